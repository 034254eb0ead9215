"""Indoor scenes: furnished rooms whose walls have doors and windows, with what lies outside."""

from __future__ import annotations

import numpy as np

from training import furniture
from training.builder import Builder, Light, Place, Vec
from training.materials import Material, lacquer, paint, pick, picture, stuff

Hole = tuple[float, float, float, float]


def wall(p: Place, width: float, height: float, thick: float, holes: list[Hole], m: Material) -> None:
    """A wall along x from 0 to ``width``, its face at y = 0, with holes (x0, x1, z0, z1) in order of x."""
    x = 0.0
    for x0, x1, z0, z1 in holes:
        p.box((x, 0, 0), (x0, thick, height), m)
        if z0 > 0.01:
            p.box((x0, 0, 0), (x1, thick, z0), m)
        p.box((x0, 0, z1), (x1, thick, height), m)
        x = x1
    p.box((x, 0, 0), (width, thick, height), m)


def frame(p: Place, hole: Hole, thick: float, m: Material) -> None:
    """Bars around a hole and across it, as windows have."""
    r = p.rng
    x0, x1, z0, z1 = hole
    bar, y = float(r.uniform(0.02, 0.08)), float(r.uniform(0.0, 0.8)) * thick
    y0, y1 = y - bar * float(r.uniform(0.1, 0.6)), y + bar
    p.box((x0, y0, z0), (x0 + bar, y1, z1), m)
    p.box((x1 - bar, y0, z0), (x1, y1, z1), m)
    p.box((x0, y0, z1 - bar), (x1, y1, z1), m)
    p.box((x0, y0, z0), (x1, y1, z0 + bar), m)
    for k in range(1, int(r.integers(1, 5))):
        x = x0 + (x1 - x0) * k / 4 + 0.0
        p.box((x - 0.4 * bar, y0, z0), (x + 0.4 * bar, y1, z1), m)
    for _ in range(int(r.integers(0, 3))):
        z = float(r.uniform(z0, z1))
        p.box((x0, y0, z - 0.3 * bar), (x1, y1, z + 0.3 * bar), m)
    if r.random() < 0.4 and z0 > 0.1:
        p.box((x0 - 0.1, -0.15, z0 - 0.03), (x1 + 0.1, 0.02, z0), m)


def door(p: Place, hole: Hole, thick: float, m: Material) -> None:
    """A frame around a hole and a leaf, open or shut."""
    r = p.rng
    x0, x1, _, z1 = hole
    for a, b in ((x0 - 0.07, x0), (x1, x1 + 0.07)):
        p.box((a, -0.015, 0), (b, thick + 0.015, z1 + 0.07), m)
    p.box((x0, -0.015, z1), (x1, thick + 0.015, z1 + 0.07), m)
    angle = float(r.choice([0.0, r.uniform(-2.2, -0.3)]))
    leaf = p.inner((x0, 0.02, 0), angle)
    leaf.box((0, 0, 0.01), (x1 - x0, 0.04, z1), m if r.random() < 0.5 else furniture.board(p))
    leaf.rod((x1 - x0 - 0.15, -0.05, 1.0), (x1 - x0 - 0.05, -0.05, 1.0), 0.01, furniture.metal(p))


def outside(b: Builder, half: Vec) -> None:
    """What windows show: ground, houses, hedges, trees, in full daylight."""
    r = b.rng
    drop = float(r.choice([0.1, 0.3, 3.0, 8.0]))

    def lit(group: str, low: float, high: float) -> Material:
        m = stuff(r, group, (low, high))
        return Material(m.texture, m.texel, m.tint, glow=float(r.uniform(0.3, 1.5)))

    p = Place(b, (0, 0, -drop))
    p.box((-80, -80, -0.5), (80, 80, 0), lit(str(r.choice(["leaves", "stone", "carpet"])), 0.2, 1.0))
    for _ in range(int(r.integers(4, 12))):
        turn, gap = float(r.uniform(0, 2 * np.pi)), float(np.exp(r.uniform(np.log(1.2), np.log(40))))
        far = float(np.hypot(half[0], half[1])) + gap
        spot = p.inner((far * np.cos(turn), far * np.sin(turn), 0), turn)
        w, h = gap * float(r.uniform(0.2, 0.8)) + 0.3, drop + gap * float(r.uniform(0.1, 0.7)) + 0.3
        what = r.random()
        if what < 0.6:
            d = float(r.uniform(0.3, 0.6)) * gap
            spot.box((0, -w, 0), (d, w, h), lit(str(r.choice(["stone", "any", "wood", "plain"])), 0.2, 1.0))
            for k in range(int(r.integers(0, 4))):
                y = w * (-0.7 + 0.45 * k)
                spot.box((-0.03, y, 0.5 * h), (0.1, y + 0.25 * w, 0.75 * h), lit("screen", 0.3, 1))
        else:
            spot.rod((0, 0, 0), (0, 0, h), 0.05 * w, lit("wood", 0.5, 1))
            for _ in range(5):
                x, y, z = r.normal(0, 0.3 * w, 3)
                spot.ball((x, y, h + z), tuple(r.uniform(0.3, 0.7, 3) * w), lit("leaves", 0.3, 2))


