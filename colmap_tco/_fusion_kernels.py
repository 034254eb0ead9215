"""Compiled loops of :mod:`colmap_tco.fusion`: which pixels take part, and which views agree on them.

They are serial and release the interpreter's lock; :class:`colmap_tco.workers.Workers` runs them on
ranges of pixels.

Coordinates are those of the reference camera, so that large world coordinates cost no precision.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

KEEP, NO_DEPTH, MASKED, LOW_CONFIDENCE, NO_NORMAL, GRAZING, EDGE, FAR = range(8)
"""Why a pixel takes no part, as :func:`classify` marks it."""

_MOST_TILT = 1.05
"""Largest ratio of depths within one pixel that is ascribed to a slanted surface."""


CHANNELS = 5
"""A packed view is (H, W, 5): depth, normal x y z, confidence, side by side for they are read together.

A pair is (24,): the six numbers of :func:`camera` of the reference, those of the other view, and the
(3, 4) transform from the first to the second, row by row.
"""

Votes = tuple[
    NDArray[np.uint16],
    NDArray[np.uint16],
    NDArray[np.uint16],
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.uint64],
    NDArray[np.float32],
]
"""The arrays of :class:`colmap_tco.fusion_votes.Votes`. Kernels take tuples, not classes of ours: numba's
cache on disk would name the class, and fail to load once a later version has renamed it."""
Limits = tuple[float, float, float, float, float]
"""Relative depth error, reprojection error in pixels of the map, least cosine between normals,
``sigma_at_one``, ``most_depth_error``; see :class:`colmap_tco.fusion.FusionConfig`."""


def camera(intrinsics: NDArray[np.float64]) -> NDArray[np.float64]:
    """fx, fy, cx, cy, 1/fx, 1/fy of (fx, fy, cx, cy): divisions would take half the time of a comparison."""
    return np.concatenate([intrinsics, 1.0 / intrinsics[:2]])


def pair(
    ref: NDArray[np.float64], other: NDArray[np.float64], other_from_ref: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Two cameras (6,) and the (3, 4) transform between them, as the loops take them.

    Arrays alone, because an array that is reached through a tuple inside a loop is counted as in use
    and released there, which takes three times as long as the comparison.
    """
    return np.concatenate([ref, other, other_from_ref.ravel()])


@njit(cache=True, error_model="numpy", inline="always")
def ray(camera: NDArray[np.float64], row: int, col: int) -> tuple[float, float]:
    """x and y of the ray (x, y, 1) through the centre of a pixel of the (first) camera."""
    return (col + 0.5 - camera[2]) * camera[4], (row + 0.5 - camera[3]) * camera[5]


@njit(cache=True, error_model="numpy", inline="always")
def move(pair: NDArray[np.float64], x: float, y: float, z: float) -> tuple[float, float, float]:
    """A point of the first camera in the second."""
    return (
        pair[12] * x + pair[13] * y + pair[14] * z + pair[15],
        pair[16] * x + pair[17] * y + pair[18] * z + pair[19],
        pair[20] * x + pair[21] * y + pair[22] * z + pair[23],
    )


@njit(cache=True, error_model="numpy", inline="always")
def _turn_back(pair: NDArray[np.float64], x: float, y: float, z: float) -> tuple[float, float, float]:
    """A direction of the second camera in the first."""
    return (
        pair[12] * x + pair[16] * y + pair[20] * z,
        pair[13] * x + pair[17] * y + pair[21] * z,
        pair[14] * x + pair[18] * y + pair[22] * z,
    )


@njit(cache=True, error_model="numpy")
def _bends(before: float, centre: float, after: float, most: float) -> bool:
    """Whether the second difference of inverse depth is above ``most`` of the centre's, not divided by it.

    False where a depth is missing.
    """
    if before <= 0.0 or after <= 0.0:
        return False
    product = before * after
    return abs(centre * (before + after) - 2.0 * product) > most * product


@njit(cache=True, error_model="numpy")
def _classify_one(
    view: NDArray[np.float32],
    camera: NDArray[np.float64],
    row: int,
    col: int,
    bounds: tuple[float, float, float, float],
) -> int:
    """The mark of one pixel; ``bounds`` as in :func:`classify`."""
    min_confidence, max_bend, min_cos, max_depth = bounds
    z = view[row, col, 0]
    if not z > 0.0:
        return NO_DEPTH
    if z > max_depth:
        return FAR
    if view[row, col, 4] < min_confidence:
        return LOW_CONFIDENCE
    nx, ny, nz = view[row, col, 1], view[row, col, 2], view[row, col, 3]
    if nx == 0.0 and ny == 0.0 and nz == 0.0:
        return NO_NORMAL
    x, y = ray(camera, row, col)
    if -(nx * x + ny * y + nz) < min_cos * np.sqrt(x * x + y * y + 1.0):
        return GRAZING
    bent = 0 < col < view.shape[1] - 1 and _bends(view[row, col - 1, 0], z, view[row, col + 1, 0], max_bend)
    if not bent and 0 < row < view.shape[0] - 1:
        bent = _bends(view[row - 1, col, 0], z, view[row + 1, col, 0], max_bend)
    return EDGE if bent else KEEP


