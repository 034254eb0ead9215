"""The examples, run as they are on a rendered room whose depths, cameras and surfaces are known exactly."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from colmap_tco import _pycolmap
from colmap_tco.maps import read_map
from colmap_tco.ply import read_ply
from colmap_tco.scene import Scene, open_scene
from colmap_tco.views import ViewConfig
from colmap_tco.workspace import dense_paths
from examples import custom_backbone, custom_prior, demo, python_api, rgbd_prior
from tco.backbones.base import Backbone
from tco.geometry import transform, unproject
from tco.options import PolishConfig, TCOConfig
from tco.types import Prediction, SparseDepth
from tests.conftest import Room
from training.scenes import walk

ROOT = Path(__file__).resolve().parents[1]
SIZE, STEPS = 128, 2
SHORT = TCOConfig(steps=4, polish=PolishConfig(polish_looks=4))

Floats = NDArray[np.floating]


def run(name: str, *words: str | Path) -> str:
    """What an example prints, started as its docstring says."""
    command = [sys.executable, str(ROOT / "examples" / name), *map(str, words)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def densified(room: Room, tmp_path_factory: pytest.TempPathFactory) -> tuple[Room, str]:
    """A copy of the room in which the first example was run, and what that printed."""
    root = tmp_path_factory.mktemp("examples") / "room"
    shutil.copytree(room.root, root, ignore=shutil.ignore_patterns("dense-tco", ".dense-tco*"))
    told = run("quickstart.py", root, "--size", str(SIZE), "--steps", str(STEPS))
    return Room(root, room.names, room.sample), told


@pytest.fixture(scope="module")
def scene(room: Room) -> Scene:
    return open_scene(room.root, ViewConfig(max_image_size=SIZE))


@pytest.fixture(scope="module")
def truth(scene: Scene, room: Room) -> Tensor:
    """Depth (V, H, W) of the room in the units of the scene, 0 where there is none."""
    (h, w), (tall, wide) = scene.views.size, room.sample.depth.shape[1:]
    # The original pixel in which the centre of a network's pixel is.
    y, x = np.ix_((np.arange(h) + 0.5) * tall // h, (np.arange(w) + 0.5) * wide // w)
    return torch.from_numpy(room.sample.depth[:, y.astype(int), x.astype(int)]) / scene.frame.scale


def error(prediction: Prediction, truth: Tensor, where: Tensor | None = None) -> float:
    """Median relative error over all pixels, or some."""
    chosen = truth > 0 if where is None else (truth > 0) & where
    return float((prediction.depth / truth - 1)[chosen].abs().median())


def off_surface(room: Room, points: Floats) -> Floats:
    """Relative depth error (N,) of points (N, 3) in the view that they fit best."""
    off = np.full(len(points), np.inf)
    h, w = room.sample.depth.shape[1:]
    for depth, K, pose in zip(room.sample.depth, room.sample.K, room.sample.cam_from_world, strict=True):
        local = points @ pose[:3, :3].T + pose[:3, 3]
        ahead = local[:, 2] > 0.1
        x, y = np.floor((local / np.where(ahead, local[:, 2], 1)[:, None]) @ K.T).astype(int)[:, :2].T
        seen = ahead & (x >= 0) & (x < w) & (y >= 0) & (y < h)
        error = np.abs(local[seen, 2] / depth[y[seen], x[seen]] - 1)
        off[seen] = np.minimum(off[seen], error)
    return off


def test_quickstart_finds_the_surfaces_of_the_room(densified: tuple[Room, str]) -> None:
    room, told = densified
    points, normals, _ = read_ply(dense_paths(room.root).ply)
    assert f"{len(points)} points" in told and len(points) > 2000
    assert np.median(off_surface(room, points)) < 0.02
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)


def test_python_api_gives_what_densify_writes(densified: tuple[Room, str]) -> None:
    """Step by step and in memory, or by the command: the same depths, and the same points of the cloud."""
    room, _ = densified
    paths = dense_paths(room.root)
    cloud, maps, errors = python_api.reconstruct(room.root, SIZE, TCOConfig(steps=STEPS))
    assert set(maps) == set(room.names)
    for name, ours in maps.items():
        np.testing.assert_allclose(ours.depth, read_map(paths.depth_map(name)), rtol=1e-4)
        np.testing.assert_allclose(ours.confidence, read_map(paths.confidence_map(name)), rtol=1e-3)
    points, _, _ = read_ply(paths.ply)
    assert len(cloud) == pytest.approx(len(points), rel=0.01)
    assert float(errors.abs().median()) < 0.03


def test_export_splatting_keeps_every_point_on_its_rays(densified: tuple[Room, str]) -> None:
    """Keypoints of the tracks are where PINHOLE cameras see the points, which are on the room's surfaces."""
    room, _ = densified
    most = 1000
    told = run("export_splatting.py", room.root, "--points", str(most))
    model = _pycolmap.load().Reconstruction(str(room.root / "dense-tco-3dgs" / "sparse" / "0"))
    assert f"{len(model.points3D)} points" in told
    assert 0.9 * most <= len(model.points3D) <= most
    xyz = {key: point.xyz for key, point in model.points3D.items()}
    for entry in _pycolmap.registered(model):
        assert entry.camera.model.name == "PINHOLE"
        xy, ids = _pycolmap.observations(model, entry.image_id)
        local = np.array([xyz[key] for key in ids.tolist()]) @ entry.cam_from_world[:, :3].T
        local += entry.cam_from_world[:, 3]
        np.testing.assert_allclose(
            _pycolmap.img_from_cam(entry.camera, local[:, :2] / local[:, 2:]), xy, atol=0.01
        )
    assert min(point.track.length() for point in model.points3D.values()) >= 2
    assert np.median(off_surface(room, np.array(list(xyz.values())))) < 0.02


