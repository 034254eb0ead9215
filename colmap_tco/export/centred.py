"""Map coordinates for programs that compute in float32: the model moved to the origin by a round offset.

Trainers of Gaussian splats hold cameras and points in float32, OpenMVS its points (``TPoint3<float>`` in
``libs/MVS/PointCloud.h``). At 5 000 000 that is a grid of half a unit, whatever the precision of the files.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_tco.atomic import write_text
from colmap_tco.ply import needs_double
from colmap_tco.sparse_format import SparseModel

log = logging.getLogger(__name__)

OFFSET_FILE = "offset.txt"
"""x y z in one line: add them to the coordinates of the export to have those of the model."""


def offset_for(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """What (3,) to subtract from (N, 3) coordinates; zeros where float32 holds them well enough.

    It is near the middle of the points, in multiples of a power of ten that their extent exceeds.
    """
    if not needs_double(points):
        return np.zeros(3)
    low, high = np.quantile(points, (0.05, 0.95), axis=0)
    step = 10.0 ** np.floor(np.log10((high - low).max()))
    return np.asarray(np.round((low + high) / 2 / step) * step)


def moved(model: SparseModel, offset: NDArray[np.float64]) -> SparseModel:
    """The model with ``offset`` (3,) subtracted from all world coordinates; its images see the same."""
    images = []
    for image in model.images:
        rotation, shift = image.cam_from_world[:, :3], image.cam_from_world[:, 3]
        pose = np.concatenate([rotation, (shift + rotation @ offset)[:, None]], 1)
        images.append(replace(image, cam_from_world=pose))
    return replace(model, images=images, points=replace(model.points, xyz=model.points.xyz - offset))


def tell_offset(folder: Path, offset: NDArray[np.float64]) -> None:
    """Write and log an offset that is not zero."""
    if offset.any():
        line = " ".join(f"{value:.15g}" for value in offset)
        write_text(folder / OFFSET_FILE, line + "\n")
        log.info(
            "coordinates this large need more digits than float32 has: cameras and points are moved to the "
            "origin; add %s (%s) to have them back",
            line,
            OFFSET_FILE,
        )
