"""Pieces of furniture: each stands on z = 0 of its place, its front towards −y."""

from __future__ import annotations

import numpy as np

from training.builder import Place
from training.materials import (
    Material,
    anything,
    fabric,
    lacquer,
    paint,
    pick,
    picture,
    stuff,
    tinted,
)


def metal(p: Place) -> Material:
    """Steel tube, black, grey or bright."""
    return Material(
        pick(p.rng, "white"), 1.0, tinted(p.rng, 0.02, 0.8, 0.04), gloss=float(p.rng.uniform(0, 0.8)),
        mirror=float(p.rng.choice([0.0, 0.0, 0.6])),
    )  # fmt: skip


def board(p: Place) -> Material:
    """What furniture is made of: wood with or without visible grain, lacquer, paint; seldom a pattern."""
    what = p.rng.random()
    if what < 0.35:
        return stuff(p.rng, "wood", (0.5, 1.5), float(p.rng.choice([0.0, 0.0, 0.25])))
    if what < 0.35 + 0.2 * (1 - p.plainness):
        return stuff(p.rng, "any", (0.4, 2))
    return lacquer(p.rng) if what < 0.85 else paint(p.rng)


def things(p: Place, extent: tuple[float, float], z: float, count: int, size: tuple[float, float]) -> None:
    """Small things of all kinds standing on a surface at height z within ± extent."""
    r = p.rng
    for _ in range(count):
        x, y = r.uniform(-1, 1, 2) * extent
        a, b, c = np.exp(r.uniform(np.log(size[0]), np.log(size[1]), 3))
        m, what, yaw = anything(r, p.plainness), r.random(), float(r.uniform(0, np.pi))
        spot = p.inner((x, y, z), yaw)
        if what < 0.3:
            spot.box((-a, -b, 0), (a, b, 2 * c), m)
        elif what < 0.45:  # papers and books that lie
            sheets = picture(r, str(r.choice(["poster", "print"])))
            spot.box((-a, -1.4 * a, 0), (a, 1.4 * a, float(r.choice([0.002, 0.02, 0.05]))), sheets)
        elif what < 0.55:
            spot.ball((0, 0, c), (a, b, c), m)
        elif what < 0.7:  # bottle
            spot.drum((0, 0, c), 0.5 * a, c, m)
            spot.drum((0, 0, 2 * c), 0.2 * a, 0.5 * c, m)
        elif what < 0.8:  # cup with a handle
            spot.drum((0, 0, 0.05), 0.04, 0.05, m)
            spot.tube([(0.04, 0, 0.08), (0.07, 0, 0.07), (0.07, 0, 0.03), (0.04, 0, 0.02)], 0.007, m)
        elif what < 0.9:  # plant
            spot.drum((0, 0, 0.06), 0.07, 0.06, m)
            green = stuff(r, "leaves", (2, 6))
            for _ in range(int(r.integers(2, 7))):
                u, v, w = r.normal(0, 0.07, 3)
                spot.ball((u, v, 0.25 + w), tuple(r.uniform(0.02, 0.1, 3)), green)
        else:  # standing picture or book
            spot.box((-a, -0.015, 0), (a, 0.015, 2.6 * a), picture(r))


def table(p: Place) -> None:
    """A plate on thin legs, straight or splayed, with things on it."""
    r = p.rng
    w, d, h, t = r.uniform(0.3, 1.1), r.uniform(0.25, 0.55), r.uniform(0.35, 0.85), r.uniform(0.01, 0.035)
    top, leg = board(p), metal(p) if r.random() < 0.6 else board(p)
    p.box((-w, -d, h - 2 * t), (w, d, h), top)
    radius, splay = float(r.uniform(0.012, 0.04)), float(r.choice([0.0, 0.12]))
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = sx * (w - 0.06), sy * (d - 0.06)
            p.rod((x, y, h - 2 * t), (x + splay * sx, y + splay * sy, 0), radius, leg)
    if r.random() < 0.3:
        p.box((-w, d - 0.06, h - 0.3), (w, d - 0.04, h - 2 * t), board(p))
    things(p, (0.8 * w, 0.8 * d), h, int(r.integers(0, 9)), (0.03, 0.15))


