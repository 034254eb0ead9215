"""The paper's table of noise: how wrong camera priors may be, held plainly and held by their uncertainty.

    python -m benchmarks.noise [--sets kitchen livingroom] [--output docs/noise.md]

Every camera is turned about a random axis by a normal angle, its centre moved in a random direction (relative
to the mean distance of the centres from their middle), its focal length multiplied. Of one seed, all rows
have the same axes, directions and normal numbers: they differ in their sizes alone. This is a table about
cameras: the triangulated points, and how far they are from each camera, stay those of the exact cameras,
better than any triangulation with wrong cameras; and the standard deviations that are told are those that
were drawn from, unless ``--stated`` names factors. Ways to use such cameras are compared:

network     the network alone, which takes them as they are
held        the optimisation with the cameras as they are
plain       cameras may move and are held by the paper's penalties with its weights
weighted    cameras may move and are held by their standard deviations, with a robust kernel
agreed      weighted, and the views asked together what the depths are

With plain and weighted the network is given the corrected cameras. With ``--stated``, weighted is repeated
with standard deviations that are so many times those of the noise.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.real import RealSet, arguments, load, within
from benchmarks.tables import cell, paragraph, publish, runs, weights_told
from colmap_tco.bench.noise import Noise
from tco.backbones.base import Backbone
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.consensus import agreed
from tco.optimize import Outcome, optimize
from tco.options import AblationConfig, ConsensusConfig, PolishConfig, TCOConfig
from tco.penalties import in_first_view, rotation_angle

TABLE = (
    Noise(),
    *(Noise(rotation=r) for r in (1, 3, 5)),
    *(Noise(translation=t) for t in (0.01, 0.05, 0.1)),
    *(Noise(focal=f) for f in (0.01, 0.05, 0.1)),
    *(Noise(r, t, t) for r, t in ((1, 0.01), (3, 0.05), (5, 0.1))),
)

Figures = dict[str, tuple[float, float]]
"""Way → share within 5 % and mean error of the rotations, degrees."""


def ways(steps: int, polish: PolishConfig) -> dict[str, TCOConfig]:
    """The four ways to use uncertain cameras."""
    plain = TCOConfig(steps=steps, polish=polish)
    return {
        "network": replace(plain, steps=0),
        "held": replace(plain, camera_rate=0.0),
        "plain": replace(plain, ablation=AblationConfig(plain_cameras=True)),
        "weighted": plain,
    }


def rotation_error(outcome: Outcome, real: RealSet) -> float:
    """Mean angle in degrees between the rotations, relative to the first view, and those of COLMAP."""
    assert real.given.cameras is not None
    ours, theirs = (in_first_view(c.world_from_cam) for c in (outcome.cameras, real.given.cameras))
    return math.degrees(float(rotation_angle(ours[1:, :3, :3], theirs[1:, :3, :3]).mean()))


def measured(network: Backbone, real: RealSet, noise: Noise, seed: int, args: argparse.Namespace) -> Figures:
    """Way → share within 5 % and mean error of the rotations, of one draw of the noise."""
    noisy, found = noise(real.given, seed), {}
    for way, config in ways(args.steps, PolishConfig(polish_uncertainty=args.polish_uncertainty)).items():
        outcome = optimize(network, real.views, noisy, config, seed)
        found[way] = within(outcome.prediction, real.truth), rotation_error(outcome, real)
    asking = ConsensusConfig(consensus_uncertainty=args.consensus_uncertainty)
    together = agreed(outcome.prediction, outcome.cameras, real.views, noisy, asking)
    found["agreed"] = within(together.prediction, real.truth), found["weighted"][1]
    for factor in args.stated:
        other = optimize(network, real.views, noise(real.given, seed, factor), config, seed)
        found[said(factor)] = within(other.prediction, real.truth), rotation_error(other, real)
    return found


def said(factor: float) -> str:
    """What the way with mis-stated standard deviations is called."""
    return f"weighted, told {factor:g} times"


def cells(of_seeds: Sequence[Figures]) -> list[str]:
    """Cells of one set: the share, and in brackets the mean error of the rotations."""
    found = {way: tuple(zip(*(of_seed[way] for of_seed in of_seeds), strict=True)) for way in of_seeds[0]}
    return [f"{cell(shares, 3)} ({np.mean(angles):.2f})" for shares, angles in found.values()]


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = arguments(__doc__ or "")
    parser.set_defaults(sets=["kitchen", "livingroom"])
    parser.add_argument("--rows", type=int, nargs="+", default=range(len(TABLE)), help="rows of the table")
    parser.add_argument("--seeds", type=int, default=1, help="draws of the noise, and of the optimisation")
    parser.add_argument(
        "--stated", type=float, nargs="+", default=[], help="standard deviations told over those drawn from"
    )
    polish, asking = PolishConfig().polish_uncertainty, ConsensusConfig().consensus_uncertainty
    parser.add_argument("--polish_uncertainty", type=float, default=polish, help="as of densify")
    parser.add_argument("--consensus_uncertainty", type=float, default=asking, help="as of densify")
    return parser


def main() -> None:
    """Measure and publish, row by row."""
    args = parser().parse_args()
    weights = args.weights or EMBEDDED
    network = load_sweep(weights)
    columns = [*ways(args.steps, PolishConfig()), "agreed", *map(said, args.stated)]
    head = [f"{name} {way}" for name in args.sets for way in columns]
    about = paragraph(
        f"`python -m benchmarks.noise --steps {args.steps} --seeds {args.seeds}`: {weights_told(weights)}, "
        f"{args.views or 'all'} views of {args.size} pixels, {args.steps} steps, {runs(args.seeds)}. Share "
        "of the measured pixels within 5 %; in brackets the mean error of relative rotations in degrees. "
        "network: no optimisation. held: cameras as given. plain: the paper's penalties and weights. "
        "weighted: by their uncertainty. agreed: weighted, and the views asked together "
        "(`docs/consensus.md`). Rows of one seed differ in the size of the noise alone. The triangulated "
        "points stay exact, and the standard deviations told are those of the noise unless a column says "
        "otherwise."
    )
    text = f"# Noise in the camera priors\n\n{about}\n| noise | {' | '.join(head)} |\n"
    text += "|---" * (len(head) + 1) + "|\n"
    sets = [load(name, args.size, args.views) for name in args.sets]
    for row in args.rows:
        of_sets = [
            [measured(network, real, TABLE[row], seed, args) for seed in range(args.seeds)] for real in sets
        ]
        line = f"| {TABLE[row]} | " + " | ".join(text for found in of_sets for text in cells(found)) + " |\n"
        text += line
        publish(text if args.output else line, args.output, args.part)


if __name__ == "__main__":
    main()
