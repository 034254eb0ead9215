"""Distances, normals and F-scores of clouds whose distances are known, and of others by brute force."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_tco.evaluation.points import (
    compare_clouds,
    estimate_normals,
    f_curve,
    f_score,
    voxel_down_sample,
)

Floats = NDArray[np.float64]


def plane(z: float, side: int = 30) -> Floats:
    """A square grid of unit side at height z."""
    x, y = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side))
    return np.stack([x, y, np.full_like(x, z)], -1).reshape(-1, 3)


def sphere(radius: float, count: int = 2000) -> Floats:
    """Points spread evenly over a sphere (Fibonacci's spiral)."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z**2)
    return radius * np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)


def test_a_shifted_plane_is_off_by_the_shift_and_has_the_same_normals() -> None:
    figures = compare_clouds(plane(0.01), plane(0))
    for name in ("accuracy_mean", "accuracy_median", "completion_mean", "completion_median"):
        assert getattr(figures, name) == pytest.approx(0.01)
    assert figures.normal_consistency_mean == pytest.approx(1)
    assert figures.normal_consistency_median == pytest.approx(1)


def test_a_missing_half_harms_completion_alone() -> None:
    truth = plane(0, 41)
    figures = compare_clouds(truth[truth[:, 1] <= 0.5], truth)
    assert figures.accuracy_mean == 0
    missing = np.maximum(truth[:, 1] - 0.5, 0)
    assert figures.completion_mean == pytest.approx(missing.mean())
    assert figures.completion_median == pytest.approx(np.median(missing))


def test_spheres_of_two_radii_are_as_far_apart_as_these() -> None:
    figures = compare_clouds(sphere(1.05), sphere(1))
    assert figures.accuracy_mean == pytest.approx(0.05, rel=1e-9)
    assert figures.completion_median == pytest.approx(0.05, rel=1e-9)
    assert figures.normal_consistency_mean > 0.999
    radial = np.abs((estimate_normals(sphere(1)) * sphere(1)).sum(1))
    assert radial.min() > 0.99


@pytest.mark.parametrize("degrees", [0.0, 25.0, 60.0])
def test_normal_consistency_is_the_cosine_of_the_angle_whatever_the_sign(degrees: float) -> None:
    points = plane(0)
    up = np.tile([0.0, 0, 1], (len(points), 1))
    tilted = Rotation.from_euler("x", degrees, degrees=True).apply(up)
    tilted[::2] *= -1
    figures = compare_clouds(points, points, tilted, up)
    cosine = np.cos(np.radians(degrees))
    for name in ("nc1_mean", "nc1_median", "nc2_mean", "nc2_median", "normal_consistency_mean"):
        assert getattr(figures, name) == pytest.approx(cosine)


def test_each_direction_takes_the_normal_of_its_own_neighbour() -> None:
    """Two points near one true point, and a true point that both directions see differently."""
    points, truth = np.array([[0.0, 0, 0], [0.1, 0, 0]]), np.array([[0.0, 0, 0], [9, 0, 0]])
    x, z = [1.0, 0, 0], [0.0, 0, 1]
    figures = compare_clouds(points, truth, np.array([x, z]), np.array([x, z]))
    assert (figures.nc1_mean, figures.nc2_mean) == (0.5, 1.0)  # (x·x, z·x), (x·x, z·z)
    assert figures.normal_consistency_mean == 0.75


def test_random_clouds_as_by_brute_force() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(200, 3)), rng.normal(size=(150, 3))
    na, nb = (Rotation.random(k, rng=rng).apply([0, 0, 1.0]) for k in (200, 150))
    d = np.linalg.norm(a[:, None] - b[None], axis=2)
    figures = compare_clouds(a, b, na, nb)
    assert figures.accuracy_mean == pytest.approx(d.min(1).mean())
    assert figures.accuracy_median == pytest.approx(np.median(d.min(1)))
    assert figures.completion_mean == pytest.approx(d.min(0).mean())
    assert figures.completion_median == pytest.approx(np.median(d.min(0)))
    nc1 = np.abs((na * nb[d.argmin(1)]).sum(1))
    nc2 = np.abs((nb * na[d.argmin(0)]).sum(1))
    assert figures.nc1_mean == pytest.approx(nc1.mean())
    assert figures.nc2_median == pytest.approx(np.median(nc2))
    assert figures.normal_consistency_median == pytest.approx((np.median(nc1) + np.median(nc2)) / 2)
    for tau, found in zip((0.1, 0.4, 1.0), f_curve(a, b, (0.1, 0.4, 1.0)), strict=True):
        p, r = (d.min(1) < tau).mean(), (d.min(0) < tau).mean()
        assert (found.precision, found.recall) == pytest.approx((p, r))
        assert found.f == pytest.approx(2 / (1 / p + 1 / r))


