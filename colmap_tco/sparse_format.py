"""COLMAP's model files written from arrays, for models with as many points as a dense cloud has.

Both formats are those of ``scene/reconstruction_io_{binary,text}.cc`` without rigs and frames, which every
version of COLMAP and every other reader takes. Images are written in the order given, which decides what
readers that count images, and not ids, understand.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_tco.atomic import atomic_file, write_text
from colmap_tco.errors import InputError
from colmap_tco.pinhole import Pinhole

_PINHOLE = 1
_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
_POINT3D = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


@dataclass(frozen=True)
class SparseImage:
    """An image of a model.

    Attributes:
        image_id: COLMAP's, at least 1.
        name: of the file.
        camera_id: of its camera.
        cam_from_world: (3, 4) float64.
        xy: (K, 2) float64 keypoints in pixels.
        points: (K,) int64 ids of their 3D points, −1 where there is none.
    """

    image_id: int
    name: str
    camera_id: int
    cam_from_world: NDArray[np.float64]
    xy: NDArray[np.float64]
    points: NDArray[np.int64]


@dataclass(frozen=True)
class SparsePoints:
    """P points and their tracks, flat lists one after the other.

    Attributes:
        ids: (P,) int64, at least 1.
        xyz: (P, 3) float64 world coordinates.
        rgb: (P, 3) uint8.
        error: (P,) float64 mean reprojection errors in pixels.
        start: (P + 1,) int64; the track of point i is ``images[start[i]:start[i + 1]]`` and the same of
            ``keypoints``.
        images: int64 ids of images.
        keypoints: int64 positions among the keypoints of these images.
    """

    ids: NDArray[np.int64]
    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    error: NDArray[np.float64]
    start: NDArray[np.int64]
    images: NDArray[np.int64]
    keypoints: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class SparseModel:
    """A model of PINHOLE cameras.

    Attributes:
        cameras: by id.
        images: in the order in which they are written.
        points: with their tracks.
    """

    cameras: dict[int, Pinhole]
    images: Sequence[SparseImage]
    points: SparsePoints


def write_binary(folder: Path, model: SparseModel) -> None:
    """Write cameras.bin, images.bin and points3D.bin, each atomically."""
    with atomic_file(folder / "cameras.bin") as file:
        file.write(struct.pack("<Q", len(model.cameras)))
        for key, c in model.cameras.items():
            file.write(struct.pack("<IiQQ4d", key, _PINHOLE, c.width, c.height, c.fx, c.fy, c.cx, c.cy))
    with atomic_file(folder / "images.bin") as file:
        file.write(struct.pack("<Q", len(model.images)))
        for image in model.images:
            pose = (*quaternion(image.cam_from_world[:, :3]), *image.cam_from_world[:, 3])
            file.write(struct.pack("<I7dI", image.image_id, *pose, image.camera_id))
            file.write(image.name.encode("utf-8") + b"\0")
            keypoints = np.empty(len(image.xy), _POINT2D)
            keypoints["xy"] = image.xy
            keypoints["point"] = image.points.astype(np.uint64)  # −1 becomes COLMAP's id of no point
            file.write(struct.pack("<Q", len(keypoints)) + keypoints.tobytes())
    with atomic_file(folder / "points3D.bin") as file:
        file.write(struct.pack("<Q", len(model.points)))
        file.write(_point_records(model.points).tobytes())


def _point_records(points: SparsePoints) -> NDArray[np.uint8]:
    """The bytes of all points: a fixed part, then the track, one point after the other."""
    length = np.diff(points.start)
    head = np.empty(len(points), _POINT3D)
    head["id"], head["xyz"], head["rgb"] = points.ids, points.xyz, points.rgb
    head["error"], head["track"] = points.error, length
    size = _POINT3D.itemsize
    begin = np.arange(len(points)) * size + points.start[:-1] * 8
    out = np.empty(len(points) * size + len(points.images) * 8, np.uint8)
    is_track = np.ones(len(out), bool)
    for byte in range(size):
        is_track[begin + byte] = False
    out[~is_track] = head.view(np.uint8)
    out[is_track] = np.stack([points.images, points.keypoints], 1).astype("<u4").view(np.uint8).ravel()
    return out


def write_model_text(folder: Path, model: SparseModel) -> None:
    """Write cameras.txt, images.txt and points3D.txt, each atomically; all digits are kept.

    Raises:
        InputError: a name with a blank, at which the format ends it.
    """
    for image in model.images:
        if image.name.split() != [image.name]:
            raise InputError(
                f"'{image.name}': COLMAP's text format cannot hold a name with a blank; rename the image, or "
                "export to 3dgs, which renames its copies"
            )
    cameras = [
        f"{key} PINHOLE {c.width} {c.height} {_row([c.fx, c.fy, c.cx, c.cy])}"
        for key, c in model.cameras.items()
    ]
    write_text(folder / "cameras.txt", _lines("CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", cameras))
    title = "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then POINTS2D[] as (X, Y, POINT3D_ID)"
    write_text(folder / "images.txt", _lines(title, (_image_text(image) for image in model.images)))
    title = "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    write_text(folder / "points3D.txt", _lines(title, _point_texts(model.points)))


def _lines(title: str, lines: Iterable[str]) -> str:
    return "".join(f"{line}\n" for line in (f"# {title}", *lines))


def _row(values: Iterable[float]) -> str:
    return " ".join(map(repr, values))


def _image_text(image: SparseImage) -> str:
    pose = _row([*quaternion(image.cam_from_world[:, :3]), *image.cam_from_world[:, 3].tolist()])
    keypoints = zip(image.xy.tolist(), image.points.tolist(), strict=True)
    seen = " ".join(f"{_row(xy)} {point}" for xy, point in keypoints)
    return f"{image.image_id} {pose} {image.camera_id} {image.name}\n{seen}"


def _point_texts(points: SparsePoints) -> Iterator[str]:
    tracks = np.stack([points.images, points.keypoints], 1).tolist()
    columns = (points.ids, points.xyz, points.rgb, points.error, points.start[:-1], points.start[1:])
    for point, xyz, rgb, error, begin, end in zip(*(column.tolist() for column in columns), strict=True):
        track = " ".join(f"{image} {index}" for image, index in tracks[begin:end])
        yield f"{point} {_row(xyz)} {_row(rgb)} {error!r} {track}"


def quaternion(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """The unit quaternion (w, x, y, z), w ≥ 0, of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
    return w, x, y, z


def reorder_images(path: Path, order: Sequence[int]) -> None:
    """Put the images of an images.bin into the order of these ids, all of them, atomically.

    COLMAP writes them in the order of a hash table. Readers that count images in the order of the file,
    COLMAP before 3.12 and OpenMVS among them, then see other images behind the numbers of
    ``fused.ply.vis`` than COLMAP from 3.12 on, which counts in the order of ids.
    """
    data = path.read_bytes()
    at, entries = 8, {}
    for _ in range(int.from_bytes(data[:8], "little")):
        begin = at
        at = data.index(b"\0", at + 64) + 1  # id, quaternion, translation and camera, then the name
        at += 8 + 24 * int.from_bytes(data[at : at + 8], "little")
        entries[int.from_bytes(data[begin : begin + 4], "little")] = data[begin:at]
    with atomic_file(path) as file:
        file.write(data[:8] + b"".join(entries[key] for key in order))
