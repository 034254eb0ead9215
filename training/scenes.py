"""Random scenes and camera paths: rooms, desks, façades and objects, for training, tests and the demo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from training import textures
from training.raytrace import BOX, CYLINDER, ELLIPSOID, ROOM, Floats, Scene, mipmaps, render

Rng = np.random.Generator
Vec = NDArray[np.float64]


@dataclass(frozen=True)
class Sample:
    """V views of one scene.

    Attributes:
        images: (V, H, W, 3) uint8, gamma-encoded.
        depth: (V, H, W) float32 camera z of the pixel centres, 0 for sky.
        K: (V, 3, 3) float32.
        cam_from_world: (V, 4, 4) float32.
    """

    images: NDArray[np.uint8]
    depth: Floats
    K: Floats
    cam_from_world: Floats


@dataclass
class Builder:
    """Collects primitives; z is up in the world.

    Attributes:
        rng: source of all randomness.
        textures: number of textures; the first ``plain`` of them are nearly uniform.
        plain: see above.
        plainness: probability that a primitive gets a plain texture.
        parts: what was added so far.
    """

    rng: Rng
    textures: int
    plain: int
    plainness: float = 0.1
    parts: list[tuple[int, NDArray[np.float64], Vec, Vec, NDArray[np.int32], float, Vec, float]] = field(
        default_factory=list
    )

    def add(self, kind: int, centre: Vec, half: Vec, yaw: float = 0.0, tilt: float = 0.0) -> None:
        """Place a primitive with a random material, turned by yaw about z, then tilted about its x."""
        c, s, ct, st = np.cos(yaw), np.sin(yaw), np.cos(tilt), np.sin(tilt)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        tip = np.array([[1, 0, 0], [0, ct, st], [0, -st, ct]])
        plain = self.rng.random(6) < self.plainness
        low, high = np.where(plain, 0, self.plain), np.where(plain, self.plain, self.textures)
        faces = self.rng.integers(low, high).astype(np.int32)
        if self.rng.random() < 0.6:
            faces[:] = faces[0]
        texel = float(np.exp(self.rng.uniform(np.log(0.3), np.log(3.0)))) / max(
            0.15, min(1.5, float(half.max()))
        )
        tint = self.rng.uniform(0.5, 1.0) * np.clip(self.rng.normal(1, 0.12, 3), 0.4, 1.4)
        gloss = float(self.rng.uniform(0.05, 0.5)) if self.rng.random() < 0.2 else 0.0
        self.parts.append(
            (kind, tip @ turn, np.asarray(centre, float), np.asarray(half, float), faces, texel, tint, gloss)
        )

    def scene(self, lights: Vec, ambient: float, sky: Vec) -> Scene:
        """The finished scene."""
        kind, rotation, centre, half, texture, texel, tint, gloss = zip(*self.parts, strict=True)
        f = np.float32
        return Scene(
            np.array(kind, np.int32), np.array(rotation, f), np.array(centre, f), np.array(half, f),
            np.array(texture, np.int32), np.array(texel, f), np.array(tint, f), np.array(gloss, f),
            lights.astype(f), float(ambient), sky.astype(f), bank(),
        )  # fmt: skip


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


def _furnish(b: Builder, lo: Vec, hi: Vec, count: int) -> None:
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


def room(b: Builder) -> tuple[Vec, Vec, Vec, Vec, float]:
    """A furnished room, seen from standing height. Returns camera, target, lights, sky and ambient."""
    half = np.array([b.rng.uniform(1.3, 4.0), b.rng.uniform(1.3, 4.0), b.rng.uniform(1.1, 1.6)])
    b.add(ROOM, np.array([0, 0, half[2]]), half)
    _furnish(b, -half * 0.95, half * 0.95, int(b.rng.integers(4, 11)))
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
    return eye, target, lights, np.zeros(3), b.rng.uniform(0.3, 0.8)


def desk(b: Builder) -> tuple[Vec, Vec, Vec, Vec, float]:
    """Close look at things on a surface before a wall, from a hand's distance."""
    b.add(BOX, np.array([0, 0, -0.03]), np.array([b.rng.uniform(0.5, 1.2), b.rng.uniform(0.4, 0.8), 0.03]))
    b.add(BOX, np.array([0, 0, -0.9]), np.array([6, 6, 0.1]))
    yaw = b.rng.normal(0, 0.3)
    b.add(BOX, np.array([0, b.rng.uniform(0.5, 2.5), 0.0]), np.array([5, 0.05, 4]), yaw)
    _clutter(b, np.zeros(2), np.array([0.5, 0.35]), 0.0, int(b.rng.integers(5, 18)), (0.02, 0.18))
    eye = np.array([b.rng.uniform(-0.5, 0.5), b.rng.uniform(-1.4, -0.6), b.rng.uniform(0.2, 0.9)])
    target = np.array([*b.rng.uniform(-0.2, 0.2, 2), b.rng.uniform(0, 0.2)])
    lights = np.stack([np.array([*b.rng.uniform(-1.5, 1.5, 2), b.rng.uniform(0.8, 2)]) for _ in range(2)])
    return eye, target, lights, b.rng.uniform(0.2, 0.9, 3), b.rng.uniform(0.3, 0.8)


