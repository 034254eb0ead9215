"""Results of finished scenes, one JSON file each, and the tables made of them.

<output>/<dataset>-<setting>-<backbone>/<row>/<scene>.json   figures, seconds, settings, fingerprint
<output>/<dataset>-<setting>-<backbone>/scenes.csv           a line a row and scene
<output>/<dataset>-<setting>-<backbone>/table.csv            a line a row: means over its scenes
<output>/<dataset>-<setting>-<backbone>/table.md             the same, beside the published figures
"""

from __future__ import annotations

import csv
import io
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from colmap_tco.atomic import write_text
from colmap_tco.bench.numbers import NOT_HERE, Numbers
from colmap_tco.errors import InputError
from colmap_tco.resume import fingerprint

log = logging.getLogger(__name__)

FORMAT = 1


@dataclass(frozen=True)
class Result:
    """One row on one scene.

    Attributes:
        row: its name.
        scene: its name.
        figures: column → value; empty if it failed.
        seconds: of the reconstruction.
        views: how many there were.
        failed: why there are no figures; empty if there are.
    """

    row: str
    scene: str
    figures: Mapping[str, float]
    seconds: float
    views: int
    failed: str = ""


def result_file(folder: Path, row: str, scene: str) -> Path:
    """Where a row's result on a scene is."""
    return folder / _plain(row) / f"{_plain(scene)}.json"


def _plain(name: str) -> str:
    """A name that any file system takes."""
    return name.replace("/", "_")


def read_result(
    folder: Path, row: str, scene: str, settings: Mapping[str, Any], overwrite: bool = False
) -> Result | None:
    """The result of these settings, failed or not, or None if there is none, or it is to be replaced.

    Raises:
        InputError: there is one of other settings, or the file is damaged, and ``overwrite`` is not given.
    """
    path = result_file(folder, row, scene)
    if overwrite or not path.exists():
        return None
    try:
        saved = json.loads(path.read_text("utf-8"))
        old, result = saved["settings"], Result(**saved["result"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no result of this command ({error}); remove it, or --overwrite") from error
    if saved["fingerprint"] != fingerprint({**settings, "format": FORMAT}):
        changed = sorted(k for k in {*old, *settings} if old.get(k) != json.loads(_json(settings.get(k))))
        raise InputError(
            f"{path} was made with other settings ({', '.join(changed) or 'of another version'}); give "
            "--overwrite to replace it, or another --output to keep it"
        )
    return result


def stored(folder: Path) -> list[tuple[str, str]]:
    """Rows and scenes of all results in the folder, whatever their settings; what is none is left out."""
    found = []
    for path in sorted(folder.glob("*/*.json")):
        try:
            saved = json.loads(path.read_text("utf-8"))["result"]
            found.append((saved["row"], saved["scene"]))
        except (ValueError, KeyError, TypeError) as error:
            log.warning("%s: no result of this command (%s)", path, error)
    return found


def write_result(folder: Path, settings: Mapping[str, Any], result: Result) -> None:
    """Keep a result, atomically."""
    content = {
        "fingerprint": fingerprint({**settings, "format": FORMAT}),
        "settings": settings,
        "result": vars(result),
    }
    write_text(result_file(folder, result.row, result.scene), _json(content, indent=1) + "\n")


def _json(value: object, indent: int | None = None) -> str:
    return json.dumps(value, indent=indent, ensure_ascii=False, allow_nan=False, default=str)


def means(results: Sequence[Result], columns: Sequence[str]) -> dict[str, float]:
    """Means over the scenes that have figures, as the published evaluations take them; empty without any."""
    done = [result for result in results if not result.failed]
    if not done:
        return {}
    return {name: sum(result.figures[name] for result in done) / len(done) for name in columns}


def write_tables(
    folder: Path,
    rows: Mapping[str, Sequence[Result]],
    columns: Sequence[str],
    about: Sequence[str],
    known: Numbers,
) -> Path:
    """Write scenes.csv, table.csv and table.md.

    Args:
        folder: of the results.
        rows: row → results of its scenes.
        columns: of the table.
        about: sentences that say what was run.
        known: published figures.

    Returns:
        table.md.
    """
    lines = [
        [r.row, r.scene, r.views, f"{r.seconds:.1f}", *(_digits(r.figures.get(c)) for c in columns), r.failed]
        for results in rows.values() for r in results
    ]  # fmt: skip
    head = ["row", "scene", "views", "seconds", *columns, "failed"]
    write_text(folder / "scenes.csv", _csv([head, *lines]))
    table = [
        [name, sum(not r.failed for r in results), f"{sum(r.seconds for r in results):.1f}",
         *(_digits(means(results, columns).get(c)) for c in columns)]
        for name, results in rows.items()
    ]  # fmt: skip
    write_text(folder / "table.csv", _csv([["row", "scenes", "seconds", *columns], *table]))
    write_text(folder / "table.md", markdown(rows, columns, about, known))
    return folder / "table.md"


def markdown(
    rows: Mapping[str, Sequence[Result]], columns: Sequence[str], about: Sequence[str], known: Numbers
) -> str:
    """The table of this machine's rows and of the published ones, and where those are from."""
    head = ["", *columns, "scenes", "s"]
    lines = ["".join(f"{sentence}\n\n" for sentence in about), _row(head), _row(["---"] * len(head))]
    for name, results in rows.items():
        mean = means(results, columns)
        done, seconds = sum(not r.failed for r in results), sum(r.seconds for r in results)
        lines.append(
            _row(
                [
                    name,
                    *(_digits(mean.get(c)) for c in columns),
                    f"{done} of {len(results)}",
                    f"{seconds:.0f}",
                ]
            )
        )
    for system in known.systems:
        figures = known.rows.get(system)
        cells = [_digits(figures[c]) for c in columns] if figures else [NOT_HERE] + [""] * (len(columns) - 1)
        lines.append(_row([f"*{system}, published*", *cells, "", ""]))
    failures = [
        f"- {r.row}, {r.scene}: {r.failed}\n" for results in rows.values() for r in results if r.failed
    ]
    if failures:
        lines += ["\nWithout figures:\n\n", *failures]
    if known.source is not None:
        s = known.source
        lines.append(f"\nPublished figures: {known.table} ({s.of}), read in {s.url} ({s.note}).\n")
    return "".join(lines)


def _row(cells: Sequence[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |\n"


def _digits(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}" if abs(value) < 100 else f"{value:.1f}"


def _csv(lines: Sequence[Sequence[object]]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(lines)
    return buffer.getvalue()
