"""The paper's table of noise: how wrong camera priors may be, held plainly and held by their uncertainty.

    python -m benchmarks.noise [--sets kitchen livingroom] [--output docs/noise.md]

Every camera is turned about a random axis by a normal angle, its centre moved in a random direction (relative
to the mean distance of the centres from their middle), its focal length multiplied. Depths at triangulated
points are left as they are: this is a table about cameras. Ways to use such cameras are compared:

network     the network alone, which takes them as they are
held        the optimisation with the cameras as they are
plain       cameras may move and are held by the paper's penalties with its weights
weighted    cameras may move and are held by their standard deviations, with a robust kernel; the network is
            given the corrected ones
agreed      weighted, and the views asked together what the depths are
"""

from __future__ import annotations

import math
from dataclasses import replace

from benchmarks.real import RealSet, arguments, load, publish, within
from colmap_tco.bench.noise import Noise
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


def ways(steps: int, polish: PolishConfig) -> dict[str, TCOConfig]:
    """The four ways to use uncertain cameras."""
    plain = TCOConfig(steps=steps, polish=polish)
    return {
        "network": replace(plain, steps=0),
        "held": replace(plain, camera_rate=0.0),
        "plain": replace(plain, reencode=0.0, ablation=AblationConfig(plain_cameras=True)),
        "weighted": plain,
    }


def rotation_error(outcome: Outcome, real: RealSet) -> float:
    """Mean angle in degrees between the rotations, relative to the first view, and those of COLMAP."""
    assert real.given.cameras is not None
    ours, theirs = (in_first_view(c.world_from_cam) for c in (outcome.cameras, real.given.cameras))
    return math.degrees(float(rotation_angle(ours[1:, :3, :3], theirs[1:, :3, :3]).mean()))


def main() -> None:
    """Command line."""
    parser = arguments(__doc__ or "")
    parser.set_defaults(sets=["kitchen", "livingroom"])
    parser.add_argument("--rows", type=int, nargs="+", default=range(len(TABLE)), help="rows of the table")
    parser.add_argument(
        "--polish_uncertainty", type=float, default=PolishConfig().polish_uncertainty, help="as of densify"
    )
    parser.add_argument(
        "--consensus_uncertainty",
        type=float,
        default=ConsensusConfig().consensus_uncertainty,
        help="as of densify",
    )
    args = parser.parse_args()
    network = load_sweep(args.weights or EMBEDDED)
    configs = ways(args.steps, PolishConfig(polish_uncertainty=args.polish_uncertainty))
    head = [f"{name} {way}" for name in args.sets for way in (*configs, "agreed")]
    lines = [
        "# Noise in the camera priors\n",
        f"`python -m benchmarks.noise --steps {args.steps}`: {args.views or 'all'} views of {args.size} "
        f"pixels, {args.steps} steps. Share of measured pixels within 5 %; in brackets the mean error of "
        "relative rotations in degrees.\n",
        "| noise | " + " | ".join(head) + " |",
        "|---" * (len(head) + 1) + "|",
    ]
    sets = [load(name, args.size, args.views) for name in args.sets]
    for row in args.rows:
        cells = []
        for real in sets:
            noisy = TABLE[row](real.given, seed=row)
            for config in configs.values():
                outcome = optimize(network, real.views, noisy, config)
                cells.append(
                    f"{within(outcome.prediction, real.truth):.3f} ({rotation_error(outcome, real):.2f})"
                )
            asking = ConsensusConfig(consensus_uncertainty=args.consensus_uncertainty)
            together = agreed(outcome.prediction, outcome.cameras, real.views, noisy, asking)
            cells.append(f"{within(together.prediction, real.truth):.3f}")
        lines.append(f"| {TABLE[row]} | " + " | ".join(cells) + " |")
        if args.output is None:
            publish(lines[-1] + "\n", None)
        else:
            publish("\n".join(lines) + "\n", args.output)


if __name__ == "__main__":
    main()
