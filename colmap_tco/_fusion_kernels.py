"""Compiled loops of :mod:`colmap_tco.fusion`: which pixels take part, and which views agree on them.

Each is parallel over pixels that do not share results.

Coordinates are those of the reference camera, so that large world coordinates cost no precision.
Pixel indices from ``prange`` are unsigned; they are used to address arrays and never negated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

KEEP, NO_DEPTH, MASKED, LOW_CONFIDENCE, NO_NORMAL, GRAZING, EDGE = range(7)
"""Why a pixel takes no part, as :func:`classify` marks it."""

_MOST_TILT = 1.05
"""Largest ratio of depths within one pixel that is ascribed to a slanted surface."""


_RANGE = 4096
"""Pixels that a thread takes at a time."""


class Maps(NamedTuple):
    """One view: depth (H, W) without the pixels that filters dropped, unit normal (H, W, 3) in the
    camera frame, confidence (H, W) or (0, 0) where there is none, intrinsics (fx, fy, cx, cy, 1/fx, 1/fy):
    a comparison of two pixels would spend half its time in divisions."""

    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    confidence: NDArray[np.float32]
    intrinsics: NDArray[np.float64]


class Votes(NamedTuple):
    """What the other views say of M pixels of the reference.

    ``seen`` (M,) views whose image contains the point; ``support`` (M,) views that agree, the
    reference included; ``conflicts`` (M,) views that look through the point; ``weight`` (M,),
    ``shift`` (M, 3), ``normal`` (M, 3) weighted sums over the views that agree; ``who`` (M, words)
    one bit for each neighbour that agrees.
    """

    seen: NDArray[np.uint16]
    support: NDArray[np.uint16]
    conflicts: NDArray[np.uint16]
    weight: NDArray[np.float32]
    shift: NDArray[np.float32]
    normal: NDArray[np.float32]
    who: NDArray[np.uint64]

    def select(self, keep: NDArray[np.bool_] | slice) -> Votes:
        """The votes on some of the pixels."""
        return Votes(
            self.seen[keep],
            self.support[keep],
            self.conflicts[keep],
            self.weight[keep],
            self.shift[keep],
            self.normal[keep],
            self.who[keep],
        )


class Limits(NamedTuple):
    """Bounds of the consistency test; see :class:`colmap_tco.fusion.FusionConfig`.

    ``depth_error`` is relative, ``reproj_error`` in pixels of the reference's map.
    """

    depth_error: float
    reproj_error: float
    cos_normal: float
    sigma_at_one: float
    most_depth_error: float


@njit(cache=True, error_model="numpy", inline="always")
def ray(maps: Maps, row: int, col: int) -> tuple[float, float]:
    """x and y of the ray (x, y, 1) through the centre of a pixel."""
    k = maps.intrinsics
    return (col + 0.5 - k[2]) * k[4], (row + 0.5 - k[3]) * k[5]


@njit(cache=True, error_model="numpy")
def _bend(before: float, centre: float, after: float) -> float:
    """Second difference of inverse depth relative to the centre; 0 where a depth is missing."""
    if before <= 0.0 or centre <= 0.0 or after <= 0.0:
        return 0.0
    return abs(centre / before - 2.0 + centre / after)


@njit(cache=True, error_model="numpy")
def _classify_one(
    maps: Maps, row: int, col: int, bounds: tuple[float, float, float], bottom_right: tuple[int, int]
) -> int:
    """The mark of one pixel; ``bounds`` as in :func:`classify`, ``bottom_right`` the last row and column."""
    min_confidence, max_bend, min_cos = bounds
    depth, normal = maps.depth, maps.normal
    z = depth[row, col]
    if not z > 0.0:
        return NO_DEPTH
    if maps.confidence.shape[0] > 0 and maps.confidence[row, col] < min_confidence:
        return LOW_CONFIDENCE
    nx, ny, nz = normal[row, col, 0], normal[row, col, 1], normal[row, col, 2]
    if nx == 0.0 and ny == 0.0 and nz == 0.0:
        return NO_NORMAL
    x, y = ray(maps, row, col)
    if -(nx * x + ny * y + nz) < min_cos * np.sqrt(x * x + y * y + 1.0):
        return GRAZING
    bend = 0.0
    if 0 < col < bottom_right[1]:
        bend = _bend(depth[row, col - 1], z, depth[row, col + 1])
    if 0 < row < bottom_right[0]:
        bend = max(bend, _bend(depth[row - 1, col], z, depth[row + 1, col]))
    return EDGE if bend > max_bend else KEEP


@njit(cache=True, error_model="numpy", parallel=True)
def classify(maps: Maps, bounds: tuple[float, float, float], marks: NDArray[np.uint8]) -> None:
    """Mark each pixel of ``marks`` (H, W) that is not MASKED already with KEEP or why it is dropped.

    ``bounds``: least confidence, largest relative second difference of the inverse depth, least
    cosine between the normal and the direction to the camera.
    """
    height, width = marks.shape
    for line in prange(height):
        row = np.int64(line)
        for col in range(width):
            if marks[row, col] != MASKED:
                marks[row, col] = _classify_one(maps, row, col, bounds, (height - 1, width - 1))


@njit(cache=True, error_model="numpy", inline="always")
def confidence(maps: Maps, row: int, col: int) -> float:
    """Confidence of a pixel, 1 where there is none."""
    return float(maps.confidence[row, col]) if maps.confidence.shape[0] > 0 else 1.0


@njit(cache=True, error_model="numpy", inline="always")
def move(transform: NDArray[np.float64], x: float, y: float, z: float) -> tuple[float, float, float]:
    """The (3, 4) ``transform`` of a point."""
    return (
        transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] * z + transform[0, 3],
        transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] * z + transform[1, 3],
        transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] * z + transform[2, 3],
    )


@njit(cache=True, error_model="numpy", inline="always")
def _turn_back(transform: NDArray[np.float64], x: float, y: float, z: float) -> tuple[float, float, float]:
    """The inverse rotation of the (3, 4) ``transform`` of a direction."""
    return (
        transform[0, 0] * x + transform[1, 0] * y + transform[2, 0] * z,
        transform[0, 1] * x + transform[1, 1] * y + transform[2, 1] * z,
        transform[0, 2] * x + transform[1, 2] * y + transform[2, 2] * z,
    )


@njit(cache=True, error_model="numpy")
def _surface(maps: Maps, row: int, col: int, x: float, y: float) -> float:
    """Depth along the ray (x, y, 1) of the tangent plane of pixel (row, col); 0 where it has no depth.

    Exact on planes at every sub-pixel position, and one memory access; no value is interpolated
    across a discontinuity. A plane that is nearly parallel to the ray says nothing about depth, so
    beyond a ratio of ``_MOST_TILT`` the depth of the pixel stands as it is.
    """
    depth = float(maps.depth[row, col])
    if depth <= 0.0:
        return 0.0
    nx, ny, nz = maps.normal[row, col, 0], maps.normal[row, col, 1], maps.normal[row, col, 2]
    centre_x, centre_y = ray(maps, row, col)
    ratio = (nx * centre_x + ny * centre_y + nz) / (nx * x + ny * y + nz)
    return depth * ratio if 1.0 / _MOST_TILT < ratio < _MOST_TILT else depth


@njit(cache=True, error_model="numpy")
def _tolerance(limits: Limits, one: float, other: float) -> float:
    """Relative depth error allowed between two pixels of these confidences."""
    if limits.sigma_at_one <= 0.0:
        return limits.depth_error
    sigma = limits.sigma_at_one * np.sqrt(1.0 / (one * one) + 1.0 / (other * other))
    return min(max(limits.depth_error, sigma), max(limits.depth_error, limits.most_depth_error))


@njit(cache=True, error_model="numpy", inline="always")
def _reprojection(ref: Maps, direction: tuple[float, float], moved: tuple[float, float, float]) -> float:
    """Squared distance in pixels from the pixel of a ray to the image of a point of the reference frame."""
    if moved[2] <= 0.0:
        return np.inf
    inverse = 1.0 / moved[2]
    du = ref.intrinsics[0] * (moved[0] * inverse - direction[0])
    dv = ref.intrinsics[1] * (moved[1] * inverse - direction[1])
    return float(du * du + dv * dv)


@njit(cache=True, error_model="numpy", inline="always")
def _cosine(ref: Maps, row: int, col: int, n: tuple[float, float, float]) -> float:
    """Of the angle between the normal of a pixel and another normal in the reference frame."""
    return float(
        n[0] * ref.normal[row, col, 0] + n[1] * ref.normal[row, col, 1] + n[2] * ref.normal[row, col, 2]
    )


UNSEEN, HOLE, OCCLUDED, THROUGH, DEPTH, REPROJECTION, NORMAL, AGREES = range(8)
"""Outcomes of comparing one pixel with one view."""


@njit(cache=True, error_model="numpy")
def _compare(
    ref: Maps, other: Maps, transform: NDArray[np.float64], limits: Limits, at: tuple[int, int]
) -> tuple[int, float, tuple[float, float, float], tuple[float, float, float]]:
    """Compare pixel ``at`` of the reference with another view; ``transform`` is other_from_ref.

    Returns the outcome and, where it is AGREES, the weight, the shift of the point to the surface
    of the other view, and that view's normal, both in the reference frame.
    """
    none = (0.0, 0.0, 0.0)
    row, col = at
    direction = ray(ref, row, col)
    z = float(ref.depth[row, col])
    point = (direction[0] * z, direction[1] * z, z)
    x, y, depth = move(transform, point[0], point[1], point[2])
    if depth <= 0.0:
        return UNSEEN, 0.0, none, none
    inverse = 1.0 / depth
    x, y = x * inverse, y * inverse
    u = other.intrinsics[0] * x + other.intrinsics[2]
    v = other.intrinsics[1] * y + other.intrinsics[3]
    if not (0.0 <= u < other.depth.shape[1] and 0.0 <= v < other.depth.shape[0]):
        return UNSEEN, 0.0, none, none
    j, i = int(v), int(u)
    surface = _surface(other, j, i, x, y)
    if surface <= 0.0:
        return HOLE, 0.0, none, none
    error = surface - depth
    weight = confidence(other, j, i)
    outlying = error * inverse / _tolerance(limits, confidence(ref, row, col), weight)
    if not abs(outlying) <= 1.0:
        if abs(outlying) <= 3.0:
            return DEPTH, 0.0, none, none
        return THROUGH if error > 0.0 else OCCLUDED, 0.0, none, none
    shift = _turn_back(transform, x * error, y * error, error)
    moved = (point[0] + shift[0], point[1] + shift[1], point[2] + shift[2])
    if not _reprojection(ref, direction, moved) <= limits.reproj_error * limits.reproj_error:
        return REPROJECTION, 0.0, none, none
    n = _turn_back(transform, other.normal[j, i, 0], other.normal[j, i, 1], other.normal[j, i, 2])
    if _cosine(ref, row, col, n) < limits.cos_normal:
        return NORMAL, 0.0, none, none
    return AGREES, weight, shift, n


@njit(cache=True, error_model="numpy")
def _vote_range(
    ref: Maps,
    pixels: NDArray[np.int64],
    other: Maps,
    transform: NDArray[np.float64],
    limits: Limits,
    slot: int,
    votes: Votes,
    outcomes: NDArray[np.int64],
) -> None:
    """Compare ``pixels`` (M,) with a neighbour, add what it says to ``votes``, count the ``outcomes``."""
    seen, support, conflicts, weights, shifts, normals, who = votes
    width = ref.depth.shape[1]
    word, bit = slot >> 6, np.uint64(1) << np.uint64(slot & 63)
    for m in range(len(pixels)):
        row = pixels[m] // width
        at = (row, pixels[m] - row * width)
        outcome, weight, shift, normal = _compare(ref, other, transform, limits, at)
        outcomes[outcome] += 1
        if outcome != UNSEEN:
            seen[m] += 1
        if outcome == THROUGH:
            conflicts[m] += 1
        if outcome == AGREES:
            support[m] += 1
            who[m, word] |= bit
            weights[m] += weight
            for axis in range(3):
                shifts[m, axis] += weight * shift[axis]
                normals[m, axis] += weight * normal[axis]


@njit(cache=True, error_model="numpy", parallel=True)
def vote(
    ref: Maps,
    pixels: NDArray[np.int64],
    other: Maps,
    transform: NDArray[np.float64],
    limits: Limits,
    slot: int,
    votes: Votes,
) -> NDArray[np.int64]:
    """Let one neighbour, number ``slot`` of the reference, vote on ``pixels`` (M,), flat indices.

    An agreeing view counts with its confidence. Weights that fall with the depth error would draw the
    mean to the reference, whose own error is as large.

    Threads take ranges of pixels, not pixels: a parallel loop that writes to arrays reached through
    a tuple loses values (numba 0.68), and a call for each pixel costs more than the comparison.

    Returns how often each outcome came up.
    """
    ranges = (len(pixels) + _RANGE - 1) // _RANGE
    outcomes = np.zeros((ranges, AGREES + 1), np.int64)
    for r in prange(ranges):
        first, last = r * _RANGE, min(np.int64((r + 1) * _RANGE), len(pixels))
        part = Votes(
            votes.seen[first:last],
            votes.support[first:last],
            votes.conflicts[first:last],
            votes.weight[first:last],
            votes.shift[first:last],
            votes.normal[first:last],
            votes.who[first:last],
        )
        _vote_range(ref, pixels[first:last], other, transform, limits, slot, part, outcomes[r])
    return outcomes.sum(0)


@njit(cache=True, error_model="numpy")
def differences(
    ref: Maps,
    pixels: NDArray[np.int64],
    other: Maps,
    transform: NDArray[np.float64],
    out: NDArray[np.float64],
) -> int:
    """Fill ``out`` (M, 3) with how much a neighbour differs at those of ``pixels`` that it sees.

    The columns are the relative depth error, the reprojection error in pixels, and the angle between
    the normals in radians.

    Returns how many rows were filled.
    """
    width, found = ref.depth.shape[1], 0
    for m in range(len(pixels)):
        row = pixels[m] // width
        col = pixels[m] - row * width
        direction = ray(ref, row, col)
        z = float(ref.depth[row, col])
        x, y, depth = move(transform, direction[0] * z, direction[1] * z, z)
        if depth <= 0.0:
            continue
        x, y = x / depth, y / depth
        u = other.intrinsics[0] * x + other.intrinsics[2]
        v = other.intrinsics[1] * y + other.intrinsics[3]
        if not (0.0 <= u < other.depth.shape[1] and 0.0 <= v < other.depth.shape[0]):
            continue
        j, i = int(v), int(u)
        surface = _surface(other, j, i, x, y)
        if surface <= 0.0:
            continue
        error = surface - depth
        shift = _turn_back(transform, x * error, y * error, error)
        moved = (direction[0] * z + shift[0], direction[1] * z + shift[1], z + shift[2])
        n = _turn_back(transform, other.normal[j, i, 0], other.normal[j, i, 1], other.normal[j, i, 2])
        out[found, 0] = abs(error) / depth
        out[found, 1] = np.sqrt(_reprojection(ref, direction, moved))
        out[found, 2] = np.arccos(min(max(_cosine(ref, row, col, n), -1.0), 1.0))
        found += 1
    return found
