"""What COLMAP knows of a chunk's views: poses, intrinsics, sparse depths, each with its uncertainty."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_tco._pycolmap import Floats, Ints, Mask, focal_lengths
from colmap_tco.errors import InputError
from colmap_tco.overlap import OVERLAPS, overlap
from colmap_tco.tracks import Tracks, observed
from colmap_tco.views import (
    ChunkFrame,
    View,
    canvas_camera,
    canvas_cameras,
    canvas_size,
    network_from_original,
)
from tco.config import POSITIVE, check_range, knob

if TYPE_CHECKING:
    from tco.types import Cameras, Priors, SparseDepth

log = logging.getLogger(__name__)

SIGMA_FLOOR = 0.003
"""Relative depth error that remains for the best of tracks: the cameras are not exact either."""
INFLATION = 1.7
"""Depth errors against exact depths are 1.5 to 1.9 times as large as first-order propagation says (measured
on a synthetic scene; the factor is nearly the same for short and long tracks): the keypoints of a track are
not independent, they share a bias of the surface's appearance, and bundle adjustment has fitted it."""
SIGMA_LIMIT = 0.2
"""Points whose relative depth is more uncertain than this say nothing and are dropped."""
PIXEL_FLOOR = 0.1
"""Poses are not known better than this many pixels of rotation."""
FEWEST = 4
"""A view with fewer usable points than this says too little of where its surfaces are."""
WORST = 8


@dataclass(frozen=True)
class PriorConfig:
    """Which of COLMAP's points are used how."""

    holdout: float = knob(
        0.1, "share of the tracks kept out of the optimisation, to measure the error on them; 0 uses all"
    )
    rotation_sigma: float = knob(
        0.0,
        "standard deviation of the cameras' rotations about each axis, degrees; 0: a view's median "
        "reprojection error over its focal length",
    )
    centre_sigma: float = knob(
        0.0,
        "standard deviation of the camera centres along each axis, in units of the model; 0: the same, times "
        "the median depth of the view's points",
    )
    focal_sigma: float = knob(0.005, "relative standard deviation of the focal lengths")
    overlap_by: str = knob(
        "information",
        "which views are matched with each other. number: those that share the most points; angle: the most "
        "by MVSNet's weight of the triangulation angle; information: one after the other what adds most to "
        "those before it by that weight, so that no part of the picture is without",
        choices=OVERLAPS,
    )
    pose_covariance: bool = knob(
        False,
        "add, in squares, what the covariance of COLMAP's bundle adjustment says of each camera, for models "
        "that hold some of theirs by few points; takes seconds",
    )

    def __post_init__(self) -> None:
        if not 0 <= self.holdout < 1:
            raise ValueError(f"holdout is a share of at least 0 and below 1, not {self.holdout}")
        check_range(self, "rotation_sigma centre_sigma", 0)
        check_range(self, "focal_sigma", POSITIVE)


@dataclass(frozen=True)
class PriorSet:
    """The priors of one chunk.

    Attributes:
        optimise: what the optimisation may use.
        held_out: one ``SparseDepth`` a view, of the tracks that it may not.
        dropped: reason → number of observations that are in neither.
    """

    optimise: Priors
    held_out: tuple[SparseDepth, ...]
    dropped: dict[str, int]


@dataclass(frozen=True)
class ProjectionCheck:
    """How far COLMAP's keypoints are from its points as the network's cameras project them.

    Attributes:
        median: over all observations, network pixels.
        per_view: name → median of the view.
    """

    median: float
    per_view: dict[str, float]


@dataclass(frozen=True)
class _Seen:
    """Points that one view observes, projected onto the canvas."""

    xy: Floats
    depth: Floats
    sigma: Floats
    track: Ints

    def tensors(self, keep: Mask) -> SparseDepth:
        import torch

        from tco.types import SparseDepth

        xy, depth, sigma = (torch.from_numpy(a[keep]).float() for a in (self.xy, self.depth, self.sigma))
        return SparseDepth(xy, depth, sigma, torch.from_numpy(self.track[keep]))


def with_points(
    tracks: Tracks, views: Sequence[View], config: PriorConfig = PriorConfig(), seed: int = 0
) -> tuple[list[View], dict[str, str]]:
    """The views with enough points to tell their range of depths, and name → reason for the others.

    Raises:
        InputError: no view is left.
    """
    enough: list[View] = []
    reasons = {}
    for view in views:
        seen, _ = _project(tracks, view, 1.0, (view.network.height, view.network.width))
        count = int((~held_out(seen.track, config.holdout, seed)).sum())
        if count >= FEWEST:
            enough.append(view)
        else:
            reasons[view.name] = f"{count} of its 3D points can be used, fewer than {FEWEST}"
    if not enough:
        raise InputError(f"no view has {FEWEST} 3D points that can be used; map the images again")
    return enough, reasons


