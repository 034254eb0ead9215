"""A finished dense workspace, read back: its views, who confirms each point, how sure the network was."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Model
from colmap_tco.errors import InputError
from colmap_tco.maps import map_shape, read_map
from colmap_tco.pinhole import Pinhole
from colmap_tco.ply import Visibility
from colmap_tco.views import View
from colmap_tco.workspace import DensePaths, dense_paths


def finished(root: Path) -> DensePaths:
    """The result of a workspace.

    Raises:
        InputError: there is none.
    """
    paths = dense_paths(root)
    if not paths.report.is_file():
        raise InputError(f"{paths.root} holds no finished result; make one with: colmap-tco densify {root}")
    return paths


def read_report(paths: DensePaths) -> dict[str, Any]:
    """What ``report.json`` says.

    Raises:
        InputError: it cannot be read.
    """
    try:
        found: dict[str, Any] = json.loads(paths.report.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{paths.report} cannot be read ({error}); make the result anew with --overwrite"
        ) from error
    return found


def dense_views(paths: DensePaths, model: Model) -> list[View]:
    """The views of the undistorted model that have a depth map, ordered by name.

    Their original camera is the undistorted one, and ``network`` has the size of the depth map.
    """
    views = []
    for entry in _pycolmap.registered(model):
        if not paths.depth_map(entry.name).is_file():
            continue
        fx, fy, cx, cy = (float(value) for value in entry.camera.params)
        camera = Pinhole(*_pycolmap.camera_size(entry.camera), fx, fy, cx, cy)
        height, width, _ = map_shape(paths.depth_map(entry.name))
        network, path = camera.resized(width, height), paths.image(entry.name)
        views.append(
            View(entry.name, entry.image_id, path, entry.camera, camera, network, entry.cam_from_world)
        )
    return views


def point_confidence(
    paths: DensePaths, views: Sequence[View | None], points: NDArray[np.floating], visibility: Visibility
) -> NDArray[np.float32]:
    """Mean confidence (N,) of each point of a cloud over the pixels of the views that confirm it.

    Args:
        paths: where the confidence maps are.
        views: by their position in ``reg_image_ids()``, as the visibility names them; None has no maps.
        points: (N, 3) in the frame of the model.
        visibility: of the points.
    """
    owner = np.repeat(np.arange(len(points)), np.diff(visibility.start))
    order = np.argsort(visibility.images, kind="stable")
    bounds = np.searchsorted(visibility.images[order], np.arange(len(views) + 1))
    total, count = np.zeros(len(points)), np.zeros(len(points))
    for position, view in enumerate(views):
        seen = owner[order[bounds[position] : bounds[position + 1]]]
        if view is None or not len(seen):
            continue
        confidence = read_map(paths.confidence_map(view.name))
        local = points[seen] @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
        front = local[:, 2] > 0
        xy = view.network.pixels(local[front, :2] / local[front, 2:])
        x, y = np.floor(xy).astype(int).T
        x, y = x.clip(0, view.network.width - 1), y.clip(0, view.network.height - 1)
        np.add.at(total, seen[front], confidence[y, x])
        np.add.at(count, seen[front], 1)
    return (total / np.maximum(count, 1)).astype(np.float32)


def by_position(model: Model, views: Sequence[View]) -> list[View | None]:
    """The views in the order of ``reg_image_ids()``, None where one has no maps."""
    named = {view.image_id: view for view in views}
    return [named.get(int(key)) for key in model.reg_image_ids()]


def thinned(visibility: Visibility, chosen: NDArray[np.integer]) -> Visibility:
    """The visibility of the points ``chosen`` (M,) alone, in that order."""
    count = np.diff(visibility.start)[chosen]
    start = np.concatenate([[0], count]).astype(np.int64).cumsum()
    at = np.repeat(visibility.start[chosen] - start[:-1], count) + np.arange(start[-1])
    return Visibility(start, visibility.images[at])
