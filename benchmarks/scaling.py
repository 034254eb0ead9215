"""Steps of optimisation against error and seconds, as the paper's scaling curve: table and plot.

    python -m benchmarks.scaling [--steps_list 0 5 10 20 40 80] [--output docs/scaling.md]

Each number of steps is a run of its own, since the schedule depends on it. Seconds are CPU seconds of the
optimiser on the loaded network, from pixels to depths; of several seeds, their mean. Loops are compiled
before.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.real import RealSet, arguments, load, median_error, within
from benchmarks.tables import cell, paragraph, plot_beside, publish, runs, weights_told
from tco.backbones.base import Backbone
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.optimize import optimize
from tco.options import TCOConfig
from tco.terms import errors_at_points

Run = tuple[float, float, float, float, float]
"""Seconds; within 2 and 5 % of the truth; median error; hidden points within 5 %."""
Curve = dict[int, list[Run]]
"""Steps → runs, one a seed."""


def measure(network: Backbone, real: RealSet, steps: int, seed: int) -> Run:
    """One run."""
    start = time.process_time()
    outcome = optimize(network, real.views, real.given, TCOConfig(steps=steps), seed=seed)
    seconds = time.process_time() - start
    p = outcome.prediction
    errors = [e.abs() for e in errors_at_points(p, real.priors.held_out)]
    hidden = float(sum((e < 0.05).sum() for e in errors)) / max(1, sum(len(e) for e in errors))
    close = within(p, real.truth, 0.02), within(p, real.truth, 0.05)
    return seconds, *close, median_error(p, real.truth), hidden


def plot(curves: dict[str, Curve], path: Path) -> None:
    """Share of pixels off by more than 5 % against steps, relative to no steps; means over the seeds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 4.2), layout="constrained")
    axes = figure.subplots()
    for name, curve in curves.items():
        off = [1 - float(np.mean([run[2] for run in of_steps])) for of_steps in curve.values()]
        axes.plot(list(curve), [value / off[0] for value in off], marker="o", label=name)
    axes.set(xlabel="steps", ylabel="pixels off by more than 5 %, relative to no steps")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def line(steps: int, of_seeds: Sequence[Run]) -> str:
    """A row of the table."""
    seconds, *figures = zip(*of_seeds, strict=True)
    cells = [cell(values, digits) for values, digits in zip(figures, (4, 4, 4, 3), strict=True)]
    return f"| {steps} | {np.mean(seconds):.1f} | " + " | ".join(cells) + " |\n"


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--steps_list", type=int, nargs="+", default=[0, 2, 5, 10, 20, 40, 80])
    parser.add_argument("--seeds", type=int, default=1, help="runs of each number of steps")
    return parser


def main() -> None:
    """Measure and publish."""
    args = parser().parse_args()
    weights = args.weights or EMBEDDED
    network = load_sweep(weights)
    curves: dict[str, Curve] = {}
    for name in args.sets:
        real = load(name, args.size, args.views)
        if not curves:
            measure(network, real, 1, 0)
        # Without steps nothing is drawn.
        seeds = {steps: range(args.seeds if steps else 1) for steps in args.steps_list}
        curves[name] = {
            steps: [measure(network, real, steps, seed) for seed in drawn] for steps, drawn in seeds.items()
        }
    text = "# What steps buy\n\n" + paragraph(
        f"`python -m benchmarks.scaling`: {weights_told(weights)}, {args.views or 'all'} views of "
        f"{args.size} pixels, {runs(args.seeds)}. d2, d5: share of the measured pixels within 2 and 5 %; "
        "depths of each view alone, before the views are asked together. Steps are those on the network; "
        "the depths are refined after any but 0."
    )
    if args.output is not None:
        picture = plot_beside(args.output, args.part)
        plot(curves, picture)
        text += f"\n![steps against error]({picture.name})\n"
    for name, curve in curves.items():
        text += (
            f"\n## {name}\n\n| steps | CPU s | d2 | d5 | median error | hidden points within 5 % |\n"
            "|---|---|---|---|---|---|\n"
        )
        text += "".join(line(steps, of_seeds) for steps, of_seeds in curve.items())
    publish(text, args.output, args.part)


if __name__ == "__main__":
    main()
