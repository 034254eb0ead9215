"""Which module may import which: the table of the project's layers."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

FORBIDDEN = {
    "tco": {"colmap_tco", "pycolmap", "open3d", "training", "benchmarks", "tests"},
    "colmap_tco": {"training", "benchmarks", "tests"},
}
"""Package → what it never imports, not even inside a function."""

ONLY_IN = {"pycolmap": {"colmap_tco/_pycolmap.py"}}
"""Module → the only files of the packages that import it."""

LAZY = {"torch", "pycolmap", "open3d", "numba", "cv2", "scipy", "kornia"}
START_UP = (
    "workspace",
    "mapping",
    "views",
    "pinhole",
    "priors",
    "tracks",
    "chunks",
    "_pycolmap",
    "model_files",
    "errors",
    "weights",
    "published",
    "backbones",
    "memory",
    "attempts",
    "check",
    "commands",
    "export/command",
    "export/dense",
    "mesh",
    "bench/command",
    "bench/rows",
    "bench/noise",
    "bench/schedules",
    "poses",
    "rough",
    "depth_views",
    "pose_network",
    "pose_outputs",
    "show",
    "viewer",
    "evaluation/command",
    "evaluation/sections",
    "evaluation/sources",
    "evaluation/maps",
    "evaluation/align",
    "evaluation/points",
    "evaluation/eth3d",
    "evaluation/trajectory",
)
"""Modules of ``colmap_tco`` that the command line imports for their settings: nothing in LAZY at the top."""


def sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imported(tree: ast.AST) -> Iterator[str]:
    """Top-level names of all modules that a tree imports, at any depth."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.split(".")[0]


def at_the_top(tree: ast.Module) -> ast.Module:
    """The statements that run on import: no functions, no ``if TYPE_CHECKING``."""
    checks = [n for n in tree.body if not (isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING")]
    return ast.Module([n for n in checks if not isinstance(n, ast.FunctionDef | ast.ClassDef)], [])


def test_the_table_sees_what_it_forbids() -> None:
    tree = ast.parse("import a.b\nif TYPE_CHECKING:\n    import c\ndef f():\n    from d.e import g\n")
    assert set(imported(tree)) == {"a", "c", "d"}
    assert set(imported(at_the_top(tree))) == {"a"}


@pytest.mark.parametrize("package", FORBIDDEN)
def test_layers(package: str) -> None:
    assert sources(package)
    for path in sources(package):
        wrong = set(imported(ast.parse(path.read_text(encoding="utf-8")))) & FORBIDDEN[package]
        assert not wrong, f"{path.relative_to(ROOT)} imports {wrong}"


@pytest.mark.parametrize("module", ONLY_IN)
def test_one_adapter(module: str) -> None:
    users = {
        path.relative_to(ROOT).as_posix()
        for package in FORBIDDEN
        for path in sources(package)
        if module in imported(ast.parse(path.read_text(encoding="utf-8")))
    }
    assert users == ONLY_IN[module]


@pytest.mark.parametrize("name", START_UP)
def test_heavy_imports_are_inside_functions(name: str) -> None:
    tree = ast.parse((ROOT / "colmap_tco" / f"{name}.py").read_text(encoding="utf-8"))
    assert not set(imported(at_the_top(tree))) & LAZY
