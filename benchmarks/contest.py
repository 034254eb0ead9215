"""What it gives that depths which other views contradict give way, and what that depends on.

    python -m benchmarks.contest [--output docs/contest.md]

Each set is predicted once with the default optimisation, the views are asked together, and their depths are
put on planes, as ``densify`` does; then depths are contested (``tco/contest.py``) with several settings.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import NamedTuple
from unittest import mock

import numpy as np

from benchmarks.planes import Case, cases
from benchmarks.planes import parser as parser_of_planes
from benchmarks.tables import paragraph, publish, weights_told
from tco import contest
from tco.backbones.weights import EMBEDDED
from tco.options import ConsensusConfig
from tco.planar.run import flattened


class Shares(NamedTuple):
    """Of the measured pixels: within 2 and 5 % of the truth, another view's; seconds."""

    close: float
    near: float
    taken: float
    seconds: float


def variants() -> Iterator[tuple[str, int, Mapping[str, float]]]:
    """Names, views that are asked, and constants of :mod:`tco.contest` that are otherwise."""
    default = ConsensusConfig().contest_views
    yield "not contested", 0, {}
    yield "default", default, {}
    yield "by views alone", default, {"WORTH": 0.0}
    yield "by pictures alone", default, {"WORTH": 1e4, "LEAST": 0.0, "BEHIND": 1e9}
    yield "by pictures, two agree", default, {"WORTH": 1e4, "BEHIND": 1e9}
    for views in (4, 20):
        yield f"contest_views {views}", views, {}
    for worth in (10.0, 40.0):
        yield f"worth {worth:.0f}", default, {"WORTH": worth}
    yield "margin 4", default, {"MARGIN": 4.0}
    yield "window 7 × 7", default, {"SIDE": 3}


def shares(case: Case, views: int, changes: Mapping[str, float]) -> Shares:
    """What depths on planes become."""
    config = replace(ConsensusConfig(), contest_views=views)
    depth, known = case.agreement.prediction.depth, case.truth > 0
    with ExitStack() as stack:
        for constant, value in changes.items():
            stack.enter_context(mock.patch.object(contest, constant, value))
        start = time.perf_counter()
        new, taken = contest.settled(depth, case.cameras, case.views, case.overlap, config)
        seconds = time.perf_counter() - start
    error = (new / case.truth.clamp_min(1e-6) - 1).abs()[known]
    within = (float((error < bound).float().mean()) for bound in (0.02, 0.05))
    return Shares(*within, float(taken[known].float().mean()), seconds)


def on_planes(case: Case) -> Case:
    """The same with depths on planes."""
    flat = flattened(case.agreement, case.cameras, case.views, ConsensusConfig())
    return replace(case, agreement=flat.agreement)


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = parser_of_planes()
    parser.description = __doc__
    return parser


def main() -> None:
    """Measure and publish."""
    args = parser().parse_args()
    every = list(map(on_planes, cases(args)))
    shares(every[0], 2, {})  # compiles the loops
    named, random = every[: len(args.sets)], every[len(args.sets) :]
    text = "# Contested depths\n\n" + paragraph(
        f"`python -m benchmarks.contest`: {weights_told(args.weights or EMBEDDED)}, {args.size} pixels, "
        f"{args.views or 'all'} views, after {args.steps} steps, the consensus and planes. Shares of the "
        "measured pixels within 2 and 5 % and of those that are another view's, and seconds. random: mean of "
        f"{len(random)} scenes of the training's kinds that no training saw; better: on how many of these "
        "the share within 5 % grew; worst: its lowest change among them."
    )
    text += "\n| | " + " | ".join([*(case.name for case in named), "random", "better", "worst"]) + " |\n"
    text += "|---" * (len(named) + 4) + "|\n"
    before: list[float] = []
    for name, views, changes in variants():
        cells = ["{:.3f} {:.3f} {:.3f} {:.1f} s".format(*shares(case, views, changes)) for case in named]
        far = [shares(case, views, changes) for case in random]
        if far:
            before = before or [found.near for found in far]
            change = [found.near - old for found, old in zip(far, before, strict=True)]
            cells.append("{:.3f} {:.3f} {:.3f} {:.1f} s".format(*np.mean(far, 0)))
            cells += [f"{sum(c > 0 for c in change)}", f"{min(change):+.3f}"]
        text += f"| {name} | " + " | ".join(cells) + " |\n"
    publish(text, args.output, args.part)


if __name__ == "__main__":
    main()
