"""7-Scenes (Shotton et al., CVPR 2013): seven rooms, recorded with a hand-held Kinect.

Layout of the archives of microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes:

    <root>/<scene>/TestSplit.txt                        lines such as "sequence3"
    <root>/<scene>/seq-03/frame-000000.color.png        640×480 RGB
    <root>/<scene>/seq-03/frame-000000.depth.png        640×480, 16 bit, millimetres, 65535 is invalid
    <root>/<scene>/seq-03/frame-000000.pose.txt         4×4 camera to world, metres

Colour and depth come from two cameras, which were not calibrated; the dataset's page gives the Kinect's
default for the depth camera, focal length 585, principal point (320, 240), and the poses are those of that
camera. The calibration used since (liris.cnrs.fr, in the scripts of DSAC*, ACE and SimpleRecon) has a focal
length of 525 and the principal point in the middle for colour, and the transform :data:`COLOUR_FROM_DEPTH`.
SimpleRecon's ``data_scripts/7scenes_preprocessing.py`` warps depth into the colour camera and writes
``frame-*.depth.proj.png``, 0 where nothing was measured. Such files are used where they are; else the same is
done here, from ``depth.png``.

The evaluations of CUT3R, π³ and TCO take the projected depth, but the poses as they are in the files, which
are the depth camera's; and π³'s and TCO's have, as focal length of colour, NRGBD's 554.26 (``datasets/
sevenscenes.py`` in both). ``as_published`` does so too, to compare with their tables.
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
    pixel_centres,
    project,
    rays,
    read_depth_png,
    read_matrix,
    rigid,
)
from colmap_tco.errors import InputError

SIZE = (640, 480)
FOCAL, DEPTH_FOCAL, PUBLISHED_FOCAL = 525.0, 585.0, 554.2562584220408
INVALID = (0, 65535)
FARTHEST = 10.0
"""Metres; the published evaluations take depths beyond this for errors of the sensor."""

COLOUR_FROM_DEPTH: Floats = np.array(
    [
        [9.9996518012567637e-01, 2.6765126468950343e-03, -7.9041012313000904e-03, -2.5558943178152542e-02],
        [-2.7409311281316700e-03, 9.9996302803027592e-01, -8.1504520778013286e-03, 1.0109636268061706e-04],
        [7.8819942130445332e-03, 8.1718328771890631e-03, 9.9993554558014031e-01, 2.0318321729487039e-03],
        [0, 0, 0, 1],
    ]
)
"""Points of the depth camera's frame in the colour camera's, metres."""

REMEDY = "unpack the scene's archive and the archives of its sequences in it, see docs/bench.md"


class SevenScenes(InFolder):
    """The sequences of the test split."""

    name = "7scenes"
    title = "7-Scenes"

    def __init__(self, root: Path, as_published: bool = False) -> None:
        """Where the scenes' folders are, and whether focal length and poses are those of the evaluations.

        Raises:
            InputError: the folder is not there.
        """
        super().__init__(root)
        self.as_published = as_published

    def scenes(self) -> list[str]:
        """``chess/seq-03`` and so on: the sequences of ``TestSplit.txt``, scene by scene.

        Raises:
            InputError: no scene, a scene without its split, or a line of it that is no sequence.
        """
        found = []
        for scene in folders(self.root):
            split = existing(self.root / scene / "TestSplit.txt", "the list of test sequences", REMEDY)
            for line in split.read_text("utf-8").split():
                number = line.removeprefix("sequence")
                if not number.isdigit():
                    raise InputError(f"{split}: '{line}' is no sequence, such as 'sequence3'; {REMEDY}")
                found.append(f"{scene}/seq-{int(number):02d}")
        if not found:
            raise InputError(f"{self.root}: no scene in it; {REMEDY}")
        return found

    def pictures(self, scene: str) -> list[Path]:
        """The colour pictures of a scene, in order."""
        folder = existing(self.root / scene, "a sequence", REMEDY)
        return numbered(folder, "frame-", ".color.png")

    def read(self, scene: str, frames: Sequence[int]) -> Scene:
        """Frames of a sequence; its true depth is in the colour camera.

        Raises:
            InputError: a file is missing or damaged, or a picture is not of 640×480 pixels.
        """
        paths = chosen(self.pictures(scene), frames, scene)
        return Scene(scene, tuple(self._frame(path) for path in paths))

    def _frame(self, picture: Path) -> Frame:
        name = picture.name.removesuffix(".color.png")
        size = image_size(picture)
        if size != SIZE:
            raise InputError(
                f"{picture}: {size[0]}×{size[1]} pixels, but the calibration is of 640×480; do not resize"
            )
        file = picture.with_name(f"{name}.pose.txt")
        pose = rigid(read_matrix(file, "the pose", REMEDY), str(file))
        if not self.as_published:
            pose = pose @ np.linalg.inv(COLOUR_FROM_DEPTH)
        focal = PUBLISHED_FOCAL if self.as_published else FOCAL
        K = intrinsics(focal, focal, SIZE[0] / 2, SIZE[1] / 2)
        return Frame(name, picture, size, rigid(pose, str(file)), K, lambda: _depth(picture.parent, name))


def _depth(folder: Path, name: str) -> Depth:
    """Depth in the colour camera: as it was projected before, else projected now."""
    projected = folder / f"{name}.depth.proj.png"
    if projected.exists():
        depth = read_depth_png(projected, REMEDY, INVALID)
    else:
        depth = registered(read_depth_png(folder / f"{name}.depth.png", REMEDY, INVALID))
    depth[depth > FARTHEST] = 0
    return depth


def registered(depth: Depth) -> Depth:
    """A map of the depth camera (480, 640) in the colour camera, metres; the nearest where several fall.

    Every measured pixel is one point, which falls into one pixel, so that some stay empty, as in the
    script of SimpleRecon.
    """
    height, width = depth.shape
    z = depth.reshape(-1).astype(np.float64)
    measured = z > 0
    centre = (width / 2, height / 2)
    xyz = rays(pixel_centres(width, height)[measured], intrinsics(DEPTH_FOCAL, DEPTH_FOCAL, *centre))
    xyz = xyz * z[measured, None] @ COLOUR_FROM_DEPTH[:3, :3].T + COLOUR_FROM_DEPTH[:3, 3]
    xyz = xyz[xyz[:, 2] > 0]
    column, row = np.floor(project(xyz, intrinsics(FOCAL, FOCAL, *centre))).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    nearest = np.full(height * width, np.inf)
    np.minimum.at(nearest, (row * width + column)[inside], xyz[inside, 2])
    nearest[np.isinf(nearest)] = 0
    return nearest.reshape(height, width).astype(np.float32)
