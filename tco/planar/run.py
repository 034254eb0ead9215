"""Depths of all views moved onto the planes that they show together."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from tco.consensus import Agreement, agreed
from tco.options import ConsensusConfig
from tco.planar.fit import faces_along, find, refit
from tco.planar.frame import Frame, edges, frame_of
from tco.planar.hinges import hinged
from tco.planar.label import labelled
from tco.planar.view import Plane, Shown, shown
from tco.types import Cameras, Prediction, Priors, Views

ROUNDS = 3
"""How often pixels are labelled and planes fitted again."""
SHARED = 3.0
"""Views' worth of pixels that this is done with: many views take part at a lower resolution each, never at
more than half of it. In the end all are labelled at their own."""
LARGEST = 200_000
"""Pixels at most that are labelled at once; labels of larger views are coarser, their depths are not. This
bounds memory, at 1 kB a pixel and thread for 20 planes, and time. While planes are chosen from about twice as
many, those that are put up among them, it is half of that."""
WORKERS = 8
"""Threads at most."""
SMALLEST = 16
"""Pixels of the shorter side of a view in which planes are sought."""


@dataclass(frozen=True)
class OnPlanes:
    """Depths of which some are those of planes.

    Attributes:
        agreement: with these depths, on the CPU. Where a depth is a plane's, its standard error is the
            plane's if that is larger than what it was by how far apart the views were.
        before: the agreement without planes.
        planes: that were found.
        labels: (V, H, W) 0 where a pixel kept its depth, else the number of its plane, from 1.
        error: (V, H, W) relative standard error of the plane alone, infinite where there is none.
        square: of each plane, whether it faces along a direction of the scene.
    """

    agreement: Agreement
    before: Agreement
    planes: tuple[Plane, ...]
    labels: Tensor
    error: Tensor
    square: tuple[bool, ...]


def together(
    prediction: Prediction, cameras: Cameras, views: Views, priors: Priors, config: ConsensusConfig,
    seed: int = 0,
) -> OnPlanes:  # fmt: skip
    """What the views agree on and, where that is flat, the plane: consensus, then planes.

    Where nobody is asked, for instance because the cameras are uncertain, there are no planes either.

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
    agreement = agreed(prediction, cameras, views, priors, config)
    return on_planes(agreement, prediction, cameras, views, config, seed)


def on_planes(
    agreement: Agreement, prediction: Prediction, cameras: Cameras, views: Views, config: ConsensusConfig,
    seed: int = 0,
) -> OnPlanes:  # fmt: skip
    """The same of an agreement that is known already; on none if it is of the ``prediction`` itself."""
    if agreement.prediction is prediction:
        config = replace(config, planes=0)
    return flattened(agreement.to("cpu"), cameras.to("cpu"), views.to("cpu"), config, seed)


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
    chosen = torch.zeros_like(prediction.depth, dtype=torch.int64)
    of_plane = torch.full_like(prediction.depth, torch.inf)
    if config.planes == 0 or min(views.size) < SMALLEST:
        return OnPlanes(agreement, agreement, (), chosen, of_plane, ())
    show = partial(shown, prediction, cameras, views)
    planes = find(map(show, range(count)), count, config, np.random.default_rng(seed))
    shared = math.ceil(math.sqrt(count / SHARED))
    bound = math.ceil(math.sqrt(math.prod(views.size) / (LARGEST / 2)))
    stride = min(max(2, shared, bound), min(views.size) // SMALLEST)
    with ThreadPoolExecutor(min(torch.get_num_threads(), WORKERS)) as pool:
        some = list(pool.map(lambda i: show(i, stride), range(count)))
        frame = None
        if config.plane_square > 0:
            frame = frame_of(some, planes, list(pool.map(lambda i: edges(show(i)), range(count))))
        if frame is not None:
            planes += hinged(some, frame, planes)
        for _ in range(ROUNDS):
            labels = list(pool.map(partial(labelled, planes=planes, config=config, frame=frame), some))
            planes = refit(some, labels, planes, config, frame)
        of_view = partial(_view_on_planes, agreement, show, planes, config, frame)
        results = list(pool.map(of_view, views.wanted))
    depth = prediction.depth.clone()
    for i, (flat, error, label) in zip(views.wanted, results, strict=True):
        depth[i], of_plane[i], chosen[i] = flat, error, label
    error = torch.where(chosen > 0, torch.maximum(agreement.error, of_plane), agreement.error)
    moved = Agreement(replace(prediction, depth=depth), error)
    square = tuple(frame is not None and faces_along(plane, frame) for plane in planes)
    return OnPlanes(moved, agreement, tuple(planes), chosen, of_plane, square)


def _view_on_planes(
    agreement: Agreement, show: Callable[..., Shown], planes: Sequence[Plane], config: ConsensusConfig,
    frame: Frame | None, i: int,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Depth, standard error of the planes and labels (H, W) of one view."""
    view = show(i)
    stride = math.ceil(math.sqrt(view.depth.size / LARGEST))
    label = labelled(view if stride == 1 else show(i, stride), planes, config, frame)
    if stride > 1:
        rows, columns = (np.minimum(np.arange(n) // stride, n // stride - 1) for n in view.depth.shape)
        label = label[rows[:, None], columns]
    label = np.where(view.known, label, 0).ravel()
    depth = agreement.prediction.depth[i].clone(memory_format=torch.contiguous_format)
    error = torch.full_like(depth, torch.inf)
    for k, plane in enumerate(planes):
        on = np.flatnonzero(label == k + 1)
        part = view.at(on)
        there = plane.depth(part)
        met = there > 0
        label[on[~met]] = 0
        depth.view(-1)[on[met]] = torch.from_numpy(there[met]).to(depth)
        error.view(-1)[on[met]] = torch.from_numpy(plane.error(part, there)[met]).to(error)
    return depth, error, torch.from_numpy(label).reshape(depth.shape)
