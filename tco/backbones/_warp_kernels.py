"""Compiled loops of the plane sweep on a CPU: warping and correlation in one pass, and its gradient.

Arrays are flat; a feature map is (V, h, w, C) with channels last. Channel c belongs to group c % G, so
that the sum over a group runs over whole vectors.

The compiler makes vector instructions of a loop only if it knows that nothing is written that is read in it,
and nothing ends it early. So loops over pixels are cut in parts that compute alone and parts that only look
up, divisions by zero are not looked for (``error_model``), exponentials and logarithms are written out, and
the few channels of a group, of which the compiler would make no vector by itself, are one by two intrinsics.

numba keeps compiled code by the date of the file of a loop, and does not see changes in what the loop
imports: helpers that may change belong into this file, inlined, for what is called may round otherwise when
read from disk.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from tco._elementary import exp, log

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


Index = np.uint64  # not below zero: of a signed one numba looks whether it counts from the end
f32 = np.float32
UNSEEN = f32(80.0)
"""Logarithm of an error that is worth nothing."""
HALF, ONE = f32(0.5), f32(1.0)


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy", inline="always")
def _project(m: Floats, y: int, planes: Floats, at: Floats) -> None:
    """A row of pixels in the source: u, v in units from the centre of its first pixel, z times inverse depth.

    Args:
        m: (12,) matrix.
        y: the row.
        planes: (w,) inverse depths, or (1,) of all.
        at: (3, w) where u, v, z go.
    """
    py = f32(y) + HALF
    u0, v0, z0 = m[1] * py + m[2], m[5] * py + m[6], m[9] * py + m[10]
    u, v, z = at[0], at[1], at[2]
    for x in range(len(z)):
        z[x] = planes[x if len(planes) > 1 else 0]
    for x in range(len(z)):
        px, inverse = f32(x) + HALF, z[x]
        z[x] = m[8] * px + z0 + m[11] * inverse
        share = ONE / max(z[x], f32(1e-4))
        u[x] = (m[0] * px + u0 + m[3] * inverse) * share - HALF
        v[x] = (m[4] * px + v0 + m[7] * inverse) * share - HALF


@njit(nogil=True, cache=True, fastmath=True, inline="always")
def _seen(u: Any, v: Any, z: Any, h: int, w: int) -> bool:
    return z > f32(1e-3) and u >= -HALF and v >= -HALF and u <= w - HALF and v <= h - HALF


@njit(nogil=True, cache=True, fastmath=True, inline="always")
def _taps(u: Any, v: Any, h: int, w: int, scale: Any) -> tuple[tuple[int, ...], tuple[Any, ...]]:
    """The four pixels around a position, the border's repeated, and their bilinear weights times a number."""
    u, v = min(max(u, f32(0.0)), f32(w - 1)), min(max(v, f32(0.0)), f32(h - 1))
    x0, y0 = int(u), int(v)
    x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
    fx, fy = u - f32(x0), v - f32(y0)
    gx, gy, fy = ONE - fx, (ONE - fy) * scale, fy * scale
    return (y0 * w + x0, y0 * w + x1, y1 * w + x0, y1 * w + x1), (gx * gy, fx * gy, gx * fy, fx * fy)


@njit(nogil=True, cache=True, inline="always")
def _firsts(taps: tuple[int, ...], base: int, channels: int) -> tuple[Any, ...]:
    """The first numbers of four pixels of the view that begins with pixel ``base``."""
    i, j, k, n = base + taps[0], base + taps[1], base + taps[2], base + taps[3]
    return Index(i * channels), Index(j * channels), Index(k * channels), Index(n * channels)


class _Vectors:
    """Instructions on the groups of some channels, a vector of G numbers each."""

    def __init__(self, context: Any, builder: Any, groups: int) -> None:
        self.context, self.builder = context, builder
        self.type = ir.VectorType(ir.FloatType(), groups)

    def pointer(self, array: Any, kind: Any, first: Any, offset: int = 0) -> Any:
        """To the vector in a flat array from so many numbers after its ``first`` on."""
        b, data = self.builder, self.context.make_array(kind)(self.context, self.builder, array).data
        place = b.gep(data, [b.add(first, ir.Constant(ir.IntType(64), offset))])
        return b.bitcast(place, self.type.as_pointer())

    def load(self, pointer: Any) -> Any:
        """Vectors begin anywhere in an array of float32."""
        return self.builder.load(pointer, align=4)

    def store(self, value: Any, pointer: Any) -> None:
        """As :meth:`load`."""
        self.builder.store(value, pointer, align=4)

    def add(self, value: Any, pointer: Any) -> None:
        """To what is there."""
        self.store(self.plus(self.load(pointer), value), pointer)

    def taps(self, pair: Any) -> list[tuple[Any, Any]]:
        """First numbers of four pixels, and their weights as vectors, of a pair of tuples."""
        get = self.builder.extract_value
        return [(get(pair, (0, i)), self.all(get(pair, (1, i)))) for i in range(4)]

    def mixed(self, array: Any, kind: Any, taps: list[tuple[Any, Any]], offset: int) -> Any:
        """Weighted sum of the vectors at four pixels."""
        total = None
        for place, share in taps:
            total = self.plus(total, self.times(share, self.load(self.pointer(array, kind, place, offset))))
        return total

    def all(self, number: Any) -> Any:
        """The number in all places of a vector."""
        b, none = self.builder, ir.Constant(self.type, ir.Undefined)
        one, places = ir.IntType(32), ir.VectorType(ir.IntType(32), self.type.count)
        first = b.insert_element(none, number, ir.Constant(one, 0))
        return b.shuffle_vector(first, none, ir.Constant(places, [0] * self.type.count))

    def times(self, x: Any, y: Any) -> Any:
        """Product."""
        return self.builder.fmul(x, y, flags=("fast",))

    def plus(self, x: Any, y: Any) -> Any:
        """Sum; of nothing and ``y`` it is that."""
        return y if x is None else self.builder.fadd(x, y, flags=("fast",))


