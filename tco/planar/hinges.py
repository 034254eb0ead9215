"""Planes that nothing shows but their rims.

A cupboard's plain door has no depth that is sure, so that no plane is found on it. What borders on it is
known, the worktop above it or the frame around it, and if it stands square to all else
(:mod:`tco.planar.frame`) one number is missing: how far away it is. That is where sure pixels bound the
unsure ones. From each unsure pixel the next sure ones are looked up in four directions. Each gives a plane
along each of the scene's directions; where many of these are one, it is put up for :mod:`tco.planar.label` to
take or leave.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from tco.planar.frame import Frame
from tco.planar.view import Bools, Floats, Labels, Plane, Shown, guessed

KNOWN, UNKNOWN = 0.08, 0.15
"""Relative error of a depth below which it is sure, and above which it is unsure."""
WIDTH = 0.012
"""Spacing at which planes are told apart, of the median depth."""
PEAKS = 12
"""Planes at most along each direction."""
SHARE = 0.003
"""Of all pixels, by which a place must be bounded; each unsure pixel looks at four."""
LEAN = 1.5
"""Standard deviation, degrees, of the normal of a plane that is put up."""
ALIKE = 6.0, 2.0
"""Degrees, and times ``WIDTH``, within which a plane is one that is known already."""
FINEST = 2
"""Bins of each ``WIDTH``."""
FARTHEST = 2000.0
"""Times ``WIDTH`` from the median, beyond which no place is looked for."""


def hinged(views: Sequence[Shown], frame: Frame, known: Sequence[Plane]) -> list[Plane]:
    """Planes along a scene's directions, through what bounds its unsure pixels; none of those ``known``.

    Their covariance is that of ``LEAN`` and half of ``WIDTH``.
    """
    points, weights = _rims(views)
    depths = [float(np.median(view.depth[view.known])) for view in views if view.known.any()]
    if not len(points) or not depths:
        return []
    width = WIDTH * float(np.median(depths))
    found = []
    for axis in frame.axes:
        offsets = points @ axis
        for offset in _peaks(offsets, weights, width):
            near = np.abs(offsets - offset) < 1.5 * width
            mean = float(np.average(offsets[near], weights=weights[near]))
            centre = np.average(points[near], axis=0, weights=weights[near])
            if not any(_alike(axis, centre, plane, width) for plane in known):
                guess = guessed(axis, mean, centre, LEAN, width / 2)
                found.append(replace(guess, guess=guess))
    return found


def _rims(views: Sequence[Shown]) -> tuple[Floats, Floats]:
    """Points (N, 3) where the sure pixels nearest to unsure ones are, and how much of all pixels each is."""
    found, weights = [np.zeros((0, 3), np.float32)], [np.zeros(0)]
    for view in views:
        error = np.where(view.known, view.error, np.inf)
        unsure = view.known & (error > UNKNOWN)
        points = view.points
        for axis, ahead in ((0, True), (0, False), (1, True), (1, False)):
            at = nearest_along(view.known & (error < KNOWN), axis, ahead)
            there = unsure & (at >= 0)
            rows, columns = np.nonzero(there)
            rim = points[at[there], columns] if axis == 0 else points[rows, at[there]]
            found.append(rim)
            weights.append(np.full(len(rim), 1 / (error.size * len(views))))
    return np.concatenate(found), np.concatenate(weights)


def nearest_along(there: Bools, axis: int, ahead: bool) -> Labels:
    """Index (H, W) along an axis of the nearest pixel, after each or before, that is ``there``; −1: none."""
    n = there.shape[axis]
    index = np.arange(n).reshape((-1, 1) if axis == 0 else (1, -1))
    if ahead:
        found = np.where(there, index, n)
        found = np.flip(np.minimum.accumulate(np.flip(found, axis), axis), axis)
        return np.asarray(np.where(found < n, found, -1))
    return np.asarray(np.maximum.accumulate(np.where(there, index, -1), axis))


def _peaks(offsets: Floats, weights: Floats, width: float) -> list[float]:
    """Where most of the offsets (N,) are, the most first, ``PEAKS`` at most."""
    near = np.abs(offsets - np.median(offsets)) < FARTHEST * width
    offsets, weights = offsets[near], weights[near]
    low, bins = float(offsets.min()) - 4 * width, FINEST / width
    count = int((float(offsets.max()) - low + 4 * width) * bins) + 1
    density = np.bincount(((offsets - low) * bins).astype(int), weights, count)
    density = gaussian_filter1d(density, FINEST)
    found = []
    for _ in range(PEAKS):
        top = int(density.argmax())
        offset = low + (top + 0.5) / bins
        if weights[np.abs(offsets - offset) < 1.5 * width].sum() < SHARE:
            break
        found.append(offset)
        density[max(0, top - 3 * FINEST) : top + 3 * FINEST + 1] = 0
    return found


def _alike(axis: Floats, centre: Floats, plane: Plane, width: float) -> bool:
    """Whether a plane faces nearly along an axis and passes a point so near that it is the same."""
    degrees, times = ALIKE
    if abs(float(axis @ plane.normal)) < math.cos(math.radians(degrees)):
        return False
    return abs(float(plane.normal @ centre) - plane.offset) < times * width
