"""What the views say together: each pixel's depth moved to where the views that see it put the surface.

A network answers for one view at a time, and polishing moves one view at a time, so that what one gets
wrong another often has right. Here the depths D_j of all views are held fixed as evidence. A pixel of view i,
at its depth d, falls on a place of view j. With z its depth there, the surface is D_j − z further away from
view j than the pixel is, and view j says that d should be d + D_j − z: exact for a surface that faces both.
The weighted median of what the views say, its own depth among it, is found, then the weighted mean of what is
near the median, and the pixel moves there. From the new place it asks again, for on a slanted surface the
answer depends on where one looks.

A view weighs by its confidence c_j, which stands for the inverse of the relative error of D_j; for the
pixel's depth that is an error D_j / d times as large, so that the weight is c_j d / z: near views know
better.

What agrees afterwards is no evidence any more, for all views were asked: who wants to know what the views
found independently of each other, as fusion does, takes the depths from before. How far apart they were is
kept as the standard error of what they say together, as if they erred each by itself.

On a CPU a compiled loop does it pixel by pixel; elsewhere, and in float64, tensor operations, with which it
agrees to rounding.

Medians of aligned depth maps: Merrell et al., Real-time visibility-based fusion of depth maps, ICCV 2007.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tco.geometry import invert, pixel_grid, project, rays, sample, transform
from tco.options import ConsensusConfig
from tco.parallel import in_ranges, side_by_side
from tco.polish import too_uncertain
from tco.schedule import most_overlapping
from tco.types import Cameras, Prediction, Priors, Views

JUMP = 1.1
"""Ratio of the depths in a square of nine pixels above which there is an edge among them, and what is
interpolated there is on neither side of it."""
ALL = 1 - 1e-5
"""Share of what is mixed at a place from which on all of it counts; less is at a border."""
HALF = 0.5 * (1 - 1e-6)
"""Share of the weights at which the median is: of an even number of equal ones the lower of the middle
two, however they are rounded."""
BAND = 1 << 15
"""Pixels of a view that ask together; memory grows with them times the views that are asked."""
FEWEST = 4.0
"""Views, counted as (Σ w)² / Σ w², of which it takes more to tell a spread: no weight is half of all then."""
SIGMA_OF_MAD = 1.4826
"""Standard deviation of a normal distribution by its median absolute deviation."""
OF_MEDIAN = math.sqrt(math.pi / 2)
"""Standard deviation of a median of many normal values, by that of their mean."""


@dataclass(frozen=True)
class Agreement:
    """What the views say together.

    Attributes:
        prediction: with the depths moved.
        error: (V, H, W) relative standard error of these depths if the views erred each by itself, by how
            far apart they were; infinite where too few spoke. What they get wrong alike it does not know of,
            so that real errors are larger (``docs/calibration.md``).
    """

    prediction: Prediction
    error: Tensor

    def to(self, device: torch.device | str) -> Agreement:
        """The same on another device."""
        return Agreement(self.prediction.to(device), self.error.to(device))


@torch.no_grad()
def agreed(
    prediction: Prediction, cameras: Cameras, views: Views, priors: Priors, config: ConsensusConfig
) -> Agreement:
    """The depths of all wanted views moved to what the views say together, and how far apart these were.

    Args:
        prediction: of all V views. Confidences weigh what a view says, and stay as they are; a depth that is
            not positive and finite is none, says nothing and stays.
        cameras: of all V views.
        views: whose valid pixels count, and which of them are wanted.
        priors: whose ``overlap`` says which views overlap best, and so are asked, and whose standard
            deviations of the cameras say whether asking is of any use.
        config: settings.

    Returns:
        With ``prediction`` itself where nobody is asked: of no round, a single view, or uncertain cameras.

    Raises:
        ValueError: the prediction is of some of the views alone, or there is no overlap among the priors.
    """
    if len(prediction.depth) != len(views):
        raise ValueError(f"all {len(views)} views must be predicted to agree, not {len(prediction.depth)}")
    overlap = priors.overlap
    if overlap is None:
        raise ValueError("which views to ask is not known: there is no overlap among the priors")
    error = torch.full_like(prediction.depth, math.inf)
    if config.consensus_rounds == 0 or len(views) < 2:
        return Agreement(prediction, error)
    consequence = "views are not asked for each other's depths, nor these put on planes or contested"
    if priors.cameras is not None and too_uncertain(
        priors, views.size, config.consensus_uncertainty, f"{consequence} (--consensus_uncertainty)"
    ):
        return Agreement(prediction, error)
    known = torch.isfinite(prediction.depth) & (prediction.depth > 0)
    depth = prediction.depth.where(known, torch.ones_like(prediction.depth))
    counts = (views.valid & known & smooth(depth)).to(depth)
    loops = depth.device.type == "cpu" and depth.dtype == torch.float32
    evidence = torch.stack([1 / depth, prediction.confidence, counts], -1 if loops else 1)
    ask = _asked_in_loops if loops else _asked
    moved = prediction.depth.clone()

    def move(view: int) -> None:
        others = most_overlapping(overlap, view, config.consensus_views)
        if others:
            asked, spread = ask(evidence, cameras, view, others, config)
            moved[view] = asked.where(known[view], moved[view])
            error[view] = spread.where(known[view], error[view])

    side_by_side(move, views.wanted, depth.device)
    return Agreement(replace(prediction, depth=moved, stages=()), error)


def smooth(depth: Tensor) -> Tensor:
    """Where (V, H, W) no neighbour's depth is off by more than the ratio ``JUMP``."""
    inverse = (1 / depth).unsqueeze(1)
    high, low = (F.max_pool2d(sign * inverse, 3, 1, 1) * sign for sign in (1, -1))
    return (high < JUMP * low).squeeze(1)


