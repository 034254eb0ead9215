"""``colmap-tco poses``: rough poses of a rendered room come back; inputs of all kinds; what it refuses."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco.cli import main
from colmap_tco.depth_views import depth_in
from colmap_tco.errors import InputError
from colmap_tco.evaluation.sources import read_cameras, read_tum, world_from_cam
from colmap_tco.evaluation.trajectory import trajectory_figures
from colmap_tco.maps import write_map
from colmap_tco.poses import PosesConfig, Trajectory, poses
from colmap_tco.progress import Progress
from colmap_tco.rough import RoughConfig
from colmap_tco.tracks import read_tracks
from colmap_tco.views import ViewConfig, make_views
from colmap_tco.workspace import open_workspace
from tco.pose_options import PoseConfig
from tests.conftest import Room

Floats = NDArray[np.float64]

QUICK = PoseConfig(sizes=(48, 80), iterations=(10, 8), neighbours=4)


def turned(axis: Floats, degrees: float) -> Floats:
    return cv2.Rodrigues(axis / np.linalg.norm(axis) * math.radians(degrees))[0]


def truth(room: Room) -> Floats:
    """World_from_cam (V, 4, 4)."""
    entries = read_cameras(room.root)
    return world_from_cam([entries[name] for name in sorted(entries)])


def perturbed(exact: Floats, seed: int = 0) -> Floats:
    """3° about random axes, 5 % of the mean distance in random directions."""
    rng = np.random.default_rng(seed)
    out = exact.copy()
    centre = exact[:, :3, 3]
    unit = np.linalg.norm(centre - centre.mean(0), axis=1).mean()
    for pose in out:
        pose[:3, :3] = pose[:3, :3] @ turned(rng.normal(size=3), 3)
        way = rng.normal(size=3)
        pose[:3, 3] += 0.05 * unit * way / np.linalg.norm(way)
    return out


def tum(path: Path, stamps: list[str], world: Floats) -> Path:
    from scipy.spatial.transform import Rotation

    rows = []
    for stamp, pose in zip(stamps, world, strict=True):
        quat = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(" ".join([stamp, *map(repr, [*pose[:3, 3].tolist(), *quat.tolist()])]))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def write_depths(room: Room, folder: Path, keep: Callable[[int], bool] = lambda i: True) -> Path:
    """16-bit PNG in millimetres, like a depth camera's."""
    folder.mkdir()
    for i, name in enumerate(room.names):
        if keep(i):
            counts = np.clip(room.sample.depth[i] * 1000, 0, 65534).round().astype(np.uint16)
            cv2.imwrite(str(folder / f"{Path(name).stem}.png"), counts)
    return folder


def camera(room: Room) -> tuple[float, ...]:
    K = room.sample.K[0]
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def settings(room: Room, tmp_path: Path, rough: Floats, **changes: object) -> PosesConfig:
    """A trajectory as the rough poses."""
    stamps = [str(i) for i in range(len(rough))]
    given = RoughConfig(
        rough=tum(tmp_path / "rough.txt", stamps, rough), match="order", camera_params=camera(room)
    )
    base = PosesConfig(output_path=tmp_path / "out", rough=given, poses=QUICK)
    return replace(base, **changes)  # type: ignore[arg-type]


def run(room: Room, config: PosesConfig) -> Trajectory:
    return poses(room.root / "images", config, Progress())


@pytest.fixture(scope="module")
def refined(room: Room, tmp_path_factory: pytest.TempPathFactory) -> tuple[Room, Floats, Trajectory]:
    """Rough poses and what became of them, from depths in millimetres."""
    folder = tmp_path_factory.mktemp("refined")
    rough = perturbed(truth(room))
    depths = write_depths(room, folder / "depths")
    return room, rough, run(room, settings(room, folder, rough, depths=depths))


