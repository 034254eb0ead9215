"""Change a sign, a factor or half a pixel, and see which test notices.

    python -m benchmarks.mutations [--only surfels,kernels] [--output docs/mutations.md]

Each mutation is a textual change of one place, applied to a copy of the tree, on which the test files of that
module are run until the first failure. A mutation that no test notices is a gap in the tests, and the command
then ends with status 1. Where ``../shared/parity`` is, the tests that compare with the authors' numbers are
run by themselves, too: the last column tells which of them notices.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import shutil
import sys
import tempfile
import time
from multiprocessing import get_context
from pathlib import Path

from benchmarks.mutated import MUTATIONS, Mutation
from benchmarks.tables import publish, to_file

ROOT = Path(__file__).resolve().parents[1]


NO_TESTS = 5
"""Status of pytest where a selection holds no test."""


def copy_tree(work: Path) -> None:
    """What the tests need, in a folder beside a link to the published numbers."""
    for name in ("tco", "colmap_tco", "tests", "training", "benchmarks"):
        shutil.copytree(ROOT / name, work / "tree" / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", work / "tree")
    shared = ROOT.parent / "shared"
    if shared.is_dir():
        os.symlink(shared, work / "shared")


def first_failure(tree: Path, mutation: Mutation, only: str = "") -> str | None:
    """Name of the first test that fails, None if all pass; of those alone that ``only`` selects (``-k``).

    The tests run in a fork of this process, which has loaded what takes long to load.

    Raises:
        SystemExit: the tests could not be run at all.
    """
    log = tree / "log.txt"
    process = get_context("fork").Process(target=_run_tests, args=(tree, mutation, log, only))
    process.start()
    process.join()
    if process.exitcode == 0 or (only and process.exitcode == NO_TESTS):
        return None
    text = log.read_text(encoding="utf-8")
    found = re.search(r"^(?:FAILED|ERROR) \S*?(test_\w+\.py\S*)", text, re.MULTILINE)
    if process.exitcode != 1 or not found:
        sys.exit(f"the tests could not be run:\n{text[-2000:]}")
    return found[1]


def _run_tests(tree: Path, mutation: Mutation, log: Path, only: str) -> None:
    """In the fork: run the tests of a mutation in the copy, and end with pytest's status."""
    import pytest

    # Compiled code is found by the date of its file, which a change within a second may not alter.
    cache = tree / (f"cache-{time.monotonic_ns()}" if "kernels" in mutation.file else "cache")
    os.environ["NUMBA_CACHE_DIR"] = str(cache)
    sys.dont_write_bytecode = True
    os.chdir(tree)
    sys.path[:] = [str(tree), *(entry for entry in sys.path if entry not in ("", str(ROOT)))]
    for name in [name for name in sys.modules if name.split(".")[0] == "benchmarks"]:
        del sys.modules[name]
    with log.open("w", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        status = pytest.main(
            ["-q", "-x", "-rfE", "--no-header", "-p", "no:cacheprovider", "-k", only, *mutation.tests]
        )
        sys.stdout.flush()
    os._exit(int(status))


def code(text: str) -> str:
    """Text as code in a cell of a Markdown table."""
    line = " ".join(text.split()).replace("|", "\\|")
    return f"`{line}`"


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="", help="parts of file names, separated by commas")
    to_file(parser)
    return parser


def main() -> None:
    """Command line."""
    args = parser().parse_args()
    wanted = [word for word in args.only.split(",") if word]
    chosen = [m for m in MUTATIONS if not wanted or any(word in m.file for word in wanted)]
    # Loaded once, for all forks: a single thread, which a fork can take along.
    importlib.import_module("torch").set_num_threads(1)
    rows, missed, by_numbers = [], 0, 0
    with tempfile.TemporaryDirectory() as folder:
        copy_tree(Path(folder))
        tree = Path(folder) / "tree"
        for mutation in chosen:
            path = tree / mutation.file
            original = path.read_text(encoding="utf-8")
            if mutation.old not in original:
                sys.exit(f"{mutation.file} does not hold {mutation.old!r} any more: adapt the list")
            path.write_text(original.replace(mutation.old, mutation.new, 1), encoding="utf-8")
            caught, parity = first_failure(tree, mutation), first_failure(tree, mutation, "parity")
            path.write_text(original, encoding="utf-8")
            missed += caught is None
            by_numbers += parity is not None
            change = f"{code(mutation.old)} | {code(mutation.new)}"
            rows.append(f"| {mutation.file} | {change} | {caught or '**not noticed**'} | {parity or ''} |")
            sys.stderr.write(rows[-1] + "\n")
    text = (
        f"# Mutations\n\n`python -m benchmarks.mutations`: {len(chosen) - missed} of {len(chosen)} changes "
        "are noticed; the first test that fails is named. The tests against the authors' numbers alone (the "
        f"last column) notice {by_numbers}; they do not reach what the published code does not have.\n\n"
        "| file | from | to | noticed by | by the authors' numbers |\n|---|---|---|---|---|\n"
    )
    text += "\n".join(rows) + "\n"
    publish(text, args.output, args.part)
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
