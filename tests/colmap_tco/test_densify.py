"""The whole way from a workspace to its dense result, on a rendered room whose depth is known."""

from __future__ import annotations

import gc
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from colmap_tco import _pycolmap, chunkwise
from colmap_tco.backbones import NetworkConfig, select
from colmap_tco.chunks import plan_chunks
from colmap_tco.cli import main
from colmap_tco.densify import Densified, DensifyConfig, densify, limited_threads
from colmap_tco.errors import InputError, PartlyDoneError
from colmap_tco.fusion import FusionConfig
from colmap_tco.lock import locked
from colmap_tco.mapping import MappingConfig
from colmap_tco.maps import read_map
from colmap_tco.origin import origin_of
from colmap_tco.outputs import plain, reaches, read_view
from colmap_tco.ply import read_ply, read_vis
from colmap_tco.predict import view_maps
from colmap_tco.priors import PriorConfig, held_out
from colmap_tco.progress import Progress
from colmap_tco.scene import open_scene
from colmap_tco.tracks import covisibility, read_tracks
from colmap_tco.views import ViewConfig, make_views
from colmap_tco.workspace import DensePaths, WorkspaceConfig, open_workspace
from tco.options import ConsensusConfig, PolishConfig, TCOConfig
from tco.types import Prediction

if TYPE_CHECKING:
    from tests.conftest import Room

ROOT = Path(__file__).resolve().parents[2]
FLAGS = ("--max_image_size", "128", "--chunk_size", "8", "--device", "cpu", "--polish_looks", "1")
"""The settings of :func:`config` on a command line."""


def config(steps: int = 0, **changes: Any) -> DensifyConfig:
    """Small images, so that a run takes seconds."""
    plain = DensifyConfig(
        network=NetworkConfig(device="cpu", chunk_size=8),
        tco=TCOConfig(steps=steps, polish=PolishConfig(polish_looks=1)),
        views=ViewConfig(max_image_size=128),
    )
    return replace(plain, **changes)


def made(root: Path, settings: DensifyConfig) -> Densified:
    return densify(root, settings, Progress())


IGNORED = ("dense-tco", ".dense-tco.partial", ".dense-tco.lock")


