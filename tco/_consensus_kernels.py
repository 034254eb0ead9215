"""Compiled loops of :mod:`tco.consensus` on a CPU: rows of pixels ask all views and move, with nothing kept.

The same as the tensor operations there, to rounding: those sort what all pixels hear at once, and that takes
most of their time.

A loop that only computes becomes vector instructions, if it writes one array and does not look for divisions
by zero; what is looked up and what is sorted has loops of its own. All of it is inlined: what is called
could be linked in another form when it is read from disk than when it was compiled, and round otherwise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tco._elementary import log

Floats = NDArray[np.float32]
Order = NDArray[np.int64]
f32 = np.float32
Index = np.uint64  # not below zero: of a signed one numba looks whether it counts from the end
HALF, ONE = f32(0.5), f32(1.0)
FAST = {"reassoc", "contract", "nsz", "arcp"}  # sums in any order, but what is not finite stays so


class Asked(NamedTuple):
    """The views that are asked.

    Attributes:
        maps: (V, H, W, 3) of all views: inverse depth, confidence, and 1 where the two count.
        others: (S,) which views.
        poses: (S, 3, 4) that take a ray of depth 1, times a depth, and 1, to a homogeneous pixel.
    """

    maps: Floats
    others: NDArray[np.int64]
    poses: Floats


class Rules(NamedTuple):
    """How it is asked; see :mod:`tco.consensus`.

    Attributes:
        rounds: times that the pixel asks and moves.
        low, high: bounds of the ratio of two depths of one surface.
        width: distance from the median at which a value counts half.
        whole: share of what is mixed at a place from which on it counts.
        half: share of the weights at which the lower median is.
        fewest: views from which on there is a spread.
        of_spread: standard error of a median of many by the median distance from it.
    """

    rounds: int
    low: float
    high: float
    width: float
    whole: float
    half: float
    fewest: float
    of_spread: float


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _project(rays: Floats, depth: Floats, m: Floats, at: Floats) -> None:
    """Where a row of pixels falls in another view: u, v and z, (3, w)."""
    u, v, z = at[0], at[1], at[2]
    x, y = rays[0], rays[1]
    for i in range(len(depth)):
        z[i] = (m[2, 0] * x[i] + m[2, 1] * y[i] + m[2, 2]) * depth[i] + m[2, 3]
    for i in range(len(depth)):
        u[i] = ((m[0, 0] * x[i] + m[0, 1] * y[i] + m[0, 2]) * depth[i] + m[0, 3]) / z[i]
    for i in range(len(depth)):
        v[i] = ((m[1, 0] * x[i] + m[1, 1] * y[i] + m[1, 2]) * depth[i] + m[1, 3]) / z[i]


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _look_up(maps: Floats, at: Floats, whole: float, found: Floats) -> None:
    """Inverse depth and confidence of maps (H, W, 3) where a row of pixels falls; 0, 0 if nothing counts.

    Args:
        maps: of the other view.
        at: (3, w) places, pixel centres at +0.5.
        whole: share of what is mixed at a place from which on it counts.
        found: (2, w) where it goes.
    """
    h, w = maps.shape[:2]
    flat, right, bottom = maps.reshape(-1), f32(w) + HALF, f32(h) + HALF
    for i in range(at.shape[1]):
        u, v = at[0, i], at[1, i]
        found[0, i] = found[1, i] = 0
        if not (at[2, i] > f32(1e-6) and u > -HALF and v > -HALF and u < right and v < bottom):
            continue
        column, row = int(u + HALF) - 1, int(v + HALF) - 1
        fx, fy = u - HALF - f32(column), v - HALF - f32(row)
        gx, gy = (ONE - fx) * f32(column >= 0), (ONE - fy) * f32(row >= 0)
        fx, fy = fx * f32(column + 1 < w), fy * f32(row + 1 < h)
        x0, x1, y0, y1 = max(column, 0), min(column + 1, w - 1), max(row, 0), min(row + 1, h - 1)
        a, b, c, d = Index(y0 * w + x0), Index(y0 * w + x1), Index(y1 * w + x0), Index(y1 * w + x1)
        a, b, c, d = Index(3) * a, Index(3) * b, Index(3) * c, Index(3) * d
        p, q, r, s = gx * gy, fx * gy, gx * fy, fx * fy
        one, two = Index(1), Index(2)
        if p * flat[a + two] + q * flat[b + two] + r * flat[c + two] + s * flat[d + two] > whole:
            found[0, i] = p * flat[a] + q * flat[b] + r * flat[c] + s * flat[d]
            found[1, i] = p * flat[a + one] + q * flat[b + one] + r * flat[c + one] + s * flat[d + one]


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _words(found: Floats, z: Floats, depth: Floats, rules: Rules, said: Floats, weights: Floats) -> None:
    """What another view says of a row of pixels (w,), and its weights; without any it says nothing."""
    inverse, confidence = found[0], found[1]
    low, high = f32(rules.low), f32(rules.high)
    for i in range(len(z)):
        factor = ONE + (ONE / max(inverse[i], f32(1e-9)) - z[i]) / depth[i]
        said[i] = log(max(factor, low))
    for i in range(len(z)):
        surface = ONE / max(inverse[i], f32(1e-9))
        factor = ONE + (surface - z[i]) / depth[i]
        asked = (inverse[i] > 0) & (surface > low * z[i]) & (surface < high * z[i])
        asked &= (factor > low) & (factor < high)
        weights[i] = confidence[i] * (depth[i] / z[i]) if asked else f32(0)


@njit(nogil=True, cache=True, inline="always")
def _sort(values: Floats, weights: Floats, whose: Order, count: int) -> None:
    """Put the first so many values in order; their weights, and whose they are, with them."""
    for i in range(1, count):
        value, weight, who = values[i], weights[i], whose[i]
        j = i - 1
        while j >= 0 and values[j] > value:
            values[j + 1], weights[j + 1], whose[j + 1] = values[j], weights[j], whose[j]
            j -= 1
        values[j + 1], weights[j + 1], whose[j + 1] = value, weight, who


@njit(nogil=True, cache=True, inline="always")
def _heard(
    said: Floats, weighs: Floats, x: int, values: Floats, weights: Floats, whose: Order, rest: Order
) -> int:
    """What was said to one pixel of a row and counts, in order; returns how much.

    It is sorted from the order of the pixel before, from which it differs little.

    Args:
        said, weighs: (S + 1, w) values and weights, of which those count that have some weight.
        x: the pixel.
        values, weights: (S + 1,) where they go.
        whose: (S + 1,) rows in the order of the pixel before, and then of this one.
        rest: (S + 1,) to write in.
    """
    count, others = 0, 0
    for k in range(len(whose)):
        s = whose[k]
        if weighs[s, x] > 0:
            values[count], weights[count], whose[count] = said[s, x], weighs[s, x], s
            count += 1
        else:
            rest[others] = s
            others += 1
    for k in range(others):
        whose[count + k] = rest[k]
    _sort(values, weights, whose, count)
    return count


@njit(nogil=True, cache=True, inline="always")
def _median(values: Floats, weights: Floats, count: int, share: float) -> float:
    """First of the values, in order, with which so large a share of the weights is reached."""
    total = 0.0
    for k in range(count):
        total += weights[k]
    reached = 0.0
    for k in range(count):
        reached += weights[k]
        if reached >= share * total:
            return values[k]
    return values[count - 1]


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _robust_mean(values: Floats, weights: Floats, count: int, middle: float, width: float) -> float:
    """Mean of what is near the median."""
    total = mean = f32(0)
    for k in range(count):
        share = (values[k] - f32(middle)) / f32(width)
        near = weights[k] / (ONE + share * share)
        total += near
        mean += near * values[k]
    return float(mean / total)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _spread(values: Floats, weights: Floats, count: int, middle: float, rules: Rules, rest: Order) -> float:
    """Standard error of what was heard; the values are changed, and so is ``rest`` (S + 1,)."""
    total = squares = 0.0
    for k in range(count):
        values[k] = abs(values[k] - middle)
        total += weights[k]
        squares += weights[k] ** 2
    views = total**2 / max(squares, 1e-30)
    if not views > rules.fewest:
        return math.inf
    _sort(values, weights, rest, count)
    off = _median(values, weights, count, 1 - rules.half)
    return rules.of_spread * off * math.sqrt(views) / (views - 0.8)


@njit(nogil=True, cache=True, fastmath=FAST, error_model="numpy")
def ask(own: Floats, rays: Floats, asked: Asked, rules: Rules, rows: tuple[int, int], out: Floats) -> None:
    """Depths and standard errors of some rows of pixels of a view.

    Args:
        own: (2, H, W) inverse depth and confidence of the view.
        rays: (2, H, W) x and y at depth 1.
        asked: the other views.
        rules: how.
        rows: first and end.
        out: (2, H, W) where depth and relative standard error go.
    """
    views, w = len(asked.others), own.shape[2]
    said, weighs = np.empty((views + 1, w), np.float32), np.empty((views + 1, w), np.float32)
    at, found = np.empty((3, w), np.float32), np.empty((2, w), np.float32)
    values, weights = np.empty(views + 1, np.float32), np.empty(views + 1, np.float32)
    whose, rest = np.arange(views + 1), np.empty(views + 1, np.int64)
    for y in range(rows[0], rows[1]):
        depth, error, inverse = out[0, y], out[1, y], own[0, y]
        weighs[views] = own[1, y]
        for x in range(w):
            depth[x] = ONE / inverse[x]
        for turn in range(rules.rounds):
            for s in range(views):
                _project(rays[:, y], depth, asked.poses[s], at)
                _look_up(asked.maps[asked.others[s]], at, rules.whole, found)
                _words(found, at[2], depth, rules, said[s], weighs[s])
            own_word = said[views]
            for x in range(w):
                own_word[x] = log(ONE / (inverse[x] * depth[x]))
            for x in range(w):
                count = _heard(said, weighs, x, values, weights, whose, rest)
                middle = _median(values, weights, count, rules.half)
                depth[x] *= math.exp(_robust_mean(values, weights, count, middle, rules.width))
                if turn + 1 == rules.rounds:
                    error[x] = _spread(values, weights, count, middle, rules, rest)