def _skin(b: Builder) -> Material:
    """What walls are covered with: paint with a faint texture, mostly."""
    r = b.rng
    if r.random() < b.plainness:
        return paint(r, 0.4, 0.98, 0.04)
    return stuff(r, str(r.choice(["plain", "stone", "any", "wood"], p=[0.55, 0.2, 0.1, 0.15])), (0.3, 1.0))


def _floor(b: Builder) -> Material:
    r = b.rng
    what = r.random()
    if what < 0.4:
        return stuff(r, "wood", (0.4, 1.0), float(r.choice([0.0, 0.2, 0.5])))
    if what < 0.65:
        return stuff(r, "carpet", (0.7, 3))
    if what < 0.8:
        return stuff(r, "any", (0.3, 1.0), float(r.choice([0.0, 0.3])))
    return paint(r, 0.1, 0.7, 0.1)


def _shell(b: Builder, half: Vec, height: float) -> tuple[list[Place], list[tuple[int, Hole]]]:
    """Walls with openings, floor, ceiling and skirting. Returns the walls' places and the windows."""
    r, thick = b.rng, float(b.rng.uniform(0.08, 0.35))
    low, high = -half[:2] - thick, half[:2] + thick
    ground = Place(b, (0, 0, 0))
    ground.box((low[0], low[1], -0.1), (high[0], high[1], 0), _floor(b))
    ground.box((low[0], low[1], height), (high[0], high[1], height + 0.1), paint(r, 0.6, 0.98, 0.02))
    common, trim = _skin(b), paint(r, 0.3, 0.98, 0.03)
    places, windows = [], []
    for k in range(4):
        length = 2 * float(half[k % 2])
        away = float(half[(k + 1) % 2])
        yaw = k * np.pi / 2
        corner = np.array(
            [-np.sin(yaw) * away - np.cos(yaw) * length / 2, np.cos(yaw) * away - np.sin(yaw) * length / 2, 0]
        )
        p = Place(b, corner, yaw)
        holes: list[Hole] = []
        x = float(r.uniform(0.2, 0.8))
        while x < length - 0.9 and len(holes) < 3 and r.random() < 0.55:
            w = float(r.uniform(0.6, min(2.5, length - x - 0.2)))
            is_door = r.random() < 0.3
            w = min(w, 1.0) if is_door else w
            z0 = 0.0 if is_door or r.random() < 0.2 else float(r.uniform(0.5, 1.1))
            z1 = 2.05 if is_door else float(r.uniform(max(1.6, z0 + 0.6), height - 0.1))
            holes.append((x, x + w, z0, z1))
            (door if is_door else frame)(p, holes[-1], thick, trim if r.random() < 0.8 else lacquer(r))
            if not is_door:
                windows.append((k, holes[-1]))
            x += w + float(r.uniform(0.2, 1.5))
        wall(p, length, height, thick, holes, common if r.random() < 0.7 else _skin(b))
        if r.random() < 0.6 and not any(h[2] == 0 for h in holes):
            p.box((0, -0.015, 0), (length, 0, float(r.uniform(0.05, 0.15))), trim)
        places.append(p)
    return places, windows


