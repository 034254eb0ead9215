"""Compiled loops of :mod:`tco.planar.label`: one label a pixel, of least energy on a grid.

The energy of labels l is

    E(l) = Σ_p U_p(l_p) + Σ_pq w_pq (min(1, |L_p(l_p) − L_q(l_q)| / τ) + κ [l_p ≠ l_q])

over pixels p and their neighbours q to the right and below, but two pixels of the same label above 0 cost
nothing: they are on one plane, whatever its slope. Label 0 is a surface of any form and pays for its steps.

Messages are passed as in sequential tree-reweighted message passing (Kolmogorov, Convergent tree-reweighted
message passing for energy minimization, PAMI 2006), which is exact where the grid is one line.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Labels = NDArray[np.int64]
f32, ONE = np.float32, np.float32(1)

LANES = 8
"""Labels are made a multiple of this many, so that their loops are vector instructions without a rest. What
is added changes, and nothing asks for it."""
ORDER = {"nnan", "nsz"}
"""The compiler may take the least of numbers in any order; there is no NaN among them."""


@njit(nogil=True, cache=True, inline="always")
def step_cost(one: int, other: int, log: float, other_log: float, kappa: float) -> float:
    """Cost of two neighbours' labels, for a weight of one, by the logarithms of depth they give, over τ."""
    if one == other and one > 0:
        return 0.0
    step = min(1.0, abs(log - other_log))
    return step if one == other else step + kappa


@njit(nogil=True, cache=True, fastmath=ORDER)
def _send(
    own: Floats, labels: int, logs: Floats, here: Any, there: Any, terms: tuple[Any, Any], best: Floats,
    message: Floats,
) -> None:  # fmt: skip
    """Message from a pixel to its neighbour, its least entry zero.

    Args:
        own: (K,) the pixel's share of its costs and of all messages to it, without the neighbour's.
        labels: how many of the K there are.
        logs: (H · W · K,), over τ.
        here: where the pixel's begin.
        there: where the neighbour's begin.
        terms: weight and κ.
        best: (K,) room.
        message: (H · W · K,) that it is written to.
    """
    weight, kappa = terms
    count = len(best)
    cheapest = own[0]
    for j in range(1, labels):
        cheapest = min(cheapest, own[j])
    most = cheapest + weight * (ONE + kappa)  # whatever the two labels, a border costs no more
    for k in range(count):
        best[k] = most
    for j in range(labels):
        if own[j] < most:
            log, dearer = logs[here + np.uint64(j)], own[j] + weight * kappa
            for k in range(count):
                step = min(ONE, abs(log - logs[there + np.uint64(k)]))
                best[k] = min(best[k], dearer + weight * step)
            same = f32(step_cost(j, j, log, logs[there + np.uint64(j)], kappa))
            best[j] = min(best[j], own[j] + weight * same)
    least = best[0]
    for k in range(1, labels):
        least = min(least, best[k])
    for k in range(count):
        message[there + np.uint64(k)] = best[k] - least


@njit(nogil=True, cache=True)
def _pass_on(
    unary: Floats, logs: Floats, right: Floats, down: Floats, kappa: Any, messages: Floats,
    shape: tuple[int, int, int], forth: bool,
) -> None:  # fmt: skip
    """One pass over all pixels, from the first to the last or back, of the messages (4, H · W · K).

    Message 0 comes from the left, 1 from the right, 2 from above, 3 from below. ``shape`` is H, W and the
    number of labels, of which ``unary`` and ``logs`` (H · W · K) have a few more.
    """
    h, w, labels = shape
    count = len(unary) // (h * w)
    mine, own, best = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    left, beyond, above, below = messages[0], messages[1], messages[2], messages[3]
    pixel, row = np.uint64(count), np.uint64(count * w)
    for step in range(h * w):
        at = step if forth else h * w - 1 - step
        y, x = divmod(at, w)
        p, here = np.uint64(at), np.uint64(at * count)
        share = ONE / f32(max((x > 0) + (y > 0), (x + 1 < w) + (y + 1 < h), 1))
        for k in range(count):
            i = here + np.uint64(k)
            mine[k] = share * (unary[i] + (left[i] + beyond[i] + above[i] + below[i]))
        if forth and x + 1 < w:
            _without(mine, beyond, here, own)
            _send(own, labels, logs, here, here + pixel, (right[p], kappa), best, left)
        if forth and y + 1 < h:
            _without(mine, below, here, own)
            _send(own, labels, logs, here, here + row, (down[p], kappa), best, above)
        if not forth and x > 0:
            _without(mine, left, here, own)
            _send(own, labels, logs, here, here - pixel, (right[p - np.uint64(1)], kappa), best, beyond)
        if not forth and y > 0:
            _without(mine, above, here, own)
            _send(own, labels, logs, here, here - row, (down[p - np.uint64(w)], kappa), best, below)


@njit(nogil=True, cache=True, inline="always")
def _without(mine: Floats, message: Floats, here: Any, own: Floats) -> None:
    """What a pixel tells a neighbour by, (K,): its share without the message that came from there."""
    for k in range(len(own)):
        own[k] = mine[k] - message[here + np.uint64(k)]


@njit(nogil=True, cache=True)
def least_labels(
    unary: Floats, logs: Floats, right: Floats, down: Floats, terms: tuple[float, float], sweeps: int
) -> Labels:
    """Labels (H, W) of low energy.

    Args:
        unary: (H, W, K) cost U of each label.
        logs: (H, W, K) logarithm L of the depth that a label gives.
        right: (H, W) weight w between a pixel and the one to its right; the last column counts nothing.
        down: (H, W) the same to the one below; the last row counts nothing.
        terms: τ and κ.
        sweeps: passes there and back.
    """
    h, w, labels = unary.shape
    count = -(-labels // LANES) * LANES
    tau, kappa = f32(terms[0]), f32(terms[1])
    cost, log = np.zeros((h, w, count), np.float32), np.zeros((h, w, count), np.float32)
    cost[..., :labels], log[..., :labels] = unary, logs / tau
    messages = np.zeros((4, h * w * count), np.float32)
    flat = cost.reshape(-1), log.reshape(-1), right.reshape(-1), down.reshape(-1)
    for _ in range(sweeps):
        _pass_on(*flat, kappa, messages, (h, w, labels), True)
        _pass_on(*flat, kappa, messages, (h, w, labels), False)
    beyond, below = messages[1].reshape((h, w, count)), messages[3].reshape((h, w, count))
    found = np.zeros((h, w), np.int64)
    for y in range(h):
        for x in range(w):
            best = np.inf
            for k in range(labels):
                total = cost[y, x, k] + beyond[y, x, k] + below[y, x, k]
                if x > 0:
                    j = found[y, x - 1]
                    total += right[y, x - 1] * step_cost(j, k, log[y, x - 1, j], log[y, x, k], kappa)
                if y > 0:
                    j = found[y - 1, x]
                    total += down[y - 1, x] * step_cost(j, k, log[y - 1, x, j], log[y, x, k], kappa)
                if total < best:
                    best, found[y, x] = total, k
    return found
