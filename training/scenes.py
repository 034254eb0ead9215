"""Random scenes seen along random paths, for training, tests and the demo."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from training.builder import Builder, Light, Rng, Vec
from training.outdoors import building, monument
from training.paths import PATHS, look_at, path
from training.raytrace import ROOM, Floats, Scene, render
from training.rooms import furnished, tabletop
from training.simple import desk, facade, furnish, room, thing

__all__ = ["KINDS", "Sample", "encode", "exposed", "generate", "look_at", "path", "walk"]


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


KINDS: dict[str, tuple[Callable[[Builder], tuple[Vec, Vec, Light]], float]] = {
    "furnished": (furnished, 0.46),
    "tabletop": (tabletop, 0.14),
    "building": (building, 0.14),
    "monument": (monument, 0.08),
    "room": (room, 0.09),
    "desk": (desk, 0.03),
    "facade": (facade, 0.03),
    "thing": (thing, 0.03),
}
"""Scenes by name, and how often they are drawn."""


def encode(linear: Floats, rng: Rng) -> NDArray[np.uint8]:
    """Gamma-encoded 8-bit colour with the exposure that the brightest fifth asks for."""
    gain = rng.uniform(0.6, 1.05) / (np.quantile(linear, 0.9) + 1e-3)
    return (255 * np.clip(linear * min(gain, 3.0), 0, 1) ** (1 / rng.uniform(1.4, 2.4)) + 0.5).astype(
        np.uint8
    )


def exposed(linear: Floats, seen: NDArray[np.bool_], rng: Rng) -> NDArray[np.uint8]:
    """Gamma-encoded 8-bit colour, exposed for most of what is ``seen``: windows and sun may clip."""
    bright = np.quantile(
        linear[seen].mean(-1), rng.choice([rng.uniform(0.4, 0.75), rng.uniform(0.75, 0.99)], p=[0.2, 0.8])
    )
    gain = rng.uniform(0.3, 0.9) / (bright + 1e-3)
    x = np.clip(linear * gain, 0, None)
    knee = rng.uniform(0.6, 1.0)  # above it, film and sensors give less and less
    x = np.where(x > knee, knee + (1 - knee) * np.tanh((x - knee) / (1 - knee + 1e-3)), x)
    return (255 * np.clip(x, 0, 1) ** (1 / rng.uniform(1.6, 2.4)) + 0.5).astype(np.uint8)


def _fits(depth: Floats, least: float) -> bool:
    """Whether views (..., H, W) show something over half of each picture, and nothing that is too near."""
    share = (depth > 0).mean((-2, -1))
    return bool((share >= 0.5).all()) and float(depth[depth > 0].min()) >= least


def _camera(rng: Rng, shape: tuple[int, int]) -> Floats:
    """Intrinsics (3, 3) of a lens between 42 and 80 degrees."""
    h, w = shape
    focal = w / (2 * np.tan(np.deg2rad(rng.uniform(42, 80)) / 2))
    return np.array([[focal, 0, w / 2], [0, focal * rng.uniform(0.98, 1.02), h / 2], [0, 0, 1]], np.float32)


def _probed(scene: Scene, K: Floats, pose: Vec, shape: tuple[int, int]) -> tuple[Floats, float]:
    """Depth at an eighth of the size, to judge a view by, and the share of it that differs from beside it."""
    small = K / np.array([[8], [8], [1]], np.float32)
    color, depth = render(scene, small, pose.astype(np.float32), (shape[0] // 8, shape[1] // 8), 1)
    grey = np.sqrt(np.clip(color.mean(-1) / (np.quantile(color, 0.9) + 1e-3), 0, 1))
    change = np.maximum(np.abs(np.diff(grey, axis=0))[:, 1:], np.abs(np.diff(grey, axis=1))[1:])
    return depth, float((change > 0.06).mean())


def generate(
    seed: int, views: int = 6, shape: tuple[int, int] = (192, 256), kind: str | None = None
) -> Sample:
    """Render one random scene; the same seed gives the same sample.

    Views in which something is closer than a twentieth of the median depth, or that show nothing
    over more than half of the picture, are drawn again with another scene, as is one that is all plain.
    """
    rng = np.random.default_rng(seed)
    weights = np.array([weight for _, weight in KINDS.values()])
    name = kind or str(rng.choice(list(KINDS), p=weights / weights.sum()))
    simple = name in ("room", "desk", "facade", "thing")
    while True:
        builder = Builder(rng, plainness=float(rng.choice([0.05, 0.3, 0.6] if simple else [0.3, 0.7, 0.9])))
        eye, target, light = KINDS[name][0](builder)
        scene, K = builder.scene(light), _camera(rng, shape)
        probe, varied = _probed(scene, K, look_at(eye, target), shape)
        if not (probe > 0).any() or varied < 0.1:
            continue
        middle = float(np.median(probe[probe > 0]))
        if not _fits(probe, 0.06 * middle):
            continue
        chosen = rng.choice(len(PATHS), p=[p for _, p in PATHS])
        poses = PATHS[chosen][0](rng, eye, target, views, middle)
        if not all(_fits(_probed(scene, K, p, shape)[0], 0.04 * middle) for p in poses):
            continue
        pairs = [render(scene, K, p.astype(np.float32), shape, 2, 3) for p in poses]
        depth = np.stack([d for _, d in pairs])
        if not _fits(depth, 0.03 * middle):
            continue
        linear = np.stack([c for c, _ in pairs])
        images = encode(linear, rng) if simple else exposed(linear, depth > 0, rng)
        cams = np.stack([np.linalg.inv(p) for p in poses]).astype(np.float32)
        return Sample(images, depth, np.stack([K] * views), cams)


def walk(seed: int, views: int, shape: tuple[int, int]) -> Sample:
    """A slow walk through a furnished, mostly textured room, which COLMAP can map; for demo and tests."""
    rng = np.random.default_rng(seed)
    builder = Builder(rng)
    half = np.array([2.4, 2.0, 1.3])
    builder.add(ROOM, np.array([0, 0, half[2]]), half)
    furnish(builder, np.array([-2.0, 0.2, 0]), np.array([2.0, 1.8, 0]), 7)
    lights = np.array([[0.5, -1.0, 2.3], [-1.5, 0.5, 2.0]])
    scene = builder.scene(Light(lights, 0.5, np.zeros(3)), leaning=True)
    h, w = shape
    K = np.array([[0.85 * w, 0, w / 2], [0, 0.85 * w, h / 2], [0, 0, 1]], np.float32)
    poses = []
    for t in np.linspace(-1, 1, views):
        eye = np.array([0.75 * t, -1.6 + 0.15 * t * t, 1.35 + 0.1 * np.sin(5 * t)])
        poses.append(look_at(eye, np.array([0.35 * t, 1.4, 0.75])))
    with ThreadPoolExecutor() as pool:
        pairs = list(pool.map(lambda p: render(scene, K, p.astype(np.float32), shape), poses))
    images = encode(np.stack([c for c, _ in pairs]), rng)
    cams = np.stack([np.linalg.inv(p) for p in poses]).astype(np.float32)
    return Sample(images, np.stack([d for _, d in pairs]), np.stack([K] * views), cams)
