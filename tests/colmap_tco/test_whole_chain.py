"""A slanted plane from distorted pictures to the cloud on disk: no part of a pixel is lost on the way.

The pictures show, as a grey value, the inverse depth of the plane at each pixel. Over a plane it is linear
in undistorted pixels, so that a network which reads it back knows the depth exactly where the picture is
exactly where it should be: undistortion, resize, canvas, cameras, maps and fusion are all in between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_tco import _pycolmap
from colmap_tco.chunks import Chunk
from colmap_tco.fusion import FusionConfig, fuse
from colmap_tco.outputs import fusion_views, undistorted_model, write_cloud, write_model, write_view
from colmap_tco.ply import read_ply
from colmap_tco.predict import predict_chunk
from colmap_tco.priors import PriorConfig, chunk_frame
from colmap_tco.tracks import read_tracks
from colmap_tco.views import View, ViewConfig, canvas_size, make_views
from colmap_tco.workspace import DensePaths, open_workspace
from tco.options import TCOConfig
from tco.types import Prediction, Priors, SparseDepth, Views
from tests.conftest import Shot, colmap_camera, look_at, write_text_model

Floats = NDArray[np.float64]
SHOT = Shot((480, 360), "OPENCV", (430.0, 434.0, 251.0, 171.0, -0.12, 0.03, 0.001, -0.002))
PORTRAIT = Shot((360, 480), "OPENCV", (434.0, 430.0, 171.0, 251.0, -0.12, 0.03, -0.002, 0.001))
WIDE = Shot((480, 280), "OPENCV", (430.0, 434.0, 247.0, 133.0, -0.12, 0.03, 0.001, -0.002))
SHOTS = (SHOT, PORTRAIT, SHOT, WIDE, SHOT)
"""None fills the canvas that they share, so that each is cut out of it at another place."""
NORMAL = np.array([0.5, 0.35, -1.0]) / np.linalg.norm([0.5, 0.35, -1.0])
DISTANCE, DARK, BRIGHT = 4.0, 0.0, 0.6
"""Distance of the cameras, and the inverse depths that are drawn black and white."""
NAMES = [f"{i}.png" for i in range(5)]
PIXEL = DISTANCE / 129.3
"""Size of a pixel of the depth maps at the distance of the plane."""


@dataclass
class Reader:
    """A network that reads the inverse depth off the pictures; ``unit`` is the chunk's, in COLMAP units."""

    unit: float
    shift: int = 0
    name: str = "reader"
    stride: int = 8
    uses_cameras: bool = True

    def encode(self, views: Views, priors: Priors) -> tuple[Views, Priors]:
        return views, priors

    def decode(
        self, encoded: Any, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        pictures, priors = encoded
        chosen = tuple(range(len(pictures))) if views is None else tuple(views)
        grey = pictures.images[list(chosen)].mean(1).clamp(min=0.01)
        depth = 1 / (DARK + (BRIGHT - DARK) * grey) / self.unit
        depth = torch.roll(depth, (self.shift, self.shift), (1, 2))
        return Prediction(depth, torch.full_like(depth, 2.0), priors.cameras, chosen)

    def with_points(self, encoded: Any, points: Mapping[int, SparseDepth]) -> Any:
        return encoded

    def decoder(self) -> torch.nn.Module:
        return torch.nn.Identity()


def pose(i: int, origin: Floats) -> Floats:
    angle = 0.14 * (i - 2)
    eye = np.array([DISTANCE * np.sin(angle), 0.4 * np.sin(2.1 * i), -DISTANCE * np.cos(angle)])
    return look_at(eye + origin, origin + np.zeros(3))


def workspace_of(root: Path, origin: Floats) -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(-1, 1, (120, 2))
    points = np.c_[xy, -(xy @ NORMAL[:2]) / NORMAL[2]] + origin
    poses = np.stack([pose(i, origin) for i in range(len(NAMES))])
    write_text_model(root / "sparse" / "0", SHOTS, poses, points, 0.0, NAMES)
    for name, shot, move in zip(NAMES, SHOTS, poses, strict=True):
        u, v = np.meshgrid(*(np.arange(side) + 0.5 for side in shot.size))
        rays = _pycolmap.cam_from_img(colmap_camera(shot), np.c_[u.ravel(), v.ravel()])
        centre = -move[:, :3].T @ move[:, 3] - origin
        inverse = -(np.c_[rays, np.ones(len(rays))] @ move[:, :3] @ NORMAL) / (centre @ NORMAL)
        grey = 255 * (inverse - DARK) / (BRIGHT - DARK)
        assert (grey > 0).all() and (grey < 255).all()
        # Dithered: a rounded grey value would be a staircase of a tenth of a pixel.
        picture = np.floor(grey + rng.random(grey.shape)).astype(np.uint8).reshape(u.shape)
        (root / "images").mkdir(exist_ok=True)
        cv2.imwrite(str(root / "images" / name), picture)


def chain(root: Path, origin: Floats, shift: int = 0) -> tuple[Floats, list[View]]:
    """Every step from the workspace to the cloud on disk; returns its points (N, 3), and the views."""
    workspace_of(root, origin)
    workspace = open_workspace(root)
    views, skipped = make_views(workspace, ViewConfig(max_image_size=160), 8)
    assert not skipped
    tracks = read_tracks(workspace.model)
    everything = Chunk(tuple(range(len(views))))
    reader = Reader(chunk_frame(tracks, views).scale, shift)
    settings = (PriorConfig(holdout=0.0), TCOConfig(steps=0), 0)
    done = predict_chunk((reader, torch.device("cpu")), tracks, views, everything, settings, lambda _: None)
    paths = DensePaths(root / "dense")
    for view in views:
        write_view(paths, view, done.views[view.name].maps)
    indices = write_model(paths, undistorted_model(workspace.model, views))
    neighbours = {name: [other for other in NAMES if other != name] for name in NAMES}
    cloud, _ = fuse(
        fusion_views(paths, views, neighbours, indices),
        FusionConfig(num_threads=1, max_normal_error=30.0, max_depth_bend=0.0),
    )
    write_cloud(paths, cloud)
    return read_ply(paths.ply)[0], views


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Floats, list[View], Path]:
    root = tmp_path_factory.mktemp("plain")
    return *chain(root, np.zeros(3)), root


