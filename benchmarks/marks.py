"""What COLMAP's own points reach where the pixels are: the mark that dense maps are measured against.

    python -m benchmarks.marks [--output docs/marks.md]

The share of COLMAP's points that agree with the sensor is a mark for dense maps only where points and pixels
lie at the same depths. Points are where there is texture; so here the measured pixels of a set are split into
fifths by their depth, points and maps are compared in each, and the mean over the fifths is what points would
reach if they were spread over depths as pixels are.

What is wrong is then asked why: at the pixels whose depth is off by more than 5 %, do the colours of other
views fit it better than the true depth? Where they do, as on what mirrors, no comparison of colours can find
the truth.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.real import SIZE, RealSet, arguments, load
from benchmarks.sets import SETS
from benchmarks.tables import paragraph, publish, weights_told
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.conclusion import concluded
from tco.geometry import invert, project, sample, transform, unproject
from tco.optimize import optimize
from tco.options import TCOConfig
from tco.schedule import most_overlapping
from tco.types import SparseDepth

FIFTHS = 5
WITHIN = 0.05
"""Relative error up to which a depth agrees with the sensor."""
ASKED, SEEN, LESS = 4, 0.02, 0.001
"""Views whose colours are compared, those that overlap best; relative difference of true depths up to which
they see the same; by how much a difference of colours must be less, a quarter of a grey level."""


class Compared(NamedTuple):
    """One range of depths: its bounds in metres, and of points and of the maps' pixels there which agree.

    ``nearer`` are the shares of points and pixels that are too near by more than that.
    """

    low: float
    high: float
    points: int
    agree: tuple[float, float]
    nearer: tuple[float, float]


def at_points(truth: Tensor, sparse: tuple[SparseDepth, ...]) -> tuple[Tensor, Tensor]:
    """True depth (N,) at the points of all views where it is known, and the points' own relative to it."""
    true, ratio = [], []
    for depth, points in zip(truth, sparse, strict=True):
        x, y = points.xy.floor().long().unbind(1)
        there = depth[y.clamp(0, depth.shape[0] - 1), x.clamp(0, depth.shape[1] - 1)]
        known = there > 0
        true.append(there[known])
        ratio.append(points.depth[known] / there[known])
    return torch.cat(true), torch.cat(ratio)


def compared(real: RealSet, depth: Tensor) -> list[Compared]:
    """The fifths of the measured pixels of a set, by their true depth, the nearest first."""
    assert real.given.sparse is not None
    known = real.truth > 0
    pixels, maps = real.truth[known], (depth / real.truth.clamp_min(1e-6))[known]
    points, ratio = at_points(real.truth, tuple(real.given.sparse))
    edges = torch.from_numpy(np.quantile(pixels.numpy(), np.linspace(0, 1, FIFTHS + 1))).to(pixels)
    found = []
    for k, (low, high) in enumerate(pairwise(edges.tolist())):
        here = [
            r[torch.bucketize(t, edges[1:-1], right=True) == k] for t, r in ((points, ratio), (pixels, maps))
        ]
        agree, nearer = (
            (float(test(here[0]).float().mean()), float(test(here[1]).float().mean()))
            for test in (lambda r: (r - 1).abs() < WITHIN, lambda r: r <= 1 - WITHIN)
        )
        found.append(Compared(low * real.metres, high * real.metres, len(here[0]), agree, nearer))
    return found


class Wrong(NamedTuple):
    """Measured pixels that are off: their share, and of those that other views see, in truth: how many, the
    mean difference of colours at the maps' depth and at the true one, and the share that fits better in ours.
    """

    share: float
    seen: int
    ours: float
    true: float
    better: float


def looked_up(real: RealSet, depth: Tensor, view: int, other: int) -> tuple[Tensor, Tensor]:
    """What another view shows where a depth (H, W) puts a view's pixels.

    Returns:
        (4, H, W) its colours and its true depth, the latter of one pixel; (H, W) depth of the points there, 0
        where they are not in its picture, or there is no depth.
    """
    assert real.given.cameras is not None
    cameras = real.given.cameras
    size, points = depth.shape, unproject(depth, cameras.K[view]).reshape(-1, 3)
    other_from_view = invert(cameras.world_from_cam[other]) @ cameras.world_from_cam[view]
    xy, z = project(transform(other_from_view, points), cameras.K[other])
    inside = (xy >= 0.5).all(-1) & (xy <= xy.new_tensor([size[1], size[0]]) - 0.5).all(-1)
    inside &= (z > 0) & (depth.flatten() > 0)
    colours = sample(real.views.images[other][None], xy[None])[0]
    there = sample(real.truth[other][None, None], xy[None], mode="nearest")[0]
    return torch.cat([colours, there]).unflatten(-1, size), (z * inside).unflatten(-1, size)