def bytes_of(folder: Path, besides: tuple[str, ...] = IGNORED) -> dict[str, str]:
    """Hash and time of change of every file below a folder, leaving out some of its entries."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {
        str(path.relative_to(folder)): (
            f"{hashlib.sha256(path.read_bytes()).hexdigest()} {path.stat().st_mtime_ns}"
        )
        for path in files
        if path.relative_to(folder).parts[0] not in besides
    }


@dataclass(frozen=True)
class Done:
    """A finished run and what was in the workspace before it."""

    room: Room
    result: Densified
    before: dict[str, str]

    @property
    def dense(self) -> Path:
        return self.result.folder


@pytest.fixture(scope="module")
def done(room: Room, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """Two steps of optimisation, for tests that only read."""
    import shutil

    root = tmp_path_factory.mktemp("done") / "room"
    shutil.copytree(room.root, root)
    before = bytes_of(root)
    return Done(replace(room, root=root), made(root, config(steps=2)), before)


def truth(room: Room, view: int, shape: tuple[int, ...]) -> np.ndarray:
    """True depth (H, W) at the pixel centres of a smaller map."""
    h, w = room.sample.depth.shape[1:]
    rows = ((np.arange(shape[0]) + 0.5) * h / shape[0]).astype(int)
    cols = ((np.arange(shape[1]) + 0.5) * w / shape[1]).astype(int)
    return room.sample.depth[view][rows[:, None], cols]


def assert_accurate(room: Room, dense: Path, within: float = 0.05, share: float = 0.75) -> None:
    """Most pixels of every depth map are within some per cent of the truth."""
    for i, name in enumerate(room.names):
        depth = read_map(dense / "stereo" / "depth_maps" / f"{name}.geometric.bin")
        error = np.abs(depth / truth(room, i, depth.shape) - 1)
        assert (error < within).mean() > share, name


def test_the_result_is_complete(done: Done) -> None:
    assert done.dense == done.room.root / "dense-tco"
    assert done.result.fresh
    names = done.room.names
    expected = {f"images/{name}" for name in names}
    for kind in ("depth", "normal", "confidence", "error"):
        expected |= {f"stereo/{kind}_maps/{name}.geometric.bin" for name in names}
    for kind in ("depth", "normal"):
        expected |= {f"stereo/{kind}_maps/{name}.photometric.bin" for name in names}
    expected |= {"fused.ply", "fused.ply.vis", "report.json", "report.html", "manifest.json"}
    expected |= {"stereo/fusion.cfg", "stereo/patch-match.cfg"}
    found = {path.relative_to(done.dense).as_posix() for path in done.dense.rglob("*") if path.is_file()}
    model = {f"sparse/{kind}.bin" for kind in ("cameras", "images", "points3D")}
    assert model <= found
    rest = {path for path in found if not path.startswith("sparse/")}
    assert rest == expected
    assert not (done.room.root / ".dense-tco.partial").exists()


def test_nothing_that_the_user_had_is_changed(done: Done) -> None:
    assert bytes_of(done.room.root) == done.before


def test_depth_maps_are_close_to_the_rendered_truth(done: Done) -> None:
    assert_accurate(done.room, done.dense)


def test_normals_are_those_of_the_rendered_surfaces(done: Done) -> None:
    """The normal of the largest wall, which is a plane of constant world y in this room."""
    pose = done.room.sample.cam_from_world[3]
    normal = read_map(done.dense / "stereo" / "normal_maps" / f"{done.room.names[3]}.geometric.bin")
    assert np.allclose(np.linalg.norm(normal, axis=2)[normal.any(2)], 1, atol=1e-4)
    world = normal @ pose[:3, :3]
    axes = np.abs(world).max(2)  # the room and most of its furniture are aligned with the axes
    assert (axes[normal.any(2)] > 0.98).mean() > 0.4
    assert (normal[..., 2] < 0.2).mean() > 0.95  # towards the camera


def test_the_cloud_lies_on_the_rendered_surfaces(done: Done) -> None:
    points, normals, colors = read_ply(done.dense / "fused.ply")
    assert len(points) > 3000 and len(points) == len(normals) == len(colors)
    sample, errors = done.room.sample, []
    for pose, K, depth in zip(sample.cam_from_world, sample.K, sample.depth, strict=True):
        local = points @ pose[:3, :3].T + pose[:3, 3]
        xy = np.floor((local / local[:, 2:]) @ K.T)[:, :2].astype(int)
        inside = (local[:, 2] > 0.1) & (xy >= 0).all(1) & (xy < (320, 240)).all(1)
        error = np.full(len(points), np.inf)
        error[inside] = np.abs(local[inside, 2] / depth[xy[inside, 1], xy[inside, 0]] - 1)
        errors.append(error)
    assert (np.min(errors, axis=0) < 0.02).mean() > 0.93


def test_colmap_reads_the_result(done: Done) -> None:
    pycolmap = _pycolmap.load()
    model = pycolmap.Reconstruction(str(done.dense / "sparse"))
    original = pycolmap.Reconstruction(str(done.room.root / "sparse" / "0"))
    assert model.num_reg_images() == len(done.room.names)
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
    ours, theirs = (
        {entry.name: entry.cam_from_world for entry in _pycolmap.registered(m)} for m in (model, original)
    )
    for name in done.room.names:
        np.testing.assert_allclose(ours[name], theirs[name], atol=1e-9)
        depth = pycolmap.DepthMap()
        depth.read(str(done.dense / "stereo" / "depth_maps" / f"{name}.geometric.bin"))
        map_ = read_map(done.dense / "stereo" / "depth_maps" / f"{name}.geometric.bin")
        np.testing.assert_array_equal(depth.to_array(), map_)


def test_visibility_names_views_that_see_the_point(done: Done) -> None:
    points, _, _ = read_ply(done.dense / "fused.ply")
    visibility = read_vis(done.dense / "fused.ply.vis")
    assert len(visibility) == len(points)
    assert min(len(views) for views in visibility) >= 1
    assert max(max(views) for views in visibility) < len(done.room.names)


def test_the_report_says_what_was_done(done: Done) -> None:
    report = json.loads((done.dense / "report.json").read_text("utf-8"))
    assert set(report["views"]) == set(done.room.names)
    for figures in report["views"].values():
        assert figures["state"] == "used"
        assert figures["points"] > 50
    assert [len(chunk) for chunk in report["loss"]] == [config(steps=2).tco.all_steps(len(done.room.names))]
    terms = {name for step in report["loss"][0] for name in step}
    assert {"photometric", "sparse", "cameras", "loss"} <= terms
    held = report["held_out"]
    assert held["points"] == sum(v["points_held_out"] for v in report["views"].values()) > 50
    assert 0.7 < held["within_5_percent"] <= 1 and 0 < held["median_error"] < 0.02
    assert report["points"] == len(read_ply(done.dense / "fused.ply")[0])
    assert report["seconds"].keys() == {"workspace", "optimisation", "fusion"}
    assert report["settings"]["tco"]["steps"] == 2 and report["settings"]["views"]["max_image_size"] == 128
    assert {"python", "pycolmap", "torch", "numpy"} <= report["versions"].keys()
    assert report["device"] == "cpu"
    assert report["workspace"]["model"].endswith("sparse/0")


def test_a_number_of_threads_binds_all_who_have_their_own(room: Room) -> None:
    """Torch and OpenCV while the run lasts, and the loops over pixels: with one, no thread is begun."""
    import threading

    import cv2
    import torch

    before = torch.get_num_threads(), cv2.getNumThreads()
    with limited_threads(1):
        assert (torch.get_num_threads(), cv2.getNumThreads()) == (1, 1)
    assert (torch.get_num_threads(), cv2.getNumThreads()) == before

    scene = open_scene(room.root, ViewConfig(max_image_size=160))
    view, valid = scene.images[0], scene.views.valid
    assert view.network.height > 64  # more rows than a thread takes at a time
    flat = Prediction(torch.ones(valid.shape), torch.ones(valid.shape), scene.priors.cameras, (0,))
    begun: list[str] = []
    for threads in (1, 2):
        threading.setprofile(lambda *_: begun.append(threading.current_thread().name))
        view_maps(view, flat, 0, valid, 1.0, num_threads=threads)
        threading.setprofile(None)
        assert bool(begun) == (threads == 2)


def test_the_summary_names_the_cloud_and_the_quality(done: Done) -> None:
    text = done.result.summary()
    assert str(done.dense / "fused.ply") in text and str(done.dense / "report.json") in text
    assert "depths at held-out points within 5 %" in text and "made" in text


def test_a_second_run_says_that_all_is_done_and_changes_nothing(done: Done) -> None:
    before = bytes_of(done.room.root, besides=())
    again = made(done.room.root, config(steps=2))
    assert not again.fresh and "already made" in again.summary()
    assert again.report == done.result.report
    threads = config(steps=2)
    threads = replace(threads, fusion=replace(threads.fusion, num_threads=1))  # decides nothing
    assert not made(done.room.root, threads).fresh
    assert bytes_of(done.room.root, besides=()) == before


def test_a_copy_of_a_workspace_is_complete_too(done: Done, tmp_path: Path) -> None:
    """With files of another time, and where a model is there, however one would have been made."""
    import shutil

    root = tmp_path / "elsewhere"
    shutil.copytree(done.room.root, root, copy_function=shutil.copyfile)
    assert not made(root, config(steps=2)).fresh
    settings = config(
        steps=2,
        mapping=MappingConfig(mapper="global", matcher="sequential"),
        workspace=WorkspaceConfig(image_path=str(root / "images"), model_path=str(root / "sparse" / "0")),
    )
    assert not made(root, settings).fresh
    picture = root / "images" / done.room.names[1]
    picture.write_bytes((root / "images" / done.room.names[2]).read_bytes())
    with pytest.raises(InputError, match=f"other inputs .picture {done.room.names[1]}.; give --overwrite"):
        made(root, config(steps=2))


def test_the_device_counts_and_not_how_it_was_named(done: Done) -> None:
    import torch

    if torch.cuda.is_available():
        pytest.skip("auto is another device here")
    settings = config(steps=2)
    auto = replace(settings, network=replace(settings.network, device="auto", backbone="sweep"))
    assert not made(done.room.root, auto).fresh


def test_boxes_in_map_coordinates_are_told_apart(done: Done) -> None:
    """Two that differ by 3 m at 5400 km, and the report has them to the last digit."""
    box = (499_000.0, 5_399_000.0, 0.0, 501_000.0, 5_401_001.25, 900.0)
    far = (*box[:4], box[4] + 3, box[5])
    origins = [
        origin_of(
            open_workspace(done.room.root),
            (),
            config(fusion=FusionConfig(roi=roi)),
            select(NetworkConfig(device="cpu")),
        )
        for roi in (box, far)
    ]
    assert not origins[0].same_result(origins[1]) and origins[0].same_maps(origins[1])
    assert origins[1].settings["roi"] == list(far)
    assert plain({"settings": FusionConfig(roi=far)})["settings"]["roi"] == list(far)  # type: ignore[index]


@pytest.mark.parametrize("changes", [{"seed": 1}, {"priors": PriorConfig(holdout=0.2)}])
def test_other_settings_do_not_replace_a_result_by_themselves(done: Done, changes: dict[str, Any]) -> None:
    before = bytes_of(done.room.root, besides=())
    with pytest.raises(InputError, match=r"other settings.*--overwrite"):
        made(done.room.root, config(steps=2, **changes))
    assert bytes_of(done.room.root, besides=()) == before


def test_overwrite_replaces_a_result(fresh_room: Room) -> None:
    first = made(fresh_room.root, config())
    (first.folder / "fused.ply").unlink()
    second = made(fresh_room.root, config(seed=1, overwrite=True))
    assert second.fresh and (second.folder / "fused.ply").exists()
    assert sorted(p.name for p in fresh_room.root.iterdir()) == ["dense-tco", "images", "sparse"]
    assert not made(fresh_room.root, config(seed=1)).fresh


def test_equal_settings_give_equal_results(fresh_room: Room, done: Done) -> None:
    again = made(fresh_room.root, config(steps=2))
    same = ("fused.ply", "fused.ply.vis", "stereo/depth_maps/view_2.png.geometric.bin", "sparse/images.bin")
    for name in same:
        assert (again.folder / name).read_bytes() == (done.dense / name).read_bytes(), name
    assert again.report["views"] == done.result.report["views"]


def test_without_steps_it_is_the_plain_prediction_in_colmaps_cameras(fresh_room: Room) -> None:
    result = made(fresh_room.root, config(steps=0))
    assert_accurate(fresh_room, result.folder)
    assert result.report["loss"] == [[]]
    for figures in result.report["views"].values():
        assert figures["correction"] == {"rotation_degrees": 0.0, "centre": 0.0, "focal": 0.0}


def keypoints(model: Path, image_id: int) -> np.ndarray:
    return _pycolmap.observations(_pycolmap.read_model(model), image_id)[0]


def poses(model: Path) -> dict[str, np.ndarray]:
    return {e.name: e.cam_from_world for e in _pycolmap.registered(_pycolmap.read_model(model))}


def test_chunks_give_every_view_once(fresh_room: Room) -> None:
    network = NetworkConfig(device="cpu", chunk_size=4)
    result = made(fresh_room.root, config(steps=1, network=network))
    assert sorted(result.report["views"]) == sorted(fresh_room.names)
    assert len(result.report["loss"]) > 1
    assert (result.folder / "stereo" / "fusion.cfg").read_text().split() == list(fresh_room.names)
    assert_accurate(fresh_room, result.folder, share=0.7)


def test_corrected_cameras_are_written_where_asked_for(fresh_room: Room) -> None:
    """The report says how far each went; without the option the same run keeps COLMAP's."""
    eager = TCOConfig(steps=8, camera_rate=0.5)  # every view is a source
    result = made(fresh_room.root, config(tco=eager, refine_cameras=True))
    ours, theirs = poses(result.folder / "sparse"), poses(fresh_room.root / "sparse" / "0")
    for name, figures in result.report["views"].items():
        relative = ours[name][:, :3] @ theirs[name][:, :3].T
        angle = np.degrees(np.linalg.norm(relative - relative.T) / np.sqrt(8))
        assert angle > 1e-4
        assert angle == pytest.approx(figures["correction"]["rotation_degrees"], rel=1e-3, abs=1e-6)
        a, b = (-pose[name][:, :3].T @ pose[name][:, 3] for pose in (ours, theirs))
        assert np.linalg.norm(a - b) == pytest.approx(figures["correction"]["centre"], rel=1e-3, abs=1e-7)
    assert_accurate(fresh_room, result.folder)
    assert result.report["views"][name]["correction"]["focal"] != 0
    # Keypoints are where they are in the images, which were not drawn anew for the corrected cameras.
    original = keypoints(fresh_room.root / "sparse" / "0", 3)
    np.testing.assert_allclose(keypoints(result.folder / "sparse", 3), original, atol=1e-6)

    kept = made(fresh_room.root, config(tco=eager, overwrite=True))
    for name, pose in poses(kept.folder / "sparse").items():
        np.testing.assert_allclose(pose, theirs[name], atol=1e-9)
    assert kept.report["views"][name]["correction"]["rotation_degrees"] > 1e-4


