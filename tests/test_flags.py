"""Flags and configurations are two spellings of one thing: each determines the other."""

from __future__ import annotations

import argparse
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Optional

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_tco import flags
from tco.config import knob


@dataclass(frozen=True)
class Inner:
    """Penalties. And a second sentence."""

    weight: float = knob(0.2, "weight of the term, 100 % at 1")
    kind: str = knob("l1", "norm", choices=("l1", "huber"))
    parts: tuple[str, ...] = knob(("qkv", "proj"), "layers", choices=("qkv", "proj", "fc1"))


@dataclass(frozen=True)
class Middle:
    inner: Inner = Inner(weight=1.5)
    sizes: tuple[int, ...] = knob((), "sizes in pixels")
    limit: Optional[float] = knob(None, "largest value")  # noqa: UP045


@dataclass(frozen=True)
class Outer:
    """The whole."""

    steps: int = knob(40, "steps")
    overwrite: bool = knob(False, "replace results")
    resume: bool = knob(True, "continue")
    mask_path: Path | None = knob(None, "masks")
    middle: Middle = Middle()
    name: str = knob("a b", "a name")


def parse(config_type: type, words: list[str]) -> Any:
    parser = argparse.ArgumentParser(exit_on_error=False)
    flags.add_flags(parser, config_type)
    return flags.build(config_type, parser.parse_args(flags.normalise(words)))


def spell(config_type: type, values: Any) -> list[str]:
    """The command line that sets every setting of ``values``, through its nested attributes."""
    flat: dict[str, Any] = {}
    stack = [values]
    while stack:
        for name, value in vars(stack.pop()).items():
            if hasattr(value, "__dataclass_fields__"):
                stack.append(value)
            else:
                flat[name] = value
    words = []
    for setting in flags.settings(config_type):
        value = flat[setting.name]
        if setting.base is bool:
            words.append(setting.flags[0 if value else 1])
        else:
            words.append(f"{setting.flags[0]}={setting.show(value)}")
    return words


TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=8)
OUTER = st.builds(
    Outer,
    steps=st.integers(),
    overwrite=st.booleans(),
    resume=st.booleans(),
    mask_path=st.none() | st.sampled_from([Path("masks"), Path("a b/c=d"), Path("--x"), Path("ä")]),
    name=TEXT,
    middle=st.builds(
        Middle,
        inner=st.builds(
            Inner,
            weight=st.floats(allow_nan=False),
            kind=st.sampled_from(("l1", "huber")),
            parts=st.lists(st.sampled_from(("qkv", "proj", "fc1"))).map(tuple),
        ),
        sizes=st.lists(st.integers()).map(tuple),
        limit=st.none() | st.floats(allow_nan=False),
    ),
)


@given(OUTER)
@settings(max_examples=60, deadline=None)
def test_every_configuration_survives_the_command_line(config: Outer) -> None:
    assert parse(Outer, spell(Outer, config)) == config


def test_no_flag_gives_the_defaults_of_the_outermost_class() -> None:
    assert parse(Outer, []) == Outer()
    assert parse(Outer, []).middle.inner.weight == 1.5


@pytest.mark.parametrize("flag", ["--mask_path", "--mask-path"])
def test_both_spellings_name_the_same_flag(flag: str) -> None:
    assert parse(Outer, [flag, "a-b/c-d"]).mask_path == Path("a-b/c-d")
    assert parse(Outer, [f"{flag}=a-b"]).mask_path == Path("a-b")


@pytest.mark.parametrize(
    ("words", "expected"),
    [(["--overwrite"], True), (["--no-overwrite"], False), (["--overwrite", "--no_overwrite"], False)],
)
def test_the_last_switch_wins(words: list[str], expected: bool) -> None:
    assert parse(Outer, words).overwrite is expected


def test_a_bare_double_dash_ends_the_flags() -> None:
    assert flags.normalise(["--a-b=c-d", "x-y", "--", "--a-b"]) == ["--a_b=c-d", "x-y", "--", "--a-b"]


def test_a_setting_can_have_a_short_flag() -> None:
    @dataclass(frozen=True)
    class Short:
        output_path: Optional[Path] = knob(None, "where to", alias="-o")  # noqa: UP045

    for words in (["-o", "x-y"], ["--output-path", "x-y"], ["--output_path=x-y"]):
        assert parse(Short, words).output_path == Path("x-y")
    assert parse(Short, []).output_path is None


