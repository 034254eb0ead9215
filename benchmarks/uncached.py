"""A backbone without memory, as the published loop uses one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import nn

from tco.backbones.base import Backbone
from tco.types import Prediction, Priors, SparseDepth, Views


class Uncached:
    """A backbone that keeps nothing between steps: whatever is asked, it starts from the pixels."""

    def __init__(self, inner: Backbone) -> None:
        self.inner = inner
        self.name, self.stride, self.uses_cameras = inner.name, inner.stride, inner.uses_cameras

    def encode(self, views: Views, priors: Priors) -> tuple[Views, Priors, Mapping[int, SparseDepth]]:
        return views, priors, {}

    def with_points(self, encoded: Any, points: Mapping[int, SparseDepth]) -> Any:
        return (*encoded[:2], points)

    def decode(
        self, encoded: Any, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        pictures, priors, points = encoded
        features = self.inner.encode(pictures, priors)
        if points:
            features = self.inner.with_points(features, points)
        return self.inner.decode(features, views, context)

    def decoder(self) -> nn.Module:
        return self.inner.decoder()
