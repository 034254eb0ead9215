"""Compiled loops of :mod:`colmap_tco.fusion`: pairs of cameras, and which pixels of a view take part.

They are serial and release the interpreter's lock; :class:`colmap_tco.workers.Workers` runs them on
ranges of pixels.

Coordinates are those of the reference camera, so that large world coordinates cost no precision.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

KEEP, NO_DEPTH, MASKED, LOW_CONFIDENCE, NO_NORMAL, GRAZING, EDGE, FAR, NOT_FINITE = range(9)
"""Why a pixel takes no part, as :func:`filtered` counts it."""

Maps = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]
"""Depth (H, W), normal (H, W, 3), confidence (H, W), and a mask (H, W) or (0, 0) for none. Kernels take
tuples, not classes of ours: numba's cache on disk would name the class, and fail to load once a later
version has renamed it."""

Bounds = tuple[float, float, float, float, float]
"""Least confidence; largest relative second difference of the inverse depth; least cosine between the normal
and the direction to the camera; largest depth; confidence of pixels whose second difference is free."""


def camera(intrinsics: NDArray[np.float64]) -> NDArray[np.float64]:
    """fx, fy, cx, cy, 1/fx, 1/fy of (fx, fy, cx, cy): divisions would take half the time of a comparison."""
    return np.concatenate([intrinsics, 1.0 / intrinsics[:2]])


def pair(
    ref: NDArray[np.float64], other: NDArray[np.float64], other_from_ref: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Two cameras (6,) and the (3, 4) transform between them, row by row, as the loops take them: (24,).

    Arrays alone, because an array that is reached through a tuple inside a loop is counted as in use
    and released there, which takes three times as long as the comparison.
    """
    return np.concatenate([ref, other, other_from_ref.ravel()]).astype(np.float32)


@njit(cache=True, error_model="numpy", inline="always")
def _bends(before: float, centre: float, after: float, most: float) -> bool:
    """Whether the second difference of inverse depth is above ``most`` of the centre's, not divided by it.

    False where a depth is missing.
    """
    product = before * after
    bent = abs(centre * (before + after) - 2.0 * product) > most * product
    return bent & (before > 0.0) & (after > 0.0)


@njit(cache=True, error_model="numpy", inline="always")
def _surface_marks(
    maps: Maps, camera: NDArray[np.float64], least: float, row: int, marks: NDArray[np.uint8]
) -> None:
    """Mark the pixels (W,) of a row by their normal and confidence alone: NO_NORMAL, GRAZING, or KEEP."""
    normal = maps[1]
    cx, over_fx = camera[2], camera[4]
    y = (row + 0.5 - camera[3]) * camera[5]
    for col in range(normal.shape[1]):
        nx, ny, nz = normal[row, col, 0], normal[row, col, 1], normal[row, col, 2]
        x = (col + 0.5 - cx) * over_fx
        grazing = -(nx * x + ny * y + nz) < least * np.sqrt(x * x + y * y + 1.0)
        none = (nx == 0.0) & (ny == 0.0) & (nz == 0.0)
        mark = GRAZING if grazing else KEEP
        marks[col] = NO_NORMAL if none else mark


@njit(cache=True, error_model="numpy", inline="always")
def _depth_marks(maps: Maps, bounds: Bounds, row: int, marks: NDArray[np.uint8]) -> None:
    """Complete the marks (W,) of a row by depth and confidence; the first reason of :data:`KEEP`… counts."""
    depth, _, confidence, _ = maps
    least, bend, _, farthest, sure = bounds
    height, width = depth.shape
    above, below = (row - 1, row + 1) if 0 < row < height - 1 else (row, row)
    for col in range(1, width - 1):
        bent = _bends(depth[row, col - 1], depth[row, col], depth[row, col + 1], bend)
        bent &= confidence[row, col] != sure
        marks[col] = EDGE if bent & (marks[col] == KEEP) else marks[col]
    for col in range(width):
        z, mark = depth[row, col], marks[col]
        bent = _bends(depth[above, col], z, depth[below, col], bend)
        bent &= confidence[row, col] != sure
        mark = EDGE if bent & (mark == KEEP) else mark
        mark = LOW_CONFIDENCE if confidence[row, col] < least else mark
        mark = FAR if z > farthest else mark
        marks[col] = mark if z > 0.0 else NO_DEPTH


@njit(cache=True, error_model="numpy", nogil=True)
def filtered(
    maps: Maps,
    camera: NDArray[np.float64],
    bounds: Bounds,
    rows: tuple[int, int],
    out: NDArray[np.float32],
    counts: NDArray[np.int64],
) -> None:
    """Fill ``rows`` of ``out`` (H, W) with the depths, and with 0 where a pixel takes no part.

    ``counts`` (9,) tells how many pixels have each mark, and how many hold a value that is NOT_FINITE,
    or a confidence that is not above 0.
    """
    depth, normal, confidence, mask = maps
    marks = np.empty(depth.shape[1], np.uint8)
    for row in range(rows[0], rows[1]):
        _surface_marks(maps, camera, bounds[2], row, marks)
        _depth_marks(maps, bounds, row, marks)
        for col in range(depth.shape[1]):
            mark = marks[col]
            if mask.size > 0 and not mask[row, col]:
                mark = np.uint8(MASKED)
            counts[mark] += 1
            z, nx, ny, nz = depth[row, col], normal[row, col, 0], normal[row, col, 1], normal[row, col, 2]
            sure = confidence[row, col]
            # The difference of a number that is not finite to itself is no number.
            wrong = (z - z) + (nx - nx) + (ny - ny) + (nz - nz) != 0.0
            counts[NOT_FINITE] += wrong | ((mark == KEEP) & ((sure <= 0.0) | (sure - sure != 0.0)))
            out[row, col] = z if mark == KEEP else np.float32(0.0)


@njit(cache=True, error_model="numpy", nogil=True)
def free(depth: NDArray[np.float32], taken: NDArray[np.uint8], pixels: NDArray[np.int64]) -> tuple[int, int]:
    """List the pixels (flat indices, ascending) with a depth that are not taken in ``pixels`` (H W,).

    Returns how many these are, and how many pixels have a depth.
    """
    found, valid, width = 0, 0, depth.shape[1]
    for row in range(depth.shape[0]):
        for col in range(width):
            pixels[found] = row * width + col
            there = depth[row, col] > 0.0
            valid += there
            found += there & (taken[row, col] == 0)
    return found, valid
