"""Outdoor scenes: façades with portals and reliefs, fountains, statues and courtyards under the sky."""

from __future__ import annotations

import numpy as np

from training import furniture
from training.builder import Builder, Light, Place, Vec
from training.materials import Material, lacquer, pick, stuff, tinted
from training.raytrace import BOX, ELLIPSOID
from training.rooms import Hole, door, frame, wall


def masonry(b: Builder) -> Material:
    """Stone with or without courses, brick, plaster."""
    r = b.rng
    group = str(r.choice(["stone", "any", "plain", "white"], p=[0.55, 0.05, 0.2, 0.2]))
    m = stuff(r, group, (0.15, 0.8))
    amount = float(r.choice([0.0, 0.05, 0.15, 0.4]))
    detail = (float(pick(r, "grain")), amount, float(np.exp(r.uniform(np.log(0.3), np.log(4)))))
    return Material(m.texture, m.texel, tinted(r, 0.3, 1.0, 0.08), detail=detail)


def column(p: Place, radius: float, height: float, m: Material) -> None:
    """A shaft between a base and a capital."""
    p.box((-1.4 * radius, -1.4 * radius, 0), (1.4 * radius, 1.4 * radius, 0.8 * radius), m)
    p.drum((0, 0, 0.5 * height), radius, 0.5 * height, m)
    p.drum((0, 0, height - radius), 1.25 * radius, 0.3 * radius, m)
    p.box((-1.5 * radius, -1.5 * radius, height - 0.6 * radius), (1.5 * radius, 1.5 * radius, height), m)


def arch(p: Place, radius: float, z: float, thick: float, m: Material) -> None:
    """A half ring of tube over the x axis at height z, its middle at y = 0."""
    angles = np.linspace(0, np.pi, 9)
    p.tube([(radius * np.cos(a), 0.0, z + radius * np.sin(a)) for a in angles], thick, m)


def statue(p: Place, height: float, m: Material) -> None:
    """A figure of ellipsoids on a plinth."""
    r, h = p.rng, height
    w = 0.2 * h * float(r.uniform(0.8, 1.4))
    p.box((-w, -w, 0), (w, w, 0.3 * h), m)
    p.ball((0, 0, 0.5 * h), (0.12 * h, 0.1 * h, 0.22 * h), m)
    p.ball((0, 0, 0.72 * h), (0.14 * h, 0.09 * h, 0.14 * h), m)
    p.ball((0.02 * h, -0.02 * h, 0.91 * h), (0.06 * h, 0.07 * h, 0.08 * h), m)
    for side in (-1, 1):
        x, y, z = side * 0.18 * h, float(r.uniform(-0.2, 0.05)) * h, float(r.uniform(0.5, 0.8)) * h
        p.tube([(side * 0.13 * h, 0, 0.8 * h), (x, 0.3 * y, 0.66 * h), (0.6 * x, y, z)], 0.035 * h, m)
    for _ in range(int(r.integers(0, 7))):
        at = r.normal(0, 0.08, 3) * h + [0, 0, 0.55 * h]
        p.ball(tuple(at), tuple(r.uniform(0.03, 0.12, 3) * h), m)