@njit(cache=True, error_model="numpy", nogil=True)
def classify(
    view: NDArray[np.float32],
    camera: NDArray[np.float64],
    bounds: tuple[float, float, float, float],
    rows: tuple[int, int],
    marks: NDArray[np.uint8],
) -> None:
    """Mark each pixel in ``rows`` of ``marks`` (H, W) that is not MASKED with KEEP or why it is dropped.

    ``bounds``: least confidence, largest relative second difference of the inverse depth, least
    cosine between the normal and the direction to the camera, largest depth.
    """
    for row in range(rows[0], rows[1]):
        for col in range(view.shape[1]):
            if marks[row, col] != MASKED:
                marks[row, col] = _classify_one(view, camera, row, col, bounds)


@njit(cache=True, error_model="numpy", inline="always")
def _surface(
    other: NDArray[np.float32], pair: NDArray[np.float64], row: int, col: int, at: tuple[float, float]
) -> float:
    """Depth along the ray (x, y, 1) of the tangent plane of a pixel of the second view; 0 if it has none.

    Exact on planes at every sub-pixel position, and one memory access; no value is interpolated
    across a discontinuity. A plane that is nearly parallel to the ray says nothing about depth, so
    beyond a ratio of ``_MOST_TILT`` the depth of the pixel stands as it is.
    """
    depth = float(other[row, col, 0])
    nx, ny, nz = other[row, col, 1], other[row, col, 2], other[row, col, 3]
    x = (col + 0.5 - pair[8]) * pair[10]
    y = (row + 0.5 - pair[9]) * pair[11]
    ratio = (nx * x + ny * y + nz) / (nx * at[0] + ny * at[1] + nz)
    return depth * ratio if 1.0 / _MOST_TILT < ratio < _MOST_TILT else depth


@njit(cache=True, error_model="numpy", inline="always")
def _tolerance(limits: Limits, one: float, other: float) -> float:
    """Relative depth error allowed between two pixels of these confidences."""
    depth_error, _, _, sigma_at_one, most_depth_error = limits
    if sigma_at_one <= 0.0:
        return depth_error
    sigma = sigma_at_one * np.sqrt(1.0 / (one * one) + 1.0 / (other * other))
    return min(max(depth_error, sigma), max(depth_error, most_depth_error))


@njit(cache=True, error_model="numpy", inline="always")
def _reprojection(
    pair: NDArray[np.float64], direction: tuple[float, float], moved: tuple[float, float, float]
) -> float:
    """Squared distance in pixels from the pixel of a ray to the image of a point of the first camera."""
    if moved[2] <= 0.0:
        return np.inf
    inverse = 1.0 / moved[2]
    du = pair[0] * (moved[0] * inverse - direction[0])
    dv = pair[1] * (moved[1] * inverse - direction[1])
    return float(du * du + dv * dv)


@njit(cache=True, error_model="numpy", inline="always")
def _between(
    pair: NDArray[np.float64], row: int, col: int, z: float, centre: tuple[float, float, float]
) -> float:
    """Cosine of the angle at a pixel's point between its camera and one with this centre."""
    x, y = ray(pair, row, col)
    a, b, c = x * z - centre[0], y * z - centre[1], z - centre[2]
    product = x * a + y * b + c
    return float(product / np.sqrt((x * x + y * y + 1.0) * (a * a + b * b + c * c)))


UNSEEN, HOLE, OCCLUDED, THROUGH, DEPTH, REPROJECTION, NORMAL, AGREES = range(8)
"""Outcomes of comparing one pixel with one view."""


