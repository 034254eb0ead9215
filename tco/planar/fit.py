"""Planes of the depths of many views: found among their pixels, and fitted to those that took them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from tco.options import ConsensusConfig
from tco.planar._costs import votes
from tco.planar.frame import TILT, Frame
from tco.planar.view import Bools, Floats, Labels, Plane, Shown, guessed, normals, within

LEAST, MOST = 0.01, 0.1
"""Bounds of the relative error of a depth that is compared with a plane: no confidence makes it smaller, and
depths that are worse do not show a plane."""
SURE = 30.0
"""Confidence above 1 from which on a pixel counts no more than others."""
ANGLES = (12.0, 40.0)
"""Degrees between the normals of a pixel and of its plane, at most, for the least and the largest error."""
SAMPLES, DRAWN, JUDGES = 30_000, 300, 8_000
"""Pixels of all views among which planes are sought, planes that are drawn for each that is found, and pixels
that judge them."""
GRAZING = 0.5
"""Least cosine, but for the length of the ray, between a ray and a normal that is reckoned with: depths err
more where a surface is seen at a flat angle, about by as much as less of it is across the surface."""
GOLDEN, SHUFFLE = (5**0.5 - 1) / 2, 10_007.0
"""What lots are turned by from one plane to the next, and multiplied by to draw judges."""
FEWEST = 50
"""Pixels that make a plane."""
STEPS = 5
"""Of each robust fit."""
NEARLY = 10.0
"""Degrees from a direction of the scene within which a plane is expected to face along it."""
ALIKE = 1.2e-3
"""Share of a view that errs as one: a plane's covariance is of so many independent errors, not of pixels."""


