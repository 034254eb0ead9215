"""What the pages in ``docs/`` quote of the program is what the program has."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from colmap_tco.commands import COMMANDS
from colmap_tco.options_page import options_page

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
VARIES = "…"


def texts(source: str) -> Iterator[str]:
    """The text constants of a module; what is filled in, by braces or by %, is ``…``."""
    tree = ast.parse(source)
    pieces = {
        id(value) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for value in node.values
    }
    pieces |= {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}  # docstrings
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(v.value if isinstance(v, ast.Constant) else VARIES for v in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in pieces:
            yield re.sub(r"%[\d.]*[sdfg]", VARIES, node.value)


@cache
def said() -> tuple[str, ...]:
    """Everything that the packages can say."""
    files = [path for package in ("tco", "colmap_tco") for path in (ROOT / package).rglob("*.py")]
    return tuple(text for path in files for text in texts(path.read_text(encoding="utf-8")))


def occurs(message: str, among: tuple[str, ...]) -> bool:
    """Whether one of the texts has the fixed parts of a message, in their order."""
    pattern = re.compile(".*".join(map(re.escape, message.strip(VARIES).split(VARIES))), re.DOTALL)
    return any(pattern.search(text) for text in among)


def quoted() -> list[str]:
    """The messages that the table of troubles quotes: rows whose first cell begins with one."""
    rows = re.findall(r"^\| (`.*?) \| .* \|$", (DOCS / "troubleshooting.md").read_text("utf-8"), re.MULTILINE)
    return [message for row in rows for message in re.findall(r"`([^`]+)`", row)]


@pytest.mark.parametrize("message", quoted())
def test_every_message_that_is_explained_exists(message: str) -> None:
    assert occurs(message, said())


def test_messages_that_do_not_exist_are_seen() -> None:
    assert len(quoted()) > 50
    source = '"two words"\nraise E(f"{n} of {m} views " "do not fit")\nlog.warning("two %d in %.1f parts", 2)'
    among = tuple(texts(source))
    for there in ("… of … views do not fit", "views do", "two … in … parts"):
        assert occurs(there, among)
    for missing in ("two words", "no point is left", "do not fit … views", "views … parts", "of 3 views"):
        assert not occurs(missing, among)


def test_the_page_of_options_is_that_of_the_program() -> None:
    page = (DOCS / "options.md").read_text("utf-8")
    assert page == options_page(), "python -m colmap_tco.options_page > docs/options.md makes it anew"


def test_the_page_of_options_has_all_commands_and_takes_no_torch() -> None:
    code = (
        "import sys\nfrom colmap_tco.options_page import options_page\noptions_page()\n"
        "print(*{'torch', 'pycolmap'} & {*sys.modules})"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert found.strip() == ""
    sections = re.findall(r"^## `colmap-tco (\w+)", options_page(), re.MULTILINE)
    assert sections == list(COMMANDS)


def test_links_between_pages_lead_somewhere() -> None:
    pages = [ROOT / "README.md", *DOCS.glob("*.md")]
    named = {
        (page.name, name)
        for page in pages
        for name in re.findall(r"[`(](docs/\w+\.\w+)[`)]", page.read_text("utf-8"))
    }
    missing = sorted(f"{page}: {name}" for page, name in named if not (ROOT / name).is_file())
    assert not missing
