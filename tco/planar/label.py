"""Which plane each pixel of a view takes, or whether it keeps its depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from tco.options import ConsensusConfig
from tco.planar._costs import add_by_colour, histograms, on_own_depth
from tco.planar._kernels import least_labels
from tco.planar.frame import Frame
from tco.planar.view import SIDE, Floats, Labels, Plane, Shown, normals, span

f32 = np.float32
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
BINS, UNLIKE, MOST_UNLIKE, SHRINK = 8, 1.5, 3.0, 2e-3
"""Bins of each channel; weight of how much rarer a colour is on the plane than in the view, in powers of e;
the most that counts; share of a view, in sure pixels, that makes the colours of a plane known."""
CERTAIN = 3.0
"""Confidence above 1 from which on a pixel counts no more for the colours of a plane; below that it counts
with the square, as an inverse variance."""
FREE, ASKEW = 6.0, 5.0
"""Degrees from a direction of the scene up to which a plane faces along it; how many more cost half of
``plane_square``."""
KEPT, DOUBTFUL = 0.2, 0.1
"""Cost of keeping a depth, though the surface is slanted to all directions, in units of ``plane_square``; the
relative error at which it is half of that."""
SLANTED, REACH = (10.0, 25.0), 6.0
"""Degrees from a direction at which a surface begins to be slanted, and at which it is altogether; pixels to
each side over which its normal is taken."""
CLEAR, VAGUE = 0.5, 0.05
"""Of how much rarer the colour of a pixel that keeps its depth is off all planes than in the view, in powers
of e, so much does not count; the relative error of the depth at which half of the rest does. A plain door
behind a table has the colours of the doors beside it, which are on a plane, whatever the network makes of
it."""
NEAR = 0.05
"""Relative error that larger ones count as where the colours of a plane are gathered: what is hardly known at
all is near every plane."""
NEVER = 1e3
"""Cost of what cannot be: a plane behind the camera, or one where there is no depth."""
SWEEPS = 3
"""Passes of messages there and back."""
WORTH, FEW = 1 / 8, 1e-3
"""A plane is tried if it costs less than this share of ``plane_trust`` at such a share of a view or more."""


def labelled(
    view: Shown, planes: Sequence[Plane], config: ConsensusConfig, frame: Frame | None = None
) -> Labels:
    """(H, W): 0 where a pixel keeps its depth, k + 1 where plane k of the list is its surface.

    Args:
        view: with its depths.
        planes: that it may take.
        config: how much depths are trusted, and how much borders cost.
        frame: directions, if the scene has any, along which surfaces are likelier to face.
    """
    if not planes:
        return np.zeros(view.depth.shape, np.int64)
    colours = colour_bins(view)
    keep = np.zeros_like(view.depth) if frame is None else cost_of_keeping(view, frame, config)
    taking = costs_of(view, planes, colours, config)
    if frame is not None:
        facing = [cost_of_facing(plane, frame, config) for plane in planes]
        taking.cost[:] = np.minimum(taking.cost + np.asarray(facing, np.float32)[:, None, None], NEVER)
    tried = (taking.cost < min(WORTH * config.plane_trust, NEVER)).mean((1, 2)) >= FEW
    if not tried.any():
        return np.zeros(view.depth.shape, np.int64)
    keep = keep + cost_of_colour(view, colours, taking.near[tried].max(0), config)
    unary = np.stack([keep, *taking.cost[tried]], -1, dtype=np.float32)
    log_depth = np.stack([np.log(view.depth), *taking.log_depth[tried]], -1, dtype=np.float32)
    del taking
    right, down = borders(view, config.plane_smoothness)
    chosen = least_labels(unary, log_depth, right, down, (STEP, CHANGE), SWEEPS)
    return np.concatenate([[0], 1 + np.flatnonzero(tried)])[chosen]


@dataclass(frozen=True)
class Taking:
    """What it costs a view's pixels to take each of K planes, instead of keeping their depths.

    Attributes:
        cost: (K, H, W), ``NEVER`` where there is no depth or the plane is behind the camera.
        log_depth: (K, H, W) logarithm of the planes' depths, 0 there.
        near: (K, H, W) how much a pixel is on the plane by its own depth, 0 to 1.
    """

    cost: Floats
    log_depth: Floats
    near: Floats


def costs_of(view: Shown, planes: Sequence[Plane], colours: Labels, config: ConsensusConfig) -> Taking:
    """Costs of planes by their departures from the depths, by their own errors and by the colours on them.

    Args:
        view: with its depths.
        planes: K of them.
        colours: (H, W) bins.
        config: how much depths are trusted.
    """
    off = (WIDE * view.error).clip(LEAST, MOST), view.error.clip(LEAST / WIDE, NEAR)
    rows = *np.moveaxis(view.directions, -1, 0), np.where(view.known, view.depth, 0), np.log(view.depth), *off
    pixels = np.stack([row.ravel() for row in rows], dtype=np.float32)
    packed = np.stack([plane.packed(view.centre) for plane in planes])
    cost, log_depth, near = (np.empty((len(planes), pixels.shape[1]), np.float32) for _ in range(3))
    on_own_depth(pixels, packed, (f32(config.plane_trust), f32(DOUBT / UNSURE**2)), cost, log_depth, near)
    near = near.reshape(-1, *view.depth.shape)
    rare = (UNLIKE * rarity(colours, view.sure.clip(0, CERTAIN) ** 2, near)).astype(np.float32)
    add_by_colour(colours.ravel(), rare, f32(NEVER), cost)
    return Taking(cost.reshape(near.shape), log_depth.reshape(near.shape), near)


def cost_of_colour(view: Shown, colours: Labels, on_any: Floats, config: ConsensusConfig) -> Floats:
    """What it costs (H, W) to keep a depth that is unsure, where sure pixels of that colour are on planes.

    Args:
        view: with its depths.
        colours: (H, W) bins.
        on_any: (H, W) how much a pixel is on one of the planes by its own depth, 0 to 1.
        config: whose ``plane_colour`` is the weight.
    """
    rare = rarity(colours, view.sure.clip(0, CERTAIN) ** 2, 1 - on_any[None])[0, colours]
    unsure = (view.error / VAGUE) ** 2
    cost = config.plane_colour * np.maximum(rare - CLEAR, 0) * unsure / (1 + unsure)
    return np.asarray(cost * view.known, np.float32)


def cost_of_facing(plane: Plane, frame: Frame, config: ConsensusConfig) -> float:
    """What it costs a pixel that a plane does not face along a direction of the scene."""
    times = max(0.0, float(frame.astray(plane.normal)) - FREE) / ASKEW
    return config.plane_square * times**2 / (1 + times**2)


def cost_of_keeping(view: Shown, frame: Frame, config: ConsensusConfig) -> Floats:
    """What it costs (H, W) to keep a depth that is unsure, of a surface slanted to all directions."""
    n = normals(view, REACH)
    low, high = SLANTED
    slanted = ((frame.astray(n) - low) / (high - low)).clip(0, 1) * (n != 0).any(-1)
    r = span(view, REACH)
    if min(view.depth.shape) > 2 * r:
        slanted = np.pad(slanted[r:-r, r:-r], r, mode="edge")
    unsure = (view.error / DOUBTFUL) ** 2
    return np.asarray(KEPT * config.plane_square * slanted * unsure / (1 + unsure), np.float32)


def colour_bins(view: Shown) -> Labels:
    """Bin (H, W) of each pixel's colour, of the picture without its noise."""
    smooth = cv2.GaussianBlur(np.ascontiguousarray(view.image, np.float32), (0, 0), 1.0)
    r, g, b = np.nan_to_num(smooth * BINS).clip(0, BINS - 1).astype(np.int64).transpose(2, 0, 1)
    return np.asarray((r * BINS + g) * BINS + b)


