"""The house rules, checked on every source file, and the checker itself checked on what breaks them."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(path for package in ("tco", "colmap_tco") for path in (ROOT / package).rglob("*.py"))

FILE_LINES, FUNCTION_LINES, ARGUMENTS, COMPLEXITY = 400, 80, 8, 15
DOCUMENTED = 0.9

Function = ast.FunctionDef | ast.AsyncFunctionDef
BRANCHES = (
    ast.If,
    ast.For,
    ast.AsyncFor,
    ast.While,
    ast.ExceptHandler,
    ast.IfExp,
    ast.Assert,
    ast.match_case,
)


def complexity(function: Function) -> int:
    """1 + the number of places where the flow forks, those of inner functions and comprehensions included."""
    count = 1
    for node in ast.walk(function):
        if isinstance(node, BRANCHES):
            count += 1
        elif isinstance(node, ast.comprehension):
            count += 1 + len(node.ifs)
        elif isinstance(node, ast.BoolOp):
            count += len(node.values) - 1
    return count


def parameters(function: Function) -> list[ast.arg]:
    """All parameters but the object that a method belongs to."""
    a = function.args
    variadic = [arg for arg in (a.vararg, a.kwarg) if arg is not None]
    every = [*a.posonlyargs, *a.args, *a.kwonlyargs, *variadic]
    return [arg for arg in every if arg.arg not in ("self", "cls")]


def is_broad(handler: ast.ExceptHandler) -> bool:
    """Whether an except clause catches everything: nothing named, or a base class of all errors."""
    kinds = handler.type.elts if isinstance(handler.type, ast.Tuple) else [handler.type]
    return any(
        kind is None or (isinstance(kind, ast.Name) and kind.id in ("Exception", "BaseException"))
        for kind in kinds
    )


def violations(source: str, may_print: bool = False) -> Iterator[str]:
    """The rules that a module breaks, each with the line."""
    lines = len(source.splitlines())
    if lines > FILE_LINES:
        yield f"the file has {lines} lines, more than {FILE_LINES}"
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, Function):
            yield from function_violations(node)
        elif isinstance(node, ast.ExceptHandler) and is_broad(node):
            yield f"line {node.lineno}: except clause that catches every error"
        elif isinstance(node, ast.Call) and not may_print and getattr(node.func, "id", "") == "print":
            yield f"line {node.lineno}: print"


def function_violations(function: Function) -> Iterator[str]:
    """The rules that a function breaks."""
    where = f"line {function.lineno}: {function.name}"
    start = min([function.lineno, *(decorator.lineno for decorator in function.decorator_list)])
    lines = (function.end_lineno or start) - start + 1
    if lines > FUNCTION_LINES:
        yield f"{where} has {lines} lines, more than {FUNCTION_LINES}"
    if len(parameters(function)) > ARGUMENTS:
        yield f"{where} has {len(parameters(function))} arguments, more than {ARGUMENTS}"
    if complexity(function) > COMPLEXITY:
        yield f"{where} has complexity {complexity(function)}, more than {COMPLEXITY}"
    untyped = [arg.arg for arg in parameters(function) if arg.annotation is None]
    if untyped or (function.returns is None and function.name != "__init__"):
        yield f"{where} is not fully typed"


def public(source: str) -> Iterator[tuple[str, bool]]:
    """(name, whether it has a docstring) of the public functions, methods and classes of a module."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_"):
            yield node.name, ast.get_docstring(node) is not None


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_source_file_keeps_the_rules(path: Path) -> None:
    found = list(violations(path.read_text(), may_print=path == ROOT / "colmap_tco" / "cli.py"))
    assert not found, "\n".join(found)


def test_public_names_are_documented() -> None:
    names = [
        (f"{path.relative_to(ROOT)}: {name}", has)
        for path in SOURCES
        for name, has in public(path.read_text())
    ]
    missing = [name for name, has in names if not has]
    assert len(missing) <= (1 - DOCUMENTED) * len(names), "\n".join(missing)


def test_there_are_sources_to_check() -> None:
    assert {"tco", "colmap_tco"} == {path.relative_to(ROOT).parts[0] for path in SOURCES}


def long_function(lines: int) -> str:
    return "def f() -> None:\n" + "    pass\n" * (lines - 1)


def branching_function(branches: int) -> str:
    return "def f(x: int) -> None:\n" + "    if x:\n        pass\n" * branches


def looping_function(loops: int) -> str:
    return "def f(y: list[int]) -> list[int]:\n    return [0 " + "for x in y if x " * loops + "]"


def many_arguments(arguments: int) -> str:
    return ", ".join(f"a{i}: int" for i in range(arguments))


GOOD = {
    "longest function": long_function(FUNCTION_LINES),
    "most arguments": f"class A:\n    def f(self, {many_arguments(ARGUMENTS)}) -> None: ...",
    "most branches": branching_function(COMPLEXITY - 1),
    "most loops": looping_function((COMPLEXITY - 1) // 2),
    "longest file": "x = 1\n" * FILE_LINES,
    "named errors": "try:\n    pass\nexcept (OSError, ValueError):\n    pass",
    "a method named print": "printer.print(1)",
    "constructor without return type": "class A:\n    def __init__(self, a: int): ...",
}
BAD = {
    "81 lines, more than 80": long_function(FUNCTION_LINES + 1),
    "9 arguments, more than 8": f"def f({many_arguments(ARGUMENTS - 1)}, *b: int, **c: int) -> None: ...",
    "complexity 16, more than 15": branching_function(COMPLEXITY),
    "f has complexity 16": f"def f(x: int) -> bool:\n    return {' and '.join(['x'] * (COMPLEXITY + 1))}",
    "f has complexity 17": looping_function((COMPLEXITY + 1) // 2),
    "401 lines, more than 400": "x = 1\n" * (FILE_LINES + 1),
    "line 1: print": "print(1)",
    "line 3: except": "try:\n    pass\nexcept Exception:\n    pass",
    "catches every": "try:\n    pass\nexcept:\n    pass",
    "except clause": "try:\n    pass\nexcept (OSError, BaseException):\n    pass",
    "not fully typed": "def f(a) -> None: ...",
    "f is not fully typed": "def f(a: int): ...",
    "inner is not fully typed": "def f() -> None:\n    def inner(x): ...",
}


@pytest.mark.parametrize("source", GOOD.values(), ids=GOOD)
def test_the_checker_accepts_what_just_keeps_the_rules(source: str) -> None:
    assert list(violations(source)) == []


@pytest.mark.parametrize(("told", "source"), BAD.items(), ids=BAD)
def test_the_checker_sees_what_just_breaks_them(told: str, source: str) -> None:
    (found,) = violations(source)
    assert told in found


def test_the_checker_lets_the_command_line_print() -> None:
    assert list(violations("print(1)", may_print=True)) == []


def test_the_checker_counts_docstrings() -> None:
    source = 'class A:\n    "What it is."\n    def f(self): ...\n    def _g(self): ...'
    assert sorted(public(source)) == [("A", True), ("f", False)]