def test_a_plane_keeps_its_place_to_a_fiftieth_of_a_pixel(plain: tuple[Floats, list[View], Path]) -> None:
    points, views, _ = plain
    sizes = [(view.network.width, view.network.height) for view in views]
    assert sizes == [(160, 120), (120, 160), (160, 120), (160, 96), (160, 120)]
    assert canvas_size(views) == (160, 160)
    assert views[0].camera.width > 1.05 * SHOT.size[0], "undistortion shall change the size"
    assert len(points) > 10_000
    off = points @ NORMAL / PIXEL
    assert abs(off.mean()) < 0.02
    assert abs(np.median(off)) < 0.02
    # No tilt either: what is left does not depend on the place.
    slope = np.linalg.lstsq(np.c_[points[:, :2], np.ones(len(points))], off, rcond=None)[0]
    assert np.abs(slope).max() < 0.02


def test_that_would_show_a_fault_of_half_a_pixel(tmp_path: Path) -> None:
    """Depths moved by one pixel of the map are found as such: (n_x + n_y) pixels off the plane."""
    points, _ = chain(tmp_path, np.zeros(3), shift=1)
    turned = pose(2, np.zeros(3))[:, :3] @ NORMAL
    off = np.median(points @ NORMAL) / PIXEL
    assert off == pytest.approx(turned[0] + turned[1], rel=0.25)
    assert abs(off) / 2 > 0.3


def test_map_coordinates_give_the_same_cloud_without_stripes(
    plain: tuple[Floats, list[View], Path], tmp_path: Path
) -> None:
    """A model at easting 500 km, northing 5400 km: the same points, to a thousandth of a pixel."""
    origin = np.array([500_000.0, 5_400_000.0, 300.0])
    near, far = plain[0], chain(tmp_path, origin)[0] - origin
    assert abs(len(far) - len(near)) < 0.002 * len(near)
    distance = cKDTree(near).query(far)[0] / PIXEL
    assert np.quantile(distance, 0.99) < 1e-3
    header = (tmp_path / "dense" / "fused.ply").read_bytes()[:400]
    assert b"property double x" in header and b"property float nx" in header
    assert b"property float x" in (plain[2] / "dense" / "fused.ply").read_bytes()[:400]
    # Float32 would leave a grid of half a unit, some twelve pixels wide.
    assert len(np.unique(far[:, 1])) > 0.9 * len(far)
    assert len(np.unique((far[:, 1] + origin[1]).astype(np.float32))) < 20
