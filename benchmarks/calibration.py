"""Is the predicted error of a pixel its actual error? Table and plot on the real sets.

    python -m benchmarks.calibration [--steps 2] [--output docs/calibration.md]

The embedded network predicts the scale b of a Laplace distribution of each pixel's relative depth error, for
which the mean of |error| is b; confidence is 1 + 0.02 / b. The depths are those that densify writes:
optimised, and moved to what the views say together. Pixels are put into classes of b, and the mean and median
of what a depth sensor says are set beside it. Errors above 50 % count as 50 %, as in training. The plot goes
beside the Markdown file.

A second table sets the standard error, by how far apart the views were (``error_maps``), beside the same.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.real import SIZE, arguments, load
from benchmarks.tables import paragraph, plot_beside, publish, weights_told
from tco.backbones.sweep import ERROR_UNIT
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.conclusion import concluded
from tco.optimize import optimize
from tco.options import TCOConfig

EDGES = np.array([0.0, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 1.0])
APART = np.array([0.0, 0.0005, 0.001, 0.002, 0.003, 0.005, 0.01, 0.02, 0.05, 1.0])
"""Bounds of the classes of predicted errors, and of standard errors."""
Row = tuple[float, float, float, float, float]
"""Share of the pixels; mean predicted error; mean and median actual error; share within 5 %."""


def classes(
    predicted: NDArray[np.float64], actual: NDArray[np.float64], edges: NDArray[np.float64] = EDGES
) -> list[Row]:
    """One row for each class of predicted error that holds at least 200 pixels."""
    rows, which = [], np.digitize(predicted, edges) - 1
    for k in range(len(edges) - 1):
        mine = which == k
        if mine.sum() < 200:
            continue
        e = actual[mine]
        rows.append(
            (
                float(mine.mean()), float(predicted[mine].mean()), float(e.mean()), float(np.median(e)),
                float((e < 0.05).mean()),
            )
        )  # fmt: skip
    return rows


def gap(rows: list[Row]) -> float:
    """Mean over the pixels of |log₂(actual / predicted)|: 1 is a factor of two."""
    share = sum(row[0] for row in rows)
    return sum(row[0] * abs(float(np.log2(row[2] / row[1]))) for row in rows) / share


def plot(curves: dict[str, list[Row]], path: Path) -> None:
    """Predicted against actual error of each set, both logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 4.8), layout="constrained")
    axes = figure.subplots()
    axes.plot([0.002, 0.5], [0.002, 0.5], color="0.6", linewidth=1, label="predicted = actual")
    for name, rows in curves.items():
        axes.plot([r[1] for r in rows], [r[2] for r in rows], marker="o", label=name)
    axes.set(
        xscale="log", yscale="log", xlabel="predicted relative error", ylabel="actual relative error, mean"
    )
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = arguments(__doc__ or "")
    parser.set_defaults(steps=TCOConfig().steps, size=SIZE, views=0)
    return parser


def main() -> None:
    """Measure and publish."""
    args = parser().parse_args()
    weights = args.weights or EMBEDDED
    network = load_sweep(weights)
    curves, apart = {}, {}
    for name in args.sets:
        real = load(name, args.size, args.views)
        config = TCOConfig(steps=args.steps)
        outcome = optimize(network, real.views, real.given, config)
        end = concluded(outcome, real.views, real.given, config)
        prediction, known = end.agreement.prediction, real.truth > 0
        error = (prediction.depth / real.truth.clamp_min(1e-6) - 1).abs().double().clamp_max(0.5)
        predicted = (ERROR_UNIT / (prediction.confidence[known] - 1).clamp_min(1e-3)).to(torch.float64)
        curves[name] = classes(predicted.numpy(), error[known].numpy())
        own = known & ~end.taken
        apart[name] = classes(end.agreement.error[own].double().numpy(), error[own].numpy(), APART)
    text = "# Calibration of the confidence\n\n" + paragraph(
        f"`python -m benchmarks.calibration --steps {args.steps}`: {weights_told(weights)}, {args.size} "
        f"pixels, {args.views or 'all'} views. Standard errors are of pixels that have not taken another "
        "view's depth; their share is of these."
    )
    if args.output is not None:
        picture = plot_beside(args.output, args.part)
        plot(curves, picture)
        text += f"\n![predicted against actual error]({picture.name})\n"
    for name, rows in curves.items():
        text += f"\n## {name}\n\nOff by a factor of {2 ** gap(rows):.2f} on average.\n\n"
        text += table("predicted", rows) + "\n" + table("standard error", apart[name])
    publish(text, args.output, args.part)


def table(what: str, rows: list[Row]) -> str:
    """Classes of what was told as a Markdown table."""
    text = (
        f"| share of pixels | {what} | actual, mean | actual, median | within 5 % |\n|---|---|---|---|---|\n"
    )
    for share, told, mean, median, close in rows:
        text += f"| {share:.3f} | {told:.4f} | {mean:.4f} | {median:.4f} | {close:.3f} |\n"
    return text


if __name__ == "__main__":
    main()
