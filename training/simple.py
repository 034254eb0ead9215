"""Scenes of few, boldly textured primitives: rooms, desks, façades and objects."""

from __future__ import annotations

import numpy as np

from training.builder import Builder, Light, Vec
from training.raytrace import BOX, CYLINDER, ELLIPSOID, ROOM


def _clutter(b: Builder, centre: Vec, extent: Vec, top: float, count: int, size: tuple[float, float]) -> None:
    """Small things of every kind standing on a horizontal surface at height ``top``."""
    for _ in range(count):
        half = np.exp(b.rng.uniform(np.log(size[0]), np.log(size[1]), 3))
        at = centre[:2] + b.rng.uniform(-1, 1, 2) * extent[:2]
        kind = int(b.rng.choice([BOX, BOX, ELLIPSOID, CYLINDER]))
        if kind == CYLINDER:
            half[1] = half[0]
        b.add(kind, np.array([*at, top + half[2]]), half, b.rng.uniform(0, np.pi))


def _table(b: Builder, centre: Vec, yaw: float) -> None:
    """A plate on four legs with clutter on it."""
    w, d, h = b.rng.uniform(0.3, 0.9), b.rng.uniform(0.25, 0.5), b.rng.uniform(0.35, 0.9)
    b.add(BOX, np.array([centre[0], centre[1], h]), np.array([w, d, 0.02]), yaw)
    c, s = np.cos(yaw), np.sin(yaw)
    for sx, sy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        x, y = sx * (w - 0.04), sy * (d - 0.04)
        b.add(
            BOX,
            np.array([centre[0] + c * x - s * y, centre[1] + s * x + c * y, h / 2]),
            np.array([0.025, 0.025, h / 2]),
            yaw,
        )
    reach = 0.7 * min(w, d) * np.ones(2)
    _clutter(b, centre, reach, h + 0.02, int(b.rng.integers(0, 7)), (0.03, 0.2))


def _shelf(b: Builder, centre: Vec, yaw: float) -> None:
    """Boards between two sides, filled with blocks."""
    w, d, h = b.rng.uniform(0.3, 0.7), b.rng.uniform(0.12, 0.25), b.rng.uniform(0.5, 1.1)
    levels = int(b.rng.integers(2, 5))
    c, s = np.cos(yaw), np.sin(yaw)
    for side in (-1, 1):
        b.add(
            BOX,
            np.array([centre[0] + side * c * w, centre[1] + side * s * w, h]),
            np.array([0.015, d, h]),
            yaw,
        )
    for k in range(levels + 1):
        z = 2 * h * k / levels
        b.add(BOX, np.array([centre[0], centre[1], z]), np.array([w, d, 0.012]), yaw)
        if k < levels:
            for _ in range(int(b.rng.integers(0, 4))):
                x = b.rng.uniform(-0.8, 0.8) * w
                half = np.array(
                    [
                        b.rng.uniform(0.02, 0.15),
                        d * b.rng.uniform(0.3, 0.9),
                        h / levels * b.rng.uniform(0.3, 0.9),
                    ]
                )
                b.add(BOX, np.array([centre[0] + c * x, centre[1] + s * x, z + half[2]]), half, yaw)


def furnish(b: Builder, lo: Vec, hi: Vec, count: int) -> None:
    """Furniture over the floor area between lo and hi."""
    for _ in range(count):
        at = np.array([*b.rng.uniform(lo[:2], hi[:2]), 0.0])
        yaw = float(b.rng.choice([0, np.pi / 2, b.rng.uniform(0, np.pi)]))
        what = b.rng.random()
        if what < 0.3:
            _table(b, at, yaw)
        elif what < 0.45:
            _shelf(b, at, yaw)
        elif what < 0.8:
            half = np.exp(b.rng.uniform(np.log(0.12), np.log(0.7), 3))
            b.add(BOX, at + [0, 0, half[2]], half, yaw)
            _clutter(b, at, half[:2] * 0.7, 2 * half[2], int(b.rng.integers(0, 4)), (0.03, 0.15))
        else:
            kind = int(b.rng.choice([ELLIPSOID, CYLINDER]))
            half = np.exp(b.rng.uniform(np.log(0.1), np.log(0.5), 3))
            half[1] = half[0]
            b.add(kind, at + [0, 0, half[2]], half, yaw, float(b.rng.normal(0, 0.3)))


def room(b: Builder) -> tuple[Vec, Vec, Light]:
    """A furnished room, seen from standing height. Returns camera, target and light."""
    half = np.array([b.rng.uniform(1.3, 4.0), b.rng.uniform(1.3, 4.0), b.rng.uniform(1.1, 1.6)])
    b.add(ROOM, np.array([0, 0, half[2]]), half)
    furnish(b, -half * 0.95, half * 0.95, int(b.rng.integers(4, 11)))
    for _ in range(int(b.rng.integers(0, 6))):
        axis, side = int(b.rng.integers(0, 2)), b.rng.choice([-1, 1])
        at = b.rng.uniform(-0.8, 0.8, 3) * half + [0, 0, half[2]]
        at[axis] = side * half[axis]
        size = b.rng.uniform(0.1, 0.7, 3)
        size[axis] = b.rng.uniform(0.005, 0.08)
        b.add(BOX, at, size)
    eye = np.array([*(b.rng.uniform(-0.8, 0.8, 2) * half[:2]), b.rng.uniform(0.5, 1.9)])
    target = np.array([*(b.rng.uniform(-0.95, 0.95, 2) * half[:2]), b.rng.uniform(0.0, 1.6)])
    lights = np.stack([b.rng.uniform(-0.8, 0.8, 3) * half + [0, 0, 1.2 * half[2]] for _ in range(2)])
    return eye, target, Light(lights, b.rng.uniform(0.3, 0.8), np.zeros(3))


