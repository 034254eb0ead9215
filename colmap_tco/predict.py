"""One chunk of views → depth maps at COLMAP's scale: priors, self-check, optimisation, figures per view."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from colmap_tco.chunks import Chunk
from colmap_tco.normals import normals_from_depth
from colmap_tco.outputs import ViewMaps
from colmap_tco.priors import PriorConfig, build_priors, check_projection, chunk_frame
from colmap_tco.tracks import Tracks
from colmap_tco.views import Picture, View, batch, crop, network_image
from tco.options import TCOConfig

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from tco.backbones.base import Backbone
    from tco.conclusion import Conclusion
    from tco.optimize import Outcome
    from tco.types import Cameras, Prediction

log = logging.getLogger(__name__)

_LEAST_ERROR = np.float32(1e-6)
"""Standard errors are at least this, so that 0 can mean that there is none."""


@dataclass(frozen=True)
class ViewResult:
    """One view of a finished chunk.

    Attributes:
        maps: depth, normals and confidence at the size of ``view.network``, in COLMAP units.
        own: the same before the views were asked what they say together.
        figures: numbers for the report.
        corrected: the view with its corrected camera.
    """

    maps: ViewMaps
    own: ViewMaps
    figures: dict[str, object]
    corrected: View


@dataclass(frozen=True)
class ChunkResult:
    """Results of the views that a chunk owns, by name, and what was recorded of the whole.

    Attributes:
        views: name → result.
        history: the terms of every step.
        agreement: of a network that predicts cameras, how far they are from COLMAP's: medians over views,
            in degrees, and in parts of the centres' mean distance from their middle. Else empty.
    """

    views: dict[str, ViewResult]
    history: list[dict[str, float]]
    agreement: dict[str, float]


def predict_chunk(
    network: tuple[Backbone, torch.device],
    tracks: Tracks,
    views: Sequence[View],
    chunk: Chunk,
    settings: tuple[PriorConfig, TCOConfig, int],
    report: Callable[[dict[str, float]], None],
    picture: Callable[[View], Picture] = network_image,
    num_threads: int = -1,
) -> ChunkResult:
    """Optimise one chunk and give the results of the views that it owns.

    Args:
        network: backbone and device.
        tracks: of the model.
        views: all views of the workspace; the chunk's indices refer to them.
        chunk: owned and context views.
        settings: of priors and of optimisation, and the seed.
        report: called with the terms of each step.
        picture: makes the picture of a view for the network.
        num_threads: for the normals, one a core if not positive.

    Raises:
        InputError: the points do not project where the keypoints are, or an image cannot be read.
    """
    from tco.align import CameraPenalties, KnownCameras
    from tco.conclusion import concluded
    from tco.optimize import optimize
    from tco.terms import errors_at_points

    (backbone, device), (prior_config, tco_config, seed) = network, settings
    penalties = CameraPenalties.of(tco_config)
    aligned = None if backbone.uses_cameras else KnownCameras(backbone, penalties)
    members = [views[i] for i in chunk.views]
    frame = chunk_frame(tracks, members)
    images, cameras = batch(members, frame, picture, len(chunk.context))
    check = check_projection(tracks, members, frame, cameras)
    priors = build_priors(tracks, members, frame, prior_config, seed)
    there = images.to(device)
    outcome = optimize(
        aligned or backbone,
        there,
        priors.optimise.to(device),
        tco_config,
        seed,
        lambda _, terms: report(terms),
        watched=[points.to(device) for points in priors.held_out],
    )
    assert priors.optimise.sparse is not None
    end = concluded(outcome, there, priors.optimise, tco_config, seed)
    prediction, error = end.agreement.prediction, end.agreement.error
    own, moved = outcome.prediction.to("cpu"), outcome.cameras.to("cpu")
    used, held = (errors_at_points(prediction, p) for p in (priors.optimise.sparse, priors.held_out))
    results = {}
    for i in range(len(chunk.owned)):
        view = members[i]
        figures: dict[str, object] = {
            "points": len(used[i]),
            "points_held_out": len(held[i]),
            "error_at_points": _median(used[i]),
            "error_at_held_out": _median(held[i]),
            "held_out_within_5_percent": float((held[i].abs() < 0.05).float().mean())
            if len(held[i])
            else None,
            "error_of_one_depth": _error_of_one_depth(priors.optimise.sparse[i].depth),
            "reprojection_error_pixels": check.per_view.get(view.name),
            "correction": _correction(outcome, i, frame.scale),
        }
        maps = view_maps(view, prediction, i, images.valid, frame.scale, error, num_threads)
        before = view_maps(view, own, i, images.valid, frame.scale, num_threads=num_threads)
        figures |= _asked(own.depth[i], end, i, images.valid[i], outcome)
        corrected = corrected_view(view, frame.scale, cameras, moved, i)
        results[view.name] = ViewResult(maps, before, figures, corrected)
    if aligned is not None:
        steps = [
            terms | {f"own_{k}": v for k, v in more.items()}
            for terms, more in _paired(outcome.history, aligned.history)
        ]
        return ChunkResult(results, steps, aligned.agreement)
    return ChunkResult(results, outcome.history, {})


def _asked(own: Tensor, end: Conclusion, i: int, valid: Tensor, outcome: Outcome) -> dict[str, object]:
    """What others said of view ``i``: further points, how far depths moved, what is on planes or taken."""
    before, taken = end.flat.before, end.taken[i]
    after, spread = before.prediction.depth[i], before.error[i]
    known = valid & (own > 0) & (after > 0)
    moved = (after[known] / own[known]).log().abs()
    return {
        "points_agreed": len(outcome.told[i]) if i in outcome.told else 0,
        "moved_by_consensus": _median(moved),
        "asked_by_consensus": float(spread.isfinite()[valid].float().mean()),
        "on_planes": float(((end.flat.labels[i] > 0) & ~taken)[valid].float().mean()),
        "taken_from_others": float(taken[valid].float().mean()),
    }


def _paired(
    steps: list[dict[str, float]], own: list[dict[str, float]]
) -> list[tuple[dict[str, float], dict[str, float]]]:
    """Each step with the penalties of the network's own cameras; later steps, on the depths, have none."""
    none: dict[str, float] = {}
    return [(terms, own[i] if i < len(own) else none) for i, terms in enumerate(steps)]


