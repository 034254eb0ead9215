"""The figures of the paper's tables of one scene."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from colmap_tco.datasets.base import Floats
from colmap_tco.errors import InputError
from colmap_tco.evaluation.align import icp, umeyama
from colmap_tco.evaluation.points import compare_clouds
from colmap_tco.evaluation.trajectory import trajectory_figures

POINTS = {
    "acc_mean": "accuracy_mean", "acc_med": "accuracy_median",
    "comp_mean": "completion_mean", "comp_med": "completion_median",
    "nc_mean": "normal_consistency_mean", "nc_med": "normal_consistency_median",
}  # fmt: skip
"""Column → attribute of :class:`colmap_tco.evaluation.points.CloudFigures`."""

POSES = {"ate": "ate_rmse", "rpe_trans": "rpe_translation", "rpe_rot": "rpe_rotation_deg"}
"""Column → attribute of :class:`colmap_tco.evaluation.trajectory.TrajectoryFigures`."""

LENGTHS = ("acc_mean", "acc_med", "comp_mean", "comp_med")
"""Columns in the unit of the table."""

UNITS = {"dtu": 1000.0}
"""Dataset → units of its table per metre, where that is not 1: DTU's is in millimetres."""

COLUMNS = {name: tuple(POSES if name == "scannet" else POINTS) for name in
           ("eth3d", "dtu", "7scenes", "nrgbd", "scannet")}  # fmt: skip
"""Dataset → columns of its table."""


def point_figures(
    points: Floats,
    truth: Floats,
    known: NDArray[np.bool_],
    per_metre: float = 1.0,
    kept: NDArray[np.bool_] | None = None,
) -> dict[str, float]:
    """Accuracy, completion and normal consistency as the paper has them.

    A similarity is fitted to the corresponding points where the truth is known, then ICP with a threshold of
    0.1 m (100 mm for DTU, which is the same), and the clouds are compared.

    Args:
        points: (V, H, W, 3), in any frame and unit.
        truth: (V, H, W, 3), metres.
        known: (V, H, W), where the truth is.
        per_metre: units of the result per metre.
        kept: (V, H, W), pixels whose points are there; None: all. All true points are to be found.

    Raises:
        InputError: too few true points, or points that cannot be aligned to them.
    """
    both = known if kept is None else known & kept
    ours, theirs = points[both], truth[known]
    if len(ours) < 3:
        raise InputError(f"{len(ours)} pixels of these frames have a true depth: there is nothing to compare")
    try:
        similarity = umeyama(ours, truth[both])
    except ValueError as error:
        raise InputError(f"the points cannot be aligned to the truth: {error}") from error
    aligned = similarity.apply(ours)
    found = asdict(compare_clouds(icp(aligned, theirs).apply(aligned), theirs))
    return {
        column: found[name] * (per_metre if column in LENGTHS else 1.0) for column, name in POINTS.items()
    }


def pose_figures(world_from_cam: Floats, truth: Floats) -> dict[str, float]:
    """ATE and RPE after a similarity of the camera centres; poses are (V, 4, 4).

    Raises:
        InputError: the camera centres determine no alignment.
    """
    try:
        found = asdict(trajectory_figures(world_from_cam, truth))
    except ValueError as error:
        raise InputError(f"the poses cannot be aligned to the truth: {error}") from error
    return {column: found[name] for column, name in POSES.items()}