def test_corrected_cameras_keep_the_precision_of_map_coordinates(fresh_room: Room) -> None:
    """Coordinates of millions: the written centres move by the correction, not by rounding."""
    model = _pycolmap.read_model(fresh_room.root / "sparse" / "0")
    pycolmap = _pycolmap.load()
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([4.1e6, -6.2e5, 300.0])))
    model.write(str(fresh_room.root / "sparse" / "0"))
    for text in (fresh_room.root / "sparse" / "0").glob("*.txt"):
        text.unlink()
    result = made(fresh_room.root, config(steps=1, refine_cameras=True))
    ours, theirs = poses(result.folder / "sparse"), poses(fresh_room.root / "sparse" / "0")
    for name, figures in result.report["views"].items():
        a, b = (-pose[name][:, :3].T @ pose[name][:, 3] for pose in (ours, theirs))
        assert np.linalg.norm(a - b) == pytest.approx(figures["correction"]["centre"], rel=0.01, abs=1e-6)
    assert_accurate(fresh_room, result.folder)


def test_nothing_large_waits_for_a_search_for_cycles(fresh_room: Room) -> None:
    """A run searches for none, so that what it let go of must be free without."""
    import torch

    gc.collect()
    gc.disable()
    try:
        assert made(fresh_room.root, config(steps=2)).fresh
        gc.set_debug(gc.DEBUG_SAVEALL)
        gc.collect()
        large = [thing for thing in gc.garbage if isinstance(thing, (torch.Tensor, np.ndarray))]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert not large


