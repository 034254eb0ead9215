"""Parameters of single pixels, learned beside or instead of adapters: the paper's ablations."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from tco.surfels import Adjustment
from tco.types import Prediction


class FreePixels(nn.Module):
    """A factor of each pixel's depth, of its surfel's radii, and a turn of it; the identity at first."""

    def __init__(self, depth: Tensor, free_depth: bool, free_surfels: bool) -> None:
        """Take shape, dtype and device from the depth (V, H, W)."""
        super().__init__()
        zeros = torch.zeros_like(depth)
        self.log_depth = nn.Parameter(zeros.clone()) if free_depth else None
        self.log_radii = nn.Parameter(zeros[..., None].repeat(1, 1, 1, 2)) if free_surfels else None
        self.turn = nn.Parameter(zeros[..., None].repeat(1, 1, 1, 3)) if free_surfels else None

    def apply_to(self, prediction: Prediction) -> Prediction:
        """The prediction with its depth times the factors of its pixels."""
        if self.log_depth is None:
            return prediction
        factor = torch.exp(self.log_depth[list(prediction.views)])
        return replace(prediction, depth=prediction.depth * factor)

    def adjustment(self, view: int) -> Adjustment | None:
        """What is learned of the surfels of a view."""
        if self.log_radii is None or self.turn is None:
            return None
        return Adjustment(self.log_radii[view], self.turn[view])
