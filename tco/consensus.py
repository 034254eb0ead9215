"""What the views say together: each pixel's depth moved to where the views that see it put the surface.

A network answers for one view at a time, and polishing moves one view at a time, so that what one gets
wrong another often has right. Here the depths D_j of all views are held fixed as evidence. A pixel of view i,
at its depth d, falls on a place of view j; with z its depth there, that view says that d should be multiplied
by D_j / z. The weighted median of what the views say, its own depth among it, is found, then the weighted
mean of what is near the median, and the pixel moves there. From the new place it asks again, for on a slanted
surface the answer depends on where one looks.

What agrees afterwards is no evidence any more, for all views were asked: who wants to know what the views
found independently of each other, as fusion does, takes the depths from before.

Medians of aligned depth maps: Merrell et al., Real-time visibility-based fusion of depth maps, ICCV 2007.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from tco import _consensus_kernels
from tco._consensus_kernels import ALL
from tco.geometry import invert, pixel_grid, project, rays, sample, transform
from tco.options import ConsensusConfig
from tco.schedule import most_overlapping
from tco.types import Cameras, Prediction, Views

JUMP = 1.1
"""Ratio of the depths in a square of nine pixels above which there is an edge among them, and what is
interpolated there is on neither side of it."""
BAND = 1 << 16
"""Pixels of a view that are asked about together where memory grows with their number."""


def agreed(
    prediction: Prediction, cameras: Cameras, views: Views, overlap: Tensor, config: ConsensusConfig
) -> Prediction:
    """The prediction with the depths of all wanted views moved to what the views say together.

    Args:
        prediction: of all V views. Confidences weigh what a view says, and stay as they are.
        cameras: of all V views.
        views: whose valid pixels count, and which of them are wanted.
        overlap: (V, V) how much views share; the ``consensus_views`` that share most are asked.
        config: settings.
    """
    if config.consensus_rounds == 0 or len(views) < 2:
        return prediction
    evidence = torch.stack(
        [1 / prediction.depth, prediction.confidence, (views.valid & smooth(prediction.depth)).float()], 1
    ).detach()
    moved = prediction.depth.detach().clone()
    cpu = moved.device.type == "cpu"
    for view in views.wanted:
        others = most_overlapping(overlap, view, config.consensus_views)
        if others:
            ask = _consensus_kernels.ask if cpu else ask_views
            moved[view] = ask(evidence, cameras, view, others, config)
    return replace(prediction, depth=moved, stages=())


def smooth(depth: Tensor) -> Tensor:
    """Where (V, H, W) no neighbour's depth is off by more than the ratio ``JUMP``."""
    inverse = (1 / depth).unsqueeze(1)
    high, low = (F.max_pool2d(sign * inverse, 3, 1, 1) * sign for sign in (1, -1))
    return (high < JUMP * low).squeeze(1)


def ask_views(
    evidence: Tensor, cameras: Cameras, view: int, others: list[int], config: ConsensusConfig
) -> Tensor:
    """Depth (H, W) of a view after all rounds, on any device; the plain twin of the compiled loop.

    Args:
        evidence: (V, 3, H, W) inverse depth, weight, and 1 where the two count.
        cameras: of all V views.
        view: whose pixels ask.
        others: views that are asked.
        config: settings.
    """
    h, w = evidence.shape[-2:]
    ray = rays(pixel_grid(h, w, evidence).reshape(-1, 2), cameras.K[view])
    other_from_view = invert(cameras.world_from_cam[others]) @ cameras.world_from_cam[view]
    inverse, weight = evidence[view, :2].reshape(2, -1)
    found = []
    for first in range(0, h * w, BAND):
        band = slice(first, first + BAND)
        own, depth = 1 / inverse[band], 1 / inverse[band]
        for _ in range(config.consensus_rounds):
            points = transform(other_from_view, (ray[band] * depth[:, None]).unsqueeze(0))
            xy, z = project(points, cameras.K[others])
            there = sample(evidence[others], xy)
            change = -torch.log((there[:, 0] * z).clamp_min(1e-9))
            inside = (z > 1e-6) & (there[:, 2] > ALL) & (change.abs() < config.consensus_reach)
            said = torch.cat([torch.log(own / depth)[None], change.where(inside, torch.zeros_like(change))])
            weights = torch.cat([weight[None, band], there[:, 1] * inside])
            depth = depth * torch.exp(robust_mean(said, weights, config.consensus_width))
        found.append(depth)
    return torch.cat(found).reshape(h, w)


def robust_mean(values: Tensor, weights: Tensor, width: float) -> Tensor:
    """Mean (N,) of what is near the weighted median of values (K, N), along K.

    Around the median m, a value v of weight w counts w / (1 + ((v − m) / width)²).
    """
    ordered, order = values.sort(0)
    sums = weights.gather(0, order).cumsum(0)
    at = (sums < sums[-1:] / 2).sum(0, keepdim=True).clamp_max(len(values) - 1)
    off = values - ordered.gather(0, at)
    near = weights / (1 + (off / width) ** 2)
    return (near * values).sum(0) / near.sum(0)
