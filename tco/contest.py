"""Depths that other views contradict, against those that they put in the same place.

The consensus (:mod:`tco.consensus`) moves a depth within reach, and planes take what is unsure. What is left
is of another surface: beside an edge, at thin things, where the network is sure of what is wrong. So a pixel
has other depths to choose from: each of the views that overlap best puts its own there, the nearest of those
that fall on the pixel. One that differs from the pixel's depth is weighed against it by

- views: those whose depth at its place is the same, less those that see through it, to something beyond, less
  those that put something before it, which would hide it from here. A depth too near is seen through, one too
  far is hidden; the right one is least of both;
- pictures: the mean of the highest correlations of a window around the pixel with other pictures; a
  correlation of one is worth ``WORTH`` views. One that shows less than ``SHOWN`` of the window has none.

Both are needed (``docs/contest.md``): views err together, and a window looks like others by chance. The views
are asked with their depths on planes: those of before count for more views that found them by themselves,
which counts for less than what planes mend.

What is taken here has been found before by others, which do not become more by that: it is for the maps that
are written, and no point of a cloud begins with it.

Visibility: Merrell et al., Real-time visibility-based fusion of depth maps, ICCV 2007 (stability). Weights of
the window: Yoon and Kweon, Adaptive support-weight approach for correspondence search, PAMI 2006.
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
"""Pixels to each side that a pixel of another view covers, so that no gaps open between them. The nearest of
those that cover a pixel counts, so that what is in front grows by as much."""
LEAST, BEHIND = 2.0, 2.0
"""Other views that must agree with a depth that is taken, with the one that put it there; votes by which it
may have fewer than the pixel's own."""
WORTH = 20.0
"""Views that a correlation of one is worth."""
MARGIN = 2.0
"""Votes by which a depth must be worth more than the pixel's own."""
MEMORY = 1 << 28
"""Bytes at most of what is put into views, of all that are settled at once."""
BEST = 3
"""Pictures whose correlations are taken, the highest: the others may not see the place."""
SIDE = 2
"""Pixels to each side of the window."""
CONTRAST, NOISE = 0.1, 1 / 12 / 255**2
"""Difference in grey, of 1, at which a pixel of the window counts 1 / e; variance that rounding to bytes
gives where all channels are alike."""
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
    maps = np.where(known, depth.numpy(), np.float32(0)).astype(np.float32, copy=False)
    grey = views.images.float().mean(1).masked_fill_(~views.valid, -1.0).numpy()

    def settle_one(i: int) -> None:
        others = most_overlapping(overlap, i, config.contest_views)
        if others:
            found = _settled(i, others, maps, grey, cameras)
            taken[i] = torch.from_numpy(found != maps[i])
            result[i] = torch.from_numpy(found).to(depth).where(taken[i], depth[i])

    at_once = max(1, MEMORY // (4 * min(config.contest_views, len(views) - 1) * maps[0].size))
    with ThreadPoolExecutor(min(torch.get_num_threads(), WORKERS, at_once)) as pool:
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
