"""Compiled loops of :mod:`colmap_tco.fusion`: the colours of points, the pixels they cover, and their views.

Points are taken in tiles, as in :mod:`colmap_tco._vote_kernels`: where they lie in the other view is computed
for a whole tile by loops that the compiler turns into vector instructions, and only images and maps are read
and written one by one. Coordinates are those of the reference camera, in single precision.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from colmap_tco._vote_kernels import TILE, Pair

# The rows of the scratch of one tile, as where they begin.
_X, _Y, _Z, _SIZE = (k * TILE for k in range(4))
"""The point in the other view: ray and depth; and how many of that view's pixels are as wide as it."""
_I, _J, _A, _B = (k * TILE for k in range(4, 8))
"""Column and row of a pixel, and the rest of the coordinates."""
_LEFT, _RIGHT, _TOP, _BOTTOM = (k * TILE for k in range(8, 12))
"""First and last columns and rows that the point covers; none where the last is below the first."""
_SCRATCH = 12 * TILE

Scratch = NDArray[np.float32]

_0, _HALF, _1, _2 = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
_REACH = np.float32(0.75)
"""Half the side of the square that a point covers, in pixels of its reference."""


@njit(cache=True, error_model="numpy")
def _move(points: NDArray[np.float32], first: int, count: int, pair: Pair, w: Scratch) -> None:
    """Where the ``count`` points from ``first`` on are in the other view, and how large they are there."""
    a0, a1, a2, a3, b0, b1 = pair[12], pair[13], pair[14], pair[15], pair[16], pair[17]
    b2, b3, c0, c1, c2, c3 = pair[18], pair[19], pair[20], pair[21], pair[22], pair[23]
    wide = pair[4] * pair[6]
    for m in range(count):
        x, y, z = points[0, first + m], points[1, first + m], points[2, first + m]
        depth = c0 * x + c1 * y + c2 * z + c3
        inverse = _1 / depth
        w[_X + m] = (a0 * x + a1 * y + a2 * z + a3) * inverse
        w[_Y + m] = (b0 * x + b1 * y + b2 * z + b3) * inverse
        w[_Z + m] = depth
        w[_SIZE + m] = z * wide * inverse


@njit(cache=True, error_model="numpy")
def _between(count: int, pair: Pair, shape: tuple[int, int], w: Scratch) -> None:
    """The upper left of the four pixels of an image that a point lies between, at most the last but one.

    Clamped to the border, so that what is outside has the colour there.
    """
    fx, fy, cx, cy = pair[6], pair[7], pair[8], pair[9]
    right, bottom = np.float32(shape[1] - 1), np.float32(shape[0] - 1)
    for m in range(count):
        u = min(max(fx * w[_X + m] + cx - _HALF, _0), right)
        v = min(max(fy * w[_Y + m] + cy - _HALF, _0), bottom)
        i, j = np.floor(min(u, right - _1)), np.floor(min(v, bottom - _1))
        i, j = max(i, _0), max(j, _0)
        w[_I + m], w[_J + m], w[_A + m], w[_B + m] = i, j, u - i, v - j


