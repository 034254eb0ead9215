"""From bare pictures to a model, with COLMAP's real programs on a small painted room."""

from __future__ import annotations

import logging
import re
import shutil
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_tco import _pycolmap, mapping
from colmap_tco.cli import configure_logging
from colmap_tco.errors import InputError
from colmap_tco.mapping import (
    MappingConfig,
    choose_pairs,
    ensure_model,
    largest_descriptors,
    similarity,
)
from colmap_tco.progress import Progress
from colmap_tco.workspace import find_models, open_workspace

SIZE = (288, 216)
K = np.array([[260.0, 0, 144], [0, 260.0, 108], [0, 0, 1]])


def paint(rng: np.random.Generator) -> np.ndarray:
    """A texture with corners at many scales."""
    canvas = np.full((700, 700, 3), 128, np.uint8)
    for _ in range(900):
        centre = tuple(rng.integers(0, 700, 2).tolist())
        colour = rng.integers(0, 256, 3).tolist()
        size = int(rng.integers(3, 28))
        if rng.random() < 0.5:
            cv2.circle(canvas, centre, size, colour, -1, cv2.LINE_AA)
        else:
            box = cv2.boxPoints((centre, (2.0 * size, float(size)), float(rng.uniform(0, 180))))
            cv2.fillConvexPoly(canvas, box.astype(np.int32), colour, cv2.LINE_AA)
    return canvas


