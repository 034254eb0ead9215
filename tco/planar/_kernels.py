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
def step_cost(one: int, other: int, logs: Floats, others: Floats, tau: float, kappa: float) -> float:
    """Cost of two neighbours' labels, for a weight of one, by their logarithms of depth (K,) each."""
    if one == other and one > 0:
        return 0.0
    step = min(1.0, abs(logs[one] - others[other]) / tau)
    return step if one == other else step + kappa


@njit(nogil=True, cache=True)
def _send(
    mine: Floats, back: Floats, logs: Floats, others: Floats, terms: tuple[float, float, float], out: Floats
) -> None:
    """Message (K,) from a pixel to its neighbour into ``out``, its least entry zero.

    Args:
        mine: (K,) the pixel's share of its costs and of all messages to it.
        back: (K,) the message that came from that neighbour.
        logs, others: (K,) of the pixel and of the neighbour.
        terms: weight, τ and κ.
        out: where the message goes.
    """
    weight, tau, kappa = terms
    cheapest = np.float32(np.inf)
    for k in range(len(mine)):
        cheapest = min(cheapest, mine[k] - back[k])
    most = np.float32(cheapest + weight * (1 + kappa))  # whatever the two labels, a border costs no more
    least = np.float32(np.inf)
    for k in range(len(mine)):
        best = most
        for j in range(len(mine)):
            own = mine[j] - back[j]
            if own < best:
                best = min(best, own + weight * step_cost(j, k, logs, others, tau, kappa))
        out[k] = best
        least = min(least, best)
    for k in range(len(mine)):
        out[k] -= least


@njit(nogil=True, cache=True)
def _pass_on(
    unary: Floats, logs: Floats, right: Floats, down: Floats, terms: tuple[float, float], messages: Floats,
    forth: bool,
) -> None:  # fmt: skip
    """One pass over all pixels, from the first to the last or back, of the messages (4, H, W, K).

    Message 0 comes from the left, 1 from the right, 2 from above, 3 from below.
    """
    h, w, labels = unary.shape
    tau, kappa = terms
    mine = np.empty(labels, np.float32)
    for step in range(h * w):
        y, x = divmod(step if forth else h * w - 1 - step, w)
        before, after = (x > 0) + (y > 0), (x + 1 < w) + (y + 1 < h)
        share = np.float32(1.0 / max(before, after, 1))
        for k in range(labels):
            sent = messages[0, y, x, k] + messages[1, y, x, k] + messages[2, y, x, k] + messages[3, y, x, k]
            mine[k] = share * (unary[y, x, k] + sent)
        here = logs[y, x]
        if forth and x + 1 < w:
            to, known = messages[0, y, x + 1], messages[1, y, x]
            _send(mine, known, here, logs[y, x + 1], (right[y, x], tau, kappa), to)
        if forth and y + 1 < h:
            to, known = messages[2, y + 1, x], messages[3, y, x]
            _send(mine, known, here, logs[y + 1, x], (down[y, x], tau, kappa), to)
        if not forth and x > 0:
            to, known = messages[1, y, x - 1], messages[0, y, x]
            _send(mine, known, here, logs[y, x - 1], (right[y, x - 1], tau, kappa), to)
        if not forth and y > 0:
            to, known = messages[3, y - 1, x], messages[2, y, x]
            _send(mine, known, here, logs[y - 1, x], (down[y - 1, x], tau, kappa), to)


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
    tau, kappa = terms
    messages = np.zeros((4, h, w, labels), np.float32)
    for _ in range(sweeps):
        _pass_on(unary, logs, right, down, terms, messages, True)
        _pass_on(unary, logs, right, down, terms, messages, False)
    found = np.zeros((h, w), np.int64)
    for y in range(h):
        for x in range(w):
            best = np.inf
            for k in range(labels):
                cost = unary[y, x, k] + messages[1, y, x, k] + messages[3, y, x, k]
                if x > 0:
                    j = found[y, x - 1]
                    cost += right[y, x - 1] * step_cost(j, k, logs[y, x - 1], logs[y, x], tau, kappa)
                if y > 0:
                    j = found[y - 1, x]
                    cost += down[y - 1, x] * step_cost(j, k, logs[y - 1, x], logs[y, x], tau, kappa)
                if cost < best:
                    best, found[y, x] = cost, k
    return found
