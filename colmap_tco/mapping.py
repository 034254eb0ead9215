"""Bare images → a sparse model: COLMAP's own extraction, matching and mapping."""

from __future__ import annotations

import logging
import os
import shutil
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Ints
from colmap_tco.errors import InputError, MissingError
from colmap_tco.image_files import decoded_size, list_images
from colmap_tco.progress import Progress
from colmap_tco.workspace import existing_root, find_images, find_models, listing
from tco.config import check_range, knob

log = logging.getLogger(__name__)

EXHAUSTIVE_UP_TO = 150
"""Images up to which all pairs are matched: about ten thousand pairs."""
LOOK_AGAIN = 0.5
"""Seconds after which it is looked again how far COLMAP is."""
_BLOCK = 64


@dataclass(frozen=True)
class MappingConfig:
    """How a model is made where there is none."""

    mapper: str = knob(
        "incremental",
        "how poses are found: incremental is robust; global is faster from about 100 images on",
        choices=("incremental", "global"),
    )
    matcher: str = knob(
        "auto",
        "which pairs are matched: exhaustive, all; sequential, neighbours in name order (videos); retrieval, "
        "the most similar ones; auto: exhaustive up to 150 images, above that retrieval",
        choices=("auto", "exhaustive", "sequential", "retrieval"),
    )
    overlap: int = knob(10, "neighbours in name order that sequential and retrieval matching include")
    num_similar: int = knob(30, "images that retrieval matches with each image; raise if models split")
    cameras: str = knob(
        "shared",
        "shared: one camera for all images of one size, make, model and focal length (EXIF); "
        "per_image: one for each, for collections from unknown cameras",
        choices=("shared", "per_image"),
    )

    def __post_init__(self) -> None:
        check_range(self, "overlap", 1 if self.matcher == "sequential" else 0)
        check_range(self, "num_similar", 1)


@dataclass(frozen=True)
class _Job:
    """What the steps of one mapping have in common."""

    folder: Path
    names: list[str]
    scratch: Path
    threads: int
    seed: int

    @property
    def database(self) -> Path:
        return self.scratch / "database.db"


def ensure_model(
    root: Path | str,
    image_path: str = "",
    config: MappingConfig = MappingConfig(),
    num_threads: int = -1,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Path]:
    """The sparse models of a workspace; made from its images if there are none.

    Everything is made in ``.sparse-tco.partial`` and renamed at the end: models to ``sparse/``, the
    database to ``database.db`` unless the workspace has one, which is left alone.

    Args:
        root: the workspace.
        image_path: image folder, if not in its usual place.
        config: how to map.
        num_threads: -1 for all cores.
        seed: with one thread the result is repeatable; with several it is nearly so.
        progress: is told of the stages features, matching and mapping.

    Raises:
        InputError: fewer than two readable images, ``sparse`` in the way, or no reconstruction.
        MissingError: the installed pycolmap lacks the mapper or matcher that was asked for.
    """
    root = existing_root(root)
    models = find_models(root)
    if models:
        return models
    sparse = root / "sparse"
    if sparse.exists() and any(sparse.iterdir()):
        raise InputError(
            f"{sparse} is not empty and holds no model; move it away, or name one with --model_path"
        )
    if root.name == "images" and find_models(root.parent):
        raise InputError(
            f"{root} holds pictures alone, and {root.parent} a model too: colmap-tco densify {root.parent}"
        )
    _check_version(config)
    folder = find_images(root, image_path)
    names = _readable(folder, list_images(folder, recursive=folder != root))
    scratch = root / ".sparse-tco.partial"
    shutil.rmtree(scratch, ignore_errors=True)
    (scratch / "sparse").mkdir(parents=True)
    log.info("no sparse model in %s: mapping %d images of %s", root, len(names), folder)
    _reconstruct(_Job(folder, names, scratch, num_threads, seed), config, progress or Progress())
    if (root / "database.db").exists():
        log.info("%s is left as it is", root / "database.db")
    else:
        os.replace(scratch / "database.db", root / "database.db")
    os.replace(scratch / "sparse", sparse)
    shutil.rmtree(scratch)
    return find_models(root)


def _check_version(config: MappingConfig) -> None:
    lacking = None
    if config.mapper == "global" and not _pycolmap.has_global_mapper():
        lacking = "--mapper global"
    if config.matcher == "retrieval" and not _pycolmap.can_match_pairs():
        lacking = "--matcher retrieval"
    if lacking:
        raise MissingError(f"{lacking} needs pycolmap 4.0 or later; install it with pip install -U pycolmap")


