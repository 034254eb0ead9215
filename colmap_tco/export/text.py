"""COLMAP's text format, which is easy to read by programs and people: cameras, images, points3D."""

from __future__ import annotations

from pathlib import Path

from colmap_tco.export.dense import Dense, thinned
from colmap_tco.export.tracks import dense_model
from colmap_tco.sparse_format import write_model_text


def write_text_model(dense: Dense, folder: Path, max_points: int) -> str:
    """Fill ``folder`` with the model of the undistorted images and the cloud; returns what is in it.

    Raises:
        InputError: no cloud, no visibility, or a name that the format cannot hold.
    """
    cloud = thinned(dense.cloud(), max_points)
    model, cloud = dense_model(dense, cloud, {view.name: view.name for view in dense.views})
    write_model_text(folder, model)
    return f"{len(dense.views)} images, {len(cloud)} points"
