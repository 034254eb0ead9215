"""Cameras whose calibration is implausible: COLMAP finds it with the scene, and sometimes both are bent."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Camera, Registered

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


def implausible(images: Iterable[Registered]) -> list[str]:
    """A sentence on the cameras that distort as no lens does, if any; the shape of the model is doubtful."""
    cameras = {entry.camera.camera_id: entry.camera for entry in images}
    much = {i: pincushion(c) for i, c in cameras.items() if not _pycolmap.is_spherical(c)}
    strange = {i: share for i, share in much.items() if share > MOST}
    if not strange:
        return []
    worst = max(strange, key=strange.__getitem__)
    return [
        f"{len(strange)} of {len(cameras)} cameras have more pincushion distortion than lenses have, camera "
        f"{worst} ({cameras[worst].model.name}) {100 * strange[worst]:.0f} % at the corners: the "
        "self-calibration went astray, and the shape of the model with it. Map again with a known focal "
        "length (EXIF, or COLMAP's --ImageReader.camera_params), or with more varied pictures"
    ]