def wrong(real: RealSet, depth: Tensor) -> Wrong:
    """Why depths (V, H, W) are off: what the colours of other views say of them and of the true ones."""
    assert real.given.overlap is not None
    off = (real.truth > 0) & ~((depth / real.truth.clamp_min(1e-6) - 1).abs() < WITHIN)
    found = [torch.zeros(2, 0)]
    for i, image in enumerate(real.views.images):
        total, count = torch.zeros(2, *off.shape[1:]), torch.zeros(off.shape[1:])
        for other in most_overlapping(real.given.overlap, i, ASKED):
            ours, z_ours = looked_up(real, depth[i], i, other)
            true, z_true = looked_up(real, real.truth[i], i, other)
            seen = (z_ours > 0) & (z_true > 0) & ((true[3] / z_true.clamp_min(1e-6) - 1).abs() < SEEN)
            total += seen * torch.stack([(x[:3] - image).abs().mean(0) for x in (ours, true)])
            count += seen
        asked = off[i] & (count > 0)
        found.append((total / count.clamp_min(1))[:, asked])
    ours, true = torch.cat(found, 1)
    share = float(off.sum() / (real.truth > 0).sum())
    return Wrong(
        share, len(ours), float(ours.mean()), float(true.mean()), float((ours < true - LESS).float().mean())
    )


def lines(real: RealSet, depth: Tensor) -> list[str]:
    """Rows of the table of one set."""
    assert real.given.sparse is not None
    ranges = compared(real, depth)
    _, ratio = at_points(real.truth, tuple(real.given.sparse))
    every = float(((ratio - 1).abs() < WITHIN).float().mean())
    spread, maps = np.nanmean([r.agree for r in ranges], axis=0)
    rows = [f"| {real.name} | all | {len(ratio)} | {every:.3f} | {spread:.3f} | {maps:.3f} | | |"]
    for r in ranges:
        rows.append(
            f"| | {r.low:.2f} to {r.high:.2f} m | {r.points} | {r.agree[0]:.3f} | | {r.agree[1]:.3f} | "
            f"{r.nearer[0]:.3f} | {r.nearer[1]:.3f} |"
        )
    return rows


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = arguments(__doc__ or "", SETS)
    parser.set_defaults(size=SIZE, views=0, steps=TCOConfig().steps)
    return parser


def main() -> None:
    """Measure and publish."""
    args = parser().parse_args()
    weights = args.weights or EMBEDDED
    network, config = load_sweep(weights), TCOConfig(steps=args.steps)
    why = [
        "| set | off | seen elsewhere | colours at ours | at the truth | ours fits better |",
        "|" + "---|" * 6,
    ]
    rows = [
        "| set | depths | points | agree | spread as pixels | maps agree | points nearer | maps nearer |",
        "|" + "---|" * 8,
    ]
    for name in args.sets:
        real = load(name, args.size, args.views)
        outcome = optimize(network, real.views, real.given, config)
        depth = concluded(outcome, real.views, real.given, config).agreement.prediction.depth
        rows += lines(real, depth)
        w = wrong(real, depth)
        why.append(f"| {name} | {w.share:.3f} | {w.seen} | {w.ours:.4f} | {w.true:.4f} | {w.better:.3f} |")
    told = (
        f"`python -m benchmarks.marks --sets {' '.join(args.sets)}`: {weights_told(weights)}, "
        f"{args.size} pixels, {args.views or 'all'} views, {args.steps} steps. agree: share of COLMAP's "
        "points, each in every view that sees it, within 5 % of the sensor; maps agree: the same of the "
        "pixels of our maps; by fifths of the measured pixels. spread as pixels: mean of the points' shares "
        "over the fifths, what they would reach if they lay at the depths that pixels lie at. nearer: share "
        "that is too near by more than 5 %."
    )
    asked = (
        f"The pixels that are off by more than 5 % or have no depth, and what the {ASKED} views that "
        "overlap best show where the maps put them and where they are; of pixels whose true place one of "
        "these sees (its own true depth is the same). Colours: mean difference, of 1. ours fits better: "
        "share of these pixels whose colours differ less at the wrong depth than at the true one."
    )
    tables = [[paragraph(told), *rows, ""], [paragraph(asked), *why, ""]]
    text = "\n".join(line for table in tables for line in table)
    publish(f"# The mark: COLMAP's own points\n\n{text}", args.output, args.part)


if __name__ == "__main__":
    main()
