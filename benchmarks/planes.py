"""What it gives to move depths onto planes, and what that depends on.

    python -m benchmarks.planes [--output docs/planes.md]

Each set is predicted once with the default optimisation and the views are asked together, as ``densify``
does, with the planes that the network is told of at first; then the settings of the planes that depths are
put on in the end are varied on the same depths. The settings were chosen by random scenes of the training's
kinds that no training saw (``--random``), with the figures of all other sets in view.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from benchmarks.real import SIZE, arguments, load
from benchmarks.rendered import SCENES
from benchmarks.sets import SETS
from benchmarks.tables import paragraph, publish, weights_told
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.conclusion import concluded
from tco.consensus import Agreement
from tco.optimize import optimize
from tco.options import ConsensusConfig, TCOConfig
from tco.planar.run import flattened
from tco.types import Cameras, Priors, Views
from training.dataset import assemble, jittered, triangulated
from training.photo import photographed
from training.scenes import generate

FIRST_SEED = 910_000
"""Of the random scenes; those of training are smaller."""
VIEWS = 10
SHAPE = (192, 256)


@dataclass(frozen=True)
class Case:
    """A set whose views were asked, how these overlap (V, V), and true depths (V, H, W), 0 where unknown."""

    name: str
    agreement: Agreement
    cameras: Cameras
    views: Views
    overlap: Tensor
    truth: Tensor


def variants() -> Iterator[tuple[str, ConsensusConfig]]:
    """Names and settings."""
    plain = ConsensusConfig()
    yield "no planes", replace(plain, planes=0)
    yield "default", plain
    yield "planes 1", replace(plain, planes=1)
    for trust in (2.5, 10.0):
        yield f"plane_trust {trust}", replace(plain, plane_trust=trust)
    for smoothness in (1.0, 4.0):
        yield f"plane_smoothness {smoothness}", replace(plain, plane_smoothness=smoothness)
    for square in (0.0, 1.0):
        yield f"plane_square {square}", replace(plain, plane_square=square)
    yield "plane_colour 0.0", replace(plain, plane_colour=0.0)


def random_scene(seed: int) -> tuple[Views, Priors, Tensor] | None:
    """Views, priors and true depths of a scene of the training's kinds; None if it has too few points."""
    rng = np.random.default_rng(seed)
    sample = generate(seed, VIEWS, SHAPE)
    tracks = triangulated(sample, rng)
    if not len(tracks.xyz) or tracks.seen.sum(1).min() < 8:
        return None
    return assemble(jittered(sample, rng), photographed(sample.images, rng), tracks)


def cases(args: argparse.Namespace) -> Iterator[Case]:
    """All sets, predicted, one after the other."""
    network = load_sweep(args.weights or EMBEDDED)
    config = TCOConfig(steps=args.steps)

    def predicted(name: str, views: Views, priors: Priors, truth: Tensor, config: TCOConfig) -> Case:
        outcome = optimize(network, views, priors, config)
        plain = replace(config, consensus=replace(config.consensus, planes=0, contest_views=0))
        together = concluded(outcome, views, priors, plain).flat.before
        assert priors.overlap is not None
        return Case(name, together, outcome.cameras, views, priors.overlap, truth)

    for name in args.sets:
        real = load(name, args.size, args.views)
        yield predicted(name, real.views, real.given, real.truth, config)
    for seed in range(FIRST_SEED, FIRST_SEED + args.random):
        scene = random_scene(seed)
        if scene is not None:
            yield predicted(f"{seed}", *scene, replace(config, camera_rate=0.0))


def shares(case: Case, config: ConsensusConfig) -> tuple[float, float, float]:
    """Shares of the measured pixels within 2 and 5 %, and seconds."""
    start = time.perf_counter()
    flat = flattened(case.agreement, case.cameras, case.views, config)
    seconds = time.perf_counter() - start
    error = (flat.agreement.prediction.depth / case.truth.clamp_min(1e-6) - 1).abs()[case.truth > 0]
    return float((error < 0.02).float().mean()), float((error < 0.05).float().mean()), seconds


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = arguments(__doc__ or "", (*SETS, *SCENES))
    parser.set_defaults(size=SIZE, views=0, steps=TCOConfig().steps)
    parser.add_argument("--random", type=int, default=16, help="random scenes, besides")
    return parser


def main() -> None:
    """Measure and publish."""
    args = parser().parse_args()
    every = list(cases(args))
    named, random = every[: len(args.sets)], every[len(args.sets) :]
    text = "# Planes\n\n" + paragraph(
        f"`python -m benchmarks.planes`: {weights_told(args.weights or EMBEDDED)}, {args.size} pixels, "
        f"{args.views or 'all'} views, after {args.steps} steps and the consensus, by a network that was "
        "told of planes in all rows. Shares of the measured "
        "pixels within 2 and 5 %, seconds of the planes (`tco/planar`, `docs/method.md`). random: mean of "
        f"{len(random)} scenes of the training's kinds, {VIEWS} views each, that no training saw, with "
        "dark, noisy and overexposed pictures among them; worst: the lowest change of the share within 5 % "
        "among these against no planes."
    )
    text += "\n| | " + " | ".join([*(case.name for case in named), "random", "worst"]) + " |\n"
    text += "|---" * (len(named) + 3) + "|\n"
    before: list[float] = []
    for name, config in variants():
        cells = ["{:.3f} {:.3f} {:.1f} s".format(*shares(case, config)) for case in named]
        far = [shares(case, config) for case in random]
        if far:
            before = before or [close for _, close, _ in far]
            worst = min(close - old for (_, close, _), old in zip(far, before, strict=True))
            means = np.mean(far, 0)
            cells += [f"{means[0]:.3f} {means[1]:.3f} {means[2]:.1f} s", f"{worst:+.3f}"]
        text += f"| {name} | " + " | ".join(cells) + " |\n"
    publish(text, args.output, args.part)


if __name__ == "__main__":
    main()