def test_images_that_cannot_be_used_are_left_out_and_named(fresh_room: Room) -> None:
    missing, cut = fresh_room.names[2], fresh_room.names[5]
    (fresh_room.root / "images" / missing).unlink()
    path = fresh_room.root / "images" / cut
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(PartlyDoneError, match="2 images were left out"):
        made(fresh_room.root, config())
    report = json.loads((fresh_room.root / "dense-tco" / "report.json").read_text("utf-8"))
    states = {name: figures["state"] for name, figures in report["views"].items()}
    assert states == {n: "skipped" if n in (missing, cut) else "used" for n in fresh_room.names}
    assert "there is no file" in report["views"][missing]["why"]
    assert "cannot be decoded" in report["views"][cut]["why"]
    assert len(read_ply(fresh_room.root / "dense-tco" / "fused.ply")[0]) > 2000
    assert missing not in poses(fresh_room.root / "dense-tco" / "sparse")
    before = bytes_of(fresh_room.root, besides=())
    with pytest.raises(PartlyDoneError, match=r"already made[^$]*2 images were left out"):
        made(fresh_room.root, config())
    assert bytes_of(fresh_room.root, besides=()) == before


def test_pictures_that_are_not_in_the_model_are_named_and_harm_nothing(fresh_room: Room) -> None:
    """One that no model has, and one that only a smaller model has."""
    import shutil

    pictures, name = fresh_room.root / "images", "other.png"
    shutil.copy(pictures / fresh_room.names[0], pictures / "new.png")
    shutil.copy(pictures / fresh_room.names[1], pictures / name)
    smaller = fresh_room.root / "sparse" / "1"
    shutil.copytree(fresh_room.root / "sparse" / "0", smaller)
    model = _pycolmap.read_model(smaller)
    entries = _pycolmap.registered(model)
    model.images[entries[1].image_id].name = name
    for entry in entries[4:]:
        model.deregister_frame(model.images[entry.image_id].frame_id)
    for text in smaller.glob("*.txt"):
        text.unlink()
    model.write(str(smaller))
    report = made(fresh_room.root, config()).report
    assert report["images"] == {"used": len(fresh_room.names), "skipped": 0, "failed": 0, "unregistered": 2}
    states = {image: figures["state"] for image, figures in report["views"].items()}
    assert states == {
        **dict.fromkeys(fresh_room.names, "used"), "new.png": "unregistered", name: "unregistered"
    }  # fmt: skip
    assert "did not register" in report["views"]["new.png"]["why"]
    assert f"registered it in {smaller}" in report["views"][name]["why"]


