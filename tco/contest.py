"""Depths that other views contradict, against those that they put in the same place.

The consensus (:mod:`tco.consensus`) moves a depth within reach, and planes take what is unsure. What is left
is of another surface: beside an edge, at thin things, where the network is sure of what is wrong. So a pixel
has other depths to choose from: each of the views that overlap best puts its own there, the nearest of those
that fall on the pixel. One that differs from the pixel's depth is weighed against it by

- views: those whose depth at its place is the same, less those that see through it, to something beyond, less
  those that put something before it, which would hide it from here. Counted so, what is in front and what is
  behind are in balance at the right depth;
- pictures: the mean of the highest correlations of a window around the pixel with other pictures, bilaterally
  weighted; a correlation of one is worth ``WORTH`` views.

Either alone takes more good depths than it mends bad ones: views err together, and a window of a picture
looks like others by chance. Depths of before planes are no better evidence for having been found
independently of each other: planes mend more than views have in common.

What is taken here has been found before by others, which do not become more by that: it is for the maps that
are written, not evidence for a fusion.

Visibility: Merrell et al., Real-time visibility-based fusion of depth maps, ICCV 2007 (stability). Weights of
the window: Schönberger et al., Pixelwise view selection for unstructured multi-view stereo, ECCV 2016.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tco.options import ConsensusConfig
from tco.planar.run import WORKERS
from tco.schedule import most_overlapping
from tco.types import Cameras, Views

SAME, BEYOND = 0.02, 0.05
"""Relative difference up to which two depths are one surface, and from which on one hides the other."""
RADIUS = 0.35
"""Pixels to each side that a pixel of another view covers, so that no gaps open between them."""
LEAST, BEHIND = 2.0, 2.0
"""Views that must agree with a depth that is taken; votes by which it may have fewer."""
WORTH = 20.0
"""Views that a correlation of one is worth."""
MARGIN = 2.0
"""Votes by which a depth must be worth more than the pixel's own."""
BEST = 3
"""Pictures whose correlations are taken, the highest: the others may not see the place."""
SIDE = 2
"""Pixels to each side of the window."""
CONTRAST, NOISE = 0.1, 1 / 12 / 255**2
"""Difference in grey, of 1, at which a pixel of the window counts 1 / e; variance that rounding to bytes
gives."""
SHOWN = 0.6
"""Share of the window's weight that another picture must show to say something."""


@torch.no_grad()
def settled(
    depth: Tensor, cameras: Cameras, views: Views, overlap: Tensor, config: ConsensusConfig
) -> tuple[Tensor, Tensor]:
    """Depths of which those that others contradict are replaced by what others see there.

    Args:
        depth: (V, H, W) on the CPU; one that is not positive and finite is none, says nothing and stays.
        cameras: of all V views, on the CPU.
        views: pictures, which pixels count, and which views are wanted: the others only take part.
        overlap: (V, V) by which views are asked, see :func:`tco.schedule.most_overlapping`.
        config: how many are.

    Returns:
        (V, H, W) depths; (V, H, W) bool, where they are another view's.
    """
    result, taken = depth.clone(), torch.zeros_like(depth, dtype=torch.bool)
    if config.contest_views == 0 or len(views) < 2:
        return result, taken
    known = (torch.isfinite(depth) & (depth > 0) & views.valid).numpy()
    maps = np.where(known, depth.numpy(), 0).astype(np.float32)
    grey = views.images.float().mean(1).where(views.valid, torch.tensor(-1.0)).numpy()

    def settle_one(i: int) -> None:
        others = most_overlapping(overlap, i, config.contest_views)
        if others:
            found = _settled(i, others, maps, grey, cameras)
            taken[i] = torch.from_numpy(found != maps[i])
            result[i] = torch.from_numpy(found).to(depth).where(taken[i], depth[i])

    with ThreadPoolExecutor(min(torch.get_num_threads(), WORKERS)) as pool:
        list(pool.map(settle_one, views.wanted))
    return result, taken


def _settled(
    i: int, others: list[int], maps: NDArray[np.float32], grey: NDArray[np.float32], cameras: Cameras
) -> NDArray[np.float32]:
    """Depths (H, W) of one view, by others of maps and grey pictures (V, H, W)."""
    from tco._contest_kernels import Others, Rules, View, carry, settle

    told = np.zeros((len(others), *maps.shape[1:]), np.float32)
    for k, j in enumerate(others):
        carry(maps[j], _pose(cameras, i, j), RADIUS, told[k])
    poses = np.stack([_pose(cameras, j, i) for j in others])
    rules = Rules(SAME, BEYOND, LEAST, BEHIND, WORTH, MARGIN, BEST, _window(), CONTRAST, NOISE, SHOWN)
    out = np.empty_like(maps[i])
    settle(View(maps[i], grey[i], told), Others(maps, grey, np.array(others), poses), rules, out)
    return out


def _pose(cameras: Cameras, target: int, source: int) -> NDArray[np.float32]:
    """(3, 4) that takes (u, v, 1) d and 1 of the source view to (u, v, 1) z of the target view."""
    target_from_source = torch.linalg.solve(
        cameras.world_from_cam[target].double(), cameras.world_from_cam[source].double()
    )
    K = cameras.K.double()
    target_from_source[:3, :3] = torch.linalg.solve(K[source], target_from_source[:3, :3], left=False)
    return (K[target] @ target_from_source[:3]).float().numpy()


def _window() -> NDArray[np.float32]:
    """(T, 3) columns and rows from the middle, and weights exp(−r² / (2 · ``SIDE``²)) by their distance r."""
    row, column = np.mgrid[-SIDE : SIDE + 1, -SIDE : SIDE + 1]
    weight = np.exp(-(row**2 + column**2) / (2 * SIDE**2))
    return np.stack([column, row, weight], -1).reshape(-1, 3).astype(np.float32)
