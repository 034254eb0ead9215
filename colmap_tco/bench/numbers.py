"""Published figures of the compared systems: those that a source could be read for, and no others."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources

NOT_HERE = "not available here"
"""What a table shows in the place of figures that no source could be read for."""


@dataclass(frozen=True)
class Source:
    """Where figures were read.

    Attributes:
        of: the publication that they are of.
        url: what was read.
        note: how far that is the publication itself.
    """

    of: str
    url: str
    note: str


@dataclass(frozen=True)
class Numbers:
    """What is known of one table.

    Attributes:
        systems: all systems that the paper compares, in its order.
        rows: system → column → figure, of those whose figures are known.
        table: which table of which publication they are from; empty if none are.
        source: where they were read; None if none are.
    """

    systems: tuple[str, ...]
    rows: Mapping[str, Mapping[str, float]]
    table: str = ""
    source: Source | None = None


@cache
def published(dataset: str, setting: str) -> Numbers:
    """The published figures of a dataset in a setting, in the unit of the tables.

    Points are aligned and compared as here, with the same frames; ScanNet's are not known for six views.
    """
    data = json.loads(resources.files(__package__).joinpath("data/published.json").read_text("utf-8"))
    systems = tuple(data["systems"])
    for table in data["tables"]:
        if (table["dataset"], table["setting"]) == (dataset, setting):
            rows = {
                system: dict(zip(data["columns"], figures, strict=True))
                for system, figures in table["rows"].items()
            }
            return Numbers(systems, rows, table["table"], Source(**data["sources"][table["source"]]))
    return Numbers(systems, {})
