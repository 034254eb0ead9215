"""Text of the tables in ``docs/``: means with intervals, which weights, and where in a file a table goes."""

from __future__ import annotations

import argparse
import math
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np

FIRST = "table"
"""Name of the part of a file that has its title."""


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean, and half the width of its 95 % interval by Student's t; not a number for a single value."""
    from scipy.stats import t

    n = len(values)
    if n < 2:
        return float(np.mean(values)), math.nan
    return float(np.mean(values)), float(t.ppf(0.975, n - 1) * np.std(values, ddof=1) / math.sqrt(n))


def cell(values: Sequence[float], digits: int) -> str:
    """Mean ± half of the interval; one value alone has no interval."""
    mean, half = interval(values)
    return f"{mean:.{digits}f}" + ("" if math.isnan(half) else f" ± {half:.{digits}f}")


def runs(seeds: int) -> str:
    """How many seeds figures are of, and what follows a ±."""
    if seeds == 1:
        return "one seed"
    return f"{seeds} seeds; a ± is half of the 95 % interval of the mean over them (Student's t)"


def weights_told(path: Path) -> str:
    """A file of weights and, where it says so, how many steps it was trained."""
    from safetensors import safe_open

    with safe_open(str(path), framework="np") as file:
        steps = (file.metadata() or {}).get("steps")
    return f"weights {path.name}" + (f" of step {steps}" if steps else "")


def paragraph(text: str) -> str:
    """A paragraph of Markdown, its lines as long as those of ``docs/``."""
    return textwrap.fill(text, 118, break_long_words=False, break_on_hyphens=False) + "\n"


def to_file(parser: argparse.ArgumentParser) -> None:
    """Options that say where a result goes."""
    parser.add_argument("--output", type=Path, default=None, help="Markdown file to write, else the terminal")
    parser.add_argument("--part", default=FIRST, help="which part of the file it is; the others are kept")


def marks(part: str) -> tuple[str, str]:
    """Lines before and after a part of a file that a script makes."""
    return f"<!-- {part}, made by benchmarks -->\n", f"<!-- end of {part} -->\n"


def publish(text: str, output: Path | None, part: str = FIRST) -> None:
    """Write a result into its part of a Markdown file, or show it.

    What stands around the marks of the part is written by hand and kept. A part that the file does not have
    yet comes to its end; a file without any marks is replaced. Titles of parts but the first are one level
    down and name the part.
    """
    if output is None:
        sys.stdout.write(text)
        return
    if part != FIRST and text.startswith("# "):
        title, _, rest = text.partition("\n")
        text = f"#{title}: {part}\n{rest}"
    begin, end = marks(part)
    made = begin + text + ("" if text.endswith("\n") else "\n") + end
    old = output.read_text("utf-8") if output.exists() else ""
    if begin in old and end in old:
        head, _, rest = old.partition(begin)
        made = head + made + rest.partition(end)[2]
    elif ", made by benchmarks -->" in old:
        made = f"{old.rstrip()}\n\n{made}"
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(made, encoding="utf-8")


def plot_beside(output: Path, part: str) -> Path:
    """The file of a part's plot."""
    return output.with_name(f"{output.stem}{'' if part == FIRST else '-' + part.replace(' ', '-')}.png")
