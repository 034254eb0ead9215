"""Procedural textures, wrapped and square, so that no picture need be shipped."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Floats = NDArray[np.float32]


def _noise(rng: np.random.Generator, size: int, slope: float) -> Floats:
    """Wrapped random field with spectrum 1 / f^slope, mean 0, deviation 1."""
    f = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]) + 1 / size
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) / f**slope
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum, (size, size))
    return (field / field.std()).astype(np.float32)


def _palette(rng: np.random.Generator, field: Floats) -> Floats:
    """Colours along a random walk through RGB, indexed by the ranks of ``field``."""
    stops = rng.uniform(0.03, 0.97, (rng.integers(2, 6), 3))
    if rng.random() < 0.5:
        grey = stops.mean(1, keepdims=True)
        stops = grey + rng.uniform(0, 0.5) * (stops - grey)
    t = np.clip(
        (field - np.quantile(field, 0.01)) / (np.quantile(field, 0.99) - np.quantile(field, 0.01) + 1e-6),
        0,
        1,
    )
    at = np.linspace(0, 1, len(stops))
    return np.stack([np.interp(t, at, stops[:, c]) for c in range(3)], -1).astype(np.float32)


def clouds(rng: np.random.Generator, size: int) -> Floats:
    """Coloured fractal noise, from fine grain to broad stains."""
    return _palette(rng, _noise(rng, size, rng.uniform(0.4, 2.0)))


def plain(rng: np.random.Generator, size: int) -> Floats:
    """Painted wall: one colour with faint grain and stains; often none."""
    base = rng.uniform(0.15, 0.95) * np.ones(3) + rng.normal(0, 0.06, 3)
    amount = rng.choice([0.0, 0.004, 0.015, 0.04])
    return np.clip(base + amount * _noise(rng, size, rng.uniform(0, 1.8))[..., None], 0, 1).astype(np.float32)


def tiles(rng: np.random.Generator, size: int) -> Floats:
    """Bricks, tiles, planks or stripes with joints, each with its own shade."""
    rows, cols = int(rng.choice([1, 2, 4, 8, 16])), int(rng.choice([1, 2, 4, 8, 16]))
    y, x = np.mgrid[0:size, 0:size] / size
    shift = 0.5 * (np.floor(y * rows) % 2) if rng.random() < 0.5 else 0.0
    u, v = (x * cols + shift) % cols, y * rows
    shade = rng.normal(0, rng.uniform(0, 0.2), (rows, cols))[np.floor(v).astype(int), np.floor(u).astype(int)]
    joint = rng.uniform(0.01, 0.08)
    gap = (np.minimum(u % 1, 1 - u % 1) < joint * cols / 8) | (
        np.minimum(v % 1, 1 - v % 1) < joint * rows / 8
    )
    image = clouds(rng, size) * 0.4 + rng.uniform(0.1, 0.6, 3) + shade[..., None]
    image[gap] = rng.uniform(0.05, 0.9)
    return np.clip(image, 0, 1).astype(np.float32)


def shapes(rng: np.random.Generator, size: int) -> Floats:
    """Overlapping discs, bars and blocks of any colour: posters, book spines, clutter."""
    image = np.ones((size, size, 3)) * rng.uniform(0.1, 0.9, 3)
    y, x = np.mgrid[0:size, 0:size]
    for _ in range(int(rng.integers(8, 70))):
        cx, cy = rng.uniform(0, size, 2)
        dx, dy = (x - cx + size / 2) % size - size / 2, (y - cy + size / 2) % size - size / 2
        a = rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)])
        u, v = np.cos(a) * dx + np.sin(a) * dy, -np.sin(a) * dx + np.cos(a) * dy
        w, h = size * np.exp(rng.uniform(np.log(0.01), np.log(0.3), 2))
        inside = (u / w) ** 2 + (v / h) ** 2 < 1 if rng.random() < 0.4 else (abs(u) < w) & (abs(v) < h)
        image[inside] = rng.uniform(0, 1, 3)
    return (
        (image * (1 + rng.uniform(0, 0.1) * _noise(rng, size, 1.0)[..., None])).clip(0, 1).astype(np.float32)
    )


def writing(rng: np.random.Generator, size: int) -> Floats:
    """Lines of letter-like strokes on paper."""
    image = np.ones((size, size), np.float32)
    pitch = int(rng.choice([8, 12, 16, 24]))
    for y0 in range(2, size - pitch, pitch):
        x = 2
        while x < size - pitch:
            step = int(rng.integers(pitch // 3, pitch))
            if rng.random() < 0.8:
                glyph = rng.random((pitch * 2 // 3, step)) < 0.45
                image[y0 : y0 + glyph.shape[0], x : x + step][glyph] = 0
            x += step + 1
    image = gaussian_filter(image, 0.7, mode="wrap")
    paper, ink = rng.uniform(0.5, 1, 3), rng.uniform(0, 0.5, 3)
    return (image[..., None] * paper + (1 - image[..., None]) * ink).astype(np.float32)


MAKERS = (clouds, plain, tiles, shapes, writing)


def atlas(rng: np.random.Generator, count: int, size: int = 256) -> Floats:
    """(count, size, size, 3) textures of all kinds, in linear RGB within [0, 1]."""
    makers = rng.choice(len(MAKERS), count, p=[0.4, 0.05, 0.2, 0.25, 0.1])
    return np.stack([MAKERS[m](rng, size) for m in makers])
