"""Compiled loops of :mod:`tco.planar.label` and :mod:`tco.planar.fit`: how pixels stand to planes.

In float32, but for sums by colour, and a plane at a time, so that many pixels share an instruction.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tco._elementary import exp, log

Floats = NDArray[np.float32]
Labels = NDArray[np.int64]
f32 = np.float32
ZERO, HALF, ONE, LEAST = f32(0), f32(0.5), f32(1), f32(1e-6)
FARTHEST = f32(1e15)
"""Depth of a plane up to which its square is a number."""


@njit(nogil=True, cache=True, fastmath={"nsz", "reassoc", "contract"}, error_model="numpy")
def on_own_depth(
    view: Floats, planes: Floats, weights: tuple[Any, Any], cost: Floats, logs: Floats, near: Floats
) -> None:
    """Costs by depth and by how well the plane is known, of N pixels and K planes.

    Args:
        view: (7, N) direction of the ray (3), depth, 0 where none counts, its logarithm, width at which a
            departure costs half, width at which a pixel is near.
        planes: (K, 16) normal (3); its offset as seen from the camera; what gives the plane's errors, by
            column: directions (3, 3), offsets (3).
        weights: most that a departure costs; cost of the square of the plane's relative error.
        cost: (K, N) result, infinite where there is no depth or the plane is behind the camera.
        logs: (K, N) result, logarithm of the plane's depth, 0 there.
        near: (K, N) result, how much a pixel is on the plane by its own depth, 0 to 1.
    """
    trust, doubt = weights
    for k in range(len(planes)):
        p = planes[k]
        for i in range(view.shape[1]):
            x, y, z = view[0, i], view[1, i], view[2, i]
            along = x * p[0] + y * p[1] + z * p[2]
            depth = p[3] / along
            there = (depth > ZERO) & (depth < FARTHEST) & (view[3, i] > ZERO)
            depth = depth if there else ONE
            log_depth = log(depth)
            off = log_depth - view[4, i]
            apart = (off / view[5, i]) * (off / view[5, i])
            u = depth * (x * p[4] + y * p[5] + z * p[6]) + p[13]
            v = depth * (x * p[7] + y * p[8] + z * p[9]) + p[14]
            w = depth * (x * p[10] + y * p[11] + z * p[12]) + p[15]
            across = max(abs(along), LEAST) * max(depth, LEAST)
            own = trust * apart / (ONE + apart) + doubt * ((u * u + v * v + w * w) / (across * across))
            close = off / view[6, i]
            cost[k, i] = own if there else f32(np.inf)
            logs[k, i] = log_depth if there else ZERO
            near[k, i] = exp(-HALF * close * close) if there else ZERO


@njit(nogil=True, cache=True)
def histograms(colours: Labels, weights: Floats, near: Floats, counts: NDArray[np.float64]) -> None:
    """Add weights (N,) times nearness (K, N), if it is worth it, to ``counts`` (K, bins) of each colour."""
    for k in range(len(near)):
        for i in range(len(colours)):
            if near[k, i] > LEAST:
                counts[k, colours[i]] += weights[i] * near[k, i]


@njit(nogil=True, cache=True)
def add_by_colour(colours: Labels, rare: Floats, most: Any, cost: Floats) -> None:
    """Add a cost by colour (K, bins) to the costs (K, N) of N pixels, none above ``most``."""
    for k in range(len(cost)):
        for i in range(len(colours)):
            cost[k, i] = min(cost[k, i] + rare[k, colours[i]], most)


@njit(nogil=True, cache=True, fastmath={"nsz", "reassoc", "contract"}, error_model="numpy")
def votes(pixels: Floats, planes: Floats, grazing: Any, found: Floats) -> None:
    """Sum of the weights of the pixels that are on a plane, by place and by normal.

    Args:
        pixels: (12, N) point (3), normal (3), direction of the ray (3), distance along a ray of cosine one
            within which it is on a plane, least cosine between the normals, weight.
        planes: (P, 4) normal (3), offset.
        grazing: least cosine between ray and normal that is reckoned with.
        found: (P,) result.
    """
    for k in range(len(planes)):
        a, b, c, d = planes[k]
        total = ZERO
        for i in range(pixels.shape[1]):
            far = abs(pixels[0, i] * a + pixels[1, i] * b + pixels[2, i] * c - d)
            same = pixels[3, i] * a + pixels[4, i] * b + pixels[5, i] * c
            along = abs(pixels[6, i] * a + pixels[7, i] * b + pixels[8, i] * c)
            on = (far < pixels[9, i] * max(along, grazing)) & (same > pixels[10, i])
            total += pixels[11, i] if on else ZERO
        found[k] = total
