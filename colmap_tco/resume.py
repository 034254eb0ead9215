"""The result folder while it is made: resumed after a kill, published when complete, never half there.

Everything is written to ``<workspace>/.dense-tco.partial/`` with atomic files, and its
``manifest.json`` lists the finished views under a fingerprint of the settings and inputs. A run that
finds a partial folder with its own fingerprint goes on after the last finished view; one with another
fingerprint is removed, for it cannot be completed any more. At the end the folder is renamed to
``dense-tco``. Folders without our manifest are never touched.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from colmap_tco.atomic import UNFINISHED, write_text
from colmap_tco.errors import InputError
from colmap_tco.workspace import DensePaths, dense_paths, partial_paths

log = logging.getLogger(__name__)

_MADE_BY = "colmap-tco"
_FORMAT = 1


def fingerprint(settings: Mapping[str, object], contents: Iterable[Path], files: Iterable[Path]) -> str:
    """A text that changes when the result would.

    Args:
        settings: everything that decides the result, as JSON can hold it.
        contents: files whose bytes count (the model, masks).
        files: files of which name, size and time of change count (images).
    """
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for path in sorted(contents):
        digest.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
    for path in sorted(files):
        status = path.stat()
        digest.update(f"{path.name} {status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()


class _Record(NamedTuple):
    """What a manifest holds of the work that was done: figures of views by name, and of chunks.

    Attributes:
        chunk_size: views of the largest chunk that was planned with; 0: nothing was planned.
    """

    views: dict[str, dict[str, object]]
    chunks: list[dict[str, object]]
    chunk_size: int = 0


class Result:
    """The result folder of one workspace, finished or in the making; opened by :func:`open_result`.

    Attributes:
        paths: where to write, or, if ``finished``, where the result is.
        finished: True if the published result has this fingerprint: nothing is left to do.
        views: what was recorded of each finished view, by name.
        chunks: what was recorded of each finished chunk, earlier runs included.
    """

    def __init__(self, root: Path, keys: tuple[str, str], finished: bool, record: _Record) -> None:
        self.paths: DensePaths = dense_paths(root) if finished else partial_paths(root)
        self.finished = finished
        self.views, self.chunks, self._chunk_size = record
        self._root = root
        self._fingerprint, self._maps = keys

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

    def mark_done(self, views: Mapping[str, Mapping[str, object]]) -> None:
        """Record that all files of some views, by name, are written, with the figures of each for the report.

        The manifest is written as a whole, so that many views are better told of at once.
        """
        self.views.update({name: dict(figures) for name, figures in views.items()})
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
            "fingerprint": self._fingerprint,
            "maps": self._maps,
            "complete": complete,
            "chunk_size": self._chunk_size,
            "chunks": self.chunks,
            "views": self.views,
        }
        write_text(self.paths.manifest, json.dumps(manifest, indent=1, allow_nan=False) + "\n")


def open_result(
    root: Path, fingerprint: str, overwrite: bool = False, maps: str = "", settings: object = None
) -> Result:
    """Find out what there is to do, and prepare the partial folder for it.

    Args:
        root: the workspace.
        fingerprint: of this run's settings and inputs, see :func:`fingerprint`.
        overwrite: make the result anew even if there is one, and let it replace the one there. The maps of
            a result that differs by what comes after them alone are kept.
        maps: fingerprint of what decides the depth maps; empty: the same as ``fingerprint``.
        settings: of this run, as ``report.json`` holds them, so that an error can say what is different.

    Raises:
        InputError: a result of other settings is there and ``overwrite`` is not given; or a folder of
            that name is there which we did not make.
    """
    final, partial, aside = dense_paths(root), partial_paths(root), _aside(root)
    keys = (fingerprint, maps or fingerprint)
    reusable = False
    if aside.root.exists():
        _restore(final, aside)
    if final.root.exists():
        _require_ours(final)
        same = _read(final).get("fingerprint") == fingerprint
        reusable = not same and _maps_key(final) == keys[1]
        if same and not overwrite:
            log.info("%s is complete and made with these settings: nothing to do", final.root)
            return Result(root, keys, True, _record(final))
        if not overwrite:
            hint = "replace it (its depth maps will be kept)" if reusable else "replace it"
            raise InputError(
                f"{final.root} was made {_difference(final, settings)}; give --overwrite to {hint}, or "
                "rename it to keep it"
            )
    record = _resume(partial, keys[1])
    if reusable and not record.views:
        record = _reuse(final, partial)
    result = Result(root, keys, False, record)
    result._save(complete=False)
    return result


def _difference(paths: DensePaths, settings: object) -> str:
    """How the result that is there came about otherwise than by these settings."""
    try:
        before = _flat(json.loads(paths.report.read_text("utf-8"))["settings"])
    except (OSError, ValueError, KeyError):
        before = {}
    now = _flat(settings)
    other = [name for name in now if name in before and before[name] != now[name] and name not in _FREE]
    if not other:
        return "from other inputs, with other settings or by another version"
    told = [f"{name} {json.dumps(before[name])}, now {json.dumps(now[name])}" for name in other]
    return f"with other settings ({'; '.join(told)})"


_FREE = ("given", "overwrite", "report_page", "num_threads")
"""Settings that do not change the result."""


def _flat(settings: object) -> dict[str, object]:
    """Settings by name, those of nested groups among them; their names are all different."""
    found: dict[str, object] = {}
    for name, value in settings.items() if isinstance(settings, dict) else ():
        found |= _flat(value) if isinstance(value, dict) else {name: value}
    return found


def _resume(partial: DensePaths, maps: str) -> _Record:
    """The finished views in a partial folder with this fingerprint of maps; any other of ours is removed."""
    if not partial.root.exists():
        return _Record({}, [])
    _require_ours(partial)
    if _maps_key(partial) != maps:
        log.info("%s was begun from other inputs or with other settings: beginning anew", partial.root)
        shutil.rmtree(partial.root)
        return _Record({}, [])
    for unfinished in list(partial.root.rglob(f"*{UNFINISHED}*")):
        if unfinished.is_dir():
            shutil.rmtree(unfinished)
        else:
            unfinished.unlink()
    record = _record(partial)
    views = {name: figures for name, figures in record.views.items() if _all_there(partial, name)}
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


def _maps_key(paths: DensePaths) -> object:
    """The fingerprint of the maps; manifests of the first versions have one fingerprint for everything."""
    manifest = _read(paths)
    return manifest.get("maps", manifest.get("fingerprint"))


def _record(paths: DensePaths) -> _Record:
    manifest = _read(paths)
    views, chunks, size = manifest.get("views"), manifest.get("chunks"), manifest.get("chunk_size")
    return _Record(
        dict(views) if isinstance(views, dict) else {},
        list(chunks) if isinstance(chunks, list) else [],
        size if isinstance(size, int) else 0,
    )