def rarity(colours: Labels, sure: Floats, near: Floats) -> Floats:
    """By how much rarer colours are on planes than in the view, (K, BINS³), 0 if not, in powers of e.

    The chance of a colour on a plane is shrunk to that in the view where little of the plane is seen.

    Args:
        colours: (H, W) bins.
        sure: (H, W) weights.
        near: (K, H, W) how much a pixel is on each of K planes by its own depth, 0 to 1.
    """
    flat, weight = colours.ravel(), sure.ravel().astype(np.float64)
    weight /= max(float(weight.sum()), 1e-9)
    counts = np.zeros((1 + len(near), BINS**3))
    counts[0] = np.bincount(flat, weight, BINS**3)
    histograms(flat, weight.astype(np.float32), near.reshape(len(near), -1), counts[1:])
    blurred = gaussian_filter(counts.reshape(-1, BINS, BINS, BINS), (0, 0.7, 0.7, 0.7), mode="reflect")
    every, here = np.split(blurred.reshape(counts.shape), [1])
    share = here.sum(1, keepdims=True)
    ratio = (here + SHRINK * every) / (share + SHRINK) / every.clip(1e-9)
    return np.where(every > 1e-6, -np.log(ratio.clip(1e-9)), 0).clip(0, MOST_UNLIKE)


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