@njit(cache=True, error_model="numpy", inline="always")
def _meet(
    ref: NDArray[np.float32], other: NDArray[np.float32], pair: NDArray[np.float64], row: int, col: int
) -> tuple[int, float, float, float, float, float, int, int]:
    """Where a pixel of the reference meets the other view.

    Returns UNSEEN, HOLE or AGREES; where it is AGREES, the relative depth error, the squared
    reprojection error, the shift of the point to the surface of the other view in the reference
    frame (x, y, z), and the row and column in the other view.
    """
    direction = ray(pair, row, col)
    z = float(ref[row, col, 0])
    x, y, depth = move(pair, direction[0] * z, direction[1] * z, z)
    if depth <= 0.0:
        return UNSEEN, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0
    inverse = 1.0 / depth
    x, y = x * inverse, y * inverse
    u, v = pair[6] * x + pair[8], pair[7] * y + pair[9]
    if not (0.0 <= u < other.shape[1] and 0.0 <= v < other.shape[0]):
        return UNSEEN, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0
    j, i = int(v), int(u)
    if other[j, i, 0] <= 0.0:
        return HOLE, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0
    error = _surface(other, pair, j, i, (x, y)) - depth
    dx, dy, dz = _turn_back(pair, x * error, y * error, error)
    back = _reprojection(pair, direction, (direction[0] * z + dx, direction[1] * z + dy, z + dz))
    return AGREES, error * inverse, back, dx, dy, dz, j, i


@njit(cache=True, error_model="numpy", inline="always")
def _judge(limits: Limits, off: float, back: float, cosine: float) -> int:
    """The outcome for a depth error in tolerances, a squared reprojection error, and a normal's cosine."""
    if not abs(off) <= 1.0:
        if abs(off) <= 3.0:
            return DEPTH
        return THROUGH if off > 0.0 else OCCLUDED
    if not back <= limits[1] * limits[1]:
        return REPROJECTION
    return AGREES if cosine >= limits[2] else NORMAL


@njit(cache=True, error_model="numpy", nogil=True)
def vote(
    ref: NDArray[np.float32],
    pixels: NDArray[np.int64],
    other: NDArray[np.float32],
    pair: NDArray[np.float64],
    limits: Limits,
    slot: int,
    votes: Votes,
    outcomes: NDArray[np.int64],
) -> None:
    """Let one neighbour, number ``slot`` of the reference, vote on ``pixels`` (M,), flat indices.

    An agreeing view counts with its confidence. Weights that fall with the depth error would draw the
    mean to the reference, whose own error is as large. ``outcomes`` (8,) counts each outcome.
    """
    seen, support, conflicts, weights, shifts, normals, who, cosines = votes
    there = _turn_back(pair, -pair[15], -pair[19], -pair[23])
    width = ref.shape[1]
    word, bit = slot >> 6, np.uint64(1) << np.uint64(slot & 63)
    for m in range(len(pixels)):
        row = pixels[m] // width
        col = pixels[m] - row * width
        outcome, error, back, dx, dy, dz, j, i = _meet(ref, other, pair, row, col)
        if outcome == UNSEEN:
            outcomes[UNSEEN] += 1
            continue
        seen[m] += 1
        if outcome == HOLE:
            outcomes[HOLE] += 1
            continue
        nx, ny, nz = _turn_back(pair, other[j, i, 1], other[j, i, 2], other[j, i, 3])
        cosine = nx * ref[row, col, 1] + ny * ref[row, col, 2] + nz * ref[row, col, 3]
        weight = float(other[j, i, 4])
        off = error / _tolerance(limits, float(ref[row, col, 4]), weight)
        outcome = _judge(limits, off, back, cosine)
        outcomes[outcome] += 1
        if outcome == THROUGH:
            conflicts[m] += 1
        if outcome == AGREES:
            support[m] += 1
            who[m, word] |= bit
            cosines[m] = min(cosines[m], _between(pair, row, col, float(ref[row, col, 0]), there))
            weights[m] += weight
            shifts[m, 0] += weight * dx
            shifts[m, 1] += weight * dy
            shifts[m, 2] += weight * dz
            normals[m, 0] += weight * nx
            normals[m, 1] += weight * ny
            normals[m, 2] += weight * nz


@njit(cache=True, error_model="numpy", nogil=True)
def differences(
    ref: NDArray[np.float32],
    pixels: NDArray[np.int64],
    other: NDArray[np.float32],
    pair: NDArray[np.float64],
    out: NDArray[np.float64],
) -> int:
    """Fill ``out`` (M, 3) with how much a neighbour differs at those of ``pixels`` that it sees.

    The columns are the relative depth error, the reprojection error in pixels, and the angle between
    the normals in radians.

    Returns how many rows were filled.
    """
    width, found = ref.shape[1], 0
    for m in range(len(pixels)):
        row = pixels[m] // width
        col = pixels[m] - row * width
        outcome, error, back, _, _, _, j, i = _meet(ref, other, pair, row, col)
        if outcome != AGREES:
            continue
        nx, ny, nz = _turn_back(pair, other[j, i, 1], other[j, i, 2], other[j, i, 3])
        cosine = nx * ref[row, col, 1] + ny * ref[row, col, 2] + nz * ref[row, col, 3]
        out[found, 0] = abs(error)
        out[found, 1] = np.sqrt(back)
        out[found, 2] = np.arccos(min(max(cosine, -1.0), 1.0))
        found += 1
    return found