def chair(p: Place) -> None:
    """Seat, back and four legs; or a bent tube frame; or a swivel foot."""
    r, m, leg = p.rng, fabric(p.rng) if p.rng.random() < 0.5 else board(p), metal(p)
    w, h, t = float(r.uniform(0.19, 0.27)), float(r.uniform(0.38, 0.48)), float(r.uniform(0.01, 0.05))
    back, lean, thin = (
        h + float(r.uniform(0.3, 0.6)),
        float(r.uniform(0.02, 0.2)),
        float(r.uniform(0.009, 0.022)),
    )
    p.box((-w, -w, h - t), (w, w, h + t), m)
    tilt = np.array([[1, 0, 0], [0, np.cos(lean), np.sin(lean)], [0, -np.sin(lean), np.cos(lean)]])
    low = float(r.choice([h, h + 0.2]))
    p.put(0, (0, w + lean * 0.15, (low + back) / 2), (w, max(t, 0.012), (back - low) / 2), m, tilt)
    what = r.random()
    if what < 0.45:
        for sx in (-1, 1):
            p.rod((sx * w * 0.95, -w * 0.95, h), (sx * w * 0.95, -w, 0), thin, leg)
            p.tube([(sx * w, w + 0.06, 0), (sx * w, w, h), (sx * w, w + lean * 0.3, back)], thin, leg)
    elif what < 0.75:
        for sx in (-1.1 * w, 1.1 * w):
            arm = h + 0.22
            p.tube(
                [(sx, 0.8 * w, 0.02), (sx, -0.9 * w, 0.02), (sx, -1.2 * w, 0.1), (sx, -1.25 * w, arm - 0.1),
                 (sx, -1.05 * w, arm), (sx, 0.9 * w, arm), (sx, w + lean * 0.2, back)], thin, leg,
            )  # fmt: skip
        p.rod((-1.1 * w, 0.8 * w, 0.02), (1.1 * w, 0.8 * w, 0.02), thin, leg)
    else:
        p.rod((0, 0, h), (0, 0, 0.08), 0.03, leg)
        for k in range(5):
            a = 2 * np.pi * k / 5
            p.rod((0, 0, 0.1), (0.3 * np.cos(a), 0.3 * np.sin(a), 0.04), 0.018, leg)
        for sx in (-1.15 * w, 1.15 * w):
            p.tube([(sx, 0.1, h), (sx, 0.1, h + 0.2), (sx, -0.15, h + 0.2)], 0.02, leg)


def desk(p: Place) -> None:
    """A desk with monitors, keyboard, cables, lamp and papers."""
    r = p.rng
    w, d, h = float(r.uniform(0.5, 1.1)), float(r.uniform(0.3, 0.45)), float(r.uniform(0.7, 0.78))
    p.box((-w, -d, h - 0.04), (w, d, h), board(p))
    side, black = board(p), lacquer(r)
    for sx in (-1, 1):
        if r.random() < 0.5:
            p.box((sx * (w - 0.04), -d, 0), (sx * w, d, h - 0.04), side)
        else:
            p.box((sx * (w - 0.4), -d, 0), (sx * w, d, h - 0.04), side)
    for k in range(int(r.integers(1, 3))):
        at = p.inner((float(r.uniform(-0.2, 0.2)) * w + 0.55 * k, 0.4 * d, h), float(r.normal(0, 0.3)))
        monitor(at, float(r.uniform(0.2, 0.33)), black)
    x = float(r.uniform(-0.3, 0.1)) * w
    p.box((x - 0.22, -0.6 * d, h), (x + 0.22, -0.6 * d + 0.15, h + 0.02), stuff(r, "keys", (2, 2.5)))
    p.ball((x + 0.33, -0.4 * d, h), (0.03, 0.05, 0.03), black)
    cable(p, (x, -0.3 * d, h), (float(r.uniform(-w, w)), d, h - 0.3))
    if r.random() < 0.5:
        lamp(p.inner((float(r.choice([-0.8, 0.8])) * w, 0.5 * d, h), float(r.uniform(0, 6))), 0.5)
    things(p, (0.85 * w, 0.8 * d), h, int(r.integers(0, 8)), (0.02, 0.12))


