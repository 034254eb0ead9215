"""Distances between clouds: accuracy, completion, normal consistency, F-score.

Accuracy, completion and normal consistency are those of the paper (arXiv 2604.03878, code at
github.com/cvlab-stonybrook/TCO, ``evaluation/mv_recon/utils.py``), taken over from π³, CUT3R, Spann3R and
NICER-SLAM:

* accuracy: distances from the points to the nearest true points;
* completion: distances from the true points to the nearest points;
* normal consistency: |n · n'| of the pairs of accuracy (NC1) and of the pairs of completion (NC2); what the
  tables call NC is the mean of the two means, and the mean of the two medians.

All distances count; none is cut off.

The F-score is that of Tanks and Temples (Knapitsch et al. 2017, code at
github.com/isl-org/TanksAndTemples, ``python_toolbox/evaluation/evaluation.py``): precision and recall are the
shares of distances strictly below the threshold, F their harmonic mean. That benchmark thins both clouds
with voxels of half the scene's threshold before, once for its whole curve, which goes up to five times the
threshold. ETH3D's is another one, see :mod:`colmap_tco.evaluation.eth3d`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_tco._open3d import open3d
from colmap_tco.evaluation.checks import as_points

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class CloudFigures:
    """Distances in units of the truth; normal consistencies between 0 and 1.

    Attributes:
        accuracy_mean: from points to truth.
        accuracy_median: from points to truth.
        completion_mean: from truth to points.
        completion_median: from truth to points.
        normal_consistency_mean: (nc1_mean + nc2_mean) / 2.
        normal_consistency_median: (nc1_median + nc2_median) / 2.
        nc1_mean: over the pairs of accuracy.
        nc1_median: over the pairs of accuracy.
        nc2_mean: over the pairs of completion.
        nc2_median: over the pairs of completion.
    """

    accuracy_mean: float
    accuracy_median: float
    completion_mean: float
    completion_median: float
    normal_consistency_mean: float
    normal_consistency_median: float
    nc1_mean: float
    nc1_median: float
    nc2_mean: float
    nc2_median: float


@dataclass(frozen=True)
class FScore:
    """Shares between 0 and 1.

    Attributes:
        precision: of the points that are within the threshold of the truth.
        recall: of the true points that are within the threshold of the points.
        f: harmonic mean of the two; 0 where both are 0.
    """

    precision: float
    recall: float
    f: float


def compare_clouds(
    points: Floats, truth: Floats, normals: Floats | None = None, truth_normals: Floats | None = None
) -> CloudFigures:
    """Accuracy, completion and normal consistency of aligned clouds.

    Args:
        points: (N, 3).
        truth: (M, 3).
        normals: (N, 3) unit vectors of either sign; None: estimated as the paper does, by Open3D with its
            defaults (30 nearest points).
        truth_normals: (M, 3), likewise.

    Raises:
        ValueError: an empty cloud, shapes that do not agree, or a value that is not finite.
        MissingError: normals are to be estimated and Open3D cannot be imported.
    """
    points, truth = _pair(points, truth)
    n = estimate_normals(points) if normals is None else _normals(normals, points, "the points'")
    m = estimate_normals(truth) if truth_normals is None else _normals(truth_normals, truth, "the truth's")
    accuracy, to_truth = nearest(points, truth)
    completion, to_points = nearest(truth, points)
    nc1 = np.abs((n * m[to_truth]).sum(1))
    nc2 = np.abs((m * n[to_points]).sum(1))
    means, medians = (
        [float(statistic(values)) for values in (accuracy, completion, nc1, nc2)]
        for statistic in (np.mean, np.median)
    )
    return CloudFigures(
        accuracy_mean=means[0],
        accuracy_median=medians[0],
        completion_mean=means[1],
        completion_median=medians[1],
        normal_consistency_mean=(means[2] + means[3]) / 2,
        normal_consistency_median=(medians[2] + medians[3]) / 2,
        nc1_mean=means[2],
        nc1_median=medians[2],
        nc2_mean=means[3],
        nc2_median=medians[3],
    )


def estimate_normals(points: Floats) -> Floats:
    """Unit normals (N, 3) of points (N, 3), of arbitrary sign, by Open3D's ``estimate_normals()``.

    Its defaults, as in the paper's code: the direction in which the 30 nearest points vary least.

    Raises:
        ValueError: fewer than 3 points, which have no normal.
        MissingError: Open3D cannot be imported.
    """
    points = as_points(points, "the")
    if len(points) < 3:
        raise ValueError(f"normals are estimated from at least 3 points, not {len(points)}")
    o3d = open3d()
    # Open3D sums squares of coordinates, which would cancel far from the origin.
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points - points.mean(0)))
    cloud.estimate_normals()
    return np.asarray(cloud.normals, np.float64)


def f_score(points: Floats, truth: Floats, threshold: float, voxel_size: float | None = None) -> FScore:
    """Precision, recall and F-score at a distance, as Tanks and Temples defines them.

    Args:
        points: (N, 3).
        truth: (M, 3).
        threshold: distance below which a point counts, in units of the truth.
        voxel_size: both clouds are thinned with :func:`voxel_down_sample` before; the benchmark takes
            ``threshold / 2``. None: as they are.

    Raises:
        ValueError: an empty cloud, a value that is not finite, a threshold or voxel that is not positive.
        MissingError: they are to be thinned and Open3D cannot be imported.
    """
    return f_curve(points, truth, [threshold], voxel_size)[0]


def f_curve(
    points: Floats, truth: Floats, thresholds: Sequence[float], voxel_size: float | None = None
) -> tuple[FScore, ...]:
    """:func:`f_score` at several distances, in their order; the clouds are thinned with one voxel size."""
    points, truth = _pair(points, truth)
    if any(not t > 0 for t in thresholds):
        raise ValueError(f"thresholds of the F-score must be positive: {list(thresholds)}")
    if voxel_size is not None:
        points, truth = voxel_down_sample(points, voxel_size), voxel_down_sample(truth, voxel_size)
    accuracy, _ = nearest(points, truth)
    completion, _ = nearest(truth, points)
    return tuple(
        from_shares(float((accuracy < t).mean()), float((completion < t).mean())) for t in thresholds
    )


def from_shares(precision: float, recall: float) -> FScore:
    """The F-score of two shares."""
    total = precision + recall
    return FScore(precision, recall, 2 * precision * recall / total if total > 0 else 0.0)


def voxel_down_sample(points: Floats, voxel_size: float) -> Floats:
    """One point (K, 3) a voxel, the mean of those in it, by Open3D.

    Raises:
        ValueError: a voxel size that is not positive.
        MissingError: Open3D cannot be imported.
    """
    if not voxel_size > 0:
        raise ValueError(f"the voxel size must be positive, it is {voxel_size}")
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(as_points(points, "the")))
    return np.asarray(cloud.voxel_down_sample(voxel_size).points, np.float64)


def nearest(points: Floats, others: Floats) -> tuple[Floats, Ints]:
    """Distance (N,) and index (N,) of the nearest of ``others`` (M, 3) to each of ``points`` (N, 3)."""
    from scipy.spatial import cKDTree

    distance, index = cKDTree(others).query(points, workers=-1)
    return np.asarray(distance, np.float64), np.asarray(index, np.int64)


def _pair(points: Floats, truth: Floats) -> tuple[Floats, Floats]:
    points, truth = as_points(points, "the reconstruction's"), as_points(truth, "the truth's")
    for cloud, name in ((points, "reconstruction"), (truth, "truth")):
        if not len(cloud):
            raise ValueError(f"the {name} has no points to compare")
    return points, truth


def _normals(normals: Floats, points: Floats, whose: str) -> Floats:
    out = np.asarray(normals, np.float64)
    if out.shape != points.shape or not np.isfinite(out).all():
        raise ValueError(f"{whose} normals must be {points.shape} finite numbers, not {out.shape}")
    return out
