"""Compiled loops of :mod:`colmap_tco.fusion`: where the votes on a pixel put its point, and how it is turned.

A vote within the tolerance may still be wrong, for the tolerance is that of the whole scene. So the mean
is taken of all votes, then twice again with weights w / (1 + (e / width)²), where e is how far a vote is
from the mean before, and the width that of the noise: a tenth is left of what one wrong vote among five does
to a mean. To good votes these weights are nearly even and cost their mean some 4 % of its efficiency; a
median would cost more, and sorting.

How far votes are apart is measured along the normal of the reference, in which direction alone they say
where the surface is, and relative to the distance of the voting camera from the tangent plane, for a near
camera errs by less. Loops run over tiles, in single precision, as in :mod:`colmap_tco._vote_kernels`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from colmap_tco._vote_kernels import (
    COL,
    CONFIDENCE,
    NX,
    OFF,
    ROW,
    TILE,
    TURNED,
    VOTE_SIZE,
    WEIGHT,
    Tiles,
    Votes,
    Z,
)  # fmt: skip

Points = tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float32]]
"""M points: (3, M) in the frame of the reference, (M, 3) in that of the model, normals (M, 3) there."""

# The rows of the scratch of one tile, as where they begin.
_H, _MEAN, _TOTAL, _MOVED, _TURN, _NORMAL, _BY, _FROM = (k * TILE for k in (0, 1, 2, 3, 4, 7, 10, 11))
"""Distance of the reference from the tangent plane, less than 0; mean of how far the votes move the point
along the normal; sum of the weights and, so weighted, of these ways; mean normal and its next sum (three
rows each); weighted sums of the relative errors and of these times the voter's centre (three rows): the way
to a voter's surface is (point − centre) · error."""
_SCRATCH = 14 * TILE
_ONE, _TINY = np.float32(1.0), np.float32(1e-30)
_REWEIGHTED = 2

Numbers = NDArray[np.float32]


@njit(cache=True, error_model="numpy", inline="always")
def _start(tile: Numbers, camera: NDArray[np.float64], w: Numbers) -> None:
    """Distances from the tangent planes; and no width yet: where the reference is, with weight 0."""
    half = np.float32(0.5)
    cx, cy, ifx, ify = (
        np.float32(camera[2]), np.float32(camera[3]), np.float32(camera[4]), np.float32(camera[5])
    )  # fmt: skip
    for m in range(TILE):
        x, y = (tile[COL + m] + half - cx) * ifx, (tile[ROW + m] + half - cy) * ify
        slope = x * tile[NX + m] + y * tile[NX + TILE + m] + tile[NX + 2 * TILE + m]
        w[_H + m] = tile[Z + m] * slope
        w[_MEAN + m] = np.float32(0.0)
    for m in range(3 * TILE):
        w[_TURN + m] = tile[NX + m]


@njit(cache=True, error_model="numpy", inline="always")
def _own(tile: Numbers, sharp: Numbers, w: Numbers) -> None:
    """Begin all sums with the vote of the reference."""
    place, turn = sharp[0], sharp[1]
    for m in range(TILE):
        h, mean = w[_H + m] * w[_H + m] + _TINY, w[_MEAN + m]
        w[_TOTAL + m] = tile[CONFIDENCE + m] * h / (h + place * mean * mean)
        w[_MOVED + m] = np.float32(0.0)
        x, y = tile[NX + m] - w[_TURN + m], tile[NX + TILE + m] - w[_TURN + TILE + m]
        z = tile[NX + 2 * TILE + m] - w[_TURN + 2 * TILE + m]
        weight = tile[CONFIDENCE + m] / (_ONE + turn * (x * x + y * y + z * z))
        w[_NORMAL + m] = weight * tile[NX + m]
        w[_NORMAL + TILE + m] = weight * tile[NX + TILE + m]
        w[_NORMAL + 2 * TILE + m] = weight * tile[NX + 2 * TILE + m]
    for m in range(4 * TILE):
        w[_BY + m] = np.float32(0.0)


@njit(cache=True, error_model="numpy", inline="always")
def _add_place(
    tile: Numbers, votes: Numbers, at: int, centre: Numbers, place: np.float32, w: Numbers
) -> None:
    """Add where a neighbour sees the surface, by how far that is from the mean; its votes begin ``at``."""
    a, b, c = centre[0], centre[1], centre[2]
    for m in range(TILE):
        away = a * tile[NX + m] + b * tile[NX + TILE + m] + c * tile[NX + 2 * TILE + m]
        distance, error = w[_H + m] - away, votes[at + OFF + m]
        way = error * distance
        apart, square = way - w[_MEAN + m], distance * distance + _TINY
        weight = votes[at + WEIGHT + m] * square / (square + place * apart * apart)
        by = weight * error
        w[_TOTAL + m] += weight
        w[_MOVED + m] += weight * way
        w[_BY + m] += by
        w[_FROM + m] += by * a
        w[_FROM + TILE + m] += by * b
        w[_FROM + 2 * TILE + m] += by * c