def facade(b: Builder) -> tuple[Vec, Vec, Vec, Vec, float]:
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
    return eye, target, lights, b.rng.uniform(0.5, 1.0, 3), b.rng.uniform(0.3, 0.8)


def thing(b: Builder) -> tuple[Vec, Vec, Vec, Vec, float]:
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
    return (
        eye,
        np.array([0, 0, b.rng.uniform(0.1, 0.7)]),
        lights,
        b.rng.uniform(0.4, 1.0, 3),
        b.rng.uniform(0.3, 0.8),
    )


KINDS: dict[str, Callable[[Builder], tuple[Vec, Vec, Vec, Vec, float]]] = {
    "room": room,
    "desk": desk,
    "facade": facade,
    "thing": thing,
}


PLAIN, TEXTURED = 60, 260


@cache
def bank() -> NDArray[np.uint8]:
    """The textures of all scenes, plain ones first; some seconds at the first call of a process."""
    rng = np.random.default_rng(11)
    plain = np.stack([textures.plain(rng, 256) for _ in range(PLAIN)])
    return mipmaps(np.concatenate([plain, textures.atlas(rng, TEXTURED)]))


def look_at(eye: Vec, target: Vec, roll: float = 0.0) -> Vec:
    """world_from_cam (4, 4) of a camera at ``eye`` that looks at ``target``, upright but for ``roll``."""
    z = target - eye
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1.0])
    x = x / (np.linalg.norm(x) + 1e-9)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    pose = np.eye(4)
    pose[:3] = np.stack([c * x + s * y, -s * x + c * y, z, eye], -1)
    return pose


def path(rng: Rng, eye: Vec, target: Vec, views: int, distance: float) -> list[Vec]:
    """Poses of a hand-held walk: baselines of 2 to 40 % of the distance, mostly sideways."""
    base = look_at(eye, target)
    poses = [look_at(eye, target, rng.normal(0, 0.08))]
    reach = distance * np.exp(rng.uniform(np.log(0.06), np.log(0.45)))
    turn = rng.uniform(0, 2 * np.pi)
    for _ in range(1, views):
        a = turn + rng.choice([0, np.pi]) + rng.normal(0, 0.6)
        size = reach * rng.uniform(0.15, 1.0)
        offset = size * np.array([np.cos(a), 0.6 * np.sin(a), 0.35 * rng.normal()])
        moved = eye + base[:3, :3] @ offset
        aim = target + base[:3, :3] @ (offset * rng.uniform(0, 0.9) + rng.normal(0, 0.04, 3) * distance)
        poses.append(look_at(moved, aim, rng.normal(0, 0.08)))
    return poses


