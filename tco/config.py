"""How settings are declared: frozen dataclasses whose fields carry their own help text."""

from __future__ import annotations

import math
from dataclasses import field
from typing import TypeVar

T = TypeVar("T")

POSITIVE = math.ulp(0.0)
"""The least number above 0, as a bound for :func:`check_range`."""


def knob(default: T, help: str, choices: tuple[str, ...] | None = None, alias: str = "") -> T:
    """A dataclass field with a default, a help text, the values that a text may take, and a short flag.

    The command line is generated from these; ``help`` says what the setting does, in which unit,
    and when to change it.
    """
    return field(default=default, metadata={"help": help, "choices": choices, "alias": alias})


def check_range(config: object, names: str, least: float, most: float = math.inf) -> None:
    """Check settings when a configuration is made, so that a command line is refused at once.

    Args:
        config: the dataclass.
        names: of its fields, numbers or tuples of numbers, with blanks between them.
        least, most: the range, both ends included.

    Raises:
        ValueError: one is outside; the message names it.
    """
    bound = "must be positive" if least == POSITIVE else f"must be at least {least:g}"
    if most < math.inf:
        bound += f" and at most {most:g}"
    for name in names.split():
        value = getattr(config, name)
        if not all(least <= one <= most for one in (value if isinstance(value, tuple) else (value,))):
            raise ValueError(f"{name} {bound}, it is {value}")
