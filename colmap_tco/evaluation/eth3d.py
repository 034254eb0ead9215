"""Accuracy, completeness and F-score as the ETH3D benchmark defines them.

Schöps et al., CVPR 2017; program at github.com/ETH3D/multi-view-evaluation (``accuracy.cc``,
``completeness.cc``, ``util.h``). They differ from those of Tanks and Temples in three ways:

* distances count up to and with the tolerance, not below it;
* the shares are taken in voxels of 1 cm and averaged over the voxels that hold points, so that dense
  regions weigh no more than sparse ones; two grids are used, the second shifted by half a voxel in each
  direction, and all voxels of both enter one mean;
* accuracy knows free space. A laser beam widens from its start; a point of the reconstruction is judged only
  by the scan points whose beams pass through it. It is accurate where one of these scan points is within the
  tolerance, else inaccurate where one lies behind it, for then the beam would have been stopped. Points that
  no beam proves wrong (behind surfaces, off the scans) are unobserved and do not count.

The last needs the positions of the scanner (:class:`Scan`). For a truth without them
:func:`voxel_curve` takes every point that is not within the tolerance for inaccurate, which is stricter.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_tco.evaluation.checks import as_points, as_poses
from colmap_tco.evaluation.points import FScore, from_shares, nearest

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

TOLERANCES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
"""Metres; those of the example in the program's description."""

VOXEL_SIZE = 0.01
_SHIFTS = (0.0, 0.5)
_CHUNK = 20_000


@dataclass(frozen=True)
class Beam:
    """The laser's beam: its radius at distance r from the scanner is start + r tan(divergence).

    Attributes:
        start: radius at the scanner, metres.
        divergence_deg: half of its opening angle, degrees.
    """

    start: float = 0.5 * 0.00225
    divergence_deg: float = 0.011

    def radius(self, distance: Floats) -> Floats:
        """Radius (N,) at distances (N,) from the scanner."""
        return self.start + distance * math.tan(math.radians(self.divergence_deg))


@dataclass(frozen=True)
class Scan:
    """A laser scan.

    Attributes:
        points: (M, 3) in the frame of the scanner, which is at its origin.
        world_from_scan: (4, 4), rigid.
    """

    points: Floats
    world_from_scan: Floats

    @property
    def world(self) -> Floats:
        """The points (M, 3) in the world."""
        pose = np.asarray(self.world_from_scan, np.float64)
        return np.asarray(self.points, np.float64) @ pose[:3, :3].T + pose[:3, 3]


def eth3d_curve(
    points: Floats,
    scans: Sequence[Scan],
    tolerances: Sequence[float] = TOLERANCES,
    voxel_size: float = VOXEL_SIZE,
    beam: Beam | None = None,
) -> tuple[FScore, ...]:
    """Accuracy (as ``precision``), completeness (as ``recall``) and F-score at several tolerances.

    Args:
        points: (N, 3) in the world; an empty cloud scores 0.
        scans: of the laser scanner.
        tolerances: in units of the scans, in any order.
        voxel_size: side of the voxels in which shares are taken.
        beam: of the scanner; None: that of the benchmark.

    Raises:
        ValueError: no scan, an empty one, a pose that is not rigid, a value that is not finite, or a size
            that is not positive.
    """
    points = _checked(points, tolerances, voxel_size)
    if not scans:
        raise ValueError("there is no scan to compare with")
    as_poses(np.stack([scan.world_from_scan for scan in scans]), "scan")
    truth = as_points(np.concatenate([scan.world for scan in scans]), "the scans'")
    closest, refuted = np.full(len(points), np.inf), np.zeros(len(points), bool)
    for scan in scans:
        near, wrong = _judge(points, scan, beam or Beam())
        np.minimum(closest, near, out=closest)
        refuted |= wrong
    voxels = _Voxels(points, voxel_size)
    accuracy = [voxels.mean(closest <= t, (closest <= t) | refuted) for t in tolerances]
    return _scores(accuracy, _completeness(points, truth, tolerances, voxel_size))


def voxel_curve(
    points: Floats,
    truth: Floats,
    tolerances: Sequence[float] = TOLERANCES,
    voxel_size: float = VOXEL_SIZE,
) -> tuple[FScore, ...]:
    """ETH3D's scores where the scanner's positions are unknown, so that every point is judged.

    Args:
        points: (N, 3); an empty cloud scores 0.
        truth: (M, 3) in the same frame.
        tolerances: in units of the truth.
        voxel_size: side of the voxels in which shares are taken.

    Raises:
        ValueError: no truth, a value that is not finite, or a size that is not positive.
    """
    points, truth = _checked(points, tolerances, voxel_size), as_points(truth, "the truth's")
    if not len(truth):
        raise ValueError("the truth has no points to compare")
    closest, _ = nearest(points, truth) if len(points) else (np.zeros(0), None)
    voxels = _Voxels(points, voxel_size)
    accuracy = [voxels.mean(closest <= t) for t in tolerances]
    return _scores(accuracy, _completeness(points, truth, tolerances, voxel_size))