def fountain(p: Place, m: Material) -> None:
    """A basin with stacked bowls, scrolls and balls against a wall or free."""
    r = p.rng
    w, h = float(r.uniform(0.7, 1.6)), float(r.uniform(0.35, 0.6))
    for x0, y0, x1, y1 in (
        (-w, -w, w, -w + 0.15),
        (-w, 0, w, 0.15),
        (-w, -w, -w + 0.15, 0),
        (w - 0.15, -w, w, 0),
    ):
        p.box((x0, y0, 0), (x1, y1, h), m)
    p.box((-w - 0.06, -w - 0.06, h), (w + 0.06, -w + 0.2, h + 0.08), m)
    p.box((-w, -w, 0.1), (w, 0, 0.6 * h), lacquer(r))
    z, half = h, w
    for _ in range(int(r.integers(2, 6))):
        tall = float(r.uniform(0.2, 0.7))
        half *= float(r.uniform(0.6, 0.95))
        p.box((-half, -0.15 * half, z), (half, 0.3, z + tall), m)
        p.box((-1.1 * half, -0.25 * half, z + tall), (1.1 * half, 0.35, z + tall + 0.07), m)
        for side in (-1, 1):
            what, at = r.random(), (side * half, -0.1 * half, z + 0.5 * tall)
            if what < 0.4:
                p.ball(at, (0.2 * half, 0.25 * half, 0.4 * tall), m)
            elif what < 0.7:
                p.rod((at[0], at[1] - 0.2, at[2]), (at[0], at[1] + 0.2, at[2]), 0.35 * tall, m)
            else:
                column(p.inner((side * 0.8 * half, -0.3 * half, z)), 0.08 * half, tall, m)
        if r.random() < 0.7:
            arch(p.inner((0, -0.2 * half, 0)), 0.5 * half, z + 0.2 * tall, 0.06 * half, m)
        p.ball(
            (0, -0.15 * half, z + 0.5 * tall), tuple(r.uniform(0.1, 0.3, 3) * half), stuff(r, "any", (1, 4))
        )
        z += tall + 0.07
    statue(p.inner((0, 0, z)), float(r.uniform(0.4, 1.0)), m)


def portal(p: Place, width: float, height: float, depth: float, m: Material) -> None:
    """Nested frames that step back to a door, with arches above and steps below; the wall is at y = 0."""
    r = p.rng
    rings, round_ = int(r.integers(2, 7)), r.random() < 0.6
    for k in range(rings):
        share = k / rings
        w, y = width * (1 - 0.45 * share), depth * share
        step = 0.45 * width / rings
        for side in (-1, 1):
            if r.random() < 0.5:
                p.drum((side * (w - step / 2), y, height / 2), step / 2, height / 2, m)
            else:
                p.box((side * (w - step), y - step / 2, 0), (side * w, y + step, height), m)
        if round_:
            arch(p.inner((0, y, 0)), w - step / 2, height, 0.55 * step, m)
        else:
            p.box((-w, y - step / 2, height), (w, y + step, height + step), m)
    w = 0.6 * width
    p.box((-width, depth, height), (width, depth + 0.1, height + (width if round_ else 0.1)), m)
    p.box(
        (-w, depth, 0),
        (w, depth + 0.05, height),
        stuff(r, str(r.choice(["wood", "keys", "slats"])), (0.4, 1.5)),
    )
    for k in range(int(r.integers(0, 5))):
        p.box((-width - 0.3 * k, -0.35 * (k + 1), -0.16 * (k + 1)), (width + 0.3 * k, depth, -0.16 * k), m)


def backdrop(b: Builder, near: float) -> None:
    """Ground, and houses and trees far away on all sides."""
    r = b.rng
    p = Place(b, (0, 0, 0))
    ground = stuff(r, str(r.choice(["stone", "leaves", "carpet", "any", "plain"])), (0.15, 0.8))
    p.box((-90, -90, -3), (90, 90, -0.8), ground)
    p.box((-40, -40, -0.9), (40, 3 + 40 * float(r.random() < 0.5), 0.0), ground)
    for _ in range(int(r.integers(2, 9))):
        turn, far = float(r.uniform(0, 2 * np.pi)), near * float(np.exp(r.uniform(0.3, 2.2)))
        spot = p.inner((far * np.cos(turn), far * np.sin(turn), 0), turn + float(r.normal(0, 0.4)))
        w, h = far * float(r.uniform(0.15, 0.6)), far * float(r.uniform(0.1, 0.6))
        if r.random() < 0.65:
            m = masonry(b)
            house(spot.inner((0, w, 0), -np.pi / 2), 2 * w, h, m)
        else:
            spot.rod((0, 0, 0), (0, 0, h), 0.06 * h, stuff(r, "wood", (0.5, 2)))
            for _ in range(6):
                x, y, z = r.normal(0, 0.25 * h, 3)
                spot.ball((x, y, h + z), tuple(r.uniform(0.2, 0.45, 3) * h), stuff(r, "leaves", (0.3, 1.5)))


