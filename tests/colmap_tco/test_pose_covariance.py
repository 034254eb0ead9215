"""Deviations of cameras: those by which repeated bundle adjustments scatter, and what the user says."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from colmap_tco import _pycolmap
from colmap_tco.pose_covariance import with_deviations
from colmap_tco.priors import PriorConfig, build_priors, chunk_frame
from colmap_tco.tracks import read_tracks
from colmap_tco.views import ViewConfig, make_views
from colmap_tco.workspace import open_workspace
from tco.align import align_cameras
from tco.geometry import invert

NOISE = 0.5
"""Pixels along each axis."""


def poses(model: _pycolmap.Model) -> dict[int, torch.Tensor]:
    return {e.image_id: torch.from_numpy(e.cam_from_world.copy()) for e in _pycolmap.registered(model)}


def adjusted(folder: Path, seed: int) -> dict[int, torch.Tensor]:
    """Cameras after bundle adjustment of the exact model with noisy keypoints."""
    pycolmap, rng = _pycolmap.load(), np.random.default_rng(seed)
    model = _pycolmap.read_model(folder)
    for image in model.images.values():
        for point in image.points2D:
            point.xy = np.asarray(point.xy) + rng.normal(0, NOISE, 2)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = False
    pycolmap.bundle_adjustment(model, options)
    return poses(model)


def in_common_frame(found: dict[int, torch.Tensor], exact: dict[int, torch.Tensor]) -> list[np.ndarray]:
    """Errors of rotations and of centres, (V, 3) each, in the frame in which they are least."""
    ours, theirs = (invert(with_row(torch.stack([c[i] for i in exact]))) for c in (found, exact))
    moved = align_cameras(ours, theirs).poses(ours)
    turns = Rotation.from_matrix((moved[:, :3, :3].mT @ theirs[:, :3, :3]).numpy()).as_rotvec()
    return [turns, (moved - theirs)[:, :3, 3].numpy()]


def with_row(poses: torch.Tensor) -> torch.Tensor:
    """(V, 4, 4) of (V, 3, 4)."""
    return torch.cat([poses, torch.tensor([[[0.0, 0, 0, 1]]], dtype=poses.dtype).expand(len(poses), 1, 4)], 1)


def test_deviations_are_what_repeated_bundle_adjustments_scatter_by(
    make_workspace: Callable[..., Path], tmp_path: Path
) -> None:
    clean = make_workspace(tmp_path / "clean")
    workspace = open_workspace(make_workspace(tmp_path / "noisy", noise=NOISE))
    tracks = with_deviations(read_tracks(workspace.model), workspace.model)
    exact = poses(workspace.model)
    errors = [in_common_frame(adjusted(clean / "sparse" / "0", seed), exact) for seed in range(40)]
    for part in (0, 1):
        scatter = np.sqrt(np.square([error[part] for error in errors]).mean((0, 2)))
        told = np.array([tracks.deviations[image][part] for image in exact])
        assert np.square(told).mean() == pytest.approx(np.square(scatter).mean(), rel=0.2)
        assert told == pytest.approx(scatter, rel=0.45)


def test_settings_and_deviations_decide_how_uncertain_cameras_are(workspace_folder: Path) -> None:
    workspace = open_workspace(workspace_folder)
    views, _ = make_views(workspace, ViewConfig(max_image_size=128), 8)
    tracks = read_tracks(workspace.model)
    frame = chunk_frame(tracks, views)
    tracks = replace(tracks, deviations={view.image_id: (3.0, 4.0 * frame.scale) for view in views})

    def sigmas(config: PriorConfig) -> list[torch.Tensor]:
        p = build_priors(tracks, views, frame, config).optimise
        found = [p.rotation_sigma, p.centre_sigma, p.focal_sigma]
        assert all(sigma is not None for sigma in found)
        return found  # type: ignore[return-value]

    own = sigmas(PriorConfig())
    given = sigmas(PriorConfig(rotation_sigma=2.0, centre_sigma=0.5, focal_sigma=0.1))
    for sigma, value in zip(given, (math.radians(2.0), 0.5 / frame.scale, 0.1), strict=True):
        torch.testing.assert_close(sigma, torch.full((len(views),), value, dtype=sigma.dtype))
    both = sigmas(PriorConfig(pose_covariance=True))
    torch.testing.assert_close(both[0], torch.hypot(own[0], torch.tensor(3.0)))
    torch.testing.assert_close(both[1], torch.hypot(own[1], torch.tensor(4.0)))


@pytest.mark.parametrize("wrong", [{"holdout": 1.0}, {"rotation_sigma": -1.0}, {"focal_sigma": 0.0}])
def test_settings_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"holdout|sigma"):
        PriorConfig(**wrong)
