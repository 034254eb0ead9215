"""Compiled loops of :mod:`tco.consensus` on a CPU: a pixel asks all views and moves, with nothing kept of it.

The same as the tensor operations there, to rounding: those sort what all pixels hear at once, and that takes
most of their time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]


class Asked(NamedTuple):
    """The views that are asked.

    Attributes:
        maps: (V, H, W, 3) of all views: inverse depth, confidence, and 1 where the two count.
        others: (S,) which views.
        poses: (S, 3, 4) ``other_from_view``.
        intrinsics: (S, 4) fx, fy, cx, cy.
    """

    maps: Floats
    others: NDArray[np.int64]
    poses: Doubles
    intrinsics: Doubles


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


@njit(nogil=True, cache=True, inline="always")
def _seen(maps: Floats, u: float, v: float, whole: float) -> tuple[float, float]:
    """Inverse depth and confidence of maps (H, W, 3) at a place, pixel centres at +0.5; 0, 0 if none."""
    h, w = maps.shape[:2]
    if not (u > -0.5 and v > -0.5 and u < w + 0.5 and v < h + 0.5):
        return 0.0, 0.0
    column, row = int(u + 0.5) - 1, int(v + 0.5) - 1
    fx, fy = u - 0.5 - column, v - 0.5 - row
    inverse = confidence = counts = 0.0
    for dy in range(2):
        y, down = row + dy, fy if dy else 1 - fy
        for dx in range(2):
            x, share = column + dx, down * (fx if dx else 1 - fx)
            if 0 <= y < h and 0 <= x < w:
                inverse += share * maps[y, x, 0]
                confidence += share * maps[y, x, 1]
                counts += share * maps[y, x, 2]
    if counts > whole:
        return inverse, confidence
    return 0.0, 0.0


@njit(nogil=True, cache=True)
def _sort(values: Doubles, weights: Doubles, count: int) -> None:
    """Put the first so many values in order, their weights with them; stable."""
    for i in range(1, count):
        value, weight = values[i], weights[i]
        j = i - 1
        while j >= 0 and values[j] > value:
            values[j + 1], weights[j + 1] = values[j], weights[j]
            j -= 1
        values[j + 1], weights[j + 1] = value, weight


@njit(nogil=True, cache=True)
def _median(values: Doubles, weights: Doubles, count: int, share: float) -> float:
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


@njit(nogil=True, cache=True)
def _hear(ray: Doubles, depth: float, asked: Asked, rules: Rules, values: Doubles, weights: Doubles) -> int:
    """What the views say of a pixel, from the second value on; returns how many values there are then."""
    count = 1
    for s in range(len(asked.others)):
        m, k = asked.poses[s], asked.intrinsics[s]
        x = (m[0, 0] * ray[0] + m[0, 1] * ray[1] + m[0, 2] * ray[2]) * depth + m[0, 3]
        y = (m[1, 0] * ray[0] + m[1, 1] * ray[1] + m[1, 2] * ray[2]) * depth + m[1, 3]
        z = (m[2, 0] * ray[0] + m[2, 1] * ray[1] + m[2, 2] * ray[2]) * depth + m[2, 3]
        if not z > 1e-6:
            continue
        u, v = k[0] * x / z + k[2], k[1] * y / z + k[3]
        inverse, confidence = _seen(asked.maps[asked.others[s]], u, v, rules.whole)
        if inverse <= 0:
            continue
        surface = 1 / max(inverse, 1e-9)
        factor = 1 + (surface - z) / depth
        if rules.low * z < surface < rules.high * z and rules.low < factor < rules.high:
            values[count], weights[count] = math.log(factor), confidence * (depth / z)
            count += 1
    return count


@njit(nogil=True, cache=True)
def _spread(values: Doubles, weights: Doubles, count: int, middle: float, rules: Rules) -> float:
    """Standard error of what was heard; the values are changed."""
    total = squares = 0.0
    for k in range(count):
        values[k] = abs(values[k] - middle)
        total += weights[k]
        squares += weights[k] ** 2
    views = total**2 / max(squares, 1e-30)
    if not views > rules.fewest:
        return math.inf
    _sort(values, weights, count)
    off = _median(values, weights, count, 1 - rules.half)
    return rules.of_spread * off * math.sqrt(views) / (views - 0.8)


@njit(nogil=True, cache=True)
def ask(own: Floats, rays: Floats, asked: Asked, rules: Rules, pixels: tuple[int, int], out: Floats) -> None:
    """Depths and standard errors of a range of the pixels of a view.

    Args:
        own: (N, ≥ 2) inverse depth and confidence of the view.
        rays: (N, 3) at depth 1.
        asked: the other views.
        rules: how.
        pixels: first and end.
        out: (2, N) where depth and relative standard error go.
    """
    values, weights = np.empty(len(asked.others) + 1), np.empty(len(asked.others) + 1)
    ray = np.empty(3)
    for p in range(pixels[0], pixels[1]):
        first = 1.0 / own[p, 0]
        depth, error = first, math.inf
        for c in range(3):
            ray[c] = rays[p, c]
        for turn in range(rules.rounds):
            values[0], weights[0] = math.log(first / depth), own[p, 1]
            count = _hear(ray, depth, asked, rules, values, weights)
            _sort(values, weights, count)
            middle = _median(values, weights, count, rules.half)
            total = mean = 0.0
            for k in range(count):
                near = weights[k] / (1 + ((values[k] - middle) / rules.width) ** 2)
                total += near
                mean += near * values[k]
            depth *= math.exp(mean / total)
            if turn + 1 == rules.rounds:
                error = _spread(values, weights, count, middle, rules)
        out[0, p], out[1, p] = depth, error