@njit(cache=True, error_model="numpy", inline="always")
def _add_normal(votes: Numbers, at: int, turn: np.float32, w: Numbers) -> None:
    """Add the normal that a neighbour sees, by how far that is from the mean; its votes begin ``at``."""
    for m in range(TILE):
        x, y, z = (
            votes[at + TURNED + m], votes[at + TURNED + TILE + m], votes[at + TURNED + 2 * TILE + m]
        )  # fmt: skip
        p, q, r = x - w[_TURN + m], y - w[_TURN + TILE + m], z - w[_TURN + 2 * TILE + m]
        weight = votes[at + WEIGHT + m] / (_ONE + turn * (p * p + q * q + r * r))
        w[_NORMAL + m] += weight * x
        w[_NORMAL + TILE + m] += weight * y
        w[_NORMAL + 2 * TILE + m] += weight * z


@njit(cache=True, error_model="numpy", inline="always")
def _means(tile: Numbers, votes: Numbers, centres: Numbers, sharp: Numbers, w: Numbers) -> None:
    """The next means, from all votes on a tile and the means before."""
    _own(tile, sharp, w)
    for s in range(len(centres)):
        _add_place(tile, votes, s * VOTE_SIZE, centres[s], sharp[0], w)
        _add_normal(votes, s * VOTE_SIZE, sharp[1], w)
    for m in range(TILE):
        w[_MEAN + m] = w[_MOVED + m] / w[_TOTAL + m]
        x, y, z = w[_NORMAL + m], w[_NORMAL + TILE + m], w[_NORMAL + 2 * TILE + m]
        scale = _ONE / np.sqrt(x * x + y * y + z * z)
        w[_TURN + m], w[_TURN + TILE + m], w[_TURN + 2 * TILE + m] = x * scale, y * scale, z * scale


@njit(cache=True, error_model="numpy", nogil=True)
def average(
    tiles: Tiles,
    votes: Votes,
    kept: NDArray[np.int64],
    camera: NDArray[np.float64],
    pose: NDArray[np.float64],
    centres: NDArray[np.float32],
    widths: tuple[float, float],
    out: Points,
) -> None:
    """Fill ``out`` with the robust means of the votes on the pixels ``kept`` (M,), ascending, of ``tiles``.

    Args:
        tiles: the pixels.
        votes: of the neighbours on them.
        kept: numbers of pixels.
        camera: (6,) of the reference.
        pose: (4, 3) the rotation of its cam_from_world and, in the last row, its position.
        centres: (slots, 3) positions of the neighbours in its frame.
        widths: relative depth error, and angle in radians, at which a vote has half its weight.
        out: is filled.
    """
    w, sharp, at = np.empty(_SCRATCH, np.float32), np.zeros(2, np.float32), -1
    for k in range(len(kept)):
        tile = tiles[kept[k] // TILE]
        if kept[k] // TILE != at:
            at = kept[k] // TILE
            _start(tile, camera, w)
            sharp[0], sharp[1] = 0.0, 0.0
            _means(tile, votes[at], centres, sharp, w)
            sharp[0], sharp[1] = 1.0 / (widths[0] * widths[0]), 1.0 / (widths[1] * widths[1])
            for _ in range(_REWEIGHTED):
                _means(tile, votes[at], centres, sharp, w)
        _place(tile, kept[k] % TILE, w, camera, pose, k, out)


@njit(cache=True, error_model="numpy", inline="always")
def _place(
    tile: Numbers,
    m: int,
    w: Numbers,
    camera: NDArray[np.float64],
    pose: NDArray[np.float64],
    k: int,
    out: Points,
) -> None:
    """Write point and normal k of ``out``, of the means at pixel m of a tile."""
    local, points, normals = out
    z, scale, by = float(tile[Z + m]), 1.0 / float(w[_TOTAL + m]), float(w[_BY + m])
    x = (float(tile[COL + m]) + 0.5 - camera[2]) * camera[4] * z
    y = (float(tile[ROW + m]) + 0.5 - camera[3]) * camera[5] * z
    x += (x * by - w[_FROM + m]) * scale
    y += (y * by - w[_FROM + TILE + m]) * scale
    z += (z * by - w[_FROM + 2 * TILE + m]) * scale
    local[0, k], local[1, k], local[2, k] = x, y, z
    a, b, c = float(w[_TURN + m]), float(w[_TURN + TILE + m]), float(w[_TURN + 2 * TILE + m])
    for axis in range(3):
        points[k, axis] = x * pose[0, axis] + y * pose[1, axis] + z * pose[2, axis] + pose[3, axis]
        normals[k, axis] = a * pose[0, axis] + b * pose[1, axis] + c * pose[2, axis]
