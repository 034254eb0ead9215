"""``report.html``: the page of :mod:`colmap_tco.page.content` with its program and its data in one file."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from colmap_tco.atomic import write_text
from colmap_tco.errors import DensifyError
from colmap_tco.page.content import Limits, content
from colmap_tco.workspace import DensePaths

log = logging.getLogger(__name__)

PLACE = "__COLMAP_TCO_DATA__"
"""Where the bundled page wants its data."""


def write_page(paths: DensePaths, report: Mapping[str, Any], limits: Limits = Limits()) -> Path:
    """Write ``report.html`` beside ``report.json``, atomically.

    Args:
        paths: a dense workspace with maps, model and cloud.
        report: what ``report.json`` holds.
        limits: of what the page holds.

    Raises:
        InputError: a file is missing or damaged.
    """
    page = filled(content(paths, report, limits))
    write_text(paths.page, page)
    log.info("%s: %.1f MB", paths.page.name, len(page) / 1e6)
    return paths.page


def filled(data: Mapping[str, Any]) -> str:
    """The page with its data.

    Raises:
        DensifyError: the installed page has no place for data.
    """
    page = resources.files("colmap_tco.page").joinpath("built/page.html").read_text("utf-8")
    before, found, after = page.partition(PLACE)
    if not found:
        raise DensifyError("the installed built/page.html is damaged; install colmap-tco again")
    # A name of an image could hold "</script>", which would end the data.
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return before + text.replace("<", "\\u003c") + after
