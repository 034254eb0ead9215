"""How settings are declared: frozen dataclasses whose fields carry their own help text."""

from __future__ import annotations

from dataclasses import field
from typing import TypeVar

T = TypeVar("T")


def knob(default: T, help: str, choices: tuple[str, ...] | None = None, alias: str = "") -> T:
    """A dataclass field with a default, a help text, the values that a text may take, and a short flag.

    The command line is generated from these; ``help`` says what the setting does, in which unit,
    and when to change it.
    """
    return field(default=default, metadata={"help": help, "choices": choices, "alias": alias})
