"""The three parts of an evaluation: depth maps, the cloud, the cameras; each a dictionary of numbers."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from colmap_tco.errors import InputError, MissingError
from colmap_tco.evaluation.align import Similarity, icp, umeyama
from colmap_tco.evaluation.depth import DepthFigures, depth_figures
from colmap_tco.evaluation.eth3d import Scan, eth3d_curve, voxel_curve
from colmap_tco.evaluation.maps import DepthPair, depth_pairs, true_maps
from colmap_tco.evaluation.points import FScore, compare_clouds, f_curve
from colmap_tco.evaluation.sources import (
    MESH_POINTS,
    CloudTruth,
    Outcome,
    read_points,
    world_from_cam,
)
from colmap_tco.evaluation.trajectory import pose_auc, trajectory_figures
from colmap_tco.progress import Progress

if TYPE_CHECKING:
    from colmap_tco.evaluation.command import EvaluateConfig

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

_FAR_OFF = 1.1
"""A median ratio of depths further from 1 than this is more likely a wrong unit than an error."""
_VIEW_FIGURES = ("abs_rel", "median", "d2", "d5", "coverage")


@dataclass(frozen=True)
class Pixels:
    """Depth of all views at the measured pixels, and a part of them as points.

    Attributes:
        pairs: of the views, in the truth's unit.
        seen: (K, 3) points of the predicted depth, in the result's frame.
        there: (K, 3) points of the true depth at the same pixels, in the truth's frame.
        truth: (M, 3) points of the true depth, predicted or not, in the truth's frame.
    """

    pairs: Mapping[str, tuple[NDArray[np.float32], NDArray[np.float32]]]
    seen: Floats
    there: Floats
    truth: Floats


def read_pixels(
    outcome: Outcome,
    folder: Path,
    true_poses: Mapping[str, Floats],
    config: EvaluateConfig,
    progress: Progress,
) -> Pixels:
    """Read all true depth maps and look the predictions up.

    Args:
        outcome: with a dense workspace.
        folder: of the true maps.
        true_poses: name → true world_from_cam, which the true depth is then projected back from; empty: the
            result's own, scaled by ``metres_per_unit``.
        config: units and sizes.
        progress: counts the images.

    Raises:
        InputError: see :func:`colmap_tco.evaluation.maps.depth_pairs`.
    """
    files = true_maps(outcome, folder)
    count = len(files)
    progress.stage("depth maps", count)
    each = math.ceil(config.clouds.max_points / count) if config.clouds.max_points else None
    pairs, seen, there, truth = {}, [], [], []
    for pair in depth_pairs(outcome, files, config.units.depth_unit, max(1, config.max_pixels // count)):
        pairs[pair.name] = (pair.predicted * np.float32(config.units.metres_per_unit), pair.truth)
        if not true_poses or pair.name in true_poses:
            mine, yours, every = _as_points(
                pair, true_poses.get(pair.name), config.units.metres_per_unit, each
            )
            seen.append(mine)
            there.append(yours)
            truth.append(every)
        progress.advance(1)
    if not truth:
        raise InputError(f"no image has both a true pose and a map in {folder}")
    return Pixels(pairs, np.concatenate(seen), np.concatenate(there), np.concatenate(truth))


def _as_points(
    pair: DepthPair, true_pose: Floats | None, metres_per_unit: float, most: int | None
) -> tuple[Floats, Floats, Floats]:
    """(predicted, true at the same pixels, true at all pixels), at most ``most`` pixels of the view."""
    usable = np.flatnonzero(np.isfinite(pair.rays).all(1))
    if most is not None and len(usable) > most:
        usable = np.sort(np.random.default_rng(0).choice(usable, most, replace=False))
    rays, predicted = pair.rays[usable], pair.predicted[usable].astype(np.float64)
    if true_pose is None:
        true_pose = Similarity(metres_per_unit).poses(pair.world_from_cam)
    every = _world(true_pose, rays, pair.truth[usable].astype(np.float64))
    has = predicted > 0
    return _world(pair.world_from_cam, rays[has], predicted[has]), every[has], every


def _world(pose: Floats, rays: Floats, depth: Floats) -> Floats:
    return (rays * depth[:, None]) @ pose[:3, :3].T + pose[:3, 3]


def depth_section(pixels: Pixels, config: EvaluateConfig) -> dict[str, Any]:
    """Figures over all views, and those of each, with the scale of all.

    Raises:
        InputError: no measured pixel has a prediction.
    """
    predicted, truth = (np.concatenate([pair[i] for pair in pixels.pairs.values()]) for i in (0, 1))
    try:
        every = depth_figures(
            predicted.astype(np.float64),
            truth.astype(np.float64),
            config.units.scaling,  # type: ignore[arg-type]
        )
    except ValueError as error:
        raise InputError(f"depth maps: {error}") from error
    both = predicted > 0
    ratio = float(np.median(truth[both].astype(np.float64) / predicted[both]))
    if config.units.scaling == "none" and unit_mismatch(ratio):
        log.warning(
            "the true depths are %.4g times the predicted ones: a difference of units rather than an error? "
            "The length of one unit of the model is given with --metres_per_unit (%.6g would fit), or left "
            "open with --scaling median",
            ratio, ratio * config.units.metres_per_unit,
        )  # fmt: skip
    views = {name: _view_figures(*pair, every) for name, pair in pixels.pairs.items()}
    return {**asdict(every), "median_ratio": ratio, "scaling": config.units.scaling, "views": views}


def unit_mismatch(ratio: float) -> str:
    """Why true depths cannot be projected back from the result's own cameras; empty if they can.

    Args:
        ratio: median of true over predicted depth. Where it is far from 1, the distances of the cameras are
            in another unit than the depths, and the points of different views do not fit together.
    """
    if 1 / _FAR_OFF < ratio < _FAR_OFF:
        return ""
    return (
        f"for the true depths are {ratio:.4g} times the predicted ones, so that the result's cameras are not "
        "in their unit; give --metres_per_unit, or true cameras as a further --truth"
    )


def _view_figures(
    predicted: NDArray[np.float32], truth: NDArray[np.float32], every: DepthFigures
) -> dict[str, float] | None:
    """Figures of one view with the scale of all; None where it has no pixel to compare."""
    scaled = np.where(predicted > 0, every.scale * predicted.astype(np.float64) + every.shift, 0)
    if not ((scaled > 0) & (truth > 0)).any():
        return None
    figures = depth_figures(scaled, truth.astype(np.float64))
    return {name: getattr(figures, name) for name in _VIEW_FIGURES}


def cloud_section(
    outcome: Outcome,
    surface: CloudTruth | None,
    pixels: Pixels | None,
    poses: Mapping[str, Floats],
    config: EvaluateConfig,
) -> dict[str, Any]:
    """Distances and F-scores of the cloud after the alignment that was asked for.

    Args:
        outcome: the result.
        surface: the truth; None: the points of the true depth maps.
        pixels: of the depth maps, if any are true.
        poses: name → true world_from_cam, for the alignment by camera centres.
        config: alignment, thresholds, sizes.

    Raises:
        InputError: no cloud, or nothing to align by.
    """
    scans: tuple[Scan, ...] = ()
    if surface is not None:
        scans = surface.scans
        truth = surface.points(config.clouds.max_points or MESH_POINTS, config.seed)
    else:
        assert pixels is not None, "without a cloud the truth is made of depth maps"
        truth = pixels.truth
    points = _points(outcome, pixels, config)
    # Pixels correspond in the frame of a cloud of its own only where true cameras say how.
    pairs = pixels if surface is None or poses else None
    moved_by = _aligned(points, truth, _correspondences(outcome, pairs, poses, config), config)
    used, truth_used = (thinned(cloud, config.clouds.max_points) for cloud in (moved_by.apply(points), truth))
    try:
        figures = compare_clouds(used, truth_used)
        scores = _scores(used, truth_used, scans, config)
    except ValueError as error:
        raise InputError(f"the cloud cannot be compared: {error}") from error
    return {
        **asdict(figures),
        "points": len(used),
        "truth_points": len(truth_used),
        "of_points": len(points),
        "of_truth_points": len(truth),
        "cloud": config.clouds.cloud,
        "align": config.clouds.align,
        "truth_from_result": moved_by.matrix.tolist(),
        "scale": moved_by.scale,
        "f_score": config.clouds.f_score,
        "free_space": bool(scans) and config.clouds.f_score == "eth3d",
        "thresholds": [
            {"threshold": t, **asdict(score)}
            for t, score in zip(config.clouds.thresholds, scores, strict=True)
        ],
    }


def _points(outcome: Outcome, pixels: Pixels | None, config: EvaluateConfig) -> Floats:
    if config.clouds.cloud == "pixels":
        if pixels is None:
            raise InputError("--cloud pixels takes true depth maps; --cloud fused takes the cloud as it is")
        if not len(pixels.seen):
            raise InputError("no measured pixel has a predicted depth")
        return pixels.seen
    if outcome.cloud is None:
        raise InputError(
            f"{outcome.path} has no cloud (fused.ply) to compare; --cloud pixels takes the depth maps instead"
        )
    return read_points(outcome.cloud, config.clouds.max_points or MESH_POINTS, config.seed)


def _correspondences(
    outcome: Outcome, pixels: Pixels | None, poses: Mapping[str, Floats], config: EvaluateConfig
) -> tuple[Floats, Floats] | None:
    """Points (K, 3) and where they truly are (K, 3): pixels where there is true depth, else camera centres.

    Raises:
        InputError: neither is there, though a similarity is asked for.
    """
    if config.clouds.align != "sim3":
        return None
    if pixels is not None:
        return pixels.seen, pixels.there
    if not poses:
        raise InputError(
            "--align sim3 needs corresponding points: name the true cameras too, as in "
            "--truth scan.ply,cameras (a COLMAP model or a TUM trajectory), or use --align icp or none"
        )
    centres = world_from_cam([outcome.cameras[name] for name in poses])[:, :3, 3]
    return centres, np.stack(list(poses.values()))[:, :3, 3]


def _aligned(
    points: Floats, truth: Floats, known: tuple[Floats, Floats] | None, config: EvaluateConfig
) -> Similarity:
    """truth_from_result: the similarity of the known points, then ICP, as far as asked for."""
    start = Similarity(config.units.metres_per_unit)
    if known is not None:
        try:
            start = umeyama(*known)
        except ValueError as error:
            raise InputError(f"--align sim3: {error}") from error
    if config.clouds.align == "none" or not config.clouds.icp_threshold:
        return start
    # ICP looks at the whole truth but at no more of the points than count afterwards.
    return icp(thinned(points, config.clouds.max_points), truth, config.clouds.icp_threshold, start)


def _scores(
    points: Floats, truth: Floats, scans: Sequence[Scan], config: EvaluateConfig
) -> tuple[FScore, ...]:
    if config.clouds.f_score == "eth3d" and scans:
        return eth3d_curve(points, scans, config.clouds.thresholds, config.clouds.voxel_size)
    if config.clouds.f_score == "eth3d":
        return voxel_curve(points, truth, config.clouds.thresholds, config.clouds.voxel_size)
    voxel = config.clouds.thresholds[0] / 2 if config.clouds.f_score == "tanks" else None
    return f_curve(points, truth, config.clouds.thresholds, voxel)


def thinned(points: Floats, most: int) -> Floats:
    """At most so many points (K, 3), chosen at random, the same each time; 0 keeps all."""
    if not 0 < most < len(points):
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), most, replace=False))]


def pose_section(outcome: Outcome, poses: Mapping[str, Floats], config: EvaluateConfig) -> dict[str, Any]:
    """ATE, RPE and angular accuracy of the cameras of the images that have a true pose, ordered by name.

    Without evo, or where the cameras determine no alignment, there is no ATE and RPE; the figures say why.

    Raises:
        InputError: fewer than two images, or matrices that are no poses.
    """
    names = sorted(poses)
    estimated = Similarity(config.units.metres_per_unit).poses(
        world_from_cam([outcome.cameras[name] for name in names])
    )
    true = np.stack([poses[name] for name in names])
    figures: dict[str, Any] = {"images": len(names), "with_scale": config.units.pose_scale, "left_out": ""}
    try:
        angles = pose_auc(estimated, true)
    except ValueError as error:
        raise InputError(f"cameras of {outcome.path}: {error}") from error
    figures |= {field.name: getattr(angles, field.name) for field in fields(angles)}
    try:
        figures |= asdict(trajectory_figures(estimated, true, config.units.pose_scale))
    except (ValueError, MissingError) as error:
        log.warning("ATE and RPE are left out: %s", error)
        figures["left_out"] = str(error)
    return figures
