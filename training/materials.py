"""Textures of particular stuffs, and how surfaces made of them look."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from training import textures
from training.raytrace import Floats, mipmaps

Rng = np.random.Generator
Vec = NDArray[np.float64]
SIZE = 256


def _stretched(rng: Rng, slope: float, ratio: float) -> Floats:
    """Wrapped random field with spectrum 1 / f^slope whose grain is ``ratio`` times longer along y."""
    fy, fx = np.fft.fftfreq(SIZE)[:, None] * ratio, np.fft.rfftfreq(SIZE)[None]
    f = np.hypot(fy, fx) + 1 / SIZE
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) / f**slope
    spectrum[0, 0] = 0
    field = np.fft.irfft2(spectrum, (SIZE, SIZE))
    return (field / field.std()).astype(np.float32)


def _between(low: Vec, high: Vec, share: Floats) -> Floats:
    """Colours from ``low`` to ``high`` (3,) by ``share`` (H, W)."""
    return (low + np.clip(share, 0, 1)[..., None] * (high - low)).clip(0, 1).astype(np.float32)


def _color(rng: Rng, low: float, high: float, spread: float) -> Vec:
    """A random colour of some brightness and saturation."""
    return np.clip(rng.uniform(low, high) * (1 + rng.normal(0, spread, 3)), 0.01, 1)


def white(rng: Rng) -> Floats:
    """Nothing at all: the tint and the detail make the picture."""
    return np.ones((SIZE, SIZE, 3), np.float32)


def grain(rng: Rng) -> Floats:
    """Grey field about one half: plaster, fabric, brush strokes or wood, to scale another texture with."""
    what = rng.random()
    if what < 0.5:
        field = _stretched(rng, rng.uniform(0, 1.8), 1.0)
    elif what < 0.75:
        field = _stretched(rng, rng.uniform(0.3, 1.5), float(np.exp(rng.uniform(0.5, 3.5))))
    elif what < 0.88:
        y, x = np.mgrid[0:SIZE, 0:SIZE] * (2 * np.pi / SIZE * int(rng.choice([16, 32, 48])))
        field = np.sin(x) * np.sin(y) + 0.5 * _stretched(rng, 0.5, 1)
    else:
        field = (_stretched(rng, rng.uniform(0.8, 1.6), 1) > 1.2) * 2.0 - 0.2
    return np.repeat(np.clip(0.5 + 0.18 * field, 0, 1)[..., None], 3, 2).astype(np.float32)


def wood(rng: Rng) -> Floats:
    """Boards with grain along y and thin joints, or a veneer without."""
    field = _stretched(rng, rng.uniform(0.7, 1.5), rng.uniform(6, 25))
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    rings = np.sin((x * rng.integers(2, 8) + 0.15 * _stretched(rng, 2.0, 8)) * 2 * np.pi)
    tone = rng.uniform(0.1, 0.8) * np.array([1, rng.uniform(0.55, 0.85), rng.uniform(0.25, 0.65)])
    contrast = rng.uniform(0.02, 0.25)
    share = 1 + contrast * (0.5 * field + rng.uniform(0, 0.7) * rings)
    if rng.random() < 0.6:
        boards, lengths = int(rng.choice([2, 4, 8])), int(rng.choice([1, 2, 3]))
        u, v = x * boards, y * lengths + 0.37 * np.floor(x * boards)
        shade = rng.normal(1, rng.uniform(0, 0.12), (boards, lengths))
        share = share * shade[u.astype(int), v.astype(int) % lengths]
        share[(u % 1 < 0.012 * boards) | (v % 1 < 0.006 * lengths)] *= rng.uniform(0.4, 0.95)
    return np.clip(tone * share[..., None], 0.01, 1).astype(np.float32)


def stone(rng: Rng) -> Floats:
    """Courses of blocks of unequal length and shade with weathered joints, or bare rock."""
    field = textures._noise(rng, SIZE, rng.uniform(0.6, 1.6))
    tone = _color(rng, 0.15, 0.7, 0.1)
    share = 1 + rng.uniform(0.03, 0.3) * field
    if rng.random() < 0.75:
        rows = int(rng.choice([3, 4, 6, 8, 12, 16]))
        y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
        v = (y * rows).astype(int)
        ends = np.sort(rng.random((rows, int(rng.integers(2, 1 + rows)))), 1)
        block = (x[..., None] > ends[v]).sum(-1) % ends.shape[1]
        gap = np.abs(x[..., None] - ends[v]).min(-1) < rng.uniform(0.002, 0.01)
        share = share * rng.normal(1, rng.uniform(0.02, 0.25), ends.shape)[v, block]
        share[gap | ((y * rows) % 1 < rng.uniform(0.02, 0.1))] *= rng.choice([0.4, 0.7, 1.4])
    return np.clip(tone * share[..., None], 0.01, 1).astype(np.float32)


def poster(rng: Rng) -> Floats:
    """A picture: soft blobs, sharp forms, a gradient, some lines of print, and a border."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    image = _between(rng.random(3), rng.random(3), (rng.normal() * x + rng.normal() * y).astype(np.float32))
    for _ in range(int(rng.integers(2, 25))):
        cx, cy = rng.random(2)
        w, h = np.exp(rng.uniform(np.log(0.02), np.log(0.4), 2))
        a = rng.choice([0.0, rng.uniform(0, np.pi)])
        u, v = np.cos(a) * (x - cx) + np.sin(a) * (y - cy), np.cos(a) * (y - cy) - np.sin(a) * (x - cx)
        r = (u / w) ** 2 + (v / h) ** 2 if rng.random() < 0.7 else np.maximum(abs(u / w), abs(v / h)) ** 4
        soft = rng.choice([0.03, 0.3, 1.0])
        mask = np.clip((1 - r) / soft, 0, 1)[..., None]
        shade = np.clip(1 + rng.uniform(0, 0.8) * u / w, 0.2, 1.8)[..., None]
        image = image * (1 - mask) + mask * rng.random(3) * shade
    if rng.random() < 0.5:
        print_, top = printing(rng), int(rng.integers(0, SIZE - 64))
        image[top : top + 64, 16:-16] = print_[:64, 16:-16]
    image *= 1 + rng.uniform(0, 0.2) * _stretched(rng, 1.2, 1)[..., None]
    if rng.random() < 0.5:
        edge = int(rng.integers(3, 30))
        border = np.ones((SIZE, SIZE), bool)
        border[edge:-edge, edge:-edge] = False
        image[border] = rng.choice([0.05, 0.9, rng.random()])
    return np.clip(image, 0, 1).astype(np.float32)


