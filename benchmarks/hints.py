"""What it gives to equalise pictures, to tell what views agree on, to take refined depths back.

    python -m benchmarks.hints [--output docs/hints.md]

Every row is the whole of what the maps are made by: optimisation, consensus, planes, contest. Random scenes
are those of ``benchmarks.planes``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from operator import attrgetter
from typing import Any
from unittest.mock import patch

import numpy as np
from torch import Tensor

from benchmarks.planes import FIRST_SEED, random_scene
from benchmarks.real import SIZE, arguments, load
from benchmarks.rendered import SCENES
from benchmarks.sets import SETS
from benchmarks.tables import paragraph, publish, weights_told
from tco.backbones.sweep import Sweep
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.conclusion import concluded
from tco.optimize import Outcome, optimize
from tco.options import TCOConfig
from tco.types import Priors, Views

Shares = tuple[float, float]
Case = tuple[str, Views, Priors, Tensor, TCOConfig]


def changed(config: TCOConfig, **changes: Any) -> TCOConfig:
    """The settings with other ones of the hints (``hint_…``) and of the refinement."""
    hints = {name: value for name, value in changes.items() if name.startswith("hint_")}
    polish = {name: value for name, value in changes.items() if name.startswith("polish_")}
    return replace(config, hints=replace(config.hints, **hints), polish=replace(config.polish, **polish))


def cases(args: argparse.Namespace) -> Iterator[Case]:
    """Name, views, priors, true depths and settings of each set; random ones have cameras that stay."""
    config = TCOConfig(steps=args.steps)
    for name in args.sets:
        real = load(name, args.size, args.views)
        yield name, real.views, real.given, real.truth, config
    for seed in range(FIRST_SEED, FIRST_SEED + args.random):
        scene = random_scene(seed)
        if scene is not None:
            yield str(seed), *scene, replace(config, camera_rate=0.0)


def shares(outcome: Outcome, case: Case, config: TCOConfig) -> Shares:
    """Shares of the measured pixels within 2 and 5 %."""
    _, views, priors, truth, _ = case
    depth = concluded(outcome, views, priors, config).agreement.prediction.depth
    error = (depth / truth.clamp_min(1e-6) - 1).abs()[truth > 0]
    return float((error < 0.02).float().mean()), float((error < 0.05).float().mean())


def rows(networks: tuple[Sweep, Sweep], case: Case) -> Iterator[tuple[str, Shares]]:
    """Each variant of one set, by networks that see pictures as they are and equalised."""
    plain, equalised = networks
    _, views, priors, _, config = case
    alone, told = changed(config, hint_rounds=0), config

    def predicted(network: Sweep, config: TCOConfig) -> Callable[[TCOConfig], Shares]:
        outcome = optimize(network, views, priors, config)
        return lambda settings: shares(outcome, case, settings)

    of = predicted(plain, alone)
    yield "pictures as they are, COLMAP's points, all refined depths", of(changed(alone, polish_growth=0.0))
    of = predicted(equalised, alone)
    yield "equalised pictures", of(changed(alone, polish_growth=0.0))
    yield "equalised, refined depths taken back", of(alone)
    of = predicted(equalised, told)
    yield "equalised, told", of(changed(told, polish_growth=0.0))
    yield "default: equalised, told, taken back", of(told)
    with patch("tco.hints.as_planes_are", attrgetter("agreement")):
        of = predicted(equalised, told)
    yield "the same, told of pixels on planes as of others", of(told)
    unoptimised = replace(told, steps=0)
    yield "default without optimisation", predicted(equalised, unoptimised)(unoptimised)


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = arguments(__doc__ or "", (*SETS, *SCENES))
    parser.set_defaults(size=SIZE, views=0, steps=TCOConfig().steps)
    parser.add_argument("--random", type=int, default=8, help="random scenes, besides")
    return parser


def main() -> None:
    """Measure and publish."""
    args = parser().parse_args()
    weights = args.weights or EMBEDDED
    networks = load_sweep(weights), load_sweep(weights)
    networks[0].config = replace(networks[0].config, equalise=0.0)
    found: dict[str, dict[str, Shares]] = {}
    for case in cases(args):
        for name, figures in rows(networks, case):
            found.setdefault(name, {})[case[0]] = figures
    lines = ["| | " + " | ".join([*args.sets, *(["random", "worst"] if args.random else [])]) + " |"]
    lines.append("|" + "---|" * (lines[0].count("|") - 1))
    first = next(iter(found.values()))
    for name, figures in found.items():
        cells = [f"{figures[s][0]:.3f} {figures[s][1]:.3f}" for s in args.sets]
        drawn = [s for s in figures if s not in args.sets]
        if drawn:
            mean = np.mean([figures[s] for s in drawn], axis=0)
            worst = min(figures[s][1] - first[s][1] for s in drawn)
            cells += [f"{mean[0]:.3f} {mean[1]:.3f}", f"{worst:+.3f}"]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    size = "" if args.size == SIZE else f" --size {args.size}"
    told = (
        f"`python -m benchmarks.hints --sets {' '.join(args.sets)} --random {args.random}{size}`: "
        f"{weights_told(weights)}, {args.size} pixels, "
        f"{args.views or 'all'} views, {args.steps} steps. Shares of the measured pixels within 2 and 5 %. "
        f"random: mean of {len(first) - len(args.sets)} scenes of the training's kinds, 10 views each, "
        "that no training saw; worst: the lowest change of the share within 5 % among these against the "
        "first row."
    )
    text = "# What views agree on\n\n" + paragraph(told) + "\n" + "\n".join(lines) + "\n"
    publish(text, args.output, args.part)


if __name__ == "__main__":
    main()