def _readable(folder: Path, names: list[str]) -> list[str]:
    """The names whose files can be decoded to their end."""
    faults = {}
    for name in names:
        try:
            decoded_size(folder / name)
        except InputError as error:
            faults[name] = str(error)
    if faults:
        log.warning("%d of %d images are skipped:\n%s", len(faults), len(names), listing(faults))
    good = [name for name in names if name not in faults]
    if len(good) < 2:
        raise InputError(f"{folder}: {len(good)} readable images; a reconstruction needs at least two")
    return good


def _camera_groups(job: _Job) -> list[list[str]]:
    """Names by size, make, model and focal length, as far as EXIF tells."""
    from PIL import ExifTags, Image

    groups: dict[tuple[object, ...], list[str]] = {}
    for name in job.names:
        with Image.open(job.folder / name) as image:
            exif = image.getexif()
            focal = exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLength)
            make, model = exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model)
            groups.setdefault((image.size, make, model, focal), []).append(name)
    return list(groups.values())


def _reconstruct(job: _Job, config: MappingConfig, progress: Progress) -> None:
    progress.stage("features", len(job.names))
    share = config.cameras == "shared"
    with _watched(job, "SELECT COUNT(*) FROM keypoints", progress):
        for names in _camera_groups(job) if share else [job.names]:
            _pycolmap.extract_features(job.database, job.folder, names, share, job.threads, job.seed)
    log.info("%d features in %d images", _asked(job, "SELECT SUM(rows) FROM keypoints"), len(job.names))
    _require_features(job)
    _match(job, config, progress)
    progress.stage("mapping", len(job.names))
    inputs, output = (job.database, job.folder), job.scratch / "sparse"

    def registered() -> None:
        progress.advance(1 if progress.done else 3)  # the first two come without a call

    use_global = config.mapper == "global"
    if not _pycolmap.run_mapper(inputs, output, use_global, job.threads, job.seed, registered):
        all_pairs = _choose_matcher(config.matcher, len(job.names)) == "exhaustive"
        more = "" if all_pairs else "; --matcher exhaustive tries all pairs"
        few = " Two or three are often too few." if len(job.names) <= 3 else ""
        raise InputError(
            f"{job.folder}: COLMAP found no reconstruction in {len(job.names)} images. They need texture, "
            f"much overlap, and a camera that moves sideways{more}.{few}"
        )


def _match(job: _Job, config: MappingConfig, progress: Progress) -> None:
    """Match the features of all pairs, or of those that are likely to overlap."""
    matcher, count = _choose_matcher(config.matcher, len(job.names)), len(job.names)
    pairs, overlap, total = None, None, count * (count - 1) // 2
    if matcher == "retrieval":
        pairs = _retrieve(job, config)
        total = len(pairs.read_text("utf-8").splitlines())
    elif matcher == "sequential":
        overlap, total = config.overlap, min(total, config.overlap * count)
    log.info("matching: %s", matcher)
    progress.stage("matching", total)
    with _watched(job, "SELECT COUNT(*) FROM two_view_geometries", progress):
        if pairs:
            _pycolmap.match_pairs(job.database, pairs, job.threads, job.seed)
        else:
            _pycolmap.match(job.database, job.threads, job.seed, overlap)
    told = [_asked(job, f"SELECT COUNT(*) FROM two_view_geometries{x}") for x in (" WHERE rows > 0", "")]
    log.info("%d of %d pairs of images match", *told)