def _asked(
    evidence: Tensor, cameras: Cameras, view: int, others: list[int], config: ConsensusConfig
) -> tuple[Tensor, Tensor]:
    """Depth (H, W) of a view after all rounds, and its relative standard error (H, W).

    Args:
        evidence: (V, 3, H, W) inverse depth, confidence, and 1 where the two count.
        cameras: of all V views.
        view: whose pixels ask.
        others: views that are asked.
        config: settings.
    """
    h, w = evidence.shape[-2:]
    ray = rays(pixel_grid(h, w, evidence).reshape(-1, 2), cameras.K[view])
    other_from_view = invert(cameras.world_from_cam[others]) @ cameras.world_from_cam[view]
    inverse, confidence = evidence[view, :2].reshape(2, -1)
    theirs, K, found = evidence[others], cameras.K[others], []
    for first in range(0, h * w, BAND):
        band = slice(first, first + BAND)
        own = depth = 1 / inverse[band]
        for _ in range(config.consensus_rounds):
            points = transform(other_from_view, (ray[band] * depth[:, None]).unsqueeze(0))
            xy, z = project(points, K)
            said, weights = _words(sample(theirs, xy), z, depth, config.consensus_reach)
            said = torch.cat([torch.log(own / depth)[None], said])
            weights = torch.cat([confidence[None, band], weights])
            middle = weighted_median(said, weights)
            depth = depth * torch.exp(robust_mean(said, weights, config.consensus_width, middle))
        found.append(torch.stack([depth, standard_error(said, weights, middle)]))
    depth, error = torch.cat(found, 1).reshape(2, h, w)
    return depth, error


