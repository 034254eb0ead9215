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
    count = common.sum(1)
    if by == "number":
        return count.astype(float)
    views, at = np.nonzero(common)
    place = xyz[mine[at]]
    worth = angle_weight(centres[i] - place, centres[views] - place)
    if by == "angle":
        return np.bincount(views, worth, len(seen)).astype(float)
    edges = np.cumsum(count)[:-1]
    return _added(np.split(at, edges), np.split(np.sqrt(worth), edges), len(mine))


def _added(points: Sequence[Ints], worth: Sequence[Floats], count: int) -> Floats:
    """What each of V views adds to those before it (V,), the next being the one that adds most.

    What a view adds falls as others are known, so that only the first in the order of what was found last
    has to be computed anew (Minoux 1978).

    Args:
        points: indices of those that each of V views sees.
        worth: of each of these in that view.
        count: of all points.
    """
    known, added = np.ones(count), np.zeros(len(points))
    bound = np.array([np.log1p(own).sum() for own in worth])
    bound[bound <= 0] = -np.inf  # of which nothing is left to find
    while np.isfinite(bound).any():
        best = int(bound.argmax())
        at, own = points[best], worth[best]
        now = float(np.log1p(own / known[at]).sum())
        fresh, bound[best] = now == bound[best], now
        if fresh or now >= bound.max():
            added[best] = now
            known[at] += own
            bound[best] = -np.inf
    return added