@njit(cache=True, error_model="numpy", nogil=True)
def sample_colors(
    points: NDArray[np.float32],
    who: NDArray[np.uint64],
    bit: np.uint64,
    pair: Pair,
    image: NDArray[np.uint8],
    samples: NDArray[np.uint8],
    count: NDArray[np.uint8],
) -> None:
    """Append the colours of those of ``points`` (3, M) that have ``bit`` in ``who`` (M,) to ``samples``.

    The second camera of ``pair`` is that of ``image``, which may be larger than the maps; it is read
    bilinearly, and clamped to its border. ``samples`` is (tiles, S, 3, TILE). ``count`` (M,) says how many
    there are already; beyond S no more are taken.
    """
    height, width = image.shape[0], image.shape[1]
    most = np.uint8(samples.shape[1])
    beside, below = np.uint32(width > 1), np.uint32(height > 1)
    w = np.empty(_SCRATCH, np.float32)
    for first in range(0, points.shape[1], TILE):
        number = min(TILE, points.shape[1] - first)
        _move(points, first, number, pair, w)
        _between(number, pair, (height, width), w)
        tile = samples[first // TILE]
        for m in range(number):
            n = count[first + m]
            if (who[first + m] & bit) == 0 or n >= most or not w[_Z + m] > _0:
                continue
            i, j, a, b = np.uint32(w[_I + m]), np.uint32(w[_J + m]), w[_A + m], w[_B + m]
            right, lower = i + beside, j + below
            for c in range(3):
                p, q = np.float32(image[j, i, c]), np.float32(image[lower, i, c])
                p += a * (np.float32(image[j, right, c]) - p)
                q += a * (np.float32(image[lower, right, c]) - q)
                tile[n, c, m] = np.uint8(p + b * (q - p) + _HALF)
            count[first + m] = n + np.uint8(1)


@njit(cache=True, error_model="numpy")
def _sort(channel: NDArray[np.uint8]) -> None:
    """Sort the samples (S, TILE) of each point: all points at once, neighbours in turns, S times."""
    for turn in range(len(channel)):
        for n in range(turn % 2, len(channel) - 1, 2):
            # The compiler makes vectors of rows by themselves alone, and of a choice, not of min and max.
            low, high = channel[n], channel[n + 1]
            for m in range(TILE):
                one, other = low[m], high[m]
                low[m] = one if one < other else other
                high[m] = other if one < other else one


@njit(cache=True, error_model="numpy", nogil=True)
def median_colors(samples: NDArray[np.uint8], count: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    """Medians of the first ``count`` (M,) of ``samples`` (tiles, S, 3, TILE) into ``out`` (M, 3)."""
    slots = samples.shape[1]
    channel, counts = np.empty((slots, TILE), np.uint8), np.zeros(TILE, np.uint8)
    for first in range(0, len(out), TILE):
        tile, number = samples[first // TILE], min(TILE, len(out) - first)
        counts[:number] = count[first : first + number]
        for c in range(3):
            for n in range(slots):
                row, last = channel[n], np.uint8(n)
                for m in range(TILE):
                    # What is not there comes last.
                    row[m] = tile[n, c, m] if last < counts[m] else np.uint8(255)
            _sort(channel)
            for m in range(number):
                have = max(np.uint32(counts[m]), np.uint32(1))
                low, high = channel[(have - np.uint32(1)) >> 1, m], channel[have >> 1, m]
                out[first + m, c] = np.uint8((np.uint32(low) + np.uint32(high) + np.uint32(1)) >> 1)


@njit(cache=True, error_model="numpy")
def _cover(count: int, pair: Pair, shape: tuple[int, int], least: np.float32, w: Scratch) -> None:
    """The pixel of the other view that a point falls into, column −1 if none, and those that it covers."""
    fx, fy, cx, cy = pair[6], pair[7], pair[8], pair[9]
    height, width = np.float32(shape[0]), np.float32(shape[1])
    for m in range(count):
        u, v = fx * w[_X + m] + cx, fy * w[_Y + m] + cy
        inside = (w[_Z + m] > _0) & (u >= _0) & (u < width) & (v >= _0) & (v < height)
        reach = max(_REACH * min(w[_SIZE + m], _2), least)
        left, top = np.ceil(u - reach - _HALF), np.ceil(v - reach - _HALF)
        right, bottom = np.floor(u + reach - _HALF), np.floor(v + reach - _HALF)
        w[_I + m], w[_J + m] = np.floor(u) if inside else -_1, np.floor(v)
        w[_LEFT + m], w[_TOP + m] = max(left, _0), max(top, _0)
        w[_RIGHT + m], w[_BOTTOM + m] = min(right, width - _1), min(bottom, height - _1)


@njit(cache=True, error_model="numpy", nogil=True)
def mark_taken(
    points: NDArray[np.float32],
    who: NDArray[np.uint64],
    bit: np.uint64,
    depth: NDArray[np.float32],
    pair: Pair,
    limits: tuple[float, float],
    taken: NDArray[np.uint8],
) -> None:
    """Set ``taken`` (H, W) at the pixels of another view that those of ``points`` (3, M) with ``bit`` cover.

    A point covers what its pixel in the reference does. The pixels of the other view whose centres lie
    within that square, widened by half so that no gap remains between the squares of neighbours, are the
    same surface seen again; a view that sees it finer than two to one keeps the rest of its pixels, for
    they add detail. Threads may set the same pixel to the same 1.

    ``depth`` (H, W) is that of the other view. ``limits``: relative depth error, and pixels that a point
    covers at least on each side; if these are 0, the pixel that a point falls into is the same surface
    whatever its depth.
    """
    depth_error, least = np.float32(limits[0]), np.float32(limits[1])
    w = np.empty(_SCRATCH, np.float32)
    for first in range(0, points.shape[1], TILE):
        number = min(TILE, points.shape[1] - first)
        _move(points, first, number, pair, w)
        _cover(number, pair, taken.shape, least, w)
        for m in range(number):
            if (who[first + m] & bit) == 0 or w[_I + m] < _0:
                continue
            if least == _0:
                taken[np.uint32(w[_J + m]), np.uint32(w[_I + m])] = 1
            z = w[_Z + m]
            off, left, right = depth_error * z, np.int32(w[_LEFT + m]), np.int32(w[_RIGHT + m])
            for j in range(np.int32(w[_TOP + m]), np.int32(w[_BOTTOM + m]) + 1):
                for i in range(left, right + 1):
                    if abs(depth[j, i] - z) <= off:
                        taken[j, i] = 1


@njit(cache=True, error_model="numpy", nogil=True)
def list_views(
    who: NDArray[np.uint64],
    slots: NDArray[np.int64],
    indices: NDArray[np.uint32],
    own: tuple[int, int],
    images: NDArray[np.uint32],
) -> None:
    """Fill ``images`` with the views that agree on each point and the reference, in ascending order.

    Args:
        who: (words, M) one bit for each neighbour that agrees.
        slots: the neighbours in ascending order of their index.
        indices: of the neighbours, by slot.
        own: how many of ``slots`` come before the reference, and its index.
        images: all lists, one after the other.
    """
    before, index = own
    at = 0
    for k in range(who.shape[1]):
        for s in range(len(slots) + 1):
            if s == before:
                images[at] = index
                at += 1
            if s < len(slots) and (who[slots[s] >> 6, k] >> np.uint64(slots[s] & 63)) & np.uint64(1):
                images[at] = indices[slots[s]]
                at += 1
