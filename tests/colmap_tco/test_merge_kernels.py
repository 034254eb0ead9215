"""Colours, medians and marks of the fusion against plain twins in double precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from colmap_tco import _merge_kernels
from colmap_tco._fusion_kernels import camera, pair
from colmap_tco._fusion_shelf import Shelf
from colmap_tco._vote_kernels import TILE
from colmap_tco.fusion import FusionConfig
from colmap_tco.workers import Workers
from tests.colmap_tco.test_fusion import Scene

Floats = NDArray[np.float64]
REFERENCE = np.array([60.0, 58.0, 20.5, 15.5])
OTHER_FROM_REFERENCE = np.array(
    [[0.995, 0.0, 0.0998, -0.3], [0.0, 1.0, 0.0, 0.1], [-0.0998, 0.0, 0.995, 0.2]]
)
BIT = np.uint64(1) << np.uint64(5)


def random_points(count: int, rng: np.random.Generator) -> Floats:
    """(3, M); some are beside the other view, and every ninth behind both, on the ray of one before them."""
    depth = rng.uniform(0.05, 6.0, count)
    points = np.stack([rng.uniform(-0.5, 0.5, count) * depth, rng.uniform(-0.4, 0.4, count) * depth, depth])
    points[:, ::9] *= -1.0
    return points


def projected(points: Floats, intrinsics: Floats) -> tuple[Floats, Floats]:
    """Pixels (2, M) of the points in the other view, and their depths there."""
    x, y, z = OTHER_FROM_REFERENCE[:, :3] @ points + OTHER_FROM_REFERENCE[:, 3:]
    fx, fy, cx, cy = intrinsics
    return np.stack([fx * x / z + cx, fy * y / z + cy]), z


@pytest.mark.parametrize("shape", [(31, 41), (62, 82), (1, 41), (31, 1)])
def test_colours_are_those_between_four_pixels(shape: tuple[int, int]) -> None:
    """As scipy interpolates linearly, with the border's colour outside; the points behind are left out."""
    rng = np.random.default_rng(0)
    points = random_points(3 * TILE + 17, rng)
    image = rng.integers(0, 256, (*shape, 3), np.uint8)
    scale = shape[1] / 41, shape[0] / 31
    intrinsics = np.array([50.0 * scale[0], 51.0 * scale[1], 20.0 * scale[0], 16.0 * scale[1]])
    chosen = rng.random(points.shape[1]) < 0.7
    who = np.where(chosen, BIT, np.uint64(3))
    samples = np.zeros((4, 2, 3, TILE), np.uint8)
    count = rng.integers(0, 3, points.shape[1]).astype(np.uint8)
    before = count.copy()
    both = pair(camera(REFERENCE), camera(intrinsics), OTHER_FROM_REFERENCE)
    _merge_kernels.sample_colors(points.astype(np.float32), who, BIT, both, image, samples, count)
    (u, v), z = projected(points, intrinsics)
    added = chosen & (z > 0) & (before < 2)
    assert 100 < added.sum() < (chosen & (before < 2)).sum() - 20
    np.testing.assert_array_equal(count, before + added)
    rows = np.stack([v - 0.5, u - 0.5])[:, added]
    for channel in range(3):
        want = map_coordinates(image[..., channel].astype(float), rows, order=1, mode="nearest")
        m = np.flatnonzero(added)
        got = samples[m // TILE, before[m], channel, m % TILE]
        assert np.abs(got - want).max() < 0.51


@pytest.mark.parametrize("slots", [1, 2, 7, 15])
def test_medians_are_medians(slots: int) -> None:
    rng = np.random.default_rng(slots)
    count = rng.integers(1, slots + 1, TILE + 31).astype(np.uint8)
    samples = rng.integers(0, 256, (2, slots, 3, TILE), np.uint8)
    out = np.zeros((len(count), 3), np.uint8)
    _merge_kernels.median_colors(samples, count, out)
    for m, n in enumerate(count):
        own = np.sort(samples[m // TILE, :n, :, m % TILE].astype(int), 0)
        want = (own[(n - 1) // 2] + own[n // 2] + 1) // 2
        np.testing.assert_array_equal(out[m], want)


def covered(points: Floats, depth: Floats, intrinsics: Floats, limits: Sequence[float]) -> NDArray[np.bool_]:
    """The pixels of the other view that the points cover, by the rule that ``mark_taken`` states."""
    height, width = depth.shape
    marked = np.zeros(depth.shape, bool)
    (us, vs), zs = projected(points, intrinsics)
    for u, v, z, own in zip(us, vs, zs, points[2], strict=True):
        if z <= 0 or not (0 <= u < width and 0 <= v < height):
            continue
        if limits[1] == 0:
            marked[int(v), int(u)] = True
        reach = max(0.75 * min(own / REFERENCE[0] * intrinsics[0] / z, 2.0), limits[1])
        rows, columns = np.mgrid[:height, :width] + 0.5
        near = (np.abs(columns - u) <= reach) & (np.abs(rows - v) <= reach)
        marked |= near & (np.abs(depth - z) <= limits[0] * z)
    return marked


@pytest.mark.parametrize("focal", [20.0, 50.0, 170.0])
@pytest.mark.parametrize("limits", [(0.2, 0.0), (0.2, 0.5)])
def test_marks_are_the_pixels_within_the_square_and_at_the_depth(
    focal: float, limits: tuple[float, float]
) -> None:
    rng = np.random.default_rng(1)
    points = random_points(8 * TILE + 40, rng)
    depth = rng.uniform(1.0, 6.0, (31, 41))
    intrinsics = np.array([focal, focal, 20.0, 16.0])
    chosen = rng.random(points.shape[1]) < 0.6
    taken = np.zeros(depth.shape, np.uint8)
    other = depth.astype(np.float32)
    both = pair(camera(REFERENCE), camera(intrinsics), OTHER_FROM_REFERENCE)
    who = np.where(chosen, BIT, np.uint64(0))
    _merge_kernels.mark_taken(points.astype(np.float32), who, BIT, other, both, limits, taken)
    want = covered(points[:, chosen], depth, intrinsics, limits)
    assert 30 < want.sum() < 0.9 * want.size
    np.testing.assert_array_equal(taken.astype(bool), want)


def test_views_that_no_reference_needs_any_more_are_dropped() -> None:
    """So that of a row of views, long or short, five are in memory where two neighbours on each side vote."""
    for count in (6, 12):
        row = Scene(count=count).views()
        near = [[j for j in range(i - 2, i + 3) if j != i and 0 <= j < count] for i in range(count)]
        views = [replace(view, neighbours=tuple(near[i])) for i, view in enumerate(row)]
        with Workers(1) as workers:
            shelf = Shelf(views, FusionConfig(num_threads=1), workers)
            for position in range(count):
                one = shelf.get(position).nbytes
                for other in near[position]:
                    shelf.get(other)
                shelf.finish(position)
        assert shelf.loads == count, "none is read twice"
        assert shelf.peak_bytes == 5 * one
