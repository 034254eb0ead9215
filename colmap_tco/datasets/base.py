"""What every dataset gives: scenes of frames with pictures, cameras and true depths, in one convention.

Axes are OpenCV's, lengths are metres, intrinsics are in pixels of the picture as it is stored with the centre
of the top-left pixel at (0.5, 0.5), and a depth of 0 is none. What a dataset has otherwise (OpenGL's axes,
millimetres, 65535) ends in its reader.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from colmap_tco.errors import InputError

Floats = NDArray[np.float64]
Depth = NDArray[np.float32]

_LOOSE = 0.01
"""A published rotation may be so far from orthogonal; it is replaced by the nearest that is."""


@dataclass(frozen=True)
class Frame:
    """One picture and what is known of it.

    Attributes:
        name: of the frame in its scene.
        image: the picture.
        size: its (width, height) in pixels.
        world_from_cam: (4, 4).
        K: (3, 3), of the picture.
        load_depth: reads the true depth map (h, w), 0 where there is none; h and w may differ from the
            picture's.
        depth_K: (3, 3), intrinsics of the depth map where it has a camera of its own at the same place;
            None: it shows what the picture shows.
    """

    name: str
    image: Path
    size: tuple[int, int]
    world_from_cam: Floats = field(repr=False)
    K: Floats = field(repr=False)
    load_depth: Callable[[], Depth] = field(repr=False)
    depth_K: Floats | None = field(default=None, repr=False)

    def depth(self) -> Depth:
        """The true depth map (h, w), metres, 0 where there is none.

        Raises:
            InputError: its file is missing or damaged.
        """
        return self.load_depth()

    def depth_at(self, xy: Floats) -> Depth:
        """True depths (N,) at pixels (N, 2) of the picture: that of the depth map's pixel they fall into.

        0 outside the depth map. Raises as :meth:`depth`.
        """
        depth = self.depth()
        height, width = depth.shape
        if self.depth_K is None:
            at = np.asarray(xy, float) * (width / self.size[0], height / self.size[1])
        else:
            at = project(rays(np.asarray(xy, float), self.K), self.depth_K)
        column, row = np.floor(at).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        found = np.zeros(len(at), np.float32)
        found[inside] = depth[row[inside], column[inside]]
        return found


@dataclass(frozen=True)
class Scene:
    """Frames that are reconstructed together.

    Attributes:
        name: of the scene.
        frames: in the order of the dataset.
        cloud: the true cloud, mesh or, for ETH3D, MeshLab project; None where the dataset has none, or its
            archive was not unpacked.
    """

    name: str
    frames: tuple[Frame, ...]
    cloud: Path | None = None


class Dataset(Protocol):
    """A dataset in a folder on this machine.

    Attributes:
        name: as ``--dataset`` spells it.
    """

    name: str

    def scenes(self) -> list[str]:
        """Names of the scenes that the published evaluations use, as far as they are there."""
        ...

    def count(self, scene: str) -> int:
        """Number of frames of a scene."""
        ...

    def read(self, scene: str, frames: Sequence[int]) -> Scene:
        """The frames at these positions, counted from 0 in the order of the dataset."""
        ...


class InFolder(ABC):
    """A dataset whose root holds a folder for each scene; what its readers share.

    Attributes:
        name: as ``--dataset`` spells it.
        title: as its authors spell it, for messages.
        root: the folder.
    """

    name: str
    title: str

    def __init__(self, root: Path) -> None:
        """Where the scenes' folders are.

        Raises:
            InputError: the folder is not there.
        """
        self.root = existing(Path(root), f"the folder of {self.title}", "name it with --root")

    @abstractmethod
    def pictures(self, scene: str) -> list[Path]:
        """The colour pictures of a scene, in order.

        Raises:
            InputError: they are not there.
        """

    def count(self, scene: str) -> int:
        """Number of pictures of a scene."""
        return len(self.pictures(scene))


def rays(xy: Floats, K: Floats) -> Floats:
    """Directions (N, 3) of depth 1 in the camera's frame, through pixels (N, 2)."""
    xy = (xy - K[:2, 2]) / (K[0, 0], K[1, 1])
    return np.concatenate([xy, np.ones((len(xy), 1))], 1)


def project(points: Floats, K: Floats) -> Floats:
    """Pixels (N, 2) of points (N, 3) in the camera's frame, all before it."""
    return points[:, :2] / points[:, 2:] * (K[0, 0], K[1, 1]) + K[:2, 2]