def chunk_frame(tracks: Tracks, views: Sequence[View]) -> ChunkFrame:
    """The first view as world, and the median depth of all points as seen by all views as the unit.

    Raises:
        InputError: none of the views sees a point.
    """
    depth = np.concatenate([_local(tracks, view)[:, 2] for view in views])
    if not len(depth):
        raise InputError(f"no 3D point is seen by {', '.join(view.name for view in views[:WORST])}")
    return ChunkFrame(views[0].cam_from_world, float(np.median(depth)))


def _local(tracks: Tracks, view: View) -> Floats:
    """Points that a view observes (N, 3) in its camera frame, COLMAP units."""
    xyz = tracks.xyz[tracks.images[view.image_id].point]
    return xyz @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]


def build_priors(
    tracks: Tracks,
    views: Sequence[View],
    frame: ChunkFrame,
    config: PriorConfig = PriorConfig(),
    seed: int = 0,
) -> PriorSet:
    """Cameras, sparse depths and uncertainties of a chunk, on its canvas and in its units.

    A sparse depth sits where its 3D point projects, not where its keypoint is: the depth belongs to
    that ray, and the keypoint differs from it by exactly the error that bundle adjustment removed.
    Its relative uncertainty is √(rᵀ C r) / z, with r the viewing axis and C the point's covariance,
    times :data:`INFLATION`, and never below :data:`SIGMA_FLOOR`.

    The pose of a view is held as well as its keypoints locate it: σ(rotation) = e / f with e its median
    reprojection error and f its focal length in original pixels, σ(centre) = e / f times its median
    depth. One error for all its points, because what remains after bundle adjustment is systematic. The
    settings may give others, or add the covariance of bundle adjustment, if the tracks have it.
    """
    import torch

    from tco.types import Priors

    canvas = canvas_size(views)
    seen, dropped = (
        [],
        {"outside the network's image": 0, f"depth uncertain by more than {SIGMA_LIMIT:.0%}": 0},
    )
    for view in views:
        points, lost = _project(tracks, view, frame.scale, canvas)
        seen.append(points)
        for reason, count in zip(dropped, lost, strict=True):
            dropped[reason] += count
    held = [held_out(points.track, config.holdout, seed) for points in seen]
    depth = np.array([np.median(points.depth) if len(points.depth) else 1.0 for points in seen])
    rotation, centre = _pose_sigmas(tracks, views, depth, frame.scale, config)
    told = overlap(*observed(tracks, [view.image_id for view in views]), tracks.xyz, config.overlap_by)
    priors = Priors(
        cameras=canvas_cameras(views, frame),
        sparse=tuple(points.tensors(~mask) for points, mask in zip(seen, held, strict=True)),
        overlap=torch.from_numpy(told).float(),
        rotation_sigma=torch.from_numpy(rotation).float(),
        centre_sigma=torch.from_numpy(centre).float(),
        focal_sigma=torch.full((len(views),), config.focal_sigma),
    )
    return PriorSet(priors, tuple(p.tensors(mask) for p, mask in zip(seen, held, strict=True)), dropped)


def _project(
    tracks: Tracks, view: View, scale: float, canvas: tuple[int, int]
) -> tuple[_Seen, tuple[int, int]]:
    """Points of a view on the canvas, and how many were outside and too uncertain."""
    point = tracks.images[view.image_id].point
    local = _local(tracks, view)
    z = local[:, 2]
    axis = view.cam_from_world[2, :3]
    sigma = INFLATION * np.sqrt(np.einsum("i,nij,j->n", axis, tracks.covariance[point], axis)) / z
    network = view.network.pixels(local[:, :2] / z[:, None])
    inside = ((network > 0) & (network < (view.network.width, view.network.height))).all(1)
    good = inside & (sigma <= SIGMA_LIMIT)
    xy = canvas_camera(view, canvas).pixels(local[:, :2] / z[:, None])
    sigma = np.hypot(sigma, SIGMA_FLOOR)
    seen = _Seen(xy[good], z[good] / scale, sigma[good], tracks.ids[point][good])
    return seen, (int((~inside).sum()), int((inside & ~good).sum()))


def usable_points(tracks: Tracks, view: View) -> tuple[Floats, Floats, Ints]:
    """The points of a view that priors are made of: network pixels (N, 2), depths (N,), COLMAP's ids (N,)."""
    seen, _ = _project(tracks, view, 1.0, (view.network.height, view.network.width))
    return seen.xy, seen.depth, seen.track


