"""Train the image-only network ``mini`` where a GPU is at hand for some minutes.

    python -m benchmarks.gpu.train_mini [--minutes 8.5] [--schedule 21.5]

All processor cores but two render while the GPU trains, so samples grow from run to run. A run takes
``--minutes`` in all: it first waits for ``--first`` samples, and resumes where the one before stopped. The
learning rate follows a clock of ``--schedule`` minutes of training over all runs. ``--work`` keeps samples
and state; ``--out`` gets the weights, the log and the table of errors on samples that were held out.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.gpu.rendering import rendering, wait_for
from colmap_tco.evaluation.trajectory import pose_auc, relative_errors
from tco.backbones.dinov2 import ViTConfig
from tco.backbones.mini import Mini, load
from tco.backbones.vggt import VGGTConfig
from tco.types import Priors, Views
from training.pool import Held, gathered
from training.supervision import Scenes, normalised
from training.train_mini import MiniConfig, MiniTrainer

AT_THE_END = 0.7
"""Minutes that the last checkpoint, its copy and the table take."""

TINY = VGGTConfig(
    ViTConfig(48, 0, 2, registers=1, side=4, mask_token=False, patch=8), 48, 2, 4, registers=2,
    camera_depth=1, camera_heads=4, features=16, levels=(16, 16, 16, 16), layers=(0, 0, 1, 1), points=False,
)  # fmt: skip
"""A network to try the script with."""

LARGE = MiniConfig()
SMALL = replace(
    LARGE, network=TINY, sizes=((0.0, 32, 48),), shape=(32, 48), pixels=12 * 32 * 48, warmup=5, held_out=2
)
COLUMNS = ("AUC@5°", "AUC@30°", "rotation °", "direction °", "focal", "AbsRel", "within 5 %")


@torch.no_grad()
def scored(network: Mini, scenes: Scenes) -> list[float]:
    """The columns for one scene: shares, median errors of pairs in degrees, and relative errors.

    Depth is compared after one scale, the median ratio over all views.
    """
    true = normalised(scenes)
    images, views = true.images[0], true.images.shape[1]
    valid = torch.ones(views, *true.size, dtype=torch.bool, device=images.device)
    shown = Views(images, valid, tuple(map(str, range(views))))
    found = network.decode(network.encode(shown, Priors()))
    ours, theirs = (p.double().cpu().numpy() for p in (found.cameras.world_from_cam, true.world_from_cam[0]))
    area = pose_auc(ours, theirs, (5, 30)).auc
    rotation, direction = relative_errors(ours, theirs)
    focal = (found.cameras.K[:, 0, 0] / true.K[0, :, 0, 0] - 1).abs().mean()
    known = true.depth[0] > 0
    depth, truth = found.depth[known], true.depth[0][known]
    error = ((truth / depth).median() * depth / truth - 1).abs()
    depths = [float(error.mean()), float((error < 0.05).float().mean())]
    return [*area, float(np.median(rotation)), float(np.median(direction)), float(focal), *depths]


def table(weights: Path, samples: Sequence[Held], shape: tuple[int, int], device: str) -> str:
    """Errors on samples by number of views, of the weights as they were written."""
    network = load(weights, device)
    most = max(len(sample) for sample in samples)
    lines = ["| views | " + " | ".join(COLUMNS) + " |", "|---" * (1 + len(COLUMNS)) + "|"]
    for views in sorted({2, min(4, most), most}):
        rows = []
        for sample in samples:
            if len(sample) >= views:
                chosen = np.linspace(0, len(sample) - 1, views).round().astype(int).tolist()
                rows.append(scored(network, gathered([sample], [chosen], shape)))
        lines.append(f"| {views} | " + " | ".join(f"{x:.3f}" for x in np.mean(rows, 0)) + " |")
    return "\n".join(lines) + "\n"


def options(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, default=Path("runs/gpu/mini"), help="keeps samples and state")
    parser.add_argument("--out", type=Path, default=Path(os.environ.get("OUT", "runs/gpu/out")))
    parser.add_argument("--data", type=Path, nargs="*", default=[], help="more folders of samples")
    parser.add_argument("--minutes", type=float, default=8.5, help="of this run, in all")
    parser.add_argument("--schedule", type=float, default=21.5, help="minutes of training in all runs")
    parser.add_argument("--first", type=int, default=1500, help="samples to wait for")
    parser.add_argument("--views", type=int, default=8, help="of each rendered sample")
    parser.add_argument("--cores", type=int, default=max(1, (os.cpu_count() or 1) - 2), help="that render")
    parser.add_argument(
        "--samples", type=int, default=20_000, help="most that are rendered: 1.1 MB each on the GPU"
    )
    parser.add_argument(
        "--pixels", type=int, default=0, help="of a batch; 0: for 80 GB; halve it for half of that"
    )
    parser.add_argument("--rate", type=float, default=LARGE.rate)
    parser.add_argument("--device", default="cuda")
    parser.add_argument(
        "--small", action="store_true", help="a tiny network and tiny pictures, to try the script"
    )
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, train, write, measure.

    Raises:
        SystemExit: too few samples were rendered in the time there is.
    """
    args, began = options(arguments), time.monotonic()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", stream=sys.stderr)
    plain = SMALL if args.small else LARGE
    data = args.work / "data"
    if torch.device(args.device).type == "cuda":
        torch.set_float32_matmul_precision("high")
    with rendering(data, plain.shape, args.cores, args.views, args.samples):
        have = wait_for(data, max(args.first, plain.held_out + 1), args.minutes / 2)
        if have <= plain.held_out:
            raise SystemExit(f"{data}: {have} samples in {args.minutes / 2:g} minutes; give --minutes more")
        left = args.minutes - (time.monotonic() - began) / 60 - min(AT_THE_END, 0.2 * args.minutes)
        config = replace(
            plain,
            minutes=args.schedule,
            stop=max(left, 1e-3),
            rate=args.rate,
            pixels=args.pixels or plain.pixels,
        )
        trainer = MiniTrainer(config, [*args.data, data], args.work / "run", device=args.device)
        trainer.run(every=200, validation=1000)
    args.out.mkdir(parents=True, exist_ok=True)
    for name in ("weights.safetensors", "log.csv"):
        (args.out / name).write_bytes((args.work / "run" / name).read_bytes())
    told = (
        f"{trainer.step} steps in {trainer.clock() / 60:.1f} of {args.schedule:g} minutes, "
        f"{trainer.shown} scenes seen, drawn from {len(trainer.pool.samples)} samples\n\n"
    )
    text = told + table(args.out / "weights.safetensors", trainer.held_out, config.shape, args.device)
    (args.out / "table.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
