"""Compiled loops of :mod:`colmap_tco.normals`."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

_SMOOTH = 0.005
"""Second difference, relative to the inverse depth, below which both sides count as one surface."""
_TOLERANCE = 0.01
"""Residual to the plane, relative to the inverse depth, at which a pixel's weight falls to a quarter."""


@njit(cache=True, error_model="numpy", inline="always")
def _at(q: NDArray[np.float32], row: int, col: int) -> float:
    """Inverse depth, 0 outside the map."""
    if row < 0 or col < 0 or row >= q.shape[0] or col >= q.shape[1]:
        return 0.0
    return float(q[row, col])


@njit(cache=True, error_model="numpy")
def _side(q0: float, q1: float, q2: float) -> tuple[float, float]:
    """Slope away from the centre over one side, and its weight; a weight of 0 means no pixel there."""
    if q1 <= 0.0:
        return 0.0, 0.0
    if q2 <= 0.0:
        return q1 - q0, 1e-3 / (_SMOOTH * q0) ** 2
    bend = q2 - 2.0 * q1 + q0
    return 0.5 * (q2 - q0), 1.0 / (bend * bend + (_SMOOTH * q0) ** 2)


@njit(cache=True, error_model="numpy")
def _slope(q: NDArray[np.float32], row: int, col: int, down: int, right: int) -> float:
    """Derivative of the inverse depth along one axis, from the side without a discontinuity."""
    q0 = _at(q, row, col)
    after, weight_after = _side(q0, _at(q, row + down, col + right), _at(q, row + 2 * down, col + 2 * right))
    before, weight_before = _side(
        q0, _at(q, row - down, col - right), _at(q, row - 2 * down, col - 2 * right)
    )
    total = weight_after + weight_before
    if total <= 0.0:
        return 0.0
    return (weight_after * after - weight_before * before) / total


@njit(cache=True, error_model="numpy")
def _fit(
    q: NDArray[np.float32], row: int, col: int, plane: tuple[float, float, float], radius: int
) -> tuple[float, float, float, bool]:
    """One reweighted least-squares fit of (value at the pixel, slope along x, along y) to a window."""
    centre, slope_x, slope_y = plane
    scale = 1.0 / (_TOLERANCE * centre)
    s = sx = sy = sq = sxx = sxy = syy = sxq = syq = 0.0
    for dy in range(max(-radius, -row), min(radius, q.shape[0] - 1 - row) + 1):
        for dx in range(max(-radius, -col), min(radius, q.shape[1] - 1 - col) + 1):
            value = float(q[row + dy, col + dx])
            if value <= 0.0:
                continue
            value -= centre
            residual = (value - slope_x * dx - slope_y * dy) * scale
            w = 1.0 / (1.0 + residual * residual)
            w *= w
            s += w
            sx += w * dx
            sy += w * dy
            sq += w * value
            sxx += w * dx * dx
            sxy += w * dx * dy
            syy += w * dy * dy
            sxq += w * dx * value
            syq += w * dy * value
    mx, my, mq = sx / s, sy / s, sq / s
    cxx, cxy, cyy = sxx / s - mx * mx, sxy / s - mx * my, syy / s - my * my
    determinant = cxx * cyy - cxy * cxy
    if s < 1.5 or determinant < 0.01:
        return 0.0, 0.0, 0.0, False
    cxq, cyq = sxq / s - mx * mq, syq / s - my * mq
    a = (cxq * cyy - cyq * cxy) / determinant
    b = (cyq * cxx - cxq * cxy) / determinant
    return centre + mq - a * mx - b * my, a, b, True


@njit(cache=True, error_model="numpy")
def _plane(q: NDArray[np.float32], row: int, col: int, radius: int) -> tuple[float, float, float, bool]:
    """Slopes along x and y and value at the pixel of the local plane, and whether there is one."""
    centre = float(q[row, col])
    if centre <= 0.0:
        return 0.0, 0.0, 0.0, False
    a, b = _slope(q, row, col, 0, 1), _slope(q, row, col, 1, 0)
    ok = True
    for _ in range(2):
        centre, a, b, ok = _fit(q, row, col, (centre, a, b), radius)
        if not ok or centre <= 0.0:
            return 0.0, 0.0, 0.0, False
    return a, b, centre, True


@njit(cache=True, error_model="numpy", nogil=True)
def plane_normals(
    q: NDArray[np.float32],
    intrinsics: NDArray[np.float64],
    radius: int,
    rows: tuple[int, int],
    out: NDArray[np.float32],
) -> None:
    """Fill ``rows`` of ``out`` (H, W, 3) with normals of inverse depths (H, W) under (fx, fy, cx, cy)."""
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for row in range(rows[0], rows[1]):
        for col in range(q.shape[1]):
            out[row, col] = 0.0
            a, b, centre, ok = _plane(q, row, col, radius)
            if not ok:
                continue
            x, y = a * fx, b * fy
            z = centre - a * (col + 0.5 - cx) - b * (row + 0.5 - cy)
            length = -np.sqrt(x * x + y * y + z * z)
            out[row, col, 0] = x / length
            out[row, col, 1] = y / length
            out[row, col, 2] = z / length
