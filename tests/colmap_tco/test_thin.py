"""Thinning: one point a cube, as many as allowed, evenly spread, and the lists of views stay with them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_tco.errors import InputError
from colmap_tco.ply import Cloud, Visibility
from colmap_tco.thin import thin

Floats = NDArray[np.float64]


def uneven(count: int = 20_000) -> Floats:
    """Points on a wavy sheet, ten times as dense on one half as on the other."""
    rng = np.random.default_rng(0)
    x = np.where(rng.random(count) < 10 / 11, rng.uniform(0, 1, count), rng.uniform(1, 2, count))
    y = rng.uniform(0, 1, count)
    return np.stack([x, y, 0.1 * np.sin(5 * x)], 1)


def cubes(points: Floats, size: float) -> NDArray[np.int64]:
    return np.floor((points - uneven().min(0)) / size).astype(np.int64)


@pytest.mark.parametrize("size", [0.02, 0.1, 5.0])
def test_every_cube_that_has_points_keeps_exactly_one(size: float) -> None:
    points = uneven()
    kept = thin(points, size)
    occupied = np.unique(cubes(points, size), axis=0)
    assert (np.diff(kept) > 0).all()
    assert len(kept) == len(occupied)
    assert np.array_equal(np.unique(cubes(points[kept], size), axis=0), occupied)


def test_it_is_the_point_nearest_to_the_middle() -> None:
    points = np.array([[0.0, 0, 0], [0.3, 0, 0], [0.9, 0, 0], [5.0, 0, 0]])
    assert thin(points, 1.0).tolist() == [1, 3]


@pytest.mark.parametrize("most", [1, 17, 500, 4000, 15_000])
def test_nearly_as_many_points_as_allowed_stay(most: int) -> None:
    kept = thin(uneven(), 0.0, most)
    assert 0.9 * most - 2 <= len(kept) <= most


@pytest.mark.parametrize("most", [700, 2000, 7999, 12_000])
def test_of_a_lattice_nearly_as_many_stay_and_are_spread_evenly(most: int) -> None:
    """Cubes leave an eighth of it, or all: between the two every cube gets more of its points in turn."""
    side = 25
    points = np.stack(np.meshgrid(*[np.arange(side)] * 3), -1).reshape(-1, 3).astype(float)
    kept = thin(points, 0.0, most)
    assert 0.9 * most <= len(kept) <= most
    assert (np.diff(kept) > 0).all()
    assert np.array_equal(kept, thin(points, 0.0, most))
    octant = (points[kept] >= side / 2) @ [1, 2, 4]
    share = np.bincount(octant, minlength=8) / len(kept)
    assert share.min() > 0.7 / 8 and share.max() < 1.4 / 8
    assert cKDTree(points[kept]).query(points)[0].max() <= np.sqrt(3) * (side**3 / len(kept)) ** (1 / 3)


def test_both_limits_hold_together() -> None:
    assert len(thin(uneven(), 0.1, 10_000)) == len(thin(uneven(), 0.1))
    assert len(thin(uneven(), 0.02, 300)) <= 300


def test_what_stays_is_spread_evenly() -> None:
    """Both halves of the sheet keep as much, and no point is far from one that stays."""
    points = uneven()
    left = points[thin(points, 0.0, 800)]
    share = (left[:, 0] < 1).mean()
    assert 0.45 < share < 0.55  # of all points, 0.91
    side = np.sqrt(2.1 / len(left))  # of the cubes, roughly: they hold the sheet's area
    assert cKDTree(left).query(points)[0].max() < 2 * np.sqrt(3) * side


def test_enough_room_changes_nothing() -> None:
    for limits in ((0.0, 0), (0.0, 20_000), (1e-6, 0)):
        assert np.array_equal(thin(uneven(), *limits), np.arange(20_000))
    assert len(thin(np.zeros((0, 3)), 1.0, 5)) == 0
    assert thin(np.ones((9, 3)), 0.0, 4).tolist() == [0]


def test_moving_the_model_moves_the_result() -> None:
    points = np.round(uneven() * 2**20) / 2**20  # exact sums
    assert np.array_equal(thin(points + [2**19, 2**22, 256], 0.05, 700), thin(points, 0.05, 700))


def test_cubes_too_small_to_count_are_refused() -> None:
    with pytest.raises(InputError, match="voxel_size 1e-12 is too small"):
        thin(uneven(), 1e-12)


def test_points_keep_their_colours_and_views() -> None:
    rng = np.random.default_rng(1)
    lists = [rng.integers(0, 50, rng.integers(0, 6)).astype(np.uint32) for _ in range(200)]
    start = np.concatenate([[0], np.cumsum([len(one) for one in lists])]).astype(np.int64)
    points, colors = rng.normal(size=(200, 3)), rng.integers(0, 256, (200, 3), dtype=np.uint8)
    cloud = Cloud(points, points.astype(np.float32), colors, Visibility(start, np.concatenate(lists)))
    kept = thin(points, 0.7)
    part = cloud.select(kept)
    assert 0 < len(part) < 200
    assert np.array_equal(part.colors, colors[kept]) and np.array_equal(part.points, points[kept])
    assert len(part.visibility) == len(kept)
    for i, original in enumerate(kept):
        assert part.visibility[i].tolist() == lists[original].tolist()
