"""NRGBD, the synthetic rooms of Neural RGB-D Surface Reconstruction (Azinović et al., CVPR 2022).

Layout of ``neural_rgbd_data.zip`` (7.25 GB), as github.com/dazinovic/neural-rgbd-surface-reconstruction
describes it:

    <root>/<scene>/images/img0.png          RGB; numbers without leading zeros
    <root>/<scene>/depth/depth0.png         16 bit, millimetres: exact depth of the rendering
    <root>/<scene>/focal.txt                one number, pixels
    <root>/<scene>/poses.txt                4N lines of 4 numbers: camera to world, with OpenGL's camera axes
                                            (x right, y up, z backward); "nan" where there is no pose

There are also ``depth_with_noise``, ``depth_filtered`` and ``trainval_poses.txt``, for reconstruction; the
evaluations of CUT3R, π³ and TCO take ``depth`` and ``poses.txt``, and leave out depths above 10 m and below
1 mm (``datasets/nrgbd.py`` of π³ and TCO). The camera is a centred pinhole; its principal point is taken to
be the middle of the picture, which no source gives to better than half a pixel.
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
    folders,
    image_size,
    intrinsics,
    numbered,
    read_depth_png,
    read_numbers,
    rigid,
)
from colmap_tco.errors import InputError

NEAREST, FARTHEST = 1e-3, 10.0
"""Metres; what lies outside does not count in the published evaluations."""

OPENGL_FROM_OPENCV: Floats = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes: y and z have the other sign."""

REMEDY = (
    "unpack http://kaldir.vc.in.tum.de/neural_rgbd/neural_rgbd_data.zip and name the folder that holds the "
    "scenes with --root"
)


class NRGBD(InFolder):
    """The nine rooms."""

    name = "nrgbd"
    title = "NRGBD"

    def scenes(self) -> list[str]:
        """The folders that hold pictures.

        Raises:
            InputError: there is none.
        """
        found = [name for name in folders(self.root) if (self.root / name / "images").is_dir()]
        if not found:
            raise InputError(f"{self.root}: no folder in it has images/; {REMEDY}")
        return found

    def pictures(self, scene: str) -> list[Path]:
        """The colour pictures of a scene, in order."""
        return numbered(existing(self.root / scene / "images", "the pictures", REMEDY), "img", ".png")

    def read(self, scene: str, frames: Sequence[int]) -> Scene:
        """Frames of a room.

        Raises:
            InputError: a file is missing or damaged, poses and pictures are not as many, or a frame was not
                tracked.
        """
        pictures, folder = self.pictures(scene), self.root / scene
        file = folder / "poses.txt"
        poses = read_numbers(file, "the poses, lines of 4 numbers", REMEDY)
        if poses.shape != (4 * len(pictures), 4):
            raise InputError(
                f"{file}: {poses.shape[0]}×{poses.shape[1]} numbers where {len(pictures)} pictures make "
                f"{4 * len(pictures)}×4; {REMEDY}"
            )
        focal = read_numbers(folder / "focal.txt", "the focal length, one number", REMEDY)
        if focal.size != 1 or not focal.item() > 0:
            raise InputError(f"{folder / 'focal.txt'}: a focal length is one positive number; {REMEDY}")
        matrices = poses.reshape(-1, 4, 4)
        return Scene(
            scene,
            tuple(
                _frame(path, rigid(matrices[i], f"{file}, frame {i}") @ OPENGL_FROM_OPENCV, focal.item())
                for i, path in zip(frames, chosen(pictures, frames, scene), strict=True)
            ),
        )


def _frame(picture: Path, world_from_cam: Floats, focal: float) -> Frame:
    width, height = image_size(picture)
    depth = picture.parent.parent / "depth" / picture.name.replace("img", "depth", 1)
    K = intrinsics(focal, focal, width / 2, height / 2)
    return Frame(picture.stem, picture, (width, height), world_from_cam, K, lambda: _depth(depth))


def _depth(path: Path) -> Depth:
    depth = read_depth_png(path, REMEDY)
    depth[(depth > FARTHEST) | (depth < NEAREST)] = 0
    return depth
