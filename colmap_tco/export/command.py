"""``colmap-tco export FORMAT WORKSPACE``: a finished dense workspace for another program."""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from colmap_tco.atomic import UNFINISHED, write_text
from colmap_tco.errors import InputError
from colmap_tco.export.dense import Dense, open_dense
from colmap_tco.progress import Progress
from tco.config import knob

log = logging.getLogger(__name__)

FORMATS = ("3dgs", "openmvs", "las", "text")
MARK = "colmap-tco-export.json"
"""File in every folder that an export made, so that another may replace it."""


@dataclass(frozen=True)
class ExportConfig:
    """Where to and how much."""

    output_path: Path | None = knob(
        None,
        "What is written: a file for las (.laz is compressed), a folder for the others. none: beside the "
        "result, named after it and the format.",
        alias="-o",
    )
    max_points: int | None = knob(
        None,
        "Most points to keep, spread evenly: one in each cube of a grid; 0 keeps all. none: 400000 for "
        "3dgs, whose trainers want 300 to 500 thousand, and all for the others. openmvs always gets all.",
    )
    overwrite: bool = knob(False, "Replace an earlier export.")

    def points(self, usual: int) -> int:
        """The most points to keep where the format has a usual number; 0: all."""
        return usual if self.max_points is None else self.max_points

    def __post_init__(self) -> None:
        if self.max_points is not None and self.max_points < 0:
            raise ValueError(f"--max_points must not be negative, it is {self.max_points}")


@dataclass(frozen=True)
class Exported:
    """What was written.

    Attributes:
        path: the file or folder.
        told: what is in it, for the user.
    """

    path: Path
    told: str

    def summary(self) -> str:
        """Where it is and what is in it."""
        return f"{self.path}: {self.told}"


def export(
    format: str, root: Path, config: ExportConfig = ExportConfig(), progress: Progress | None = None
) -> Exported:
    """Write the dense workspace of ``root`` in one of :data:`FORMATS`.

    The files appear complete or not at all.

    Raises:
        InputError: there is no dense workspace, it is damaged, or the output exists and may not be replaced.
        MissingError: a package that the format needs is not installed.
    """
    dense = open_dense(root)
    progress = progress or Progress()
    progress.stage(f"export {format}", 1)
    if format == "las":
        from colmap_tco.export.las import write_las

        target = config.output_path or dense.paths.ply.with_suffix(".laz")
        if target.exists() and not config.overwrite:
            raise InputError(f"{target} exists; replace it with --overwrite or name another with -o")
        told = write_las(dense, target, config.points(0))
    else:
        target = config.output_path or dense.paths.root.with_name(f"{dense.paths.root.name}-{format}")
        told = _into_folder(
            target, config.overwrite, lambda folder: _write_folder(format, dense, folder, config)
        )
    progress.advance(1)
    return Exported(target, told)


def _write_folder(format: str, dense: Dense, folder: Path, config: ExportConfig) -> str:
    from colmap_tco.export import openmvs, splatting, text

    if format == "3dgs":
        return splatting.write_3dgs(dense, folder, config.points(splatting.USUAL_POINTS))
    if format == "openmvs":
        return openmvs.write_openmvs(dense, folder)
    if format == "text":
        return text.write_text_model(dense, folder, config.points(0))
    raise ValueError(f"{format!r} is not one of {', '.join(FORMATS)}")


def _into_folder(target: Path, overwrite: bool, write: Callable[[Path], str]) -> str:
    """Let ``write`` fill a folder, which becomes ``target`` when it returns.

    Raises:
        InputError: the folder is there and ``overwrite`` is not given, or it is not an export.
    """
    target = target.absolute()
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        if not (target / MARK).is_file():
            raise InputError(f"{target} exists and is no export of colmap-tco; name another folder with -o")
        if not overwrite:
            raise InputError(f"{target} exists; replace it with --overwrite or name another with -o")
    folder = target.with_name(f".{target.name}.{os.getpid()}{UNFINISHED}")
    aside = target.with_name(f".{target.name}.{os.getpid()}.old{UNFINISHED}")
    try:
        folder.mkdir(parents=True)
        told = write(folder)
        write_text(folder / MARK, json.dumps({"made_by": "colmap-tco", "holds": told}) + "\n")
        if target.exists():
            os.replace(target, aside)
        os.replace(folder, target)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.rmtree(aside, ignore_errors=True)
    return told


def copy_images(dense: Dense, names: dict[str, str], folder: Path) -> None:
    """Copy the undistorted images, each under its new name.

    Raises:
        InputError: one is missing.
    """
    folder.mkdir(parents=True)
    for old, new in names.items():
        if not dense.paths.image(old).is_file():
            raise InputError(f"{dense.paths.image(old)}: there is no such image, though the model names it")
        shutil.copyfile(dense.paths.image(old), folder / new)
    renamed = sum(old != new for old, new in names.items())
    if renamed:
        log.info("%d images lose folders, blanks and commas in their names", renamed)