def test_maps_are_nearer_to_the_truth_after_the_views_were_asked(done: Done) -> None:
    """Median errors of a view's own map, which the cloud is made of, and of the one that agrees."""
    room, paths = done.room, DensePaths(done.dense)
    errors = []
    for i, name in enumerate(room.names):
        own, together = read_map(paths.own_maps(name)[0]), read_map(paths.depth_map(name))
        assert read_view(paths, name).depth.tobytes() == own.tobytes()
        known = truth(room, i, own.shape)
        errors.append([np.median(np.abs(depth / known - 1)) for depth in (own, together)])
        told = done.result.report["views"][name]["moved_by_consensus"]
        on_planes = done.result.report["views"][name]["on_planes"]
        assert told > 0
        assert 0 <= on_planes <= 1
        taken = done.result.report["views"][name]["taken_from_others"]
        assert 0 <= taken < 0.2
        asked = done.result.report["views"][name]["asked_by_consensus"]
        error = read_map(paths.error_map(name))
        assert (
            error.shape == own.shape
            and bool(((error == 0) | (error >= 1e-6)).all())
            and np.isfinite(error).all()
        )
        known_error = error > 0
        agreed = read_view(paths, name, agreed=True)
        assert agreed.depth.tobytes() == together.tobytes() and agreed.error is not None
        assert agreed.error.tobytes() == error.tobytes() and read_view(paths, name).error is None
        assert known_error.mean() == pytest.approx(asked, rel=0.01) and asked > 0.2
    before, after = np.mean(errors, axis=0)
    assert after < 0.95 * before


def test_the_report_says_how_far_views_moved_the_depths(fresh_room: Room) -> None:
    """Without planes and contest that is the difference of the two maps of a view."""
    plain = config(steps=0)
    consensus = ConsensusConfig(planes=0, contest_views=0)
    done = made(fresh_room.root, replace(plain, tco=replace(plain.tco, consensus=consensus)))
    paths = DensePaths(done.folder)
    for name, figures in done.report["views"].items():
        own, together = read_map(paths.own_maps(name)[0]), read_map(paths.depth_map(name))
        moved = float(np.median(np.abs(np.log(together / own))))
        assert figures["moved_by_consensus"] == pytest.approx(moved, rel=0.01) and moved > 1e-4
        assert figures["on_planes"] == figures["taken_from_others"] == 0


def test_views_that_are_not_asked_keep_their_own_maps(fresh_room: Room) -> None:
    plain = config(steps=0)
    alone = replace(plain, tco=replace(plain.tco, consensus=ConsensusConfig(consensus_rounds=0)))
    paths = DensePaths(made(fresh_room.root, alone).folder)
    for name in fresh_room.names:
        for own, together in zip(
            paths.own_maps(name), (paths.depth_map(name), paths.normal_map(name)), strict=True
        ):
            assert own.read_bytes() == together.read_bytes()
        assert not read_map(paths.error_map(name)).any()
    report = json.loads(paths.report.read_text("utf-8"))
    assert report["fusion"]["gaps"] is None  # nobody was asked, so that there is nothing to fill them with


def test_other_settings_of_the_fusion_keep_the_depth_maps(fresh_room: Room) -> None:
    """The same bytes from the same time, in a new cloud; and the cloud of a run from the beginning."""
    settings = config(steps=1)
    first = made(fresh_room.root, settings)
    files = {path.relative_to(first.folder): path.stat() for path in first.folder.rglob("stereo/*/*.bin")}
    loose = replace(settings, fusion=replace(settings.fusion, min_num_pixels=2))
    with pytest.raises(InputError, match="its depth maps will be kept"):
        made(fresh_room.root, loose)
    second = made(fresh_room.root, replace(loose, overwrite=True))
    for name, status in files.items():
        now = (second.folder / name).stat()
        assert (now.st_ino, now.st_mtime_ns) == (status.st_ino, status.st_mtime_ns)
    assert second.report["points"] > first.report["points"]
    assert second.report["loss"] == first.report["loss"]
    spent = [run.report["seconds"]["optimisation"] for run in (first, second)]
    assert (
        spent[0] == spent[1] == pytest.approx(first.report["chunks"][0]["seconds"], rel=1e-5) and spent[0] > 0
    )
    assert len(first.report["loss"][0]) == settings.tco.all_steps(len(fresh_room.names))
    assert second.report["views"] == first.report["views"]
    assert not made(fresh_room.root, loose).fresh
    anew = made(fresh_room.root, replace(loose, overwrite=True))
    some = next(iter(files))
    assert (anew.folder / some).stat().st_ino != files[some].st_ino
    assert anew.report["points"] == second.report["points"]
    near = replace(settings, fusion=replace(settings.fusion, max_depth_ratio=0.8), overwrite=True)
    assert_far_pixels_are_dropped(made(fresh_room.root, near), fresh_room.root, 0.8)


def assert_far_pixels_are_dropped(result: Densified, root: Path, ratio: float) -> None:
    """All that lie beyond so many times the reach of the model's points, in the maps that are fused."""
    workspace = open_workspace(root)
    views, _ = make_views(workspace, ViewConfig(), 8)
    far = 0
    for name, reach in reaches(read_tracks(workspace.model), views).items():
        own = read_map(DensePaths(result.folder).own_maps(name)[0])
        far += int((own.astype(np.float64) > ratio * reach).sum())  # as compiled loops compare
    assert result.report["fusion"]["pixels"]["max_depth_ratio"] == far > 1000


