"""How much the views differ where they see the same surface, and what follows from it for the fusion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _fusion_kernels, _vote_kernels
from colmap_tco._fusion_shelf import Shelf
from colmap_tco.fusion_config import FusionConfig
from colmap_tco.fusion_input import FusionView, other_from_reference
from colmap_tco.fusion_report import Tolerance

_VIEWS = 24
_NEIGHBOURS = 4
_PIXELS = 4000
"""What is sampled: so many reference views, evenly spread, neighbours of each, pixels of each."""
_FEWEST = 500
"""Comparisons below which nothing is concluded."""
_OTHER_SURFACE = 0.1
"""Relative depth difference above which two pixels are taken to show different surfaces."""
_FACTOR = 1.5
"""Tolerance over median difference, 1 σ of a normal distribution. Of what is right two thirds of the pairs
agree, so that among many views enough do; 2 and 3 let more wrong points in than right ones."""
_MOST_REPROJ, _MOST_NORMAL = 4.0, 45.0
"""Bounds: times ``max_reproj_error``, and degrees."""
_DEPTH_WIDTH, _NORMAL_WIDTH = 2.5, 2.0
"""Widths of the robust means over median differences of two views: 2.4 σ of one view, for a median difference
is 0.95 σ of depths, and 1.67 σ of each component of normals, of which two matter."""
_LEAST_WIDTH = 0.25
"""Least width, times the tolerance that was given: noise is not the same everywhere in a scene."""


@dataclass(frozen=True)
class Noise:
    """Median differences between two views of a surface.

    Attributes:
        depth: relative.
        reproj: pixels of the depth map.
        normal: radians.
    """

    depth: float
    reproj: float
    normal: float


def noise(shelf: Shelf, views: Sequence[FusionView], config: FusionConfig) -> Noise | None:
    """The noise of the depths, or None where hardly two views see a surface together."""
    found = _sample(shelf, views, config)
    found = found[found[:, 0] < _OTHER_SURFACE]
    if len(found) < _FEWEST:
        return None
    return Noise(*(float(np.median(column)) for column in found.T))


def tolerance(found: Noise | None, config: FusionConfig) -> Tolerance:
    """The tolerances of the settings, widened to 1.5 times the median difference between views."""
    given = Tolerance(config.max_depth_error, config.max_reproj_error, config.max_normal_error)
    if found is None or not config.adapt_to_noise:
        return given
    return Tolerance(
        max(given.depth, min(_FACTOR * found.depth, config.most_depth_error)),
        max(given.reproj, min(_FACTOR * found.reproj, _MOST_REPROJ * given.reproj)),
        max(given.normal, min(_FACTOR * math.degrees(found.normal), _MOST_NORMAL)),
    )


def widths(found: Noise | None, config: FusionConfig) -> tuple[float, float]:
    """Distances from the mean, relative and in radians, at which a vote has half its weight.

    Where the noise is not known, they are the tolerances.
    """
    depth, normal = config.max_depth_error, math.radians(config.max_normal_error)
    if found is None:
        return depth, normal
    return (
        max(_DEPTH_WIDTH * found.depth, _LEAST_WIDTH * depth),
        max(_NORMAL_WIDTH * found.normal, _LEAST_WIDTH * normal),
    )


def _sample(shelf: Shelf, views: Sequence[FusionView], config: FusionConfig) -> NDArray[np.float64]:
    """Differences (M, 3) of depth, reprojection and normal between some pixels and their neighbours."""
    blocks = [np.zeros((0, 3))]
    for position in _spread(range(len(views)), _VIEWS):
        ref = shelf.get(position)
        valid = np.flatnonzero(ref.depth)
        pixels = np.ascontiguousarray(valid[:: max(1, len(valid) // _PIXELS)], np.int64)
        tiles = _vote_kernels.tiles_of(len(pixels))
        _vote_kernels.begin(ref.surface, pixels, tiles)
        for neighbour in _spread(sorted(views[position].neighbours[: config.check_num_images]), _NEIGHBOURS):
            other = shelf.get(neighbour)
            transform = other_from_reference(views[neighbour], views[position])
            pair = _fusion_kernels.pair(ref.camera, other.camera, transform)
            block = np.empty((len(pixels), 3))
            blocks.append(block[: _vote_kernels.differences(tiles, other.surface, pair, block)])
    return np.concatenate(blocks)


def _spread(items: Sequence[int], count: int) -> list[int]:
    """At most ``count`` of the items, evenly spaced."""
    if len(items) <= count:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, count).round().astype(int)]
