"""Point clouds and their visibility: ``fused.ply`` and ``fused.ply.vis`` exactly as COLMAP writes them.

``fused.ply`` is binary little-endian with float32 x y z nx ny nz and uint8 red green blue, 27 bytes
a point. Where float32 would round the coordinates visibly (:func:`needs_double`: models in projected
map coordinates, which it would cut into stripes), x y z are ``double`` instead, 39 bytes a point. There
is no offset to add: the coordinates are always those of the model.

``fused.ply.vis`` is a uint64 number of points, then for each point a uint32 count and that many uint32
image indices, positions in ``Reconstruction.reg_image_ids()``.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_tco.atomic import atomic_file
from colmap_tco.errors import InputError
from colmap_tco.workers import Workers

_Number = TypeVar("_Number", bound=np.generic)
_POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    + [(name, "u1") for name in ("red", "green", "blue")]
)
_DOUBLE_POINT = np.dtype(
    [(name, "<f8") for name in ("x", "y", "z")] + [(name, _POINT[name]) for name in (_POINT.names or ())[3:]]
)
_STRIPES = 0.01
"""Rounding above this share of the spacing of the points shows as stripes."""
_BLOCK = 1 << 18
"""Points that are brought into the form of the file together."""
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class Visibility:
    """Which images see each of N points, as flat lists one after the other.

    Attributes:
        start: (N + 1,) int64; the images of point i are ``images[start[i]:start[i + 1]]``.
        images: uint32 positions in ``Reconstruction.reg_image_ids()``.
    """

    start: NDArray[np.int64]
    images: NDArray[np.uint32]

    def __len__(self) -> int:
        return len(self.start) - 1

    def __getitem__(self, point: int) -> NDArray[np.uint32]:
        return self.images[self.start[point] : self.start[point + 1]]

    def select(self, points: NDArray[np.int64]) -> Visibility:
        """The lists of some points (M,), in that order."""
        first, count = self.start[points], np.diff(self.start)[points]
        start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        within = np.arange(start[-1]) - np.repeat(start[:-1], count)
        return Visibility(start, self.images[np.repeat(first, count) + within])


@dataclass(frozen=True)
class Cloud:
    """N oriented, coloured points.

    Attributes:
        points: (N, 3) float64 world coordinates.
        normals: (N, 3) float32 unit vectors in the world frame, towards the cameras.
        colors: (N, 3) uint8 RGB.
        visibility: the images that confirmed each point.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]
    visibility: Visibility

    def __len__(self) -> int:
        return len(self.points)

    @property
    def nbytes(self) -> int:
        """Memory of the arrays: 47 bytes a point, and 4 for each image that confirmed it."""
        of_lists = self.visibility.start.nbytes + self.visibility.images.nbytes
        return self.points.nbytes + self.normals.nbytes + self.colors.nbytes + of_lists

    def select(self, points: NDArray[np.int64]) -> Cloud:
        """The cloud of some points (M,), in that order."""
        return Cloud(
            self.points[points], self.normals[points], self.colors[points], self.visibility.select(points)
        )


def join(clouds: Iterable[Cloud], num_threads: int = 1) -> Cloud:
    """One cloud of the points of all, in order, copied by some threads.

    Where ``clouds`` is a generator that keeps none, the memory needed is that of the result and, once more,
    of as many of its largest arrays as there are threads.
    """
    points: list[NDArray[np.float64]] = [np.zeros((0, 3))]
    normals: list[NDArray[np.float32]] = [np.zeros((0, 3), np.float32)]
    colors: list[NDArray[np.uint8]] = [np.zeros((0, 3), np.uint8)]
    counts: list[NDArray[np.uint32]] = [np.zeros(1, np.uint32)]
    images: list[NDArray[np.uint32]] = [np.zeros(0, np.uint32)]
    for cloud in clouds:
        points.append(cloud.points)
        normals.append(cloud.normals)
        colors.append(cloud.colors)
        counts.append(np.diff(cloud.visibility.start).astype(np.uint32))
        images.append(cloud.visibility.images)
    copies: list[Callable[[], NDArray[Any]]] = [
        lambda: _moved(points),
        lambda: _moved(images),
        lambda: _moved(counts).cumsum(dtype=np.int64),
        lambda: _moved(normals),
        lambda: _moved(colors),
    ]
    with Workers(num_threads) as workers:
        whole = workers.map(lambda copy: copy(), copies)
    return Cloud(whole[0], whole[3], whole[4], Visibility(whole[2], whole[1]))