@dataclass(frozen=True)
class _Pixels:
    """N pixels of any views: points, normals, directions of rays (N, 3), depths, errors, weights (N,)."""

    points: Floats
    normals: Floats
    directions: Floats
    depth: Floats
    error: Floats
    weight: Floats

    def __getitem__(self, keep: Bools | Labels) -> _Pixels:
        return _Pixels(
            self.points[keep], self.normals[keep], self.directions[keep], self.depth[keep],
            self.error[keep], self.weight[keep],
        )  # fmt: skip

    @staticmethod
    def of(view: Shown, on: Labels, normals: Floats) -> _Pixels:
        """Some of a view's pixels, by flat indices, whose normals are given."""
        part = view.at(on)
        return _Pixels(part.points, normals, part.directions, part.depth, part.error, part.sure.clip(0, SURE))

    @staticmethod
    def joined(parts: Sequence[_Pixels]) -> _Pixels:
        """All of them, one after the other."""
        names = [field.name for field in fields(_Pixels)]
        return _Pixels(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def across(self, normal: Floats) -> Floats:
        """Length along n, (N,), by which a relative error of depth of 1 is off a plane."""
        return np.asarray(self.depth * np.abs(self.directions @ normal).clip(GRAZING))

    def near(self, normal: Floats, offset: float, times: float = 1.0) -> Bools:
        """Which pixels (N,) are on a plane, by place and by normal."""
        far = np.abs(self.points @ normal - offset)
        close = far < times * bounded(self.error) * self.across(normal)
        return np.asarray(close & (self.normals @ normal > self.least_cosine))

    @property
    def least_cosine(self) -> Floats:
        """Least cosine (N,) between the normals of a pixel and of its plane."""
        share = (bounded(self.error) - LEAST) / (MOST - LEAST)
        return np.asarray(np.cos(np.radians(ANGLES[0] + (ANGLES[1] - ANGLES[0]) * share)))


def bounded(error: Floats) -> Floats:
    """Errors as they are compared with planes."""
    return error.clip(LEAST, MOST)


def find(
    views: Iterable[Shown], count: int, config: ConsensusConfig, rng: np.random.Generator
) -> list[Plane]:
    """The planes that explain most of the depths, the best first; a wavy one may come twice.

    Args:
        views: with their depths; one at a time is kept.
        count: of the views.
        config: how many planes at most, and how much each must explain.
        rng: draws them.
    """
    pixels, lots = _drawn(views, count, rng)
    total, found = float(pixels.weight.sum()), list[Plane]()
    while len(found) < config.planes and len(pixels.depth) >= FEWEST and total > 0:
        best = _best(*_chosen(pixels, lots, len(found)))
        normal, offset, on = _robust(pixels, *best)
        if on.sum() < FEWEST or pixels.weight[on].sum() < config.plane_share * total:
            break
        found.append(_plane(pixels[on], normal, offset))
        left = ~pixels.near(normal, offset, 1.5)
        pixels, lots = pixels[left], lots[left]
    return found


def _drawn(views: Iterable[Shown], count: int, rng: np.random.Generator) -> tuple[_Pixels, Floats]:
    """Pixels that have a normal, at random from all ``count`` views, which are read one by one; their lots.

    Lots (N,), in [0, 1), are what draws pixels later (:func:`_chosen`). That one pixel more has a normal
    changes one that is drawn, and none of another view.
    """
    parts, lots = [], []
    for view in views:
        n, (turn, lot) = normals(view), rng.random((2, view.depth.size))
        there = np.flatnonzero((n != 0).any(-1) & (view.sure > 0))
        pick = there[turn[there].argsort()[: -(-SAMPLES // count)]]
        parts.append(_Pixels.of(view, pick, n.reshape(-1, 3)[pick]))
        lots.append(lot[pick])
    return _Pixels.joined(parts), np.concatenate(lots)


def _best(drawn: _Pixels, judges: _Pixels) -> tuple[Floats, float]:
    """Normal and offset of the best, in the eyes of some pixels, of the planes through others."""
    offsets = (drawn.points * drawn.normals).sum(-1)
    first = int(votes_for(judges, drawn.normals, offsets).argmax())
    return drawn.normals[first], float(offsets[first])


def _chosen(pixels: _Pixels, lots: Floats, turn: int) -> tuple[_Pixels, _Pixels]:
    """Pixels that planes are put through, by weight, and pixels that judge these; others at every turn.

    What a pixel's lot is does not depend on the others. Those are drawn of whose lot the logarithm is least
    for their weight (Efraimidis and Spirakis, "Weighted random sampling with a reservoir", 2006).
    """
    lots = (lots + turn * GOLDEN) % 1
    keys = -np.log(1 - lots) / pixels.weight.astype(np.float64).clip(1e-12)
    return pixels[keys.argsort()[:DRAWN]], pixels[(lots * SHUFFLE % 1).argsort()[:JUDGES]]


def votes_for(pixels: _Pixels, normals: Floats, offsets: Floats) -> Floats:
    """Sum of the weights of the pixels near each of P planes, (P,), of normals (P, 3) and offsets (P,)."""
    rows = *pixels.points.T, *pixels.normals.T, *pixels.directions.T, bounded(pixels.error) * pixels.depth
    asked = np.stack([*rows, pixels.least_cosine, pixels.weight], dtype=np.float32)
    found = np.empty(len(offsets), np.float32)
    votes(asked, np.column_stack([normals, offsets]).astype(np.float32), np.float32(GRAZING), found)
    return found


def _robust(pixels: _Pixels, normal: Floats, offset: float) -> tuple[Floats, float, Bools]:
    """The plane fitted to the pixels near it, and which these are, some times."""
    on = pixels.near(normal, offset, 1.5)
    for _ in range(STEPS):
        if on.sum() < FEWEST:
            break
        near = pixels[on]
        weight = near.weight / near.across(normal) ** 2
        normal, offset = _least_squares(near.points, weight, normal)
        on = pixels.near(normal, offset, 1.5)
    return normal, offset, on


def _least_squares(points: Floats, weight: Floats, like: Floats) -> tuple[Floats, float]:
    """The plane of least weighted square distances from points (N, 3), its normal on the side of ``like``."""
    points, weight = points.astype(np.float64), weight.astype(np.float64)
    mean = weight @ points / weight.sum()
    centred = points - mean
    normal = np.linalg.eigh(centred.T @ (weight[:, None] * centred))[1][:, 0]
    normal = normal if normal @ like > 0 else -normal
    return normal.astype(np.float32), float(normal @ mean)


def _plane(pixels: _Pixels, normal: Floats, offset: float) -> Plane:
    """With a centre in the middle of pixels and two axes, and no covariance yet."""
    return Plane(normal, offset, _middle(pixels), within(normal), np.zeros((3, 3)))


def _middle(pixels: _Pixels) -> Floats:
    """Weighted mean (3,) of the points."""
    return np.asarray(pixels.weight @ pixels.points / max(float(pixels.weight.sum()), 1e-12))


def refit(
    views: Sequence[Shown], labels: Sequence[Labels], planes: Sequence[Plane], config: ConsensusConfig,
    frame: Frame | None = None,
) -> list[Plane]:  # fmt: skip
    """Planes fitted to the pixels that took them, with covariances; those that too few took are gone.

    Args:
        views: that were labelled.
        labels: (H, W) of each, plane k as k + 1.
        planes: that they could take.
        config: share of all pixels that a plane needs.
        frame: directions, if the scene has any, that planes near them are expected to face along.
    """
    total, found = sum(int(view.known.sum()) for view in views), list[Plane]()
    stands_for = 1 / (ALIKE * labels[0].size)
    for k, plane in enumerate(planes):
        parts = []
        for view, label in zip(views, labels, strict=True):
            on = np.flatnonzero((label == k + 1) & (view.sure > 0))
            parts.append(_Pixels.of(view, on, np.broadcast_to(plane.normal, (len(on), 3))))
        pixels = _Pixels.joined(parts)
        if len(pixels.depth) < max(FEWEST, config.plane_share * total):
            continue
        if plane.guess is not None:
            found.append(
                _likeliest(pixels, plane, plane.guess, np.linalg.inv(plane.guess.covariance), stands_for)
            )
        elif frame is not None and faces_along(plane, frame):
            normal, middle = frame.nearest(plane.normal), _middle(pixels)
            guess = guessed(normal, float(normal @ middle), middle, TILT, 1.0)
            precision = np.diag([*(1 / guess.covariance.diagonal()[:2]), 0.0])
            found.append(_likeliest(pixels, plane, guess, precision, stands_for))
        else:
            found.append(_fitted(pixels, plane, stands_for))
    return found


def faces_along(plane: Plane, frame: Frame) -> bool:
    """Whether a plane is one that is expected to face along a direction of the scene."""
    return float(frame.astray(plane.normal)) < NEARLY


def _fitted(pixels: _Pixels, plane: Plane, stands_for: float) -> Plane:
    """The plane fitted to pixels alone, robustly, from what it was; see :func:`_with_covariance`."""
    normal, offset = plane.normal, plane.offset
    for _ in range(STEPS):
        across = pixels.across(normal)
        off = (pixels.points @ normal - offset) / across / bounded(pixels.error)
        weight = pixels.weight / across**2 / (1 + off**2) ** 2
        normal, offset = _least_squares(pixels.points, weight, normal)
    return _with_covariance(_plane(pixels, normal, offset), pixels, stands_for)


def _likeliest(pixels: _Pixels, plane: Plane, guess: Plane, precision: Floats, stands_for: float) -> Plane:
    """The plane of the highest probability by pixels and by a guess, from what it was, and its covariance.

    Args:
        pixels: with errors that are not bounded.
        plane: what it was.
        guess: whose centre is on it.
        precision: (3, 3) inverse of the covariance of its slopes and its offset.
        stands_for: number of independent errors that a pixel stands for.
    """
    n, (u, v), middle = guess.normal, guess.axes, guess.centre
    across, error = pixels.across(n), pixels.error.clip(LEAST)
    at = np.concatenate([(pixels.points - middle) @ guess.axes.T, np.ones((len(across), 1))], -1)
    at = at.astype(np.float64)
    off = ((pixels.points - middle) @ n).astype(np.float64)
    now = np.array([-plane.normal @ u, -plane.normal @ v, plane.offset - plane.normal @ middle])
    now = now.astype(np.float64) / float(plane.normal @ n)
    for _ in range(STEPS):
        missed = (off - at @ now) / across / bounded(pixels.error)
        information = stands_for / (error * across).astype(np.float64) ** 2 / (1 + missed**2) ** 2
        normal_equations = at.T @ (information[:, None] * at) + precision
        now = np.linalg.solve(normal_equations, at.T @ (information * off))
    normal = n - now[0] * u - now[1] * v
    length = float(np.linalg.norm(normal))
    offset = float(normal @ middle + now[2]) / length
    covariance = np.linalg.inv(normal_equations)
    return Plane((normal / length).astype(np.float32), offset, middle, guess.axes, covariance, plane.guess)


def _with_covariance(plane: Plane, pixels: _Pixels, stands_for: float) -> Plane:
    """The plane with the covariance that the errors of pixels near it allow, if they weigh by these.

    Args:
        plane: fitted to them.
        pixels: with errors that are not bounded.
        stands_for: number of independent errors that a pixel stands for.
    """
    off = np.abs(pixels.points @ plane.normal - plane.offset) / pixels.across(plane.normal)
    near = pixels[off < 3 * bounded(pixels.error)]
    if not len(near.depth):
        near = pixels
    at = np.concatenate([(near.points - plane.centre) @ plane.axes.T, np.ones((len(near.depth), 1))], -1)
    information = stands_for / (near.error.clip(LEAST) * near.across(plane.normal)).astype(np.float64) ** 2
    normal_equations = at.T @ (information[:, None] * at)
    normal_equations += 1e-9 * information.sum() * np.eye(3)
    return replace(plane, covariance=np.linalg.inv(normal_equations))
