"""Train the embedded network further where a GPU is at hand for some minutes.

    python -m benchmarks.gpu.train_sweep [--render-minutes 3] [--minutes 6] [--init FILE]

Renders on all processor cores until there are enough samples, then trains from the weights in the
package by the clock, and prints a table of the errors before and after on samples that were held out. Run it
again to go on: samples stay in ``--work``, and ``--init`` takes the weights of the run before.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from benchmarks.gpu.rendering import rendering
from tco.backbones.weights import EMBEDDED, load_sweep
from training.dataset import load
from training.train import TrainConfig

SIZES = {
    "large": [[0.0, 144, 192], [0.25, 192, 256], [0.7, 288, 384]],
    "small": [[0.0, 48, 64]],
}
COLUMNS = ("AbsRel", "within 2 %", "within 5 %")


def render(folder: Path, minutes: float, shape: tuple[int, int]) -> int:
    """Render samples on all cores for some minutes; the number of samples there are."""
    have = len(list(folder.glob("*.npz")))
    with rendering(folder, shape, os.cpu_count() or 1):
        time.sleep(60 * minutes)
    count = len(list(folder.glob("*.npz")))
    sys.stdout.write(f"{count - have} samples rendered, {count} in all\n\n")
    return count


@torch.no_grad()
def scored(weights: Path, files: Sequence[Path], shape: tuple[int, int], device: str) -> list[float]:
    """The columns: mean relative error of the depths, and shares within bounds, means over samples."""
    network, rows = load_sweep(weights, device), []
    for path in files:
        sample = load(path, 7, shape)
        if sample is None:
            continue
        views, priors, depth = (part.to(device) for part in sample)
        found = network.decode(network.encode(views, priors)).depth
        error = (found / depth - 1).abs()[depth > 0]
        rows.append([float(x) for x in (error.mean(), *((error < b).float().mean() for b in (0.02, 0.05)))])
    return np.mean(rows, 0).tolist()


def table(rows: dict[str, Path], files: Sequence[Path], shape: tuple[int, int], device: str) -> str:
    """Errors of files of weights, by what they are called."""
    lines = [f"| weights | {' | '.join(COLUMNS)} |", "|---" * (1 + len(COLUMNS)) + "|"]
    for name, weights in rows.items():
        cells = " | ".join(f"{x:.4f}" for x in scored(weights, files, shape, device))
        lines.append(f"| {name} | {cells} |")
    return "\n".join(lines) + "\n"


def train(data: Path, run: Path, args: argparse.Namespace) -> None:
    """Train by the clock, in processes of their own.

    They are told nothing of what views agree on: for that a CPU takes seconds a sample, and the GPU waits.
    """
    sizes = args.work / "sizes.json"
    sizes.write_text(json.dumps(SIZES[args.sizes]))
    subprocess.run(
        [
            sys.executable, "-m", "training.train", "--data", str(data), "--out", str(run),
            "--minutes", str(args.minutes), "--sizes", str(sizes), "--workers", str(args.workers),
            "--device", args.device, "--rate", str(args.rate), "--init", str(args.init), "--told", "0",
        ],
        check=True,
    )  # fmt: skip


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, default=Path("runs/gpu"), help="keeps the samples")
    parser.add_argument("--out", type=Path, default=Path(os.environ.get("OUT", "runs/gpu/out")))
    parser.add_argument("--render-minutes", type=float, default=3.0)
    parser.add_argument("--minutes", type=float, default=6.0, help="of training; 0: render alone")
    parser.add_argument("--workers", type=int, default=6, help="processes that share the GPU")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--sizes", choices=tuple(SIZES), default="large")
    parser.add_argument("--shape", type=int, nargs=2, default=(288, 384))
    parser.add_argument("--rate", type=float, default=8e-4)
    parser.add_argument("--init", type=Path, default=EMBEDDED)
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    """Render, train, write, measure.

    Raises:
        SystemExit: there are too few samples to hold some out and train on others, or too little time.
    """
    args = parsed(arguments)
    data, held_out = args.work / "data", TrainConfig.held_out
    if args.render_minutes > 0:
        render(data, args.render_minutes, tuple(args.shape))
    files = sorted(data.glob("*.npz"))
    if len(files) <= held_out:
        raise SystemExit(
            f"{data}: {len(files)} samples, and {held_out} are held out; give --render-minutes more: loops "
            "are compiled first, which takes a minute on an idle machine"
        )
    if args.minutes <= 0:
        return
    run = args.work / f"run-{time.time_ns()}"
    train(data, run, args)
    if not (run / "weights.safetensors").exists():
        raise SystemExit(f"{run}: no step was finished in {args.minutes:g} minutes; give --minutes more")
    args.out.mkdir(parents=True, exist_ok=True)
    for name in ("weights.safetensors", "log.csv"):
        (args.out / name).write_bytes((run / name).read_bytes())
    both = {"before": args.init, "after": args.out / "weights.safetensors"}
    text = table(both, files[:held_out], tuple(SIZES[args.sizes][-1][1:]), args.device)
    (args.out / "table.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
