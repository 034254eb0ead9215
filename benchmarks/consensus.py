"""What it gives to ask all views where a surface is: depths of each view alone, and after the consensus.

    python -m benchmarks.consensus [--output docs/consensus.md]

Each set is predicted once by the network alone and once with the default optimisation; then the settings of
the consensus are varied on the same depths. Rendered sets (``benchmarks/rendered.py``) are made if need be.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace

from benchmarks.real import SIZE, RealSet, arguments, load, median_error, within
from benchmarks.rendered import SCENES
from benchmarks.sets import SETS
from benchmarks.tables import paragraph, publish, weights_told
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.consensus import agreed
from tco.optimize import Outcome, optimize
from tco.options import ConsensusConfig, TCOConfig


def variants() -> Iterator[tuple[str, ConsensusConfig]]:
    """Names and settings."""
    plain = ConsensusConfig()
    yield "each view alone", replace(plain, consensus_rounds=0)
    yield "default", plain
    for rounds in (1, 4):
        yield f"{rounds} rounds", replace(plain, consensus_rounds=rounds)
    for views in (2, 4, 8):
        yield f"{views} views asked", replace(plain, consensus_views=views)
    for reach in (0.05, 0.1, 0.2, 0.4):
        yield f"reach {reach}", replace(plain, consensus_reach=reach)
    for width in (1e-4, 0.003, 0.03):
        yield f"width {width}", replace(plain, consensus_width=width)


def cell(real: RealSet, outcome: Outcome, config: ConsensusConfig) -> str:
    """Shares within 2 and 5 %, median error and seconds of the consensus."""
    start = time.process_time()
    together = agreed(outcome.prediction, outcome.cameras, real.views, real.given, config)
    seconds = time.process_time() - start
    depths = together.prediction
    near, close = within(depths, real.truth, 0.02), within(depths, real.truth)
    return f"{near:.3f} {close:.3f} {100 * median_error(depths, real.truth):.2f} % {seconds:.1f} s"


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = arguments(__doc__ or "", (*SETS, *SCENES))
    parser.set_defaults(size=SIZE, views=0, steps=TCOConfig().steps)
    return parser


def main() -> None:
    """Measure and publish."""
    args = parser().parse_args()
    weights = args.weights or EMBEDDED
    network = load_sweep(weights)
    sets = [load(name, args.size, args.views) for name in args.sets]
    head = "| | " + " | ".join(args.sets) + " |\n" + "|---" * (len(sets) + 1) + "|\n"
    text = "# Consensus\n\n" + paragraph(
        f"`python -m benchmarks.consensus`: {weights_told(weights)}, {args.size} pixels, "
        f"{args.views or 'all'} views. Shares of the measured pixels within 2 and 5 %, median error, seconds "
        "of CPU of the consensus (`tco/consensus.py`, `docs/method.md`)."
    )
    for steps in (0, args.steps):
        outcomes = [optimize(network, real.views, real.given, TCOConfig(steps=steps)) for real in sets]
        text += f"\n## {steps} steps\n\n{head}"
        for name, config in variants():
            cells = [cell(real, outcome, config) for real, outcome in zip(sets, outcomes, strict=True)]
            text += f"| {name} | " + " | ".join(cells) + " |\n"
    publish(text, args.output, args.part)


if __name__ == "__main__":
    main()
