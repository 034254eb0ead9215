"""DTU (Jensen et al., CVPR 2014; Aanæs et al., IJCV 2016), as MVSNet's test set with depths by Spann3R.

Layout of the archive that Spann3R's ``docs/data_preprocess.md`` links, which π³ and TCO read, too:

    <root>/scan1/images/00000000.jpg          pictures of the 49 positions
    <root>/scan1/cams/00000000_cam.txt        MVSNet's: "extrinsic", 4×4 camera from world, "intrinsic", 3×3
                                              of a picture of the depth map's size, then the depth range
    <root>/scan1/depths/00000000.npy          rendered from the meshed scan, millimetres, 0 is none
    <root>/scan1/binary_masks/00000000.png    the object; above 0.5 of 255
    <root>/Points/stl/stl001_total.ply        the scans, if DTU's own archive is unpacked here, too

The mask is eroded by a square of 10 pixels before it is applied to the depth, as in ``datasets/dtu.py`` of
π³ and TCO. Lengths become metres here; the published tables of DTU are in millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    image_size,
    inverse,
    numbered,
    rigid,
)
from colmap_tco.errors import InputError

SCANS = (1, 4, 9, 10, 11, 12, 13, 15, 23, 24, 29, 32, 33, 34, 48, 49, 62, 75, 77, 110, 114, 118)
"""The test set of MVSNet."""
EROSION = 10
MILLIMETRE = 1e-3

REMEDY = "unpack the DTU archive that docs/data_preprocess.md of HengyiWang/spann3r links into --root"


class DTU(InFolder):
    """The scans of MVSNet's test set that are there."""

    name = "dtu"
    title = "DTU"

    def scenes(self) -> list[str]:
        """``scan1`` and so on.

        Raises:
            InputError: there is none.
        """
        found = [f"scan{number}" for number in SCANS if (self.root / f"scan{number}").is_dir()]
        if not found:
            raise InputError(f"{self.root}: no scan of MVSNet's test set in it, such as scan1; {REMEDY}")
        return found

    def pictures(self, scene: str) -> list[Path]:
        """The colour pictures of a scene, in order."""
        return numbered(existing(self.root / scene / "images", "the pictures", REMEDY), "", ".jpg")

    def read(self, scene: str, frames: Sequence[int]) -> Scene:
        """Frames of a scan, with its cloud if it is there.

        Raises:
            InputError: a file is missing or damaged.
        """
        paths = chosen(self.pictures(scene), frames, scene)
        number = int(scene.removeprefix("scan"))
        cloud = self.root / "Points" / "stl" / f"stl{number:03d}_total.ply"
        return Scene(scene, tuple(map(_frame, paths)), cloud if cloud.exists() else None)


def _frame(picture: Path) -> Frame:
    folder, name = picture.parent.parent, picture.stem
    cam_from_world, K = read_camera(folder / "cams" / f"{name}_cam.txt")
    size, depth = image_size(picture), folder / "depths" / f"{name}.npy"
    height, width = _load(depth, mapped=True).shape
    K[0] *= size[0] / width
    K[1] *= size[1] / height
    mask = folder / "binary_masks" / f"{name}.png"
    world_from_cam = inverse(cam_from_world)
    world_from_cam[:3, 3] *= MILLIMETRE
    return Frame(name, picture, size, world_from_cam, K, lambda: _depth(depth, mask))


def read_camera(path: Path) -> tuple[Floats, Floats]:
    """cam_from_world (4, 4) in millimetres and intrinsics (3, 3) of a camera file of MVSNet.

    Raises:
        InputError: it is missing or holds something else.
    """
    words = existing(path, "the camera", REMEDY).read_text("utf-8").split()
    if len(words) < 27 or words[0] != "extrinsic" or words[17] != "intrinsic":
        raise InputError(
            f"{path}: a camera file of MVSNet has 'extrinsic', 16 numbers, 'intrinsic', 9 numbers; {REMEDY}"
        )
    try:
        numbers = np.array([*words[1:17], *words[18:27]], float)
    except ValueError as error:
        raise InputError(f"{path}: not all of it are numbers ({error}); {REMEDY}") from error
    return rigid(numbers[:16].reshape(4, 4), str(path)), numbers[16:].reshape(3, 3)


def _load(path: Path, mapped: bool = False) -> Depth:
    existing(path, "the depth map", REMEDY)
    try:
        depth = np.load(path, mmap_mode="r" if mapped else None)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: not an array of NumPy ({error}); {REMEDY}") from error
    if depth.ndim != 2:
        raise InputError(f"{path}: a depth map has two axes, not {depth.ndim}; {REMEDY}")
    return depth


def _depth(path: Path, mask_path: Path) -> Depth:
    """Metres, 0 outside the eroded mask."""
    import cv2

    depth = np.nan_to_num(_load(path).astype(np.float32), posinf=0, neginf=0)
    existing(mask_path, "the mask of the object", REMEDY)
    mask = cv2.imread(str(mask_path), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise InputError(f"{mask_path}: not a picture that can be decoded; {REMEDY}")
    inside = cv2.resize((mask > 127).astype(np.uint8), depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    inside = cv2.erode(inside, np.ones((EROSION, EROSION), np.uint8))
    metres: Depth = np.where((inside > 0) & (depth > 0), depth * np.float32(MILLIMETRE), np.float32(0))
    return metres