def _asked_in_loops(
    evidence: Tensor, cameras: Cameras, view: int, others: list[int], config: ConsensusConfig
) -> tuple[Tensor, Tensor]:
    """:func:`_asked` by a compiled loop; the evidence (V, H, W, 3) is in float32 on the CPU."""
    from tco._consensus_kernels import Asked, Rules, ask

    h, w = evidence.shape[1:3]
    ray = rays(pixel_grid(h, w, evidence).reshape(-1, 2), cameras.K[view])[:, :2].T.reshape(2, h, w)
    other_from_view = invert(cameras.world_from_cam[others].double()) @ cameras.world_from_cam[view].double()
    poses = (cameras.K[others].double() @ other_from_view[:, :3]).float().numpy()
    asked, reach = Asked(evidence.numpy(), np.array(others), poses), config.consensus_reach
    rules = Rules(
        config.consensus_rounds, math.exp(-reach), math.exp(reach), config.consensus_width, ALL, HALF, FEWEST,
        SIGMA_OF_MAD * OF_MEDIAN,
    )  # fmt: skip
    own, out = evidence[view].movedim(-1, 0)[:2].contiguous().numpy(), evidence.new_empty(2, h, w)
    places, into = ray.contiguous().numpy(), out.numpy()
    in_ranges(lambda *rows: ask(own, places, asked, rules, rows, into), h)
    depth, error = out
    return depth, error


def _words(there: Tensor, z: Tensor, depth: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """What S views say of N pixels: logarithms of factors of their depths (S, N); weights, 0 if not asked.

    Args:
        there: (S, 3, N) inverse depth, confidence and whether these count, where the pixels fall.
        z: (S, N) depth of the pixels there.
        depth: (N,) of the pixels in their own view.
        reach: see :class:`tco.options.ConsensusConfig`.
    """
    front = z > 1e-6
    z = z.where(front, torch.ones_like(z))
    surface = 1 / there[:, 0].clamp_min(1e-9)
    factor = 1 + (surface - z) / depth
    low, high = math.exp(-reach), math.exp(reach)
    near = (surface > low * z) & (surface < high * z) & (factor > low) & (factor < high)
    asked = front & (there[:, 2] > ALL) & near
    said = torch.log(factor.where(asked, torch.ones_like(factor)))
    return said, there[:, 1] * (depth / z) * asked


def robust_mean(values: Tensor, weights: Tensor, width: float, middle: Tensor) -> Tensor:
    """Mean (N,) of what is near the weighted median m of values (K, N), along K; ``middle`` is m (1, N).

    A value v of weight w counts w / (1 + ((v − m) / width)²).
    """
    off = values - middle
    near = weights / (1 + (off / width) ** 2)
    return (near * values).sum(0) / near.sum(0)


def standard_error(values: Tensor, weights: Tensor, middle: Tensor) -> Tensor:
    """Standard error (N,) of what values (K, N) say together, along K, by their spread: s √(π / 2n).

    s is 1.4826 times the weighted median distance from the weighted median, ``middle`` (1, N), times
    n / (n − 0.8) since one of few values is at no distance (Croux and Rousseeuw 1992), and n = (Σ w)² / Σ w².
    That is the median's, and a little more than that of :func:`robust_mean`. Infinite where n is not above
    ``FEWEST``.
    """
    off = (values - middle).abs()
    spread = SIGMA_OF_MAD * weighted_median(off, weights, upper=True).squeeze(0)
    count = weights.sum(0) ** 2 / (weights**2).sum(0).clamp_min(1e-30)
    enough = count > FEWEST
    count = count.where(enough, torch.ones_like(count))
    error = spread * OF_MEDIAN * count.sqrt() / (count - 0.8)
    return error.where(enough, torch.full_like(error, math.inf))


def weighted_median(values: Tensor, weights: Tensor, upper: bool = False) -> Tensor:
    """Of values (K, N) along K, as (1, N); the lower or upper one where two share the middle."""
    ordered, order = values.sort(0)
    sums = weights.gather(0, order).cumsum(0)
    half = 1 - HALF if upper else HALF
    at = (sums < sums[-1:] * half).sum(0, keepdim=True).clamp_max(len(values) - 1)
    return ordered.gather(0, at)