def house(p: Place, width: float, height: float, m: Material) -> None:
    """A block with rows of shallow windows on its front, which runs along x from 0, and a roof's edge."""
    r = p.rng
    p.box((0, 0, 0), (width, 0.5 * width, height), m)
    glass, trim = lacquer(r), lacquer(r)
    nx, nz = int(r.integers(1, 5)), int(r.integers(1, 4))
    for i in range(nx):
        for k in range(nz):
            x, z = width * (i + 0.3) / nx, height * (k + 0.3) / nz
            w, h = 0.4 * width / nx, 0.5 * height / nz
            p.box((x - 0.06 * w, -0.03, z - 0.06 * h), (x + 1.06 * w, 0.05, z + 1.06 * h), trim)
            p.box((x, -0.04, z), (x + w, 0.05, z + h), glass)
    p.box((-0.1, -0.03 * height, height), (width + 0.1, 0.5 * width, height * 1.04), trim)


def sunlight(b: Builder, front: float = -np.pi / 2) -> Light:
    """Sun from a direction within a right angle of ``front``, or a dull sky; always some from all sides."""
    r = b.rng
    a, up = front + float(r.uniform(-1.7, 1.7)), float(np.tan(np.deg2rad(r.uniform(15, 70))))
    power = float(r.choice([0.08, r.uniform(0.4, 1.6)], p=[0.35, 0.65]))
    lights = 300 * np.array([[np.cos(a), np.sin(a), up], [np.cos(a + 2), np.sin(a + 2), 1.0]])
    sky = r.uniform(0.7, 2) * np.array([r.uniform(0.5, 1), r.uniform(0.75, 1), 1])
    lean = np.array([0.3 * r.normal(), 0.3 * r.normal(), r.uniform(0.1, 0.5)])
    softness = float(r.uniform(0.001, 0.003))
    clouds = pick(r, "cloud") if r.random() < 0.6 else -1
    weak = [r.uniform(0.0, 0.15), 0.0]
    return Light(
        lights,
        float(r.uniform(0.25, 0.6)),
        sky,
        np.array([[power, 0], weak]),
        int(power > 0.1),
        softness,
        lean,
        clouds,
    )


def _openings(r: np.random.Generator, width: float, height: float) -> list[Hole]:
    """Windows side by side."""
    count = int(r.integers(1, 5))
    each = width / count
    w, z0, z1 = each * r.uniform(0.25, 0.6), height * r.uniform(0.1, 0.4), height * r.uniform(0.55, 0.9)
    return [((i + 0.5) * each - w / 2, (i + 0.5) * each + w / 2, z0, z1) for i in range(count)]


def building(b: Builder) -> tuple[Vec, Vec, Light]:
    """A façade with windows in recesses, columns, ledges, portals, reliefs and fountains before it."""
    r = b.rng
    width, thick, m = float(r.uniform(4, 14)), float(r.uniform(0.2, 0.7)), masonry(b)
    floors, tall = int(r.integers(1, 3)), float(r.uniform(2.8, 5))
    second = masonry(b) if r.random() < 0.6 else m
    backdrop(b, 12)
    base = Place(b, (-width / 2, 0, 0))
    trim = masonry(b) if r.random() < 0.5 else lacquer(r)
    for k in range(floors):
        p = base.inner((0, 0, k * tall))
        holes = _openings(r, width, tall) if r.random() < 0.75 else []
        wall(p, width, tall, thick, holes, m)
        for hole in holes:
            (door if r.random() < 0.1 and hole[2] < 0.3 else frame)(p, hole, thick, trim)
        if r.random() < 0.7:
            reach = float(r.uniform(0.05, 0.35))
            p.box((-0.1, -reach, tall - 0.2), (width + 0.1, 0.1, tall), second)
            p.box((-0.1, -0.5 * reach, tall - 0.35), (width + 0.1, 0.1, tall - 0.2), second)
    base.box((0, thick + 1.5, 0), (width, thick + 1.7, floors * tall), lacquer(r))
    kind = r.random()
    middle = base.inner((float(r.uniform(0.3, 0.7)) * width, 0, 0))
    if kind < 0.35:
        portal(middle.inner((0, -0.3, 0)), float(r.uniform(0.9, 1.8)), float(r.uniform(1.8, 3)), 0.29, second)
    elif kind < 0.6:
        fountain(middle.inner((0, -0.35, 0)), second)
    elif kind < 0.85:
        count, radius = int(r.integers(2, 7)), float(r.uniform(0.12, 0.35))
        for i in range(count):
            column(
                base.inner((width * (i + 0.5) / count, -float(r.uniform(0.4, 0.5)) - radius, 0)),
                radius,
                tall,
                second,
            )
        if r.random() < 0.5:
            span = width / count
            for i in range(count - 1):
                arch(
                    base.inner((width * (i + 1) / count, -0.45 - radius, 0)),
                    0.5 * span,
                    tall,
                    0.6 * radius,
                    second,
                )
    for _ in range(int(r.integers(0, 14))):
        x, z = float(r.uniform(0, width)), float(r.uniform(0.3, floors * tall))
        size = tuple(np.exp(r.uniform(np.log(0.05), np.log(0.4), 3)))
        base.put(ELLIPSOID if r.random() < 0.5 else BOX, (x, -0.02, z), size, second)
    _street(b, width)
    eye = np.array([r.uniform(-0.5, 0.5) * width, -r.uniform(2.5, 9), r.uniform(1.2, 2.2)])
    target = np.array([r.uniform(-0.4, 0.4) * width, 0, r.uniform(0.6, 0.9 * tall * floors)])
    return eye, target, sunlight(b)