def encode(linear: Floats, rng: Rng) -> NDArray[np.uint8]:
    """Gamma-encoded 8-bit colour with the exposure that the brightest fifth asks for."""
    gain = rng.uniform(0.6, 1.05) / (np.quantile(linear, 0.9) + 1e-3)
    return (255 * np.clip(linear * min(gain, 3.0), 0, 1) ** (1 / rng.uniform(1.4, 2.4)) + 0.5).astype(
        np.uint8
    )


def generate(
    seed: int, views: int = 6, shape: tuple[int, int] = (144, 192), kind: str | None = None
) -> Sample:
    """Render one random scene; the same seed gives the same sample.

    Views in which something is closer than a twentieth of the median depth, or that show nothing
    over more than half of the picture, are drawn again with another camera.
    """
    rng = np.random.default_rng(seed)
    name = kind or str(rng.choice(list(KINDS), p=[0.55, 0.15, 0.15, 0.15]))
    while True:
        builder = Builder(rng, PLAIN + TEXTURED, PLAIN, float(rng.choice([0.05, 0.3, 0.6])))
        eye, target, lights, sky, ambient = KINDS[name](builder)
        scene = builder.scene(lights, ambient, sky)
        h, w = shape
        focal = w / (2 * np.tan(np.deg2rad(rng.uniform(42, 80)) / 2))
        K = np.array([[focal, 0, w / 2], [0, focal * rng.uniform(0.98, 1.02), h / 2], [0, 0, 1]], np.float32)
        quarter = K / np.array([[4], [4], [1]], np.float32)
        _, probe = render(scene, quarter, look_at(eye, target).astype(np.float32), (h // 4, w // 4), 1)
        seen = probe[probe > 0]
        if seen.size < 0.5 * probe.size or seen.min() < 0.05 * np.median(seen):
            continue
        poses = path(rng, eye, target, views, float(np.median(seen)))
        pairs = [render(scene, K, p.astype(np.float32), shape) for p in poses]
        depth = np.stack([d for _, d in pairs])
        lowest = min((float(d[d > 0].min()) if (d > 0).any() else 0.0) for d in depth)
        if (depth > 0).mean(axis=(1, 2)).min() < 0.5 or lowest < 0.03 * np.median(seen):
            continue
        images = encode(np.stack([c for c, _ in pairs]), rng)
        cams = np.stack([np.linalg.inv(p) for p in poses]).astype(np.float32)
        return Sample(images, depth, np.stack([K] * views), cams)


def walk(seed: int, views: int, shape: tuple[int, int]) -> Sample:
    """A slow walk through a furnished, mostly textured room, which COLMAP can map; for demo and tests."""
    rng = np.random.default_rng(seed)
    builder = Builder(rng, PLAIN + TEXTURED, PLAIN, 0.1)
    half = np.array([2.4, 2.0, 1.3])
    builder.add(ROOM, np.array([0, 0, half[2]]), half)
    _furnish(builder, np.array([-2.0, 0.2, 0]), np.array([2.0, 1.8, 0]), 7)
    lights = np.array([[0.5, -1.0, 2.3], [-1.5, 0.5, 2.0]])
    scene = builder.scene(lights, 0.5, np.zeros(3))
    h, w = shape
    K = np.array([[0.85 * w, 0, w / 2], [0, 0.85 * w, h / 2], [0, 0, 1]], np.float32)
    poses = []
    for t in np.linspace(-1, 1, views):
        eye = np.array([0.75 * t, -1.6 + 0.15 * t * t, 1.35 + 0.1 * np.sin(5 * t)])
        poses.append(look_at(eye, np.array([0.35 * t, 1.4, 0.75])))
    pairs = [render(scene, K, p.astype(np.float32), shape) for p in poses]
    images = encode(np.stack([c for c, _ in pairs]), rng)
    cams = np.stack([np.linalg.inv(p) for p in poses]).astype(np.float32)
    return Sample(images, np.stack([d for _, d in pairs]), np.stack([K] * views), cams)