@pytest.mark.parametrize("kind", ["vggt", "pi3", "da3", "mini"])
def test_networks_that_predict_cameras_run_through(fresh_room: Room, tmp_path: Path, kind: str) -> None:
    """With random weights: every file is there, in COLMAP's cameras, and nobody is told that it is good."""
    from tests.colmap_tco.test_backbones import written

    weights = str(written(tmp_path / "random.safetensors", kind))
    network = NetworkConfig(backbone="auto", device="cpu", chunk_size=8, weights=weights)
    with pytest.raises(PartlyDoneError, match=r"contradict COLMAP's points .*: do not use them"):
        made(fresh_room.root, config(steps=1, network=network, views=ViewConfig(max_image_size=70)))
    dense = fresh_room.root / "dense-tco"
    report = json.loads((dense / "report.json").read_text("utf-8"))
    assert report["images"]["used"] == len(fresh_room.names) and not report["held_out"]["plausible"]
    assert len(read_ply(dense / "fused.ply")[0]) == len(read_vis(dense / "fused.ply.vis")) == report["points"]
    assert (report["points"] == 0) == bool(report["no_points"])
    assert report["backbone"]["name"] == kind and "holds weights of" in report["backbone"]["reason"]
    assert (
        report["backbone"]["licence"]
        == {
            "vggt": "CC BY-NC 4.0: no commercial use; for that there is vggt-commercial",
            "pi3": "CC BY-NC 4.0: no commercial use",
            "da3": "Apache-2.0: commercial use allowed",
            "mini": None,
        }[kind]
    )
    assert report["settings"]["tco"]["lora_targets"] == ["qkv", "proj", "fc1", "fc2"]
    (chunk,) = report["chunks"]
    assert chunk["agreement"].keys() == {"rotation_degrees", "centre", "centre_over_depth"}
    assert chunk["reduced"] is False and "do not use them" in report["doubt"]
    assert {"own_rotation", "own_translation", "own_focal"} <= report["loss"][0][0].keys()
    theirs, sides = poses(fresh_room.root / "sparse" / "0"), (56, 64) if kind == "mini" else (56, 70)
    for name, pose in poses(dense / "sparse").items():
        np.testing.assert_allclose(pose, theirs[name], atol=1e-9)
        depth = read_map(dense / "stereo" / "depth_maps" / f"{name}.geometric.bin")
        assert depth.shape == sides and (depth > 0).all()


def test_out_of_memory_leads_to_smaller_chunks(fresh_room: Room) -> None:
    """The process is limited so that four views fit and seven do not; the report says so."""
    words = ["densify", str(fresh_room.root), *FLAGS, "--steps", "0", "--num_threads", "1"]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *words], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "out of memory with 7 views" in done.stderr
    report = json.loads((fresh_room.root / "dense-tco" / "report.json").read_text("utf-8"))
    assert report["images"]["used"] == len(fresh_room.names)
    assert all(chunk["reduced"] and len(chunk["views"]) <= 3 for chunk in report["chunks"])
    assert_accurate(fresh_room, fresh_room.root / "dense-tco", share=0.6)


LIMITED = """
import sys
from colmap_tco import chunkwise
from colmap_tco.cli import main

predict = chunkwise.predict_chunk

def limited(network, tracks, views, chunk, *others):
    import torch
    if len(chunk.views) > 3:
        torch.empty(1 << 60, dtype=torch.uint8)
    return predict(network, tracks, views, chunk, *others)

chunkwise.predict_chunk = limited
sys.exit(main(sys.argv[1:]))
"""
"""Chunks of more than three views ask for more memory than any machine has."""


def test_a_workspace_in_use_is_refused(fresh_room: Room) -> None:
    with locked(fresh_room.root), pytest.raises(InputError, match="another run is working on"):
        made(fresh_room.root, config())
    assert sorted(p.name for p in fresh_room.root.iterdir()) == ["images", "sparse"]


def keep_points_of(root: Path, name: str, kept: Callable[[int], bool], most: int) -> None:
    """Let one image of a model observe only ``most`` of those points that ``kept`` chooses by their ids."""
    folder = root / "sparse" / "0"
    model = _pycolmap.read_model(folder)
    image = next(image for image in model.images.values() if image.name == name)
    left = most
    for index, point in enumerate(image.points2D):
        if not point.has_point3D():
            continue
        if left and kept(point.point3D_id):
            left -= 1
        else:
            model.delete_observation(image.image_id, index)
    model.write(str(folder))
    for text in folder.glob("*.txt"):
        text.unlink()


@pytest.mark.parametrize("points", [0, 1, 2])
def test_a_view_with_hardly_a_point_stops_nothing(fresh_room: Room, points: int) -> None:
    """Here all points that it sees are held out: none is left to tell its range of depths."""
    name = fresh_room.names[6]
    keep_points_of(fresh_room.root, name, lambda key: bool(held_out(np.array([key]), 0.1, 0)[0]), points)
    with pytest.raises(PartlyDoneError, match="1 images were left out"):
        made(fresh_room.root, config())
    report = json.loads((fresh_room.root / "dense-tco" / "report.json").read_text("utf-8"))
    assert report["views"][name]["state"] == "skipped" and "3D point" in report["views"][name]["why"]
    assert sum(v["state"] == "used" for v in report["views"].values()) == len(fresh_room.names) - 1


def test_masks_leave_holes(fresh_room: Room) -> None:
    """The left half of one view is masked: no depth there, and the others as ever."""
    import cv2

    masks = fresh_room.root / "masks"
    masks.mkdir()
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, :160] = 0
    cv2.imwrite(str(masks / fresh_room.names[1]), mask)
    views = ViewConfig(max_image_size=128, mask_path=str(masks))
    result = made(fresh_room.root, config(steps=1, views=views))
    depth = read_map(result.folder / "stereo" / "depth_maps" / f"{fresh_room.names[1]}.geometric.bin")
    normal = read_map(result.folder / "stereo" / "normal_maps" / f"{fresh_room.names[1]}.geometric.bin")
    assert not depth[:, :64].any() and (depth[:, 65:] > 0).all()
    assert not normal[:, :64].any()