def render(eye: np.ndarray, walls: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Walls z = const or x = const seen from ``eye``, by homographies, far ones first."""
    picture = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    for texture, corners in walls:
        local = (corners - eye) @ K.T
        target = (local[:, :2] / local[:, 2:]).astype(np.float32) - 0.5
        source = np.array([[0, 0], [699, 0], [699, 699], [0, 699]], np.float32)
        H = cv2.getPerspectiveTransform(source, target)
        warped = cv2.warpPerspective(texture, H, SIZE, flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.full((700, 700), 255, np.uint8), H, SIZE) > 250
        picture[inside] = warped[inside]
    return picture


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five pictures of a slanted wall and two boards before it, from a camera that moves sideways."""
    rng = np.random.default_rng(0)
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    slanted = square @ [[1, 0, 0.35], [0, 1, 0.2], [0, 0, 1]]
    walls = [
        (paint(rng), slanted * 5 + [0, 0, 7]),
        (paint(rng), slanted * [0.9, 0.9, -1.2] + [-0.9, 0.3, 4]),
        (paint(rng), slanted * 0.8 + [1.0, -0.4, 3.2]),
    ]
    folder = tmp_path_factory.mktemp("bare") / "images"
    folder.mkdir()
    for i, x in enumerate(np.linspace(-1.2, 1.2, 5)):
        cv2.imwrite(str(folder / f"{i}.png"), render(np.array([x, 0.15 * (i % 2), 0.1 * i]), walls))
    return folder


@pytest.fixture(scope="module")
def mapped(pictures: Path) -> Path:
    """The folder of the pictures, mapped with the defaults on one thread."""
    ensure_model(pictures.parent, num_threads=1)
    return pictures.parent


def test_bare_pictures_become_a_workspace(mapped: Path) -> None:
    workspace = open_workspace(mapped)
    assert len(workspace.images) == 5
    assert len(workspace.model.points3D) > 100
    assert len(workspace.model.cameras) == 1
    assert (mapped / "database.db").is_file()
    assert {path.name for path in mapped.iterdir()} == {"images", "sparse", "database.db"}
    centres = np.stack([-e.cam_from_world[:, :3].T @ e.cam_from_world[:, 3] for e in workspace.images])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert steps / steps.mean() == pytest.approx(np.ones(4), abs=0.1)


def compared(root: Path) -> set[tuple[int, int]]:
    """Pairs of pictures, as they are numbered in their names, that were matched."""
    with closing(sqlite3.connect(root / "database.db")) as database:
        names = dict(database.execute("SELECT image_id, name FROM images"))
        pairs = database.execute("SELECT pair_id FROM two_view_geometries").fetchall()
    # COLMAP's key of a pair: the smaller id times the largest possible, plus the other.
    ids = [(pair // 2147483647, pair % 2147483647) for (pair,) in pairs]
    found = [sorted(int(Path(names[i]).stem) for i in pair) for pair in ids]
    return {(a, b) for a, b in found}


def test_pictures_beside_the_model_to_be_and_neighbours_in_name_order(pictures: Path, tmp_path: Path) -> None:
    """Bare pictures in the workspace itself; each is compared with the next alone, as in a video."""
    for picture in pictures.iterdir():
        shutil.copy(picture, tmp_path / picture.name)
    ensure_model(tmp_path, config=MappingConfig(matcher="sequential", overlap=1), num_threads=1)
    assert compared(tmp_path) == {(i, i + 1) for i in range(4)}
    workspace = open_workspace(tmp_path)
    assert workspace.image_folder == tmp_path
    assert len(workspace.images) >= 4


@pytest.mark.parametrize(("cameras", "expected"), [("shared", 2), ("per_image", 5)])
def test_pictures_of_one_size_share_a_camera_or_not(
    pictures: Path, tmp_path: Path, cameras: str, expected: int
) -> None:
    """Two of the five are smaller, as from another camera."""
    (tmp_path / "images").mkdir()
    for i in range(5):
        picture = cv2.imread(str(pictures / f"{i}.png"))
        if i in (1, 3):
            picture = cv2.resize(picture, (240, 180), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), picture)
    ensure_model(tmp_path, config=MappingConfig(cameras=cameras), num_threads=1)
    workspace = open_workspace(tmp_path)
    assert len(workspace.images) == 5 and not workspace.skipped  # each of the size of its camera
    assert len({entry.camera.camera_id for entry in workspace.images}) == expected
    for entry in workspace.images:
        small = entry.name in ("1.png", "3.png")
        assert _pycolmap.camera_size(entry.camera) == ((240, 180) if small else SIZE)


def test_every_phase_says_what_it_found_and_moves_the_bar(
    pictures: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "images").symlink_to(pictures)
    progress = Progress(interval=0.0)
    with caplog.at_level(logging.INFO, "colmap_tco"):
        ensure_model(tmp_path, num_threads=1, progress=progress)
    told = [record.__dict__["data"] for record in caplog.records if "data" in record.__dict__]
    furthest = {entry["stage"]: (entry["done"], entry["total"]) for entry in told}
    assert list(furthest) == ["features", "matching", "mapping"]
    assert list(furthest.values()) == [(5, 5), (10, 10), (5, 5)]
    assert re.search(r"\d{4} features in 5 images", caplog.text)
    assert "10 of 10 pairs of images match" in caplog.text


def test_the_bar_follows_a_database_that_is_being_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a lock on it: whoever writes may take it as a whole at any time."""
    monkeypatch.setattr(mapping, "LOOK_AGAIN", 0.002)
    job = mapping._Job(tmp_path, [], tmp_path, 1, 0)
    progress = Progress()
    progress.stage("features", 40)
    seen = []
    with mapping._watched(job, "SELECT COUNT(*) FROM keypoints", progress):
        writer = sqlite3.connect(job.database, isolation_level=None, timeout=0)
        writer.execute("CREATE TABLE keypoints (rows INTEGER)")
        for _ in range(40):
            writer.execute("BEGIN EXCLUSIVE")
            writer.execute("INSERT INTO keypoints VALUES (7)")
            writer.execute("COMMIT")
            time.sleep(0.005)
            seen.append(progress.done)
        writer.close()
    assert seen == sorted(seen) and len(set(seen)) > 2
    assert progress.done == 40


@pytest.mark.parametrize(("verbosity", "log_json", "level"), [(0, False, 2), (1, False, 0), (1, True, 2)])
def test_colmaps_own_log_is_shown_where_asked_for(verbosity: int, log_json: bool, level: int) -> None:
    configure_logging(verbosity, log_json)
    log = _pycolmap.load().logging
    before = log.minloglevel
    try:
        _pycolmap.load.__wrapped__()
        assert log.minloglevel == level
    finally:
        log.minloglevel = before


def test_a_model_that_is_there_is_left_alone(mapped: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in mapped.rglob("*")}
    assert ensure_model(mapped) == find_models(mapped)
    assert {path: path.stat().st_mtime_ns for path in mapped.rglob("*")} == before


def test_similar_pictures_of_a_real_database(mapped: Path) -> None:
    names, descriptors = largest_descriptors(mapped / "database.db", count=100)
    assert names == [f"{i}.png" for i in range(5)]
    assert all(part.shape == (100, 128) for part in descriptors)
    assert all(np.allclose(np.linalg.norm(part, axis=1), 1, atol=1e-3) for part in descriptors)
    counts = similarity(descriptors)
    noise = np.abs(np.random.default_rng(0).normal(size=(100, 128))).astype(np.float32)
    noise /= np.linalg.norm(noise, axis=1, keepdims=True)
    stranger = similarity([*descriptors, noise])[5, :5].max()
    assert np.array_equal(counts, counts.T)
    assert counts[0, 1] > 5 * max(stranger, 1)


@pytest.mark.skipif(not _pycolmap.can_match_pairs(), reason="retrieval needs pycolmap 4.0")
def test_retrieval_and_the_global_mapper_beside_the_users_database(pictures: Path, tmp_path: Path) -> None:
    (tmp_path / "images").symlink_to(pictures)
    (tmp_path / "database.db").write_bytes(b"the user's")
    config = MappingConfig(matcher="retrieval", mapper="global", overlap=1, num_similar=3)
    ensure_model(tmp_path, config=config, num_threads=1)
    assert len(open_workspace(tmp_path).images) == 5
    assert (tmp_path / "database.db").read_bytes() == b"the user's"
    assert not (tmp_path / ".sparse-tco.partial").exists()


def test_similarity_counts_ratio_test_matches() -> None:
    """Vectors along axes match themselves. One halfway between two axes is as near to both, so it matches
    neither; seen from either axis it is the nearest by far, so each of the two matches it."""
    axes = np.eye(8, dtype=np.float32)
    between = ((axes[0] + axes[1]) / np.sqrt(2))[None]
    counts = similarity([axes[:4], axes[2:6], axes[6:], np.concatenate([between, axes[7:]])])
    assert counts[0, 1] == 4
    assert counts[0, 2] == 0
    assert counts[2, 3] == 2
    assert counts[0, 3] == 2


def test_pairs_are_the_most_similar_and_the_neighbours() -> None:
    counts = np.zeros((6, 6), int)
    counts[0, 4] = counts[4, 0] = 9
    counts[0, 3] = counts[3, 0] = 5
    neighbours = [(i, i + 1) for i in range(5)]
    assert choose_pairs(counts, 1, 1) == sorted([*neighbours, (0, 4), (0, 3)])
    assert choose_pairs(counts, 1, 0) == [(0, 3), (0, 4)]
    assert choose_pairs(np.zeros((6, 6), int), 3, 1) == neighbours


def test_what_cannot_be_mapped_is_said(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for i in range(2):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), np.full((60, 80, 3), 99, np.uint8))
    with pytest.raises(InputError, match="no features"):
        ensure_model(tmp_path, num_threads=1)
    for i in range(2):
        noise = np.random.default_rng(i).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), noise)
    with pytest.raises(InputError, match="no reconstruction in 2 images"):
        ensure_model(tmp_path, num_threads=1)
    assert not (tmp_path / "sparse").exists()
    (tmp_path / "images" / "1.png").write_bytes(b"broken")
    with pytest.raises(InputError, match="1 readable images"):
        ensure_model(tmp_path, num_threads=1)
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse" / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match="not empty"):
        ensure_model(tmp_path, num_threads=1)


def test_the_database_is_only_read(mapped: Path) -> None:
    before = (mapped / "database.db").read_bytes()
    largest_descriptors(mapped / "database.db")
    assert (mapped / "database.db").read_bytes() == before
    with pytest.raises(sqlite3.OperationalError):
        largest_descriptors(mapped / "none.db")


def test_the_folder_of_pictures_of_a_workspace_is_no_workspace(mapped: Path) -> None:
    """The folder above was meant; nothing is mapped anew, and nothing written beside the pictures."""
    before = sorted((mapped / "images").rglob("*"))
    with pytest.raises(InputError, match=f"colmap-tco densify {mapped}$"):
        ensure_model(mapped / "images", num_threads=1)
    assert sorted((mapped / "images").rglob("*")) == before
