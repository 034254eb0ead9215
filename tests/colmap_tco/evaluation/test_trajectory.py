"""Poses with known errors, and others against implementations that share nothing with ours."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from skimage.transform import SimilarityTransform

from colmap_tco.errors import MissingError
from colmap_tco.evaluation.align import Similarity
from colmap_tco.evaluation.trajectory import pose_auc, relative_errors, trajectory_figures

Floats = NDArray[np.float64]


def poses(count: int = 8, seed: int = 0) -> Floats:
    rng = np.random.default_rng(seed)
    out = np.tile(np.eye(4), (count, 1, 1))
    out[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    out[:, :3, 3] = rng.normal(size=(count, 3))
    return out


def disturbed(truth: Floats, degrees: float, length: float, seed: int = 5) -> Floats:
    rng = np.random.default_rng(seed)
    out = truth.copy()
    axes = rng.normal(size=(len(truth), 3))
    axes *= np.radians(degrees) / np.linalg.norm(axes, axis=1, keepdims=True)
    out[:, :3, :3] = truth[:, :3, :3] @ Rotation.from_rotvec(axes).as_matrix()
    out[:, :3, 3] += length * rng.normal(size=(len(truth), 3))
    return out


FRAME = Similarity(3.0, Rotation.from_rotvec([0.4, -1, 2]).as_matrix(), np.array([5.0, -2, 9]))


class TestWithEvo:
    """ATE and RPE, which evo computes."""

    @pytest.fixture(autouse=True)
    def _evo(self) -> None:
        pytest.importorskip("evo.core.metrics", reason="evo is not installed")

    def test_another_frame_and_scale_is_no_error(self) -> None:
        truth = poses()
        found = trajectory_figures(FRAME.poses(truth), truth)
        assert max(found.ate_rmse, found.rpe_translation, found.rpe_rotation_deg) < 1e-6

    def test_without_scale_another_scale_is_an_error(self) -> None:
        truth = poses()
        larger = Similarity(1.5).poses(truth)
        centred = truth[:, :3, 3] - truth[:, :3, 3].mean(0)
        found = trajectory_figures(larger, truth, with_scale=False)
        assert found.ate_rmse == pytest.approx(0.5 * np.sqrt((centred**2).sum(1).mean()))
        assert found.rpe_rotation_deg == pytest.approx(0, abs=1e-6)

    def test_a_camera_that_is_turned_shows_in_two_steps(self) -> None:
        truth = poses(9)
        turned = truth.copy()
        turned[4, :3, :3] = truth[4, :3, :3] @ Rotation.from_euler("z", 10, degrees=True).as_matrix()
        found = trajectory_figures(turned, truth)
        assert found.ate_rmse == pytest.approx(0, abs=1e-9)
        assert found.rpe_rotation_deg == pytest.approx(np.sqrt(2 * 10**2 / 8))

    def test_noisy_poses_as_by_our_own_alignment(self) -> None:
        truth = poses(12)
        estimated = FRAME.poses(disturbed(truth, 4, 0.1))
        fit = SimilarityTransform.from_estimate(estimated[:, :3, 3], truth[:, :3, 3])
        assert fit
        moved = Similarity(fit.scale, fit.params[:3, :3] / fit.scale, fit.translation).poses(estimated)
        ate = np.sqrt(np.square(moved[:, :3, 3] - truth[:, :3, 3]).sum(1).mean())
        errors = []
        for i in range(11):
            step, true = (np.linalg.inv(p[i]) @ p[i + 1] for p in (moved, truth))
            errors.append(np.linalg.inv(true) @ step)
        angles = Rotation.from_matrix(np.stack(errors)[:, :3, :3]).magnitude()
        found = trajectory_figures(estimated, truth)
        assert found.ate_rmse == pytest.approx(ate)
        assert found.rpe_translation == pytest.approx(
            np.sqrt(np.square(np.stack(errors)[:, :3, 3]).sum(1).mean())
        )
        assert found.rpe_rotation_deg == pytest.approx(np.degrees(np.sqrt((angles**2).mean())))

    def test_cameras_on_a_line_are_refused(self) -> None:
        truth = poses()
        truth[:, :3, 3] = np.outer(np.arange(8), [1, 2, 3])
        with pytest.raises(ValueError, match="on one line"):
            trajectory_figures(truth, truth)


def test_without_evo_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "evo"] + ["evo", "evo.core"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingError, match=r"colmap-tco\[evaluate\]"):
        trajectory_figures(poses(), poses())


def test_relative_errors_need_no_alignment_and_are_those_of_scipy() -> None:
    truth = poses()
    estimated = FRAME.poses(disturbed(truth, 5, 0.2))
    rotation, translation = relative_errors(estimated, truth)
    for k, (i, j) in enumerate(itertools.combinations(range(8), 2)):
        a, b = (np.linalg.inv(p[j]) @ p[i] for p in (estimated, truth))
        angle = Rotation.from_matrix(a[:3, :3] @ b[:3, :3].T).magnitude()
        cosine = abs(a[:3, 3] @ b[:3, 3]) / np.linalg.norm(a[:3, 3]) / np.linalg.norm(b[:3, 3])
        assert rotation[k] == pytest.approx(np.degrees(angle))
        assert translation[k] == pytest.approx(np.degrees(np.arccos(cosine)))


@pytest.mark.parametrize("degrees", [1e-7, 0.5, 90.0, 179.9, 180.0])
def test_a_known_rotation_error_is_measured_at_any_size(degrees: float) -> None:
    truth = poses(2)
    turned = truth.copy()
    turned[0, :3, :3] = truth[0, :3, :3] @ Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix()
    rotation, _ = relative_errors(turned, truth)
    assert rotation == pytest.approx([degrees], rel=1e-6)


def test_a_known_direction_error_is_measured_without_its_sign() -> None:
    truth = np.tile(np.eye(4), (2, 1, 1))
    truth[1, 0, 3] = 1
    for angle, expected in ((0, 0), (30, 30), (90, 90), (150, 30), (180, 0)):
        moved = truth.copy()
        moved[1, :3, 3] = 7 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0])
        rotation, translation = relative_errors(moved, truth)
        assert (rotation[0], translation[0]) == pytest.approx((0, expected), abs=1e-9)


def test_a_pair_without_baseline_has_no_direction() -> None:
    truth = np.tile(np.eye(4), (2, 1, 1))
    assert relative_errors(truth, truth)[1] == pytest.approx([90])


def test_accuracies_and_area_of_two_cameras() -> None:
    """One pair, off by 7.5°: below the curve from 8° on, so 3 of 10 and 23 of 30 bins."""
    truth = poses(2)
    turned = truth.copy()
    turned[0, :3, :3] = truth[0, :3, :3] @ Rotation.from_euler("x", 7.5, degrees=True).as_matrix()
    found = pose_auc(turned, truth, (5, 7, 8, 10, 30))
    assert found.rra == (0, 0, 1, 1, 1)
    assert found.rta == (1, 1, 1, 1, 1)
    assert found.auc == pytest.approx((0, 0, 1 / 8, 3 / 10, 23 / 30))
    assert found.pairs == 1


def test_the_area_is_the_mean_recall_at_whole_degrees() -> None:
    truth = poses(12)
    estimated = disturbed(truth, 6, 0.2)
    worse = np.maximum(*relative_errors(estimated, truth))
    found = pose_auc(estimated, truth)
    for threshold, auc in zip(found.thresholds, found.auc, strict=True):
        assert auc == pytest.approx(np.mean([(worse < k).mean() for k in range(1, threshold + 1)]))
    assert 0 < found.auc[0] < found.auc[-1] < 1


def test_exact_poses_reach_one() -> None:
    truth = poses()
    found = pose_auc(FRAME.poses(truth), truth)
    assert found.rra == found.rta == (1, 1, 1, 1)
    assert found.auc == pytest.approx((1, 1, 1, 1))


def test_what_cannot_be_compared_is_refused() -> None:
    with pytest.raises(ValueError, match="at least two"):
        pose_auc(poses(1), poses(1))
    with pytest.raises(ValueError, match="do not correspond"):
        pose_auc(poses(3), poses(4))
    with pytest.raises(ValueError, match="whole degrees"):
        pose_auc(poses(), poses(), (2.5,))  # type: ignore[arg-type]
    scaled = poses()
    scaled[3, :3, :3] *= 2
    with pytest.raises(ValueError, match="pose 3 is not a rotation"):
        pose_auc(scaled, poses())
    with pytest.raises(ValueError, match="not finite"):
        pose_auc(poses() * np.nan, poses())
    with pytest.raises(ValueError, match=r"\(N, 4, 4\)"):
        pose_auc(poses()[:, :3], poses())
