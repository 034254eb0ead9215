"""Similarities that are known exactly are found, and what determines none is refused."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from skimage.transform import SimilarityTransform

from colmap_tco.evaluation.align import Similarity, icp, umeyama

Floats = NDArray[np.float64]


def some(seed: int = 0, scale: float = 2.5, far: float = 10.0) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(scale, Rotation.random(rng=rng).as_matrix(), far * rng.normal(size=3))


def cloud(count: int = 50, seed: int = 1) -> Floats:
    return np.random.default_rng(seed).normal(size=(count, 3))


def test_composition_and_inverse_are_those_of_the_matrices() -> None:
    a, b, x = some(1), some(2, 0.3), cloud()
    homogeneous = np.c_[x, np.ones(len(x))]
    np.testing.assert_allclose(a.apply(x), (homogeneous @ a.matrix.T)[:, :3], atol=1e-12)
    np.testing.assert_allclose(a.after(b).matrix, a.matrix @ b.matrix, atol=1e-12)
    np.testing.assert_allclose(a.inverse.matrix, np.linalg.inv(a.matrix), atol=1e-12)
    np.testing.assert_array_equal(Similarity().matrix, np.eye(4))


def test_poses_move_with_the_points_that_their_cameras_see() -> None:
    a, pose = some(), np.eye(4)
    pose[:3, :3], pose[:3, 3] = some(3).rotation, [1, 2, 3]
    in_cam = cloud()
    world = in_cam @ pose[:3, :3].T + pose[:3, 3]
    (moved,) = a.poses(pose[None])
    np.testing.assert_allclose(
        (a.scale * in_cam) @ moved[:3, :3].T + moved[:3, 3], a.apply(world), atol=1e-12
    )


@pytest.mark.parametrize("flat", [False, True], ids=["in space", "in a plane"])
@pytest.mark.parametrize("far", [0.0, 5e6], ids=["near", "map coordinates"])
def test_an_exact_similarity_is_found(flat: bool, far: float) -> None:
    x, true = cloud() * (1, 1, 0 if flat else 1) + far, some(far=far)
    found = umeyama(x, true.apply(x))
    np.testing.assert_allclose(found.scale, true.scale, rtol=1e-8)
    np.testing.assert_allclose(found.rotation, true.rotation, atol=1e-8)
    np.testing.assert_allclose(found.apply(x), true.apply(x), atol=1e-7)
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_noisy_points_are_fitted_as_skimage_fits_them() -> None:
    x = cloud()
    y = some().apply(x) + 0.3 * cloud(seed=2)
    np.testing.assert_allclose(
        umeyama(x, y).matrix, SimilarityTransform.from_estimate(x, y).params, atol=1e-10
    )


def test_weights_and_rotation_without_scale_as_scipy_has_them() -> None:
    x, w = cloud(), np.random.default_rng(3).uniform(0, 2, 50)
    y = some(scale=1).apply(x) + 0.3 * cloud(seed=2)
    found = umeyama(x, y, w, with_scale=False)
    expected, _ = Rotation.align_vectors(y - np.average(y, 0, w), x - np.average(x, 0, w), weights=w)
    assert found.scale == 1
    np.testing.assert_allclose(found.rotation, expected.as_matrix(), atol=1e-10)
    np.testing.assert_allclose(np.average(found.apply(x) - y, 0, w), 0, atol=1e-12)


def test_points_of_weight_zero_do_not_count() -> None:
    x, true = cloud(), some()
    y = true.apply(x)
    y[:10] += 100
    found = umeyama(x, y, np.r_[np.zeros(10), np.ones(40)])
    np.testing.assert_allclose(found.matrix, true.matrix, atol=1e-10)


def test_a_mirrored_cloud_gets_the_best_rotation_instead() -> None:
    x = cloud()
    y = x * (1, 1, -1)
    found = umeyama(x, y)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    best = np.square(found.apply(x) - y).sum()
    for seed in range(30):
        turn = Rotation.from_rotvec(0.05 * cloud(1, seed)[0]).as_matrix()
        other = Similarity(found.scale, turn @ found.rotation, found.translation)
        assert np.square(other.apply(x) - y).sum() >= best


LINE = np.outer(np.linspace(0, 1, 20), [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("source", "target", "told"),
    [
        (cloud(2), cloud(2), "at least 3"),
        (cloud(5), cloud(6), "do not correspond"),
        (LINE, cloud(20), "source points are on one line"),
        (LINE + 1e6, cloud(20), "source points are on one line"),
        (cloud(20), LINE, "target points are on one line"),
        (np.ones((5, 3)), cloud(5), "coincide"),
        (cloud(5), np.full((5, 3), 7e5), "coincide"),
        (np.full((5, 3), np.nan), cloud(5), "5 source points are not finite"),
        (np.zeros((5, 2)), cloud(5), r"\(N, 3\)"),
    ],
)
def test_what_determines_no_similarity_is_refused(source: Floats, target: Floats, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        umeyama(source, target)


def test_weights_are_checked() -> None:
    with pytest.raises(ValueError, match="not negative"):
        umeyama(cloud(5), cloud(5), np.array([1, 1, 1, 1, -1.0]))
    with pytest.raises(ValueError, match="not 2"):
        umeyama(cloud(5), cloud(5), np.array([1, 1, 0, 0, 0.0]))


def own_icp(source: Floats, target: Floats, threshold: float) -> Floats:
    """Point-to-point ICP as Open3D documents it: at most 30 rounds, until the errors rest."""
    pose, last = np.eye(4), (0.0, 0.0)
    for _ in range(31):
        moved = source @ pose[:3, :3].T + pose[:3, 3]
        d = np.linalg.norm(moved[:, None] - target[None], axis=2)
        near = d.min(1) < threshold
        state = (near.mean(), np.sqrt(np.square(d.min(1)[near]).mean()))
        if abs(state[0] - last[0]) < 1e-6 and abs(state[1] - last[1]) < 1e-6:
            break
        last = state
        a, b = moved[near], target[d.argmin(1)[near]]
        turn, _ = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))
        step = np.eye(4)
        step[:3, :3] = turn.as_matrix()
        step[:3, 3] = b.mean(0) - turn.apply(a.mean(0))
        pose = step @ pose
    return pose


def test_icp_is_that_of_an_independent_implementation() -> None:
    target = cloud(200)
    source = some(scale=1, far=0).inverse.apply(target[:150])
    near = Similarity(1.0, Rotation.from_rotvec([0.02, -0.05, 0.03]).as_matrix(), np.array([0.03, 0, -0.02]))
    start = near.after(some(scale=1, far=0))
    found = icp(source, target + 0.001 * cloud(200, 5), 0.3, start)
    expected = own_icp(start.apply(source), target + 0.001 * cloud(200, 5), 0.3)
    np.testing.assert_allclose(found.matrix, expected @ start.matrix, atol=1e-6)
    np.testing.assert_allclose(found.apply(source), target[:150], atol=2e-3)


def test_icp_keeps_the_scale_of_its_start_and_stands_far_coordinates() -> None:
    target = cloud(300) + 5e6
    start = Similarity(2.0, np.eye(3), np.full(3, 0.02))
    found = icp(target / 2, target, 0.2, start)
    assert found.scale == 2
    np.testing.assert_allclose(found.apply(target / 2), target, atol=1e-6)


def test_icp_leaves_out_what_is_further_than_its_threshold() -> None:
    target = cloud(300)
    source = np.r_[target + 0.01, target[:100] + 1000]
    found = icp(source, target, 0.1)
    np.testing.assert_allclose(found.apply(source[:300]), target, atol=1e-9)


def test_icp_without_correspondences_returns_its_start_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    start = some()
    with caplog.at_level(logging.WARNING):
        assert icp(cloud(), cloud() + 1e4, 0.1, start) is start
    assert "not refined" in caplog.text


@pytest.mark.parametrize("threshold", [0.0, -1.0, float("nan")])
def test_icp_refuses_thresholds_that_are_none(threshold: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        icp(cloud(), cloud(), threshold)


def test_icp_refuses_empty_clouds() -> None:
    with pytest.raises(ValueError, match="have points"):
        icp(np.zeros((0, 3)), cloud(), 0.1)
