"""Correlations with several sources fused into one volume, by attention over the sources per hypothesis."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np
import torch
from torch import Tensor, nn

from tco.parallel import in_ranges

MOST = 8.0
"""Bound of the logarithm of a weight."""
NONE = 1e-6
"""What is added to the sum of weights, so that what no source sees becomes 0."""


class Fusing:
    """A softmax accumulated source by source, so that memory does not grow with their number.

    Two layers make C channels and a weight of each cell's correlations. Without gradients in float32 on a CPU
    compiled loops do that, to rounding of float32 whatever type products are computed in elsewhere.
    """

    def __init__(
        self,
        layers: nn.Sequential,
        mixed: Callable[[torch.device], AbstractContextManager[object]],
        into: Tensor | None = None,
    ) -> None:
        """With nothing added yet.

        Args:
            layers: a linear layer from G + 2 numbers, a ReLU, and a linear layer to C + 1: the channels and
                the logarithm of their weight.
            mixed: products are computed in its type inside it.
            into: (..., C) where to make the result, without gradients; a new tensor by default.
        """
        self.layers, self.mixed, self.into = layers, mixed, into
        self.total: Tensor | None = None
        self.weights: Tensor | None = None

    def add(self, correlations: Tensor, seen: Tensor) -> None:
        """What one source says.

        Args:
            correlations: (..., G) of each cell, 0 where the source does not see it.
            seen: (...) 1 where it does, else 0.
        """
        plain = correlations.device.type == "cpu" and correlations.dtype == torch.float32
        if plain and not torch.is_grad_enabled():
            self._add_in_loops(correlations, seen)
            return
        seen = seen.unsqueeze(-1)
        with self.mixed(correlations.device):
            out = self.layers(torch.cat([correlations, seen, correlations.mean(-1, keepdim=True)], -1))
        weight = out[..., -1:].to(seen).clamp(-MOST, MOST).exp() * seen
        channels = weight * out[..., :-1]
        self.total = channels if self.total is None else self.total + channels
        self.weights = weight if self.weights is None else self.weights + weight

    def _add_in_loops(self, correlations: Tensor, seen: Tensor) -> None:
        """The same of numpy's arrays, in place."""
        from tco.backbones._fuse_kernels import Layers, fuse

        first, last = self.layers[0], self.layers[-1]
        assert isinstance(first, nn.Linear) and isinstance(last, nn.Linear)
        groups, channels = correlations.shape[-1], last.out_features - 1
        if self.total is None or self.weights is None:
            shape = (*seen.shape, channels)
            self.total = correlations.new_zeros(shape) if self.into is None else self.into.zero_()
            self.weights = seen.new_zeros((*seen.shape, 1))
        into, bias, out, out_bias = (
            p.detach().float().numpy() for p in (first.weight, first.bias, last.weight, last.bias)
        )
        # Where a cell is seen, that it is is a constant, and the mean is a sum of the correlations.
        mean = into[:, groups + 1 :] / groups
        layers = Layers(np.ascontiguousarray(into[:, :groups] + mean), bias + into[:, groups], out, out_bias)
        cells = correlations.contiguous().numpy().reshape(-1, groups)
        there, total = seen.contiguous().numpy().reshape(-1), self.total.view(-1, channels).numpy()
        weights = self.weights.view(-1).numpy()
        in_ranges(
            lambda a, b: fuse(cells[a:b], there[a:b], layers, total[a:b], weights[a:b], MOST), len(cells)
        )

    def result(self) -> Tensor:
        """Channels (..., C), 0 where no source saw anything.

        Raises:
            ValueError: no source was added.
        """
        if self.total is None or self.weights is None:
            raise ValueError("nothing was added that could be fused")
        if self.total.requires_grad:
            return self.total / (self.weights + NONE)
        result = self.total.div_(self.weights.add_(NONE))
        return result if self.into is None or self.into is result else self.into.copy_(result)