def _pose_sigmas(
    tracks: Tracks, views: Sequence[View], depth: Floats, scale: float, config: PriorConfig
) -> tuple[Floats, Floats]:
    """Standard deviations of V views' rotations, radians, and centres, units of the chunk, about each axis.

    Args:
        tracks: of the model.
        views: V of them.
        depth: (V,) typical depth of each, units of the chunk.
        scale: COLMAP units in one of the chunk.
        config: what the user says of them.
    """
    angle = np.array([_pose_error(tracks, view) for view in views])
    rotation, centre = angle, angle * depth
    if config.rotation_sigma > 0:
        rotation = np.full(len(views), math.radians(config.rotation_sigma))
    if config.centre_sigma > 0:
        centre = np.full(len(views), config.centre_sigma / scale)
    if config.pose_covariance:
        turn, shift = np.array([tracks.deviations[view.image_id] for view in views]).T
        rotation, centre = np.hypot(rotation, turn), np.hypot(centre, shift / scale)
    return rotation, centre


def _pose_error(tracks: Tracks, view: View) -> float:
    """Median reprojection error of a view over its focal length: radians."""
    error = tracks.images[view.image_id].error
    typical = max(float(np.median(error)) if len(error) else 1.0, PIXEL_FLOOR)
    return typical / float(np.mean(focal_lengths(view.original)))


def held_out(track: Ints, share: float, seed: int) -> Mask:
    """Which tracks (N,) are held out: a hash of id and seed below ``share``.

    It depends on nothing else, so that a track is held out in all views, chunks and runs, or in none.
    The hash is the finaliser of SplitMix64 (Steele et al. 2014).
    """
    with np.errstate(over="ignore"):
        x = track.astype(np.uint64) + np.uint64(seed) * np.uint64(0xD1342543DE82EF95)
        x = x * np.uint64(0x9E3779B97F4A7C15) + np.uint64(0x632BE59BD9B4E019)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        x = x ^ (x >> np.uint64(31))
    result: NDArray[np.bool_] = x.astype(np.float64) / 2.0**64 < share
    return result


def check_projection(
    tracks: Tracks, views: Sequence[View], frame: ChunkFrame, cameras: Cameras, max_error: float = 1.0
) -> ProjectionCheck:
    """Project the points with exactly the cameras that the network is given and compare with the keypoints.

    The keypoints come from the original image by its distortion and the maps of :mod:`colmap_tco.views`,
    the points from the world by the chunk's frame, unit and canvas: an error in any of them shows. It
    is measured in network pixels, since what is below one of them cannot mislead the network.

    Args:
        cameras: poses and intrinsics on the canvas, in the chunk's frame.
        max_error: largest median, network pixels.

    Raises:
        InputError: the median is larger; the message lists the worst views.
    """
    canvas = canvas_size(views)
    poses, K = cameras.world_from_cam.double().numpy(), cameras.K.double().numpy()
    R0, t0 = frame.cam_from_world[:, :3], frame.cam_from_world[:, 3]
    errors = {}
    for i, view in enumerate(views):
        seen = tracks.images[view.image_id]
        world = (tracks.xyz[seen.point] @ R0.T + t0) / frame.scale
        local = (world - poses[i, :3, 3]) @ poses[i, :3, :3]
        projected = (local @ K[i].T)[:, :2] / local[:, 2:]
        margin = (canvas[1] - view.network.width, canvas[0] - view.network.height)
        keypoints = network_from_original(view, seen.xy) + np.array(margin) / 2
        error = np.linalg.norm(projected - keypoints, axis=1)
        errors[view.name] = error[np.isfinite(error)]
    everything = np.concatenate(list(errors.values()))
    if not len(everything):
        raise InputError("no keypoint of these views can be compared with its 3D point; map the images again")
    per_view = {name: float(np.median(error)) for name, error in errors.items() if len(error)}
    check = ProjectionCheck(float(np.median(everything)), per_view)
    _judge(check, max_error)
    return check


def _judge(check: ProjectionCheck, max_error: float) -> None:
    worst = sorted(check.per_view.items(), key=lambda item: -item[1])[:WORST]
    table = "\n".join(f"  {name}: {error:.2f} px" for name, error in worst)
    if check.median > max_error:
        raise InputError(
            f"the 3D points project {check.median:.2f} network pixels (median) away from their keypoints, "
            f"more than {max_error:g}:\n{table}\nThe images or cameras are not those of the model: name the "
            "right --image_path or --model_path, or run colmap bundle_adjuster on the model."
        )
    if worst and worst[0][1] > max_error:
        log.warning("some views fit their keypoints badly (median error, network pixels):\n%s", table)
