"""Uncertainty of points against formulas and chance, and what pairs of views share against counting."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from colmap_tco import _pycolmap
from colmap_tco.errors import InputError
from colmap_tco.tracks import PIXEL_FLOOR, Tracks, covisibility, read_tracks
from tests.conftest import Shot, write_text_model

FOCAL = 200.0


def stereo(folder: Path, baseline: float, xyz: np.ndarray, noise: float = 0.0, count: int = 2) -> Tracks:
    """``count`` parallel cameras in a row, the outermost ``baseline`` apart."""
    camera = Shot((400, 400), "SIMPLE_PINHOLE", (FOCAL, 200.0, 200.0))
    poses = np.stack(
        [np.eye(4)[:3] - [[0, 0, 0, x], [0] * 4, [0] * 4] for x in np.linspace(0, baseline, count)]
    )
    names = [f"{i}.png" for i in range(count)]
    write_text_model(folder / "model", [camera] * count, poses, xyz, noise, names)
    return read_tracks(_pycolmap.read_model(folder / "model"))


@pytest.mark.parametrize("baseline", [0.2, 1.0])
def test_depth_uncertainty_of_a_stereo_pair(baseline: float, tmp_path: Path) -> None:
    """From disparity d = f b / z: σ(z) = z² / (f b) · √2 σ(pixel), the textbook's formula."""
    tracks = stereo(tmp_path, baseline, np.array([[0.0, 0.0, 2.0], [0.3, -0.2, 5.0]]))
    z = tracks.xyz[:, 2]
    expected = z**2 / (FOCAL * baseline) * np.sqrt(2) * PIXEL_FLOOR
    assert np.allclose(np.sqrt(tracks.covariance[:, 2, 2]), expected, rtol=1e-6)


def test_covariance_is_the_scatter_of_triangulation(tmp_path: Path) -> None:
    """Gauss–Newton triangulations of noisy keypoints scatter as the covariance of the exact ones says."""
    point, sigma, count = np.array([[0.2, 0.1, 4.0]]), 0.5, 4
    tracks = stereo(tmp_path, 0.9, point, count=count)
    shift = np.linspace(0, 0.9, count)
    rng = np.random.default_rng(0)

    def project(x: np.ndarray) -> np.ndarray:
        """(T, 3) → (T, 2 count)."""
        u = FOCAL * (x[:, :1] - shift) / x[:, 2:]
        return np.concatenate([u, FOCAL * x[:, 1:2] / x[:, 2:] * np.ones(count)], 1)

    target = project(point) + sigma * rng.normal(size=(4000, 2 * count))
    x = np.repeat(point, 4000, 0)
    for _ in range(5):
        J = np.stack([(project(x + d) - project(x - d)) / 2e-5 for d in 1e-5 * np.eye(3)], -1)
        Jt = np.swapaxes(J, 1, 2)
        x = x + np.linalg.solve(Jt @ J, Jt @ (target - project(x))[..., None])[..., 0]
    empirical = np.cov(x.T)
    assert np.allclose(empirical, tracks.covariance[0] * (sigma / PIXEL_FLOOR) ** 2, rtol=0.1, atol=1e-4)


def test_the_residual_sets_the_scale(tmp_path: Path) -> None:
    """With many noisy tracks, the keypoint error in the covariance is the noise that was put in."""
    xyz = np.random.default_rng(1).uniform([-1, -1, 4], [1, 1, 6], (300, 3))
    exact = stereo(tmp_path / "exact", 0.9, xyz, count=5)
    noisy = stereo(tmp_path / "noisy", 0.9, xyz, noise=1.0, count=5)
    ratio = np.sqrt(noisy.covariance[:, 2, 2] / exact.covariance[:, 2, 2]) * PIXEL_FLOOR
    # Points are the true ones here, not refitted to the noise, which (2n − 3) / 2n would correct for.
    assert np.median(ratio) == pytest.approx(np.sqrt((10 + 4) / (7 + 4)), rel=0.1)


def test_observations_that_contradict_the_model_are_dropped(tmp_path: Path) -> None:
    xyz = np.random.default_rng(1).uniform([-1, -1, 4], [1, 1, 6], (50, 3))
    good = stereo(tmp_path, 0.9, xyz, noise=0.2, count=3)
    points = tmp_path / "model" / "points3D.txt"
    lines = points.read_text(encoding="utf-8").splitlines()
    first, second = lines[0].split(), lines[1].split()
    first[1:4], second[3] = ["9.0", "9.0", "5.0"], "-4.0"
    points.write_text("\n".join([" ".join(first), " ".join(second), *lines[2:]]) + "\n", encoding="utf-8")
    tracks = read_tracks(_pycolmap.read_model(tmp_path / "model"))
    assert len(tracks.ids) == len(good.ids) - 2
    assert set(good.ids) - set(tracks.ids) == {1, 2}
    assert list(tracks.dropped.values()) == [3, 3, 0]


def test_a_model_of_nonsense_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no 3D point"):
        stereo(tmp_path, 0.9, np.array([[0.1, 0.1, 4.0]]), count=1)


def test_common_points_and_scores_are_what_counting_gives(
    make_workspace: Callable[..., Path], tmp_path: Path
) -> None:
    tracks = read_tracks(_pycolmap.read_model(make_workspace(tmp_path, noise=0.1) / "sparse" / "0"))
    ids = sorted(tracks.images)
    pairs = covisibility(tracks, ids)
    for a, i in enumerate(ids):
        for b, j in enumerate(ids):
            both = (
                np.intersect1d(tracks.images[i].point, tracks.images[j].point) if a != b else np.zeros(0, int)
            )
            to_a, to_b = (tracks.centres[k] - tracks.xyz[both] for k in (i, j))
            cosine = (to_a * to_b).sum(1) / np.linalg.norm(to_a, axis=1) / np.linalg.norm(to_b, axis=1)
            angle = np.degrees(np.arccos(cosine))
            score = sum(np.exp(-((t - 5) ** 2) / (2 if t <= 5 else 200)) for t in angle)
            assert pairs.common[a, b] == len(both)
            assert pairs.score[a, b] == pytest.approx(score, rel=1e-9)


def test_real_models_are_read_whole(shared: Path) -> None:
    tracks = read_tracks(_pycolmap.read_model(shared / "data" / "office" / "sparse" / "2"))
    assert len(tracks.ids) == 750
    assert len(tracks.images) == 15
    assert sum(len(seen.xy) for seen in tracks.images.values()) == tracks.length.sum()
    assert np.isfinite(tracks.covariance).all()
