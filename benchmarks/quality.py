"""Densify the shared real sets and score them against their sensors, beside what else one could run.

``python -m benchmarks.quality --steps 0 2 --baselines interp patchmatch`` prints a Markdown table;
``--output docs/quality.md`` writes it, and ``--part`` says which of that file it is.
PatchMatch needs ``pip install --no-deps pyarchinit-photogrammetry-core``.
``--sets`` also takes the rendered scenes of ``benchmarks/rendered.py``, which are scored against their truth,
and stretches of real sequences on which nothing was chosen (``benchmarks/unseen.py``), such as ``icl-140``.
Workspaces are copied to ``--work`` first; the shared sets are only read.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from benchmarks.sets import SETS, SHARED, known, workspace
from benchmarks.tables import FIRST, paragraph, publish, to_file, weights_told
from colmap_tco.published import NETWORKS
from colmap_tco.weights import located
from tco.options import TCOConfig

COLUMNS = ("cover", "med", "d2", "d5", "f5", "acc", "comp", "points")
LEGEND = (
    f"Pictures of {NETWORKS['sweep'].image_size} pixels unless an option says otherwise. PatchMatch is a "
    "CPU implementation at half the resolution of the pictures (`score.py --baseline patchmatch "
    "--half`). Depth figures are of the maps as written, after the views were asked together "
    "(`docs/consensus.md` has them of each view alone), put on planes (`docs/planes.md` has them "
    "without) and contested (`docs/contest.md`); clouds are made of what each view found alone, and of "
    "the other in their gaps. cover: share of the measured pixels with a depth. med: median relative "
    "error. d2, d5: share of **all** measured pixels within 2 and 5 %; a hole counts as wrong. f5: F-score "
    "of the cloud at 5 cm; acc, comp: median distance of its points to the truth, and of the truth to it, "
    "in metres. s: seconds of the whole command, from starting Python to the page of the report."
)
"""What the table says of itself."""


class Done(NamedTuple):
    """A command that has ended: what it wrote, its exit code, seconds, peak resident gibibytes."""

    text: str
    code: int
    seconds: float
    peak: float


def measured(command: list[str]) -> Done:
    """Run a command to its end, whatever that is."""
    start = time.monotonic()
    with tempfile.TemporaryFile("w+") as written:
        process = subprocess.Popen(command, stdout=written, stderr=subprocess.STDOUT)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.monotonic() - start
        written.seek(0)
        return Done(written.read(), process.returncode, seconds, used.ru_maxrss / 2**20)


def run(command: list[str]) -> Done:
    """Run a command that must succeed, in whole or in part.

    Raises:
        SystemExit: it failed; what it wrote is shown.
    """
    done = measured(command)
    if done.code not in (0, 6):
        sys.exit(f"{' '.join(command)} failed with {done.code}:\n{done.text}")
    return done


def scored(root: Path, *words: str) -> tuple[dict[str, float], float]:
    """Figures of the shared scorer, and its peak memory."""
    done = run([sys.executable, str(SHARED / "tools" / "score.py"), str(root), *words])
    figures: dict[str, float] = json.loads(done.text.splitlines()[-1])
    return figures, done.peak


def row(name: str, what: str, figures: dict[str, float], seconds: float, peak: float, views: int) -> str:
    """A line of the table."""
    cells = [f"{figures[c]:.4g}" if figures.get(c) is not None else "" for c in COLUMNS]
    return (
        f"| {name} | {what} | "
        + " | ".join(cells)
        + f" | {seconds:.0f} | {seconds / views:.2f} | {peak:.2f} |"
    )


def copied(name: str, work: Path) -> Path:
    """A workspace with the model and the pictures of a shared set, in which a result may be written."""
    original, copy = workspace(name, work.parent), work / name
    if not copy.exists():
        shutil.copytree(original / "sparse", copy / "sparse")
        os.symlink((original / "images").resolve(), copy / "images")
    return copy


def densified(name: str, steps: int, work: Path, rest: list[str]) -> tuple[dict[str, float], float, float]:
    """Scores, seconds and peak memory of our result on one set."""
    copy = copied(name, work)
    command = [
        sys.executable,
        "-m",
        "colmap_tco",
        "densify",
        str(copy),
        "--steps",
        str(steps),
        "--overwrite",
        *rest,
    ]
    done = run(command)
    kept = work / f"{name}-{steps}"
    shutil.rmtree(kept, ignore_errors=True)
    shutil.copytree(copy / "dense-tco", kept)
    return scored(workspace(name, work.parent), "--dense", str(kept))[0], done.seconds, done.peak


def parser() -> argparse.ArgumentParser:
    """Command line; what it does not know is handed to densify."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0], allow_abbrev=False)
    parser.add_argument("--sets", nargs="+", default=list(SETS), type=known)
    parser.add_argument("--steps", nargs="+", type=int, default=[0, TCOConfig().steps])
    parser.add_argument("--baselines", nargs="*", default=["interp"], help="interp, patchmatch")
    parser.add_argument("--work", type=Path, default=Path("runs/quality"))
    to_file(parser)
    return parser


def main() -> None:
    """Measure and publish, row by row."""
    args, rest = parser().parse_known_args()
    args.work.mkdir(parents=True, exist_ok=True)
    head = (
        "| set | method | " + " | ".join(COLUMNS) + " | s | s / view | GiB |\n" + "|---" * (len(COLUMNS) + 5)
    )
    chosen = [] if args.sets == list(SETS) else ["--sets", *args.sets]
    beside = [] if args.baselines == ["interp"] else ["--baselines", *args.baselines]
    told = " ".join([*chosen, *beside, "--steps", *map(str, args.steps), *rest])
    made = f"`python -m benchmarks.quality {told}`: {weights_told(located(NETWORKS['sweep']))}."
    about = paragraph(f"{made} {LEGEND}" if args.part == FIRST else made)
    text = f"# Quality, measured\n\n{about}\n{head}|\n"
    publish(text if args.output else f"{head}|\n", args.output, args.part)

    def add(line: str) -> None:
        nonlocal text
        text += line + "\n"
        publish(text if args.output else line + "\n", args.output, args.part)
        sys.stdout.flush()

    for name in args.sets:
        views = len(list((workspace(name, args.work.parent) / "images").iterdir()))
        for baseline in args.baselines:
            half = ["--half"] if baseline == "patchmatch" else []
            figures, peak = scored(workspace(name, args.work.parent), "--baseline", baseline, *half)
            add(row(name, baseline, figures, figures["seconds"], peak, views))
        for steps in args.steps:
            figures, seconds, peak = densified(name, steps, args.work, rest)
            add(row(name, f"colmap-tco, {steps} steps", figures, seconds, peak, views))


if __name__ == "__main__":
    main()
