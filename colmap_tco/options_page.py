"""``docs/options.md``: every flag of every command, from the same dataclasses as ``--help``.

``python -m colmap_tco.options_page > docs/options.md`` makes it anew; a test tells when that is due.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping

from colmap_tco import flags
from colmap_tco.commands import COMMANDS, Command

HEAD = """\
# All options

Made by `python -m colmap_tco.options_page` from what `--help_all` is made of. `_` and `-` are
alike in names, `none` and `empty` are no value, `…` is a list separated by commas. Every command also takes
`-v` (details and tracebacks), `-q` (warnings and errors alone) and `--log_json` (one JSON object a line on
stderr). A group that several commands have with the same defaults is listed once.
"""


def options_page(commands: Mapping[str, Command] = COMMANDS) -> str:
    """The page as Markdown: a section for each command, and in it a table for each group of flags.

    Raises:
        TypeError, ValueError: as :func:`colmap_tco.flags.settings`.
    """
    listed: dict[tuple[flags.Setting, ...], str] = {}
    lines = [HEAD]
    for name, command in commands.items():
        words = " ".join(["colmap-tco", name, *(argument.shown for argument in command.arguments)])
        lines += [f"## `{words}`\n", f"{_escaped(command.help[:1].upper() + command.help[1:])}.\n"]
        for group in _groups(command):
            title = flags.title(group[0].owner)
            first = listed.setdefault(group, name)
            if first == name:
                lines += [f"**{title}**\n", *_table(group)]
            else:
                lines += [f"**{title}**: as those of `{first}`.\n"]
    return "\n".join(lines).rstrip() + "\n"


def _groups(command: Command) -> Iterator[tuple[flags.Setting, ...]]:
    """The settings of a command by the dataclass that declares them, in the order of ``--help``."""
    module, _, name = command.config.partition(":")
    groups: dict[type, list[flags.Setting]] = {}
    for setting in flags.settings(getattr(importlib.import_module(module), name)):
        groups.setdefault(setting.owner, []).append(setting)
    yield from map(tuple, groups.values())


def _table(group: tuple[flags.Setting, ...]) -> list[str]:
    rows = [
        f"| {', '.join(f'`{f} {s.metavar}'.rstrip() + '`' for f in s.flags)} "
        f"| `{s.default_word}` | {_escaped(s.help)} |"
        for s in group
    ]
    return ["| flag | default | what it does |", "|---|---|---|", *rows, ""]


def _escaped(text: str) -> str:
    """Text whose signs Markdown shows instead of obeying them."""
    for sign in "\\|*<>`":
        text = text.replace(sign, "\\" + sign)
    return text


if __name__ == "__main__":
    sys.stdout.write(options_page())
