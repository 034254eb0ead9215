"""One chunk: devices, weights, memory, units, corrected cameras, and what is reported of each view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from colmap_tco.backbones import NetworkConfig, load, select
from colmap_tco.chunks import Chunk
from colmap_tco.errors import InputError
from colmap_tco.pictures import Pictures
from colmap_tco.predict import ChunkResult, corrected_view, predict_chunk
from colmap_tco.priors import PriorConfig, chunk_frame
from colmap_tco.tracks import Tracks, read_tracks
from colmap_tco.views import (
    ChunkFrame,
    Picture,
    View,
    ViewConfig,
    canvas_cameras,
    make_views,
    network_image,
    undistorted_image,
)
from colmap_tco.workspace import open_workspace
from tco.geometry import so3_exp
from tco.options import TCOConfig
from tco.types import Cameras

if TYPE_CHECKING:
    from tests.conftest import Room


@dataclass(frozen=True)
class Input:
    views: list[View]
    tracks: Tracks


@pytest.fixture(scope="module")
def known(room: Room) -> Input:
    workspace = open_workspace(room.root)
    views, _ = make_views(workspace, ViewConfig(max_image_size=128), 16)
    return Input(views, read_tracks(workspace.model))


def predicted(
    known: Input,
    chunk: Chunk,
    steps: int = 0,
    holdout: float = 0.2,
    picture: Callable[[View], Picture] = network_image,
) -> ChunkResult:
    settings = (PriorConfig(holdout=holdout), TCOConfig(steps=steps), 0)
    return predict_chunk(
        (load(select(NetworkConfig(backbone="sweep", device="cpu"))), torch.device("cpu")),
        known.tracks, known.views, chunk, settings, lambda _: None, picture,
    )  # fmt: skip


def test_maps_are_in_colmap_units_and_of_the_size_of_the_network_images(known: Input, room: Room) -> None:
    taken: dict[str, NDArray[np.uint8]] = {}
    pictures = Pictures(lambda view, image: taken.update({view.name: image}))
    result = predicted(known, Chunk((1, 3, 4), (2,)), picture=pictures)
    assert sorted(result.views) == [known.views[i].name for i in (1, 3, 4)]  # not those of the context
    assert sorted(taken) == [known.views[i].name for i in (1, 2, 3, 4)]
    name = known.views[3].name
    assert (taken[name] == undistorted_image(known.views[3])[0]).all()
    assert result.history == []
    for index in (1, 3, 4):
        view = known.views[index]
        maps = result.views[view.name].maps
        h, w = view.network.height, view.network.width
        assert maps.depth.shape == maps.confidence.shape == (h, w)
        assert maps.normal.shape == (h, w, 3)
        assert (maps.depth > 0).all() and (maps.confidence >= 1).all()
        rows = ((np.arange(h) + 0.5) * 240 / h).astype(int)
        cols = ((np.arange(w) + 0.5) * 320 / w).astype(int)
        truth = room.sample.depth[index][rows[:, None], cols]
        assert np.median(np.abs(maps.depth / truth - 1)) < 0.02


def test_every_view_is_reported(known: Input) -> None:
    result = predicted(known, Chunk(tuple(range(7))), holdout=0.3)
    for view in known.views:
        figures = result.views[view.name].figures
        total = figures["points"] + figures["points_held_out"]
        assert 0.2 < figures["points_held_out"] / total < 0.4
        assert 0 <= figures["error_at_points"] < 0.03
        assert 0 <= figures["error_at_held_out"] < 0.03
        assert 0.7 < figures["held_out_within_5_percent"] <= 1
        assert figures["reprojection_error_pixels"] < 0.3
        assert figures["correction"] == {"rotation_degrees": 0.0, "centre": 0.0, "focal": 0.0}
    everything = predicted(known, Chunk((0, 1, 2)), holdout=0.0).views[known.views[0].name].figures
    assert everything["points_held_out"] == 0
    assert everything["error_at_held_out"] is None and everything["held_out_within_5_percent"] is None


def scaled(known: Input, factor: float) -> Input:
    """The same workspace in another unit of length."""
    tracks = replace(
        known.tracks,
        xyz=known.tracks.xyz * factor,
        covariance=known.tracks.covariance * factor**2,
        centres={i: c * factor for i, c in known.tracks.centres.items()},
    )
    moved = [np.column_stack([v.cam_from_world[:, :3], factor * v.cam_from_world[:, 3]]) for v in known.views]
    return Input([replace(v, cam_from_world=m) for v, m in zip(known.views, moved, strict=True)], tracks)


def test_depth_is_in_the_unit_of_the_model(known: Input) -> None:
    """A power of two, so that all numbers inside a chunk are the same."""
    chunk = Chunk((0, 2, 4))
    a, b = predicted(known, chunk, steps=1), predicted(scaled(known, 1024.0), chunk, steps=1)
    for name, view in a.views.items():
        other = b.views[name]
        np.testing.assert_allclose(other.maps.depth, 1024 * view.maps.depth, rtol=1e-5)
        assert other.figures["correction"]["centre"] == pytest.approx(
            1024 * view.figures["correction"]["centre"],
            rel=1e-3,
        )
        np.testing.assert_allclose(
            other.corrected.cam_from_world[:, :3], view.corrected.cam_from_world[:, :3]
        )


def test_images_that_are_not_those_of_the_model_are_refused(known: Input) -> None:
    """Poses of one view given to another: the points do not project where its keypoints are."""
    views = list(known.views)
    views[0] = replace(views[0], cam_from_world=known.views[6].cam_from_world)
    views[2] = replace(views[2], cam_from_world=known.views[5].cam_from_world)
    with pytest.raises(InputError, match="network pixels"):
        predicted(Input(views, known.tracks), Chunk((0, 1, 2)))


def frames(known: Input, origin: float) -> tuple[list[View], ChunkFrame]:
    """The views and their chunk, moved far from the origin of the world."""
    views = []
    for view in known.views[:3]:
        R, t = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
        shifted = np.column_stack([R, t - R @ np.array([origin, -2 * origin, 0.1 * origin])])
        views.append(replace(view, cam_from_world=shifted))
    scale = chunk_frame(known.tracks, known.views).scale
    return views, ChunkFrame(views[0].cam_from_world, scale)


def centre(view: View) -> np.ndarray:
    return -view.cam_from_world[:, :3].T @ view.cam_from_world[:, 3]


@pytest.mark.parametrize("origin", [0.0, 4.0e6])
def test_without_a_correction_a_view_keeps_its_camera(known: Input, origin: float) -> None:
    """To the precision of the numbers in the model, also where coordinates are those of a map."""
    views, frame = frames(known, origin)
    cameras = canvas_cameras(views, frame)
    for i, view in enumerate(views):
        back = corrected_view(view, frame.scale, cameras, cameras, i)
        np.testing.assert_allclose(back.cam_from_world[:, :3], view.cam_from_world[:, :3], atol=1e-12)
        np.testing.assert_allclose(centre(back), centre(view), rtol=0, atol=1e-9 * max(1, origin))
        assert back.camera == view.camera and back.network == view.network


@pytest.mark.parametrize("origin", [0.0, 4.0e6])
def test_a_correction_moves_the_camera_as_it_says(known: Input, origin: float) -> None:
    """A turn about the camera's own axes, a shift in the chunk's frame and unit, a longer focal length."""
    views, frame = frames(known, origin)
    before = canvas_cameras(views, frame)
    turn = so3_exp(torch.tensor([0.01, -0.02, 0.03])).expand(3, 3, 3)
    pose = before.world_from_cam.clone()
    pose[:, :3, :3] = pose[:, :3, :3] @ turn
    shift = torch.tensor([0.1, 0.2, -0.05])
    pose[:, :3, 3] += shift
    K = before.K.clone()
    K[:, [0, 1], [0, 1]] *= 1.01
    for i, view in enumerate(views):
        got = corrected_view(view, frame.scale, before, Cameras(pose, K), i)
        relative = got.cam_from_world[:, :3] @ view.cam_from_world[:, :3].T
        np.testing.assert_allclose(relative, turn[0].T.numpy(), atol=1e-6)
        np.testing.assert_allclose(
            got.cam_from_world[:, :3] @ got.cam_from_world[:, :3].T, np.eye(3), atol=1e-12
        )
        moved = frame.cam_from_world[:, :3] @ (centre(got) - centre(view))
        np.testing.assert_allclose(moved, frame.scale * shift.numpy(), atol=1e-5 * frame.scale)
        np.testing.assert_allclose(
            [got.camera.fx / view.camera.fx, got.camera.fy / view.camera.fy], 1.01, rtol=1e-6
        )
        assert (got.camera.width, got.camera.height) == (view.camera.width, view.camera.height)
        assert (got.camera.cx, got.camera.cy) == (view.camera.cx, view.camera.cy)
