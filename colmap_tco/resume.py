"""The result folder while it is made: resumed after a kill, published when complete, never half there.

Everything is written to ``<workspace>/.dense-tco.partial/`` with atomic files, and its
``manifest.json`` lists the finished views and what they were made from: settings and inputs. A run with
the same goes on after the last finished view. Another cannot complete the folder; it removes it where no
view is finished or the user says so. At the end the folder is renamed to ``dense-tco``. Folders without our
manifest are never touched.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from colmap_tco.atomic import UNFINISHED, write_text
from colmap_tco.errors import InputError
from colmap_tco.workspace import DensePaths, dense_paths, partial_paths

log = logging.getLogger(__name__)

_MADE_BY = "colmap-tco"
_FORMAT = 1


def fingerprint(settings: Mapping[str, object], contents: Iterable[Path] = ()) -> str:
    """A text that changes when the result would.

    Args:
        settings: everything that decides the result, as JSON can hold it.
        contents: files whose names and bytes count.
    """
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for path in sorted(contents):
        digest.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


class Origin(NamedTuple):
    """What a result is made from.

    Attributes:
        settings: name → value as JSON holds it, exactly, of those that decide the result.
        inputs: name of each file that decides it → hash of its bytes.
        later: names of the settings that decide only what follows the depth maps.
    """

    settings: Mapping[str, object]
    inputs: Mapping[str, str]
    later: frozenset[str] = frozenset()

    def same_result(self, other: Origin) -> bool:
        """Whether both give the same result."""
        return self.settings == other.settings and self.inputs == other.inputs

    def same_maps(self, other: Origin) -> bool:
        """Whether both give the same depth maps."""
        theirs, own = ({k: v for k, v in o.settings.items() if k not in self.later} for o in (other, self))
        return theirs == own and self.inputs == other.inputs

    def difference(self, before: Origin) -> str:
        """How a result came about that was made from ``before``, to follow upon "was made"."""
        settings, inputs = (_changed(*both) for both in zip(before[:2], self[:2], strict=True))
        if not before.settings:
            return "by an earlier version"
        values = [f"{k} {_shown(before.settings, k)}, now {_shown(self.settings, k)}" for k in settings]
        told = [f"with other settings ({'; '.join(values)})"] if values else []
        more = f" and {len(inputs) - _NAMED} more" if len(inputs) > _NAMED else ""
        told += [f"from other inputs ({', '.join(inputs[:_NAMED])}{more})"] if inputs else []
        return " and ".join(told)


_NAMED = 5
"""Files that a message names before it says how many more there are."""


def _changed(before: Mapping[str, object], now: Mapping[str, object]) -> list[str]:
    """Names of what is another, new or missing."""
    return [name for name in {**before, **now} if _shown(before, name) != _shown(now, name)]


def _shown(values: Mapping[str, object], name: str) -> str:
    return json.dumps(values[name]) if name in values else "unknown"


class _Record(NamedTuple):
    """What a manifest holds of the work that was done: figures of views by name, and of chunks.

    Attributes:
        chunk_size: views of the largest chunk that was planned with; 0: nothing was planned.
        mapping: seconds that it took to make the model of these images, where a run of ours did.
    """

    views: dict[str, dict[str, object]]
    chunks: list[dict[str, Any]]
    chunk_size: int = 0
    mapping: float = 0.0


class Result:
    """The result folder of one workspace, finished or in the making; opened by :func:`open_result`.

    Attributes:
        paths: where to write, or, if ``finished``, where the result is.
        finished: True if the published result is made from the same: nothing is left to do.
        views: what was recorded of each finished view, by name.
        chunks: what was recorded of each finished chunk, earlier runs included.
    """

    def __init__(self, root: Path, origin: Origin, finished: bool, record: _Record) -> None:
        self.paths: DensePaths = dense_paths(root) if finished else partial_paths(root)
        self.finished = finished
        self.views, self.chunks, self._chunk_size, self._mapping = record
        self._root, self._origin = root, origin

    def is_done(self, name: str) -> bool:
        """Whether this view was finished, now or by an earlier run."""
        return name in self.views

    def chunk_size(self, limit: int) -> int:
        """Views of a chunk to plan with: what an earlier run planned with, else ``limit``.

        The free memory is another in every run. Chunks of another size would hold other views, so that those
        of a finished chunk would be predicted again.
        """
        self._chunk_size = self._chunk_size or limit
        return self._chunk_size

    def seconds(self, spent: Mapping[str, float]) -> dict[str, float]:
        """Seconds of each stage: what this run spent, and earlier ones on the model and the chunks."""
        chunks = sum(chunk.get("seconds", 0.0) for chunk in self.chunks)
        return ({"mapping": self._mapping} if self._mapping else {}) | {**spent, "optimisation": chunks}

    def mark_done(self, views: Mapping[str, Mapping[str, object]]) -> None:
        """Record that all files of some views, by name, are written, with the figures of each for the report.

        The manifest is written as a whole, so that many views are better told of at once.
        """
        self.views.update({name: dict(figures) for name, figures in views.items()})
        self._save(complete=False)

    def mark_mapping(self, seconds: float) -> None:
        """Record how long it took to make the model."""
        self._mapping = seconds
        self._save(complete=False)

    def mark_chunk(self, figures: Mapping[str, object]) -> None:
        """Record what is to be reported of a chunk whose views are all done."""
        self.chunks.append(dict(figures))
        self._save(complete=False)

    def publish(self) -> DensePaths:
        """Rename the partial folder to the final one, in the place of an earlier result.

        The earlier result is set aside until the new one is there; a kill in between leaves both, and
        the next run sorts them out.
        """
        final, aside = dense_paths(self._root), _aside(self._root)
        self._save(complete=True)
        if final.root.exists():
            _require_ours(final)
            os.replace(final.root, aside.root)
        os.replace(self.paths.root, final.root)
        if aside.root.exists():
            shutil.rmtree(aside.root)
        self.paths, self.finished = final, True
        return final

    def _save(self, complete: bool) -> None:
        manifest = {
            "made_by": _MADE_BY,
            "format": _FORMAT,
            "settings": self._origin.settings,
            "inputs": self._origin.inputs,
            "complete": complete,
            "mapping": self._mapping,
            "chunk_size": self._chunk_size,
            "chunks": self.chunks,
            "views": self.views,
        }
        write_text(self.paths.manifest, json.dumps(manifest, indent=1, allow_nan=False) + "\n")


def open_result(root: Path, origin: Origin, overwrite: bool = False) -> Result:
    """Find out what there is to do, and prepare the partial folder for it.

    Args:
        root: the workspace.
        origin: what this run makes its result from.
        overwrite: make the result anew even if there is one, and let it replace the one there. The maps of
            a result that differs by what comes after them alone are kept.

    Raises:
        InputError: a result or unfinished views of another origin are there and ``overwrite`` is not given;
            or a folder of that name is there which we did not make.
    """
    final, partial, aside = dense_paths(root), partial_paths(root), _aside(root)
    reusable = False
    if aside.root.exists():
        _restore(final, aside)
    if final.root.exists():
        _require_ours(final)
        before = _origin(final)
        same = origin.same_result(before)
        reusable = not same and origin.same_maps(before)
        if same and not overwrite:
            log.info("%s is complete and made with these settings: nothing to do", final.root)
            return Result(root, origin, True, _record(final))
        if not overwrite:
            hint = "replace it (its depth maps will be kept)" if reusable else "replace it"
            raise InputError(
                f"{final.root} was made {origin.difference(before)}; give --overwrite to {hint}, or "
                "rename it to keep it"
            )
    record = _resume(partial, origin, overwrite)
    if reusable and not record.views:
        record = _reuse(final, partial)
    result = Result(root, origin, False, record)
    result._save(complete=False)
    return result


def _resume(partial: DensePaths, origin: Origin, overwrite: bool) -> _Record:
    """The finished views in a partial folder, if their maps have the same origin; else the folder is removed.

    Raises:
        InputError: views would be lost, and ``overwrite`` is not given.
    """
    if not partial.root.exists():
        return _Record({}, [])
    _require_ours(partial)
    record = _record(partial)
    views = {name: figures for name, figures in record.views.items() if _all_there(partial, name)}
    before = _origin(partial)
    if not origin.same_maps(before):
        begun = f"{partial.root} was begun {origin.difference(before)}"
        if views and not overwrite:
            raise InputError(
                f"{begun}: what it was begun with goes on after its {len(views)} finished views, --overwrite "
                "begins anew without them"
            )
        log.info("%s: beginning anew", begun)
        shutil.rmtree(partial.root)
        return _Record({}, [])
    for unfinished in list(partial.root.rglob(f"*{UNFINISHED}*")):
        if unfinished.is_dir():
            shutil.rmtree(unfinished)
        else:
            unfinished.unlink()
    log.info("%s: going on after %d finished views", partial.root, len(views))
    return record._replace(views=views)


def _reuse(final: DensePaths, partial: DensePaths) -> _Record:
    """The maps and images of a published result in the partial folder too, as links or copies.

    Files of a result are replaced, never changed, so that a link is as good as a copy.
    """
    record = _record(final)
    views = {name: figures for name, figures in record.views.items() if _all_there(final, name)}
    for name in views:
        for old, new in zip(_files(final, name), _files(partial, name), strict=True):
            new.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(old, new)
            except OSError:  # a file system without hard links
                shutil.copy2(old, new)
    log.info("%s: the depth maps of %d views are kept", final.root, len(views))
    return record._replace(views=views)


def _all_there(paths: DensePaths, name: str) -> bool:
    """Whether every file of a view exists; files are atomic, so that those that exist are whole."""
    return all(file.is_file() for file in _files(paths, name))


def _files(paths: DensePaths, name: str) -> tuple[Path, ...]:
    """Every file of a view."""
    maps = (paths.depth_map(name), paths.normal_map(name), *paths.own_maps(name))
    return paths.image(name), paths.confidence_map(name), paths.error_map(name), *maps


def _restore(final: DensePaths, aside: DensePaths) -> None:
    """Undo or finish a replacement that was interrupted between its two renames."""
    _require_ours(aside)
    if final.root.exists():
        shutil.rmtree(aside.root)
    else:
        os.replace(aside.root, final.root)


def _aside(root: Path) -> DensePaths:
    """Where an earlier result waits while it is replaced."""
    return DensePaths(root / ".dense-tco.old")


def _require_ours(paths: DensePaths) -> None:
    """Refuse a folder that holds something but not our manifest: it belongs to the user."""
    if _read(paths).get("made_by") == _MADE_BY:
        return
    if paths.root.is_dir() and all(UNFINISHED in entry.name for entry in paths.root.iterdir()):
        return
    raise InputError(f"{paths.root} exists but was not made by {_MADE_BY}; rename it or move it away")


def _read(paths: DensePaths) -> dict[str, object]:
    if not paths.manifest.is_file():
        return {}
    try:
        manifest = json.loads(paths.manifest.read_text("utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError):
        return {}
    return manifest if isinstance(manifest, dict) and manifest.get("format") == _FORMAT else {}


def _origin(paths: DensePaths) -> Origin:
    """What the manifest says that a result was made from; nothing in those of the first versions."""
    manifest = _read(paths)
    settings, inputs = manifest.get("settings"), manifest.get("inputs")
    return Origin(settings if isinstance(settings, dict) else {}, inputs if isinstance(inputs, dict) else {})


def _record(paths: DensePaths) -> _Record:
    manifest = _read(paths)
    views, chunks, size = manifest.get("views"), manifest.get("chunks"), manifest.get("chunk_size")
    mapping = manifest.get("mapping")
    return _Record(
        dict(views) if isinstance(views, dict) else {},
        list(chunks) if isinstance(chunks, list) else [],
        size if isinstance(size, int) else 0,
        mapping if isinstance(mapping, float) else 0.0,
    )
