"""Fewer points, evenly in space: one in each cube of a grid.

The grid begins at the smallest coordinates of the cloud, so that moving the model moves the result and
changes nothing else.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from colmap_tco.errors import InputError

_TRIES = 40
"""Sizes of cubes that are tried for a number of points."""
_CLOSE = 0.98
"""Share of the points allowed that is near enough to be taken."""
_FEWEST = 0.9
"""Share of the points allowed below which cubes alone are not enough."""
_MOST_CELLS = 2.0**62
"""Cells of a grid that a 64-bit number still tells apart."""
_SMALLEST = 1e-6
"""Side of a cube, as a share of the cloud's extent, of which any grid has fewer cells than that."""


def thin(points: NDArray[np.float64], voxel_size: float = 0.0, max_points: int = 0) -> NDArray[np.int64]:
    """Indices (M,), ascending, of the points (N, 3) that stay.

    Args:
        points: positions.
        voxel_size: side of the cubes of which each keeps the point nearest to the mean of its points. 0: off.
        max_points: most points that may stay; cubes just large enough are found by interpolation of the
            logarithms of size and number, and bisection where that leaves the bracket. Where no size leaves
            nearly so many, as with points on a lattice, every cube gets more of its own in turn. 0: off.

    Raises:
        InputError: the cubes are too small to be told apart.
    """
    kept = np.arange(len(points))
    if voxel_size > 0 and len(points):
        kept = _nearest(points, _cells(points, voxel_size))
    if max_points > 0 and len(kept) > max_points:
        left = points[kept]
        size, smaller = _sizes_for(left, max_points)
        cell = _cells(left, size)
        few = _nearest(left, cell)
        if len(few) < _FEWEST * max_points:
            few = _more(few, _nearest(left, _cells(left, smaller)), cell, max_points)
        kept = kept[few]
    return kept


def _more(
    few: NDArray[np.int64], many: NDArray[np.int64], cell: NDArray[np.int64], most: int
) -> NDArray[np.int64]:
    """``few`` and as many of ``many`` as are allowed: one more in each cell, then a second one, and so on.

    Of the last round, which is not for all cells, those are taken whose cells are evenly spread in number.
    """
    others = np.setdiff1d(many, few)
    others = others[np.argsort(cell[others], kind="stable")]
    first = np.searchsorted(cell[others], cell[others])  # where the points of the same cell begin
    turn = np.arange(len(others)) - first
    room = most - len(few)
    rounds = np.bincount(turn, minlength=1).cumsum()
    last = int(np.searchsorted(rounds, room, side="right"))
    whole, rest = others[turn < last], others[turn == last]
    left = min(room - len(whole), len(rest))
    part = rest[np.arange(left) * len(rest) // max(left, 1)]
    return np.sort(np.concatenate([few, whole, part]))


def _cells(points: NDArray[np.float64], size: float) -> NDArray[np.int64]:
    """The number (N,) of the cube of each point, from 0 without gaps."""
    low = points.min(0)
    counts = np.floor((points.max(0) - low) / size) + 1
    if counts.prod() > _MOST_CELLS:
        extent = counts.max() * size
        raise InputError(
            f"--voxel_size {size:g} is too small for a cloud of {extent:g} units; give at least "
            f"{extent * _SMALLEST:g}, or 0 to keep all points"
        )
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


def _sizes_for(points: NDArray[np.float64], most: int) -> tuple[float, float]:
    """Sides of cubes: of which at most ``most``, if it can be nearly so many, hold points; of which more do.

    Where no cubes do, as most of the points coincide, the second is that of the smallest tried.
    """
    extent = float((points.max(0) - points.min(0)).max())
    if extent == 0.0:
        return 1.0, 1.0  # all points are one
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
    return best, low