def monitor(p: Place, w: float, m: Material) -> None:
    """A screen on a foot."""
    r = p.rng
    z, ratio = float(r.uniform(0.08, 0.2)), float(r.choice([0.56, 0.62, 0.75]))
    p.box((-0.12, -0.08, 0), (0.12, 0.1, 0.012), m)
    p.box((-0.03, 0.03, 0), (0.03, 0.05, z + 0.1), m)
    p.box((-w, 0, z), (w, 0.035, z + 2 * w * ratio), m)
    shown = picture(r, "screen", float(r.choice([0.0, 0.4, 1.0])))
    p.box((-w + 0.012, -0.003, z + 0.015), (w - 0.012, 0.01, z + 2 * w * ratio - 0.015), shown)


def cable(p: Place, start: tuple[float, float, float], end: tuple[float, float, float]) -> None:
    """A thin line that sags or winds from one point to another."""
    r = p.rng
    a, b, n = np.array(start), np.array(end), 7
    t = np.linspace(0, 1, n)[:, None]
    middle = r.normal(0, 0.06, (n, 3)) * np.sin(np.pi * t) * [1, 1, 0.05]
    dark = Material(pick(r, "white"), 1.0, tinted(r, 0.01, float(r.choice([0.05, 0.8])), 0.1))
    p.tube([tuple(q) for q in a + t * (b - a) + middle], float(r.uniform(0.003, 0.007)), dark)


def lamp(p: Place, h: float) -> None:
    """A bent stand with a shade that glows, or not."""
    r, m = p.rng, metal(p)
    p.drum((0, 0, 0.01), 0.1, 0.012, m)
    x = float(r.uniform(-0.2, 0.3))
    p.tube([(0, 0, 0), (0, 0, 0.6 * h), (0.5 * x, 0, h), (x, 0, h)], float(r.uniform(0.006, 0.015)), m)
    shade = Material(pick(r, "white"), 1.0, tinted(r, 0.5, 0.95, 0.06), glow=float(r.choice([0.0, 1.0, 2.5])))
    radius = float(r.uniform(0.07, 0.2))
    if r.random() < 0.5:
        p.drum((x, 0, h), radius, 0.7 * radius, shade)
    else:
        p.ball((x, 0, h), (radius, radius, radius), shade)


def cupboards(p: Place, length: float) -> None:
    """A row of fronts with handles along x: kitchen units with a worktop, wall units and appliances."""
    r, front, top = p.rng, lacquer(p.rng) if p.rng.random() < 0.7 else board(p), board(p)
    h, d, count = (
        float(r.uniform(0.7, 0.95)),
        float(r.uniform(0.3, 0.6)),
        max(1, int(length / r.uniform(0.35, 0.7))),
    )
    unit, grip = length / count, metal(p)
    gap, body = float(r.uniform(0.002, 0.006)), lacquer(r)
    p.box((0, -d + 0.02, 0.08), (length, 0, h), body)
    p.box((0, -d - 0.02, h), (length, 0, h + 0.04), top)
    upper = float(r.uniform(0.5, 0.7)) if r.random() < 0.5 else 0.0
    for k in range(count):
        x0, x1 = k * unit + gap, (k + 1) * unit - gap
        if r.random() < 0.15:
            p.box((x0, -d - 0.01, 0.1), (x1, 0, h - 0.01), lacquer(r))
            p.drum((0.5 * (x0 + x1), -d, 0.5 * h), 0.35 * unit, 0.12, lacquer(r))
        else:
            p.box((x0, -d, 0.1), (x1, -d + 0.04, h - gap), front)
            p.rod((x0 + 0.05, -d - 0.03, h - 0.1), (x0 + 0.18, -d - 0.03, h - 0.1), 0.006, grip)
        if upper and r.random() < 0.85:
            z = h + float(r.choice([0.5, 0.55]))
            p.box((x0, -0.55 * d, z), (x1, 0, z + upper), front)
            p.rod(
                (x0 + 0.05, -0.55 * d - 0.02, z + 0.1), (x0 + 0.05, -0.55 * d - 0.02, z + 0.22), 0.006, grip
            )
    if r.random() < 0.4:
        p.box(
            (0, -0.005, h + 0.04),
            (length, 0, h + 0.55),
            stuff(r, "any" if r.random() < 0.5 else "keys", (1, 3)),
        )
    spot = p.inner((0.5 * length, -0.5 * d, 0))
    things(spot, (0.46 * length, 0.35 * d), h + 0.04, int(r.integers(1, 3 + 4 * length)), (0.03, 0.13))


