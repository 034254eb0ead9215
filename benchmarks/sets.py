"""What can be measured on, by name: the shared real sets, rendered scenes, stretches of public sequences."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks import rendered, unseen

SHARED = Path(__file__).resolve().parents[2] / "shared"
SETS = ("kitchen", "office", "livingroom")
RUNS = Path("runs")
"""Where workspaces are, or are made, that are not shared."""


def known(name: str) -> str:
    """The name of a set, if it is one.

    Raises:
        ArgumentTypeError: it is none.
    """
    if name in (*SETS, *rendered.SCENES) or unseen.is_stretch(name):
        return name
    stretches = (f"{sequence}-NUMBER" for sequence in unseen.SEQUENCES)
    raise argparse.ArgumentTypeError(f"{name} is none of {', '.join([*SETS, *rendered.SCENES, *stretches])}")


def workspace(name: str, runs: Path = RUNS) -> Path:
    """The workspace of a set with its truth: a shared one, or one that is made if it is not there.

    Raises:
        SystemExit: the shared sets are not beside this checkout, or a stretch cannot be made.
    """
    if name in rendered.SCENES:
        return rendered.made(name, runs / "rendered")
    if unseen.is_stretch(name):
        return unseen.made(name, runs / "unseen")
    root = SHARED / "data" / name
    if not root.is_dir():
        sys.exit(f"{root} is not there: this measurement needs the shared real sets")
    return root