@intrinsic(prefer_literal=True)
def _correlated(
    typing: Any, channels: Any, groups: Any, features: Any, taps: Any, own: Any, out: Any, at: Any
) -> Any:
    """Sum over the channels of each group of what is at the taps, mixed, times what is at a pixel.

    Args:
        channels, groups: constants.
        features: all, flat.
        taps: the first numbers of four pixels in them, and the weights of these.
        own: the first number of the pixel that is compared.
        out, at: where the (G,) go.
    """
    C, G = channels.literal_value, groups.literal_value

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        v = _Vectors(context, builder, G)
        mixed, own = v.taps(args[3]), args[4]
        total = None
        for q in range(0, C, G):
            there = v.mixed(args[2], features, mixed, q)
            total = v.plus(total, v.times(there, v.load(v.pointer(args[2], features, own, q))))
        v.store(total, v.pointer(args[5], out, args[6]))
        return context.get_dummy_value()

    return types.void(channels, groups, features, taps, own, out, at), code


@intrinsic(prefer_literal=True)
def _spread(
    typing: Any, channels: Any, groups: Any, features: Any, taps: Any, own: Any, gradients: Any, to: Any
) -> Any:
    """Gradients of :func:`_correlated`, added up.

    Args:
        channels, groups, features, taps, own: as there.
        gradients: upstream, flat; where those of (G,) are in it; and those of the features, flat.
        to: in which the first numbers of four taps, which may be one pixel, and of the pixel compared are.
    """
    C, G = channels.literal_value, groups.literal_value
    kind_up, _, kind = gradients.types

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        v = _Vectors(context, builder, G)
        mixed, own = v.taps(args[3]), args[4]
        above, at, below = (builder.extract_value(args[5], i) for i in range(3))
        *places, home = (builder.extract_value(args[6], i) for i in range(5))
        up = v.load(v.pointer(above, kind_up, at))
        for q in range(0, C, G):
            part = v.times(up, v.load(v.pointer(args[2], features, own, q)))
            for (_, share), place in zip(mixed, places, strict=True):
                v.add(v.times(share, part), v.pointer(below, kind, place, q))
            there = v.mixed(args[2], features, mixed, q)
            v.add(v.times(up, there), v.pointer(below, kind, home, q))
        return context.get_dummy_value()

    return types.void(channels, groups, features, taps, own, gradients, to), code


