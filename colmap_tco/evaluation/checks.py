"""What the metrics demand of their arguments, and the one place where they import Open3D."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def as_points(points: Floats, name: str) -> Floats:
    """The points as (N, 3) float64.

    Raises:
        ValueError: another shape, or a value that is not finite.
    """
    out = np.asarray(points, np.float64)
    if out.ndim != 2 or out.shape[1] != 3:
        raise ValueError(f"{name} points must be (N, 3), not {out.shape}")
    if not np.isfinite(out).all():
        raise ValueError(f"{int((~np.isfinite(out)).any(1).sum())} {name} points are not finite")
    return out


def as_poses(world_from_cam: Floats, name: str) -> Floats:
    """The poses as (N, 4, 4) float64, each a rotation and a translation.

    Raises:
        ValueError: another shape, a value that is not finite, or a matrix that is not a rigid motion.
    """
    out = np.asarray(world_from_cam, np.float64)
    if out.ndim != 3 or out.shape[1:] != (4, 4):
        raise ValueError(f"{name} poses must be (N, 4, 4), not {out.shape}")
    if not np.isfinite(out).all():
        raise ValueError(f"{name} poses hold values that are not finite")
    R = out[:, :3, :3]
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0)
    wrong = (off > 1e-4) | (np.linalg.det(R) < 0) | (np.abs(out[:, 3] - [0, 0, 0, 1]).max(1) > 1e-9)
    if wrong.any():
        raise ValueError(f"{name} pose {int(wrong.argmax())} is not a rotation and a translation")
    return out