def sofa(p: Place) -> None:
    """Seat, back and arms with rounded cushions."""
    r, m = p.rng, fabric(p.rng)
    w, d, h = float(r.uniform(0.35, 1.1)), 0.42, float(r.uniform(0.3, 0.45))
    p.box((-w, -d, 0.08), (w, d, h), m)
    p.box((-w, d - 0.2, h), (w, d, h + 0.4), m)
    p.put(2, (0, d - 0.1, h + 0.4), (0.1, 0.1, w), m, np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]))
    for sx in (-1, 1):
        p.box((sx * w, -d, 0.05), (sx * (w + 0.16), d, h + 0.2), m)
        p.rod((sx * (w + 0.08), -d, h + 0.2), (sx * (w + 0.08), d, h + 0.2), 0.08, m)
    for _ in range(int(r.integers(0, 4))):
        p.ball((float(r.uniform(-0.8, 0.8)) * w, d - 0.3, h + 0.18), (0.22, 0.1, 0.2), fabric(r))


def shelf(p: Place) -> None:
    """Boards between two sides, filled with books, boxes and gaps."""
    r, m = p.rng, board(p)
    w, d, h, levels = r.uniform(0.3, 0.7), r.uniform(0.12, 0.22), r.uniform(0.5, 1.1), int(r.integers(2, 6))
    for side in (-1, 1):
        p.box((side * w, -d, 0), (side * (w + 0.02), d, 2 * h), m)
    if r.random() < 0.6:
        p.box((-w, d - 0.01, 0), (w, d, 2 * h), m)
    for k in range(levels + 1):
        z, room = 2 * h * k / levels, 2 * h / levels
        p.box((-w, -d, z - 0.01), (w, d, z + 0.01), m)
        x, stop = -w, -w + 2 * w * r.choice([0.0, 0.5, 1.0])
        while k < levels and x < stop:
            thick, tall = float(r.uniform(0.015, 0.1)), float(r.uniform(0.5, 0.9)) * room
            if r.random() < 0.85:
                p.box(
                    (x, -d * r.uniform(0.3, 0.95), z),
                    (x + thick, d - 0.02, z + tall),
                    anything(r, p.plainness),
                )
            x += thick + 0.002


def block(p: Place) -> None:
    """A big plain thing: cabinet, cardboard box, tambour cupboard, fridge, with things on it."""
    r = p.rng
    w, d, h = np.exp(r.uniform(np.log(0.15), np.log(0.6), 3)) * [1, 0.8, 1.3]
    what = r.random()
    m = stuff(r, "slats", (0.5, 1.2)) if what < 0.2 else board(p)
    p.box((-w, -d, 0), (w, d, 2 * h), m)
    if r.random() < 0.5:
        p.box((-w - 0.02, -d - 0.02, 2 * h), (w + 0.02, d + 0.02, 2 * h + 0.03), board(p))
    if r.random() < 0.4:
        doors = int(r.integers(1, 4))
        for k in range(doors):
            x = -w + 2 * w * k / doors
            p.box((x + 0.004, -d - 0.018, 0.03), (x + 2 * w / doors - 0.004, -d, 2 * h - 0.02), m)
            p.rod((x + 0.05, -d - 0.03, h), (x + 0.05, -d - 0.03, h + 0.12), 0.007, metal(p))
    things(p, (0.8 * w, 0.8 * d), 2 * h + 0.03, int(r.integers(0, 5)), (0.03, 0.15))


def curtain(p: Place, width: float, z0: float, z1: float) -> None:
    """Waves of cloth along x between two heights: rows of flat cylinders before and behind each other."""
    r, m = p.rng, fabric(p.rng) if p.rng.random() < 0.4 else paint(p.rng, 0.6, 0.98, 0.03)
    m = Material(m.texture, m.texel, m.tint, 0.0, m.detail, float(r.choice([0.0, 0.2, 0.6])))
    x, deep, up, k = 0.0, float(r.uniform(0.02, 0.06)), 0.5 * (z0 + z1), 0
    while x < width:
        step = float(r.uniform(0.025, 0.08))
        side = deep * (0.5 if k % 2 else -0.5) * float(r.uniform(0.6, 1.2))
        p.put(2, (x, side, up), (step, deep * float(r.uniform(0.6, 1)), 0.5 * (z1 - z0)), m)
        x, k = x + 1.35 * step, k + 1
    p.rod((-0.1, 0, z1 + 0.02), (width + 0.1, 0, z1 + 0.02), 0.012, metal(p))
