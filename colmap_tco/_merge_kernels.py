"""Compiled loops of :mod:`colmap_tco.fusion`: the colours of points, the pixels they cover, and their views.

Coordinates are those of the reference camera, as in :mod:`colmap_tco._fusion_kernels`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from colmap_tco._fusion_kernels import move


@njit(cache=True, error_model="numpy", nogil=True)
def agreeing(who: NDArray[np.uint64], kept: NDArray[np.int64], bit: np.uint64, out: NDArray[np.int64]) -> int:
    """List in ``out`` which of the points have ``bit`` set in ``who`` at ``kept`` (M,); returns how many."""
    found = 0
    for k in range(len(kept)):
        out[found] = k
        found += (who[kept[k]] & bit) != 0
    return found


@njit(cache=True, error_model="numpy", nogil=True)
def sample_colors(
    points: NDArray[np.float32],
    chosen: NDArray[np.int64],
    pair: NDArray[np.float64],
    image: NDArray[np.uint8],
    samples: NDArray[np.uint8],
    count: NDArray[np.uint8],
) -> None:
    """Append the colours of the ``chosen`` of ``points`` (M, 3) to ``samples`` (M, S, 3).

    The second camera of ``pair`` is that of ``image``, which may be larger than the maps; it is read
    bilinearly, and clamped to its border. ``count`` (M,) says how many samples there are already; beyond
    S no more are taken.
    """
    height, width = image.shape[0], image.shape[1]
    fx, fy, cx, cy = pair[6], pair[7], pair[8] - 0.5, pair[9] - 0.5
    right, bottom = width - 1.0, height - 1.0
    for k in chosen:
        n = count[k]
        if n >= samples.shape[1]:
            continue
        x, y, z = move(pair, points[k, 0], points[k, 1], points[k, 2])
        if z <= 0.0:
            continue
        inverse = 1.0 / z
        u, v = min(max(fx * (x * inverse) + cx, 0.0), right), min(max(fy * (y * inverse) + cy, 0.0), bottom)
        i, j = np.uint64(u), np.uint64(v)
        a, b = u - np.float64(i), v - np.float64(j)
        beside, below = (
            min(i + np.uint64(1), np.uint64(width - 1)),
            min(j + np.uint64(1), np.uint64(height - 1)),
        )
        for c in range(3):
            top = (1.0 - a) * image[j, i, c] + a * image[j, beside, c]
            base = (1.0 - a) * image[below, i, c] + a * image[below, beside, c]
            samples[k, n, c] = np.uint8((1.0 - b) * top + b * base + 0.5)
        count[k] = n + 1


@njit(cache=True, error_model="numpy")
def _sort(samples: NDArray[np.uint8], m: int, n: int, c: int) -> None:
    """Sort channel c of the first n samples of point m, by insertion: n is small."""
    for k in range(1, n):
        value = samples[m, k, c]
        at = k
        while at > 0 and samples[m, at - 1, c] > value:
            samples[m, at, c] = samples[m, at - 1, c]
            at -= 1
        samples[m, at, c] = value


@njit(cache=True, error_model="numpy", nogil=True)
def median_colors(samples: NDArray[np.uint8], count: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    """Median of the first ``count`` (M,) of ``samples`` (M, S, 3) for each channel, into ``out`` (M, 3).

    The samples are left in another order.
    """
    for m in range(len(out)):
        n = np.int64(count[m])
        for c in range(3):
            _sort(samples, m, n, c)
            low, high = np.int64(samples[m, (n - 1) // 2, c]), np.int64(samples[m, n // 2, c])
            out[m, c] = np.uint8((low + high + 1) // 2)


@njit(cache=True, error_model="numpy", nogil=True)
def mark_taken(
    points: NDArray[np.float32],
    chosen: NDArray[np.int64],
    other: NDArray[np.float32],
    pair: NDArray[np.float64],
    limits: tuple[float, float],
    taken: NDArray[np.uint8],
) -> None:
    """Set ``taken`` (H, W) at the pixels of another view that the ``chosen`` of ``points`` (M, 3) cover.

    A point covers what its pixel in the reference does. The pixels of the other view whose centres lie
    within that square, widened by half so that no gap remains between the squares of neighbours, are the
    same surface seen again; a view that sees it finer than two to one keeps the rest of its pixels, for
    they add detail. Threads may set the same pixel to the same 1.

    ``limits``: relative depth error, and pixels that a point covers at least on each side; if these are 0,
    the pixel that a point falls into is the same surface whatever its depth.
    """
    height, width = taken.shape
    depth_error, least = limits
    for k in chosen:
        x, y, z = move(pair, points[k, 0], points[k, 1], points[k, 2])
        inverse = 1.0 / z
        u, v = pair[6] * (x * inverse) + pair[8], pair[7] * (y * inverse) + pair[9]
        if z <= 0.0 or not (0.0 <= u < width and 0.0 <= v < height):
            continue
        if least == 0.0:
            taken[int(v), int(u)] = 1
        reach, off = 0.75 * min(points[k, 2] * pair[4] * pair[6] * inverse, 2.0), depth_error * z
        reach = max(reach, least)
        first, last = max(int(np.ceil(u - reach - 0.5)), 0), min(int(u + reach - 0.5), width - 1)
        for j in range(max(int(np.ceil(v - reach - 0.5)), 0), min(int(v + reach - 0.5), height - 1) + 1):
            for i in range(first, last + 1):
                if taken[j, i] == 0 and abs(other[j, i, 0] - z) <= off:
                    taken[j, i] = 1


@njit(cache=True, error_model="numpy", nogil=True)
def list_views(
    who: NDArray[np.uint64],
    kept: NDArray[np.int64],
    slots: NDArray[np.int64],
    indices: NDArray[np.uint32],
    own: tuple[int, int],
    images: NDArray[np.uint32],
) -> None:
    """Fill ``images`` with the views that agree on each point (M,) and the reference, in ascending order.

    Args:
        who: (words, pixels) one bit for each neighbour that agrees.
        kept: (M,) pixels of the points.
        slots: the neighbours in ascending order of their index.
        indices: of the neighbours, by slot.
        own: how many of ``slots`` come before the reference, and its index.
        images: all lists, one after the other.
    """
    before, index = own
    at = 0
    for k in kept:
        for s in range(len(slots) + 1):
            if s == before:
                images[at] = index
                at += 1
            if s < len(slots) and (who[slots[s] >> 6, k] >> np.uint64(slots[s] & 63)) & np.uint64(1):
                images[at] = indices[slots[s]]
                at += 1
