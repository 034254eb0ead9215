"""Cameras whose calibration is implausible: COLMAP finds it with the scene, and sometimes both are bent."""

from __future__ import annotations

import logging

import numpy as np

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Camera, Registered

log = logging.getLogger(__name__)

MOST = 0.05
"""Pincushion distortion at the corners of a picture beyond which a lens is implausible. Barrel distortion has
no such bound: wide lenses have it."""


def pincushion(camera: Camera) -> float:
    """How much further from the principal point the corners are than without distortion, as a part of that.

    The largest of the four; negative for barrel distortion and for fisheye models, 0 where a corner is so far
    out that the distortion has no inverse there.

    Args:
        camera: a ``pycolmap.Camera`` with a focal length.
    """
    w, h = _pycolmap.camera_size(camera)
    corners = np.array([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]])
    straight = _pycolmap.cam_from_img(camera, corners)
    middle = _pycolmap.img_from_cam(camera, np.zeros((1, 2)))
    seen = (corners - middle) / np.array(_pycolmap.focal_lengths(camera))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.linalg.norm(seen, axis=1) / np.linalg.norm(straight, axis=1) - 1
    return float(np.nan_to_num(ratio, nan=0.0, posinf=0.0).max())


def warn_of_lenses(images: list[Registered]) -> None:
    """Say of each camera that distorts as no lens does; the shape of its model is probably wrong, too."""
    cameras = {entry.camera.camera_id: entry.camera for entry in images}
    for number, camera in cameras.items():
        if _pycolmap.is_spherical(camera):
            continue
        much = pincushion(camera)
        if much > MOST:
            log.warning(
                "camera %d (%s) has %.0f %% of pincushion distortion at the corners, more than lenses have: "
                "its self-calibration went astray, and the model's shape with it. Map again with a known "
                "focal length (EXIF, or COLMAP's --ImageReader.camera_params), or with more varied pictures",
                number, camera.model.name, 100 * much,
            )  # fmt: skip
