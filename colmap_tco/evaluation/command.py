"""``colmap-tco evaluate``: compare a result with the truth and write the figures."""

from __future__ import annotations

import json
import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from colmap_tco.atomic import write_text
from colmap_tco.errors import InputError
from colmap_tco.evaluation.align import ICP_THRESHOLD
from colmap_tco.evaluation.eth3d import TOLERANCES, VOXEL_SIZE
from colmap_tco.evaluation.sections import (
    cloud_section,
    depth_section,
    pose_section,
    read_pixels,
    unit_mismatch,
)
from colmap_tco.evaluation.sources import (
    CloudTruth,
    DepthTruth,
    Outcome,
    PoseTruth,
    Truth,
    matched,
    open_outcome,
    open_truth,
)
from colmap_tco.flags import settings
from colmap_tco.progress import Progress
from tco.config import knob

log = logging.getLogger(__name__)

KIND = "colmap-tco evaluation"
T = TypeVar("T")


def _check_positive(config: object, *names: str) -> None:
    for name in names:
        if not 0 < getattr(config, name) < math.inf:
            raise ValueError(f"--{name} must be positive, it is {getattr(config, name)}")


def _check_not_negative(config: object, *names: str) -> None:
    for name in names:
        if not 0 <= getattr(config, name) < math.inf:
            raise ValueError(f"--{name} must not be negative, it is {getattr(config, name)}")


@dataclass(frozen=True)
class UnitConfig:
    """Units."""

    metres_per_unit: float = knob(
        1.0, "Length of one unit of the result in the truth's unit. COLMAP's unit is arbitrary."
    )
    depth_unit: float = knob(
        0.0, "Length of one step of true depth maps in the truth's unit; 0: 0.001 for PNG (mm), 1 for others."
    )
    scaling: str = knob(
        "none",
        "What is done to predicted depths before they are compared: median: times the ratio of medians; "
        "scale: least squares; scale_shift: least squares with a constant. One for all views.",
        choices=("none", "median", "scale", "scale_shift"),
    )
    pose_scale: bool = knob(
        True, "Align camera centres with scale (Sim(3), as the paper does); --no_pose_scale: rigidly."
    )

    def __post_init__(self) -> None:
        _check_positive(self, "metres_per_unit")
        _check_not_negative(self, "depth_unit")


@dataclass(frozen=True)
class CloudConfig:
    """The cloud."""

    cloud: str = knob(
        "fused",
        "fused: the fused cloud. pixels: the depth maps at all pixels that have a true depth, as in the "
        "paper's tables.",
        choices=("fused", "pixels"),
    )
    align: str = knob(
        "none",
        "none: the result is in the truth's frame, but for --metres_per_unit. icp: refine from there. sim3: "
        "the paper's protocol, a similarity by corresponding pixels (true depth maps) or camera centres "
        "(true cameras), then ICP.",
        choices=("none", "icp", "sim3"),
    )
    icp_threshold: float = knob(
        ICP_THRESHOLD, "Greatest distance of ICP's pairs, in the truth's unit; 0.1 m, 100 for DTU. 0: no ICP."
    )
    thresholds: tuple[float, ...] = knob(
        TOLERANCES, "Distances at which the F-score is taken, in the truth's unit."
    )
    f_score: str = knob(
        "plain",
        "plain: shares of all points. tanks: as Tanks and Temples, both clouds thinned once with voxels of "
        "half the first threshold, which is the scene's; others are of its curve. eth3d: as "
        "ETH3D, shares within voxels, averaged over these; "
        "with scans (.mlp) free space counts too.",
        choices=("plain", "tanks", "eth3d"),
    )
    voxel_size: float = knob(VOXEL_SIZE, "eth3d: side of the voxels, in the truth's unit.")
    max_points: int = knob(1_000_000, "Points of either cloud that count, chosen at random of more; 0: all.")

    def __post_init__(self) -> None:
        _check_positive(self, "voxel_size")
        _check_not_negative(self, "icp_threshold", "max_points")
        if not self.thresholds or any(not 0 < t < math.inf for t in self.thresholds):
            raise ValueError(f"--thresholds must be positive numbers, they are {self.thresholds}")
        if self.align == "icp" and not self.icp_threshold:
            raise ValueError("--align icp needs an --icp_threshold above 0")


