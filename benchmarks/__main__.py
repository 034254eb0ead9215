"""Every table of ``docs/`` that the claim rests on, one after the other, each by its script in a process.

    python -m benchmarks [--only claim noise] [--output docs] [--force]

A table that was made by this code with these weights is not made again, so that a run that was stopped goes
on; ``runs/tables/`` holds what was made of what. What fails is named, the others go on, and the command ends
with 1. Hours on two cores; the real sets are needed beside the checkout.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.rendered import SCENES
from benchmarks.tables import FIRST, marks
from benchmarks.unseen import UNTUNED
from colmap_tco.published import NETWORKS
from colmap_tco.resume import fingerprint
from colmap_tco.weights import located

ROOT = Path(__file__).resolve().parents[1]
MADE = Path("runs/tables")
"""Where it is kept of what each table was made."""


@dataclass(frozen=True)
class Table:
    """A table, and what makes it.

    Attributes:
        name: as ``--only`` spells it.
        script: module of this package.
        file: that it is in, in the folder of the tables.
        arguments: of the script.
        part: of the file.
    """

    name: str
    script: str
    file: str
    arguments: tuple[str, ...] = ()
    part: str = FIRST

    def words(self, folder: Path) -> list[str]:
        """What the script is called with."""
        return [*self.arguments, "--output", str(folder / self.file), "--part", self.part]


_ALL = ("--sets", "kitchen", "office", "livingroom", *SCENES)
_RENDERED = ("--sets", *SCENES)
_TWO, _THREE = ("--seeds", "2"), ("--seeds", "3")

TABLES = (
    Table("quality", "quality", "quality.md", (*_ALL, "--baselines", "interp", "patchmatch")),
    Table("quality-again", "quality", "quality.md", ("--baselines", "patchmatch"), "the real sets again"),
    Table("quality-float32", "quality", "quality.md",
          (*_ALL, "--baselines", "patchmatch", "--precision", "float32"), "products in float32"),
    Table("quality-270", "quality", "quality.md",
          ("--sets", "office", "--baselines", "patchmatch", "--precision", "float32",
           "--max_image_size", "270"), "office with as many pixels as PatchMatch"),
    Table("marks", "marks", "marks.md"),
    Table("quality-384", "quality", "quality.md",
          ("--baselines", "--steps", "2", "--max_image_size", "384"), "384 pixels"),
    Table("quality-256", "quality", "quality.md",
          ("--baselines", "--steps", "0", "2", "--max_image_size", "256"), "256 pixels"),
    Table("quality-640", "quality", "quality.md",
          ("--baselines", "--steps", "0", "2", "--max_image_size", "640"), "640 pixels"),
    Table("quality-untuned", "quality", "quality.md",
          ("--sets", *UNTUNED, "--baselines", "interp", "patchmatch"), "scenes not tuned on"),
    Table("quality-colour", "quality", "quality.md",
          ("--sets", *UNTUNED, "--baselines", "--steps", "2", "--plane_colour", "0"),
          "colours of kept depths aside"),
    Table("quality-number", "quality", "quality.md",
          (*_ALL, *UNTUNED, "--baselines", "--steps", "2", "--overlap_by", "number"), "sources by number"),
    Table("stretches", "unseen", "quality.md", (), "stretches"),
    Table("quality-steps", "quality", "quality.md",
          ("--baselines", "--steps", "1", "5", "10", "20", "40"), "more steps"),
    Table("quality-seed", "quality", "quality.md",
          ("--baselines", "--steps", "2", "--seed", "1"), "another seed"),
    Table("alike", "alike", "alike.md"),
    Table("claim", "claim", "claim.md", _THREE),
    Table("claim-hills", "claim", "claim.md", (*_TWO, "--sets", "hills", "knots"), "hills and knots"),
    Table("claim-walk", "claim", "claim.md", (*_TWO, "--sets", "walk", "temple"), "walk and temple"),
    Table("ablations", "ablations", "ablations.md", (*_THREE, "--steps", "12")),
    Table("ablations-rendered", "ablations", "ablations.md", (*_THREE, "--steps", "12", *_RENDERED),
          "rendered scenes"),
    Table("ablations-default", "ablations", "ablations.md",
          ("--size", "320", "--views", "0", "--steps", "2", "--only", "densify does,the same"), "full size"),
    Table("noise", "noise", "noise.md", (*_THREE, "--steps", "12")),
    *(
        Table(f"noise-{steps}", "noise", "noise.md",
              (*_THREE, "--steps", steps, "--rows", "2"), f"{steps} steps")
        for steps in ("2", "5", "12")
    ),
    Table("noise-rendered", "noise", "noise.md", (*_THREE, "--steps", "12", "--sets", "hills", "walk"),
          "rendered scenes"),
    Table("noise-told", "noise", "noise.md",
          (*_THREE, "--steps", "12", "--rows", "2", "5", "8", "11", "--stated", "0.33", "3"), "told wrong"),
    Table("scaling", "scaling", "scaling.md", _THREE),
    Table("scaling-rendered", "scaling", "scaling.md", (*_THREE, *_RENDERED), "rendered scenes"),
    Table("tco_step", "tco_step", "tco_step.md", ("--threads", "1", "--cpu_time")),
    Table("consensus", "consensus", "consensus.md"),
    Table("planes", "planes", "planes.md"),
    Table("contest", "contest", "contest.md"),
    Table("hints", "hints", "hints.md",
          ("--sets", "kitchen", "office", "livingroom", "--random", "8", "--size", "256")),
    Table("calibration", "calibration", "calibration.md"),
    Table("poses", "poses", "poses.md", ("--exact",)),
    Table("render", "render", "render.md"),
    Table("fusion", "fusion", "fusion.md"),
    Table("exports", "exports", "exports.md"),
    Table("fill", "fill", "outputs.md", ("kitchen",)),
    Table("many", "many", "many.md", ("runs/many",)),
    Table("mutations", "mutations", "mutations.md"),
)  # fmt: skip


def source(table: Table) -> str:
    """A text that changes with what a table is made of: code, weights and arguments."""
    code = [path for part in ("tco", "colmap_tco", "benchmarks") for path in (ROOT / part).rglob("*.py")]
    settings = {"script": table.script, "arguments": table.arguments, "part": table.part}
    return fingerprint(settings, [located(NETWORKS["sweep"]), *code])


def is_made(table: Table, folder: Path) -> bool:
    """Whether the file has this table as it would be made now."""
    kept, file = MADE / table.name, folder / table.file
    known = kept.is_file() and file.is_file() and marks(table.part)[0] in file.read_text("utf-8")
    return known and kept.read_text("utf-8") == source(table)


def make(tables: Iterable[Table], folder: Path, force: bool = False) -> list[str]:
    """Make the tables that are not made yet; returns the names of those that failed."""
    failed = []
    for table in tables:
        if not force and is_made(table, folder):
            print(f"{table.name}: made already, --force makes it again", flush=True)
            continue
        print(f"{table.name}: {folder / table.file}, {table.part}", flush=True)
        command = [sys.executable, "-m", f"benchmarks.{table.script}", *table.words(folder)]
        code = subprocess.run(command, check=False).returncode
        if code:
            failed.append(table.name)
            print(f"{table.name}: failed with {code}", flush=True)
            continue
        MADE.mkdir(parents=True, exist_ok=True)
        (MADE / table.name).write_text(source(table), "utf-8")
    return failed


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    names = [table.name for table in TABLES]
    parser.add_argument(
        "--only", nargs="+", default=names, choices=names, metavar="NAME", help=", ".join(names)
    )
    parser.add_argument("--output", type=Path, default=Path("docs"), help="folder of the tables")
    parser.add_argument("--force", action="store_true", help="make tables again that are made already")
    return parser


def main(words: list[str] | None = None) -> int:
    """Make what is wanted; 1 if some of it failed."""
    args = parser().parse_args(words)
    failed = make([table for table in TABLES if table.name in args.only], args.output, args.force)
    if failed:
        print(f"without {', '.join(failed)}: what went wrong is told above", file=sys.stderr)
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