def test_rough_poses_come_back(refined: tuple[Room, Floats, Trajectory]) -> None:
    """To a sixth of the rotation, and nearer in all centres, without a scale in the alignment."""
    room, rough, found = refined
    exact, ours = truth(room), read_tum(found.folder / "trajectory.txt").poses
    before, after = (trajectory_figures(p, exact, with_scale=False) for p in (rough, ours))
    assert after.rpe_rotation_deg < before.rpe_rotation_deg / 6
    assert after.rpe_translation < 0.85 * before.rpe_translation
    assert after.ate_rmse < 0.85 * before.ate_rmse


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kitchen", "office", "livingroom"])
def test_rough_poses_of_real_sets_come_nearer_by_the_sensors_depths(name: str, shared: Path) -> None:
    """Small pictures and a third of the steps; on office, sensor and model themselves differ by 8 mm."""
    from benchmarks.poses import measured

    assert (shared / "data" / name).is_dir()
    _, before, after, _ = measured(name, 0, PoseConfig(sizes=(64,), iterations=(8,), neighbours=3))
    assert after.ate_rmse < 0.9 * before.ate_rmse
    assert after.rpe_translation < 0.75 * before.rpe_translation
    assert after.rpe_rotation_deg < before.rpe_rotation_deg / 10


def test_model_and_trajectory_are_the_same_poses(refined: tuple[Room, Floats, Trajectory]) -> None:
    room, _, found = refined
    entries = read_cameras(found.folder / "sparse" / "0")
    assert sorted(entries) == sorted(room.names)
    assert {entry.camera.model.name for entry in entries.values()} == {"PINHOLE"}
    model = world_from_cam([entries[name] for name in sorted(entries)])
    np.testing.assert_allclose(model, read_tum(found.folder / "trajectory.txt").poses, atol=1e-8)


def test_the_result_is_a_workspace_with_exact_points(refined: tuple[Room, Floats, Trajectory]) -> None:
    """Its images and model open as any workspace, and each keypoint is where its point projects."""
    _, _, found = refined
    workspace = open_workspace(found.folder)
    assert not workspace.skipped
    assert len(read_tracks(workspace.model).xyz) > 500
    assert _pycolmap.point_errors(workspace.model).max() < 1e-3
    again = json.loads((found.folder / "report.json").read_text(encoding="utf-8"))
    assert again["not_moved"] == [] and again["scale"] == 1.0
    assert again["disagreement"]["after"]["geometric"] < again["disagreement"]["before"]["geometric"] / 3


def test_nothing_of_the_users_is_changed(room: Room, tmp_path: Path) -> None:
    depths = write_depths(room, tmp_path / "depths")
    before = {p: p.read_bytes() for root in (room.root, depths) for p in root.rglob("*") if p.is_file()}
    few = replace(QUICK, sizes=(48,), iterations=(1,))
    run(room, settings(room, tmp_path, perturbed(truth(room)), depths=depths, poses=few))
    assert {
        p: p.read_bytes() for root in (room.root, depths) for p in root.rglob("*") if p.is_file()
    } == before


