"""Compiled loops that fuse the correlations of several sources on a CPU, hypothesis by hypothesis.

As :class:`tco.backbones.fusing.Fusing` has it: two small layers make a few channels and a weight of each
cell's correlations, and the channels are summed by weight over the sources. In torch a dozen passes over
memory do that, and take longer than the correlations themselves; here the numbers of some cells at a time
stay in the cache, and cells that a source does not see are passed over.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tco._elementary import exp

Floats = NDArray[np.float32]
f32 = np.float32
CELLS = 128
"""Cells that are done at a time."""


class Layers(NamedTuple):
    """Two layers with a ReLU between, of G correlations of a cell that is seen.

    Attributes:
        into: (H, G) weights, and their bias: (H,).
        out: (C + 1, H), and its out_bias: (C + 1,); the last is the logarithm of the weight.
    """

    into: Floats
    bias: Floats
    out: Floats
    out_bias: Floats


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy", inline="always")
def _layer(x: Floats, weights: Floats, bias: Floats, out: Floats) -> None:
    """Weights (O, I) times x (I, N) and the bias (O,), into ``out`` (O, N)."""
    inputs, cells = x.shape
    for o in range(len(bias)):
        row = out[o]
        for n in range(cells):
            row[n] = bias[o]
        for i in range(inputs):
            weight, column = weights[o, i], x[i]
            for n in range(cells):
                row[n] += weight * column[n]


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def fuse(
    correlations: Floats, seen: Floats, layers: Layers, total: Floats, weights: Floats, bound: float
) -> None:
    """Add what a source says of N cells to sums.

    Args:
        correlations: (N, G).
        seen: (N,) 1 where the source sees the cell, else 0.
        layers: see there.
        total: (N, C) sums of channels times weights.
        weights: (N,) sums of weights.
        bound: of the logarithm of a weight.
    """
    most = f32(bound)
    cells, groups = correlations.shape
    hidden, channels = len(layers.bias), total.shape[1]
    at, x = np.empty(CELLS, np.int64), np.zeros((groups, CELLS), np.float32)
    h, out = np.empty((hidden, CELLS), np.float32), np.empty((channels + 1, CELLS), np.float32)
    count = 0
    for cell in range(cells):
        if seen[cell] > 0:
            at[count] = cell
            for g in range(groups):
                x[g, count] = correlations[cell, g]
            count += 1
        if count < CELLS and cell + 1 < cells:
            continue
        _layer(x, layers.into, layers.bias, h)
        for i in range(hidden):
            row = h[i]
            for n in range(CELLS):
                row[n] = max(row[n], f32(0))
        _layer(h, layers.out, layers.out_bias, out)
        weight = out[channels]
        for n in range(CELLS):
            weight[n] = exp(min(max(weight[n], -most), most))
        for n in range(count):
            weights[at[n]] += weight[n]
            for c in range(channels):
                total[at[n], c] += weight[n] * out[c, n]
        count = 0
