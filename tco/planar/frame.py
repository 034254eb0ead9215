"""Three directions at right angles along which most surfaces of a scene face, as in rooms and buildings.

What is known of one surface then tells how others stand, that nobody can measure (Furukawa et al.,
Manhattan-world stereo, CVPR 2009). Which way surfaces face is told by normals, roughly and of all; edges in
the pictures say it to a fraction of a degree (Coughlan and Yuille, Manhattan world, ICCV 1999). Not every
scene has such directions, and they are not forced on one that has none: a meadow with stones has an upright,
and what stands on it faces anywhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations

import cv2
import numpy as np

from tco.planar.view import SIDE, Floats, Plane, Shown, normals

REACH = 15.0
"""Pixels to each side over which normals are taken, in views of ``SIDE``² pixels: few wiggle so far."""
SURE = 3.0
"""Confidence above 1 from which on a pixel counts no more than others."""
PIXELS = 30_000
"""Pixels of all views at most whose normals are asked."""
ALONG = 12.0
"""Degrees from a direction within which a normal is along it."""
SQUARE = 15.0
"""Degrees by which the angle of two planes of a first guess may differ from a right one."""
MOST_OF = 0.4
"""Share of the normals, by their weight, that must be along one of the three directions."""
SHORTEST = 15.0
"""Pixels of the edges that are asked, in views of that size."""
SHARP = 1.0
"""Degrees by which an edge misses its direction."""
EDGES = 0.15
"""Share of the edges, by length, that must be along the three directions; of those that lie anywhere 5 %
are."""
TURN = 0.5
"""Degrees at which directions around the most frequent one are tried by the edges."""
TILT = 1.0
"""Standard deviation, degrees, of the normal of a plane that is taken to face along a direction."""
STEPS = 6
"""Of each fit."""


@dataclass(frozen=True)
class Frame:
    """The directions, rows of ``axes`` (3, 3), in the world."""

    axes: Floats

    def astray(self, directions: Floats) -> Floats:
        """Degrees (...) between directions (..., 3) of length one and the axis that each is nearest to."""
        along = np.abs(directions @ self.axes.T).max(-1).clip(0, 1)
        return np.asarray(np.degrees(np.arccos(along)))

    def nearest(self, normal: Floats) -> Floats:
        """The axis (3,), or its opposite, that a normal (3,) is nearest to."""
        along = self.axes @ normal
        k = int(np.abs(along).argmax())
        return np.asarray(self.axes[k] * np.sign(along[k]))


def edges(view: Shown) -> tuple[Floats, Floats]:
    """Straight edges of a picture: normals (N, 3) of the planes that they and the camera span, lengths (N,).

    An edge along a direction of the world lies in a plane that holds it. (OpenCV's LSD: Grompone von Gioi et
    al., A fast line segment detector with a false detection control, PAMI 2010.)
    """
    grey = (255 * view.image.mean(-1)).clip(0, 255).astype(np.uint8)
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    ends = np.zeros((0, 4)) if found is None else np.asarray(found, np.float64).reshape(-1, 4)
    length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    long = length * SIDE > SHORTEST * view.side
    ends, length = ends[long], length[long]
    corner, d = view.directions[0, 0].astype(np.float64), view.directions
    step = np.stack([d[0, -1] - d[0, 0], d[-1, 0] - d[0, 0]]).astype(np.float64)
    step /= np.array([[d.shape[1] - 1], [d.shape[0] - 1]])
    n = np.cross(corner + ends[:, :2] @ step, corner + ends[:, 2:] @ step)
    return n / np.linalg.norm(n, axis=-1, keepdims=True).clip(1e-12), length


def frame_of(
    views: Sequence[Shown], planes: Sequence[Plane], lines: Iterable[tuple[Floats, Floats]]
) -> Frame | None:
    """The directions along which most of the normals are; None if they do not stand at right angles.

    Args:
        views: with their depths.
        planes: of which two that stand at right angles to each other are the first guess.
        lines: :func:`edges` of all views.
    """
    n, weight = _weighted_normals(views)
    spanned, lengths = (np.concatenate(x) for x in zip(*lines, strict=True))
    if not (weight.sum() > 0 and lengths.sum() > 0):
        return None
    best, axes = 0.0, None
    for a, b in permutations(planes, 2):
        cosine = float(a.normal @ b.normal)
        if abs(cosine) < math.sin(math.radians(SQUARE)):
            across = b.normal - cosine * a.normal
            across = across / np.linalg.norm(across)
            guess = np.stack([a.normal, across, np.cross(a.normal, across)])
            share = float(shares(n, weight, guess).sum())
            if share > best:
                best, axes = share, guess
    if axes is None:
        return None
    axes = by_normals(n, weight, axes)
    first = int(shares(n, weight, axes).argmax())
    axes = by_edges(spanned, lengths, turned(spanned, lengths, np.roll(axes, -first, 0)))
    along = float(_along(spanned, lengths, axes).sum() / lengths.sum())
    if shares(n, weight, axes).sum() < MOST_OF or along < EDGES:
        return None
    return Frame(axes.astype(np.float32))


def _weighted_normals(views: Sequence[Shown]) -> tuple[Floats, Floats]:
    """Normals (N, 3) of pixels of all views and their weights (N,)."""
    found, weights = [np.zeros((0, 3), np.float32)], [np.zeros(0, np.float32)]
    for view in views:
        n = normals(view, REACH)
        there = (n != 0).any(-1) & (view.sure > 0)
        every = max(1, round(there.sum() * len(views) / PIXELS))
        found.append(n[there][::every])
        weights.append(view.sure[there][::every].clip(0, SURE))
    return np.concatenate(found), np.concatenate(weights)


def shares(n: Floats, weight: Floats, axes: Floats) -> Floats:
    """Share (3,) of the normals (N, 3), by weights (N,), that is along each axis."""
    along = np.abs(n @ axes.T) > math.cos(math.radians(ALONG))
    return np.asarray(weight @ along / weight.sum())


def by_normals(n: Floats, weight: Floats, axes: Floats) -> Floats:
    """The rotation (3, 3) of least squares to the normals along its axes (Kabsch), from a first guess.

    They count by the root of what is along them, so that a large floor does not decide on all three.
    """
    for _ in range(STEPS):
        cosine = n @ axes.T
        along = np.abs(cosine) > math.cos(math.radians(ALONG))
        pull = (weight[:, None] * along * np.sign(cosine)).T.astype(np.float64) @ n
        pull /= np.sqrt((weight @ along).clip(1e-9))[:, None]
        u, _, vt = np.linalg.svd(pull)
        axes = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return axes


def turned(spanned: Floats, lengths: Floats, axes: Floats) -> Floats:
    """Axes turned around the first, to where most edges are along the two others.

    Args:
        spanned, lengths: of the edges; see :func:`edges`.
        axes: (3, 3), rows.
    """
    best, found = -1.0, axes
    for angle in np.radians(np.arange(-45, 45, TURN)):
        second = math.cos(angle) * axes[1] + math.sin(angle) * axes[2]
        guess = np.stack([axes[0], second, np.cross(axes[0], second)])
        along = float(_along(spanned, lengths, guess)[:, 1:].sum())
        if along > best:
            best, found = along, guess
    return found


def by_edges(spanned: Floats, lengths: Floats, axes: Floats) -> Floats:
    """Axes (3, 3) turned so that the edges near them are along them, by robust least squares."""
    for _ in range(STEPS):
        weight = _along(spanned, lengths, axes)
        lever = np.cross(axes[None], spanned[:, None])  # of a small turn, on the cosine of edge and axis
        off = spanned @ axes.T
        normal_equations = np.einsum("nk,nki,nkj->ij", weight, lever, lever)
        normal_equations += 1e-6 * lengths.sum() * np.eye(3)
        turn = np.linalg.solve(normal_equations, -np.einsum("nk,nki,nk->i", weight, lever, off))
        axes = axes @ cv2.Rodrigues(turn)[0].T
    return axes


def _along(spanned: Floats, lengths: Floats, axes: Floats) -> Floats:
    """How much (N, 3) of each edge's length is along each axis."""
    missed = spanned @ axes.T / math.sin(math.radians(SHARP))
    return np.asarray(lengths[:, None] * np.exp(-(missed**2)))