@cache
def forward_kernel(channels: int, groups: int) -> Kernel:
    """Correlations for a number of channels and groups, compiled once per machine."""
    C, G, scale = channels, groups, f32(groups / channels)

    @njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
    def forward(
        features: Floats, geometry: Geometry, layout: Layout, out: Floats, seen: Floats, rows: Any
    ) -> None:
        """Rows first ≤ b·h + y < last."""
        o, p = layout, geometry
        places = np.empty((3, o.w), np.float32)
        for row in range(rows[0], rows[1]):
            b, y = row // o.h, row % o.h
            ref, src = (p.pairs[2 * b] * o.h + y) * o.w, p.pairs[2 * b + 1] * o.h * o.w
            for d in range(o.depth):
                first = b * o.pb + d * o.pd + y * o.py
                planes = p.planes[first : first + (o.w - 1) * o.px + 1]
                _project(p.matrices[12 * b : 12 * b + 12], y, planes, places)
                for x in range(o.w):
                    at = Index(b * o.ob + d * o.od + y * o.oy + x * o.ox)
                    u, v, z = places[0, x], places[1, x], places[2, x]
                    if not _seen(u, v, z, o.h, o.w):
                        seen[at // Index(G)] = 0
                        for g in range(Index(G)):
                            out[at + g] = 0
                        continue
                    seen[at // Index(G)] = 1
                    taps, weights = _taps(u, v, o.h, o.w, scale)
                    mix = _firsts(taps, src, C), weights
                    _correlated(C, G, features, mix, Index((ref + x) * C), out, at)

    return forward


@cache
def backward_kernel(channels: int, groups: int) -> Kernel:
    """Gradients of the correlations for the features, compiled once per machine."""
    C, G, scale = channels, groups, f32(groups / channels)

    @njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
    def backward(
        features: Floats, geometry: Geometry, layout: Layout, upstream: Floats, grads: Floats, rows: Any
    ) -> None:
        """Pairs first ≤ b < last; grads is (B, 2, h, w, C), of the reference and of the source."""
        o, p = layout, geometry
        area = o.h * o.w
        places = np.empty((3, o.w), np.float32)
        for row in range(rows[0] * o.h, rows[1] * o.h):
            b, y = row // o.h, row % o.h
            ref, src = (p.pairs[2 * b] * o.h + y) * o.w, p.pairs[2 * b + 1] * area
            back, into = 2 * b * area + y * o.w, (2 * b + 1) * area
            for d in range(o.depth):
                first = b * o.pb + d * o.pd + y * o.py
                planes = p.planes[first : first + (o.w - 1) * o.px + 1]
                _project(p.matrices[12 * b : 12 * b + 12], y, planes, places)
                for x in range(o.w):
                    u, v, z = places[0, x], places[1, x], places[2, x]
                    if not _seen(u, v, z, o.h, o.w):
                        continue
                    at = Index(b * o.ob + d * o.od + y * o.oy + x * o.ox)
                    taps, weights = _taps(u, v, o.h, o.w, scale)
                    mix = _firsts(taps, src, C), weights
                    to = (*_firsts(taps, into, C), Index((back + x) * C))
                    _spread(C, G, features, mix, Index((ref + x) * C), (upstream, at, grads), to)

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


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy", inline="always")
def _look_up(
    places: Floats, planes: Floats, maps: Maps, base: int, size: tuple[int, int], found: Floats
) -> None:
    """What a source says where a row of hypotheses falls.

    Args:
        places: (3, w) of :func:`_project`.
        planes: (w,) inverse depths of the hypotheses.
        maps: inverse depths and errors of all views.
        base: first pixel of the source in them.
        size: h and w.
        found: (2, w) where the source's inverse depth times that of the hypothesis there, and the logarithm
            of its error go; 1 and ``UNSEEN`` if it sees nothing.
    """
    h, w = size
    inverse, log_error = maps.inverse, maps.log_error
    for x in range(w):
        u, v, z = places[0, x], places[1, x], places[2, x]
        if not _seen(u, v, z, h, w):
            found[0, x], found[1, x] = ONE, UNSEEN
            continue
        (i, j, k, n), (wi, wj, wk, wn) = _taps(u, v, h, w, ONE)
        i, j, k, n = Index(base + i), Index(base + j), Index(base + k), Index(base + n)
        theirs = wi * inverse[i] + wj * inverse[j] + wk * inverse[k] + wn * inverse[n]
        found[0, x] = max(z / planes[x] * theirs, f32(1e-4))
        found[1, x] = wi * log_error[i] + wj * log_error[j] + wk * log_error[k] + wn * log_error[n]


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy", inline="always")
def _judge(found: Floats, support: Floats, conflict: Floats, total: Floats) -> None:
    """Add to sums (w,) what a source says by what was looked up (2, w), which is changed."""
    ratio, error = found[0], found[1]
    for x in range(len(total)):
        off, gap = exp(error[x]), log(ratio[x])
        trust = f32(0.02) / (f32(0.02) + off)
        share = gap / (f32(0.01) + min(off, f32(0.1)))
        ratio[x] = trust * exp(-HALF * share * share)
        error[x] = trust / (ONE + exp(min(f32(2.0) * (share + f32(2.0)), f32(60.0))))
        total[x] += trust
    for x in range(len(total)):
        support[x] += ratio[x]
    for x in range(len(total)):
        conflict[x] += error[x]


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def agreement(planes: Floats, maps: Maps, shape: Any, out: Floats, rows: Any) -> None:
    """Support and conflict of each hypothesis; rows first ≤ b·h + y < last of (B, 2·D, h, w).

    Shape is (h, w, D, S).
    """
    h, w, depth, count = shape
    places, found, total = np.empty((3, w), np.float32), np.empty((2, w), np.float32), np.empty(w, np.float32)
    for row in range(rows[0], rows[1]):
        b, y = row // h, row % h
        for d in range(depth):
            own = planes[((b * depth + d) * h + y) * w : ((b * depth + d) * h + y + 1) * w]
            at = ((b * 2 * depth + d) * h + y) * w
            support, conflict = out[at : at + w], out[at + depth * h * w : at + depth * h * w + w]
            support[:], conflict[:], total[:] = 0, 0, 1e-3
            for s in range(b * count, b * count + count):
                _project(maps.matrices[12 * s : 12 * s + 12], y, own, places)
                _look_up(places, own, maps, maps.sources[s] * h * w, (h, w), found)
                _judge(found, support, conflict, total)
            for x in range(w):
                support[x] /= total[x]
            for x in range(w):
                conflict[x] /= total[x]
