"""Compiled loops of :mod:`colmap_tco.normals`.

Each step is a plain loop over a tile of pixels of a row, without branches, which the compiler turns into
vector instructions; see :mod:`colmap_tco._vote_kernels`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

TILE = 256
"""Pixels of a tile."""
_SMOOTH = 0.005
"""Second difference, relative to the inverse depth, below which both sides count as one surface."""
_TOLERANCE = 0.01
"""Residual to the plane, relative to the inverse depth, at which a pixel's weight falls to a quarter."""

_CENTRE, _A, _B, _FITS, _S, _SX, _SY, _SQ, _SXX, _SXY, _SYY, _SXQ, _SYQ = range(0, 13 * TILE, TILE)
"""Rows of the scratch of a tile: the plane (value at the pixel, slopes along x and y), whether there is one,
and the weighted sums of the fit."""

Inverse = NDArray[np.float32]
"""Inverse depths with a border, see :func:`bordered`."""
Scratch = NDArray[np.float64]


def border(radius: int) -> int:
    """Width of the border that a fit of this radius needs."""
    return max(radius, 2)


def bordered(inverse: NDArray[np.float32], radius: int) -> Inverse:
    """(H, W) inverse depths in a border of zeros, which are no depths, up to whole tiles."""
    height, width = inverse.shape
    b = border(radius)
    out = np.zeros((height + 2 * b, -(-width // TILE) * TILE + 2 * b), np.float32)
    out[b : b + height, b : b + width] = inverse
    return out


@njit(cache=True, error_model="numpy")
def _side(q0: float, q1: float, q2: float) -> tuple[float, float]:
    """Slope away from the centre over one side, and its weight; a weight of 0 means no pixel there."""
    bend = q2 - 2.0 * q1 + q0
    far = q2 > 0.0
    slope = 0.5 * (q2 - q0) if far else q1 - q0
    weight = (1.0 if far else 1e-3) / ((bend * bend if far else 0.0) + (_SMOOTH * q0) ** 2)
    return (slope, weight) if q1 > 0.0 else (0.0, 0.0)


@njit(cache=True, error_model="numpy")
def _slopes(q: Inverse, row: int, first: int, step: tuple[int, int], w: Scratch, into: int) -> None:
    """Derivatives of the inverse depth along one axis, from the side without a discontinuity."""
    down, right = step
    for m in range(TILE):
        col = first + m
        q0 = float(q[row, col])
        after, weight_after = _side(
            q0, float(q[row + down, col + right]), float(q[row + 2 * down, col + 2 * right])
        )
        before, weight_before = _side(
            q0, float(q[row - down, col - right]), float(q[row - 2 * down, col - 2 * right])
        )
        total = weight_after + weight_before
        w[into + m] = (weight_after * after - weight_before * before) / total if total > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def _sum(q: Inverse, row: int, first: int, radius: int, w: Scratch) -> None:
    """The weighted sums of the fit of a plane to the window around each pixel of a tile."""
    for m in range(_S, _SYQ + TILE):
        w[m] = 0.0
    for j in range(-radius, radius + 1):
        for i in range(-radius, radius + 1):
            dx, dy = float(i), float(j)
            for m in range(TILE):
                value = float(q[row + j, first + i + m])
                there, centre = value > 0.0, w[_CENTRE + m]
                value -= centre
                residual = (value - w[_A + m] * dx - w[_B + m] * dy) * (1.0 / (_TOLERANCE * centre))
                weight = 1.0 / (1.0 + residual * residual)
                weight = weight * weight if there else 0.0
                w[_S + m] += weight
                w[_SX + m] += weight * dx
                w[_SY + m] += weight * dy
                w[_SQ + m] += weight * value
                w[_SXX + m] += weight * dx * dx
                w[_SXY + m] += weight * dx * dy
                w[_SYY + m] += weight * dy * dy
                w[_SXQ + m] += weight * dx * value
                w[_SYQ + m] += weight * dy * value


@njit(cache=True, error_model="numpy")
def _solve(w: Scratch) -> None:
    """The planes of a tile from their sums; none where fewer than three pixels out of line belong to it."""
    for m in range(TILE):
        s = w[_S + m]
        mx, my, mq = w[_SX + m] / s, w[_SY + m] / s, w[_SQ + m] / s
        cxx, cxy, cyy = w[_SXX + m] / s - mx * mx, w[_SXY + m] / s - mx * my, w[_SYY + m] / s - my * my
        cxq, cyq = w[_SXQ + m] / s - mx * mq, w[_SYQ + m] / s - my * mq
        determinant = cxx * cyy - cxy * cxy
        a = (cxq * cyy - cyq * cxy) / determinant
        b = (cyq * cxx - cxq * cxy) / determinant
        centre = w[_CENTRE + m] + mq - a * mx - b * my
        fits = (s >= 1.5) & (determinant >= 0.01) & (centre > 0.0) & (w[_FITS + m] > 0.0)
        w[_CENTRE + m], w[_A + m], w[_B + m], w[_FITS + m] = centre, a, b, 1.0 if fits else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def plane_normals(
    q: Inverse,
    intrinsics: NDArray[np.float64],
    radius: int,
    rows: tuple[int, int],
    out: NDArray[np.float32],
) -> None:
    """Fill ``rows`` of ``out`` (H, W, 3) with normals of inverse depths under (fx, fy, cx, cy).

    The plane is fitted twice by reweighted least squares.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    b, width = max(radius, 2), out.shape[1]
    w = np.empty(_SYQ + TILE)
    for row in range(rows[0], rows[1]):
        for first in range(0, width, TILE):
            _slopes(q, row + b, first + b, (0, 1), w, _A)
            _slopes(q, row + b, first + b, (1, 0), w, _B)
            for m in range(TILE):
                w[_CENTRE + m] = q[row + b, first + b + m]
                w[_FITS + m] = 1.0 if w[_CENTRE + m] > 0.0 else 0.0
            for _ in range(2):
                _sum(q, row + b, first + b, radius, w)
                _solve(w)
            for m in range(min(TILE, width - first)):
                col = first + m
                x, y = w[_A + m] * fx, w[_B + m] * fy
                z = w[_CENTRE + m] - w[_A + m] * (col + 0.5 - cx) - w[_B + m] * (row + 0.5 - cy)
                length = -np.sqrt(x * x + y * y + z * z)
                fits = w[_FITS + m] > 0.0
                out[row, col, 0] = x / length if fits else 0.0
                out[row, col, 1] = y / length if fits else 0.0
                out[row, col, 2] = z / length if fits else 0.0
