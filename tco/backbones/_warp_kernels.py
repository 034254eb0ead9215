"""Compiled loops of the plane sweep on a CPU: warping and correlation in one pass, and its gradient.

Arrays are flat; a feature map is (V, h, w, C) with channels last. Channel c belongs to group c % G, so
that the sum over a group runs over whole vectors. Channels and groups are constants of the compiled
code, without which the compiler would not unroll it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Kernel = Callable[..., None]


class Geometry(NamedTuple):
    """What is compared with what.

    Attributes:
        pairs: (B, 2) reference and source. matrices: (B, 12). planes: hypotheses.
    """

    pairs: NDArray[np.int64]
    matrices: Floats
    planes: Floats


class Layout(NamedTuple):
    """Sizes, and distances between neighbours in the flat planes (p·) and in the flat output (o·)."""

    h: int
    w: int
    depth: int
    pb: int
    pd: int
    py: int
    px: int
    ob: int
    od: int
    oy: int
    ox: int


@njit(nogil=True, cache=True, fastmath=True, inline="always")
def _project(m: Floats, x: int, y: int, inverse: float) -> tuple[float, float, float]:
    """Pixel of the source, in units from the centre of its first pixel, and depth times inverse depth."""
    px, py = x + 0.5, y + 0.5
    z = m[8] * px + m[9] * py + m[10] + m[11] * inverse
    safe = max(z, 1e-4)
    u = (m[0] * px + m[1] * py + m[2] + m[3] * inverse) / safe - 0.5
    v = (m[4] * px + m[5] * py + m[6] + m[7] * inverse) / safe - 0.5
    return u, v, z


@njit(nogil=True, cache=True, fastmath=True, inline="always")
def _seen(u: float, v: float, z: float, h: int, w: int) -> bool:
    return z > 1e-3 and u >= -0.5 and v >= -0.5 and u <= w - 0.5 and v <= h - 0.5


@njit(nogil=True, cache=True, fastmath=True, inline="always")
def _taps(u: float, v: float, h: int, w: int) -> tuple[tuple[int, ...], tuple[Any, ...]]:
    """The four pixels around a position, the border's repeated, and their bilinear weights."""
    u, v = min(max(u, 0.0), w - 1.0), min(max(v, 0.0), h - 1.0)
    x0, y0 = int(u), int(v)
    x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
    fx, fy = np.float32(u - x0), np.float32(v - y0)
    gx, gy = np.float32(1.0) - fx, np.float32(1.0) - fy
    return (y0 * w + x0, y0 * w + x1, y1 * w + x0, y1 * w + x1), (gx * gy, fx * gy, gx * fy, fx * fy)


