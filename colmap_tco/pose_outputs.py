"""What ``colmap-tco poses`` writes: a COLMAP workspace with undistorted images, a model, and a trajectory."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Floats, Ints, PinholeImage, Registered
from colmap_tco.outputs import write_image, write_report
from colmap_tco.views import View, canvas_camera, undistorted_image

OURS = "trajectory.txt"
"""The file by which a folder is known to be a result of this command."""
POINTS_OF_VIEW = 300
"""About how many points of the model each view gives."""
SAME = 0.02
"""Relative difference of depths below which two views see the same point."""


@dataclass(frozen=True)
class Found:
    """V views with what was found.

    Attributes:
        views: as their images are undistorted.
        moved: the same with the poses and focal lengths that were found, in the unit of the depths.
        depth: (V, H, W) measured, on the canvas of the views' network images; 0 where it is not.
    """

    views: tuple[View, ...]
    moved: tuple[View, ...]
    depth: Floats


def write(output: Path, found: Found, figures: Mapping[str, object]) -> None:
    """Write the result; an earlier one is replaced when the new one is complete.

    Raises:
        DensifyError: an image has a format that cannot be written.
    """
    partial = output.with_name(f".{output.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    try:
        images = []
        for view in found.views:
            picture, _ = undistorted_image(view)
            write_image(partial / "images" / view.name, picture)
            images.append(picture)
        model = partial / "sparse" / "0"
        model.mkdir(parents=True)
        _write_model(model, found, images)
        write_trajectory(partial / OURS, found.moved)
        write_report(partial / "report.json", figures)
        shutil.rmtree(output, ignore_errors=True)
        partial.replace(output)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _write_model(folder: Path, found: Found, pictures: Sequence[NDArray[np.uint8]]) -> None:
    """PINHOLE cameras and poses, and points of the measured surfaces with the views that see them."""
    keypoints, owners, cloud = surface_points(found, pictures)
    images = []
    for view, xy, points in zip(found.moved, keypoints, owners, strict=True):
        c = view.camera
        entry = Registered(view.image_id, view.name, view.original, view.cam_from_world)
        images.append(PinholeImage(entry, (c.width, c.height, c.fx, c.fy, c.cx, c.cy), xy, points))
    model = _pycolmap.pinhole_model(images, cloud)
    for view in found.moved:
        model.images[view.image_id].name = view.name  # COLMAP's text format ends a name at a space
    model.write(str(folder))


def write_trajectory(path: Path, views: Sequence[View]) -> None:
    """TUM's format, ``timestamp tx ty tz qx qy qz qw``, in the order of the names.

    The timestamp is the number that the file's name is, if all are numbers, else the place in the order.
    """
    from scipy.spatial.transform import Rotation

    stems = [Path(view.name).stem for view in views]
    named = all(_is_number(stem) for stem in stems)
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for place, (stem, view) in enumerate(zip(stems, views, strict=True)):
        R = view.cam_from_world[:, :3].T
        numbers = [*(-R @ view.cam_from_world[:, 3]).tolist(), *Rotation.from_matrix(R).as_quat().tolist()]
        lines.append(" ".join([stem if named else str(place), *(f"{value:.9f}" for value in numbers)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def surface_points(
    found: Found, pictures: Sequence[NDArray[np.uint8]]
) -> tuple[list[Floats], list[Ints], tuple[Ints, Floats, NDArray[np.uint8]]]:
    """Points on a grid of each view's measured pixels, and where the views see them that measured the same.

    They are what matches are to a model of structure from motion: they tell what overlaps, and how far the
    surfaces are.

    Returns:
        Keypoints (N, 2) of each view in its undistorted image, the points (N,) they are of, and ids (P,),
        positions (P, 3) and colours (P, 3) of the points.
    """
    canvas = found.depth.shape[1:]
    cameras = [canvas_camera(view, canvas) for view in found.views]
    K = [np.array([c.fx, c.fy]) * (m.camera.fx / v.camera.fx)
         for c, v, m in zip(cameras, found.views, found.moved, strict=True)]  # fmt: skip
    middle = np.array(canvas[::-1]) / 2
    keypoints: list[list[Floats]] = [[] for _ in found.views]
    owners: list[list[Ints]] = [[] for _ in found.views]
    clouds, colors, count = [], [], 0
    for source, view in enumerate(found.moved):
        rows, columns = _grid(found.depth[source])
        z = found.depth[source][rows, columns]
        rays = (np.stack([columns + 0.5, rows + 0.5], 1) - middle) / K[source]
        local = np.c_[rays, np.ones(len(rays))] * z[:, None]
        world = (local - view.cam_from_world[:, 3]) @ view.cam_from_world[:, :3]
        ids = np.arange(count + 1, count + 1 + len(world), dtype=np.int64)
        count += len(world)
        full = np.floor(view.camera.pixels(rays)).astype(int)
        size = (view.camera.width - 1, view.camera.height - 1)
        x, y = np.clip(full, 0, size).T
        clouds.append(world)
        colors.append(pictures[source][y, x])
        for target, other in enumerate(found.moved):
            seen = _seen(world, other, K[target], found.depth[target])
            xyz = world[seen] @ other.cam_from_world[:, :3].T + other.cam_from_world[:, 3]
            keypoints[target].append(other.camera.pixels(xyz[:, :2] / xyz[:, 2:]))
            owners[target].append(ids[seen])
    cloud = (np.arange(1, count + 1, dtype=np.int64), np.concatenate(clouds), np.concatenate(colors))
    return [np.concatenate(xy) for xy in keypoints], [np.concatenate(ids) for ids in owners], cloud


def _grid(depth: Floats) -> tuple[Ints, Ints]:
    """Rows and columns of about :data:`POINTS_OF_VIEW` pixels with depth, evenly spread."""
    step = max(1, round((np.count_nonzero(depth) / POINTS_OF_VIEW) ** 0.5))
    rows, columns = np.nonzero(depth[step // 2 :: step, step // 2 :: step])
    return rows * step + step // 2, columns * step + step // 2


def _seen(world: Floats, view: View, focal: Floats, depth: Floats) -> NDArray[np.bool_]:
    """Which points (N, 3) a view measured, at the pixel that each falls into, within :data:`SAME`."""
    h, w = depth.shape
    xyz = world @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
    z = np.maximum(xyz[:, 2], 1e-9)
    at = np.floor(xyz[:, :2] / z[:, None] * focal + (w / 2, h / 2))
    inside = (xyz[:, 2] > 0) & (at >= 0).all(1) & (at < (w, h)).all(1)
    x, y = np.where(inside[:, None], at, 0).astype(int).T
    measured = depth[y, x]
    return np.asarray(inside & (measured > 0) & (np.abs(measured / z - 1) < SAME))
