"""``colmap-tco report``: make the page of a finished result anew and open it in the browser."""

from __future__ import annotations

import logging
import webbrowser
from dataclasses import dataclass
from pathlib import Path

from colmap_tco.lock import locked
from colmap_tco.progress import Progress
from colmap_tco.workspace import existing_root
from tco.config import knob

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReportConfig:
    """What ``colmap-tco report`` can be told."""

    open: bool = knob(True, "open the page in the browser; --no_open writes it only")


@dataclass(frozen=True)
class Page:
    """Where the page is."""

    path: Path

    def summary(self) -> str:
        """What the user wants to know at the end."""
        return f"{self.path}: {self.path.stat().st_size / 1e6:.1f} MB"


def show_report(root: Path, config: ReportConfig, progress: Progress) -> Page:
    """Write ``dense-tco/report.html`` from the results on disk and open it.

    Raises:
        InputError: the workspace has no finished result, a file of it is damaged, or a run is working on it.
    """
    from colmap_tco.dense import finished, read_report
    from colmap_tco.page.write import write_page

    root = existing_root(root)
    paths = finished(root)
    with locked(root):
        page = write_page(paths, read_report(paths))
    if config.open and not webbrowser.open(page.absolute().as_uri()):
        log.warning("no browser was found; open %s yourself", page)
    return Page(page)