@contextmanager
def _watched(job: _Job, query: str, progress: Progress) -> Iterator[None]:
    """Tell the progress, now and then, how many rows of the database COLMAP has written.

    COLMAP works in this thread, the only one that Ctrl-C reaches; another looks. It reads what lies on the
    disk, some megabytes behind, and takes no locks: COLMAP aborts the process where it finds one.
    """
    over = Event()

    def look() -> None:
        while not over.wait(LOOK_AGAIN):
            count = _asked(job, query, "immutable=1")
            if count > progress.done:
                progress.reach(count)

    watcher = Thread(target=look, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()
    progress.reach(_asked(job, query))


def _asked(job: _Job, query: str, how: str = "mode=ro") -> int:
    """The number that the database answers; 0 while it cannot, since it is being written."""
    try:
        with closing(_read_only(job.database, how)) as connection:
            return int(connection.execute(query).fetchone()[0] or 0)
    except sqlite3.DatabaseError:
        return 0


def _read_only(database: Path, how: str = "mode=ro") -> sqlite3.Connection:
    return sqlite3.connect(f"{database.absolute().as_uri()}?{how}", uri=True)


def _require_features(job: _Job) -> None:
    """Before pycolmap 4, matching images without features aborts the process."""
    features = [len(part) for part in largest_descriptors(job.database, count=2)[1]]
    if sum(count > 1 for count in features) < 2:
        raise InputError(
            f"{job.folder}: COLMAP found no features in these images; they are blank or very small"
        )


def _choose_matcher(matcher: str, count: int) -> str:
    if matcher != "auto":
        return matcher
    if count <= EXHAUSTIVE_UP_TO:
        return "exhaustive"
    if _pycolmap.can_match_pairs():
        return "retrieval"
    log.warning("pycolmap 4.0 could choose similar pairs; this version matches all pairs of %d images", count)
    return "exhaustive"


def _retrieve(job: _Job, config: MappingConfig) -> Path:
    """Write the list of pairs to match, two names a line, and return its path."""
    names, descriptors = largest_descriptors(job.database)
    pairs = choose_pairs(similarity(descriptors), config.num_similar, config.overlap)
    path = job.scratch / "pairs.txt"
    path.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in pairs), encoding="utf-8")
    log.info("%d of %d pairs look similar", len(pairs), len(names) * (len(names) - 1) // 2)
    return path


def largest_descriptors(database: Path, count: int = 192) -> tuple[list[str], list[NDArray[np.float32]]]:
    """Names, ordered, and unit descriptors (n ≤ count, 128) of each image's features of largest scale.

    Large features are few, repeatable, and seen from everywhere: they tell cheaply whether two images
    overlap (preemptive matching, Wu 2013). They are read from COLMAP's SQLite tables, which are the
    same in all versions: keypoints hold x, y, then scale and orientation or a 2 × 2 matrix.
    """
    names, descriptors = [], []
    query = (
        "SELECT images.name, keypoints.rows, keypoints.cols, keypoints.data, descriptors.data FROM images "
        "JOIN keypoints USING (image_id) JOIN descriptors USING (image_id) ORDER BY images.name"
    )
    with closing(_read_only(database)) as connection:
        for name, rows, cols, keypoints, features in connection.execute(query):
            shape = np.frombuffer(keypoints or b"", np.float32).reshape(rows, cols)
            scale = (
                shape[:, 2] if cols == 4 else np.abs(shape[:, 2] * shape[:, 5] - shape[:, 3] * shape[:, 4])
            )
            best = np.argsort(-scale, kind="stable")[:count]
            chosen = np.frombuffer(features or b"", np.uint8).reshape(rows, 128)[best].astype(np.float32)
            names.append(name)
            descriptors.append(chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), 1e-6))
    return names, descriptors


def similarity(descriptors: Sequence[NDArray[np.float32]], ratio: float = 0.8) -> Ints:
    """Number of ratio-test matches (V, V) between the descriptors (n, 128) of every two images, symmetric."""
    size = len(descriptors)
    counts = np.zeros((size, size), np.int64)
    for b, target in enumerate(descriptors):
        if len(target) < 2:
            continue
        for start in range(0, size, _BLOCK):
            block = descriptors[start : start + _BLOCK]
            cosine = np.concatenate(block) @ target.T
            top = np.partition(cosine, -2, axis=1)[:, -2:]
            near, next_near = (np.sqrt(np.maximum(2 - 2 * top[:, k], 0)) for k in (1, 0))
            owner = np.repeat(np.arange(start, start + len(block)), [len(d) for d in block])
            counts[b] += np.bincount(owner[near < ratio * next_near], minlength=size)
    np.fill_diagonal(counts, 0)
    return counts + counts.T


def choose_pairs(counts: Ints, num_similar: int, overlap: int) -> list[tuple[int, int]]:
    """Pairs a < b: every image with its most similar ones, and with its neighbours in name order."""
    size = len(counts)
    wanted = np.abs(np.subtract.outer(np.arange(size), np.arange(size))) <= overlap
    for a in range(size):
        best = np.argsort(-counts[a], kind="stable")[:num_similar]
        wanted[a, best[counts[a, best] > 0]] = True
    return [(int(a), int(b)) for a, b in np.argwhere(np.triu(wanted | wanted.T, 1))]
