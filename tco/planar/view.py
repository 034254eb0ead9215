"""What planes are sought in and drawn into: a view with its depths, and a plane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tco.geometry import pixel_grid, rays
from tco.types import Cameras, Prediction, Views

Floats = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]
Labels = NDArray[np.int64]

ERROR = 0.05
"""Relative error that a depth of confidence 2 is taken to have; with confidence c it is this over c − 1."""
SIDE = 222.0
"""Root of the number of pixels of the views that settings were chosen for: borders count relative to it."""
REACH = 3.0
"""Pixels to each side over which normals are taken, in views of that size."""


@dataclass(frozen=True)
class Shown:
    """One view, perhaps at a lower resolution.

    Attributes:
        depth: (H, W), 1 where there is none.
        sure: (H, W) confidence above 1, 0 where there is no depth.
        known: (H, W) where there is a depth that counts.
        image: (H, W, 3) colours in [0, 1].
        directions: (H, W, 3) of the pixels' rays in the world, of unit depth.
        centre: (3,) of the camera in the world.
    """

    depth: Floats
    sure: Floats
    known: Bools
    image: Floats
    directions: Floats
    centre: Floats

    def at(self, pixels: Labels) -> Shown:
        """Some pixels, by flat indices (N,): what is of (H, W) is then of (N,); ``side`` means nothing."""
        depth, sure = (part.ravel()[pixels] for part in (self.depth, self.sure))
        image, directions = (part.reshape(-1, 3)[pixels] for part in (self.image, self.directions))
        return Shown(depth, sure, self.known.ravel()[pixels], image, directions, self.centre)

    @property
    def points(self) -> Floats:
        """(H, W, 3) in the world."""
        return self.centre + self.directions * self.depth[..., None]

    @property
    def error(self) -> Floats:
        """Relative error (H, W) that depths are taken to have."""
        return ERROR / self.sure.clip(1e-3)

    @property
    def side(self) -> float:
        """Root of the number of pixels."""
        return math.sqrt(self.depth.size)


def shown(prediction: Prediction, cameras: Cameras, views: Views, i: int, stride: int = 1) -> Shown:
    """View ``i`` at every ``stride``-th of its pixels, colours averaged over as many."""
    h, w = (size // stride * stride for size in views.size)
    pick = slice(stride // 2, h, stride), slice(stride // 2, w, stride)
    depth, confidence = prediction.depth[i].float(), prediction.confidence[i].float()
    known = views.valid[i] & torch.isfinite(depth) & (depth > 0)
    depth = depth.where(known, torch.ones_like(depth))
    sure = (confidence - 1).where(known & ~confidence.isnan(), torch.zeros_like(depth)).clamp(0, 1e6)
    ray = rays(pixel_grid(*views.size, depth).reshape(-1, 2), cameras.K[i].float()).reshape(*views.size, 3)
    pose = cameras.world_from_cam[i].float()
    image = views.images[i, :, :h, :w].float().nan_to_num().permute(1, 2, 0)
    image = image.reshape(h // stride, stride, w // stride, stride, 3).mean((1, 3))
    return Shown(
        depth[pick].numpy(), sure[pick].numpy(), known[pick].numpy(), image.numpy(),
        (ray @ pose[:3, :3].T)[pick].numpy(), pose[:3, 3].numpy(),
    )  # fmt: skip


def span(view: Shown, reach: float) -> int:
    """A length in pixels of views of ``SIDE``² pixels in pixels of this view, at least one."""
    return max(1, round(reach * view.side / SIDE))


def normals(view: Shown, reach: float = REACH) -> Floats:
    """(H, W, 3) of the surface over ``reach`` pixels to each side; 0 at borders and beside unknown depths."""
    h, w = view.depth.shape
    r = span(view, reach)
    found = np.zeros((h, w, 3), np.float32)
    if min(h, w) <= 2 * r:
        return found
    rows, columns = slice(r, h - r), slice(r, w - r)
    points, known = view.points, view.known
    across = points[rows, 2 * r :] - points[rows, : -2 * r]
    down = points[2 * r :, columns] - points[: -2 * r, columns]
    n = np.cross(across, down)
    n /= np.linalg.norm(n, axis=-1, keepdims=True).clip(1e-12)
    there = known[rows, columns] & known[rows, 2 * r :] & known[rows, : -2 * r]
    there &= known[2 * r :, columns] & known[: -2 * r, columns]
    found[rows, columns] = n * there[..., None]
    return found


@dataclass(frozen=True)
class Plane:
    """The plane n·X = d of the world, and how well it is known.

    Attributes:
        normal: (3,) n, of length one.
        offset: d.
        centre: (3,) mean of the pixels that it was fitted to.
        axes: (2, 3) directions in the plane.
        covariance: (3, 3) of (a, b, c), where the plane's error at centre + u axes[0] + v axes[1] is
            a u + b v + c along n; zeros before the first fit to labels.
        guess: what it was put up as before any pixel took it, if it was not found among pixels.

    A point on a ray of direction r is (n·X − d) / (n·r) deeper than the plane, so that errors of depth are
    |n·r| times as large along n.
    """

    normal: Floats
    offset: float
    centre: Floats
    axes: Floats
    covariance: Floats
    guess: Plane | None = None

    def depth(self, view: Shown) -> Floats:
        """Depth (H, W) of the plane at the pixels of a view, 0 where it is behind the camera."""
        along = view.directions @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (self.offset - view.centre @ self.normal) / along
        return np.where((depth > 0) & np.isfinite(depth), depth, 0).astype(np.float32)

    def error(self, view: Shown, depth: Floats) -> Floats:
        """Relative standard error (H, W) of these depths of the plane, by its covariance."""
        turned, shift = self._errors(view.centre)
        parts = view.directions * depth[..., None] @ turned + shift
        along = np.abs(view.directions @ self.normal).clip(1e-6)
        return np.sqrt(np.einsum("...i,...i", parts, parts)) / along / depth.clip(1e-6)

    def _errors(self, centre: Floats) -> tuple[Floats, Floats]:
        """Matrix (3, 3) and offsets (3,) of what has the plane's error as length, by places from a centre."""
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(values.clip(0))  # root @ root.T is the covariance
        turned = self.axes.T @ root[:2]
        return turned.astype(np.float32), (root[2] - (self.centre - centre) @ turned).astype(np.float32)

    def packed(self, centre: Floats) -> Floats:
        """All of it as a camera at a centre sees it, (16,) float32, as :mod:`tco.planar._costs` takes it."""
        turned, shift = self._errors(centre)
        away = self.offset - centre @ self.normal
        return np.concatenate([self.normal, [away], turned.T.ravel(), shift], dtype=np.float32)


def guessed(normal: Floats, offset: float, centre: Floats, tilt: float, sigma: float) -> Plane:
    """A plane through ``centre`` (3,) with a normal uncertain by ``tilt`` degrees, an offset by ``sigma``."""
    variance = np.square([math.radians(tilt), math.radians(tilt), sigma])
    return Plane(normal, offset, centre, within(normal), np.diag(variance))


def within(normal: Floats) -> Floats:
    """Two directions (2, 3) in the plane of a normal (3,), at right angles."""
    axis = np.eye(3, dtype=np.float32)[int(np.abs(normal).argmin())]
    u = np.cross(normal, axis)
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(normal, u)])
