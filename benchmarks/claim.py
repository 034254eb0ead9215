"""The paper's claim at our scale: what each prior and the compatibility of views bring a network.

    python -m benchmarks.claim [--backbone sweep] [--seeds 3] [--output docs/claim.md]
    python -m benchmarks.claim --sets hills knots walk temple --part rendered --output docs/claim.md
    python -m benchmarks.claim --backbone mini --weights runs/gpu/out/weights.safetensors

The claim (arXiv 2604.03878): held to what is known of the cameras and to its own views' agreement for some
steps at test time, a network reconstructs better than it does alone. Rows are those of ``colmap-tco bench``
(``colmap_tco/bench/rows.py``), run by the same code, on the shared real sets or rendered scenes. A network
that predicts cameras runs all of them, with the settings of the paper's scripts for 7-Scenes, Kinect
sequences of rooms as the real sets are. One that takes cameras as input cannot do without them: its first row
is the network alone with both priors, and its settings are those of ``densify``, which refines depths after
the steps on the network. ``no-compatibility`` does not; what comparing views brings is its distance to
``adapt-only``.

Columns: ``d5``, share of the measured pixels whose depth is within 5 % after one scale for all views, the
median ratio; ``acc`` and ``comp``, means of the distances of points to the sensor's and back, millimetres,
after the paper's alignment, of pixels that a cloud would have (``max_depth_ratio``) where the network takes
cameras; ``AUC``, of relative poses at 30° against COLMAP's, where a network finds them.
A ± is half of the 95 % interval of the mean over seeds (Student's t).
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.real import RealSet, arguments, load
from benchmarks.tables import cell, paragraph, publish, runs, weights_told
from colmap_tco.backbones import NetworkConfig, Selected, select, suited
from colmap_tco.backbones import load as load_network
from colmap_tco.bench.command import TAKE_CAMERAS
from colmap_tco.bench.figures import point_figures
from colmap_tco.bench.methods import Reconstruction, check_row, reconstruct
from colmap_tco.bench.prepare import Prepared
from colmap_tco.bench.rows import Row, parse_rows
from colmap_tco.bench.schedules import published
from colmap_tco.errors import DensifyError
from colmap_tco.evaluation.trajectory import pose_auc
from colmap_tco.published import NETWORKS
from tco.backbones.base import Backbone
from tco.options import TCOConfig

BOTH = ("pose", "intrinsics")
CURVE = ("steps=5", "steps=10", "steps=20", "steps=80")
NOISE = ("noise=1/0.01/0.01", "noise=3/0.05/0.05", "noise=5/0.1/0.1")
ABLATIONS = (
    "rank=1", "rank=16", "radius=0.05", "radius=2", "heads", "surfels", *NOISE,
)  # fmt: skip
ROWS = {
    False: ("base", "raw-depth", "pose", "intrinsics", "tco", "no-compatibility", *CURVE, *ABLATIONS),
    True: ("steps=0", "tco", "adapt-only", "no-compatibility", *CURVE, *NOISE),
}
"""Whether a network takes cameras as input → its rows, the network alone first. The other ablations of one
that does are in ``benchmarks.ablations``."""

Figures = Mapping[str, float]


def prepared(real: RealSet) -> Prepared:
    """A set as the rows take it; the truth in metres, COLMAP's cameras as truth and as priors."""
    cameras = real.given.cameras
    assert cameras is not None
    poses = cameras.world_from_cam.double().numpy().copy()
    poses[:, :3, 3] *= real.metres
    truth = (real.truth * real.metres).numpy()
    return Prepared(real.views, cameras, poses, cameras.K.double().numpy(), truth, real.metres, real.given)


def figures(made: Reconstruction, scene: Prepared, own_cameras: bool) -> Figures:
    """The columns of one run.

    Raises:
        InputError: its points cannot be aligned to the truth.
    """
    R, centre = made.world_from_cam[:, :3, :3], made.world_from_cam[:, :3, 3]
    depth = np.einsum("vhwc,vc->vhw", made.points - centre[:, None, None], R[:, :, 2])
    known = scene.known
    ratio = scene.depth[known] / np.maximum(depth[known], 1e-9)
    error = np.abs(np.median(ratio) / ratio - 1)
    cloud = point_figures(made.points, scene.points, known, 1000.0, made.kept)
    found = {"d5": float((error < 0.05).mean()), "acc": cloud["acc_mean"], "comp": cloud["comp_mean"]}
    if own_cameras:
        (found["AUC"],) = pose_auc(made.world_from_cam, scene.world_from_cam, (30,)).auc
    return found


