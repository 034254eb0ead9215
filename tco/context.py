"""The depths of all views that steps compare with: when they are too old, and how new ones are put in."""

from __future__ import annotations

from dataclasses import replace

from tco.types import Prediction


def due(number: int, every: int) -> bool:
    """Whether the depths of all views are computed anew before a step: every few of them, not at first."""
    return number > 0 and number % every == 0


def detached(prediction: Prediction) -> Prediction:
    """The prediction without its history of computation."""
    depth, confidence = prediction.depth.detach(), prediction.confidence.detach()
    stages = tuple(s.detach() for s in prediction.stages)
    rays = None if prediction.rays is None else prediction.rays.detach()
    return replace(prediction, depth=depth, confidence=confidence, stages=stages, rays=rays)


def merged(every: Prediction, part: Prediction) -> Prediction:
    """The prediction of all V views with those of ``part`` replaced; neither is changed."""
    depth, confidence, views = every.depth.clone(), every.confidence.clone(), list(part.views)
    depth[views], confidence[views] = part.depth, part.confidence
    stages = tuple(s.clone() for s in every.stages)
    for whole, new in zip(stages, part.stages, strict=True):
        whole[views] = new
    rays = every.rays
    if rays is not None and part.rays is not None:
        rays = rays.clone()
        rays[views] = part.rays
    return replace(every, depth=depth, confidence=confidence, stages=stages, rays=rays)
