"""Compiled loops of :mod:`tco.contest`: depths of one view carried into another, and what they are worth.

Most pixels are not contested and cost a look at what the others put there; what is left is so little that a
plain loop over pixels, depths and views will do, which sums in order. All of it is inlined: what is called
could be linked in another form when it is read from disk than when it was compiled, and round otherwise.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
f32 = np.float32
ZERO, HALF, ONE = f32(0.0), f32(0.5), f32(1.0)
FRONT, OUTSIDE = f32(1e-6), f32(-9.0)
"""Depth from which on something is in front of a camera; place of what is not."""


class View(NamedTuple):
    """The view whose pixels are contested.

    Attributes:
        depth: (H, W), 0 where there is none.
        grey: (H, W) picture, below 0 where it does not count.
        told: (S, H, W) depths that other views put there, 0 where they put none.
    """

    depth: Floats
    grey: Floats
    told: Floats


class Others(NamedTuple):
    """The views that are asked.

    Attributes:
        depth: (V, H, W) of all views, 0 where there is none.
        grey: (V, H, W) pictures of all views, below 0 where they do not count.
        which: (S,) views that are asked.
        poses: (S, 3, 4) that take a homogeneous pixel of the view, times its depth, and 1, to one of theirs.
    """

    depth: Floats
    grey: Floats
    which: NDArray[np.int64]
    poses: Floats


class Rules(NamedTuple):
    """What counts how much; see :mod:`tco.contest`.

    Attributes:
        same: relative difference up to which two depths are the same.
        beyond: relative difference from which on one is behind the other.
        least: views that must agree with a depth that is taken.
        behind: votes by which it may have fewer than the pixel's own.
        worth: votes that a correlation of one counts.
        margin: by how much its score must be higher.
        best: views of which the correlations are taken, the highest.
        window: (T, 3) columns and rows from the pixel, and their weights.
        contrast: difference in grey at which a pixel of the window counts 1 / e.
        noise: variance in grey that all pictures have.
        shown: share of the window's weight that must be in a picture.
    """

    same: float
    beyond: float
    least: float
    behind: float
    worth: float
    margin: float
    best: int
    window: Floats
    contrast: float
    noise: float
    shown: float


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _place(pose: Floats, column: Any, row: Any, d: Any) -> tuple[Any, Any, Any]:
    """Where a pixel of a depth falls in another view: column and row, centres at +0.5, and depth."""
    a, b = f32(column) + HALF, f32(row) + HALF
    z = (pose[2, 0] * a + pose[2, 1] * b + pose[2, 2]) * d + pose[2, 3]
    if not z > FRONT:
        return OUTSIDE, OUTSIDE, ZERO
    u = ((pose[0, 0] * a + pose[0, 1] * b + pose[0, 2]) * d + pose[0, 3]) / z
    v = ((pose[1, 0] * a + pose[1, 1] * b + pose[1, 2]) * d + pose[1, 3]) / z
    return u, v, z


@njit(nogil=True, cache=True, error_model="numpy")
def carry(depth: Floats, pose: Floats, radius: float, out: Floats) -> None:
    """Put the depths of one view into another: the nearest at each pixel.

    Args:
        depth: (H, W), 0 where there is none.
        pose: (3, 4) as :class:`Others` has them, from this view to the other.
        radius: of the square, in pixels, that a pixel covers there.
        out: (H, W) of the other view, filled with 0; stays 0 where nothing falls.
    """
    h, w = depth.shape
    r = f32(radius)
    for y in range(h):
        for x in range(w):
            d = depth[y, x]
            if not d > ZERO:
                continue
            u, v, z = _place(pose, x, y, d)
            if not (u > -r and v > -r and u < f32(w) + r and v < f32(h) + r):
                continue
            left, right = max(int(u - r), 0), min(int(u + r), w - 1)
            top, bottom = max(int(v - r), 0), min(int(v + r), h - 1)
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    if out[row, column] == ZERO or z < out[row, column]:
                        out[row, column] = z


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _votes(view: View, others: Others, rules: Rules, at: tuple[int, int], d: Any) -> tuple[Any, Any]:
    """How many other views agree with a depth of a pixel (row, column), and that less those that object."""
    y, x = at
    h, w = view.depth.shape
    same, beyond = f32(rules.same), ONE + f32(rules.beyond)
    agree = against = ZERO
    for s in range(len(others.poses)):
        if view.told[s, y, x] > ZERO and view.told[s, y, x] < d * (ONE - f32(rules.beyond)):
            against += ONE
        u, v, z = _place(others.poses[s], x, y, d)
        if not (u >= ZERO and v >= ZERO and u < f32(w) and v < f32(h)):
            continue
        there = others.depth[others.which[s], int(v), int(u)]
        if there > ZERO and abs(there - z) < same * z:
            agree += ONE
        elif there > beyond * z:
            against += ONE
    return agree, agree - against


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _window(view: View, rules: Rules, at: tuple[int, int], into: Floats) -> None:
    """Grey of the pixels around one, above its own, and their weight, (T, 2); 0 where there is none."""
    y, x = at
    h, w = view.grey.shape
    for t in range(len(rules.window)):
        column, row = x + int(rules.window[t, 0]), y + int(rules.window[t, 1])
        into[t, 1] = ZERO
        if 0 <= column < w and 0 <= row < h and view.grey[row, column] >= ZERO:
            into[t, 0] = view.grey[row, column] - view.grey[y, x]
            into[t, 1] = rules.window[t, 2] * f32(math.exp(-abs(into[t, 0]) / f32(rules.contrast)))


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _look_up(grey: Floats, u: Any, v: Any) -> Any:
    """Grey between four pixels, below 0 if one of them does not count; pixel centres at +0.5."""
    h, w = grey.shape
    u, v = f32(u) - HALF, f32(v) - HALF
    if not (u >= ZERO and v >= ZERO and u < f32(w - 1) and v < f32(h - 1)):
        return -ONE
    column, row = int(u), int(v)
    fx, fy = u - f32(column), v - f32(row)
    a, b = grey[row, column], grey[row, column + 1]
    c, d = grey[row + 1, column], grey[row + 1, column + 1]
    if min(a, b, c, d) < ZERO:
        return -ONE
    return (a * (ONE - fx) + b * fx) * (ONE - fy) + (c * (ONE - fx) + d * fx) * fy


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _correlation(
    view: View, others: Others, s: int, rules: Rules, at: tuple[int, int], d: Any, window: Floats
) -> Any:
    """Weighted correlation of a pixel's window with another picture, all of it at one depth; 0 if not seen.

    Both are reckoned from the grey of the pixel, which changes nothing and leaves less to rounding.

    Args:
        view: of the pixel.
        others: the views that are asked.
        s: which of them.
        rules: how.
        at: row and column.
        d: depth.
        window: (T, 2) of :func:`_window`.
    """
    pose = others.poses[s]
    total = whole = mine = theirs = mine2 = theirs2 = both = ZERO
    for t in range(len(window)):
        weight = window[t, 1]
        whole += weight
        if not weight > ZERO:
            continue
        u, v, _ = _place(pose, f32(at[1]) + rules.window[t, 0], f32(at[0]) + rules.window[t, 1], d)
        there = f32(_look_up(others.grey[others.which[s]], u, v))
        if there < ZERO:
            continue
        here, there = window[t, 0], there - view.grey[at]
        total += weight
        mine += weight * here
        theirs += weight * there
        mine2 += weight * here * here
        theirs2 += weight * there * there
        both += weight * here * there
    if total < f32(rules.shown) * whole or not total > ZERO:
        return ZERO
    mine, theirs = mine / total, theirs / total
    noise = f32(rules.noise)
    one = max(mine2 / total - mine * mine, ZERO) + noise
    two = max(theirs2 / total - theirs * theirs, ZERO) + noise
    return (both / total - mine * theirs) / f32(math.sqrt(one * two))


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _alike(
    view: View, others: Others, rules: Rules, at: tuple[int, int], d: Any, window: Floats, highest: Floats
) -> Any:
    """Mean of the highest correlations of the pictures at a depth; ``highest`` (best,) is written in."""
    highest[:] = -ONE
    for s in range(len(others.poses)):
        value = f32(_correlation(view, others, s, rules, at, f32(d), window))
        for k in range(len(highest)):
            if value > highest[k]:
                value, highest[k] = highest[k], value
    return highest.mean()


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _contested(view: View, rules: Rules, at: tuple[int, int]) -> bool:
    """Whether any view puts something else at a pixel that has a depth."""
    d = view.depth[at]
    if not d > ZERO:
        return False
    for s in range(len(view.told)):
        if view.told[s, at[0], at[1]] > ZERO and abs(view.told[s, at[0], at[1]] - d) > f32(rules.same) * d:
            return True
    return False


@njit(nogil=True, cache=True, error_model="numpy")
def settle(view: View, others: Others, rules: Rules, out: Floats) -> None:
    """Depths (H, W) of a view, each its own or that of another view which is worth more.

    Args:
        view: whose pixels are contested.
        others: the views that are asked.
        rules: how.
        out: (H, W) where the depths go.
    """
    h, w = view.depth.shape
    window = np.empty((len(rules.window), 2), np.float32)
    highest = np.empty(min(rules.best, len(others.poses)), np.float32)
    for y in range(h):
        for x in range(w):
            at, own = (y, x), view.depth[y, x]
            out[y, x] = own
            if not _contested(view, rules, at):
                continue
            for_own = _votes(view, others, rules, at, own)[1] + ONE
            asked, needed = False, ZERO
            for s in range(len(others.poses)):
                d = view.told[s, y, x]
                if not d > ZERO or abs(d - own) <= f32(rules.same) * own:
                    continue
                agree, votes = _votes(view, others, rules, at, d)
                if agree < rules.least or votes < for_own - rules.behind:
                    continue
                if not asked:
                    asked = True
                    _window(view, rules, at, window)
                    needed = for_own + rules.margin
                    needed += rules.worth * _alike(view, others, rules, at, own, window, highest)
                score = votes + rules.worth * _alike(view, others, rules, at, d, window, highest)
                if score > needed:
                    needed, out[y, x] = score, d