@dataclass(frozen=True)
class EvaluateConfig:
    """Truth and figures."""

    truth: tuple[Path, ...] = knob(
        (),
        "One or more, separated by commas: a cloud, a mesh, or laser scans (.mlp); a folder of depth maps "
        "(16-bit PNG, .npy, COLMAP's .bin) named as the images; cameras (a COLMAP model, a TUM trajectory).",
    )
    model_path: Path | None = knob(
        None,
        "Model of the images that true depth maps and cameras belong to; none: for our own results the one "
        "that they were made from, for others their own.",
    )
    units: UnitConfig = UnitConfig()
    clouds: CloudConfig = CloudConfig()
    match: str = knob(
        "time",
        "How lines of a TUM trajectory belong to images. time: the image's name is its timestamp. order: "
        "line k is the k-th image by name.",
        choices=("time", "order"),
    )
    max_time_difference: float = knob(0.02, "Greatest difference of matching timestamps, seconds.")
    max_pixels: int = knob(20_000_000, "Pixels with a true depth that count, over all views.")
    output_path: Path | None = knob(
        None, "JSON file; none: evaluation.json in dense-tco/, of other results NAME-evaluation.json beside",
        alias="-o",
    )  # fmt: skip
    seed: int = knob(0, "Of the points that are spread over meshes.")

    def __post_init__(self) -> None:
        _check_positive(self, "max_pixels")
        _check_not_negative(self, "max_time_difference")


@dataclass(frozen=True)
class Evaluation:
    """Figures and where they are.

    Attributes:
        path: the JSON file.
        figures: what is in it.
    """

    path: Path
    figures: dict[str, Any]

    def summary(self) -> str:
        """The figures as tables."""
        tables = [
            table
            for name, table_of in (("depth", _depth_table), ("cloud", _cloud_table), ("poses", _pose_table))
            if self.figures[name] is not None
            for table in table_of(self.figures[name])
        ]
        if self.figures["cloud_left_out"]:
            tables.append(f"cloud: left out, {self.figures['cloud_left_out']}")
        return "\n".join([*tables, f"figures: {self.path}"])