def pixel_centres(width: int, height: int) -> Floats:
    """Centres (height · width, 2) of the pixels of a map, row by row."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], -1).reshape(-1, 2)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Floats:
    """The matrix (3, 3)."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)


def existing(path: Path, what: str, remedy: str) -> Path:
    """The path, if there is something.

    Raises:
        InputError: there is nothing; ``what`` says what it would be, ``remedy`` where to get it.
    """
    if not path.exists():
        raise InputError(f"{path} is missing: {what}; {remedy}")
    return path


def numbered(folder: Path, prefix: str, suffix: str) -> list[Path]:
    """Files of a folder that are called prefix, digits, suffix, ordered by the number."""
    found = {}
    for path in folder.iterdir():
        digits = path.name[len(prefix) : len(path.name) - len(suffix)]
        if path.name.startswith(prefix) and path.name.endswith(suffix) and digits.isdigit():
            found[int(digits)] = path
    return [found[number] for number in sorted(found)]


def folders(root: Path) -> list[str]:
    """Names of the folders in a folder, ordered, hidden ones left out.

    Raises:
        InputError: the folder is not there.
    """
    existing(root, "the dataset's folder", "name it with --root")
    return sorted(p.name for p in root.iterdir() if p.is_dir() and not p.name.startswith("."))


def chosen(paths: Sequence[Path], frames: Sequence[int], scene: str) -> list[Path]:
    """The paths at these positions.

    Raises:
        InputError: a position beyond the last frame.
    """
    beyond = [i for i in frames if not 0 <= i < len(paths)]
    if beyond:
        raise InputError(
            f"{scene}: there is no frame {beyond[0]}, it has {len(paths)}; unpack its archive again if it "
            "should have more"
        )
    return [paths[i] for i in frames]


def read_numbers(path: Path, what: str, remedy: str) -> Floats:
    """The numbers of a text file (N, M), all lines with as many.

    Raises:
        InputError: it is missing or holds something else.
    """
    existing(path, what, remedy)
    try:
        return np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise InputError(f"{path}: not {what} ({error}); {remedy}") from error


def read_matrix(path: Path, what: str, remedy: str) -> Floats:
    """A 4×4 matrix from a text file.

    Raises:
        InputError: it is missing or holds something else.
    """
    matrix = read_numbers(path, what, remedy)
    if matrix.shape != (4, 4):
        raise InputError(f"{path}: {what} has 4×4 numbers, here are {matrix.shape[0]}×{matrix.shape[1]}")
    return matrix


def rigid(matrix: Floats, where: str) -> Floats:
    """A pose (4, 4) with its rotation made orthogonal: the nearest rotation, by singular values.

    Raises:
        InputError: values that are not finite (how ScanNet and NRGBD mark frames that were not tracked), or
            a matrix that is no rotation and translation.
    """
    if not np.isfinite(matrix).all():
        raise InputError(
            f"{where}: the pose is not finite, which marks a frame that was not tracked; leave the scene "
            "out with --scenes, or choose other frames"
        )
    u, s, vt = np.linalg.svd(matrix[:3, :3])
    if np.abs(s - 1).max() > _LOOSE or np.linalg.det(u @ vt) < 0:
        raise InputError(f"{where}: not the pose of a camera, its 3×3 part is no rotation; copy it again")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = u @ vt, matrix[:3, 3]
    return pose


def inverse(pose: Floats) -> Floats:
    """The pose (4, 4) the other way round."""
    R, t = pose[:3, :3], pose[:3, 3]
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = R.T, -R.T @ t
    return back


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header of a picture.

    Raises:
        InputError: it is missing or no picture.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, UnidentifiedImageError) as error:
        raise InputError(f"{path}: missing or not a picture ({error}); unpack its archive again") from error


def read_depth_png(path: Path, remedy: str, invalid: Sequence[int] = (0,)) -> Depth:
    """Metres (h, w) of a 16-bit PNG in millimetres; 0 where a value is one of ``invalid``.

    Raises:
        InputError: it is missing, or not a picture of one 16-bit channel.
    """
    import cv2

    existing(path, "the depth map", remedy)
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if raw is None or raw.ndim != 2 or raw.dtype != np.uint16:
        raise InputError(f"{path}: a depth map is a PNG of one 16-bit channel; {remedy}")
    depth: Depth = np.where(np.isin(raw, invalid), 0, raw.astype(np.float32) / 1000).astype(np.float32)
    return depth
