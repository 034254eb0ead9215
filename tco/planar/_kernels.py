"""Compiled loops of :mod:`tco.planar.label`: one label a pixel, of least energy on a grid.

The energy of labels l is

    E(l) = Σ_p U_p(l_p) + Σ_pq w_pq (min(1, |L_p(l_p) − L_q(l_q)| / τ) + κ [l_p ≠ l_q])

over pixels p and their neighbours q to the right and below, but two pixels of the same label above 0 cost
nothing: they are on one plane, whatever its slope. Label 0 is a surface of any form and pays for its steps.

Messages are passed as in sequential tree-reweighted message passing (Kolmogorov, Convergent tree-reweighted
message passing for energy minimization, PAMI 2006), which is exact where the grid is one line.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Labels = NDArray[np.int64]


@njit(nogil=True, cache=True, inline="always")
def step_cost(one: int, other: int, log: float, other_log: float, kappa: float) -> float:
    """Cost of two neighbours' labels, for a weight of one, by the logarithms of depth they give, over τ."""
    if one == other and one > 0:
        return 0.0
    step = min(1.0, abs(log - other_log))
    return step if one == other else step + kappa


@njit(nogil=True, cache=True)
def _send(
    mine: Floats, messages: Floats, logs: Floats, here: tuple[int, int, int], there: tuple[int, int, int],
    terms: tuple[float, float], best: Floats,
) -> None:  # fmt: skip
    """Message (K,) from a pixel to its neighbour, its least entry zero.

    Args:
        mine: (K,) the pixel's share of its costs and of all messages to it.
        messages: (4, H, W, K); see :func:`_pass_on`.
        logs: (H, W, K), over τ.
        here: which message came from that neighbour, and row and column of the pixel.
        there: which message goes to the neighbour, and its row and column.
        terms: weight and κ.
        best: (K,) room.
    """
    weight, kappa = terms
    back, y, x = here
    to, v, u = there
    labels = len(mine)
    cheapest = np.float32(np.inf)
    for j in range(labels):
        cheapest = min(cheapest, mine[j] - messages[back, y, x, j])
    most = cheapest + weight * (1 + kappa)  # whatever the two labels, a border costs no more
    for k in range(labels):
        best[k] = most
    for j in range(labels):
        own = mine[j] - messages[back, y, x, j]
        if own < most:
            log, dearer = logs[y, x, j], own + weight * kappa
            for k in range(labels):
                best[k] = min(best[k], dearer + weight * min(np.float32(1), abs(log - logs[v, u, k])))
            best[j] = min(best[j], own + weight * step_cost(j, j, log, logs[v, u, j], kappa))
    least = np.float32(np.inf)
    for k in range(labels):
        least = min(least, best[k])
    for k in range(labels):
        messages[to, v, u, k] = best[k] - least


@njit(nogil=True, cache=True)
def _pass_on(
    unary: Floats, logs: Floats, right: Floats, down: Floats, kappa: float, messages: Floats, forth: bool
) -> None:
    """One pass over all pixels, from the first to the last or back, of the messages (4, H, W, K).

    Message 0 comes from the left, 1 from the right, 2 from above, 3 from below.
    """
    h, w, labels = unary.shape
    mine, room = np.empty(labels, np.float32), np.empty(labels, np.float32)
    for step in range(h * w):
        y, x = divmod(step if forth else h * w - 1 - step, w)
        before, after = (x > 0) + (y > 0), (x + 1 < w) + (y + 1 < h)
        share = np.float32(1.0 / max(before, after, 1))
        for k in range(labels):
            sent = messages[0, y, x, k] + messages[1, y, x, k] + messages[2, y, x, k] + messages[3, y, x, k]
            mine[k] = share * (unary[y, x, k] + sent)
        if forth and x + 1 < w:
            _send(mine, messages, logs, (1, y, x), (0, y, x + 1), (right[y, x], kappa), room)
        if forth and y + 1 < h:
            _send(mine, messages, logs, (3, y, x), (2, y + 1, x), (down[y, x], kappa), room)
        if not forth and x > 0:
            _send(mine, messages, logs, (0, y, x), (1, y, x - 1), (right[y, x - 1], kappa), room)
        if not forth and y > 0:
            _send(mine, messages, logs, (2, y, x), (3, y - 1, x), (down[y - 1, x], kappa), room)


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
    logs, kappa = logs / np.float32(terms[0]), np.float32(terms[1])
    messages = np.zeros((4, h, w, labels), np.float32)
    for _ in range(sweeps):
        _pass_on(unary, logs, right, down, kappa, messages, True)
        _pass_on(unary, logs, right, down, kappa, messages, False)
    found = np.zeros((h, w), np.int64)
    for y in range(h):
        for x in range(w):
            best = np.inf
            for k in range(labels):
                cost = unary[y, x, k] + messages[1, y, x, k] + messages[3, y, x, k]
                if x > 0:
                    j = found[y, x - 1]
                    cost += right[y, x - 1] * step_cost(j, k, logs[y, x - 1, j], logs[y, x, k], kappa)
                if y > 0:
                    j = found[y - 1, x]
                    cost += down[y - 1, x] * step_cost(j, k, logs[y - 1, x, j], logs[y, x, k], kappa)
                if cost < best:
                    best, found[y, x] = cost, k
    return found
