"""ETH3D, high-resolution multi-view training set (Schöps et al., CVPR 2017): 13 scenes with laser scans.

Two layouts are read. That of ETH3D's own archives (eth3d.net/documentation; 7-Zip, ``<scene>_dslr_jpg``,
``_dslr_undistorted``, ``_dslr_depth`` and ``_dslr_scan_eval``):

    <root>/<scene>/images/dslr_images_undistorted/DSC_0001.JPG
    <root>/<scene>/dslr_calibration_undistorted/{cameras,images}.txt   COLMAP's text format, PINHOLE
    <root>/<scene>/dslr_calibration_jpg/{cameras,images}.txt           THIN_PRISM_FISHEYE, of the originals
    <root>/<scene>/ground_truth_depth/dslr_images/DSC_0001.JPG         float32 without a header, metres,
                                                                       infinite where there is none, in
                                                                       pixels of the originals
    <root>/<scene>/dslr_scan_eval/scan_alignment.mlp                   the scans, in the frame of the cameras

and what π³'s ``datasets/preprocess/prepare_eth3d.py`` makes of it, which TCO reads:

    <root>/<scene>/images/custom_undistorted/DSC_0001.JPG
    <root>/<scene>/ground_truth_depth/custom_undistorted/DSC_0001.JPG  float32, metres, 0 is none
    <root>/<scene>/custom_undistorted_cam/DSC_0001.npz                 intrinsics 3×3; extrinsics 4×4, camera
                                                                       from world

π³'s undistortion leaves out the tangential and thin-prism terms; with the archives' own undistorted pictures,
the depth map is read at the pixel that each undistorted one comes from, with all terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_tco.datasets.base import (
    Depth,
    Floats,
    Frame,
    InFolder,
    Scene,
    chosen,
    existing,
    folders,
    image_size,
    intrinsics,
    inverse,
    pixel_centres,
    rays,
    rigid,
)
from colmap_tco.errors import InputError

REMEDY = "unpack ETH3D's archives of the scene (7z x), see docs/bench.md"

_PREPARED, _UNDISTORTED = "custom_undistorted", "dslr_images_undistorted"


@dataclass(frozen=True)
class Calibrated:
    """A picture of a calibration.

    Attributes:
        model: of the camera, as COLMAP calls it.
        size: (width, height).
        params: of the camera.
        cam_from_world: (4, 4).
    """

    model: str
    size: tuple[int, int]
    params: tuple[float, ...]
    cam_from_world: Floats


class ETH3D(InFolder):
    """The scenes of the multi-view training set that are there."""

    name = "eth3d"
    title = "ETH3D"

    def scenes(self) -> list[str]:
        """The folders that hold pictures.

        Raises:
            InputError: there is none.
        """
        found = [name for name in folders(self.root) if self._folder(name) is not None]
        if not found:
            raise InputError(
                f"{self.root}: no folder in it has images/{_UNDISTORTED} or images/{_PREPARED}; {REMEDY}"
            )
        return found

    def _folder(self, scene: str) -> Path | None:
        """The pictures: those that π³ prepared where they are, for they are what the tables were made of."""
        for name in (_PREPARED, _UNDISTORTED):
            if (self.root / scene / "images" / name).is_dir():
                return self.root / scene / "images" / name
        return None

    def pictures(self, scene: str) -> list[Path]:
        """The colour pictures of a scene, in order."""
        folder = self._folder(scene)
        if folder is None:
            missing = self.root / scene / "images" / _UNDISTORTED
            raise InputError(f"{missing} is missing: the undistorted pictures; {REMEDY}")
        return sorted(path for path in folder.iterdir() if path.suffix.upper() == ".JPG")

    def read(self, scene: str, frames: Sequence[int]) -> Scene:
        """Frames of a scene in the order of their names, with the project of its scans if it is there.

        Raises:
            InputError: a file is missing or damaged.
        """
        paths, root = chosen(self.pictures(scene), frames, scene), self.root / scene
        scans = root / "dslr_scan_eval" / "scan_alignment.mlp"
        if paths and paths[0].parent.name == _PREPARED:
            found = tuple(_prepared(root, path) for path in paths)
        else:
            calibration = read_calibration(root / "dslr_calibration_undistorted")
            found = tuple(_undistorted(root, path, calibration) for path in paths)
        return Scene(scene, found, scans if scans.exists() else None)


def _prepared(root: Path, picture: Path) -> Frame:
    """A frame in π³'s layout."""
    file = existing(root / f"{_PREPARED}_cam" / f"{picture.stem}.npz", "the camera", REMEDY)
    try:
        with np.load(file) as arrays:
            K, cam_from_world = (np.array(arrays[key], float) for key in ("intrinsics", "extrinsics"))
    except (ValueError, OSError, KeyError) as error:
        raise InputError(
            f"{file}: no arrays 'intrinsics' and 'extrinsics' in it ({error}); {REMEDY}"
        ) from error
    size, depth = image_size(picture), root / "ground_truth_depth" / _PREPARED / picture.name
    world_from_cam = inverse(rigid(cam_from_world, str(file)))
    return Frame(picture.stem, picture, size, world_from_cam, K, lambda: read_depth(depth, size))