def test_a_view_that_is_masked_out_altogether_stops_nothing(fresh_room: Room) -> None:
    import cv2

    masks = fresh_room.root / "masks"
    masks.mkdir()
    cv2.imwrite(str(masks / fresh_room.names[1]), np.zeros((240, 320), np.uint8))
    views = ViewConfig(max_image_size=128, mask_path=str(masks))
    result = made(fresh_room.root, config(steps=7, tco=TCOConfig(steps=7), views=views))
    depth = read_map(result.folder / "stereo" / "depth_maps" / f"{fresh_room.names[1]}.geometric.bin")
    assert not depth.any()
    assert result.report["points"] > 2000


def finished(root: Path) -> set[str]:
    """Names of the views that a run in progress has finished."""
    try:
        text = (root / ".dense-tco.partial" / "manifest.json").read_text("utf-8")
    except FileNotFoundError:
        return set()
    return set(json.loads(text)["views"])


def first_chunk(root: Path, size: int) -> set[str]:
    """Names of the views that the first chunk owns."""
    workspace = open_workspace(root)
    ids = [entry.image_id for entry in workspace.images]
    plan = plan_chunks(covisibility(read_tracks(workspace.model), ids).common, size)
    return {workspace.images[i].name for i in plan.chunks[0].owned}


@pytest.mark.slow
def test_a_killed_run_is_continued_by_the_next(fresh_room: Room) -> None:
    """Killed while the second chunk is optimised: the first is kept, the inputs are untouched."""
    before, first = bytes_of(fresh_room.root), first_chunk(fresh_room.root, 4)
    words = ["densify", str(fresh_room.root), *FLAGS, "--chunk_size", "4", "--steps", "3"]
    command = [sys.executable, "-m", "colmap_tco", *words]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        while process.poll() is None and not finished(fresh_room.root) >= first:
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGKILL)
        error = process.communicate()[1]
    assert process.returncode == -signal.SIGKILL, error
    assert bytes_of(fresh_room.root) == before
    assert not (fresh_room.root / "dense-tco").exists()
    assert finished(fresh_room.root) < set(fresh_room.names)
    files = [Path("stereo", "depth_maps", f"{name}.geometric.bin") for name in sorted(first)]
    times = [(fresh_room.root / ".dense-tco.partial" / file).stat().st_mtime_ns for file in files]

    network = NetworkConfig(device="cpu", chunk_size=4)
    result = made(fresh_room.root, config(steps=3, network=network))
    assert result.fresh and set(result.report["views"]) == set(fresh_room.names)
    assert [(result.folder / file).stat().st_mtime_ns for file in files] == times
    assert not (fresh_room.root / ".dense-tco.partial").exists()
    assert bytes_of(fresh_room.root) == before
    assert_accurate(fresh_room, result.folder, share=0.7)


@pytest.mark.slow
def test_a_folder_of_bare_images_is_mapped_first(tmp_path: Path) -> None:
    """As in the demo: pictures large enough for SIFT, COLMAP's own scale and focal length."""
    from examples.demo import accuracy, write_images
    from training.scenes import walk

    sample = walk(4, 6, (480, 640))
    names = write_images(sample, tmp_path / "images")
    before = bytes_of(tmp_path)
    result = made(tmp_path, config())
    after = bytes_of(tmp_path)
    assert {name: after[name] for name in before} == before
    assert {name.split("/")[0] for name in after} == {"images", "sparse", "database.db"}
    assert set(result.report["views"]) == set(names)
    assert accuracy(sample, names, result.folder)["within_5_percent"] > 0.65


@pytest.fixture
def command() -> Callable[..., int]:
    """The command line inside this process."""
    return lambda *words: main([*words])


def test_exit_code_0_and_the_summary(
    command: Callable[..., int], fresh_room: Room, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("densify", str(fresh_room.root), *FLAGS, "--steps", "0")
    assert command(*words) == 0
    assert "fused.ply" in capsys.readouterr().out
    assert command(*words) == 0
    told = capsys.readouterr()
    assert "already made" in told.out and "nothing to do" in told.err


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("--lora_rank", "0"), ("--lora_alpha", "0"), ("--rate", "-1"), ("--camera_rate", "-0.1"),
        ("--holdout", "2"), ("--holdout", "1"), ("--holdout", "-0.1"), ("--polish_levels", "0"),
        ("--polish_levels", "2,-1"), ("--polish_rate", "-1"), ("--structure", "7"), ("--structure", "-0.1"),
        ("--clip", "-1"), ("--chunk_size", "-3"), ("--max_image_size", "-5"), ("--camera_weight", "-1"),
        ("--stop_after", "-1"),
        ("--radius_factor", "0"), ("--seed", "-1"), ("--overlap", "-1"), ("--num_similar", "0"),
        ("--kept_confidence", "0.5"), ("--reencode", "-1"),
    ],
)  # fmt: skip
def test_exit_code_2_for_values_that_make_no_sense(
    command: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str], flag: str, value: str
) -> None:
    """Found out before the workspace is looked at, which is not there."""
    assert command("densify", str(tmp_path / "nowhere"), f"{flag}={value}") == 2
    assert flag.removeprefix("--") in capsys.readouterr().err


