"""Priors of a chunk: exact where the model is exact, and refused where the images are not the model's."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from colmap_tco.errors import InputError
from colmap_tco.overlap import OVERLAPS, overlap
from colmap_tco.priors import (
    INFLATION,
    SIGMA_FLOOR,
    PriorConfig,
    build_priors,
    check_projection,
    chunk_frame,
    held_out,
)
from colmap_tco.tracks import Tracks, observed, read_tracks
from colmap_tco.views import View, ViewConfig, canvas_cameras, canvas_size, make_views, original_from_network
from colmap_tco.workspace import open_workspace
from tco.geometry import project, rays, transform
from tco.types import SparseDepth


def load(root: Path, max_size: int = 128) -> tuple[Tracks, list[View]]:
    workspace = open_workspace(root)
    return read_tracks(workspace.model), make_views(workspace, ViewConfig(max_image_size=max_size), 8)[0]


@pytest.fixture(scope="module")
def mixed(make_workspace: Callable[..., Path], shot: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    shots = (shot(), shot(size=(96, 144), model="OPENCV"), shot(size=(200, 120), model="FOV"), shot())
    return make_workspace(tmp_path_factory.mktemp("mixed"), shots)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (4.5e5, 5.4e6, 120.0)])
def test_sparse_depths_of_two_views_are_the_same_points(
    origin: tuple[float, ...], make_workspace: Callable[..., Path], shot: Any, tmp_path: Path
) -> None:
    """Unprojecting a track in one view and projecting it into another gives its pixel and depth there."""
    shots = (shot(), shot(size=(96, 144), model="OPENCV"), shot(size=(200, 120), model="FOV"))
    tracks, views = load(make_workspace(tmp_path, shots, origin=origin))
    priors = build_priors(tracks, views, chunk_frame(tracks, views), PriorConfig(holdout=0)).optimise
    assert priors.cameras is not None
    assert priors.sparse is not None
    cameras, (a, b) = priors.cameras, priors.sparse[1:]
    _, in_a, in_b = np.intersect1d(a.track, b.track, return_indices=True)
    assert len(in_a) > 20
    points = rays(a.xy[in_a], cameras.K[1]) * a.depth[in_a, None]
    world = transform(cameras.world_from_cam[1], points)
    xy, z = project(transform(torch.linalg.inv(cameras.world_from_cam[2]), world), cameras.K[2])
    assert (xy - b.xy[in_b]).abs().max() < 1e-3
    assert (z - b.depth[in_b]).abs().max() < 1e-5


def test_a_chunk_has_unit_depth_and_its_first_view_as_world(mixed: Path) -> None:
    tracks, views = load(mixed)
    priors = build_priors(tracks, views, chunk_frame(tracks, views), PriorConfig(holdout=0)).optimise
    assert priors.cameras is not None
    assert priors.sparse is not None
    assert torch.allclose(priors.cameras.world_from_cam[0], torch.eye(4), atol=1e-6)
    assert torch.cat([sparse.depth for sparse in priors.sparse]).median() == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("by", OVERLAPS)
def test_views_overlap_as_the_settings_say(by: str, mixed: Path) -> None:
    tracks, views = load(mixed)
    every = {
        way: overlap(*observed(tracks, [view.image_id for view in views]), tracks.xyz, way)
        for way in OVERLAPS
    }
    priors = build_priors(tracks, views, chunk_frame(tracks, views), PriorConfig(overlap_by=by)).optimise
    assert priors.overlap is not None
    for way, told in every.items():
        assert np.allclose(priors.overlap, told, rtol=1e-5) == (way == by)


def test_held_out_tracks_are_nowhere_in_the_optimisation(mixed: Path) -> None:
    tracks, views = load(mixed)
    frame = chunk_frame(tracks, views)
    priors = build_priors(tracks, views, frame, PriorConfig(holdout=0.3), seed=4)
    assert priors.optimise.sparse is not None

    def ids(parts: tuple[SparseDepth, ...]) -> set[int]:
        return set(torch.cat([part.track for part in parts]).tolist())

    kept, held = ids(priors.optimise.sparse), ids(priors.held_out)
    assert not kept & held
    assert kept | held == set(tracks.ids.tolist())
    assert 0.15 < len(held) / len(tracks.ids) < 0.45
    part = build_priors(tracks, views[1:3], frame, PriorConfig(holdout=0.3), seed=4)
    assert ids(part.held_out) <= held
    assert ids(build_priors(tracks, views, frame, PriorConfig(holdout=0.3), seed=5).held_out) != held


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_the_held_out_share_is_kept_for_neighbouring_ids(share: float) -> None:
    """Binomial: 10 000 consecutive ids differ from the share by less than five standard deviations."""
    for seed in range(5):
        part = held_out(np.arange(10_000), share, seed).mean()
        assert abs(part - share) <= 5 * np.sqrt(share * (1 - share) / 10_000)


def test_uncertainty_grows_with_depth_and_noise(make_workspace: Callable[..., Path], tmp_path: Path) -> None:
    medians = []
    for noise in (0.3, 1.2):
        tracks, views = load(make_workspace(tmp_path / str(noise), noise=noise))
        priors = build_priors(tracks, views, chunk_frame(tracks, views)).optimise
        assert priors.sparse is not None
        sigma = torch.cat([sparse.sigma for sparse in priors.sparse])
        assert sigma.min() >= SIGMA_FLOOR
        medians.append(float(sigma.median()))
        assert priors.rotation_sigma is not None
        assert priors.centre_sigma is not None
        # The median length of a 2D Gaussian is 1.18 σ.
        expected = 1.18 * noise / views[0].original.focal_length_x
        assert priors.rotation_sigma.median() == pytest.approx(expected, rel=0.2)
        assert (priors.centre_sigma / priors.rotation_sigma).median() == pytest.approx(1, rel=0.1)
    assert medians[1] / medians[0] == pytest.approx(4, rel=0.3)


def test_the_check_passes_what_is_exact(mixed: Path) -> None:
    tracks, views = load(mixed)
    frame = chunk_frame(tracks, views)
    check = check_projection(tracks, views, frame, canvas_cameras(views, frame))
    assert check.median < 1e-3
    assert set(check.per_view) == {view.name for view in views}


@pytest.mark.parametrize("fault", ["focal", "half", "pose", "scale", "transposed"])
def test_the_check_sees_every_kind_of_wrong_camera(fault: str, mixed: Path) -> None:
    tracks, views = load(mixed)
    frame = chunk_frame(tracks, views)
    cameras = canvas_cameras(views, frame)
    pose, K = cameras.world_from_cam.clone(), cameras.K.clone()
    if fault == "focal":
        K[:, :2, :2] *= 1.1
    elif fault == "half":
        K[:, :2, 2] += 1.5
    elif fault == "pose":
        pose[1:, 0, 3] += 0.05
    elif fault == "scale":
        pose[1:, :3, 3] *= 1.3
    else:
        pose = torch.linalg.inv(pose)
    with pytest.raises(InputError, match=r"(?s)more than 1:\n  00\d.png: .* px\n.*--image_path"):
        check_projection(tracks, views, frame, replace(cameras, world_from_cam=pose, K=K))


def test_views_without_points_make_no_frame(mixed: Path) -> None:
    tracks, views = load(mixed)
    empty = {key: replace(seen, point=seen.point[:0], xy=seen.xy[:0]) for key, seen in tracks.images.items()}
    with pytest.raises(InputError, match="no 3D point is seen"):
        chunk_frame(replace(tracks, images=empty), views)


@pytest.mark.parametrize("name", ["kitchen", "office", "livingroom", "fountain", "lund_door"])
def test_real_workspaces_pass_the_check(name: str, shared: Path) -> None:
    tracks, views = load(shared / "data" / name, max_size=640)
    frame = chunk_frame(tracks, views)
    priors = build_priors(tracks, views, frame)
    assert priors.optimise.cameras is not None
    check = check_projection(tracks, views, frame, priors.optimise.cameras)
    assert check.median < 0.6
    assert sum(priors.dropped.values()) < 0.05 * tracks.length.sum()


def test_uncertainties_are_those_of_exact_depths(shared: Path) -> None:
    """Errors of the triangulated points against a synthetic scene's true depths, in units of their sigma,
    have a robust standard deviation of one: the measurement behind ``INFLATION``."""
    root = shared / "data" / "livingroom"
    tracks, views = load(root, max_size=640)
    frame = chunk_frame(tracks, views)
    priors = build_priors(tracks, views, frame, PriorConfig(holdout=0)).optimise
    assert priors.sparse is not None
    metres = json.loads((root / "gt" / "gt.json").read_text(encoding="utf-8"))["metres_per_colmap_unit"]
    canvas = canvas_size(views)
    ratios = []
    for view, sparse in zip(views[::3], priors.sparse[::3], strict=True):
        truth = cv2.imread(str(root / "gt" / "depth" / f"{Path(view.name).stem}.png"), -1) / 1000 / metres
        margin = np.array([canvas[1] - view.network.width, canvas[0] - view.network.height]) / 2
        x, y = np.floor(original_from_network(view, sparse.xy.double().numpy() - margin)).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < truth.shape[1]) & (y < truth.shape[0])
        true = truth[y[inside], x[inside]]
        error = sparse.depth.numpy()[inside] * frame.scale / np.where(true > 0, true, np.nan) - 1
        ratios.append(error / sparse.sigma.numpy()[inside])
    everything = np.concatenate(ratios)
    assert INFLATION > 1
    assert 0.75 < 1.4826 * np.nanmedian(np.abs(everything)) < 1.3
