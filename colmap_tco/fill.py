"""An existing PatchMatch result is kept where it has depths, and ours fill what it left open.

COLMAP's geometric depth maps hold what survived its own consistency filters, so that every depth in them
is one that it is sure of. Its undistorted cameras differ from ours in size and principal point alone:
centre and orientation are those of the model, so a depth along a ray is the same number in both, and
only the pixels move. A map is resampled by the tangent plane of the nearest pixel: exact on planes, and
nothing is interpolated across a discontinuity.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco.errors import InputError
from colmap_tco.maps import map_intrinsics, read_map
from colmap_tco.outputs import ViewMaps
from colmap_tco.pinhole import Pinhole
from colmap_tco.views import View, map_mask
from colmap_tco.workspace import DensePaths
from tco.config import check_range, knob

log = logging.getLogger(__name__)

_SAME_ANGLE, _SAME_PLACE = 1e-4, 1e-4
"""Radians, and parts of the spread of the camera centres, by which poses of one model may differ."""
_MOST_TILT = 1.3
"""Largest ratio of depths within one pixel that is ascribed to a slanted surface."""


@dataclass(frozen=True)
class FillConfig:
    """An earlier result to complete."""

    fill_only: str = knob(
        "",
        "dense workspace of COLMAP, with sparse/ and geometric depth and normal maps in stereo/, made from "
        "the same model: its depths are kept and only the pixels without one are filled. Empty: none.",
    )
    kept_confidence: float = knob(
        30.0,
        "confidence of the depths that fill_only keeps; that of the network's own is 1 to about 30. It is "
        "their weight where the fusion averages views.",
    )

    def __post_init__(self) -> None:
        check_range(self, "kept_confidence", 1)

    @property
    def sure(self) -> float:
        """Confidence by which the fusion knows the depths that are kept; infinity where none are."""
        return self.kept_confidence if self.fill_only else math.inf


@dataclass(frozen=True)
class Existing:
    """A checked PatchMatch result.

    Attributes:
        paths: its dense workspace.
        cameras: name → pinhole of its undistorted image, for the views that have both maps.
        confidence: of its depths.
    """

    paths: DensePaths
    cameras: Mapping[str, Pinhole]
    confidence: float

    def files(self) -> list[Path]:
        """The maps that decide the result."""
        return [f(name) for name in self.cameras for f in (self.paths.depth_map, self.paths.normal_map)]


def open_existing(config: FillConfig, views: Sequence[View]) -> Existing | None:
    """The PatchMatch result that the settings name, or None if they name none.

    Raises:
        InputError: it has no model or no geometric maps of these views, its images are distorted, or its
            cameras stand elsewhere than those of the views.
    """
    if not config.fill_only:
        return None
    paths = DensePaths(Path(config.fill_only))
    for folder in (paths.sparse, paths.stereo / "depth_maps"):
        if not folder.is_dir():
            raise InputError(
                f"--fill_only {paths.root}: there is no {folder.relative_to(paths.root)}; name the dense "
                "workspace in which image_undistorter and patch_match_stereo have run"
            )
    theirs = {entry.name: entry for entry in _pycolmap.registered(_pycolmap.read_model(paths.sparse))}
    spread = _spread(views)
    cameras = {}
    for view in views:
        if view.name not in theirs or not paths.depth_map(view.name).is_file():
            continue
        if not paths.normal_map(view.name).is_file():
            raise InputError(f"{paths.normal_map(view.name)} is missing, its depth map is there")
        _check_pose(paths, view, theirs[view.name].cam_from_world, spread)
        cameras[view.name] = _pinhole(paths, theirs[view.name])
    if not cameras:
        raise InputError(
            f"--fill_only {paths.root} holds no geometric depth map of these views, expected for instance "
            f"{paths.depth_map(views[0].name)}; run patch_match_stereo with geom_consistency"
        )
    log.info("%d of %d views have a depth map in %s", len(cameras), len(views), paths.root)
    return Existing(paths, cameras, config.kept_confidence)


def fill(existing: Existing, view: View, maps: ViewMaps) -> tuple[ViewMaps, dict[str, object]]:
    """The maps of a view with the existing depths kept, and how many pixels are kept and filled.

    The result has the resolution of the finer of the two, at most that of the undistorted image; a view
    without an existing map comes back as it is. What its mask excludes is neither kept nor filled.

    Raises:
        InputError: a map is damaged, or the two of a view differ in size.
    """
    if view.name not in existing.cameras:
        return maps, _counts(0, maps.depth)
    theirs = existing.cameras[view.name]
    depth = read_map(existing.paths.depth_map(view.name))
    normal = read_map(existing.paths.normal_map(view.name))
    if normal.shape != (*depth.shape, 3):
        raise InputError(
            f"{existing.paths.normal_map(view.name)}: {normal.shape} does not fit the depths {depth.shape}"
        )
    scale = min(max(depth.shape[1] / theirs.width, maps.depth.shape[1] / view.camera.width), 1.0)
    shape = (round(view.camera.height * scale), round(view.camera.width * scale))
    rays = _rays(view.camera, shape)
    ours = _resampled((maps.depth, maps.normal), view.camera, rays)
    kept = _resampled((depth, normal), theirs, rays)
    confidence = np.ones(shape, np.float32)
    confidence[ours.found] = maps.confidence[ours.row[ours.found], ours.col[ours.found]]
    take, mask = kept.found, map_mask(view, shape)
    confidence[take] = existing.confidence
    error = np.zeros(shape, np.float32)
    if maps.error is not None:
        error[ours.found] = maps.error[ours.row[ours.found], ours.col[ours.found]]
    error[take] = 0
    merged = ViewMaps(
        np.where(take, kept.depth, ours.depth),
        np.where(take[..., None], kept.normal, ours.normal),
        confidence,
        None if maps.error is None else error,
    )
    if mask is not None:
        take &= mask
        merged.depth[~mask], merged.normal[~mask], merged.confidence[~mask], error[~mask] = 0, 0, 1, 0
    return merged, _counts(int(take.sum()), merged.depth)


def _counts(kept: int, depth: NDArray[np.float32]) -> dict[str, object]:
    return {"pixels_kept": kept, "pixels_filled": int((depth > 0).sum()) - kept}


def _spread(views: Sequence[View]) -> float:
    centres = np.stack([_centre(view.cam_from_world) for view in views])
    return float(np.linalg.norm(centres - centres.mean(0), axis=1).max())


def _centre(cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """World position (3,) of a camera."""
    centre: NDArray[np.float64] = -cam_from_world[:, :3].T @ cam_from_world[:, 3]
    return centre


def _check_pose(paths: DensePaths, view: View, pose: NDArray[np.float64], spread: float) -> None:
    turn = pose[:, :3] @ view.cam_from_world[:, :3].T
    angle = float(np.linalg.norm(turn - np.eye(3))) / np.sqrt(2)
    away = float(np.linalg.norm(_centre(pose) - _centre(view.cam_from_world)))
    if angle > _SAME_ANGLE or away > _SAME_PLACE * spread:
        raise InputError(
            f"--fill_only {paths.root}: the camera of {view.name} is turned by {np.degrees(angle):.3g}° and "
            f"moved by {away:.3g} against the model; it was made from another model, or that was adjusted "
            "or aligned since: run image_undistorter and patch_match_stereo on the present one"
        )


def _pinhole(paths: DensePaths, entry: _pycolmap.Registered) -> Pinhole:
    name = entry.camera.model.name
    if name not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise InputError(f"--fill_only {paths.root}: {entry.name} is of a {name} camera, not undistorted")
    width, height = _pycolmap.camera_size(entry.camera)
    fx, fy = _pycolmap.focal_lengths(entry.camera)
    cx, cy = _pycolmap.img_from_cam(entry.camera, np.zeros((1, 2)))[0].tolist()
    return Pinhole(width, height, fx, fy, cx, cy)


def _rays(camera: Pinhole, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Rays (H, W, 2), x and y for z = 1, through the pixels of a map of this shape."""
    fx, fy, cx, cy = map_intrinsics(camera, shape)
    x, y = np.meshgrid((np.arange(shape[1]) + 0.5 - cx) / fx, (np.arange(shape[0]) + 0.5 - cy) / fy)
    return np.stack([x, y], -1)


