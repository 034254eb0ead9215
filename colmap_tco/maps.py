"""COLMAP's dense maps: depth, normals, and our confidence in the same format.

A file is the ASCII text ``width&height&channels&`` followed by little-endian float32 values, one
plane a channel, row by row. A depth is camera z, and 0 where there is none; a normal is a unit
vector in the camera frame that faces the camera, and (0, 0, 0) where there is none.

The bytes are written here because pycolmap's ``NormalMap.from_array`` stores interleaved channels
under this header, which its own fusion then misreads.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from colmap_tco.atomic import atomic_file
from colmap_tco.errors import InputError

if TYPE_CHECKING:
    from colmap_tco.pinhole import Pinhole

_LONGEST_HEADER = 64


def write_map(path: str | os.PathLike[str], array: NDArray[np.floating]) -> None:
    """Write an (H, W) or (H, W, C) map atomically; parent folders are created.

    Raises:
        ValueError: the array has another shape or holds a value that is not finite. COLMAP tests
            depths with ``depth <= 0``, so a NaN would pass as a depth.
    """
    array = np.asarray(array)
    if array.ndim not in (2, 3) or 0 in array.shape:
        raise ValueError(f"{path}: a map is (H, W) or (H, W, C) and not empty, this one is {array.shape}")
    planes = np.moveaxis(array.reshape(*array.shape[:2], -1), 2, 0).astype("<f4", order="C")
    if not np.isfinite(planes).all():
        bad = int((~np.isfinite(planes)).sum())
        raise ValueError(f"{path}: {bad} values of the map are not finite; mark missing values with 0")
    channels, height, width = planes.shape
    with atomic_file(path) as file:
        file.write(f"{width}&{height}&{channels}&".encode("ascii"))
        file.write(planes.tobytes())


def read_map(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """Read a map as (H, W), or (H, W, C) where it has more than one channel.

    Raises:
        InputError: the file is missing, has no map header, or is shorter or longer than it says.
    """
    with _open(path) as file:
        height, width, channels = _read_header(file, path)
        values = np.frombuffer(file.read(), np.uint8)
    expected = 4 * height * width * channels
    if values.size != expected:
        raise InputError(
            f"{path}: a {width}×{height}×{channels} map has {expected} bytes after its header, this one "
            f"has {values.size}; the file is damaged: write it again"
        )
    planes = values.view("<f4").reshape(channels, height, width).astype(np.float32)
    return planes[0] if channels == 1 else np.ascontiguousarray(np.moveaxis(planes, 0, 2))


def map_shape(path: str | os.PathLike[str]) -> tuple[int, int, int]:
    """(H, W, C) of a map, from its header alone.

    Raises:
        InputError: the file is missing or has no map header.
    """
    with _open(path) as file:
        return _read_header(file, path)


def map_intrinsics(camera: Pinhole, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """(fx, fy, cx, cy) of ``camera`` for a map of (H, W) ``shape``, which may be smaller than the image."""
    sx, sy = shape[1] / camera.width, shape[0] / camera.height
    return np.array([camera.fx * sx, camera.fy * sy, camera.cx * sx, camera.cy * sy], np.float64)


def _open(path: str | os.PathLike[str]) -> BinaryIO:
    if not Path(path).is_file():
        raise InputError(f"{path}: there is no such map")
    return open(path, "rb")


def _read_header(file: BinaryIO, path: str | os.PathLike[str]) -> tuple[int, int, int]:
    head = file.read(_LONGEST_HEADER)
    numbers = head.split(b"&", 3)[:3]
    if len(head.split(b"&", 3)) < 4 or not all(n.isdigit() and int(n) > 0 for n in numbers):
        raise InputError(f"{path}: not a COLMAP map, it does not begin with 'width&height&channels&'")
    file.seek(sum(len(n) + 1 for n in numbers))
    width, height, channels = (int(n) for n in numbers)
    return height, width, channels
