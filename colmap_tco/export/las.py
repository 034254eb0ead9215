"""LAS and LAZ, the formats of surveyors: version 1.4, point format 7 (colour), normals as extra dimensions.

Coordinates are whole numbers times a scale plus an offset. The scale is at most 1e-4 of the distance between
neighbouring points, the offset is near the middle of the cloud, so that map coordinates keep their digits.
"""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_tco.atomic import atomic_path
from colmap_tco.errors import InputError, MissingError
from colmap_tco.export.dense import Dense, thinned

PRECISION = 1e-4
"""Of the distance between points; half of it is the largest error."""
SAMPLED = 20_000
"""Points at which the distance is measured."""
_LARGEST = 2**31 - 1
_WIDEN = 257
"""255 becomes 65535."""


def write_las(dense: Dense, path: Path, max_points: int) -> str:
    """Write the cloud to a .las or .laz file; returns a sentence on what is in it.

    Raises:
        InputError: no cloud, or another extension.
        MissingError: laspy, or lazrs for .laz, is not installed.
    """
    kind = path.suffix.lower()
    if kind not in (".las", ".laz"):
        raise InputError(f"{path}: the name must end in .las or .laz")
    for module in ("laspy", "lazrs")[: 1 if kind == ".las" else 2]:
        if importlib.util.find_spec(module) is None:
            raise MissingError(f"{path.name} needs {module}; install it with: pip install 'colmap-tco[las]'")
    import laspy

    cloud = thinned(dense.cloud(), max_points)
    scale, offset = scale_and_offset(cloud.points, spacing(cloud.points))
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.global_encoding.wkt = True  # the standard demands it of this point format
    header.scales, header.offsets = np.full(3, scale), offset
    header.add_extra_dims([laspy.ExtraBytesParams(f"Normal{axis}", np.float32) for axis in "XYZ"])
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    las.red, las.green, las.blue = cloud.colors.T.astype(np.uint16) * _WIDEN
    for axis, values in zip("XYZ", cloud.normals.T, strict=True):
        las[f"Normal{axis}"] = values
    with atomic_path(path) as unfinished:
        las.write(str(unfinished))
    return f"{len(cloud)} points, coordinates to {scale:g}"


def spacing(points: NDArray[np.float64]) -> float:
    """Median distance of a point to the nearest other one, from a sample; 1 for points that all coincide."""
    from scipy.spatial import cKDTree

    local = points - points.mean(0)
    step = max(1, len(points) // SAMPLED)
    distance = cKDTree(local).query(local[::step], k=min(2, len(points)))[0].reshape(-1)
    positive = distance[distance > 0]
    return float(np.median(positive)) if len(positive) else 1.0


def scale_and_offset(points: NDArray[np.float64], distance: float) -> tuple[float, NDArray[np.float64]]:
    """A scale, a power of ten of at most ``PRECISION`` of a distance, and offsets (3,), multiples of it.

    Raises:
        InputError: the cloud is too large for 32-bit numbers of that scale.
    """
    scale = 10.0 ** math.floor(math.log10(PRECISION * distance))
    low, high = points.min(0), points.max(0)
    offset = np.round((low + high) / 2 / scale) * scale
    if (high - low).max() / 2 / scale >= _LARGEST:
        raise InputError(
            f"the cloud extends over {(high - low).max():g} with points {distance:g} apart, more than the "
            "numbers of a LAS file hold; cut its far background away"
        )
    return scale, offset
