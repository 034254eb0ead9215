"""Command-line flags generated from frozen dataclasses whose fields are made with ``knob``.

Nested dataclasses are flattened: every setting has one flat name, ``--max_image_size``, whichever
dataclass declares it, and a name declared twice is an error. The types understood are ``int``,
``float``, ``bool`` (``--name`` and ``--no_name``), ``str`` with or without choices, ``Path``,
``Optional`` of these (the word ``none`` stands for None) and ``tuple[…, ...]`` of these (separated
by commas, so that no value may hold one).

A field made with ``given_flags`` is no setting: it holds the names of those that the command line gave.
"""

from __future__ import annotations

import argparse
import difflib
import math
import re
import types
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


@dataclass(frozen=True)
class Setting:
    """One field of a configuration as the command line sees it.

    Attributes:
        name: the field's name, which is the flag without its dashes.
        base: the type of one value: int, float, bool, str or Path.
        optional: whether None is a value.
        many: whether the value is a tuple of ``base``.
        choices: the texts allowed, or None.
        default: the value where no flag is given.
        help: what the setting does.
        owner: the dataclass that declares the field.
        alias: a short flag beside the long one, or empty; switches have none.
    """

    name: str
    base: type
    optional: bool
    many: bool
    choices: tuple[str, ...] | None
    default: Any
    help: str
    owner: type
    alias: str = ""

    @property
    def flags(self) -> tuple[str, ...]:
        """The spellings with underscores: one, two for a switch, and a short one if there is any."""
        if self.base is bool:
            return (f"--{self.name}", f"--no_{self.name}")
        return (f"--{self.name}", self.alias) if self.alias else (f"--{self.name}",)

    @property
    def metavar(self) -> str:
        """What stands for the value in help texts; a switch has none."""
        if self.base is bool:
            return ""
        one = "{" + ",".join(self.choices) + "}" if self.choices else _METAVARS[self.base]
        return f"{one},…" if self.many else one

    @property
    def default_word(self) -> str:
        """The default as help texts tell it."""
        return self.show(self.default) or "empty"

    def parse(self, text: str) -> Any:
        """The value that a word of the command line stands for.

        Raises:
            argparse.ArgumentTypeError: the word is no such value.
        """
        if self.optional and text.lower() == "none":
            return None
        if self.many:
            return tuple(self._one(part) for part in text.split(",")) if text else ()
        return self._one(text)

    def show(self, value: Any) -> str:
        """The word of the command line that :meth:`parse` turns into ``value``."""
        if self.base is bool and value is not None:
            return "on" if value else "off"
        if value is None:
            return "none"
        return ",".join(map(str, value)) if self.many else str(value)

    def _one(self, text: str) -> Any:
        try:
            value = self.base(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not {_NOUNS[self.base]}") from None
        if self.base is float and math.isnan(value):
            raise argparse.ArgumentTypeError("nan is not a number to calculate with")
        if self.choices and value not in self.choices:
            raise argparse.ArgumentTypeError(f"{text!r} is not one of {', '.join(self.choices)}")
        return value


_NOUNS: dict[type, str] = {int: "a whole number", float: "a number", str: "a text", Path: "a path"}
_METAVARS: dict[type, str] = {int: "N", float: "X", str: "TEXT", Path: "PATH"}


class _Switch(argparse.Action):
    """``--name`` stores True, ``--no_name`` stores False."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        setattr(namespace, self.dest, option_string == self.option_strings[0])


def given_flags() -> tuple[str, ...]:
    """A field for the names of the settings that a command line gave, their defaults or not; else empty."""
    names: tuple[str, ...] = field(default=(), metadata={_GIVEN: True})
    return names


_GIVEN = "names of the flags that were given"


def settings(config_type: type) -> tuple[Setting, ...]:
    """All settings of a dataclass and of the dataclasses nested in it, in order.

    The defaults are those of ``config_type()``, so an outer class may change those of an inner one.

    Raises:
        TypeError: a field has no default, no help, or a type that no flag can express.
        ValueError: a name is declared twice, or a default is not a value of its own setting.
    """
    found: dict[str, Setting] = {}
    for setting in _walk(config_type, config_type()):
        twin = found.setdefault(setting.name, setting)
        if twin is not setting:
            raise ValueError(
                f"{setting.owner.__name__} and {twin.owner.__name__} both declare {setting.name!r}: "
                "flags are flat, so rename one of the two"
            )
    for setting in found.values():
        shadowed = setting.name.removeprefix("no_")
        if shadowed != setting.name and shadowed in found and found[shadowed].base is bool:
            raise ValueError(f"{setting.name!r} is the negation of the switch {shadowed!r}: rename one")
    return tuple(found.values())


def add_flags(parser: argparse.ArgumentParser, config_type: type, told: Collection[str] = ()) -> int:
    """Add a flag for every setting, one titled group for every dataclass; one not given sets nothing.

    Args:
        parser: gets them.
        config_type: declares them.
        told: names of those that the help lists; empty: all.

    Returns:
        How many the help does not list.

    Raises:
        TypeError, ValueError: as :func:`settings`.
    """
    groups: dict[type, argparse._ArgumentGroup] = {}
    every = settings(config_type)
    for setting in every:
        if setting.owner not in groups:
            groups[setting.owner] = parser.add_argument_group(title(setting.owner))
        text = f"{setting.help} (default: {setting.default_word})".replace("%", "%%")
        if told and setting.name not in told:
            text = argparse.SUPPRESS
        if setting.base is bool:
            groups[setting.owner].add_argument(
                *setting.flags,
                dest=setting.name,
                action=_Switch,
                nargs=0,
                default=argparse.SUPPRESS,
                help=text,
            )
        else:
            groups[setting.owner].add_argument(
                *setting.flags,
                dest=setting.name,
                type=setting.parse,
                default=argparse.SUPPRESS,
                metavar=setting.metavar,
                help=text,
            )
    return sum(setting.name not in told for setting in every) if told else 0


def title(owner: type) -> str:
    """The title of a group of flags: the docstring's first line, or the class name where there is none."""
    written = (owner.__doc__ or "").strip()
    # dataclasses without a docstring get their signature as one
    if not written or written.startswith(f"{owner.__name__}("):
        return owner.__name__
    return written.splitlines()[0].rstrip(".")


def build(config_type: type[T], namespace: argparse.Namespace) -> T:
    """The configuration, nested dataclasses included, that a parsed command line describes."""
    names = {setting.name for setting in settings(config_type)}
    given = {name: value for name, value in vars(namespace).items() if name in names}
    return _changed(config_type(), given)


def _changed(config: T, given: Mapping[str, Any]) -> T:
    """The configuration with the settings that were given, and their names where it has a field for them."""
    changes: dict[str, Any] = {}
    for f in fields(config):  # type: ignore[arg-type]
        value = getattr(config, f.name)
        if f.metadata.get(_GIVEN):
            changes[f.name] = tuple(sorted(given))
        elif is_dataclass(value):
            changes[f.name] = _changed(value, given)
        elif f.name in given:
            changes[f.name] = given[f.name]
    return replace(config, **changes)  # type: ignore[type-var]


def normalise(argv: Iterable[str]) -> list[str]:
    """The words of a command line with every ``--long-option=value`` spelt ``--long_option=value``.

    Only the names of options change, and nothing after a bare ``--``. Numbers with commas that begin with
    a minus are joined to the option before them, for argparse would take them for an option.
    """
    words = list(argv)
    end = words.index("--") if "--" in words else len(words)
    joined: list[str] = []
    for word in words[:end]:
        if _NUMBERS.fullmatch(word) and joined and joined[-1].startswith("--") and "=" not in joined[-1]:
            joined[-1] += f"={word}"
        else:
            joined.append(_underscored(word))
    return joined + words[end:]


_NUMBERS = re.compile(r"-[\d.][\d.eE+-]*(,[\d.eE+-]*)+")
"""A list of numbers of which the first is negative."""


def closest(flag: str, known: Iterable[str]) -> str | None:
    """The known flag that a mistyped one (``--stepz=3``) most resembles, or None."""
    matches = difflib.get_close_matches(flag.split("=", maxsplit=1)[0], list(known), n=1)
    return matches[0] if matches else None


def _walk(config_type: type, defaults: Any) -> Iterator[Setting]:
    hints = get_type_hints(config_type)
    for f in fields(config_type):
        hint, default = hints[f.name], getattr(defaults, f.name)
        if isinstance(hint, type) and is_dataclass(hint):
            yield from _walk(hint, default)
            continue
        if f.metadata.get(_GIVEN):
            continue
        where = f"{config_type.__name__}.{f.name}"
        if not f.metadata.get("help"):
            raise TypeError(f"{where} has no help: declare it with tco.config.knob")
        base, optional, many = _kind(hint, where)
        choices = f.metadata.get("choices")
        told, alias = f.metadata["help"], f.metadata.get("alias", "")
        setting = Setting(f.name, base, optional, many, choices, default, told, config_type, alias)
        _check_default(setting, where)
        yield setting


def _kind(hint: Any, where: str) -> tuple[type, bool, bool]:
    """(type of one value, whether None is allowed, whether it is a tuple) of an annotation."""
    optional = many = False
    if get_origin(hint) in (Union, types.UnionType):
        inner = [arg for arg in get_args(hint) if arg is not type(None)]
        optional, hint = True, inner[0] if len(inner) == 1 else hint
    if get_origin(hint) is tuple and get_args(hint)[1:] == (Ellipsis,):
        many, hint = True, get_args(hint)[0]
    if hint not in _NOUNS and (hint is not bool or many):
        raise TypeError(f"{where} is of type {hint}, which no flag can express")
    return hint, optional, many


def _check_default(setting: Setting, where: str) -> None:
    """A default must be what its own flag could give."""
    values = setting.default if setting.many and setting.default is not None else (setting.default,)
    for value in values:
        if value is None and setting.optional:
            continue
        accepted: tuple[type, ...] = (int, float) if setting.base is float else (setting.base,)
        if not isinstance(value, accepted) or (isinstance(value, bool) and setting.base is not bool):
            raise ValueError(f"the default of {where}, {value!r}, is not of its type")
        if setting.choices and value not in setting.choices:
            raise ValueError(f"the default of {where}, {value!r}, is not one of {setting.choices}")


def _underscored(word: str) -> str:
    if not word.startswith("--"):
        return word
    name, equals, value = word[2:].partition("=")
    return "--" + name.replace("-", "_") + equals + value
