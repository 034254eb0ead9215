"""The 3D points of a model and who sees them, as arrays, with the uncertainty of every point."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Floats, Ints, Mask, Model, Registered
from colmap_tco.errors import InputError

log = logging.getLogger(__name__)

PIXEL_FLOOR = 0.25
"""Keypoints are not located better than this, pixels, however small the residual of a short track."""
PRIOR_WEIGHT = 4.0
"""How many degrees of freedom the model's typical error counts for in the error of one track."""
BEST_ANGLE, NARROW, WIDE = 5.0, 1.0, 10.0
_PAIRS = 2_000_000


@dataclass(frozen=True)
class Observations:
    """What one image sees.

    Attributes:
        xy: (N, 2) keypoints in original pixels.
        point: (N,) indices into the arrays of :class:`Tracks`.
        error: (N,) distance in original pixels between keypoint and projected point.
    """

    xy: Floats
    point: Ints
    error: Floats


@dataclass(frozen=True)
class Tracks:
    """Points with at least two accepted observations.

    Attributes:
        ids: (P,) COLMAP's ids, ascending.
        xyz: (P, 3) world positions.
        covariance: (P, 3, 3) of the positions, in COLMAP units squared.
        length: (P,) number of accepted observations.
        images: image id → accepted observations.
        centres: image id → (3,) camera centre.
        dropped: reason → number of observations not accepted.
        deviations: image id → standard deviations of its camera about and along each axis, radians and
            units of the model, by bundle adjustment (:mod:`colmap_tco.pose_covariance`); empty where nobody
            asked.
    """

    ids: Ints
    xyz: Floats
    covariance: Floats
    length: Ints
    images: dict[int, Observations]
    centres: dict[int, Floats]
    dropped: dict[str, int]
    deviations: Mapping[int, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Covisibility:
    """How much pairs of views share; symmetric, zero on the diagonal.

    Attributes:
        common: (V, V) number of common points.
        score: (V, V) the same, weighted by triangulation angle.
    """

    common: Ints
    score: Floats


def read_tracks(model: Model, level: int = logging.DEBUG) -> Tracks:
    """All tracks of a model, without observations that contradict it.

    An observation is dropped if its point is behind the camera or projects further away than four
    times the model's median error and four pixels (COLMAP's ``filter_max_reproj_error``). Points that
    keep fewer than two observations are dropped with them.

    The covariance is the first-order one of a point triangulated from fixed cameras,
    σ² (Σ JᵀJ)⁻¹ with J = ∂(pixel) / ∂(point): long tracks and wide angles make it small, and its
    direction along a viewing ray is where the depth is uncertain. σ is the track's own residual,
    shrunk to that of the model (:data:`PRIOR_WEIGHT`), because 2n − 3 degrees of freedom say little.

    Args:
        model: with points.
        level: of the log record that says how many are used, and how many observations are not, and why.

    Raises:
        InputError: no point is left.
    """
    ids, xyz, _ = _pycolmap.points(model)
    entries = _pycolmap.registered(model)
    seen = {entry.image_id: _observe(model, entry, ids, xyz) for entry in entries}
    errors = np.concatenate([o.error for o, _ in seen.values()] or [np.zeros(0)])
    typical = float(np.median(errors[np.isfinite(errors)])) if np.isfinite(errors).any() else 0.0
    limit = max(4.0, 4 * typical)
    behind = sum(int(np.isinf(o.error).sum()) for o, _ in seen.values())
    far = int((np.isfinite(errors) & (errors > limit)).sum())

    length, information, squares = np.zeros(len(ids), int), np.zeros((len(ids), 3, 3)), np.zeros(len(ids))
    accepted: dict[int, Mask] = {}
    for image_id, (obs, J) in seen.items():
        good = accepted[image_id] = obs.error <= limit
        point = obs.point[good]
        np.add.at(length, point, 1)
        np.add.at(squares, point, obs.error[good] ** 2)
        np.add.at(information, point, np.swapaxes(J[good], 1, 2) @ J[good])
    keep = length >= 2
    if not keep.any():
        raise InputError("no 3D point of the model is seen consistently by two images; map the images again")
    singles = int(length[~keep].sum())
    # Rayleigh: the median distance is 1.1774 times the standard deviation along one axis.
    sigma2 = _track_variance(squares[keep], length[keep], typical / 1.1774)
    covariance = sigma2[:, None, None] * inverse(information[keep])

    renumber = np.cumsum(keep) - 1
    images = {}
    for image_id, (obs, _) in seen.items():
        good = accepted[image_id] & keep[obs.point]
        images[image_id] = Observations(obs.xy[good], renumber[obs.point[good]], obs.error[good])
    dropped = {"behind the camera": behind, f"off by more than {limit:.1f} px": far, "seen once": singles}
    lost = ", ".join(f"{count} {why}" for why, count in dropped.items() if count)
    told = f"; observations not used: {lost}" if lost else ""
    log.log(level, "%d points, median reprojection error %.2f px%s", keep.sum(), typical, told)
    centres = {
        e.image_id: -e.cam_from_world[:, :3].T @ e.cam_from_world[:, 3] for e in _pycolmap.registered(model)
    }
    return Tracks(ids[keep], xyz[keep], covariance, length[keep], images, centres, dropped)


def _observe(model: Model, entry: Registered, ids: Ints, xyz: Floats) -> tuple[Observations, Floats]:
    """What one image sees, error infinite behind the camera, and ∂(pixel) / ∂(point) (N, 2, 3)."""
    xy, seen = _pycolmap.observations(model, entry.image_id)
    if _pycolmap.is_spherical(entry.camera):
        xy, seen = xy[:0], seen[:0]
    point = np.searchsorted(ids, seen)
    R, t = entry.cam_from_world[:, :3], entry.cam_from_world[:, 3]
    local = xyz[point] @ R.T + t
    front = local[:, 2] > 1e-9
    z = np.where(front, local[:, 2], 1.0)
    rays = local[:, :2] / z[:, None]
    error = np.linalg.norm(_pycolmap.img_from_cam(entry.camera, rays) - xy, axis=1)
    error[~front | ~np.isfinite(error)] = np.inf
    J = image_jacobian(entry, np.concatenate([rays * z[:, None], z[:, None]], 1))
    return Observations(xy, point, error), J @ R


def image_jacobian(entry: Registered, local: Floats) -> Floats:
    """∂(pixel) / ∂(point) (N, 2, 3) at points (N, 3) before a camera, in its frame; distortion left out."""
    J = np.zeros((len(local), 2, 3))
    if len(local):
        J[:, 0, 0], J[:, 1, 1] = _pycolmap.focal_lengths(entry.camera)
        J[:, :, 2] = -local[:, :2] / local[:, 2:] * J[:, (0, 1), (0, 1)]
    return J / local[:, 2, None, None]


def skew(vectors: Floats) -> Floats:
    """[v]× (N, 3, 3) of vectors (N, 3): what turns a product with it into a cross product."""
    result = np.zeros((len(vectors), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[:, i, j], result[:, j, i] = -vectors[:, k], vectors[:, k]
    return result


def _track_variance(squares: Floats, length: Ints, typical: float) -> Floats:
    """Variance (P,) of a keypoint along one axis: the track's own, shrunk to the model's."""
    freedom = 2 * length - 3
    variance = (PRIOR_WEIGHT * typical**2 + squares) / (PRIOR_WEIGHT + freedom)
    result: Floats = np.maximum(variance, PIXEL_FLOOR**2)
    return result


def inverse(information: Floats) -> Floats:
    """Inverse of (P, 3, 3). Two parallel rays say nothing of the depth along them: the ridge keeps the
    result finite (and enormous, so that such points are rejected by their uncertainty)."""
    ridge = 1e-12 * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    result: Floats = np.linalg.inv(information + ridge)
    return result


def covisibility(tracks: Tracks, image_ids: Sequence[int]) -> Covisibility:
    """Common points of every pair of images, plainly counted and weighted by :func:`angle_weight`."""
    points, centres = observed(tracks, image_ids)
    size = len(points)
    views = np.concatenate([np.full(len(seen), v) for v, seen in enumerate(points)])
    common, score = np.zeros(size * size, np.int64), np.zeros(size * size)
    for p, a, b in _pairs(np.concatenate(points), views):
        weight = angle_weight(centres[a] - tracks.xyz[p], centres[b] - tracks.xyz[p])
        common += np.bincount(a * size + b, minlength=size * size)
        score += np.bincount(a * size + b, weight, minlength=size * size)
    counts, weights = common.reshape(size, size), score.reshape(size, size)
    return Covisibility(counts + counts.T, weights + weights.T)


def observed(tracks: Tracks, image_ids: Sequence[int]) -> tuple[list[Ints], Floats]:
    """Indices of the points that each of V images observes, and where these were taken from (V, 3)."""
    return [tracks.images[i].point for i in image_ids], np.stack([tracks.centres[i] for i in image_ids])


def angle_weight(to_one: Floats, to_other: Floats) -> Floats:
    """What a triangulation angle θ is worth, by MVSNet (Yao et al. 2018, section 4.1).

    It is exp(−(θ − 5°)² / 2σ²), σ = 1° below 5° and 10° above: narrower pairs give no depth, wider ones look
    different.

    Args:
        to_one, to_other: (..., 3) from points to two cameras.
    """
    length = np.linalg.norm(to_one, axis=-1) * np.linalg.norm(to_other, axis=-1)
    angle = np.degrees(np.arccos(np.clip((to_one * to_other).sum(-1) / length, -1, 1)))
    weight: Floats = np.exp(-0.5 * ((angle - BEST_ANGLE) / np.where(angle <= BEST_ANGLE, NARROW, WIDE)) ** 2)
    return weight


def _pairs(point: Ints, views: Ints) -> Iterator[tuple[Ints, Ints, Ints]]:
    """Blocks of (point, view a, view b), each pair of distinct views of a point once."""
    observed = np.unique(np.stack([point, views]), axis=1)
    _, start, length = np.unique(observed[0], return_index=True, return_counts=True)
    for n in np.unique(length[length > 1]):
        first, second = np.triu_indices(n, 1)
        step = max(1, _PAIRS // len(first))
        begins = start[length == n]
        for i in range(0, len(begins), step):
            begin = begins[i : i + step, None]
            a, b = (begin + first).ravel(), (begin + second).ravel()
            yield observed[0, a], observed[1, a], observed[1, b]