def _moved(arrays: list[NDArray[_Number]]) -> NDArray[_Number]:
    """One array of all, one after the other; the list is emptied."""
    whole = np.concatenate(arrays)
    arrays.clear()
    return whole


def needs_double(points: NDArray[np.floating]) -> bool:
    """Whether float32 would round (N, 3) coordinates by more than a hundredth of the points' spacing.

    The spacing is that of as many points spread over a square of the size of the cloud, without its
    outermost tenth.
    """
    if len(points) < 2:
        return False
    low, high = np.quantile(points, (0.05, 0.95), axis=0)
    spacing = float(np.linalg.norm(high - low)) / np.sqrt(len(points))
    rounding = float(np.spacing(np.float32(np.abs([low, high]).max()))) / 2
    return rounding > _STRIPES * spacing > 0


Block = tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.uint8]]
"""Points (N, 3), normals (N, 3) and uint8 colours (N, 3)."""


def write_ply(
    path: str | os.PathLike[str],
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    colors: NDArray[np.uint8],
    double: bool = False,
) -> None:
    """Write (N, 3) points, normals and uint8 colours atomically; ``double`` as :func:`write_ply_blocks`.

    Raises:
        ValueError: see :func:`write_ply_blocks`.
    """
    blocks = (
        (points[i : i + _BLOCK], normals[i : i + _BLOCK], colors[i : i + _BLOCK])
        for i in range(0, max(len(points), len(normals), len(colors), 1), _BLOCK)
    )
    write_ply_blocks(path, blocks, double)


def write_ply_blocks(path: str | os.PathLike[str], blocks: Iterable[Block], double: bool = False) -> int:
    """Write a cloud that arrives in blocks, atomically; returns the number of points.

    The header holds the count, so the points wait in a temporary file until the last block. Coordinates
    are written as float64 if ``double``, else as float32, COLMAP's way.

    Raises:
        ValueError: shapes that do not agree, a colour that is not uint8, or a value that is not finite.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    total, layout = 0, _DOUBLE_POINT if double else _POINT
    with tempfile.TemporaryFile(dir=Path(path).parent) as body:
        for points, normals, colors in blocks:
            body.write(_records(path, (points, normals, colors), layout).view(np.uint8).data)
            total += len(points)
        body.seek(0)
        with atomic_file(path) as file:
            file.write(_header(total, layout))
            shutil.copyfileobj(body, file, 1 << 20)
    return total


def _records(path: str | os.PathLike[str], block: Block, layout: np.dtype[np.void]) -> NDArray[np.void]:
    points, normals, colors = block
    shape = (len(points), 3)
    if not points.shape == normals.shape == colors.shape == shape:
        raise ValueError(
            f"{path}: points {points.shape}, normals {normals.shape}, colours {colors.shape} differ"
        )
    if colors.dtype != np.uint8:
        raise ValueError(f"{path}: colours are {colors.dtype}, not uint8")
    if not (np.isfinite(points).all() and np.isfinite(normals).all()):
        raise ValueError(f"{path}: a point or normal is not finite")
    records = np.empty(len(points), layout)
    for axis, name in enumerate("xyz"):
        records[name] = points[:, axis]
        records[f"n{name}"] = normals[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        records[name] = colors[:, channel]
    return records


def _header(count: int, layout: np.dtype[np.void]) -> bytes:
    kinds = {"<f4": "float", "<f8": "double", "|u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {kinds[layout[name].str]} {name}" for name in layout.names or ()]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def read_ply(path: str | os.PathLike[str]) -> Block:
    """Points (N, 3) float64, normals (N, 3) float32 and colours (N, 3) uint8 of a binary PLY.

    Reads little-endian files whose vertices hold numbers alone, in any order and precision, as
    COLMAP, Open3D and others write them; missing normals and colours come back as zeros.

    Raises:
        InputError: the file is missing, of another kind, without x y z, or truncated.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: there is no such cloud")
    with open(path, "rb") as file:
        header = b""
        while not header.endswith(b"end_header\n"):
            line = file.readline()
            if not line or (not header and line != b"ply\n"):
                raise InputError(f"{path}: not a PLY file")
            header += line
        count, dtype = _parse_header(header.decode("ascii", "replace"), path)
        body = file.read(count * dtype.itemsize)
    if len(body) < count * dtype.itemsize:
        raise InputError(
            f"{path}: truncated, {len(body)} of {count * dtype.itemsize} bytes of its points are there"
        )
    vertices = np.frombuffer(body, dtype)
    return (
        _columns(vertices, ("x", "y", "z"), np.float64),
        _columns(vertices, ("nx", "ny", "nz"), np.float32),
        _columns(vertices, ("red", "green", "blue"), np.uint8),
    )


