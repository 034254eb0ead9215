"""How alike two runs of ``densify`` are: the same again, with other instructions, and with another seed.

    python -m benchmarks.alike [--output docs/alike.md]

Each line compares depths with those of the first run of a set: how far apart they are where both have one,
and what it makes of the scores. On one machine the same command gives the same result. Another processor
multiplies in another order, so that last bits differ; oneDNN can be held to older instructions
(``ONEDNN_MAX_CPU_ISA``), which shows what comes of that.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.quality import copied, run, scored
from benchmarks.sets import SETS, known, workspace
from benchmarks.tables import paragraph, publish, to_file, weights_told
from colmap_tco.maps import read_map
from colmap_tco.published import NETWORKS
from colmap_tco.weights import located

APART = 0.02
"""Relative difference from which on two depths are told apart."""
OTHERS = (
    ("the same again", {}, ()),
    ("AVX2", {"ONEDNN_MAX_CPU_ISA": "AVX2"}, ()),
    ("AVX-512 without AMX", {"ONEDNN_MAX_CPU_ISA": "AVX512_CORE_BF16"}, ()),
    ("another seed", {}, ("--seed", "1")),
)
"""What the runs are that are compared with the first: name, environment, options."""
LEGEND = (
    "med: median relative difference of depths from the first run's. apart: share of the pixels that have a "
    "depth in both which are more than 2 % apart. d2, d5, f5: scores as in `docs/quality.md`. "
    "On a processor without AMX or AVX-512 the rows that leave these out are the first run again."
)


def depths(root: Path) -> NDArray[np.float32]:
    """All depths of a result, view after view by name, 0 where there is none."""
    files = sorted((root / "stereo" / "depth_maps").glob("*.geometric.bin"))
    return np.concatenate([read_map(file).ravel() for file in files])


def difference(first: NDArray[np.float32], other: NDArray[np.float32]) -> tuple[float, float]:
    """Median relative difference of depths (N,) that are positive in both, and the share above ``APART``.

    Raises:
        ValueError: no pixel has a depth in both, or they are not as many.
    """
    if first.shape != other.shape:
        raise ValueError(f"{first.size} and {other.size} pixels cannot be compared")
    both = (first > 0) & (other > 0)
    if not both.any():
        raise ValueError("no pixel has a depth in both results")
    off = np.abs(other[both] / first[both] - 1)
    return float(np.median(off)), float((off > APART).mean())


def made(name: str, work: Path, environment: Mapping[str, str], options: tuple[str, ...]) -> Path:
    """The result of a run with more in its environment."""
    copy = copied(name, work)
    words = [sys.executable, "-m", "colmap_tco", "densify", str(copy), "--overwrite", *options]
    run(["env", *(f"{key}={value}" for key, value in environment.items()), *words])
    return copy / "dense-tco"


def row(name: str, what: str, root: Path, first: NDArray[np.float32], work: Path) -> str:
    """A line of the table."""
    median, apart = difference(first, depths(root))
    figures = scored(workspace(name, work.parent), "--dense", str(root))[0]
    scores = " | ".join(f"{figures[key]:.3f}" for key in ("d2", "d5", "f5"))
    return f"| {name} | {what} | {100 * median:.3f} % | {100 * apart:.2f} % | {scores} |\n"


def parser() -> argparse.ArgumentParser:
    """Command line; what it does not know is handed to densify."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0], allow_abbrev=False)
    parser.add_argument("--sets", nargs="+", default=list(SETS), type=known)
    parser.add_argument("--work", type=Path, default=Path("runs/alike"))
    to_file(parser)
    return parser


def main() -> None:
    """Measure and publish, row by row."""
    args, rest = parser().parse_known_args()
    if "ONEDNN_MAX_CPU_ISA" in os.environ:
        sys.exit("ONEDNN_MAX_CPU_ISA is set, so that the first run would not be the usual one: unset it")
    args.work.mkdir(parents=True, exist_ok=True)
    told = " ".join(["--sets", *args.sets, *rest])
    about = f"`python -m benchmarks.alike {told}`: {weights_told(located(NETWORKS['sweep']))}. {LEGEND}"
    text = f"# How alike runs are, measured\n\n{paragraph(about)}\n"
    text += "| set | run | med | apart | d2 | d5 | f5 |\n" + "|---" * 7 + "|\n"
    for name in args.sets:
        root = made(name, args.work, {}, tuple(rest))
        first = depths(root)
        text += row(name, "first", root, first, args.work)
        for what, environment, options in OTHERS:
            root = made(name, args.work, environment, (*rest, *options))
            text += row(name, what, root, first, args.work)
            publish(text, args.output, args.part)


if __name__ == "__main__":
    main()