def printing(rng: Rng) -> Floats:
    """A page: headings and paragraphs of letter-like strokes in black or colour."""
    image = np.ones((SIZE, SIZE), np.float32)
    y, margin = int(rng.integers(4, 24)), int(rng.integers(6, 40))
    while y < SIZE - 10:
        pitch = int(rng.choice([5, 7, 10, 20], p=[0.4, 0.3, 0.2, 0.1]))
        x, stop = margin, SIZE - margin - int(rng.integers(0, 90) * (rng.random() < 0.4))
        while x < stop and y + pitch < SIZE:
            wide = int(rng.integers(2, pitch + 2))
            if rng.random() < 0.85:
                image[y : y + pitch * 2 // 3, x : x + wide] *= rng.random((pitch * 2 // 3, 1)) < 0.55
                image[y : y + pitch * 2 // 3, x : x + 1] = 0
            x += wide + 1
        y += pitch + int(rng.integers(0, 3))
    image = gaussian_filter(image, 0.5, mode="wrap")
    ink, paper = _color(rng, 0.02, 0.3, 0.5), _color(rng, 0.5, 1, 0.08)
    return _between(*((paper, ink) if rng.random() < 0.12 else (ink, paper)), image)


def screen(rng: Rng) -> Floats:
    """What a monitor shows: windows with bars and text, or a film, or nothing."""
    if rng.random() < 0.25:
        return np.full((SIZE, SIZE, 3), rng.uniform(0.005, 0.05), np.float32)
    image = np.ones((SIZE, SIZE, 3), np.float32) * _color(rng, 0.05, 0.9, 0.4).astype(np.float32)
    for _ in range(int(rng.integers(1, 5))):
        y, x = rng.integers(0, 160, 2)
        h, w = rng.integers(40, 200, 2)
        page = (printing if rng.random() < 0.6 else poster)(rng)[: SIZE - y, : SIZE - x]
        image[y : y + h, x : x + w] = page[:h, :w]
        image[y : y + 8, x : x + w] = rng.random(3)
    return image


def keys(rng: Rng) -> Floats:
    """Rows of equal caps with gaps: keyboards, grilles, perforated sheets."""
    rows, cols = int(rng.choice([4, 6, 8, 16])), int(rng.choice([8, 16, 32]))
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    u, v = (x * cols + 0.3 * np.floor(y * rows)) % 1, (y * rows) % 1
    gap = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v)) < rng.uniform(0.06, 0.3)
    dark, bright = _color(rng, 0.01, 0.2, 0.1), _color(rng, 0.1, 0.9, 0.1)
    low, high = (dark, bright) if rng.random() < 0.7 else (bright, dark)
    return _between(low, high, gaussian_filter(1.0 - gap, 0.6, mode="wrap").astype(np.float32))


