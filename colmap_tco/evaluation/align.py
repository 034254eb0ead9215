"""Alignment of a reconstruction to its truth: Umeyama's similarity, then ICP, as the paper's protocol has it.

The public code of TCO (github.com/cvlab-stonybrook/TCO, ``evaluation/mv_recon/eval_vggt.py``, which follows
that of CUT3R and π³) fits a similarity to corresponding points, applies it, and then runs Open3D's
point-to-point ICP with its default criteria (30 iterations, changes below 1e-6) from the identity; ICP is
rigid and leaves the scale alone. Its threshold is 0.1 in the unit of the truth (metres), and 100 for DTU,
whose unit is the millimetre.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from colmap_tco._open3d import open3d
from colmap_tco.evaluation.checks import as_points

logger = logging.getLogger(__name__)

Floats = NDArray[np.float64]

ICP_THRESHOLD = 0.1
"""Greatest distance of corresponding points in the paper's ICP, in units of the truth; 100 for DTU."""

_FLAT = 1e-9
"""Points are on a line where they reach less far across it than this share of their extent along it."""


@dataclass(frozen=True)
class Similarity:
    """x ↦ scale · rotation x + translation.

    Attributes:
        scale: positive.
        rotation: (3, 3), orthogonal with determinant 1.
        translation: (3,).
    """

    scale: float = 1.0
    rotation: Floats = field(default_factory=lambda: np.eye(3))
    translation: Floats = field(default_factory=lambda: np.zeros(3))

    def apply(self, xyz: Floats) -> Floats:
        """Points (…, 3) after the map."""
        return np.asarray(self.scale * np.asarray(xyz, np.float64) @ self.rotation.T + self.translation)

    def rotate(self, directions: Floats) -> Floats:
        """Directions (…, 3), such as normals, after the map."""
        return np.asarray(directions, np.float64) @ self.rotation.T

    def poses(self, world_from_cam: Floats) -> Floats:
        """Poses (…, 4, 4) of cameras that move with the world; they stay rigid, depths grow by ``scale``."""
        moved = np.array(world_from_cam, np.float64)
        moved[..., :3, :3] = self.rotation @ moved[..., :3, :3]
        moved[..., :3, 3] = self.apply(moved[..., :3, 3])
        return moved

    def after(self, first: Similarity) -> Similarity:
        """The map that does ``first`` and then this one."""
        return Similarity(
            self.scale * first.scale, self.rotation @ first.rotation, self.apply(first.translation)
        )

    @property
    def inverse(self) -> Similarity:
        """The map back."""
        return Similarity(1 / self.scale, self.rotation.T, -(self.rotation.T @ self.translation) / self.scale)

    @property
    def matrix(self) -> Floats:
        """(4, 4), for homogeneous points in columns."""
        out = np.eye(4)
        out[:3, :3] = self.scale * self.rotation
        out[:3, 3] = self.translation
        return out


def umeyama(
    source: Floats, target: Floats, weights: Floats | None = None, with_scale: bool = True
) -> Similarity:
    """The similarity that minimises Σ w ‖target − (s R source + t)‖² (Umeyama 1991, eq. 34 to 43).

    A reflection is never returned: where one would fit better, the best rotation is.

    Args:
        source: (N, 3).
        target: (N, 3), in the same order.
        weights: (N,) not negative, or None for all equal; points of weight 0 do not count.
        with_scale: False leaves the scale at 1.

    Raises:
        ValueError: shapes that differ, values that are not finite, or points that determine no rotation:
            fewer than three, or all on one line.
    """
    source, target = as_points(source, "source"), as_points(target, "target")
    if source.shape != target.shape:
        raise ValueError(f"{len(source)} source points and {len(target)} target points do not correspond")
    w = _weights(weights, len(source))
    if int((w > 0).sum()) < 3:
        raise ValueError(f"a similarity takes at least 3 corresponding points, not {int((w > 0).sum())}")
    w = w / w.sum()
    source_mean, target_mean = w @ source, w @ target
    x, y = source - source_mean, target - target_mean
    for name, points, mean in (("source", x, source_mean), ("target", y, target_mean)):
        _check_spread(name, points[w > 0], mean)
    u, d, vt = np.linalg.svd((y * w[:, None]).T @ x)
    if d[1] <= _FLAT * d[0]:
        raise ValueError("source and target points agree along one line only, which leaves no rotation")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = float((d * sign).sum() / (w @ (x**2).sum(1))) if with_scale else 1.0
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def icp(
    source: Floats, target: Floats, threshold: float = ICP_THRESHOLD, start: Similarity | None = None
) -> Similarity:
    """``start`` refined by Open3D's point-to-point ICP, with the criteria that are its defaults.

    Where no source point is within the threshold of the target, ICP has nothing to go by and returns its
    start; so does this, with a warning.

    Args:
        source: (N, 3).
        target: (M, 3).
        threshold: correspondences further apart than this are left out, in units of the target.
        start: applied to the source first; None is the identity.

    Returns:
        A similarity with the scale of ``start``.

    Raises:
        ValueError: an empty cloud, a value that is not finite, or a threshold that is not positive.
        MissingError: Open3D cannot be imported.
    """
    start = start or Similarity()
    moved, target = start.apply(as_points(source, "source")), as_points(target, "target")
    if not threshold > 0:
        raise ValueError(f"the threshold of ICP must be positive, it is {threshold}")
    if not len(moved) or not len(target):
        raise ValueError("ICP takes two clouds that have points")
    o3d = open3d()
    # Rotations about a far origin lose digits, so both clouds are moved; the result does not depend on it.
    centre = target.mean(0)
    clouds = [
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points - centre)))
        for points in (moved, target)
    ]
    registration = o3d.pipelines.registration
    found = registration.registration_icp(
        *clouds, threshold, np.eye(4), registration.TransformationEstimationPointToPoint()
    )
    if not found.fitness > 0:
        logger.warning("ICP: no point is within %g of the truth, so the alignment is not refined", threshold)
        return start
    pose = np.asarray(found.transformation, np.float64)
    step = Similarity(1.0, pose[:3, :3], pose[:3, 3] + centre - pose[:3, :3] @ centre)
    return step.after(start)


def _weights(weights: Floats | None, count: int) -> Floats:
    w = np.ones(count) if weights is None else np.asarray(weights, np.float64)
    if w.shape != (count,) or not np.isfinite(w).all() or (w < 0).any():
        raise ValueError(f"weights must be {count} finite numbers that are not negative")
    return w


def _check_spread(name: str, centred: Floats, mean: Floats) -> None:
    """Points (N, 3) about their mean must span a plane, by more than the rounding of the coordinates."""
    extent = np.linalg.svd(centred, compute_uv=False)
    noise = float(np.spacing(np.abs(mean).max())) * np.sqrt(len(centred))
    if extent[0] <= noise:
        raise ValueError(f"all {name} points coincide, which determines no similarity")
    if extent[1] <= max(_FLAT * extent[0], noise):
        raise ValueError(f"all {name} points are on one line, which leaves the rotation about it open")