def test_picture_draws_the_cloud_as_a_camera_saw_it(densified: tuple[Room, str], tmp_path: Path) -> None:
    """The first of three panels, on white, has the colours of a picture; the others are from elsewhere."""
    room, _ = densified
    run("picture.py", dense_paths(room.root).root, tmp_path / "cloud.png")
    drawn = cv2.imread(str(tmp_path / "cloud.png")).astype(int)
    size = drawn.shape[1] // 3, drawn.shape[0]
    panels = np.split(drawn, 3, axis=1)
    assert all(0.05 < (panel < 255).any(2).mean() < 0.95 for panel in panels)

    def off(panel: Floats, name: str) -> float:
        seen = cv2.resize(cv2.imread(str(dense_paths(room.root).image(name))), size).astype(int)
        return float(np.median(np.abs(panel - seen)[(panel < 255).any(2)]))

    errors = [min(off(panel, name) for name in room.names) for panel in panels]
    assert errors[0] < 3 and errors[0] < 0.5 * min(errors[1:])


def test_custom_backbone_is_a_mean_of_depths_that_adapting_improves(scene: Scene, truth: Tensor) -> None:
    network = custom_backbone.Interpolator()
    assert isinstance(network, Backbone)
    before = custom_backbone.adapt(scene, 0).prediction
    assert scene.priors.sparse is not None
    for depth, points in zip(before.depth, scene.priors.sparse, strict=True):
        assert float(points.depth.min()) * (1 - 1e-4) <= float(depth.min())
        assert float(depth.max()) <= float(points.depth.max()) * (1 + 1e-4)
    assert float(before.confidence.min()) >= 1
    # A mean of equal depths is that depth, whatever the weights.
    encoded = network.encode(scene.views, scene.priors)
    own = scene.priors.sparse[0]
    flat = SparseDepth(own.xy, torch.full_like(own.depth, 1.7), own.sigma, own.track)
    with torch.no_grad():
        level = network.decode(network.with_points(encoded, {0: flat}), [0]).depth
    torch.testing.assert_close(level, torch.full_like(level, 1.7), rtol=1e-4, atol=0)
    after = custom_backbone.adapt(scene, 15)
    assert error(after.prediction, truth) < 0.9 * error(before, truth)


def test_custom_prior_puts_on_the_plane_what_is_near_it_in_truth(scene: Scene, truth: Tensor) -> None:
    """The wall y = 2, found by the example: what is truly on it comes closer, what is far from it stays."""
    found = custom_prior.dominant_plane(scene.tracks.xyz, 0.01 * scene.frame.scale)
    np.testing.assert_allclose(found * np.sign(found[1]), [0, 1, 0, -2], atol=1e-4)
    plane = 3 * found  # of any length
    assert scene.priors.cameras is not None
    cameras = scene.priors.cameras

    def distance(depth: Tensor) -> Tensor:
        local = unproject(depth, cameras.K).reshape(len(depth), -1, 3)
        points = transform(cameras.world_from_cam, local).reshape(*depth.shape, 3)
        normal, offset = np.split(scene.chunk_plane(plane), [3])
        return (points @ torch.from_numpy(normal).float() + float(offset[0])).abs()

    wall = distance(truth) < 0.002
    assert 0.4 < float(wall.float().mean()) < 0.8
    term = custom_prior.plane_term(scene.chunk_plane(plane))
    cost = term.penalty(0, truth[0], cameras)
    assert cost is not None
    share = float((~wall[0]).float().mean())
    assert 0.5 * share < float(cost) < share + 0.01  # below 1 for each pixel that is not on it
    without = custom_prior.adapt(scene, None, SHORT).prediction
    outcome = custom_prior.adapt(scene, plane, SHORT)
    assert all("plane" in step for step in outcome.history)
    off = [float(distance(p.depth)[wall].median()) for p in (without, outcome.prediction)]
    assert off[1] < 0.8 * off[0]
    apart = distance(truth) > 0.1 * truth  # five times the reach of the penalty
    assert 0.1 < float(apart.float().mean()) < 0.5
    assert error(outcome.prediction, truth, apart) < 1.15 * error(without, truth, apart)


