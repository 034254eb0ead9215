"""How much every other view tells of a view's depths, and so which are matched with it, in which order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from colmap_tco._pycolmap import Floats, Ints, Mask
from colmap_tco.tracks import angle_weight

OVERLAPS = ("information", "angle", "number")
"""Ways to say how much that is."""


def overlap(points: Sequence[Ints], centres: Floats, xyz: Floats, by: str = OVERLAPS[0]) -> Floats:
    """What view j tells of the depths of view i, (V, V) at [i, j]; 0 if they share no point, and if i = j.

    ``number`` is that of the common points, which favours neighbours in a film that hardly differ. ``angle``
    is the sum of what their triangulation angles are worth, :func:`colmap_tco.tracks.angle_weight`. Views
    that are best by either may all see the same part of a view, from the same side. ``information`` is what
    j adds to the views before it: with w the root of that worth, of the views S that are known the points p
    of i have Σₚ log(1 + Σₛ wₛₚ), as the logarithm of a precision that grows by wₛₚ with each view from 1. The
    next in a row is the view that adds most. That is within 1 − 1/e of the best choice of as many (Nemhauser
    et al. 1978), and what is added never grows along the order, so that sorting a row gives it back.

    Args:
        points: indices of those that each of V views observes.
        centres: (V, 3) of the cameras.
        xyz: (P, 3) of the points.
        by: the way.

    Raises:
        ValueError: there is no such way.
    """
    if by not in OVERLAPS:
        raise ValueError(f"views overlap by one of {', '.join(OVERLAPS)}, not by {by!r}")
    seen = np.zeros((len(points), len(xyz)), bool)
    for view, its in enumerate(points):
        seen[view, its] = True
    return np.stack([_row(i, seen, centres, xyz, by) for i in range(len(points))])


def _row(i: int, seen: Mask, centres: Floats, xyz: Floats, by: str) -> Floats:
    """What all views tell of view i (V,)."""
    mine = np.flatnonzero(seen[i])
    common = seen[:, mine]
    common[i] = False
    if by == "number":
        return common.sum(1).astype(float)
    worth = np.zeros(common.shape)
    views, at = np.nonzero(common)
    place = xyz[mine[at]]
    worth[views, at] = angle_weight(centres[i] - place, centres[views] - place)
    return worth.sum(1) if by == "angle" else _added(np.sqrt(worth))


def _added(worth: Floats) -> Floats:
    """What each of V views adds to those before it (V,), the next being the one that adds most.

    What a view adds falls as others are known, so that only the first in the order of what was found last
    has to be computed anew (Minoux 1978).

    Args:
        worth: (V, N) of each point in each view.
    """
    known, added = np.ones(worth.shape[1]), np.zeros(len(worth))
    bound = np.log1p(worth).sum(1)
    left = set(np.flatnonzero(bound > 0).tolist())
    while left:
        best = max(left, key=lambda view: (bound[view], -view))
        now = float(np.log1p(worth[best] / known).sum())
        fresh, bound[best] = now == bound[best], now
        if fresh or all(now >= bound[view] for view in left):
            added[best] = now
            known += worth[best]
            left.remove(best)
    return added