def _checked(points: Floats, tolerances: Sequence[float], voxel_size: float) -> Floats:
    if not voxel_size > 0 or any(not t > 0 for t in tolerances):
        raise ValueError(
            f"voxel size and tolerances must be positive, not {voxel_size} and {list(tolerances)}"
        )
    return as_points(points, "the reconstruction's")


def _scores(accuracy: list[float], completeness: list[float]) -> tuple[FScore, ...]:
    return tuple(from_shares(a, c) for a, c in zip(accuracy, completeness, strict=True))


def _completeness(
    points: Floats, truth: Floats, tolerances: Sequence[float], voxel_size: float
) -> list[float]:
    if not len(points):
        return [0.0] * len(tolerances)
    distance, _ = nearest(truth, points)
    voxels = _Voxels(truth, voxel_size)
    return [voxels.mean(distance <= t) for t in tolerances]


class _Voxels:
    """The voxels of both grids that hold points of a cloud (N, 3)."""

    def __init__(self, points: Floats, size: float) -> None:
        self._voxel_of = (
            [np.unique(_keys(points, size, shift), return_inverse=True)[1] for shift in _SHIFTS]
            if len(points)
            else []
        )

    def mean(self, good: Mask, counted: Mask | None = None) -> float:
        """Mean over the voxels of the share of their counted points (N,) that are good; 0 without any."""
        counted = np.ones(len(good), bool) if counted is None else counted
        shares = []
        for voxel_of in self._voxel_of:
            count = np.bincount(voxel_of, weights=counted)
            shares.append(np.bincount(voxel_of, weights=good & counted)[count > 0] / count[count > 0])
        every = np.concatenate([np.zeros(0), *shares])
        return float(every.mean()) if len(every) else 0.0


def _keys(points: Floats, voxel_size: float, shift: float) -> Ints:
    """A number (N,) for the voxel of each point.

    Raises:
        ValueError: the cloud is too large for the voxels to be numbered.
    """
    cells = np.floor(points / voxel_size + shift)
    cells -= cells.min(0)
    sides = cells.max(0) + 1
    if not float(np.prod(sides)) < 2.0**62:
        raise ValueError(
            f"a cloud of {np.ptp(points, axis=0)} cannot be divided into voxels of {voxel_size}; "
            "are the units right?"
        )
    x, y, z = cells.astype(np.int64).T
    _, sy, sz = (int(side) for side in sides)
    return np.asarray((x * sy + y) * sz + z)


def _judge(points: Floats, scan: Scan, beam: Beam) -> tuple[Floats, Mask]:
    """For each point: distance to the nearest scan point whose beam passes through it, and whether one of
    these lies behind it."""
    from scipy.spatial import cKDTree

    rays = as_points(scan.points, "a scan's")
    reach = np.linalg.norm(rays, axis=1)
    rays, reach = rays[reach > 0], reach[reach > 0]
    if not len(rays):
        raise ValueError("a scan has no points")
    directions = rays / reach[:, None]
    tree = cKDTree(directions)
    pose = np.asarray(scan.world_from_scan, np.float64)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    nearest_distance, refuted = np.full(len(points), np.inf), np.zeros(len(points), bool)
    for first in range(0, len(points), _CHUNK):
        block = local[first : first + _CHUNK]
        point, ray = _pairs(tree, block, beam)
        p, d = block[point], directions[ray]
        along = (p * d).sum(1)
        away = np.linalg.norm(p - along[:, None] * d, axis=1)
        hit = (along >= 0) & (away <= beam.radius(np.linalg.norm(p, axis=1)))
        point, ray, along = point[hit], ray[hit], along[hit]
        distance = np.linalg.norm(block[point] - rays[ray], axis=1)
        np.minimum.at(nearest_distance, first + point, distance)
        refuted[first + point[along < reach[ray]]] = True
    return nearest_distance, refuted


def _pairs(tree: object, points: Floats, beam: Beam) -> tuple[Ints, Ints]:
    """Indices (K,) of points and of the rays whose beams may pass through them."""
    distance = np.linalg.norm(points, axis=1)
    sine = beam.radius(distance) / np.maximum(distance, 1e-300)
    # The chord between two unit vectors at the angle whose sine this is; a beam wider than the distance
    # reaches all rays on the same side.
    angle = np.where(sine < 1, np.arcsin(np.minimum(sine, 1)), np.pi / 2)
    chord = np.where(distance > 0, 2 * np.sin(angle / 2), 2.0) * (1 + 1e-6) + 1e-12
    unit = points / np.maximum(distance, 1e-300)[:, None]
    lists = tree.query_ball_point(unit, chord, workers=-1)  # type: ignore[attr-defined]
    return _flat(lists)


def _flat(lists: Sequence[list[int]]) -> tuple[Ints, Ints]:
    counts = np.array([len(one) for one in lists], np.int64)

    def every() -> Iterator[int]:
        for one in lists:
            yield from one

    return np.repeat(np.arange(len(lists)), counts), np.fromiter(every(), np.int64, int(counts.sum()))
