"""Fewer points, evenly in space: one in each cube of a grid.

The grid begins at the smallest coordinates of the cloud, so that moving the model moves the result and
changes nothing else.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_TRIES = 40
"""Sizes of cubes that are tried for a number of points."""
_CLOSE = 0.98
"""Share of the points allowed that is near enough to be taken."""
_MOST_CELLS = 2.0**62
"""Cells of a grid that a 64-bit number still tells apart."""


def thin(points: NDArray[np.float64], voxel_size: float = 0.0, max_points: int = 0) -> NDArray[np.int64]:
    """Indices (M,), ascending, of the points (N, 3) that stay.

    Args:
        points: positions.
        voxel_size: side of the cubes of which each keeps the point nearest to the mean of its points. 0: off.
        max_points: most points that may stay; cubes just large enough are found by interpolation of the
            logarithms of size and number, and bisection where that leaves the bracket. 0: off.

    Raises:
        ValueError: the cubes are too small to be told apart.
    """
    kept = np.arange(len(points))
    if voxel_size > 0 and len(points):
        kept = _nearest(points, _cells(points, voxel_size))
    if max_points > 0 and len(kept) > max_points:
        left = points[kept]
        kept = kept[_nearest(left, _cells(left, _size_for(left, max_points)))]
    return kept


def _cells(points: NDArray[np.float64], size: float) -> NDArray[np.int64]:
    """The number (N,) of the cube of each point, from 0 without gaps."""
    low = points.min(0)
    counts = np.floor((points.max(0) - low) / size) + 1
    if counts.prod() > _MOST_CELLS:
        raise ValueError(f"voxel_size {size:g} is too small for a cloud of {counts.max() * size:g} units")
    grid = np.floor((points - low) / size).astype(np.int64)
    shape = counts.astype(np.int64)
    flat = (grid[:, 0] * shape[1] + grid[:, 1]) * shape[2] + grid[:, 2]
    return np.unique(flat, return_inverse=True)[1].reshape(-1)


def _nearest(points: NDArray[np.float64], cell: NDArray[np.int64]) -> NDArray[np.int64]:
    """Of each cell the point nearest to the mean of the cell's points; the first of equals."""
    count = np.bincount(cell)
    local = points - points.min(0)
    mean = np.stack([np.bincount(cell, axis) / count for axis in local.T], 1)
    distance = ((local - mean[cell]) ** 2).sum(1)
    order = np.lexsort((np.arange(len(cell)), distance, cell))
    first = np.searchsorted(cell[order], np.arange(len(count)))
    return np.sort(order[first])


def _size_for(points: NDArray[np.float64], most: int) -> float:
    """Side of cubes of which at most ``most``, and if it can be nearly so many, hold points."""
    extent = float((points.max(0) - points.min(0)).max())
    if extent == 0.0:
        return 1.0  # all points are one
    high, at_high = 2 * extent, 1.0
    low, at_low = extent / 2**19, float(len(points))
    best = high
    for attempt in range(_TRIES):
        # ln(number) falls nearly linearly with ln(size); every other try halves, so that brackets shrink.
        share = (math.log(at_low) - math.log(most)) / max(math.log(at_low) - math.log(at_high), 1e-9)
        share = min(max(share, 0.02), 0.98) if attempt % 2 == 0 else 0.5
        size = math.exp(math.log(low) + share * (math.log(high) - math.log(low)))
        number = int(_cells(points, size).max()) + 1
        if number <= most:
            high, at_high, best = size, float(number), size
            if number >= _CLOSE * most:
                break
        else:
            low, at_low = size, float(number)
        if high / low < 1 + 1e-6:
            break
    return best
