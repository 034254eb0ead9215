"""Which plane each pixel of a view takes, or whether it keeps its depth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from tco.options import ConsensusConfig
from tco.planar._kernels import least_labels
from tco.planar.fit import SURE
from tco.planar.view import SIDE, Floats, Labels, Plane, Shown

WIDE = 2.0
"""A plane that departs from a depth by this many times its error costs half of ``plane_trust``."""
LEAST, MOST = 0.01, 1.0
"""Bounds of that."""
UNSURE, DOUBT = 0.03, 2.0
"""Relative error of a plane that costs ``DOUBT``; it grows with the square."""
EDGE, ACROSS = 0.05, 0.2
"""Step of the colours, of 1, over which a border of labels gets cheaper; the least share of its cost."""
STEP, CHANGE = 0.1, 0.1
"""Step of the logarithm of depth that costs a border as a whole; share of it that a change of labels adds."""
BINS, UNLIKE, MOST_UNLIKE, SHRINK = 8, 0.3, 3.0, 2e-3
"""Bins of each channel; weight of how much rarer a colour is on the plane than in the view, in powers of e;
the most that counts; share of a view, in sure pixels, that makes the colours of a plane known."""
NEVER = 1e3
"""Cost of what cannot be: a plane behind the camera, or one where there is no depth."""
SWEEPS = 3
"""Passes of messages there and back."""
WORTH, FEW = 1 / 8, 1e-3
"""A plane is tried if it costs less than this share of ``plane_trust`` at such a share of a view or more."""


def labelled(view: Shown, planes: Sequence[Plane], config: ConsensusConfig) -> Labels:
    """(H, W): 0 where a pixel keeps its depth, k + 1 where plane k of the list is its surface.

    Args:
        view: with its depths.
        planes: that it may take.
        config: how much depths are trusted, and how much borders cost.
    """
    colours = colour_bins(view)
    tried, costs, logs = [0], [np.zeros_like(view.depth)], [np.log(view.depth)]
    for k, plane in enumerate(planes):
        depth = plane.depth(view)
        cost = cost_of(view, plane, depth, colours, config)
        if ((cost < WORTH * config.plane_trust) & (cost < NEVER)).mean() >= FEW:
            tried.append(k + 1)
            costs.append(cost)
            logs.append(np.log(np.where(depth > 0, depth, 1)))
    if len(tried) == 1:
        return np.zeros(view.depth.shape, np.int64)
    unary, log_depth = (np.ascontiguousarray(np.stack(x, -1), np.float32) for x in (costs, logs))
    right, down = borders(view, config.plane_smoothness)
    chosen = least_labels(unary, log_depth, right, down, (STEP, CHANGE), SWEEPS)
    return np.asarray(tried)[chosen]


def cost_of(view: Shown, plane: Plane, depth: Floats, colours: Labels, config: ConsensusConfig) -> Floats:
    """What it costs (H, W) to take a plane, of these depths, instead of keeping one's own."""
    there = (depth > 0) & view.known
    off = np.where(there, np.log(np.where(there, depth, 1) / view.depth), 0)
    apart = (off / (WIDE * view.error).clip(LEAST, MOST)) ** 2
    cost = config.plane_trust * apart / (1 + apart)
    cost += DOUBT * (plane.error(view, depth) / UNSURE) ** 2
    near = np.exp(-0.5 * (off / view.error.clip(LEAST / WIDE, MOST / WIDE)) ** 2) * there
    cost += UNLIKE * rarity(colours, view.sure.clip(0, SURE), near)[colours]
    return np.where(there, cost.clip(0, NEVER), NEVER).astype(np.float32)


def colour_bins(view: Shown) -> Labels:
    """Bin (H, W) of each pixel's colour, of the picture without its noise."""
    smooth = cv2.GaussianBlur(np.ascontiguousarray(view.image, np.float32), (0, 0), 1.0)
    r, g, b = (np.clip(smooth * BINS, 0, BINS - 1).astype(np.int64)).transpose(2, 0, 1)
    return np.asarray((r * BINS + g) * BINS + b)


def rarity(colours: Labels, sure: Floats, near: Floats) -> Floats:
    """By how much rarer colours are on a plane than in the view, per bin (BINS³,), 0 if not, in powers of e.

    The chance of a colour on the plane is shrunk to that in the view where little of the plane is seen.

    Args:
        colours: (H, W) bins.
        sure: (H, W) weights.
        near: (H, W) how much a pixel is on the plane by its own depth, 0 to 1.
    """
    total = max(float(sure.sum()), 1e-9)
    every, here = (_histogram(colours, weight / total) for weight in (sure, sure * near))
    share = float(here.sum())
    ratio = (here + SHRINK * every) / (share + SHRINK) / every.clip(1e-9)
    return np.where(every > 1e-6, -np.log(ratio.clip(1e-9)), 0).clip(0, MOST_UNLIKE)


def _histogram(colours: Labels, weights: Floats) -> Floats:
    """Sums of weights (H, W) per bin, blurred a little, (BINS³,)."""
    counts = np.bincount(colours.ravel(), weights.ravel().astype(np.float64), BINS**3)
    return np.asarray(gaussian_filter(counts.reshape(BINS, BINS, BINS), 0.7, mode="reflect").ravel())


def borders(view: Shown, smoothness: float) -> tuple[Floats, Floats]:
    """Weights (H, W) of the borders to the right and below; 0 beside a pixel without depth."""
    weight = smoothness * view.side / SIDE
    found = []
    for axis in (1, 0):
        step = np.zeros_like(view.depth)
        ahead = tuple(slice(1, None) if a == axis else slice(None) for a in (0, 1))
        here = tuple(slice(None, -1) if a == axis else slice(None) for a in (0, 1))
        change = np.abs(view.image[ahead] - view.image[here]).max(-1)
        both = view.known[ahead] & view.known[here]
        step[here] = (ACROSS + (1 - ACROSS) * np.exp(-((change / EDGE) ** 2))) * both
        found.append((weight * step).astype(np.float32))
    return found[0], found[1]
