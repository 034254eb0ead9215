"""For trainers of 3D Gaussian splats: ``images/`` and ``sparse/0`` with the cloud as its points.

They read PINHOLE cameras, images by the last part of their names, and start from the points of the model;
some (the original one) read ``sparse/0/points3D.ply`` in their place where it exists. All compute in float32,
so that a model in map coordinates is moved to the origin (:mod:`colmap_tco.export.centred`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from colmap_tco.export.centred import moved, offset_for, tell_offset
from colmap_tco.export.command import copy_images
from colmap_tco.export.dense import Dense, flat_names, thinned
from colmap_tco.export.tracks import dense_model
from colmap_tco.ply import write_ply
from colmap_tco.sparse_format import write_binary

USUAL_POINTS = 400_000
"""Trainers start well from 300 to 500 thousand points."""


def write_3dgs(dense: Dense, folder: Path, max_points: int) -> str:
    """Fill ``folder``; returns a sentence on what is in it.

    Raises:
        InputError: no cloud, no visibility, or a missing image.
    """
    cloud = dense.cloud()
    offset = offset_for(cloud.points)
    cloud = thinned(cloud, max_points)
    names = flat_names([view.name for view in dense.views])
    model, cloud = dense_model(dense, cloud, names)
    copy_images(dense, names, folder / "images")
    write_binary(folder / "sparse" / "0", moved(model, offset))
    write_ply(folder / "sparse" / "0" / "points3D.ply", cloud.points - offset, cloud.normals, cloud.colors)
    tell_offset(folder, offset)
    track = len(model.points.images) / len(cloud)
    return (
        f"{len(dense.views)} images, {len(np.unique(model.points.ids))} points in sparse/0, "
        f"each seen by {track:.1f} images on average"
    )
