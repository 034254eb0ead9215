"""What the views agree on, told to the network as further points.

A network that takes triangulated points as input leans on them: it interpolates between those that are near,
and where there are none, on plain walls and floors, it is on its own. Yet many pixels there are matched well,
and by several views alike. So the network is asked twice. What it says first goes through the consensus of
the views and onto their planes (:mod:`tco.planar`); of the pixels whose depths are then known well and that
are far from any point, some are drawn and given to it with the points, and it is asked again. Matches are not
looked for anew, so that this costs a decoding, at a part of the resolution if the network can.

They are input alone: no penalty holds depths to them, since they are the network's own word.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from tco.backbones.base import Backbone
from tco.consensus import Agreement
from tco.context import first_word
from tco.options import TCOConfig
from tco.planar.run import OnPlanes, together
from tco.polish import displacement
from tco.types import Prediction, Priors, SparseDepth, Views

LEAST = 0.003
"""Relative errors of agreed depths are at least this: their spread does not tell what all get wrong."""
FEWEST_VIEWS = 8
"""Views that it takes: how far apart a few are tells little of how wrong they are together."""
UNTRACKED = -1
"""Identity of points that are of one view alone."""


@torch.no_grad()
def told(
    backbone: Backbone, encoded: Any, views: Views, priors: Priors, config: TCOConfig, seed: int = 0
) -> tuple[Any, Prediction | None, dict[int, SparseDepth]]:
    """The network's features with what the views agree on as further points.

    Args:
        backbone: the network, not adapted.
        encoded: its features of the V views.
        views: of which the wanted ones are told of.
        priors: cameras, points, overlap.
        config: settings; ``hints`` and ``consensus`` of them.
        seed: of what is drawn.

    Returns:
        Features; what the network said that was asked last, of all views, perhaps at a part of the
        resolution; and the further points of each view that has some. Where no view has any pixel that is
        agreed on: ``encoded`` itself, and none. Where the network takes no points, views are few, or cameras
        are uncertain, it is not asked, and None is what it said.
    """
    points, now, said = dict[int, SparseDepth](), encoded, None
    rounds = config.hints.hint_rounds if _can_be_told(backbone, encoded, views, priors, config) else 0
    for _ in range(rounds):
        said = first_word(backbone, encoded) if said is None else backbone.decode(now)
        found = further_points(said, views, priors, config, seed)
        if not found:
            break
        assert priors.sparse is not None
        points, now = found, with_more(backbone, encoded, priors.sparse, found)
    return now, said, points


def _can_be_told(backbone: Backbone, encoded: Any, views: Views, priors: Priors, config: TCOConfig) -> bool:
    """Whether there are views to ask, cameras that are known well, and a network that takes points."""
    if priors.cameras is None or priors.sparse is None or priors.overlap is None:
        return False
    uncertain = displacement(priors, views.size) > config.consensus.consensus_uncertainty
    if not backbone.uses_cameras or len(views) < FEWEST_VIEWS or uncertain:
        return False
    return backbone.with_points(encoded, {0: priors.sparse[0]}) is not encoded


def further_points(
    prediction: Prediction, views: Views, priors: Priors, config: TCOConfig, seed: int = 0
) -> dict[int, SparseDepth]:
    """What the views agree on, by consensus and planes, as points; see :func:`agreed_points`.

    Args:
        prediction: of all views, each by itself, perhaps at a part of the resolution.
        views: of which the wanted ones get points.
        priors: with overlap and the points that these keep their distance from.
        config: settings; ``hints`` and ``consensus`` of them.
        seed: of the planes and of the pixels that are drawn.
    """
    assert priors.sparse is not None
    factor = views.size[0] // prediction.depth.shape[-2]
    if factor > 1:
        views, priors = (
            reduced(views, factor),
            replace(
                priors, cameras=prediction.cameras, sparse=tuple(scaled(s, 1 / factor) for s in priors.sparse)
            ),
        )
    flat = together(prediction, prediction.cameras, views, priors, config.consensus, seed)
    found = agreed_points(as_planes_are(flat), views, priors.sparse or (), config, seed)
    return {i: scaled(points, factor) for i, points in found.items()}


def as_planes_are(flat: OnPlanes) -> Agreement:
    """What the views agree on, where pixels on a plane are known as well as it is.

    How far apart the views were there is of no account any more. Nor is what the network thought of its
    depths, if the plane faces along a direction of the scene (:mod:`tco.planar.frame`): that it was unsure is
    why it should be told. Other planes may be a guess where nothing is sure, on gentle hills for instance.
    """
    prediction, on = flat.agreement.prediction, flat.labels > 0
    square = torch.tensor([False, *flat.square])[flat.labels]
    confidence = prediction.confidence.masked_fill(square, torch.inf)
    error = torch.where(on, flat.error, flat.agreement.error)
    return Agreement(replace(prediction, confidence=confidence), error)


def reduced(views: Views, factor: int) -> Views:
    """The views at a part of the resolution; of pixels that are valid alone."""
    invalid = F.max_pool2d((~views.valid).to(views.images).unsqueeze(1), factor).squeeze(1)
    return replace(views, images=F.avg_pool2d(views.images, factor), valid=invalid == 0)


def scaled(points: SparseDepth, factor: float) -> SparseDepth:
    """The same points in pixels of another size."""
    return replace(points, xy=points.xy * factor)


def with_more(
    backbone: Backbone, encoded: Any, given: Sequence[SparseDepth], more: Mapping[int, SparseDepth]
) -> Any:
    """Features of the network with more points of some views than are ``given`` of all."""
    if not more:
        return encoded
    return backbone.with_points(encoded, {i: joined(given[i], points) for i, points in more.items()})


def joined(one: SparseDepth, other: SparseDepth) -> SparseDepth:
    """All points of two sets, on the device of the first and of its types."""
    pairs = ((getattr(one, name), getattr(other, name)) for name in ("xy", "depth", "sigma", "track"))
    return SparseDepth(*(torch.cat([a, b.to(a)]) for a, b in pairs))


def agreed_points(
    agreement: Agreement, views: Views, given: Sequence[SparseDepth], config: TCOConfig, seed: int = 0
) -> dict[int, SparseDepth]:
    """Pixels of the wanted views whose agreed depths are known well, as points, on the CPU.

    Args:
        agreement: of all views, on the CPU. A pixel counts whose relative standard error is below
            ``hint_error`` and whose confidence is not below ``hint_confidence``.
        views: whose valid pixels count.
        given: points of each view; pixels nearer to one than ``hint_distance`` do not count.
        config: settings.
        seed: of the pixels that are drawn of those that count, at most ``hint_points`` a view, spread over
            the picture (:func:`spread`).

    Returns:
        By view; views without any are not in it.
    """
    c, found = config.hints, dict[int, SparseDepth]()
    generator = torch.Generator().manual_seed(seed)
    depths, confidence, error = (
        x.cpu() for x in (agreement.prediction.depth, agreement.prediction.confidence, agreement.error)
    )
    valid = views.valid.cpu()
    width = valid.shape[-1]
    for i in views.wanted:
        counts = valid[i] & (depths[i] > 0) & depths[i].isfinite()
        counts &= (error[i] < c.hint_error) & (confidence[i] >= c.hint_confidence)
        counts &= _far(given[i].xy, views.size, c.hint_distance * max(views.size))
        pixels = spread(counts, c.hint_points, torch.rand(counts.shape, generator=generator))
        if len(pixels):
            xy = torch.stack([pixels % width, pixels // width], 1) + 0.5
            depth, sigma = depths[i].flatten()[pixels], error[i].flatten()[pixels].clamp_min(LEAST)
            found[i] = SparseDepth(xy, depth, sigma, torch.full_like(pixels, UNTRACKED))
    return found


def spread(counts: Tensor, most: int, turn: Tensor) -> Tensor:
    """Pixels of a mask spread evenly: one of each square of the picture, then a second one, and so on.

    A pixel that counts no more is replaced by one other, and nothing else changes, so that results that
    differ in last bits stay near each other.

    Args:
        counts: (H, W) which pixels may be taken.
        most: how many are, at most; the picture has as many squares.
        turn: (H, W) numbers in [0, 1): in each square that with the least comes first.

    Returns:
        (N,) flat indices.
    """
    (height, width), flat = counts.shape, counts.flatten().nonzero().squeeze(1).numpy()
    side = max(1.0, math.sqrt(height * width / most))
    square = (flat // width // side) * math.ceil(width / side) + flat % width // side
    lot = turn.flatten().numpy()[flat]
    order = np.lexsort((lot, square))
    begins = np.flatnonzero(np.diff(square[order], prepend=-1))
    rank = np.arange(len(flat)) - np.repeat(begins, np.diff(begins, append=len(flat)))
    first = np.lexsort((lot[order], rank))[:most]
    return torch.from_numpy(flat[order[first]])


def _far(xy: Tensor, size: tuple[int, int], distance: float) -> Tensor:
    """Where (H, W) no point (N, 2) is nearer than so many pixels, counted from the pixel it is in."""
    free = np.ones(size, bool)
    columns, rows = np.floor(xy.cpu().numpy()).astype(int).T
    free[rows.clip(0, size[0] - 1), columns.clip(0, size[1] - 1)] = False
    if free.all():
        return torch.from_numpy(free)
    return torch.from_numpy(distance_transform_edt(free) >= distance)
