"""The interactive viewer, served for real."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from colmap_tco.backbones import NetworkConfig
from colmap_tco.densify import DensifyConfig, densify
from colmap_tco.ply import read_ply, read_vis
from colmap_tco.progress import Progress
from colmap_tco.viewer import Viewer, ViewerConfig, quaternion, read_scene
from colmap_tco.views import ViewConfig
from colmap_tco.workspace import DensePaths, dense_paths
from tco.options import TCOConfig

if TYPE_CHECKING:
    from tests.conftest import Room

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def paths(room: Room, tmp_path_factory: pytest.TempPathFactory) -> DensePaths:
    """The result of the network as it is, without optimisation."""
    root = tmp_path_factory.mktemp("viewer") / "room"
    shutil.copytree(room.root, root)
    network, views = NetworkConfig(device="cpu", chunk_size=8), ViewConfig(max_image_size=128)
    config = DensifyConfig(network=network, tco=TCOConfig(steps=0), views=views, report_page=False)
    densify(root, config, Progress())
    return dense_paths(root)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def fetched(url: str) -> str:
    with urllib.request.urlopen(url, timeout=20) as answer:
        assert answer.status == 200
        return str(answer.read().decode("utf-8", "replace"))


@pytest.fixture
def viewer(paths: DensePaths) -> Iterator[Viewer]:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'colmap-tco[view]'")
    running = Viewer(read_scene(paths, 10**6), ViewerConfig(open=False, port=free_port()))
    yield running
    running.stop()


def test_no_page_was_written_where_none_was_wanted(paths: DensePaths) -> None:
    assert paths.report.is_file()
    assert not paths.page.exists()


def test_the_scene_is_the_result_on_disk(paths: DensePaths) -> None:
    scene, (points, _, colors) = read_scene(paths, 10**6), read_ply(paths.ply)
    extent = np.ptp(points, axis=0).max()
    assert np.abs(scene.points + scene.origin - points).max() < 1e-6 * extent
    assert (scene.colors == colors).all()
    assert (scene.seen == np.diff(read_vis(paths.vis).start)).all()
    assert (scene.confidence >= 1).all()  # a confidence is, and every point has a view that confirms it
    assert scene.confidence.std() > 0
    assert len(read_scene(paths, 100).points) == 100


def test_the_viewer_serves_its_page(viewer: Viewer) -> None:
    assert "<html" in fetched(viewer.url).lower()


def test_the_sliders_hide_points_and_give_them_back(viewer: Viewer) -> None:
    everything = viewer.refresh()
    assert everything == len(viewer.scene.points)
    threshold = float(np.median(viewer.scene.confidence))
    viewer.confidence.value = threshold
    assert viewer.refresh() == int((viewer.scene.confidence >= viewer.confidence.value).sum())
    assert 0 < viewer.refresh() < everything
    viewer.confidence.value = 0.0
    viewer.seen.value = int(viewer.scene.seen.max())
    assert viewer.refresh() == int((viewer.scene.seen == viewer.scene.seen.max()).sum())
    viewer.seen.value = 0
    assert viewer.refresh() == everything


def test_the_first_look_is_at_the_scene_whatever_its_size(viewer: Viewer) -> None:
    """Nearly all of the cloud is in a square picture of the viewer's 75°, between the planes that cut it."""
    camera, points = viewer.server.initial_camera, viewer.scene.points
    position, target, away = viewer.scene.overview()
    assert np.allclose(camera.position, position) and np.allclose(camera.look_at, target)
    z = (target - position) / away
    x = np.cross(z, viewer.scene.up)
    x /= np.linalg.norm(x)
    local = (points - position) @ np.stack([x, np.cross(z, x), z]).T
    half = np.tan(np.radians(75 / 2))
    assert ((np.abs(local[:, :2]) < half * local[:, 2:]).all(1)).mean() > 0.9
    assert ((local[:, 2] > camera.near) & (local[:, 2] < camera.far)).all()
    scale = 1e5
    views = [
        replace(v, cam_from_world=np.c_[v.cam_from_world[:, :3], scale * v.cam_from_world[:, 3]])
        for v in viewer.scene.views
    ]
    large = replace(viewer.scene, points=scale * points, origin=scale * viewer.scene.origin, views=views)
    assert np.allclose(large.overview()[0], scale * position, rtol=1e-4)


def test_a_quaternion_turns_as_its_matrix_does() -> None:
    rng = np.random.default_rng(0)
    matrix, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix *= np.sign(np.linalg.det(matrix))
    w, *xyz = quaternion(matrix)
    vector, axis = rng.normal(size=3), np.array(xyz)
    turned = vector + 2 * np.cross(axis, np.cross(axis, vector) + w * vector)
    assert np.allclose(turned, matrix @ vector)


def test_the_command_serves_until_it_is_interrupted(paths: DensePaths) -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'colmap-tco[view]'")
    command = [sys.executable, "-m", "colmap_tco", "view", str(paths.root.parent), "--no_open"]
    process = subprocess.Popen(
        [*command, "--port", str(free_port())],
        cwd=ROOT, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert process.stderr is not None
    try:
        line = next(line for line in process.stderr if "http://" in line)
        assert "<html" in fetched(line[line.index("http://") :].partition(";")[0]).lower()
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.stderr.close()


def test_without_viser_the_error_names_the_extra(paths: DensePaths, tmp_path: Path) -> None:
    """A module of that name that cannot be imported stands for one that is not installed."""
    (tmp_path / "viser.py").write_text("raise ModuleNotFoundError(\"No module named 'viser'\")\n")
    done = subprocess.run(
        [sys.executable, "-m", "colmap_tco", "view", str(paths.root.parent), "--no_open"],
        cwd=ROOT, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"},
    )  # fmt: skip
    assert done.returncode == 5
    assert "pip install 'colmap-tco[view]'" in done.stderr