def test_the_dominant_plane_is_found_among_other_points() -> None:
    rng = np.random.default_rng(1)
    on = np.c_[rng.uniform(-1, 1, (120, 2)), np.zeros(120)] + [0, 0, 3]
    plane = custom_prior.dominant_plane(np.r_[on, rng.uniform(-1, 1, (80, 3))], 0.01)
    np.testing.assert_allclose(np.abs(plane), [0, 0, 1, 3], atol=1e-9)


UNIT, METRES = 0.0005, 0.3
"""Metres of a step of the sensor, and of a unit of the room's model."""


def write_sensor(room: Room, folder: Path) -> None:
    """Depths of every other stripe of the pictures, with the noise of a Kinect."""
    rng = np.random.default_rng(0)
    for name, depth in zip(room.names, room.sample.depth, strict=True):
        there = METRES * depth
        sigma = rgbd_prior.kinect(torch.from_numpy(there)).numpy()
        measured = np.rint((there + sigma * rng.normal(size=depth.shape)) / UNIT)
        measured[:, (np.arange(depth.shape[1]) // 20) % 2 == 0] = 0
        cv2.imwrite(str(folder / f"{Path(name).stem}.png"), measured.astype(np.uint16))


def test_rgbd_prior_brings_its_scale_and_its_accuracy(
    scene: Scene, truth: Tensor, room: Room, tmp_path: Path
) -> None:
    """In metres, which COLMAP does not know; and where the sensor saw nothing it does no harm."""
    write_sensor(room, tmp_path)
    known, found = rgbd_prior.with_depth(scene, tmp_path, UNIT)
    assert found == pytest.approx(METRES, rel=0.005)
    assert known.depth is not None and known.depth_sigma is not None
    there = known.depth > 0
    assert 0.4 < float(there.float().mean()) < 0.6
    deviation = ((known.depth / truth - 1) / known.depth_sigma)[there & (truth > 0)]
    assert float(deviation.abs().median()) == pytest.approx(0.6745, rel=0.15)  # of a normal distribution
    without, with_them = (rgbd_prior.adapt(scene, priors, 4).prediction for priors in (scene.priors, known))
    assert error(with_them, truth, there) < 0.7 * error(without, truth, there)
    assert error(with_them, truth, ~there) < 1.05 * error(without, truth, ~there)
    assert error(with_them, truth) < 0.8 * error(without, truth)


def printed(
    example: ModuleType, words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> str:
    """What an example's command line prints, without optimisation, in this process."""
    monkeypatch.setattr(sys, "argv", [example.__name__, *words, "--size", str(SIZE), "--steps", "0"])
    example.main()
    return capsys.readouterr().out


def test_command_lines_say_what_the_examples_found(
    room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = str(room.root)
    told = printed(python_api, [root, "-o", str(tmp_path / "c.ply")], monkeypatch, capsys)
    assert f"c.ply: {len(read_ply(tmp_path / 'c.ply')[0])} points" in told
    told = printed(custom_prior, [root], monkeypatch, capsys)
    plane = re.search(r"plane of COLMAP's points: (\S+)", told)
    assert plane is not None
    found = np.array([float(word) for word in plane[1].split(",")])
    np.testing.assert_allclose(found * np.sign(found[1]), [0, 1, 0, -2], atol=1e-4)
    told = printed(custom_backbone, [root], monkeypatch, capsys)
    errors = re.findall(r"0 steps: median error at held-out points (\S+)%", told)
    assert len(errors) == 2 and errors[0] == errors[1] and float(errors[0]) < 10
    write_sensor(room, tmp_path)
    told = printed(rgbd_prior, [root, str(tmp_path), "--unit", str(UNIT)], monkeypatch, capsys)
    metres = re.search(r"one COLMAP unit is (\S+) m", told)
    assert metres is not None and float(metres[1]) == pytest.approx(METRES, rel=0.005)


def test_the_demo_runs_twice_in_one_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Pictures and model are kept, the rest is made anew; pictures of another scene are not mixed in."""
    words = ["--folder", str(tmp_path), "--views", "4", "--max_image_size", "96", "--steps", "0"]
    assert demo.main(words) == 0
    files = [*tmp_path.glob("images/*"), *tmp_path.glob("sparse/*/*")]
    kept = {path: path.stat().st_mtime_ns for path in files}
    first = dense_paths(tmp_path).manifest.stat().st_mtime_ns
    assert demo.main(words) == 0
    assert {path: path.stat().st_mtime_ns for path in files} == kept
    assert dense_paths(tmp_path).manifest.stat().st_mtime_ns > first
    assert capsys.readouterr().out.count("against the rendered truth") == 2
    other = walk(seed=5, views=3, shape=(48, 64))
    demo.drop_other_scene(other, tmp_path)
    assert not (tmp_path / "images").exists() and not (tmp_path / "sparse").exists()
    demo.write_images(other, tmp_path / "images")
    (tmp_path / "images" / "holiday.jpg").write_bytes(b"mine")
    with pytest.raises(SystemExit, match="not the demo's"):
        demo.drop_other_scene(walk(seed=5, views=2, shape=(48, 64)), tmp_path)
    assert (tmp_path / "images" / "holiday.jpg").read_bytes() == b"mine"
