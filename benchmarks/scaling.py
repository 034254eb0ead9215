"""Steps of optimisation against error and seconds, as the paper's scaling curve: table and plot.

    python -m benchmarks.scaling [--steps_list 0 5 10 20 40 80] [--output docs/scaling.md]

Each number of steps is a run of its own, since the schedule depends on it. Seconds are CPU seconds of the
optimiser on the loaded network, from pixels to depths.
"""

from __future__ import annotations

import time
from pathlib import Path

from benchmarks.real import RealSet, arguments, load, median_error, publish, within
from tco.backbones.base import Backbone
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.optimize import errors_at_points, optimize
from tco.options import TCOConfig

Row = tuple[int, float, float, float, float, float]
"""Steps; seconds; within 2 and 5 % of the sensor; median error; hidden points within 5 %."""


def measure(network: Backbone, real: RealSet, steps: int, seed: int) -> Row:
    """One run."""
    start = time.process_time()
    outcome = optimize(network, real.views, real.given, TCOConfig(steps=steps), seed=seed)
    seconds = time.process_time() - start
    p = outcome.prediction
    errors = [e.abs() for e in errors_at_points(p, real.priors.held_out)]
    hidden = float(sum((e < 0.05).sum() for e in errors)) / max(1, sum(len(e) for e in errors))
    close = within(p, real.truth, 0.02), within(p, real.truth, 0.05)
    return steps, seconds, *close, median_error(p, real.truth), hidden


def plot(curves: dict[str, list[Row]], path: Path) -> None:
    """Share of pixels off by more than 5 % against steps, relative to no steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 4.2), layout="constrained")
    axes = figure.subplots()
    for name, rows in curves.items():
        axes.plot([r[0] for r in rows], [(1 - r[3]) / (1 - rows[0][3]) for r in rows], marker="o", label=name)
    axes.set(xlabel="steps", ylabel="pixels off by more than 5 %, relative to no steps")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Command line."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--steps_list", type=int, nargs="+", default=[0, 5, 10, 20, 40, 80])
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    network = load_sweep(args.weights or EMBEDDED)
    curves = {}
    for name in args.sets:
        real = load(name, args.size, args.views)
        curves[name] = [measure(network, real, steps, args.seed) for steps in args.steps_list]
    text = (
        f"# What steps buy\n\n`python -m benchmarks.scaling`: {args.views or 'all'} views of {args.size} "
        "pixels. d2, d5: share of the measured pixels within 2 and 5 %.\n"
    )
    if args.output is not None:
        plot(curves, args.output.with_suffix(".png"))
        text += f"\n![steps against error]({args.output.with_suffix('.png').name})\n"
    for name, rows in curves.items():
        text += (
            f"\n## {name}\n\n| steps | CPU s | d2 | d5 | median error | hidden points within 5 % |\n"
            "|---|---|---|---|---|---|\n"
        )
        for steps, seconds, d2, d5, median, hidden in rows:
            text += f"| {steps} | {seconds:.1f} | {d2:.4f} | {d5:.4f} | {median:.4f} | {hidden:.3f} |\n"
    publish(text, args.output)


if __name__ == "__main__":
    main()
