"""ETH3D's scores: a wall before a scanner, whose classes are known, and random clouds by brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_tco.evaluation.eth3d import Beam, Scan, eth3d_curve, voxel_curve

Floats = NDArray[np.float64]


def wall(z: float, side: int = 21, step: float = 0.1) -> Floats:
    """A square grid at z = ``z``, centred before the origin."""
    at = (np.arange(side) - side // 2) * step
    x, y = np.meshgrid(at, at)
    return np.stack([x, y, np.full_like(x, z)], -1).reshape(-1, 3)


def posed(points: Floats, seed: int = 0) -> tuple[Scan, Floats]:
    """A scan of points in the scanner's frame, somewhere in the world, and its world_from_scan."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    return Scan(points, pose), pose


def in_world(points: Floats, pose: Floats) -> Floats:
    return points @ pose[:3, :3].T + pose[:3, 3]


def test_points_along_the_beams_are_accurate_inaccurate_or_unobserved() -> None:
    """Scaling about the scanner keeps a point in its beam: refuted in front, unobserved behind."""
    scan, pose = posed(wall(2.0))
    before, behind = (in_world(wall(2.0) * s, pose) for s in (0.5, 1.5))
    (score,) = eth3d_curve(scan.world, [scan], [0.05])
    assert (score.precision, score.recall, score.f) == (1, 1, 1)
    (score,) = eth3d_curve(before, [scan], [0.05])
    assert (score.precision, score.recall, score.f) == (0, 0, 0)
    (score,) = eth3d_curve(np.r_[scan.world, behind], [scan], [0.05])
    assert score.precision == 1
    (score,) = voxel_curve(np.r_[scan.world, behind], scan.world, [0.05])
    assert score.precision == pytest.approx(0.5)


def test_points_between_the_beams_do_not_count() -> None:
    scan, pose = posed(wall(2.0))
    between = in_world(wall(2.0) * 0.5 + [0.02, 0.02, 0], pose)
    (score,) = eth3d_curve(np.r_[scan.world, between], [scan], [0.05])
    assert score.precision == 1
    (score,) = eth3d_curve(np.r_[scan.world, between], [scan], [0.05], beam=Beam(start=0.05))
    assert score.precision < 1


def test_points_are_refuted_by_one_scan_and_confirmed_by_another() -> None:
    """What one scanner sees through, another may have hit: it is accurate."""
    near, pose = wall(1.0), posed(wall(2.0))[1]
    far = Scan(near * 2, pose)
    (score,) = eth3d_curve(in_world(near, pose), [far], [0.01])
    assert score.precision == 0
    (score,) = eth3d_curve(in_world(near, pose), [far, Scan(near, pose)], [0.01])
    assert score.precision == 1


def test_dense_regions_weigh_no_more_than_sparse_ones() -> None:
    """1000 good points in one voxel and one bad point in another make one half, not 0.999."""
    rng = np.random.default_rng(0)
    # Away from the borders of either grid, so that each group is in one voxel of both.
    truth = np.array([[0.255, 0.255, 0.255]])
    points = np.r_[truth + 1e-3 * rng.uniform(-1, 1, (1000, 3)), [[0.755, 0.255, 0.255]]]
    (score,) = voxel_curve(points, truth, [0.01], voxel_size=0.02)
    assert score.precision == 0.5 and score.recall == 1


def test_the_tolerance_itself_is_inside_and_larger_ones_never_score_less() -> None:
    truth = wall(0.0)
    scores = voxel_curve(truth + [0, 0, 0.5], truth, [0.25, 0.5, 1.0])
    assert [s.f for s in scores] == [0, 1, 1]


def brute(
    points: Floats, scans: list[Scan], tolerance: float, voxel: float, beam: Beam
) -> tuple[float, float]:
    """The definition, point by point."""
    classes = []
    for p in points:
        accurate = wrong = False
        for scan in scans:
            q = scan.world_from_scan[:3, :3].T @ (p - scan.world_from_scan[:3, 3])
            radius = beam.start + np.linalg.norm(q) * math.tan(math.radians(beam.divergence_deg))
            for s in scan.points:
                d = s / np.linalg.norm(s)
                if q @ d >= 0 and np.linalg.norm(np.cross(d, q)) <= radius:
                    accurate |= bool(np.linalg.norm(s - q) <= tolerance)
                    wrong |= bool(q @ d < np.linalg.norm(s))
        classes.append(1 if accurate else 0 if wrong else -1)
    truth = np.concatenate([scan.world for scan in scans])
    complete = (np.linalg.norm(truth[:, None] - points[None], axis=2).min(1) <= tolerance).astype(int)
    return cells(points, np.array(classes), voxel), cells(truth, complete, voxel)


def cells(points: Floats, marks: NDArray[np.int_], voxel: float) -> float:
    shares = []
    for shift in (0.0, 0.5):
        held: dict[tuple[int, ...], list[int]] = {}
        for p, mark in zip(points, marks, strict=True):
            if mark >= 0:
                held.setdefault(tuple(math.floor(c / voxel + shift) for c in p), []).append(int(mark))
        shares += [sum(v) / len(v) for v in held.values()]
    return sum(shares) / len(shares) if shares else 0.0


@pytest.mark.parametrize("tolerance", [0.15, 0.3, 0.6])
def test_random_scans_as_by_brute_force(tolerance: float) -> None:
    rng = np.random.default_rng(4)
    scans = [posed(rng.normal(size=(40, 3)) + [0, 0, 2], seed)[0] for seed in (1, 2)]
    world = np.concatenate([scan.world for scan in scans])
    points = np.r_[world[:30] + 0.1 * rng.normal(size=(30, 3)), 2 * rng.normal(size=(60, 3))]
    points = np.r_[points, [scans[0].world_from_scan[:3, 3]]]  # at the scanner itself
    beam = Beam(start=0.1, divergence_deg=2.0)
    (score,) = eth3d_curve(points, scans, [tolerance], voxel_size=0.3, beam=beam)
    assert (score.precision, score.recall) == pytest.approx(brute(points, scans, tolerance, 0.3, beam))
    assert 0 < score.precision < 1 and 0 < score.recall < 1


def test_an_empty_cloud_scores_nothing() -> None:
    scan, _ = posed(wall(2.0))
    for (score,) in (
        eth3d_curve(np.zeros((0, 3)), [scan], [0.1]),
        voxel_curve(np.zeros((0, 3)), scan.world, [0.1]),
    ):
        assert (score.precision, score.recall, score.f) == (0, 0, 0)


def test_what_cannot_be_scored_is_refused() -> None:
    scan, _ = posed(wall(2.0))
    with pytest.raises(ValueError, match="no scan"):
        eth3d_curve(wall(1.0), [], [0.1])
    with pytest.raises(ValueError, match="no points"):
        voxel_curve(wall(1.0), np.zeros((0, 3)), [0.1])
    with pytest.raises(ValueError, match="positive"):
        voxel_curve(wall(1.0), wall(1.0), [0.0])
    with pytest.raises(ValueError, match="not a rotation"):
        eth3d_curve(wall(1.0), [Scan(scan.points, 2 * np.eye(4))], [0.1])
    with pytest.raises(ValueError, match="units"):
        voxel_curve(wall(1.0), wall(1.0) * 1e7, [0.1], voxel_size=1e-6)