def _parse_header(header: str, path: str | os.PathLike[str]) -> tuple[int, np.dtype[np.void]]:
    if "format binary_little_endian 1.0\n" not in header:
        raise InputError(f"{path}: only binary little-endian PLY files are read; convert it")
    vertex = re.search(r"element vertex (\d+)\n((?:(?:property|comment) .*\n)*)", header)
    if vertex is None or re.search(r"element ", header[: vertex.start()]):
        raise InputError(f"{path}: vertices must be the first element of the PLY file")
    fields = []
    for line in vertex[2].splitlines():
        words = line.split()
        if words[0] == "property" and (len(words) != 3 or words[1] not in _TYPES):
            raise InputError(f"{path}: cannot read the vertex property '{line}'")
        if words[0] == "property":
            fields.append((words[2], "<" + _TYPES[words[1]]))
    if not {"x", "y", "z"} <= {name for name, _ in fields}:
        raise InputError(f"{path}: its vertices have no x, y, z")
    return int(vertex[1]), np.dtype(fields)


def _columns(vertices: NDArray[np.void], names: tuple[str, ...], dtype: type[_Number]) -> NDArray[_Number]:
    out = np.zeros((len(vertices), len(names)), dtype)
    for i, name in enumerate(names):
        if name in (vertices.dtype.names or ()):
            out[:, i] = vertices[name]
    return out


def write_vis(path: str | os.PathLike[str], visibility: Visibility) -> None:
    """Write the images that see each point, atomically."""
    count = np.diff(visibility.start)
    flat = np.empty(len(count) + len(visibility.images), "<u4")
    head = visibility.start[:-1] + np.arange(len(count))
    listed = np.ones(len(flat), bool)
    listed[head] = False
    flat[head] = count
    flat[listed] = visibility.images
    with atomic_file(path) as file:
        file.write(np.uint64(len(count)).astype("<u8").tobytes())
        file.write(flat.tobytes())


def read_vis(path: str | os.PathLike[str]) -> Visibility:
    """Read the images that see each point.

    Raises:
        InputError: the file is missing, or its lists end before or after the file.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: there is no such visibility file")
    data = Path(path).read_bytes()
    if len(data) < 8 or len(data) % 4:
        raise InputError(f"{path}: not a visibility file")
    points = int(np.frombuffer(data, "<u8", 1)[0])
    words = np.frombuffer(data, "<u4", offset=8)
    head, end = _heads(words)
    if head.sum() != points or end != len(words):
        raise InputError(f"{path}: damaged, its lists do not end where the file ends")
    start = np.concatenate([[0], words[head].astype(np.int64).cumsum()])
    return Visibility(start, words[~head].astype(np.uint32))


def _heads(words: NDArray[np.uint32]) -> tuple[NDArray[np.bool_], int]:
    """Which of N words are the counts of lists that follow one another, and where the last list ends.

    Where a list begins is known from the one before it alone, so the words are cut into √N blocks. Backwards
    through all blocks at once it is found where a walk over any of their words leaves its block; a loop over
    the blocks gives where the true walk enters each; forwards, again through all at once, go its other steps.
    """
    side = max(1, math.isqrt(len(words)))
    blocks = -(-len(words) // side)
    after = np.arange(1, blocks * side + 1)
    after[: len(words)] += words
    beyond = after.reshape(blocks, side).copy()
    last = np.minimum(np.arange(1, blocks + 1) * side, len(words))
    for i in range(side - 1, -1, -1):
        within = np.flatnonzero(beyond[:, i] < last)
        beyond[within, i] = beyond[within, beyond[within, i] % side]
    head = np.zeros(len(after), bool)
    first, end = [], 0
    while end < len(words):
        first.append(end)
        end = int(beyond.flat[end])
    at = np.array(first, np.int64)
    while len(at):
        head[at] = True
        step = after[at]
        at = step[(step // side == at // side) & (step < len(words))]
    return head[: len(words)], end
