"""Puts scenes together from primitives; z is up in the world, lengths are about metres."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from training.materials import PLAIN, SIZE, TEXTURED, Material, bank, mixed
from training.raytrace import BOX, CYLINDER, ELLIPSOID, Scene

Rng = np.random.Generator
Vec = NDArray[np.float64]


@dataclass(frozen=True)
class Light:
    """What lights a scene; see :class:`training.raytrace.Scene` for the fields."""

    lights: Vec
    ambient: float
    sky: Vec
    power: Vec | None = None
    shadows: int = 1
    softness: float = 0.0
    lean: Vec | None = None
    clouds: int = -1


@dataclass(frozen=True)
class Part:
    """A primitive and what it is made of."""

    kind: int
    rotation: Vec
    centre: Vec
    half: Vec
    faces: NDArray[np.int32]
    material: Material
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass
class Builder:
    """Collects primitives.

    Attributes:
        rng: source of all randomness.
        textures: number of textures that :meth:`add` uses; the first ``plain`` of them are nearly uniform.
        plain: see above.
        plainness: probability that a primitive gets a plain texture.
        parts: what was added so far.
    """

    rng: Rng
    textures: int = PLAIN + TEXTURED
    plain: int = PLAIN
    plainness: float = 0.1
    parts: list[Part] = field(default_factory=list)

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
        material = Material(int(faces[0]), texel, tuple(tint), gloss)
        half = np.asarray(half, float)
        self.parts.append(Part(kind, tip @ turn, np.asarray(centre, float), half, faces, material))

    def scene(self, light: Light, leaning: bool = False) -> Scene:
        """The finished scene; ``leaning`` as the demo's pictures were made, with slightly skewed textures."""
        f, p, m = np.float32, self.parts, [part.material for part in self.parts]
        late = max(int(part.faces.max()) for part in p) >= PLAIN + TEXTURED or any(a.detail[1] for a in m)
        named = late or light.clouds >= 0
        return Scene(
            np.array([a.kind for a in p], np.int32), np.array([a.rotation for a in p], f),
            np.array([a.centre for a in p], f), np.array([a.half for a in p], f),
            np.array([a.faces for a in p], np.int32), np.array([a.texel for a in m], f),
            np.array([a.tint for a in m], f), np.array([a.gloss for a in m], f),
            light.lights.astype(f), float(light.ambient), light.sky.astype(f), bank() if named else mixed(),
            None if light.power is None else light.power.astype(f), light.shadows, float(light.softness),
            None if light.lean is None else light.lean.astype(f), np.array([a.detail for a in m], f),
            np.array([a.glow for a in m], f), np.array([a.mirror for a in m], f),
            np.array([a.offset for a in p], f), light.clouds, not leaning, SIZE - 1 if leaning else SIZE,
        )  # fmt: skip


def spin(yaw: float) -> Vec:
    """world_from_object (3, 3) of a turn about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


class Place:
    """A spot in the world, with its own axes, in which a piece of furniture is put together."""

    def __init__(self, builder: Builder, at: Vec | tuple[float, ...], yaw: float = 0.0) -> None:
        self.builder, self.at, self.turn = builder, np.asarray(at, float), spin(yaw)
        self.rng, self.plainness = builder.rng, builder.plainness

    def inner(self, at: tuple[float, float, float], yaw: float = 0.0) -> Place:
        """A place at a position and turn within this one."""
        new = Place(self.builder, self.at + self.turn @ np.asarray(at, float))
        new.turn = self.turn @ spin(yaw)
        return new

    def put(
        self,
        kind: int,
        centre: tuple[float, ...],
        half: tuple[float, ...],
        m: Material,
        turn: Vec | None = None,
    ) -> None:
        """A primitive, turned by world_from_object ``turn`` within the place."""
        world = self.turn if turn is None else self.turn @ turn
        size = np.maximum(np.asarray(half, float), 1e-3)
        offset = (centre[0] + self.at[0], centre[2])
        if m.fit:
            wide = float(np.sort(size)[-1])
            m = Material(m.texture, 0.5 / wide, m.tint, m.gloss, m.detail, m.glow, m.mirror)
            offset = (wide, wide)
        at = self.at + self.turn @ np.asarray(centre, float)
        faces = np.full(6, m.texture, np.int32)
        self.builder.parts.append(Part(kind, world.T, at, size, faces, m, offset))

    def box(self, low: tuple[float, ...], high: tuple[float, ...], m: Material, yaw: float = 0.0) -> None:
        """A box between two corners, turned by yaw about its middle."""
        a, b = np.asarray(low, float), np.asarray(high, float)
        self.put(BOX, tuple((a + b) / 2), tuple(np.abs(b - a) / 2), m, spin(yaw) if yaw else None)

    def rod(self, start: tuple[float, ...], end: tuple[float, ...], radius: float, m: Material) -> None:
        """A round bar from one point to another."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        z = (b - a) / (np.linalg.norm(b - a) + 1e-9)
        x = np.cross(z, [0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0])
        x /= np.linalg.norm(x)
        turn = np.stack([x, np.cross(z, x), z], -1)
        self.put(CYLINDER, tuple((a + b) / 2), (radius, radius, float(np.linalg.norm(b - a)) / 2), m, turn)

    def tube(self, points: list[tuple[float, ...]], radius: float, m: Material) -> None:
        """A bent round bar through points."""
        for a, b in pairwise(points):
            self.rod(a, b, radius, m)

    def ball(self, centre: tuple[float, ...], half: tuple[float, ...], m: Material) -> None:
        """An ellipsoid."""
        self.put(ELLIPSOID, centre, half, m)

    def drum(self, centre: tuple[float, ...], radius: float, height: float, m: Material) -> None:
        """A standing cylinder of half height ``height``."""
        self.put(CYLINDER, centre, (radius, radius, height), m)