def test_exit_code_2_for_layers_that_the_network_does_not_have(
    command: Callable[..., int], fresh_room: Room, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("densify", str(fresh_room.root), *FLAGS, "--lora_targets", "conv,nonsense")
    assert command(*words, "--steps", "1") == 2
    assert "--lora_targets, --unfrozen: the target 'nonsense' fits no" in capsys.readouterr().err
    words = ("densify", str(fresh_room.root), *FLAGS, "--own_cameras", "uncertainty")
    assert command(*words) == 2
    assert "--own_cameras uncertainty: sweep is given the cameras" in capsys.readouterr().err
    assert not finished(fresh_room.root)


def test_exit_code_3_without_images_or_folder(
    command: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("densify", str(tmp_path / "nowhere")) == 3
    assert "nowhere is not a folder" in capsys.readouterr().err
    assert command("densify", str(tmp_path)) == 3
    assert "no pictures" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_exit_code_4_where_not_even_two_views_fit(
    command: Callable[..., int], fresh_room: Room, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Every chunk asks for more memory than any machine has; nothing is published."""
    import torch

    monkeypatch.setattr(chunkwise, "predict_chunk", lambda *_: torch.empty(1 << 60, dtype=torch.uint8))
    assert command("densify", str(fresh_room.root), *FLAGS, "--steps", "0") == 4
    told = capsys.readouterr().err
    assert "on with 3" in told and "not even two views fit the memory" in told and "--max_image_size" in told
    assert not (fresh_room.root / "dense-tco").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [(("--device", "cuda:9"), "--device cuda:9"), (("--weights", "none.safetensors"), "none.safetensors")],
)
def test_exit_code_5_without_the_device_or_the_weights(
    command: Callable[..., int], fresh_room: Room, capsys: pytest.CaptureFixture[str], words: tuple[str, str],
    told: str,
) -> None:  # fmt: skip
    """Found out before anything is mapped or written."""
    import shutil

    shutil.rmtree(fresh_room.root / "sparse")
    assert command("densify", str(fresh_room.root), *words) == 5
    assert told in capsys.readouterr().err
    assert sorted(p.name for p in fresh_room.root.iterdir()) == ["images"]


def test_exit_code_6_when_an_image_is_missing(
    command: Callable[..., int], fresh_room: Room, capsys: pytest.CaptureFixture[str]
) -> None:
    (fresh_room.root / "images" / fresh_room.names[0]).unlink()
    for _ in range(2):
        assert command("densify", str(fresh_room.root), *FLAGS, "--steps", "0") == 6
        assert "1 images were left out" in capsys.readouterr().err


def test_an_existing_result_is_kept_and_completed_within_a_region(fresh_room: Room) -> None:
    """COLMAP's undistorted cameras with true depths in the upper half; the cloud cut and thinned."""
    from colmap_tco import _pycolmap
    from colmap_tco.fill import FillConfig
    from colmap_tco.maps import write_map
    from colmap_tco.normals import normals_from_depth
    from colmap_tco.pinhole import Pinhole

    root, dense = fresh_room.root, DensePaths(fresh_room.root / "dense")
    dense.root.mkdir()
    _pycolmap.load().undistort_images(str(dense.root), str(root / "sparse" / "0"), str(root / "images"))
    K, (h, w) = fresh_room.sample.K[0], fresh_room.sample.depth.shape[1:]
    camera = Pinhole(w, h, *(float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))))
    for name, depth in zip(fresh_room.names, fresh_room.sample.depth, strict=True):
        upper = np.where(np.arange(h)[:, None] < h // 2, depth, 0).astype(np.float32)
        write_map(dense.depth_map(name), upper)
        write_map(dense.normal_map(name), normals_from_depth(upper, camera))
    box = (-100.0, -100.0, -100.0, *np.median(surface(fresh_room), 0).tolist())
    settings = config(
        fill=FillConfig(fill_only=str(dense.root)), fusion=FusionConfig(roi=box, max_points=500)
    )
    with pytest.raises(InputError, match="refine_cameras"):
        made(root, replace(settings, refine_cameras=True))
    result = made(root, settings)
    points = read_ply(result.folder / "fused.ply")[0]
    assert 400 < len(points) <= 500
    assert (points <= np.array(box[3:]) + 1e-6).all()
    pixels, gaps = result.report["fusion"]["pixels"], result.report["fusion"]["gaps"]["pixels"]
    assert pixels["roi"] > 0 < pixels["thinned"]
    assert len(points) == result.report["points"] == len(read_vis(result.folder / "fused.ply.vis"))
    assert pixels["points"] + gaps["points"] == len(points)
    for i, name in enumerate(fresh_room.names):
        depth = read_map(result.folder / "stereo" / "depth_maps" / f"{name}.geometric.bin")
        assert depth.shape == (h, w)
        error = np.abs(depth / truth(fresh_room, i, depth.shape) - 1)
        assert (error[: h // 2] < 1e-3).mean() > 0.99
        assert 0.5 < (error[h // 2 :] < 0.05).mean() > (error[h // 2 :] < 1e-3).mean()
        figures = result.report["views"][name]
        assert figures["pixels_kept"] == pytest.approx(h * w / 2, rel=0.01)
        assert figures["pixels_kept"] + figures["pixels_filled"] == (depth > 0).sum()


def surface(room: Room) -> np.ndarray:
    """Points (N, 3) of the model of a room."""
    return read_tracks(open_workspace(room.root).model).xyz
