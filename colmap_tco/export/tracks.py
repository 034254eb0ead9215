"""The fused cloud as points of a model: a track through every image that confirmed the point."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from colmap_tco.errors import InputError
from colmap_tco.export.dense import Dense, DenseView
from colmap_tco.ply import Cloud
from colmap_tco.sparse_format import SparseImage, SparseModel, SparsePoints

log = logging.getLogger(__name__)

FEWEST_VIEWS = 2
"""A track of fewer is none."""


def dense_model(dense: Dense, cloud: Cloud, names: Mapping[str, str]) -> tuple[SparseModel, Cloud]:
    """A model whose points are the cloud, with ids 1, 2, …, and the cloud of its points.

    The keypoints are the projections of the points into the images that confirmed them in the fusion; its
    tolerance (``max_reproj_error``) bounds how far the depths of those images place the point from there.
    Points that fall into fewer than two of their images are left out.

    Args:
        dense: the workspace.
        cloud: of it, or a part.
        names: name of an image → how it is to be called.

    Raises:
        InputError: no point is left.
    """
    count = np.diff(cloud.visibility.start)
    owner = np.repeat(np.arange(len(cloud)), count)
    xy = np.full((len(owner), 2), np.nan)
    for position, view in enumerate(dense.views):
        mine = cloud.visibility.images == position
        xy[mine] = project(view, cloud.points[owner[mine]])
    seen = np.isfinite(xy).all(1)
    enough = np.bincount(owner[seen], minlength=len(cloud)) >= FEWEST_VIEWS
    if not enough.any():
        raise InputError(
            f"{dense.paths.ply}: no point lies in two of the images that {dense.paths.vis.name} names"
        )
    if not enough.all():
        log.info("%d points are left out: they fall into fewer than two images", int((~enough).sum()))
    seen &= enough[owner]
    kept = cloud.select(np.flatnonzero(enough))
    new = np.cumsum(enough)  # position of a point that is kept, counted from 1: its id
    return _model(dense, kept, (cloud.visibility.images[seen], new[owner[seen]], xy[seen]), names), kept


def _model(
    dense: Dense,
    cloud: Cloud,
    observed: tuple[NDArray[np.uint32], NDArray[np.int64], NDArray[np.float64]],
    names: Mapping[str, str],
) -> SparseModel:
    """The model of observations (image position (M,), point id (M,), pixel (M, 2)), ordered by point."""
    position, point, xy = observed
    keypoints = np.empty(len(position), np.int64)
    images = []
    for i, view in enumerate(dense.views):
        mine = np.flatnonzero(position == i)
        keypoints[mine] = np.arange(len(mine))
        images.append(
            SparseImage(
                view.image_id, names[view.name], view.camera_id, view.cam_from_world, xy[mine], point[mine]
            )
        )
    ids = np.array([view.image_id for view in dense.views], np.int64)
    start = np.zeros(len(cloud) + 1, np.int64)
    start[1:] = np.bincount(point - 1, minlength=len(cloud)).cumsum()
    points = SparsePoints(
        np.arange(1, len(cloud) + 1), cloud.points, cloud.colors, np.zeros(len(cloud)), start,
        ids[position], keypoints,
    )  # fmt: skip
    return SparseModel({view.camera_id: view.camera for view in dense.views}, images, points)


def project(view: DenseView, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels (N, 2) of world points (N, 3); NaN behind the camera and outside the image."""
    rotation = view.cam_from_world[:, :3]
    centre = -rotation.T @ view.cam_from_world[:, 3]
    local = (points - centre) @ rotation.T  # the difference first: map coordinates have no digits to spare
    ahead = local[:, 2] > 0
    xy = np.full((len(points), 2), np.nan)
    xy[ahead] = view.camera.pixels(local[ahead, :2] / local[ahead, 2:])
    with np.errstate(invalid="ignore"):
        outside = ~((xy >= 0) & (xy <= (view.camera.width, view.camera.height))).all(1)
    xy[outside] = np.nan
    return xy