def _dressed(b: Builder, places: list[Place], windows: list[tuple[int, Hole]], height: float) -> None:
    """Curtains, blinds and radiators at the windows."""
    r = b.rng
    for k, (x0, x1, z0, z1) in windows:
        p = places[k]
        if r.random() < 0.5:
            bottom = float(r.choice([0.02, max(0.02, z0 - 0.2)]))
            cut = (x1 - x0) * float(r.uniform(0.1, 0.5))
            top = min(height - 0.05, z1 + 0.15)
            if r.random() < 0.8:
                furniture.curtain(p.inner((x0 - 0.2, -0.12, 0)), cut + 0.2, bottom, top)
            if r.random() < 0.6:
                furniture.curtain(p.inner((x1 - cut, -0.12, 0)), cut + 0.2, bottom, top)
        elif r.random() < 0.3:
            m, down = paint(r, 0.5, 0.95, 0.04), float(r.uniform(0.2, 1.0))
            count = int(r.integers(6, 22))
            for i in range(count):
                z = z1 - (z1 - z0) * down * i / count
                p.box((x0, -0.05, z - 0.004), (x1, -0.02, z + 0.004), m)
        if z0 > 0.45 and r.random() < 0.5:
            m = paint(r, 0.5, 0.95, 0.03)
            count = int((x1 - x0) / 0.08)
            for i in range(count):
                p.box((x0 + 0.08 * i, -0.12, 0.1), (x0 + 0.08 * i + 0.05, -0.04, z0 - 0.1), m)


def _hung(b: Builder, places: list[Place], half: Vec, height: float) -> None:
    """Pictures, switches, screens and wall shelves."""
    r = b.rng
    for _ in range(int(r.integers(0, 8))):
        k = int(r.integers(0, 4))
        length = 2 * float(half[k % 2])
        p, x, z = places[k], float(r.uniform(0.2, length - 0.2)), float(r.uniform(0.9, height - 0.5))
        w, h = np.exp(r.uniform(np.log(0.1), np.log(0.6), 2))
        t, what = float(r.choice([0.004, 0.02, 0.04])), r.random()
        if what < 0.5:
            p.box((x - w, -t, z - h), (x + w, 0, z + h), lacquer(r))
            e = float(r.uniform(0.0, 0.05))
            p.box((x - w + e, -t - 0.003, z - h + e), (x + w - e, 0, z + h - e), picture(r))
        elif what < 0.62:
            furniture.monitor(p.inner((x, -0.1, z - 0.4)), float(r.uniform(0.3, 0.6)), lacquer(r))
        elif what < 0.8:
            p.box((x - 0.04, -0.012, 1.1), (x + 0.04, 0, 1.18), paint(r, 0.7, 0.95))
        else:
            p.box((x - w, -0.22, z), (x + w, 0, z + 0.025), furniture.board(p))
            furniture.things(
                p.inner((x, -0.11, 0)), (0.9 * w, 0.07), z + 0.025, int(r.integers(1, 6)), (0.02, 0.1)
            )


def _furnish(b: Builder, places: list[Place], half: Vec) -> None:
    """Furniture along the walls and in the middle."""
    r = b.rng
    for k in range(4):
        length, x = 2 * float(half[k % 2]), float(r.uniform(0.0, 0.5))
        while x < length - 0.6 and r.random() < 0.7:
            what = r.random()
            w = float(r.uniform(0.6, min(2.6, length - x)))
            p = places[k].inner((x + w / 2, -0.5, 0))
            if what < 0.25:
                furniture.cupboards(places[k].inner((x, -0.01, 0)), w)
            elif what < 0.45:
                (furniture.desk if r.random() < 0.6 else furniture.table)(p)
                furniture.chair(p.inner((0, -0.6, 0), np.pi + float(r.normal(0, 0.5))))
            elif what < 0.6:
                furniture.sofa(p)
            elif what < 0.75:
                furniture.shelf(places[k].inner((x + w / 2, -0.24, 0)))
            else:
                furniture.block(p)
            x += w + float(r.uniform(0, 0.8))
    for _ in range(int(r.integers(0, 6))):
        x, y = r.uniform(-0.75, 0.75, 2) * half[:2]
        p = Place(b, (x, y, 0), float(r.uniform(0, 2 * np.pi)))
        what = r.random()
        if what < 0.3:
            furniture.table(p)
            for _ in range(int(r.integers(0, 4))):
                turn = float(r.choice([0, np.pi / 2, np.pi, -np.pi / 2])) + float(r.normal(0, 0.2))
                furniture.chair(p.inner((0, 0, 0), turn).inner((0, 0.9, 0)))
        elif what < 0.65:
            furniture.chair(p)
        elif what < 0.75:
            furniture.lamp(p, float(r.uniform(1.2, 1.7)))
        elif what < 0.85:
            furniture.sofa(p)
        else:
            furniture.block(p)
    if r.random() < 0.4:
        p = Place(b, (*(r.uniform(-0.5, 0.5, 2) * half[:2]), 0), float(r.uniform(0, 3)))
        w, d = r.uniform(0.5, 1.5, 2)
        p.box((-w, -d, 0), (w, d, 0.012), stuff(r, str(r.choice(["any", "carpet"])), (0.5, 2)))