def evaluate(path: Path, config: EvaluateConfig, progress: Progress) -> Evaluation:
    """Compare a result with everything that is true of it, and write the figures as JSON.

    Args:
        path: a workspace with ``dense-tco/``, a dense workspace of COLMAP, a COLMAP model, or a cloud.
        config: what is true, units, alignment.
        progress: of the stages.

    Raises:
        InputError: something is missing, damaged, or cannot be compared; the message says with what.
        MissingError: Open3D cannot be imported.
    """
    if not config.truth:
        raise InputError("--truth is missing: name what the result is to be compared with")
    outcome = open_outcome(path, config.model_path)
    target = _target(outcome, config)
    truths = _open_truths(config.truth)
    _check_comparable(outcome, truths)
    figures: dict[str, Any] = {
        "kind": KIND,
        "result": str(outcome.path),
        "truth": [str(one.expanduser().absolute()) for one in config.truth],
        "settings": _shown(config),
        **_sections(outcome, truths, config, progress),
    }
    write_text(target, json.dumps(figures, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    return Evaluation(target, figures)


@dataclass(frozen=True)
class _Truths:
    """What is true, one of a kind."""

    depth: DepthTruth | None
    surface: CloudTruth | None
    poses: PoseTruth | None


def _sections(
    outcome: Outcome, truths: _Truths, config: EvaluateConfig, progress: Progress
) -> dict[str, Any]:
    """The parts of the evaluation that the truths allow; None for the others."""
    depth = cloud = cameras = None
    left_out = ""
    true_poses = (
        {}
        if truths.poses is None
        else matched(outcome, truths.poses, config.match, config.max_time_difference)
    )
    pixels = None
    if truths.depth is not None:
        pixels = read_pixels(outcome, truths.depth.path, true_poses, config, progress)
        depth = depth_section(pixels, config)
        if truths.surface is None and not true_poses:
            left_out = unit_mismatch(depth["median_ratio"])
    if not left_out and (truths.surface or (pixels and (outcome.cloud or config.clouds.cloud == "pixels"))):
        progress.stage("cloud", 1)
        cloud = cloud_section(outcome, truths.surface, pixels, true_poses, config)
        progress.advance(1)
    if true_poses:
        progress.stage("cameras", 1)
        cameras = pose_section(outcome, true_poses, config)
        progress.advance(1)
    return {"depth": depth, "cloud": cloud, "cloud_left_out": left_out, "poses": cameras}


def _target(outcome: Outcome, config: EvaluateConfig) -> Path:
    """The file for the figures; an earlier evaluation there is replaced, nothing else.

    Raises:
        InputError: another file is there.
    """
    path = outcome.figures if config.output_path is None else config.output_path.expanduser().absolute()
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a JSON file with -o")
    if path.exists():
        try:
            earlier = json.loads(path.read_text(encoding="utf-8"))
        except (ValueError, OSError):
            earlier = None
        if not isinstance(earlier, dict) or earlier.get("kind") != KIND:
            raise InputError(f"{path} exists and is no earlier evaluation; name another file with -o")
    return path


def _open_truths(paths: tuple[Path, ...]) -> _Truths:
    """What lies at the paths.

    Raises:
        InputError: one is no truth, or two are of the same kind.
    """
    truths = [open_truth(path) for path in paths]
    return _Truths(_only(truths, DepthTruth), _only(truths, CloudTruth), _only(truths, PoseTruth))


def _only(truths: list[Truth], kind: type[T]) -> T | None:
    found = [truth for truth in truths if isinstance(truth, kind)]
    if len(found) > 1:
        named = " and ".join(str(truth.path) for truth in truths if isinstance(truth, kind))
        raise InputError(f"--truth: {named} are of the same kind; evaluate them one after the other")
    return found[0] if found else None


def _check_comparable(outcome: Outcome, truths: _Truths) -> None:
    if truths.depth is not None and outcome.dense is None:
        raise InputError(
            f"{outcome.path} has no depth maps to compare with {truths.depth.path}; name a dense workspace"
        )
    if truths.poses is not None and not outcome.cameras:
        raise InputError(
            f"{outcome.path} has no cameras to compare with {truths.poses.path}; name its model with "
            "--model_path"
        )
    if truths.surface is not None and outcome.cloud is None and truths.depth is None:
        raise InputError(
            f"{outcome.path} has no cloud to compare with {truths.surface.path}; densify it first"
        )


def _shown(config: EvaluateConfig) -> dict[str, str]:
    """The settings as their flags would have them, but for paths."""
    parts = (config, config.units, config.clouds)
    return {
        setting.name: setting.show(getattr(part, setting.name))
        for setting in settings(EvaluateConfig)
        for part in parts
        if isinstance(part, setting.owner) and setting.base is not Path
    }


def _depth_table(depth: dict[str, Any]) -> list[str]:
    scaled = "" if depth["scaling"] == "none" else f", predictions × {depth['scale']:.4g}"
    scaled += f" + {depth['shift']:.4g}" if depth["shift"] else ""
    return [
        f"depth, {depth['pixels']} measured pixels of {len(depth['views'])} images{scaled}",
        _row(("covered", "AbsRel", "median", "RMSE", "δ1.25", "δ1.25²", "δ1.25³", "in 2 %", "in 5 %")),
        _row(
            [f"{depth['coverage']:.1%}", f"{depth['abs_rel']:.2%}", f"{depth['median']:.2%}"]
            + [f"{depth['rmse']:.4g}"]
            + [f"{depth[name]:.1%}" for name in ("delta_1_25", "delta_1_25_2", "delta_1_25_3", "d2", "d5")]
        ),
    ]


def _cloud_table(cloud: dict[str, Any]) -> list[str]:
    names = ("accuracy", "completion", "normal_consistency")
    lines = [
        f"cloud, {cloud['points']} points against {cloud['truth_points']}, aligned by: {cloud['align']}",
        _row(("", "accuracy", "completion", "normals")),
        *(_row([k, *(f"{cloud[f'{name}_{k}']:.4g}" for name in names)]) for k in ("mean", "median")),
        _row(("below", "precision", "recall", "F")),
    ]
    for row in cloud["thresholds"]:
        shares = [f"{row[name]:.1%}" for name in ("precision", "recall", "f")]
        lines.append(_row([f"{row['threshold']:g}", *shares]))
    return lines


def _pose_table(poses: dict[str, Any]) -> list[str]:
    lines = [f"cameras, {poses['images']} images, {poses['pairs']} pairs"]
    if poses["left_out"]:
        lines.append(f"  ATE and RPE are left out: {poses['left_out']}")
    else:
        lines.append(
            f"  ATE {poses['ate_rmse']:.4g}, RPE {poses['rpe_translation']:.4g} and "
            f"{poses['rpe_rotation_deg']:.4g}°"
        )
    lines.append(_row(("within", "rotations", "directions", "AUC")))
    for values in zip(poses["thresholds"], poses["rra"], poses["rta"], poses["auc"], strict=True):
        lines.append(_row([f"{values[0]}°", *(f"{value:.1%}" for value in values[1:])]))
    return lines


def _row(cells: list[str] | tuple[str, ...]) -> str:
    return "  " + "".join(f"{cell:>12}" for cell in cells).rstrip()
