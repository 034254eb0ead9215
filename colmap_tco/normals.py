"""Surface normals of a depth map, by plane fits in inverse depth.

The points X of a plane satisfy n·X = d. With X = z · ray(u, v) that is 1 / z = n·ray(u, v) / d, and
the ray is linear in the pixel (u, v): over the image, the inverse depth of a plane is exactly
linear. A least-squares fit of 1 / z over a small window therefore has no error on planes, however
slanted, and the fitted coefficients are the normal.

Pixels across a discontinuity are kept out by their weight: the fit starts from the one-sided slope,
per axis, on the side where the inverse depth does not bend, and a pixel's weight falls with its
residual to the plane.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_tco.maps import map_intrinsics
from colmap_tco.workers import Workers

if TYPE_CHECKING:
    from colmap_tco.pinhole import Pinhole

_ROWS = 64
"""Rows that a thread takes at a time."""


def normals_from_depth(
    depth: NDArray[np.floating], camera: Pinhole, radius: int = 2, num_threads: int = -1
) -> NDArray[np.float32]:
    """Normals (H, W, 3) in the camera frame, unit length and facing the camera.

    Args:
        depth: (H, W) camera z, 0 where there is none.
        camera: the pinhole of the image; its intrinsics are scaled to the map's size.
        radius: the window of the fit is (2 radius + 1)² pixels.
        num_threads: threads to use, one a core if not positive.

    Returns:
        float32; (0, 0, 0) where there is no depth, and where fewer than three neighbouring pixels
        that are not in line belong to the same surface.
    """
    from colmap_tco import _normal_kernels

    if depth.ndim != 2:
        raise ValueError(f"a depth map is (H, W), this one is {depth.shape}")
    if radius < 1:
        raise ValueError(f"a plane fit needs a radius of at least 1, not {radius}")
    depth = np.ascontiguousarray(depth, np.float32)
    inverse = np.zeros_like(depth)
    np.divide(1.0, depth, out=inverse, where=depth > 0)
    bordered = _normal_kernels.bordered(inverse, radius)
    normals = np.empty((*depth.shape, 3), np.float32)
    intrinsics = map_intrinsics(camera, depth.shape)
    with Workers(num_threads) as workers:
        workers.run(
            len(depth),
            _ROWS,
            lambda part: _normal_kernels.plane_normals(
                bordered, intrinsics, radius, (part.start, part.stop), normals
            ),
        )
    return normals