def _street(b: Builder, width: float) -> None:
    """Statues, bollards, benches, lamps and bins before a façade."""
    r = b.rng
    for _ in range(int(r.integers(0, 6))):
        p = Place(b, (r.uniform(-0.6, 0.6) * width, -r.uniform(0.6, 3), 0), float(r.uniform(0, 6)))
        what, m = r.random(), furniture.metal(Place(b, (0, 0, 0)))
        if what < 0.25:
            statue(p, float(r.uniform(0.8, 2.2)), masonry(b))
        elif what < 0.45:
            p.drum((0, 0, 0.4), 0.08, 0.4, m)
            p.ball((0, 0, 0.85), (0.1, 0.1, 0.1), m)
        elif what < 0.6:
            p.rod((0, 0, 0), (0, 0, 3.0), 0.05, m)
            p.ball((0, 0, 3.1), (0.2, 0.2, 0.25), m)
        elif what < 0.8:
            p.box((-0.8, -0.2, 0.4), (0.8, 0.2, 0.46), furniture.board(p))
            for x in (-0.7, 0.7):
                p.box((x - 0.04, -0.2, 0), (x + 0.04, 0.2, 0.4), m)
        else:
            furniture.things(p, (0.4, 0.4), 0, 3, (0.1, 0.4))


def monument(b: Builder) -> tuple[Vec, Vec, Light]:
    """A statue, a fountain or a pile of forms in the open, houses and sky behind."""
    r = b.rng
    m = masonry(b)
    backdrop(b, 6)
    p = Place(b, (0, 0, 0), float(r.uniform(0, 6.28)))
    what = r.random()
    if what < 0.35:
        for k in range(int(r.integers(0, 4))):
            w = 1.4 - 0.3 * k
            p.box((-w, -w, 0.18 * k), (w, w, 0.18 * (k + 1)), m)
        statue(p.inner((0, 0, 0.4)), float(r.uniform(1.0, 2.5)), m if r.random() < 0.5 else masonry(b))
    elif what < 0.65:
        fountain(p, m)
    else:
        furniture.things(p, (0.8, 0.8), 0, int(r.integers(4, 12)), (0.08, 0.5))
        for _ in range(int(r.integers(0, 4))):
            furniture.chair(p.inner((*r.normal(0, 0.8, 2), 0), float(r.uniform(0, 6))))
    a, far = float(r.uniform(0, 6.28)), float(r.uniform(2.0, 4.5))
    eye = np.array([far * np.cos(a), far * np.sin(a), r.uniform(0.7, 2.2)])
    return eye, np.array([0, 0, r.uniform(0.5, 1.2)]), sunlight(b, a)
