"""Pinhole cameras, and the choice of one that shows what a distorted camera shows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Camera, Floats, Mask
from colmap_tco.errors import InputError

MAX_AREA = 1.5
"""An undistorted image may have this many times the pixels of its original."""
MAX_HALF_ANGLE = math.radians(60)
"""Directions further than this from the axis, horizontally or vertically, are cropped."""
MIN_COVERAGE = 0.25
"""A centred pinhole image of which less than this is picture is refused."""
CELL = 16
"""Side in pixels of the cells in which the inverse of a distortion is checked."""


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion, in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def K(self) -> Floats:
        """Intrinsics (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], float)

    def resized(self, width: int, height: int) -> Pinhole:
        """The camera of the image resized to width × height, with its own scale along each axis."""
        fx, cx = (value * width / self.width for value in (self.fx, self.cx))
        fy, cy = (value * height / self.height for value in (self.fy, self.cy))
        return Pinhole(width, height, fx, fy, cx, cy)

    def padded(self, width: int, height: int) -> Pinhole:
        """The camera of the image centred on a canvas of width × height (both differences even)."""
        dx, dy = width - self.width, height - self.height
        if dx < 0 or dy < 0 or dx % 2 or dy % 2:
            raise ValueError(f"{self.width}×{self.height} cannot be centred on {width}×{height}")
        return Pinhole(width, height, self.fx, self.fy, self.cx + dx // 2, self.cy + dy // 2)

    def pixels(self, xy: Floats) -> Floats:
        """Pixels (N, 2) of normalised camera coordinates (N, 2)."""
        return xy * (self.fx, self.fy) + (self.cx, self.cy)

    def normalised(self, pixels: Floats) -> Floats:
        """Normalised camera coordinates (N, 2) of pixels (N, 2)."""
        return (pixels - (self.cx, self.cy)) / (self.fx, self.fy)


def undistorted_camera(camera: Camera) -> Pinhole:
    """The pinhole camera that shows what a COLMAP camera shows, principal point in the middle.

    Focal lengths stay, so that the centre of the image keeps its resolution. All original pixels are
    kept where that costs at most ``MAX_AREA`` times their number; otherwise the field of view lies as
    far as this allows between the largest that is centred and full of picture and the one that keeps
    everything, within ``MAX_HALF_ANGLE``.

    Raises:
        InputError: no pinhole can represent the camera, or little of it would be picture.
    """
    if _pycolmap.is_spherical(camera):
        raise InputError(f"camera model {camera.model.name} covers more than a pinhole camera can")
    fx, fy = _pycolmap.focal_lengths(camera)
    focal = np.array([fx, fy])
    full, everything = _half_extents(camera)
    budget = MAX_AREA * camera.width * camera.height / (4 * focal.prod())
    for blend in np.linspace(1, 0, 101):
        half = full + blend * (everything - full)
        if half.prod() <= budget:
            break
    else:
        half = half * math.sqrt(budget / half.prod())
    # An exactly centred pinhole must keep its size although 2 f (w / 2 f) may round to just above w.
    width, height = (math.ceil(side) for side in 2 * half * focal - 1e-3)
    if width < 1 or height < 1:
        raise InputError(f"camera {camera.camera_id}: the principal point lies outside the image")
    pinhole = Pinhole(width, height, fx, fy, width / 2, height / 2)
    coverage = trusted_cells(camera, pinhole, inside=True).mean()
    if coverage < MIN_COVERAGE:
        raise InputError(
            f"camera {camera.camera_id} ({camera.model.name}): only {coverage:.0%} of a centred pinhole "
            "image would be picture; its principal point is far off or its distortion has no inverse"
        )
    return pinhole


def _half_extents(camera: Camera) -> tuple[Floats, Floats]:
    """Half sizes (2,) in normalised coordinates: of the centred area full of picture, and of all pixels."""
    limit = math.tan(MAX_HALF_ANGLE)
    x, y = np.meshgrid(np.linspace(0, camera.width, 129), np.linspace(0, camera.height, 129))
    grid = _pycolmap.cam_from_img(camera, np.stack([x, y], -1).reshape(-1, 2)).reshape(129, 129, 2)
    everything = np.nanmax(np.minimum(np.abs(grid), limit), (0, 1), initial=0.0)
    sides = np.array([[-grid[:, 0, 0], grid[:, -1, 0]], [-grid[0, :, 1], grid[-1, :, 1]]])
    full = np.nanmin(np.clip(sides, 0, limit), (1, 2), initial=limit)
    return np.minimum(full, everything), everything


def trusted_cells(camera: Camera, pinhole: Pinhole, inside: bool = False) -> Mask:
    """Cells of 16 × 16 pixels at whose corners the distortion is invertible (and inside the image).

    A polynomial distortion that folds back shows parts of the picture twice; the second copy does not
    return to itself through the inverse.
    """
    x = np.minimum(np.arange(0, pinhole.width + CELL, CELL), pinhole.width)
    y = np.minimum(np.arange(0, pinhole.height + CELL, CELL), pinhole.height)
    nodes = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2).astype(float)
    pixels = _pycolmap.img_from_cam(camera, pinhole.normalised(nodes))
    back = pinhole.pixels(_pycolmap.cam_from_img(camera, np.nan_to_num(pixels, nan=-1e6)))
    with np.errstate(invalid="ignore"):
        good = np.abs(back - nodes).max(1) < 0.5
    if inside:
        good &= ((pixels >= 0) & (pixels <= _pycolmap.camera_size(camera))).all(1)
    good = good.reshape(len(y), len(x))
    cells: Mask = good[:-1, :-1] & good[1:, :-1] & good[:-1, 1:] & good[1:, 1:]
    return cells
