"""Rendered samples on disk, and what COLMAP would have known about them.

``python -m training.dataset --out runs/data --count 3000`` renders; it skips what is there, so it
may be stopped and started again, or run several times with other ``--start`` values.
"""

from __future__ import annotations

import argparse
import logging
import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from torch import Tensor

from colmap_tco.overlap import overlap
from tco.types import Cameras, Priors, SparseDepth, Views
from training.photo import photographed
from training.raytrace import Floats
from training.scenes import Sample, generate

logger = logging.getLogger(__name__)


def write(out: Path, start: int, count: int, shape: tuple[int, int], views: int) -> None:
    """Render samples ``start`` to ``start + count`` into ``out``, skipping those that exist."""
    out.mkdir(parents=True, exist_ok=True)
    for seed in range(start, start + count):
        path = out / f"{seed:06d}.npz"
        if path.exists():
            continue
        s = generate(seed, views, shape)
        part = path.with_suffix(f".{os.getpid()}.part")
        with part.open("wb") as f:
            np.savez(f, images=s.images, depth=s.depth, K=s.K, cam_from_world=s.cam_from_world)
        part.replace(path)
        if seed % 50 == 0:
            logger.info("rendered %d", seed)


def read(path: Path) -> Sample:
    """One sample from disk."""
    with np.load(path) as f:
        return Sample(f["images"], f["depth"], f["K"], f["cam_from_world"])


def resized(s: Sample, shape: tuple[int, int]) -> Sample:
    """The sample at another size; depth of the nearest pixel centre."""
    h, w = s.depth.shape[1:]
    if (h, w) == shape:
        return s
    images = np.stack([cv2.resize(i, shape[::-1], interpolation=cv2.INTER_AREA) for i in s.images])
    ys = ((np.arange(shape[0]) + 0.5) * h / shape[0]).astype(int)
    xs = ((np.arange(shape[1]) + 0.5) * w / shape[1]).astype(int)
    K = s.K * np.array([[w / shape[1]], [h / shape[0]], [1]], np.float32) ** -1
    return Sample(images, s.depth[:, ys[:, None], xs[None]], K, s.cam_from_world)


def flipped(s: Sample) -> Sample:
    """Mirror image of the whole world: every left is a right."""
    mirror = np.diag([-1.0, 1, 1, 1]).astype(np.float32)
    K = s.K.copy()
    K[:, 0, 2] = s.depth.shape[2] - K[:, 0, 2]
    return Sample(
        np.ascontiguousarray(s.images[:, :, ::-1]), np.ascontiguousarray(s.depth[:, :, ::-1]), K,
        mirror @ s.cam_from_world @ mirror,
    )  # fmt: skip


@dataclass(frozen=True)
class Tracks:
    """Simulated triangulated points: positions, and which view sees which."""

    xyz: NDArray[np.float64]
    seen: NDArray[np.bool_]
    sigma: NDArray[np.float64]


def _corners(image: NDArray[np.uint8], sharp: float, least: float, crowding: float) -> Floats:
    """Chance (H, W), up to a factor, that a pixel becomes a point: root of the smaller structure eigenvalue.

    Raised to ``sharp``, none below ``least`` grey levels a pixel, and more where others are near, by the
    mean over a twentieth of the width to the power ``crowding``.
    """
    grey = gaussian_filter(image.astype(np.float32).mean(-1), 0.7)
    gy, gx = np.gradient(grey)
    xx, yy, xy = (gaussian_filter(a, 1.2) for a in (gx * gx, gy * gy, gx * gy))
    corner = np.sqrt(np.maximum(0, (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)))
    least = max(0.3, min(least, float(np.quantile(corner, 0.97))))
    chance = np.where(corner < least, 0, corner**sharp)
    if crowding > 0:
        chance = chance * gaussian_filter(np.minimum(corner, 20), 0.05 * image.shape[1]) ** crowding
    return chance


