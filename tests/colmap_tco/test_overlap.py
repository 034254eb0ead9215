"""What views tell of each other's depths: counted, weighed, and in the order of what each adds."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_tco.overlap import OVERLAPS, overlap

Floats = NDArray[np.float64]


def scene(seed: int, views: int = 7, count: int = 60) -> tuple[list[NDArray[np.int64]], Floats, Floats]:
    """Cameras on a wobbly line, points about four metres before it, of which each sees some."""
    rng = np.random.default_rng(seed)
    centres = np.stack([np.arange(views) * 0.2, *rng.normal(0, 0.1, (2, views))], 1)
    xyz = rng.normal([0.6, 0, 4], [1, 1, 0.5], (count, 3))
    return [np.flatnonzero(rng.random(count) < 0.5) for _ in range(views)], centres, xyz


def worths(i: int, points: list[NDArray[np.int64]], centres: Floats, xyz: Floats) -> dict[int, Floats]:
    """View → root of MVSNet's weight of each point of view i that it sees, 0 of the others."""
    found = {}
    for j in range(len(points)):
        worth = np.zeros(len(points[i]))
        for n, p in enumerate(points[i]):
            if j != i and p in points[j]:
                a, b = centres[i] - xyz[p], centres[j] - xyz[p]
                angle = math.degrees(math.acos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))
                worth[n] = math.exp(-((angle - 5) ** 2) / (4 if angle <= 5 else 400))
        found[j] = worth
    return found


@pytest.mark.parametrize("seed", range(4))
def test_the_next_view_is_the_one_that_adds_most(seed: int) -> None:
    """Rows are those of trying all views each time; they add up to what all tell together."""
    points, centres, xyz = scene(seed)
    told = overlap(points, centres, xyz)
    for i in range(len(points)):
        worth, known, left = worths(i, points, centres, xyz), 1.0, {*range(len(points))} - {i}
        last = math.inf
        while left:
            added = {j: float(np.log((known + worth[j]) / known).sum()) for j in left}
            best = max(left, key=lambda j: added[j])
            assert told[i, best] == pytest.approx(added[best], rel=1e-9)
            assert told[i, best] <= last + 1e-12
            known, last = known + worth[best], told[i, best]
            left.remove(best)
        assert told[i].sum() == pytest.approx(np.log(known).sum(), rel=1e-9)
        assert told[i, i] == 0


def test_numbers_and_angles_are_sums_over_common_points() -> None:
    points, centres, xyz = scene(5)
    number, angle = (overlap(points, centres, xyz, by) for by in ("number", "angle"))
    for i in range(len(points)):
        worth = worths(i, points, centres, xyz)
        for j in {*range(len(points))} - {i}:
            assert number[i, j] == len(np.intersect1d(points[i], points[j]))
            assert angle[i, j] == pytest.approx((worth[j] ** 2).sum(), rel=1e-9)
    assert np.array_equal(number, number.T) and not number.diagonal().any()


def test_views_from_apart_come_before_neighbours_and_cover_the_whole() -> None:
    """Of view 0's points 1 sees all, from nearby; 2 and 3 the same six, from 5° away; 4 the others."""
    xyz = np.array([[0.01 * k, 0, 4] for k in range(10)])
    aside = 4 * math.tan(math.radians(5))
    centres = np.array([[0, 0, 0], [0.01, 0, 0], [aside, 0, 0], [aside, 0.01, 0], [-aside, 0, 0]])
    points = [np.arange(10), np.arange(10), np.arange(6), np.arange(6), np.arange(6, 10)]
    order = {by: np.argsort(-overlap(points, centres, xyz, by)[0], kind="stable").tolist() for by in OVERLAPS}
    assert set(order["information"][0:3:2]) == {2, 3} and order["information"][1::2] == [4, 1]
    assert set(order["angle"][:2]) == {2, 3} and order["number"][0] == 1


def test_views_that_share_nothing_tell_nothing() -> None:
    points, centres, xyz = scene(0, views=3)
    points[2] = np.setdiff1d(np.arange(len(xyz)), np.union1d(points[0], points[1]))
    for by in OVERLAPS:
        told = overlap(points, centres, xyz, by)
        assert told[0, 1] > 0 and not told[2].any() and not told[:, 2].any()
    with pytest.raises(ValueError, match="information, angle, number, not by 'size'"):
        overlap(points, centres, xyz, "size")
