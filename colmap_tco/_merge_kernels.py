"""Compiled loops of :mod:`colmap_tco.fusion`: points, their colours, and the pixels they cover.

Coordinates are those of the reference camera, as in :mod:`colmap_tco._fusion_kernels`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from colmap_tco._fusion_kernels import Votes, move, ray


@njit(cache=True, error_model="numpy", nogil=True)
def average(
    ref: NDArray[np.float32],
    camera: NDArray[np.float64],
    pixels: NDArray[np.int64],
    votes: Votes,
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
) -> None:
    """Fill ``points`` and ``normals`` (M, 3) of the reference frame with the weighted means of the votes."""
    _, _, _, weights, shifts, theirs, _, _ = votes
    width = ref.shape[1]
    for m in range(len(pixels)):
        row = pixels[m] // width
        col = pixels[m] - row * width
        x, y = ray(camera, row, col)
        z = float(ref[row, col, 0])
        own = float(ref[row, col, 4])
        scale = 1.0 / (own + weights[m])
        points[m, 0] = x * z + shifts[m, 0] * scale
        points[m, 1] = y * z + shifts[m, 1] * scale
        points[m, 2] = z + shifts[m, 2] * scale
        length = 0.0
        for axis in range(3):
            normals[m, axis] = own * ref[row, col, 1 + axis] + theirs[m, axis]
            length += normals[m, axis] ** 2
        length = np.sqrt(length)
        for axis in range(3):
            normals[m, axis] /= length


@njit(cache=True, error_model="numpy")
def _bilinear(image: NDArray[np.uint8], u: float, v: float, out: NDArray[np.uint8]) -> None:
    """RGB of ``image`` at (u, v), clamped to the border, into ``out`` (3,)."""
    height, width = image.shape[0], image.shape[1]
    u, v = min(max(u - 0.5, 0.0), width - 1.0), min(max(v - 0.5, 0.0), height - 1.0)
    i, j = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
    a, b = u - i, v - j
    right, below = min(i + 1, width - 1), min(j + 1, height - 1)
    for c in range(3):
        top = (1.0 - a) * image[j, i, c] + a * image[j, right, c]
        bottom = (1.0 - a) * image[below, i, c] + a * image[below, right, c]
        out[c] = np.uint8((1.0 - b) * top + b * bottom + 0.5)


@njit(cache=True, error_model="numpy", nogil=True)
def sample_colors(
    points: NDArray[np.float32],
    who: NDArray[np.bool_],
    pair: NDArray[np.float64],
    image: NDArray[np.uint8],
    samples: NDArray[np.uint8],
    count: NDArray[np.uint8],
) -> None:
    """Append the colour of each of ``points`` (M, 3) that ``who`` (M,) selects to ``samples`` (M, S, 3).

    The second camera of ``pair`` is that of ``image``, which may be larger than the maps. ``count``
    (M,) says how many samples there are already; beyond S no more are taken.
    """
    for m in range(len(points)):
        if not who[m] or count[m] >= samples.shape[1]:
            continue
        x, y, z = move(pair, points[m, 0], points[m, 1], points[m, 2])
        if z <= 0.0:
            continue
        u, v = pair[6] * x / z + pair[8], pair[7] * y / z + pair[9]
        _bilinear(image, u, v, samples[m, count[m]])
        count[m] += 1


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
    who: NDArray[np.bool_],
    footprint: NDArray[np.float32],
    other: NDArray[np.float32],
    pair: NDArray[np.float64],
    depth_error: float,
    taken: NDArray[np.uint8],
) -> None:
    """Set ``taken`` (H, W) at the pixels of another view that ``points`` (M, 3) have been made of.

    A point covers ``footprint`` (M,) units of length, the size of its pixel in the reference. The
    pixels of the other view whose centres lie within that square, widened by half so that no gap
    remains between the squares of neighbours, are the same surface seen again; a view that sees it
    finer than two to one keeps the rest of its pixels, for they add detail. Threads may set the
    same pixel to the same 1.
    """
    height, width = taken.shape
    for m in range(len(points)):
        if not who[m]:
            continue
        x, y, z = move(pair, points[m, 0], points[m, 1], points[m, 2])
        u, v = pair[6] * x / z + pair[8], pair[7] * y / z + pair[9]
        if z <= 0.0 or not (0.0 <= u < width and 0.0 <= v < height):
            continue
        taken[int(v), int(u)] = 1
        reach = 0.75 * min(footprint[m] * pair[6] / z, 2.0)
        for j in range(max(int(np.ceil(v - reach - 0.5)), 0), min(int(v + reach - 0.5), height - 1) + 1):
            for i in range(max(int(np.ceil(u - reach - 0.5)), 0), min(int(u + reach - 0.5), width - 1) + 1):
                if abs(other[j, i, 0] - z) <= depth_error * z:
                    taken[j, i] = 1


@njit(cache=True, error_model="numpy", nogil=True)
def list_views(
    who: NDArray[np.uint64],
    slots: NDArray[np.int64],
    indices: NDArray[np.uint32],
    own: tuple[int, int],
    start: NDArray[np.int64],
    images: NDArray[np.uint32],
) -> None:
    """Fill ``images`` with the views that agree on each point (M,) and the reference, in ascending order.

    Args:
        who: (M, words) one bit for each neighbour that agrees.
        slots: the neighbours in ascending order of their index.
        indices: of the neighbours, by slot.
        own: how many of ``slots`` come before the reference, and its index.
        start: (M + 1,) where the list of each point begins.
        images: all lists.
    """
    before, index = own
    for m in range(len(who)):
        at = start[m]
        for k in range(len(slots) + 1):
            if k == before:
                images[at] = index
                at += 1
            if k < len(slots) and (who[m, slots[k] >> 6] >> np.uint64(slots[k] & 63)) & np.uint64(1):
                images[at] = indices[slots[k]]
                at += 1