def test_normals_are_the_directions_in_which_the_thirty_nearest_vary_least() -> None:
    points = np.random.default_rng(2).normal(size=(300, 3)) * (1, 1, 0.3)
    ours = estimate_normals(points)
    d = np.linalg.norm(points[:, None] - points[None], axis=2)
    for i in range(0, 300, 20):
        near = points[np.argsort(d[i])[:30]]
        least = np.linalg.svd(near - near.mean(0))[2][2]
        assert abs(least @ ours[i]) == pytest.approx(1, abs=1e-6)


def test_figures_do_not_depend_on_where_the_origin_is() -> None:
    rng = np.random.default_rng(1)
    truth = sphere(1, 500)
    points = truth + 0.01 * rng.normal(size=truth.shape)
    here, there = compare_clouds(points, truth), compare_clouds(points + 5e6, truth + 5e6)
    for name, value in vars(here).items():
        assert getattr(there, name) == pytest.approx(value, abs=1e-6), name


def test_the_threshold_itself_is_outside() -> None:
    score = f_score(plane(0.5), plane(0), 0.5)
    assert (score.precision, score.recall, score.f) == (0, 0, 0)
    score = f_score(plane(0.5), plane(0), 0.5 + 1e-9)
    assert (score.precision, score.recall, score.f) == (1, 1, 1)


def test_precision_and_recall_are_shares_of_their_own_cloud() -> None:
    truth = plane(0, 20)
    points = np.r_[truth[:100], truth[:60] + [0, 0, 5]]
    score = f_score(points, truth, 1e-6)
    assert score.precision == pytest.approx(100 / 160)
    assert score.recall == pytest.approx(100 / 400)
    assert score.f == pytest.approx(2 * 100 / (160 + 400))


def test_thinning_takes_the_weight_from_dense_regions() -> None:
    """A wrong point that is there a thousand times counts once after thinning with voxels."""
    truth = plane(0, 20)
    points = np.r_[truth, np.tile([0.5, 0.5, 5.0], (1200, 1))]
    assert f_score(points, truth, 0.02).precision == pytest.approx(400 / 1600)
    assert f_score(points, truth, 0.02, voxel_size=0.01).precision == pytest.approx(400 / 401)


def test_a_voxel_holds_the_mean_of_its_points() -> None:
    points = np.array([[0.0, 0, 0], [0.1, 0, 0], [5, 5, 5]])
    thin = voxel_down_sample(points, 1.0)
    np.testing.assert_allclose(thin[np.argsort(thin[:, 0])], [[0.05, 0, 0], [5, 5, 5]])


@pytest.mark.parametrize(
    ("points", "truth", "told"),
    [
        (np.zeros((0, 3)), plane(0), "the reconstruction has no points"),
        (plane(0), np.zeros((0, 3)), "the truth has no points"),
        (plane(0), np.full((4, 3), np.inf), "4 the truth's points are not finite"),
        (plane(0)[:, :2], plane(0), r"\(N, 3\)"),
    ],
)
def test_clouds_that_cannot_be_compared_are_refused(points: Floats, truth: Floats, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        compare_clouds(points, truth)
    with pytest.raises(ValueError, match=told):
        f_score(points, truth, 0.1)


def test_other_arguments_are_checked() -> None:
    with pytest.raises(ValueError, match="positive"):
        f_score(plane(0), plane(0), 0)
    with pytest.raises(ValueError, match="voxel"):
        f_score(plane(0), plane(0), 1, voxel_size=0)
    with pytest.raises(ValueError, match="normals"):
        compare_clouds(plane(0), plane(0), normals=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="at least 3"):
        estimate_normals(np.zeros((2, 3)))