def line(row: str, ours: Sequence[Sequence[Figures]], base: Sequence[Sequence[Figures]]) -> str:
    """A row of the table.

    Args:
        row: its name.
        ours: figures of each set and seed.
        base: those of the network alone.
    """
    parts = []
    for of_set in ours:
        digits = {"d5": 3, "AUC": 3, "acc": 1, "comp": 1}
        parts += [cell([run[name] for run in of_set], digits[name]) for name in of_set[0]]
    each = zip(*ours, strict=True), zip(*base, strict=True)
    gains = [
        float(np.mean([a["d5"] - b["d5"] for a, b in zip(adapted, alone, strict=True)]))
        for adapted, alone in zip(*each, strict=True)
    ]
    return f"| {row} | " + " | ".join(parts) + f" | {cell(gains, 3)} |"


def measured(network: Backbone, scene: Prepared, row: Row, config: TCOConfig, seeds: int) -> list[Figures]:
    """Figures of a row on a set, one a seed; without steps nothing is drawn, and one run stands for all."""
    device = next(network.decoder().parameters()).device
    fixed = row.config(config).steps == 0
    found = [
        figures(reconstruct(network, scene, row, config, device, seed), scene, not network.uses_cameras)
        for seed in range(1 if fixed else seeds)
    ]
    return found * seeds if fixed else found


def settings(chosen: Selected) -> TCOConfig:
    """Of the optimisation before rows change them."""
    if chosen.network.kind in TAKE_CAMERAS:
        return suited(TCOConfig(), chosen.network)
    return published("7scenes", TCOConfig())


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = arguments(__doc__ or "")
    parser.set_defaults(steps=0)
    parser.add_argument("--backbone", default="sweep", choices=list(NETWORKS))
    parser.add_argument("--device", default="auto")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--rows", nargs="+", default=None, help="as colmap-tco bench has them; first: alone")
    return parser


def table(
    network: Backbone, sets: Sequence[RealSet], rows: Sequence[Row], config: TCOConfig, seeds: int
) -> list[str]:
    """Lines of the table; the first row is what gains are counted from."""
    scenes = [prepared(real) for real in sets]
    columns = ("d5", "acc", "comp") + (() if network.uses_cameras else ("AUC",))
    head = " | ".join(f"{real.name} {column}" for real in sets for column in columns)
    lines = [f"| | {head} | gain in d5 |", "|---" * (2 + len(sets) * len(columns)) + "|"]
    base: list[list[Figures]] = []
    for row in rows:
        ours = [measured(network, scene, row, config, seeds) for scene in scenes]
        base = base or ours
        lines.append(line(row.name, ours, base))
    return lines


def main() -> None:
    """Measure and publish."""
    args = parser().parse_args()
    weights = str(args.weights) if args.weights else ""
    try:
        chosen = select(NetworkConfig(backbone=args.backbone, weights=weights, device=args.device))
        network = load_network(chosen)
        config = settings(chosen)
        if args.steps:
            config = replace(config, steps=args.steps, uncertain_steps=0)
        rows = parse_rows(args.rows or ROWS[network.uses_cameras], BOTH)
        for row in rows:
            check_row(network, row)
        sets = [load(name, args.size, args.views, network.stride) for name in args.sets]
        lines = table(network, sets, rows, config, args.seeds)
    except DensifyError as error:
        raise SystemExit(str(error)) from error
    head = f"# What priors and compatibility bring {args.backbone}\n\n"
    about = paragraph(
        f"`python -m benchmarks.claim`: {weights_told(chosen.weights)}, {args.views or 'all'} views of "
        f"{args.size} pixels, {config.steps} steps at {config.rate:g} where a row does not say otherwise, "
        f"{runs(args.seeds)}. d5 is taken after one scale for all views; acc and comp are millimetres. `gain "
        "in d5` is over the first row, paired by seed, mean of the sets."
    )
    publish(head + about + "\n" + "\n".join(lines) + "\n", args.output, args.part)


if __name__ == "__main__":
    main()
