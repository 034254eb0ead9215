"""What comes of an optimisation: refined depths where the views agree on them, consensus, planes, contest.

Refinement (:mod:`tco.polish`) brings depths nearer to the truth where the pictures have texture, and moves
them at random where they have none: there colours say nothing and any step is as good. What it did is told by
asking the views together (:mod:`tco.consensus`) with the depths of before and with those of after: where it
did harm they lie further apart. So a pixel takes what the views said together before if around it their
standard error has grown by more than a factor. It keeps the larger error: that depths can be moved about
without colours objecting is a reason to doubt them.

Each view's own depths stay refined everywhere: fusion takes what several find alike, and depths that were
moved at random are not among that.

In the end depths that others contradict are replaced (:mod:`tco.contest`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from tco.consensus import Agreement, agreed
from tco.contest import settled
from tco.options import ConsensusConfig, TCOConfig
from tco.planar.run import OnPlanes, on_planes
from tco.planar.view import SIDE
from tco.types import Cameras, Prediction, Priors, Views

if TYPE_CHECKING:
    from tco.optimize import Outcome

AROUND = 10
"""Pixels to each side over which standard errors are averaged, in views of ``SIDE``² pixels."""
LEAST, MOST = 1e-4, 0.5
"""Bounds of a standard error there; where too few views spoke it is the larger one."""


@dataclass(frozen=True)
class Conclusion:
    """What the views say in the end, on the CPU.

    Attributes:
        agreement: their depths, and standard errors of these. Where a depth is another view's, the error is
            what the two differ by, as a logarithm of their ratio, if that is larger.
        flat: the same before depths were contested.
        taken: (V, H, W) where a depth is another view's.
    """

    agreement: Agreement
    flat: OnPlanes
    taken: Tensor


def concluded(outcome: Outcome, views: Views, priors: Priors, config: TCOConfig, seed: int = 0) -> Conclusion:
    """What the views say together, with refined depths or those of before; then :func:`finished`.

    Args:
        outcome: of :func:`tco.optimize.optimize`.
        views: that were optimised.
        priors: that it was given.
        config: its settings.
        seed: of the planes that are drawn.

    Raises:
        ValueError: as :func:`tco.consensus.agreed`.
    """
    prediction, cameras = outcome.prediction, outcome.cameras
    agreement = agreed(prediction, cameras, views, priors, config.consensus)
    growth = config.polish.polish_growth
    if outcome.before is not None and growth > 0 and agreement.prediction is not prediction:
        before = agreed(outcome.before, cameras, views, priors, config.consensus)
        keep = grown(before.error, agreement.error) <= growth
        depth = agreement.prediction.depth.where(keep, before.prediction.depth)
        error = agreement.error.where(keep, torch.maximum(agreement.error, before.error))
        agreement = Agreement(replace(agreement.prediction, depth=depth), error)
    return finished(agreement, prediction, cameras, views, priors, config.consensus, seed)


def finished(
    agreement: Agreement, prediction: Prediction, cameras: Cameras, views: Views, priors: Priors,
    config: ConsensusConfig, seed: int = 0,
) -> Conclusion:  # fmt: skip
    """What views agree on, put on planes and contested.

    Args:
        agreement: of all V views; neither is done if it is of the ``prediction`` itself, as nobody was asked.
        prediction: of all V views, each by itself.
        cameras: of all V views.
        views: pictures, which pixels count, which views are wanted.
        priors: whose ``overlap`` says which views overlap best.
        config: settings.
        seed: of the planes that are drawn.
    """
    flat = on_planes(agreement, prediction, cameras, views, config, seed)
    if agreement.prediction is prediction:
        return Conclusion(flat.agreement, flat, torch.zeros_like(flat.labels, dtype=torch.bool))
    assert priors.overlap is not None
    found, error = flat.agreement.prediction.depth, flat.agreement.error
    depth, taken = settled(found, cameras.to("cpu"), views.to("cpu"), priors.overlap, config)
    apart = (depth / found).log().abs().where(taken, torch.zeros_like(error))
    told = Agreement(replace(flat.agreement.prediction, depth=depth), torch.maximum(error, apart))
    return Conclusion(told, flat, taken)


def grown(before: Tensor, after: Tensor) -> Tensor:
    """Factor (V, H, W) by which standard errors (V, H, W) have grown around a pixel, in the mean of logs."""
    side = math.sqrt(before.shape[-2] * before.shape[-1])
    r = max(1, round(AROUND * side / SIDE))
    change = (after.clamp(LEAST, MOST) / before.clamp(LEAST, MOST)).log().unsqueeze(1)
    return F.avg_pool2d(change, 2 * r + 1, 1, r, count_include_pad=False).squeeze(1).exp()