def desk(b: Builder) -> tuple[Vec, Vec, Light]:
    """Close look at things on a surface before a wall, from a hand's distance."""
    b.add(BOX, np.array([0, 0, -0.03]), np.array([b.rng.uniform(0.5, 1.2), b.rng.uniform(0.4, 0.8), 0.03]))
    b.add(BOX, np.array([0, 0, -0.9]), np.array([6, 6, 0.1]))
    yaw = b.rng.normal(0, 0.3)
    b.add(BOX, np.array([0, b.rng.uniform(0.5, 2.5), 0.0]), np.array([5, 0.05, 4]), yaw)
    _clutter(b, np.zeros(2), np.array([0.5, 0.35]), 0.0, int(b.rng.integers(5, 18)), (0.02, 0.18))
    eye = np.array([b.rng.uniform(-0.5, 0.5), b.rng.uniform(-1.4, -0.6), b.rng.uniform(0.2, 0.9)])
    target = np.array([*b.rng.uniform(-0.2, 0.2, 2), b.rng.uniform(0, 0.2)])
    lights = np.stack([np.array([*b.rng.uniform(-1.5, 1.5, 2), b.rng.uniform(0.8, 2)]) for _ in range(2)])
    return eye, target, Light(lights, b.rng.uniform(0.3, 0.8), b.rng.uniform(0.2, 0.9, 3))


def facade(b: Builder) -> tuple[Vec, Vec, Light]:
    """A wall with windows, ledges, columns and reliefs above a street, open sky behind."""
    wide, high = b.rng.uniform(3, 9), b.rng.uniform(3, 8)
    b.add(BOX, np.array([0, 0.5, high]), np.array([wide, 0.5, high]), b.rng.normal(0, 0.1))
    b.add(BOX, np.array([0, 0, -0.5]), np.array([60, 60, 0.5]))
    nx, nz = int(b.rng.integers(2, 6)), int(b.rng.integers(1, 4))
    depth, w, h = (
        b.rng.uniform(0.03, 0.4),
        wide / nx * b.rng.uniform(0.3, 0.8),
        high / nz * b.rng.uniform(0.2, 0.45),
    )
    kind = int(b.rng.choice([BOX, BOX, CYLINDER, ELLIPSOID]))
    for i in range(nx):
        for k in range(nz):
            at = np.array([(2 * i + 1 - nx) * wide / nx, -0.02, (2 * k + 1) * high / nz])
            b.add(kind, at, np.array([w, depth, h]) if kind != CYLINDER else np.array([depth, depth, h]))
    for _ in range(int(b.rng.integers(1, 5))):
        b.add(
            BOX,
            np.array([0, 0, b.rng.uniform(0, 2 * high)]),
            np.array([wide, b.rng.uniform(0.05, 0.35), b.rng.uniform(0.03, 0.2)]),
        )
    _clutter(b, np.array([0, -2.0]), np.array([wide, 1.5]), 0.0, int(b.rng.integers(0, 8)), (0.1, 0.9))
    eye = np.array([b.rng.uniform(-0.6, 0.6) * wide, -b.rng.uniform(3, 11), b.rng.uniform(1, 3)])
    target = np.array([b.rng.uniform(-0.5, 0.5) * wide, 0, b.rng.uniform(0.5, 1.2 * high)])
    lights = np.stack(
        [
            np.array([*b.rng.uniform(-30, 30, 1), -b.rng.uniform(5, 40), b.rng.uniform(5, 40)])
            for _ in range(2)
        ]
    )
    return eye, target, Light(lights, b.rng.uniform(0.3, 0.8), b.rng.uniform(0.5, 1.0, 3))


def thing(b: Builder) -> tuple[Vec, Vec, Light]:
    """One compound object on the ground, walked around, with things far behind it."""
    b.add(BOX, np.array([0, 0, -0.5]), np.array([30, 30, 0.5]))
    for _ in range(int(b.rng.integers(4, 14))):
        half = np.exp(b.rng.uniform(np.log(0.08), np.log(0.6), 3))
        kind = int(b.rng.choice([BOX, ELLIPSOID, CYLINDER]))
        if kind == CYLINDER:
            half[1] = half[0]
        at = np.array([*b.rng.normal(0, 0.45, 2), abs(b.rng.normal(0, 0.6))])
        b.add(kind, at, half, b.rng.uniform(0, np.pi), b.rng.normal(0, 0.5))
    for _ in range(int(b.rng.integers(2, 9))):
        turn, far = b.rng.uniform(0, 2 * np.pi), b.rng.uniform(3, 14)
        half = b.rng.uniform(0.3, 2.5, 3)
        b.add(BOX, np.array([far * np.cos(turn), far * np.sin(turn), half[2]]), half, b.rng.uniform(0, np.pi))
    turn, far = b.rng.uniform(0, 2 * np.pi), b.rng.uniform(1.6, 3.5)
    eye = np.array([far * np.cos(turn), far * np.sin(turn), b.rng.uniform(0.3, 2.0)])
    lights = np.stack([np.array([*b.rng.uniform(-8, 8, 2), b.rng.uniform(3, 12)]) for _ in range(2)])
    light = Light(lights, b.rng.uniform(0.3, 0.8), b.rng.uniform(0.4, 1.0, 3))
    return eye, np.array([0, 0, b.rng.uniform(0.1, 0.7)]), light
