"""ScanNet v2 (Dai et al., CVPR 2017): indoor RGB-D sequences, for poses from depth.

Two layouts are read. What ScanNet's ``SensReader/python/reader.py`` exports of ``<scene>.sens``:

    <root>/<scene>/color/0.jpg, 1.jpg, …          1296×968
    <root>/<scene>/depth/0.png, …                 640×480, 16 bit, millimetres, 0 is none
    <root>/<scene>/pose/0.txt, …                  4×4 camera to world, metres; −inf where tracking failed
    <root>/<scene>/intrinsic/intrinsic_color.txt  4×4, also intrinsic_depth.txt
    <root>/<scene>/<scene>_vh_clean_2.ply         the mesh, if it was downloaded

and the 90 frames that MonST3R's ``datasets_preprocess/prepare_scannet.py`` takes of it (every third of the
first 270), which π³ and TCO read:

    <root>/<scene>/color_90/frame_0000.jpg, depth_90/frame_0000.png, pose_90.txt  (16 numbers a frame)

The frames of a scene are those 90 in both cases. Colour and depth differ in size and focal length; in the
export both cameras are at the same place (extrinsic_color is the identity), so that a depth is looked up
along the ray of its pixel. Depths count between 1 mm and 10 m, both excluded, as in TCO's
``configs/evaluation/relpose-distance.yaml`` (``min_valid_depth``, ``max_valid_depth``).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
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
    numbered,
    read_depth_png,
    read_matrix,
    read_numbers,
    rigid,
)
from colmap_tco.errors import InputError

COUNT, EVERY = 90, 3
VALID = 1e-3, 10.0
"""Metres between which a depth counts."""

REMEDY = "export the scene's .sens with ScanNet's SensReader, see docs/bench.md"


class ScanNet(InFolder):
    """The scenes that are there."""

    name = "scannet"
    title = "ScanNet"

    def scenes(self) -> list[str]:
        """``scene0707_00`` and so on: all folders that hold frames.

        Raises:
            InputError: there is none.
        """
        found = [
            name for name in folders(self.root) if self._has(name, "color_90") or self._has(name, "color")
        ]
        if not found:
            raise InputError(f"{self.root}: no folder in it has color/ or color_90/; {REMEDY}")
        return found

    def _has(self, scene: str, folder: str) -> bool:
        return (self.root / scene / folder).is_dir()

    def pictures(self, scene: str) -> list[Path]:
        """The colour pictures of a scene, in order, at most 90."""
        root = self.root / scene
        if self._has(scene, "color_90"):
            return numbered(root / "color_90", "frame_", ".jpg")
        pictures = numbered(existing(root / "color", "the pictures", REMEDY), "", ".jpg")
        return pictures[: COUNT * EVERY : EVERY]

    def read(self, scene: str, frames: Sequence[int]) -> Scene:
        """Frames of a scene, with its mesh if it is there.

        Raises:
            InputError: a file is missing or damaged, or a frame was not tracked.
        """
        root, pictures = self.root / scene, self.pictures(scene)
        K = _intrinsics(root, "color")
        depth_K = _intrinsics(root, "depth")
        paths = chosen(pictures, frames, scene)
        prepared = self._has(scene, "color_90")
        poses = _prepared_poses(root, len(pictures), frames) if prepared else [_pose(root, p) for p in paths]
        found = []
        for path, pose in zip(paths, poses, strict=True):
            size = image_size(path)
            _check(K, size, root, path)
            folder = "depth_90" if prepared else "depth"
            load = partial(_depth, root / folder / f"{path.stem}.png")
            found.append(Frame(path.stem, path, size, pose, K, load, depth_K))
        mesh = root / f"{scene}_vh_clean_2.ply"
        return Scene(scene, tuple(found), mesh if mesh.exists() else None)


def _depth(path: Path) -> Depth:
    """Metres, 0 where there is none or it does not count."""
    depth, least, most = read_depth_png(path, REMEDY), np.float32(VALID[0]), np.float32(VALID[1])
    return np.where((depth > least) & (depth < most), depth, np.float32(0))


def _pose(root: Path, picture: Path) -> Floats:
    file = root / "pose" / f"{picture.stem}.txt"
    return rigid(read_matrix(file, "the pose", REMEDY), str(file))


def _prepared_poses(root: Path, count: int, frames: Sequence[int]) -> list[Floats]:
    file = root / "pose_90.txt"
    rows = read_numbers(file, "the poses, 16 numbers a line", REMEDY)
    if rows.shape != (count, 16):
        raise InputError(
            f"{file}: {rows.shape[0]}×{rows.shape[1]} numbers where {count}×16 are due; {REMEDY}"
        )
    return [rigid(rows[i].reshape(4, 4), f"{file}, line {i + 1}") for i in frames]


def _intrinsics(root: Path, which: str) -> Floats:
    file = root / "intrinsic" / f"intrinsic_{which}.txt"
    return read_matrix(file, "the intrinsics", REMEDY)[:3, :3]


def _check(K: Floats, size: tuple[int, int], root: Path, picture: Path) -> None:
    """The principal point is near the middle unless pictures were resized and intrinsics were not."""
    off = np.abs(K[:2, 2] / size - 0.5)
    if off.max() > 0.1:
        raise InputError(
            f"{picture}: {size[0]}×{size[1]} pixels, which {root / 'intrinsic' / 'intrinsic_color.txt'} "
            f"with its principal point ({K[0, 2]:.0f}, {K[1, 2]:.0f}) is not of; export them in full size"
        )