def slats(rng: Rng) -> Floats:
    """Stripes along y, each shaded like a rounded slat: blinds, corrugated sheet, tambour doors."""
    count = int(rng.choice([4, 8, 16, 32]))
    x = np.arange(SIZE) / SIZE * count % 1
    profile = (1 - x) ** rng.uniform(0.2, 1.5) * (x > rng.uniform(0, 0.15))
    tone, depth = _color(rng, 0.2, 0.9, 0.06), rng.choice([0.06, 0.3, 0.8])
    share = np.broadcast_to(profile, (SIZE, SIZE)) + 0.03 * _stretched(rng, 0.8, 1)
    return _between(tone * (1 - depth), tone, share.astype(np.float32))


def leaves(rng: Rng) -> Floats:
    """Foliage, hedge or lawn: bright specks over dark ones."""
    share = 0.4 + 0.25 * textures._noise(rng, SIZE, rng.uniform(0.3, 1.3))
    dark = np.array([0.02, 0.05, 0.01]) * rng.uniform(0.5, 2)
    bright = rng.uniform(0.3, 0.8) * np.array([rng.uniform(0.5, 1), 1, rng.uniform(0.15, 0.5)])
    return _between(dark, bright, share.astype(np.float32))


def carpet(rng: Rng) -> Floats:
    """Low, speckled pile in one colour, or two."""
    share = 0.5 + rng.uniform(0.05, 0.35) * textures._noise(rng, SIZE, rng.uniform(0, 0.7))
    low = _color(rng, 0.03, 0.6, 0.35)
    return _between(low, low * rng.uniform(1.1, 2.2), share.astype(np.float32))


def cloud(rng: Rng) -> Floats:
    """White clouds on a darker sky."""
    share = 0.5 + 0.4 * textures._noise(rng, SIZE, rng.uniform(1.6, 2.4))
    return _between(np.array([0.45, 0.6, 0.85]), np.ones(3), share.astype(np.float32))


MAKERS: dict[str, tuple[Callable[[Rng], Floats], int]] = {
    "white": (white, 1), "grain": (grain, 40), "wood": (wood, 24), "stone": (stone, 28),
    "poster": (poster, 56),
    "print": (printing, 16), "screen": (screen, 12), "keys": (keys, 8), "slats": (slats, 12),
    "leaves": (leaves, 12), "carpet": (carpet, 16), "cloud": (cloud, 6),
}  # fmt: skip
PLAIN, TEXTURED = 60, 260
"""Numbers of textures of mixed kinds, the plain ones first, that precede those of particular stuffs."""

RANGES: dict[str, tuple[int, int]] = {"plain": (0, PLAIN), "any": (PLAIN, PLAIN + TEXTURED)}
for _name, (_, _count) in MAKERS.items():
    _start = max(stop for _, stop in RANGES.values())
    RANGES[_name] = (_start, _start + _count)


@cache
def mixed() -> NDArray[np.uint8]:
    """The first textures of :func:`bank`, of mixed kinds; some seconds at the first call of a process."""
    rng = np.random.default_rng(11)
    plain = np.stack([textures.plain(rng, SIZE) for _ in range(PLAIN)])
    return mipmaps(np.concatenate([plain, textures.atlas(rng, TEXTURED)]))