def test_negative_numbers_are_values() -> None:
    assert parse(Outer, ["--steps", "-1"]).steps == -1


def test_infinity_is_a_number_and_nan_is_not() -> None:
    assert parse(Outer, ["--limit", "inf"]).middle.limit == math.inf
    with pytest.raises(argparse.ArgumentError, match="nan"):
        parse(Outer, ["--limit", "nan"])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--steps", "4.5"], "'4.5' is not a whole number"),
        (["--weight", "much"], "'much' is not a number"),
        (["--kind", "l2"], "'l2' is not one of l1, huber"),
        (["--parts", "qkv,head"], "'head' is not one of"),
        (["--steps", "none"], "'none' is not a whole number"),
    ],
)
def test_a_wrong_value_is_told(words: list[str], told: str) -> None:
    with pytest.raises(argparse.ArgumentError, match=told):
        parse(Outer, words)


def test_help_shows_what_each_setting_does_and_its_default() -> None:
    parser = argparse.ArgumentParser(formatter_class=lambda prog: argparse.HelpFormatter(prog, width=200))
    flags.add_flags(parser, Outer)
    text = parser.format_help()
    assert re.search(r"--weight X +weight of the term, 100 % at 1 \(default: 1\.5\)\n", text)
    assert "--resume, --no_resume" in text
    assert "continue (default: on)" in text
    assert "masks (default: none)" in text
    assert "sizes in pixels (default: empty)" in text
    assert "{qkv,proj,fc1},…" in text
    for title in ("The whole:", "Penalties. And a second sentence:", "Middle:"):
        assert f"\n{title}\n" in text


def test_a_name_used_twice_is_an_error() -> None:
    @dataclass(frozen=True)
    class Clash:
        weight: float = knob(1.0, "another weight")
        inner: Inner = Inner()

    with pytest.raises(ValueError, match="Inner and Clash both declare 'weight'"):
        # names of local classes cannot be resolved from text
        Clash.__annotations__.update(weight=float, inner=Inner)
        flags.settings(Clash)


def declare(annotation: Any, made: Any, name: str = "value") -> type:
    """A frozen dataclass of one field."""
    body = {"__annotations__": {name: annotation}, name: made}
    return dataclass(frozen=True)(type("Declared", (), body))


@pytest.mark.parametrize(
    ("annotation", "made", "error", "told"),
    [
        (int, 3, TypeError, "no help"),
        (dict, knob(None, "x"), TypeError, "no flag can express"),
        (int | str, knob(3, "x"), TypeError, "no flag can express"),
        (tuple[int, int], knob((1, 2), "x"), TypeError, "no flag can express"),
        (int, field(metadata={"help": "x"}), TypeError, "missing"),
        (int, knob(2.5, "x"), ValueError, "not of its type"),
        (int, knob(True, "x"), ValueError, "not of its type"),
        (str, knob(None, "x"), ValueError, "not of its type"),
        (str, knob("c", "x", choices=("a", "b")), ValueError, "not one of"),
        (tuple[str, ...], knob(("a", "c"), "x", choices=("a", "b")), ValueError, "not one of"),
    ],
)
def test_a_wrong_declaration_is_told(annotation: Any, made: Any, error: type[Exception], told: str) -> None:
    with pytest.raises(error, match=told):
        flags.settings(declare(annotation, made))


def test_a_setting_may_not_be_the_negation_of_a_switch() -> None:
    body = {
        "__annotations__": {"color": bool, "no_color": int},
        "color": knob(True, "x"),
        "no_color": knob(1, "x"),
    }
    with pytest.raises(ValueError, match="negation"):
        flags.settings(dataclass(frozen=True)(type("Declared", (), body)))


@pytest.mark.parametrize(
    ("mistyped", "meant"),
    [("--stepz", "--steps"), ("--max_imagesize", "--max_image_size"), ("--zzz", None)],
)
def test_the_closest_flag(mistyped: str, meant: str | None) -> None:
    assert flags.closest(mistyped, ["--steps", "--max_image_size", "--seed"]) == meant


def test_lists_that_begin_with_a_negative_number_are_values() -> None:
    for words in (["--roi-box", "-1,2,-3.5e2"], ["--roi-box=-1,2,-3.5e2"]):
        assert flags.normalise(words) == ["--roi_box=-1,2,-3.5e2"]
    assert flags.normalise(["--a", "-1", "-x,y", "--b=1", "-2,3"]) == ["--a", "-1", "-x,y", "--b=1", "-2,3"]