@dataclass(frozen=True)
class _Resampled:
    """A map at other pixels: depth (H, W), normal (H, W, 3), where there is one, and from which pixel."""

    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    found: NDArray[np.bool_]
    row: NDArray[np.int64]
    col: NDArray[np.int64]


def _resampled(
    maps: tuple[NDArray[np.float32], NDArray[np.float32]], camera: Pinhole, rays: NDArray[np.float64]
) -> _Resampled:
    """Depth and normal maps of ``camera`` along ``rays`` (H, W, 2) of a camera that stands the same."""
    depth, normal = maps
    height, width = depth.shape
    fx, fy, cx, cy = map_intrinsics(camera, depth.shape)
    u, v = rays[..., 0] * fx + cx, rays[..., 1] * fy + cy
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    col, row = np.where(inside, u, 0).astype(np.int64), np.where(inside, v, 0).astype(np.int64)
    n, d = normal[row, col], depth[row, col]
    there = n[..., 0] * (col + 0.5 - cx) / fx + n[..., 1] * (row + 0.5 - cy) / fy + n[..., 2]
    here = n[..., 0] * rays[..., 0] + n[..., 1] * rays[..., 1] + n[..., 2]
    # A plane that is nearly parallel to the ray says nothing: there the depth stands as it is.
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = there / here
        ratio = np.where((ratio > 1 / _MOST_TILT) & (ratio < _MOST_TILT), ratio, 1.0)
    found = inside & (d > 0)
    return _Resampled(
        np.where(found, d * ratio, 0).astype(np.float32), np.where(found[..., None], n, 0), found, row, col
    )
