"""The depths of all views that steps compare with: the first ones, and when and how new ones replace them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F

from tco.backbones.base import Backbone, Drafts
from tco.types import Cameras, Prediction


def first_word(backbone: Backbone, encoded: Any) -> Prediction:
    """What the network says of all views at first, at a part of the resolution if it can: it is not kept."""
    return backbone.draft(encoded) if isinstance(backbone, Drafts) else backbone.decode(encoded)


def enlarged(prediction: Prediction, size: tuple[int, int]) -> Prediction:
    """A prediction for maps of ``size`` (H, W), a whole number of times its own, by bilinear interpolation.

    Inverse depths are interpolated, which are linear on planes; so are confidences.
    """
    factor = size[1] // prediction.depth.shape[-1]
    if factor == 1:
        return prediction
    maps = torch.stack([1 / prediction.depth, prediction.confidence], 1)
    inverse, confidence = F.interpolate(maps, scale_factor=float(factor), mode="bilinear").unbind(1)
    scale = prediction.cameras.K.new_tensor([factor, factor, 1])
    cameras = Cameras(prediction.cameras.world_from_cam, prediction.cameras.K * scale[:, None])
    return replace(prediction, depth=1 / inverse, confidence=confidence, cameras=cameras)


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
