"""Depths of all views moved onto the planes that they show together."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from tco.consensus import Agreement, agreed
from tco.options import ConsensusConfig
from tco.planar.fit import find, refit
from tco.planar.label import labelled
from tco.planar.view import Plane, shown
from tco.polish import too_uncertain
from tco.types import Cameras, Prediction, Priors, Views

ROUNDS = 3
"""How often pixels are labelled and planes fitted again."""
EVERY, SHOWN = 3, 12
"""Every so many views take part in that, but not more than so many, at half their size; all are labelled in
the end."""


@dataclass(frozen=True)
class OnPlanes:
    """Depths of which some are those of planes.

    Attributes:
        agreement: with these depths, on the CPU.
        planes: that were found.
        labels: (V, H, W) 0 where a pixel kept its depth, else the number of its plane, from 1.
    """

    agreement: Agreement
    planes: tuple[Plane, ...]
    labels: Tensor


def together(
    prediction: Prediction, cameras: Cameras, views: Views, priors: Priors, config: ConsensusConfig,
    seed: int = 0,
) -> OnPlanes:  # fmt: skip
    """What the views agree on and, where that is flat, the plane: consensus, then planes.

    Args:
        prediction: of all V views, each by itself.
        cameras: of all V views.
        views: whose valid pixels count, and which are wanted.
        priors: see :func:`tco.consensus.agreed`.
        config: settings of both.
        seed: of the planes that are drawn.

    Raises:
        ValueError: as :func:`tco.consensus.agreed`.
    """
    agreement = agreed(prediction, cameras, views, priors, config).to("cpu")
    consequence = "depths are not moved onto planes (--consensus_uncertainty)"
    if config.planes == 0 or (
        priors.cameras is not None
        and too_uncertain(priors, views.size, config.consensus_uncertainty, consequence)
    ):
        return OnPlanes(agreement, (), torch.zeros_like(agreement.error, dtype=torch.int64))
    return flattened(agreement, cameras.to("cpu"), views.to("cpu"), config, seed)


@torch.no_grad()
def flattened(
    agreement: Agreement, cameras: Cameras, views: Views, config: ConsensusConfig, seed: int = 0
) -> OnPlanes:
    """Depths of the wanted views moved onto planes, where they are on one. All on the CPU.

    Args:
        agreement: of V views. Depths that are not positive and finite stay.
        cameras: of all V views.
        views: pictures, and which pixels count.
        config: settings.
        seed: of the planes that are drawn.
    """
    prediction, count = agreement.prediction, len(views)
    full = [shown(prediction, cameras, views, i) for i in range(count)]
    planes = find(full, config, np.random.default_rng(seed))
    some = [shown(prediction, cameras, views, i, 2) for i in range(0, count, max(EVERY, -(-count // SHOWN)))]
    wanted = [full[i] for i in views.wanted]
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for _ in range(ROUNDS):
            labels = list(pool.map(partial(labelled, planes=planes, config=config), some))
            planes = refit(some, labels, planes, config, count)
        labels = list(pool.map(partial(labelled, planes=planes, config=config), wanted))
    depth = prediction.depth.clone()
    chosen = torch.zeros_like(depth, dtype=torch.int64)
    for i, view, label in zip(views.wanted, wanted, labels, strict=True):
        chosen[i] = torch.from_numpy(label)
        for k, plane in enumerate(planes):
            on = chosen[i] == k + 1
            depth[i] = torch.from_numpy(plane.depth(view)).to(depth).where(on, depth[i])
    moved = replace(agreement, prediction=replace(prediction, depth=depth))
    return OnPlanes(moved, tuple(planes), chosen)