def _undistorted(root: Path, picture: Path, calibration: dict[str, Calibrated]) -> Frame:
    """A frame of ETH3D's undistorted pictures."""
    folder = root / "dslr_calibration_undistorted"
    entry = _entry(calibration, picture.name, folder)
    if entry.model != "PINHOLE" or len(entry.params) != 4:
        raise InputError(
            f"{folder}: a camera {entry.model} of {len(entry.params)} numbers where PINHOLE is due"
        )
    size = image_size(picture)
    if size != entry.size:
        raise InputError(
            f"{picture}: {size[0]}×{size[1]} pixels where its camera has {entry.size[0]}×{entry.size[1]}; "
            "do not resize"
        )
    K, name = intrinsics(*entry.params), picture.name
    world_from_cam = inverse(entry.cam_from_world)
    return Frame(
        picture.stem, picture, size, world_from_cam, K, lambda: _undistorted_depth(root, name, K, size)
    )


def _undistorted_depth(root: Path, name: str, K: Floats, size: tuple[int, int]) -> Depth:
    """The depth map of the original picture, at the pixels that the undistorted ones come from."""
    from colmap_tco import _pycolmap

    folder = root / "dslr_calibration_jpg"
    entry = _entry(read_calibration(folder), name, folder)
    depth = read_depth(root / "ground_truth_depth" / "dslr_images" / name, entry.size)
    camera = _pycolmap.camera(entry.model, entry.size, entry.params)
    found = np.zeros(size[0] * size[1], np.float32)
    xy = rays(pixel_centres(*size), K)[:, :2]
    for part in np.array_split(np.arange(len(xy)), max(1, len(xy) // 1_000_000)):
        with np.errstate(invalid="ignore"):
            pixels = np.nan_to_num(_pycolmap.img_from_cam(camera, xy[part]), nan=-1)
        column, row = np.floor(pixels).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < entry.size[0]) & (row < entry.size[1])
        found[part[inside]] = depth[row[inside], column[inside]]
    return found.reshape(size[1], size[0])


def read_depth(path: Path, size: tuple[int, int]) -> Depth:
    """A map (height, width) of float32 without a header, metres; 0 where it is infinite, NaN or negative.

    Raises:
        InputError: it is missing, or has not as many numbers as the picture of this (width, height) pixels.
    """
    existing(path, "the true depth", REMEDY)
    depth = np.fromfile(path, "<f4")
    if depth.size != size[0] * size[1]:
        raise InputError(
            f"{path}: {depth.size} numbers where {size[0]}×{size[1]} pixels are due (depth maps end in .JPG "
            f"but are raw float32); {REMEDY}"
        )
    found: Depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
    return found.reshape(size[1], size[0])


def read_calibration(folder: Path) -> dict[str, Calibrated]:
    """File name → camera and pose, from cameras.txt and images.txt of COLMAP's text format.

    Points are not read, so that points3D.txt need not be there; a name loses its folder.

    Raises:
        InputError: a file is missing or holds something else.
    """
    cameras = existing(folder / "cameras.txt", "the calibration", REMEDY)
    images = existing(folder / "images.txt", "the poses", REMEDY)
    try:
        by_id = {}
        for line in _lines(cameras):
            key, model, width, height, *params = line.split()
            by_id[key] = (model, (int(width), int(height)), tuple(map(float, params)))
        found = {}
        # Every other line lists keypoints, and may be empty.
        for line in _lines(images, keep_empty=True)[::2]:
            _, qw, qx, qy, qz, tx, ty, tz, key, name = line.split(maxsplit=9)
            pose = np.eye(4)
            pose[:3, :3] = _rotation(*map(float, (qx, qy, qz, qw)))
            pose[:3, 3] = float(tx), float(ty), float(tz)
            found[name.rpartition("/")[2]] = Calibrated(*by_id[key], pose)
    except (ValueError, KeyError) as error:
        raise InputError(f"{folder}: not COLMAP's text format ({error}); {REMEDY}") from error
    return found


def _lines(path: Path, keep_empty: bool = False) -> list[str]:
    lines = [line for line in path.read_text("utf-8").split("\n") if not line.startswith("#")]
    while lines and not lines[-1].strip():
        lines.pop()
    return lines if keep_empty else [line for line in lines if line.strip()]


def _rotation(x: float, y: float, z: float, w: float) -> Floats:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat([x, y, z, w]).as_matrix())


def _entry(calibration: dict[str, Calibrated], name: str, folder: Path) -> Calibrated:
    if name not in calibration:
        raise InputError(f"{folder / 'images.txt'} does not name {name}; {REMEDY}")
    return calibration[name]