@cache
def forward_kernel(channels: int, groups: int) -> Kernel:
    """Correlations for a number of channels and groups, compiled once per machine."""
    C, G = channels, groups
    per = channels // groups

    @njit(nogil=True, cache=True, fastmath=True)
    def forward(
        features: Floats, geometry: Geometry, layout: Layout, out: Floats, seen: Floats, rows: Any
    ) -> None:
        """Rows first ≤ b·h + y < last."""
        o, p = layout, geometry
        scale = np.float32(1.0 / per)
        for row in range(rows[0], rows[1]):
            b, y = row // o.h, row % o.h
            m = p.matrices[12 * b : 12 * b + 12]
            ref, src = (p.pairs[2 * b] * o.h + y) * o.w, p.pairs[2 * b + 1] * o.h * o.w
            for d in range(o.depth):
                for x in range(o.w):
                    at = b * o.ob + d * o.od + y * o.oy + x * o.ox
                    to = out[at : at + G]
                    u, v, z = _project(m, x, y, p.planes[b * o.pb + d * o.pd + y * o.py + x * o.px])
                    if not _seen(u, v, z, o.h, o.w):
                        seen[at // G] = 0
                        to[:] = 0
                        continue
                    seen[at // G] = 1
                    (i, j, k, n), (wi, wj, wk, wn) = _taps(u, v, o.h, o.w)
                    fi, fj = (
                        features[(src + i) * C : (src + i + 1) * C],
                        features[(src + j) * C : (src + j + 1) * C],
                    )
                    fk, fn = (
                        features[(src + k) * C : (src + k + 1) * C],
                        features[(src + n) * C : (src + n + 1) * C],
                    )
                    r = features[(ref + x) * C : (ref + x + 1) * C]
                    for g in range(G):
                        to[g] = (wi * fi[g] + wj * fj[g] + wk * fk[g] + wn * fn[g]) * r[g] * scale
                    for q in range(1, per):
                        for g in range(G):
                            c = q * G + g
                            to[g] += (wi * fi[c] + wj * fj[c] + wk * fk[c] + wn * fn[c]) * r[c] * scale

    return forward


@cache
def backward_kernel(channels: int, groups: int) -> Kernel:
    """Gradients of the correlations for the features, compiled once per machine."""
    C, G = channels, groups
    per = channels // groups

    @njit(nogil=True, cache=True, fastmath=True)
    def backward(
        features: Floats, geometry: Geometry, layout: Layout, upstream: Floats, grads: Floats, rows: Any
    ) -> None:
        """Pairs first ≤ b < last; grads is (B, 2, h, w, C), of the reference and of the source."""
        o, p = layout, geometry
        area = o.h * o.w
        scale = np.float32(1.0 / per)
        for row in range(rows[0] * o.h, rows[1] * o.h):
            b, y = row // o.h, row % o.h
            m = p.matrices[12 * b : 12 * b + 12]
            ref, src = (p.pairs[2 * b] * o.h + y) * o.w, p.pairs[2 * b + 1] * area
            back, into = 2 * b * area + y * o.w, (2 * b + 1) * area
            for d in range(o.depth):
                for x in range(o.w):
                    u, v, z = _project(m, x, y, p.planes[b * o.pb + d * o.pd + y * o.py + x * o.px])
                    if not _seen(u, v, z, o.h, o.w):
                        continue
                    at = b * o.ob + d * o.od + y * o.oy + x * o.ox
                    up = upstream[at : at + G]
                    taps, weights = _taps(u, v, o.h, o.w)
                    r = features[(ref + x) * C : (ref + x + 1) * C]
                    gr = grads[(back + x) * C : (back + x + 1) * C]
                    for tap, weight in zip(taps, weights):  # noqa: B905
                        f = features[(src + tap) * C : (src + tap + 1) * C]
                        gf = grads[(into + tap) * C : (into + tap + 1) * C]
                        part = weight * scale
                        for q in range(per):
                            for g in range(G):
                                gr[q * G + g] += part * f[q * G + g] * up[g]
                        for q in range(per):
                            for g in range(G):
                                gf[q * G + g] += part * r[q * G + g] * up[g]

    return backward


class Maps(NamedTuple):
    """Depths of all views and who is compared with whom.

    Attributes:
        matrices: (B, S, 12). sources: (B, S). inverse, log_error: (V, h, w).
    """

    matrices: Floats
    sources: NDArray[np.int64]
    inverse: Floats
    log_error: Floats


@njit(nogil=True, cache=True, fastmath=True)
def agreement(planes: Floats, maps: Maps, shape: Any, out: Floats, rows: Any) -> None:
    """Support and conflict of each hypothesis; rows first ≤ b·h + y < last of (B, 2·D, h, w).

    Shape is (h, w, D, S).
    """
    h, w, depth, count = shape
    area = h * w
    for row in range(rows[0], rows[1]):
        b, y = row // h, row % h
        for d in range(depth):
            for x in range(w):
                plane = planes[((b * depth + d) * h + y) * w + x]
                support, conflict, total = 0.0, 0.0, 1e-3
                for s in range(b * count, b * count + count):
                    u, v, z = _project(maps.matrices[12 * s : 12 * s + 12], x, y, plane)
                    if not _seen(u, v, z, h, w):
                        continue
                    taps, weights = _taps(u, v, h, w)
                    base = maps.sources[s] * area
                    theirs, error = 0.0, 0.0
                    for tap, weight in zip(taps, weights):  # noqa: B905
                        theirs += weight * maps.inverse[base + tap]
                        error += weight * maps.log_error[base + tap]
                    error = math.exp(error)
                    gap = math.log(max(z / plane * theirs, 1e-4))
                    trust = 0.02 / (0.02 + error)
                    sigma = 0.01 + min(error, 0.1)
                    support += trust * math.exp(-0.5 * (gap / sigma) ** 2)
                    conflict += trust / (1 + math.exp(min((gap + 2 * sigma) / (0.5 * sigma), 60.0)))
                    total += trust
                at = ((b * 2 * depth + d) * h + y) * w + x
                out[at] = support / total
                out[at + depth * area] = conflict / total
