"""Train the embedded network further where a GPU is at hand for some minutes.

Renders on all processor cores until there are enough samples, then trains from the weights in the
package by the clock. Run it again to go on: samples stay in ``--work``, and ``--init`` takes the weights
of the run before.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.gpu.rendering import rendering

EMBEDDED = Path(__file__).resolve().parents[2] / "tco" / "backbones" / "data" / "sweep.safetensors"
SIZES = {
    "large": [[0.0, 144, 192], [0.25, 192, 256], [0.7, 288, 384]],
    "small": [[0.0, 48, 64]],
}


def render(folder: Path, minutes: float, shape: tuple[int, int]) -> int:
    """Render samples on all cores for some minutes; the number of samples there are."""
    have = len(list(folder.glob("*.npz")))
    with rendering(folder, shape, os.cpu_count() or 1):
        time.sleep(60 * minutes)
    count = len(list(folder.glob("*.npz")))
    sys.stdout.write(f"| samples rendered | {count - have} | in all | {count} |\n")
    return count


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, default=Path("runs/gpu"), help="keeps the samples")
    parser.add_argument("--out", type=Path, default=Path(os.environ.get("OUT", "runs/gpu/out")))
    parser.add_argument("--render-minutes", type=float, default=3.0)
    parser.add_argument("--minutes", type=float, default=6.0)
    parser.add_argument("--workers", type=int, default=6, help="processes that share the GPU")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--sizes", choices=tuple(SIZES), default="large")
    parser.add_argument("--shape", type=int, nargs=2, default=(288, 384))
    parser.add_argument("--rate", type=float, default=8e-4)
    parser.add_argument("--init", type=Path, default=EMBEDDED)
    args = parser.parse_args()
    data = args.work / "data"
    if args.render_minutes > 0:
        count = render(data, args.render_minutes, tuple(args.shape))
        if not count:
            sys.exit(
                f"no sample was finished in {args.render_minutes} minutes: loops are compiled first, which "
                "takes one on an idle machine; give --render-minutes more"
            )
    if args.minutes <= 0:
        return
    args.out.mkdir(parents=True, exist_ok=True)
    sizes = args.work / "sizes.json"
    sizes.write_text(json.dumps(SIZES[args.sizes]))
    run = args.work / f"run-{int(time.time())}"
    subprocess.run(
        [
            sys.executable, "-m", "training.train", "--data", str(data), "--out", str(run),
            "--minutes", str(args.minutes), "--sizes", str(sizes), "--workers", str(args.workers),
            "--device", args.device, "--rate", str(args.rate), "--init", str(args.init),
        ],
        check=True,
    )  # fmt: skip
    for name in ("weights.safetensors", "log.csv"):
        (args.out / name).write_bytes((run / name).read_bytes())


if __name__ == "__main__":
    main()