def test_a_rough_model_in_another_unit_gets_the_scale_of_its_points(
    room: Room, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The room's model with all lengths a seventh: the scale comes from depths over triangulated points."""
    model = _pycolmap.read_model(room.root / "sparse" / "0")
    pycolmap = _pycolmap.load()
    model.transform(pycolmap.Sim3d(1 / 7, pycolmap.Rotation3d(), np.zeros(3)))
    (tmp_path / "model").mkdir()
    model.write(str(tmp_path / "model"))
    few = replace(QUICK, sizes=(64,), iterations=(2,))
    config = PosesConfig(
        depths=write_depths(room, tmp_path / "depths"), output_path=tmp_path / "out", poses=few,
        rough=RoughConfig(rough=tmp_path / "model"),
    )  # fmt: skip
    with caplog.at_level(logging.INFO, logger="colmap_tco"):
        found = run(room, config)
    assert found.report["scale"] == pytest.approx(7, rel=0.01)
    assert "triangulated points" in caplog.text
    exact, ours = truth(room), read_tum(found.folder / "trajectory.txt").poses
    moved = np.linalg.norm(ours[:, :3, 3] - exact[:, :3, 3], axis=1)
    assert moved.max() < 0.01 * np.linalg.norm(exact[:, :3, 3] - exact[:, :3, 3].mean(0), axis=1).max() + 0.01


def test_a_view_without_depth_keeps_its_rough_pose_and_is_named(
    room: Room, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rough = perturbed(truth(room))
    depths = write_depths(room, tmp_path / "depths", keep=lambda i: i != 2)
    few = replace(QUICK, sizes=(48,), iterations=(2,))
    found = run(room, settings(room, tmp_path, rough, depths=depths, poses=few))
    assert found.report["not_moved"] == [sorted(room.names)[2]]
    assert sorted(room.names)[2] in caplog.text
    ours = read_tum(found.folder / "trajectory.txt").poses
    np.testing.assert_allclose(ours[2], rough[2], atol=1e-7)
    assert np.abs(ours[3] - rough[3]).max() > 1e-3


@pytest.mark.parametrize("kind", ["npy", "bin", "half", "sparse"])
def test_depths_of_all_kinds_are_the_same_depths(room: Room, tmp_path: Path, kind: str) -> None:
    """Floats, COLMAP's maps, half the resolution, and one pixel in nine: all near the rendered depth."""
    workspace = open_workspace(room.root)
    (view, *_), _ = make_views(workspace, ViewConfig(max_image_size=64), 4)
    exact = room.sample.depth[0]
    measured = exact
    if kind == "half":
        measured = exact[::2, ::2]
    elif kind == "sparse":
        measured = np.zeros_like(exact)
        measured[1::3, 1::3] = exact[1::3, 1::3]
    elif kind == "npy":
        np.save(tmp_path / "view.npy", np.where(exact > np.median(exact), np.nan, exact))
        from colmap_tco.evaluation.maps import read_depth

        read = read_depth(tmp_path / "view.npy", 0.0)
        assert np.array_equal(read == 0, exact > np.median(exact))
        return
    else:
        from colmap_tco.evaluation.maps import read_depth

        write_map(tmp_path / "view.bin", exact)
        measured = read_depth(tmp_path / "view.bin", 0.0)
    found, whole = depth_in(view, measured), depth_in(view, exact)
    assert (found > 0).mean() > 0.99
    assert np.median(np.abs(found / whole - 1)) < 0.01
    assert set(np.unique(found)) <= {0.0, *np.unique(measured)}


def test_the_command_line_says_what_to_do_without_rough_poses(
    room: Room, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The network in the package takes cameras: exit code 3, and the two ways out."""
    depths = write_depths(room, tmp_path / "depths")
    argv = ["poses", str(room.root / "images"), "--depths", str(depths), "--backbone", "sweep"]
    assert main([*argv, "--output_path", str(tmp_path / "out")]) == 3
    told = capsys.readouterr().err
    assert "--rough" in told and "--backbone vggt" in told
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_used_is_refused(room: Room, tmp_path: Path) -> None:
    depths = write_depths(room, tmp_path / "depths")
    good = settings(room, tmp_path, perturbed(truth(room)), depths=depths)
    with pytest.raises(InputError, match="--depths is missing"):
        run(room, replace(good, depths=None))
    with pytest.raises(InputError, match="no such folder"):
        run(room, replace(good, depths=tmp_path / "nowhere"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="0 of 7 images have a depth map"):
        run(room, replace(good, depths=tmp_path / "empty"))
    with pytest.raises(InputError, match="--camera_params"):
        run(room, replace(good, rough=replace(good.rough, camera_params=())))
    with pytest.raises(InputError, match="not the parameters of PINHOLE"):
        run(room, replace(good, rough=replace(good.rough, camera_params=(300.0, 160.0, 120.0))))
    with pytest.raises(InputError, match="neither a TUM trajectory"):
        run(room, replace(good, rough=replace(good.rough, rough=tmp_path / "nothing")))
    with pytest.raises(InputError, match="--rough_scale"):
        run(room, replace(good, rough=replace(good.rough, rough_scale=1000.0)))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("all of it")
    with pytest.raises(InputError, match="no result of this command"):
        run(room, replace(good, output_path=tmp_path / "mine", overwrite=True))
    wide = tmp_path / "wide"
    wide.mkdir()
    for name in room.names:
        cv2.imwrite(str(wide / name), np.full((100, 320), 1500, np.uint16))
    with pytest.raises(InputError, match="do not show the same picture"):
        run(room, replace(good, depths=wide))