def _error_of_one_depth(depth: torch.Tensor) -> float:
    """Median relative error, at points of these depths (N,), of a map that has their median everywhere."""
    return float((depth.median() / depth - 1).abs().median())


def _median(errors: torch.Tensor) -> float | None:
    return float(errors.abs().median()) if len(errors) else None


def _correction(outcome: Outcome, i: int, scale: float) -> dict[str, float]:
    """How far the camera of a view went: degrees, COLMAP units, relative focal length."""
    sizes = outcome.corrections
    if not sizes:
        return {"rotation_degrees": 0.0, "centre": 0.0, "focal": 0.0}
    return {**{name: values[i] for name, values in sizes.items()}, "centre": sizes["centre"][i] * scale}


def view_maps(
    view: View, prediction: Prediction, i: int, valid: Tensor, scale: float, error: Tensor | None = None,
    num_threads: int = -1,
) -> ViewMaps:  # fmt: skip
    """Depth in COLMAP units, normals and confidence of one view, 0 and 1 where the image is not valid.

    Args:
        view: that the maps are of, at the size of its ``network`` camera.
        prediction: of the chunk, on its canvas and in its unit.
        i: index of the view in the prediction.
        valid: (V, H, W) bool, the chunk's ``Views.valid``.
        scale: COLMAP units per unit of the chunk.
        error: (V, H, W) of an :class:`tco.consensus.Agreement`, if the prediction is of one.
        num_threads: for the normals, one a core if not positive.
    """
    there = crop(view, valid[i]).numpy()
    depth = np.where(there, crop(view, prediction.depth[i]).numpy() * scale, 0).astype(np.float32)
    confidence = np.where(there, crop(view, prediction.confidence[i]).numpy(), 1).astype(np.float32)
    normal = normals_from_depth(depth, view.network, num_threads=num_threads)
    if error is None:
        return ViewMaps(depth, normal, confidence)
    spread = crop(view, error[i]).numpy()
    known = there & np.isfinite(spread)
    return ViewMaps(depth, normal, confidence, np.where(known, np.maximum(spread, _LEAST_ERROR), 0))


def corrected_view(view: View, scale: float, before: Cameras, after: Cameras, i: int) -> View:
    """The view with its camera corrected as camera ``i`` was, in COLMAP's frame and units.

    Only the difference of the two is applied, to COLMAP's camera in float64: the rounding of a chunk's
    float32 cameras would be metres where the model has the coordinates of a map.

    Args:
        view: with COLMAP's camera.
        scale: COLMAP units per unit of the chunk.
        before: the chunk's cameras as the optimisation was given them.
        after: as it left them.
        i: index of the view in the chunk.
    """
    old, new = (cameras.world_from_cam[i].double().numpy() for cameras in (before, after))
    # The rotation nearest to a product of matrices that are orthogonal to float32 alone.
    u, _, vt = np.linalg.svd(new[:3, :3].T @ old[:3, :3])
    turn = u @ vt
    shift = scale * old[:3, :3].T @ (new[:3, 3] - old[:3, 3])
    R, t = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
    factor = float(after.K[i, 0, 0]) / float(before.K[i, 0, 0])
    camera = replace(view.camera, fx=view.camera.fx * factor, fy=view.camera.fy * factor)
    return replace(view, camera=camera, cam_from_world=np.column_stack([turn @ R, turn @ (t - shift)]))
