"""Errors of camera poses: ATE and RPE through evo, and the area under the curve of relative pose angles.

ATE and RPE are computed by the package evo (Grupp 2017; GPL, so it is an extra that the user installs and
not a part of this one) with the settings of the paper's code and its predecessors' (π³, CUT3R, MonST3R:
``relpose/evo_utils.py``): alignment by Umeyama with scale, root mean square, RPE between successive frames.

The area under the curve is that of VGGT and π³ (``relpose/metric.py`` of the latter's branch evaluation),
see :func:`pose_auc`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_tco.errors import MissingError
from colmap_tco.evaluation.align import umeyama
from colmap_tco.evaluation.checks import as_poses

Floats = NDArray[np.float64]

THRESHOLDS = (5, 10, 20, 30)


@dataclass(frozen=True)
class TrajectoryFigures:
    """Root mean squares after alignment, lengths in units of the truth.

    Attributes:
        ate_rmse: distance of the camera centres.
        rpe_translation: length of the translation of the error of the motion from each frame to the next.
        rpe_rotation_deg: its angle, degrees.
    """

    ate_rmse: float
    rpe_translation: float
    rpe_rotation_deg: float


@dataclass(frozen=True)
class AngularFigures:
    """Shares between 0 and 1, one for each threshold.

    Attributes:
        thresholds: whole degrees.
        rra: relative rotation accuracy, the share of pairs whose rotation error is below the threshold.
        rta: relative translation accuracy, the same for the direction of the baseline.
        auc: area under the curve of the greater of the two errors.
        pairs: number of pairs.
    """

    thresholds: tuple[int, ...]
    rra: tuple[float, ...]
    rta: tuple[float, ...]
    auc: tuple[float, ...]
    pairs: int


def trajectory_figures(world_from_cam: Floats, truth: Floats, with_scale: bool = True) -> TrajectoryFigures:
    """ATE and RPE of a trajectory, aligned to its truth by its camera centres, by evo.

    RPE compares the motion from frame i to i + 1, for all i.

    Args:
        world_from_cam: (N, 4, 4) in the order of the frames.
        truth: (N, 4, 4) of the same frames.
        with_scale: False for metric trajectories, which are aligned by a rigid motion.

    Raises:
        ValueError: shapes that differ, matrices that are not poses, or centres that determine no
            alignment (fewer than three, or all on one line).
        MissingError: evo is not installed.
    """
    estimated, true = _pair(world_from_cam, truth)
    umeyama(estimated[:, :3, 3], true[:, :3, 3])  # says plainly what evo reports as a rank
    metrics, trajectory = _evo()
    reference, moved = (trajectory.PosePath3D(poses_se3=list(poses)) for poses in (true, estimated))
    moved.align(reference, correct_scale=with_scale)
    relation = metrics.PoseRelation
    ate = metrics.APE(relation.translation_part)
    steps = [
        metrics.RPE(kind, delta=1, delta_unit=metrics.Unit.frames, all_pairs=True)
        for kind in (relation.translation_part, relation.rotation_angle_deg)
    ]
    figures = []
    for metric in (ate, *steps):
        metric.process_data((reference, moved))
        figures.append(float(metric.get_statistic(metrics.StatisticsType.rmse)))
    return TrajectoryFigures(*figures)


def pose_auc(world_from_cam: Floats, truth: Floats, thresholds: Sequence[int] = THRESHOLDS) -> AngularFigures:
    """RRA, RTA and AUC over all pairs of cameras; they need no alignment.

    With e the greater of the two angles of :func:`relative_errors`, the AUC at θ degrees is the mean over
    k = 1 … θ of the share of pairs with e below k: the area under the recall curve, sampled at whole
    degrees, as VGGT and π³ compute it with a histogram of 1° bins (e = θ itself counts in the last one).

    Raises:
        ValueError: shapes that differ, fewer than two poses, or a threshold that is no positive whole number.
    """
    rotation, translation = relative_errors(world_from_cam, truth)
    if any(t != int(t) or t < 1 for t in thresholds):
        raise ValueError(f"thresholds of the AUC are whole degrees from 1 on: {list(thresholds)}")
    worse = np.maximum(rotation, translation)
    areas = []
    for t in thresholds:
        shares = np.histogram(worse, np.arange(int(t) + 1))[0] / len(worse)
        areas.append(float(shares.cumsum().mean()))
    return AngularFigures(
        thresholds=tuple(int(t) for t in thresholds),
        rra=tuple(float((rotation < t).mean()) for t in thresholds),
        rta=tuple(float((translation < t).mean()) for t in thresholds),
        auc=tuple(areas),
        pairs=len(worse),
    )


def relative_errors(world_from_cam: Floats, truth: Floats) -> tuple[Floats, Floats]:
    """Angles (P,) in degrees by which relative rotations and baseline directions are off, for pairs i < j.

    The pose compared is cam_j_from_cam_i. The direction of its translation is taken without sign, so that
    its error is at most 90°, and a pair without baseline, in the truth or not, counts as 90°, as in the
    public code of VGGT and π³.

    Raises:
        ValueError: shapes that differ, fewer than two poses, or matrices that are not poses.
    """
    estimated, true = _pair(world_from_cam, truth)
    if len(true) < 2:
        raise ValueError(f"relative poses take at least two cameras, not {len(true)}")
    i, j = np.triu_indices(len(true), 1)
    (Ra, ta), (Rb, tb) = (_relative(poses, i, j) for poses in (estimated, true))
    off = Ra @ Rb.transpose(0, 2, 1)
    # The angle from both its sine and its cosine: either alone is blind near 0° or 180°, or near 90°.
    axis = np.stack(
        [off[:, 2, 1] - off[:, 1, 2], off[:, 0, 2] - off[:, 2, 0], off[:, 1, 0] - off[:, 0, 1]], 1
    )
    rotation = np.arctan2(np.linalg.norm(axis, axis=1), off.trace(axis1=1, axis2=2) - 1)
    across, along = np.linalg.norm(np.cross(ta, tb), axis=1), np.abs((ta * tb).sum(1))
    translation = np.where((across == 0) & (along == 0), np.pi / 2, np.arctan2(across, along))
    return np.degrees(rotation), np.degrees(translation)


def _relative(world_from_cam: Floats, i: NDArray[np.intp], j: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Rotations (P, 3, 3) and translations (P, 3) of cam_j_from_cam_i."""
    R, c = world_from_cam[:, :3, :3], world_from_cam[:, :3, 3]
    to_j = R[j].transpose(0, 2, 1)
    return to_j @ R[i], np.einsum("pij,pj->pi", to_j, c[i] - c[j])


def _pair(world_from_cam: Floats, truth: Floats) -> tuple[Floats, Floats]:
    estimated, true = as_poses(world_from_cam, "estimated"), as_poses(truth, "true")
    if len(estimated) != len(true):
        raise ValueError(f"{len(estimated)} estimated poses and {len(true)} true ones do not correspond")
    return estimated, true


def _evo() -> tuple[Any, Any]:
    try:
        from evo.core import metrics, trajectory
    except ImportError as error:
        raise MissingError(
            f"ATE and RPE are computed by the package evo, which cannot be imported ({error}); install it "
            "with: pip install 'colmap-tco[evaluate]'"
        ) from error
    return metrics, trajectory