def triangulated(s: Sample, rng: np.random.Generator) -> Tracks:
    """Points as COLMAP would triangulate them: at corners, in three views or more, noisy, some wrong.

    Many or few, spread out or crowded where there is most texture, with none on plain walls.
    """
    v, h, w = s.depth.shape
    xyz, pose = [], np.linalg.inv(s.cam_from_world.astype(np.float64))
    few = rng.random() < 0.3
    want = int(np.exp(rng.uniform(np.log(25 if few else 80), np.log(150 if few else 1500))))
    sharp, least = rng.uniform(0.5, 2.0), np.exp(rng.uniform(np.log(0.3), np.log(5.0)))
    crowding = float(rng.choice([0.0, rng.uniform(0.3, 2.0)]))
    for i in range(v):
        corner = _corners(s.images[i], sharp, least, crowding)
        corner[s.depth[i] <= 0] = 0
        if corner.sum() <= 0:
            continue
        flat = (corner / corner.sum()).ravel()
        pick = rng.choice(h * w, min(max(8, 2 * want // v), int((flat > 0).sum())), replace=False, p=flat)
        y, x = np.divmod(pick, w)
        ray = np.linalg.inv(s.K[i].astype(np.float64)) @ np.stack([x + 0.5, y + 0.5, np.ones(len(x))])
        cam = ray * s.depth[i, y, x]
        xyz.append((pose[i, :3, :3] @ cam + pose[i, :3, 3:]).T)
    points = np.concatenate(xyz) if xyz else np.zeros((0, 3))
    seen = np.stack([_visible(s, i, points) for i in range(v)]) & (rng.random((v, len(points))) < 0.75)
    keep = seen.sum(0) >= 3
    points, seen = points[keep], seen[:, keep]
    eye = pose[:, :3, 3]
    along = points - eye[rng.integers(0, v)]
    sigma = np.exp(rng.normal(np.log(rng.choice([0.003, 0.008, 0.015])), 0.6, len(points)))
    wrong = rng.random(len(points)) < rng.choice([0.0, 0.02, 0.06])
    scale = np.where(wrong, rng.uniform(0.6, 1.5, len(points)), 1 + sigma * rng.standard_normal(len(points)))
    stated = sigma * np.exp(rng.normal(0, 0.3, len(points)))
    return Tracks(points + (scale[:, None] - 1) * along, seen, stated)


def _visible(s: Sample, i: int, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which world points view ``i`` sees, by its own depth."""
    if not len(points):
        return np.zeros(0, bool)
    m = s.cam_from_world[i].astype(np.float64)
    cam = points @ m[:3, :3].T + m[:3, 3]
    z = np.maximum(cam[:, 2], 1e-6)
    xy = cam[:, :2] / z[:, None] * s.K[i, [0, 1], [0, 1]] + s.K[i, :2, 2]
    h, w = s.depth.shape[1:]
    inside = (cam[:, 2] > 0) & (xy > 0.5).all(1) & (xy[:, 0] < w - 0.5) & (xy[:, 1] < h - 0.5)
    at = np.where(inside[:, None], xy, 1) - 0.5
    depth = map_coordinates(s.depth[i], [at[:, 1], at[:, 0]], order=0)
    return inside & (np.abs(z / np.maximum(depth, 1e-6) - 1) < 0.02)


def assemble(s: Sample, images: Floats, tracks: Tracks) -> tuple[Views, Priors, Tensor]:
    """Network inputs and the true depth (V, H, W), in units of the median depth of the points."""
    v = len(images)
    cams = s.cam_from_world.astype(np.float64)
    sparse, depths = [], []
    for i in range(v):
        cam = tracks.xyz @ cams[i, :3, :3].T + cams[i, :3, 3]
        z = np.maximum(cam[:, 2], 1e-6)
        xy = cam[:, :2] / z[:, None] * s.K[i, [0, 1], [0, 1]] + s.K[i, :2, 2]
        ok = tracks.seen[i] & (cam[:, 2] > 0)
        sparse.append((xy[ok], cam[ok, 2], tracks.sigma[ok], np.flatnonzero(ok)))
        depths.append(cam[ok, 2])
    unit = float(np.median(np.concatenate(depths)))
    pose = np.linalg.inv(cams)
    told = overlap([np.flatnonzero(seen) for seen in tracks.seen], pose[:, :3, 3], tracks.xyz)
    pose = np.linalg.inv(pose[0]) @ pose
    pose[:, :3, 3] /= unit
    f = torch.float32
    points = tuple(
        SparseDepth(
            torch.as_tensor(xy, dtype=f),
            torch.as_tensor(z / unit, dtype=f),
            torch.as_tensor(e, dtype=f),
            torch.as_tensor(t),
        )
        for xy, z, e, t in sparse
    )
    cameras = Cameras(torch.as_tensor(pose, dtype=f), torch.as_tensor(s.K, dtype=f))
    x = torch.as_tensor(images, dtype=f).permute(0, 3, 1, 2).contiguous()
    names = tuple(str(i) for i in range(v))
    views = Views(x, torch.ones(x.shape[0], *x.shape[2:], dtype=torch.bool), names)
    priors = Priors(cameras, points, overlap=torch.as_tensor(told, dtype=f))
    return views, priors, torch.as_tensor(s.depth / unit, dtype=f)


def jittered(s: Sample, rng: np.random.Generator) -> Sample:
    """The sample with the pose errors that bundle adjustment leaves, a fraction of a pixel."""
    amount = float(rng.choice([0.0, 0.15, 0.5])) / float(s.K[0, 0, 0])
    cams = s.cam_from_world.copy()
    median = np.median(s.depth[s.depth > 0])
    for i in range(1, len(cams)):
        turn = cv2.Rodrigues(rng.normal(0, amount / 2, 3))[0].astype(np.float32)
        cams[i, :3] = turn @ cams[i, :3]
        cams[i, :3, 3] += rng.normal(0, amount / 2, 3) * median
    return Sample(s.images, s.depth, s.K, cams)


def load(path: Path, seed: int, shape: tuple[int, int]) -> tuple[Views, Priors, Tensor] | None:
    """A training sample with random photographic effects, points and pose noise.

    Returns:
        Views, priors and true depth, or None where a view has fewer than eight points.
    """
    rng = np.random.default_rng(seed)
    s = read(path)
    if rng.random() < 0.5:
        s = flipped(s)
    tracks = triangulated(s, rng)
    if not len(tracks.xyz) or tracks.seen.sum(1).min() < 8:
        return None
    s = resized(s, shape)
    if rng.random() < 0.5:  # any colours; in the other half the sky is as it is
        s = Sample(s.images[..., rng.permutation(3)], s.depth, s.K, s.cam_from_world)
    return assemble(jittered(s, rng), photographed(s.images, rng), tracks)


def main() -> None:
    """Command line of the renderer."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--count", type=int, default=3000)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--shape", type=int, nargs=2, default=(192, 256), metavar=("H", "W"))
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    write(args.out, args.start, args.count, tuple(args.shape), args.views)


if __name__ == "__main__":
    main()