@cache
def bank() -> NDArray[np.uint8]:
    """All textures, numbered as in ``RANGES``; some seconds at the first call of a process."""
    rng = np.random.default_rng(12)
    made = [np.stack([make(rng) for _ in range(count)]) for make, count in MAKERS.values()]
    return np.concatenate([mixed(), *(mipmaps(m) for m in made)])


@dataclass(frozen=True)
class Material:
    """How a surface looks; see :class:`training.raytrace.Scene` for the fields.

    ``fit`` spreads the texture once over the larger side of what it is put on, instead of ``texel``.
    """

    texture: int
    texel: float = 1.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gloss: float = 0.0
    detail: tuple[float, float, float] = (0.0, 0.0, 1.0)
    glow: float = 0.0
    mirror: float = 0.0
    fit: bool = False


def pick(rng: Rng, group: str) -> int:
    """A random texture of a group."""
    return int(rng.integers(*RANGES[group]))


def faint(rng: Rng, most: float = 0.04) -> tuple[float, float, float]:
    """A detail that few see: none to four per cent, from fine grain to blotches of a metre."""
    amount = float(rng.choice([0.0, 0.01, 0.02, 0.04, 0.1])) * most / 0.04
    return (float(pick(rng, "grain")), amount, float(np.exp(rng.uniform(np.log(0.3), np.log(6)))))


def tinted(rng: Rng, low: float, high: float, spread: float) -> tuple[float, float, float]:
    """A random colour as a tint."""
    r, g, b = _color(rng, low, high, spread)
    return (float(r), float(g), float(b))


def paint(rng: Rng, low: float = 0.35, high: float = 0.95, spread: float = 0.05) -> Material:
    """One colour with at most a faint detail."""
    return Material(pick(rng, "white"), 1.0, tinted(rng, low, high, spread), detail=faint(rng))


def lacquer(rng: Rng) -> Material:
    """One colour, any, sometimes glossy: cupboards, plastic, metal."""
    shiny = rng.random()
    return Material(
        pick(rng, "white"), 1.0, tinted(rng, 0.03, 0.9, rng.choice([0.05, 0.5])),
        float(rng.uniform(0.1, 0.6)) if shiny < 0.35 else 0.0, faint(rng, 0.02), 0.0,
        float(rng.uniform(0.1, 0.6)) if shiny < 0.15 else 0.0,
    )  # fmt: skip


def stuff(rng: Rng, group: str, texel: tuple[float, float], mirror: float = 0.0) -> Material:
    """A texture of a group, so many a metre, with a little tint."""
    size = float(np.exp(rng.uniform(np.log(texel[0]), np.log(texel[1]))))
    tint = tuple(float(c) for c in np.clip(rng.uniform(0.6, 1.1) * rng.normal(1, 0.05, 3), 0.3, 1.2))
    return Material(pick(rng, group), size, tint, mirror=mirror, detail=faint(rng))  # type: ignore[arg-type]


def picture(rng: Rng, group: str = "poster", glow: float = 0.0) -> Material:
    """A whole picture on a face."""
    return Material(pick(rng, group), tint=tinted(rng, 0.5, 1.0, 0.03), fit=True, glow=glow)


def fabric(rng: Rng) -> Material:
    """Upholstery: one colour with a weave, seldom a pattern."""
    if rng.random() < 0.2:
        return stuff(rng, "any", (1, 5))
    detail = (float(pick(rng, "grain")), float(rng.choice([0.02, 0.06, 0.2])), float(rng.uniform(2, 10)))
    return Material(pick(rng, "white"), 1.0, tinted(rng, 0.03, 0.9, 0.25), detail=detail)


def anything(rng: Rng, plainness: float) -> Material:
    """What small things are made of."""
    if rng.random() < plainness:
        return lacquer(rng)
    group = str(
        rng.choice(["any", "poster", "print", "wood", "stone", "plain"], p=[0.4, 0.2, 0.1, 0.1, 0.1, 0.1])
    )
    if group in ("poster", "print"):
        return picture(rng, group)
    return stuff(rng, group, (1, 8))
