"""The depths of all views that steps compare with: when they are too old, and how new ones are put in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from tco.types import Prediction


class Freshness:
    """Which views' depths must be computed anew.

    All of them every ``every`` steps; or, if ``lazy``, in each step those of the views it needs that are
    as old as that.
    """

    def __init__(self, views: int, every: int, lazy: bool) -> None:
        self.made, self.every, self.lazy = [0] * views, every, lazy

    def due(self, number: int) -> bool:
        """Whether a step is one in which depths are computed anew, or might be."""
        return number > 0 and number % self.every == 0

    def stale(self, number: int, needed: Iterable[int]) -> list[int]:
        """Views to be computed before a step that needs some of them."""
        if self.lazy:
            return sorted(view for view in set(needed) if number - self.made[view] >= self.every)
        return list(range(len(self.made))) if self.due(number) else []

    def renew(self, views: Iterable[int], number: int) -> None:
        """Record that the depths of some views were computed before a step."""
        for view in views:
            self.made[view] = number


def detached(prediction: Prediction) -> Prediction:
    """The prediction without its history of computation."""
    depth, confidence = prediction.depth.detach(), prediction.confidence.detach()
    stages = tuple(s.detach() for s in prediction.stages)
    return replace(prediction, depth=depth, confidence=confidence, stages=stages)


def merged(every: Prediction, part: Prediction) -> Prediction:
    """The prediction of all V views with those of ``part`` replaced; neither is changed."""
    depth, confidence, views = every.depth.clone(), every.confidence.clone(), list(part.views)
    depth[views], confidence[views] = part.depth, part.confidence
    stages = tuple(s.clone() for s in every.stages)
    for whole, new in zip(stages, part.stages, strict=True):
        whole[views] = new
    return replace(every, depth=depth, confidence=confidence, stages=stages)
