"""Compiled loops of the plane sweep on a CPU: warping and correlation in one pass, and its gradient.

Arrays are flat; a feature map is (V, h, w, C) with channels last. Channel c belongs to group c % G, so
that the sum over a group runs over whole vectors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Kernel = Callable[..., None]


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


@cache
def correlation_kernels(channels: int, groups: int) -> tuple[Kernel, Kernel]:
    """Forward and backward loops for a number of channels and groups, compiled once per machine."""
    C, G = channels, groups
    per = channels // groups

    @njit(nogil=True, cache=True, fastmath=True, boundscheck=False)
    def forward(
        features: Floats, pairs: Any, matrices: Floats, planes: Floats,
        shape: Any, steps: Any, out: Floats, seen: Any, first: int, last: int,
    ) -> None:  # fmt: skip
        """Rows first ≤ b·h + y < last; shape is (h, w, D), steps those of planes (4) and of out (4)."""
        h, w, depth = shape
        scale = np.float32(1.0 / per)
        pb, pd, py, px, ob, od, oy, ox = steps
        for row in range(first, last):
            b, y = row // h, row % h
            m = matrices[12 * b : 12 * b + 12]
            ref = (pairs[2 * b] * h + y) * w * C
            src = pairs[2 * b + 1] * h * w * C
            for d in range(depth):
                for x in range(w):
                    at = b * ob + d * od + y * oy + x * ox
                    u, v, z = _project(m, x, y, planes[b * pb + d * pd + y * py + x * px])
                    if not _seen(u, v, z, h, w):
                        seen[at // G] = 0
                        for g in range(G):
                            out[at + g] = 0
                        continue
                    seen[at // G] = 1
                    u, v = min(max(u, 0.0), w - 1.0), min(max(v, 0.0), h - 1.0)
                    x0, y0 = int(u), int(v)
                    fx, fy = np.float32(u - x0), np.float32(v - y0)
                    x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
                    one = np.float32(1.0)
                    wa, wc = (one - fx) * (one - fy), fx * (one - fy)
                    we, wf = (one - fx) * fy, fx * fy
                    a, c = src + (y0 * w + x0) * C, src + (y0 * w + x1) * C
                    e, f = src + (y1 * w + x0) * C, src + (y1 * w + x1) * C
                    fa, fc, fe, ff = features[a : a + C], features[c : c + C], features[e : e + C], features[f : f + C]
                    r = features[ref + x * C : ref + x * C + C]
                    o = out[at : at + G]
                    for g in range(G):
                        o[g] = (wa * fa[g] + wc * fc[g] + we * fe[g] + wf * ff[g]) * r[g] * scale
                    for k in range(1, per):
                        for g in range(G):
                            i = k * G + g
                            o[g] += (wa * fa[i] + wc * fc[i] + we * fe[i] + wf * ff[i]) * r[i] * scale

    @njit(nogil=True, cache=True, fastmath=True, boundscheck=False)
    def backward(
        features: Floats, pairs: Any, matrices: Floats, planes: Floats,
        shape: Any, steps: Any, upstream: Floats, grads: Floats, first: int, last: int,
    ) -> None:  # fmt: skip
        """Pairs first ≤ b < last; grads is (B, 2, h, w, C), of the reference and of the source."""
        h, w, depth = shape
        pb, pd, py, px, ob, od, oy, ox = steps
        for b in range(first, last):
            m = matrices[12 * b : 12 * b + 12]
            src = pairs[2 * b + 1] * h * w * C
            into = (2 * b + 1) * h * w * C
            for y in range(h):
                ref = (pairs[2 * b] * h + y) * w * C
                back = (2 * b * h + y) * w * C
                for d in range(depth):
                    for x in range(w):
                        at = b * ob + d * od + y * oy + x * ox
                        u, v, z = _project(m, x, y, planes[b * pb + d * pd + y * py + x * px])
                        if not _seen(u, v, z, h, w):
                            continue
                        u, v = min(max(u, 0.0), w - 1.0), min(max(v, 0.0), h - 1.0)
                        x0, y0 = int(u), int(v)
                        fx, fy = np.float32(u - x0), np.float32(v - y0)
                        x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
                        one = np.float32(1.0)
                        scale = one / np.float32(per)
                        wa, wc = (one - fx) * (one - fy) * scale, fx * (one - fy) * scale
                        we, wf = (one - fx) * fy * scale, fx * fy * scale
                        a, c = (y0 * w + x0) * C, (y0 * w + x1) * C
                        e, f = (y1 * w + x0) * C, (y1 * w + x1) * C
                        fa, fc = features[src + a : src + a + C], features[src + c : src + c + C]
                        fe, ff = features[src + e : src + e + C], features[src + f : src + f + C]
                        ga, gc = grads[into + a : into + a + C], grads[into + c : into + c + C]
                        ge, gf = grads[into + e : into + e + C], grads[into + f : into + f + C]
                        r, gr = features[ref + x * C : ref + x * C + C], grads[back + x * C : back + x * C + C]
                        up = upstream[at : at + G]
                        for k in range(per):
                            for g in range(G):
                                i = k * G + g
                                gr[i] += (wa * fa[i] + wc * fc[i] + we * fe[i] + wf * ff[i]) * up[g]
                        for k in range(per):
                            for g in range(G):
                                ga[k * G + g] += wa * up[g] * r[k * G + g]
                        for k in range(per):
                            for g in range(G):
                                gc[k * G + g] += wc * up[g] * r[k * G + g]
                        for k in range(per):
                            for g in range(G):
                                ge[k * G + g] += we * up[g] * r[k * G + g]
                        for k in range(per):
                            for g in range(G):
                                gf[k * G + g] += wf * up[g] * r[k * G + g]

    return forward, backward


@njit(nogil=True, cache=True, fastmath=True, boundscheck=False)
def agreement(
    planes: Floats, matrices: Floats, sources: Any, inverse: Floats, log_error: Floats,
    shape: Any, out: Floats, first: int, last: int,
) -> None:  # fmt: skip
    """Support and conflict of each hypothesis; rows first ≤ b·h + y < last of (B, 2·D, h, w).

    Shape is (h, w, D, S); matrices (B, S, 12), sources (B, S), inverse and log_error (V, h, w).
    """
    h, w, depth, count = shape
    area = h * w
    for row in range(first, last):
        b, y = row // h, row % h
        for d in range(depth):
            for x in range(w):
                plane = planes[((b * depth + d) * h + y) * w + x]
                support, conflict, weights = 0.0, 0.0, 1e-3
                for s in range(count):
                    m = matrices[12 * (b * count + s) : 12 * (b * count + s) + 12]
                    u, v, z = _project(m, x, y, plane)
                    if not _seen(u, v, z, h, w):
                        continue
                    u, v = min(max(u, 0.0), w - 1.0), min(max(v, 0.0), h - 1.0)
                    x0, y0 = int(u), int(v)
                    fx, fy = u - x0, v - y0
                    x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
                    base = sources[b * count + s] * area
                    a, c = base + y0 * w + x0, base + y0 * w + x1
                    e, f = base + y1 * w + x0, base + y1 * w + x1
                    wa, wc, we, wf = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
                    theirs = wa * inverse[a] + wc * inverse[c] + we * inverse[e] + wf * inverse[f]
                    error = math.exp(
                        wa * log_error[a] + wc * log_error[c] + we * log_error[e] + wf * log_error[f]
                    )
                    gap = math.log(max(z / plane * theirs, 1e-4))
                    weight = 0.02 / (0.02 + error)
                    sigma = 0.01 + min(error, 0.1)
                    support += weight * math.exp(-0.5 * (gap / sigma) ** 2)
                    conflict += weight / (1 + math.exp(min((gap + 2 * sigma) / (0.5 * sigma), 60.0)))
                    weights += weight
                at = ((b * 2 * depth + d) * h + y) * w + x
                out[at] = support / weights
                out[at + depth * area] = conflict / weights
