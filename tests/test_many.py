"""The survey that ``benchmarks/many.py`` makes: evenly flown, and seen as its model says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.many import KEYPOINT_NOISE, SPACING, Stopwatch, flight, header, row, triangulated, write_model
from colmap_tco._pycolmap import read_model
from colmap_tco.tracks import read_tracks
from training.scenes import Sample


@pytest.mark.parametrize("views", [1, 7, 200])
def test_neighbours_are_as_far_apart_however_many_there_are(views: int) -> None:
    eyes = np.array([pose[:3, 3] for pose in flight(views)])
    assert len(eyes) == views
    steps = np.linalg.norm(np.diff(eyes[:, :2], axis=0), axis=1)
    assert np.allclose(steps, SPACING), "along a line and from its end to the next line's beginning"
    assert len(np.unique(eyes[:, :2].round(6), axis=0)) == views
    assert np.allclose(eyes[:, 0].min(), -eyes[:, 0].max()) or views == 7


def over_a_plain() -> Sample:
    """Five views of the flight of the ground z = 0, with noise for pictures."""
    h, w = 96, 128
    K = np.array([[0.8 * w, 0, w / 2], [0, 0.8 * w, h / 2], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    poses = np.array(flight(5))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    depth = np.stack([pose[2, 3] / -(rays @ pose[2, :3]) for pose in poses])
    images = np.random.default_rng(1).integers(0, 256, (5, h, w, 3), dtype=np.uint8)
    return Sample(images, depth.astype(np.float32), np.stack([K] * 5), np.linalg.inv(poses))


def test_the_model_is_that_of_the_pictures(tmp_path: Path) -> None:
    """Points on the surfaces, seen by three views or more, their keypoints off by the noise alone."""
    sample = over_a_plain()
    names = [f"{i}.jpg" for i in range(5)]
    write_model(sample, names, tmp_path / "sparse", np.random.default_rng(0))
    model = read_model(tmp_path / "sparse")
    assert sorted(image.name for image in model.images.values()) == names
    tracks = read_tracks(model)
    assert len(tracks.ids) > 30 and tracks.length.min() >= 3
    error = np.concatenate([seen.error for seen in tracks.images.values()])
    # The distance of two normal numbers: its mean square is twice the variance of each.
    assert np.sqrt((error**2).mean() / 2) == pytest.approx(KEYPOINT_NOISE, rel=0.1)
    xyz, seen = triangulated(sample, np.random.default_rng(0))
    assert seen.shape == (5, len(xyz)) and (seen.sum(0) >= 3).all()


def test_stages_take_all_the_time_and_the_table_has_their_columns() -> None:
    watch = Stopwatch()
    for stage in ("workspace", "optimisation"):
        watch.stage(stage, 1)
        sum(i * i for i in range(20_000))
    assert list(watch.seconds()) == ["workspace", "optimisation"]
    assert sum(watch.seconds().values()) > 0
    figures = {
        "seconds": {"workspace": 2.0, "fusion": 8.0},
        "peak": 2.5e9,
        "chunks": 1,
        "used": 5,
        "points": 9,
    }
    cells = row(5, figures)
    assert cells == "| 5 | 5 | 1 | 2.0 | 0.0 | 8.0 | 0.0 | 10 | 2.00 | 2.50 | 9 |"
    assert cells.count("|") == header().splitlines()[0].count("|") == header().splitlines()[1].count("|")