def daylight(b: Builder, windows: list[tuple[int, Hole]], half: Vec, height: float) -> Light:
    """Sun through a window, or a dull day, and lamps; walls of different direction differ in brightness."""
    r = b.rng
    k = windows[int(r.integers(len(windows)))][0] if windows else int(r.integers(0, 4))
    a = k * np.pi / 2 + np.pi / 2 + float(r.uniform(-1.1, 1.1))
    up = float(np.tan(np.deg2rad(r.uniform(12, 60))))
    sun = 150 * np.array([np.cos(a), np.sin(a), up])
    power = float(r.choice([0.0, r.uniform(0.5, 4)], p=[0.3, 0.7]))
    lamps = np.stack(
        [np.array([*(r.uniform(-0.8, 0.8, 2) * half[:2]), height * r.uniform(0.75, 0.97)]) for _ in range(2)]
    )
    weak = np.array([[r.uniform(0.05, 0.8), r.uniform(0.7, 4)] for _ in range(2)])
    inward = np.array([-np.cos(a), -np.sin(a), 0]) * r.uniform(-0.5, 0.1) + [0, 0, r.uniform(-0.2, 0.4)]
    lights, strong = np.concatenate([sun[None], lamps]), np.concatenate([[[power, 0.0]], weak])
    if power == 0:
        lights, strong = lights[1:], strong[1:]
    sky = r.uniform(1, 4) * np.array([r.uniform(0.7, 1), r.uniform(0.85, 1), 1])
    softness = float(np.exp(r.uniform(np.log(0.001), np.log(0.01))))
    return Light(
        lights, float(r.uniform(0.2, 0.7)), sky, strong, int(r.choice([1, 2])), softness,
        inward, pick(r, "cloud"),
    )  # fmt: skip


def furnished(b: Builder) -> tuple[Vec, Vec, Light]:
    """A room with openings, mostly of plain surfaces. Returns camera, target and light."""
    r = b.rng
    half = np.array([r.uniform(1.3, 4.0), r.uniform(1.3, 4.0)])
    height = float(r.uniform(2.2, 3.2))
    places, windows = _shell(b, half, height)
    outside(b, half)
    _dressed(b, places, windows, height)
    _hung(b, places, half, height)
    _furnish(b, places, half)
    light = daylight(b, windows, half, height)
    eye = np.array([*(r.uniform(-0.85, 0.85, 2) * half), r.uniform(0.6, 1.9)])
    target = np.array([*(r.uniform(-1, 1, 2) * half), r.uniform(0.1, 1.7)])
    if r.random() < 0.6:  # at something small, within the room
        near = [q.centre for q in b.parts if q.half.max() < 0.7 and (np.abs(q.centre[:2]) < half + 0.1).all()]
        target = near[int(r.integers(len(near)))] + r.normal(0, 0.2, 3) if near else target
    return eye, target, light


def tabletop(b: Builder) -> tuple[Vec, Vec, Light]:
    """Close look at a desk, a table or a row of cupboards before a wall."""
    r = b.rng
    p = Place(b, (0, 0, 0))
    p.box((-5, -5, -0.1), (5, 2.5, 0), _floor(b))
    back = float(r.uniform(0.5, 2.0))
    hole = [(4.2, 5.6, 0.9, 2.1)] if r.random() < 0.5 else []
    side = p.inner((-5, back, 0), float(r.normal(0, 0.1)))
    wall(side, 10, 3.2, 0.2, hole, _skin(b))
    if hole:
        frame(side, hole[0], 0.2, paint(r, 0.4, 0.95))
        outside(b, np.array([2, 2]))
    what = r.random()
    if what < 0.4:
        furniture.desk(p)
    elif what < 0.75:
        furniture.table(p)
        furniture.chair(p.inner((r.uniform(-0.5, 0.5), 0.7, 0)))
    else:
        furniture.cupboards(p.inner((-1.2, min(back - 0.02, 0.45), 0)), 2.4)
    for _ in range(int(r.integers(0, 3))):
        furniture.chair(p.inner((r.uniform(-1.5, 1.5), r.uniform(-0.2, back - 0.4), 0), r.uniform(0, 6)))
    eye = np.array([r.uniform(-0.9, 0.9), -r.uniform(0.8, 1.9), r.uniform(1.0, 1.8)])
    target = np.array([*r.uniform(-0.3, 0.3, 2), r.uniform(0.6, 1.0)])
    light = daylight(b, [(0, (0, 0, 0, 0))] if hole else [], np.array([2.0, 2.0]), 2.5)
    return eye, target, light
