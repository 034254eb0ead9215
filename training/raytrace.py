"""A small ray tracer over boxes, ellipsoids and cylinders: exact depth, textured and shadowed colour.

Everything is analytic, so a depth is right to float precision, and one 256×192 view of two hundred
primitives takes some forty milliseconds on one core. Compiled code is cached by file: after a change
in ``intersect.py``, remove ``training/__pycache__``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from training.intersect import BOX, CYLINDER, ELLIPSOID, ROOM, local, nearest, one, tree

__all__ = ["BOX", "CYLINDER", "ELLIPSOID", "ROOM", "Floats", "Scene", "mipmaps", "render"]

Floats = NDArray[np.float32]


class Scene(NamedTuple):
    """P primitives, their materials and the light.

    Attributes:
        kind: (P,) int32, one of the constants above.
        rotation: (P, 3, 3) object_from_world.
        centre: (P, 3), world.
        half: (P, 3) half sizes along the object's axes.
        texture: (P, 6) int32 texture of each face (one used where there are no faces).
        texel: (P,) textures a unit of length.
        tint: (P, 3) factor on the texture, linear RGB.
        gloss: (P,) weight of the mirror-like highlight.
        lights: (L, 3) positions.
        ambient: share of the light that comes from everywhere.
        sky: (3,) colour where nothing is hit.
        mips: :func:`mipmaps` of the textures.
        power: (L, 2) brightness of each light, and the distance at which it has halved (0: never).
            None: equal shares of 1.6 · (1 − ambient), never less.
        shadows: number of lights, from the first, that cast shadows.
        softness: radius of these lights as a share of their distance.
        lean: (3,) how much more ambient light there is on surfaces that face along it.
        detail: (P, 3) a second texture that scales the first: its number, its amplitude about one, and
            its textures a unit of length. None: none.
        glow: (P,) light that a surface gives off itself, in units of its colour. None: none.
        mirror: (P,) share of the light from ahead that is reflected as by glass. None: none.
        offset: (P, 2) where the texture coordinates start, as lengths. None: zero.
        clouds: texture that scales the colour of the sky by direction, or −1.
        upright: the texture's second axis is z on all vertical faces of boxes; otherwise only on two.
        side: texels along a side of the finest level. One too few makes the pattern lean by a texel a row,
            as in the published pictures of the demo. 0: the true number.
    """

    kind: NDArray[np.int32]
    rotation: Floats
    centre: Floats
    half: Floats
    texture: NDArray[np.int32]
    texel: Floats
    tint: Floats
    gloss: Floats
    lights: Floats
    ambient: float
    sky: Floats
    mips: NDArray[np.uint8]
    power: Floats | None = None
    shadows: int = 1
    softness: float = 0.0
    lean: Floats | None = None
    detail: Floats | None = None
    glow: Floats | None = None
    mirror: Floats | None = None
    offset: Floats | None = None
    clouds: int = -1
    upright: bool = False
    side: int = 0


class _Packed(NamedTuple):
    """A scene in few arrays, since compiled functions pay for each array that they are handed.

    Attributes:
        look: (P, 32) of each primitive: textures of the faces (6), texel, tint (3), gloss, detail (3), glow,
            mirror, offset (2), half sizes (3), rotation (9), kind, one column to spare.
        lights: (L, 5) position, power, reach.
        world: (12,) ambient, sky (3), lean (3), shadows, softness, clouds, upright, side.
        mips: as in :class:`Scene`.
    """

    look: NDArray[np.float64]
    lights: NDArray[np.float64]
    world: NDArray[np.float64]
    mips: NDArray[np.uint8]


def _packed(scene: Scene) -> _Packed:
    """The scene with zeros, or what they stand for, in the place of every None."""
    count, lights = len(scene.kind), len(scene.lights)
    same = np.tile([1.6 * (1 - scene.ambient) / lights, 0.0], (lights, 1))
    power = same if scene.power is None else scene.power
    detail = np.zeros((count, 3)) if scene.detail is None else scene.detail
    glow, mirror = (np.zeros(count) if a is None else a for a in (scene.glow, scene.mirror))
    offset = np.zeros((count, 2)) if scene.offset is None else scene.offset
    lean = np.zeros(3) if scene.lean is None else scene.lean
    side = scene.side or round(np.sqrt(scene.mips.shape[1] * 0.75))
    columns = (
        scene.texture, scene.texel, scene.tint, scene.gloss, detail, glow, mirror, offset, scene.half,
        scene.rotation, scene.kind, np.zeros(count),
    )  # fmt: skip
    look = np.concatenate([np.asarray(a, np.float64).reshape(count, -1) for a in columns], 1)
    rest = [scene.shadows, scene.softness, scene.clouds, scene.upright, side]
    world = np.concatenate([[scene.ambient], scene.sky, lean, rest]).astype(np.float64)
    return _Packed(look, np.concatenate([scene.lights, power], 1).astype(np.float64), world, scene.mips)


def mipmaps(atlas: Floats) -> NDArray[np.uint8]:
    """All levels of (T, S, S, 3) textures, finest first, as 8-bit texels (T, S² · 4/3, 3)."""
    levels = [atlas]
    while levels[-1].shape[1] > 1:
        a = levels[-1]
        levels.append((a[:, ::2, ::2] + a[:, 1::2, ::2] + a[:, ::2, 1::2] + a[:, 1::2, 1::2]) / 4)
    texels = np.concatenate([a.reshape(len(a), -1, 3) for a in levels], 1)
    return (255 * texels + 0.5).astype(np.uint8)


@njit(cache=True, fastmath=True, nogil=True)
def _surface(look, p, face, upright, q):  # type: ignore[no-untyped-def]
    """Object-frame normal and metric texture coordinates at the unit-frame point ``q``."""
    kind, a, b, c = int(look[p, 30]), look[p, 18], look[p, 19], look[p, 20]
    if kind == BOX or kind == ROOM:
        sign = (1.0 if face % 2 else -1.0) * (-1.0 if kind == ROOM else 1.0)
        if face < 2:
            return (sign, 0.0, 0.0), q[1] * b, q[2] * c
        if face < 4:
            return (0.0, sign, 0.0), (q[0] * a if upright else q[2] * c), (q[2] * c if upright else q[0] * a)
        return (0.0, 0.0, sign), q[0] * a, q[1] * b
    if kind == CYLINDER and face >= 4:
        return (0.0, 0.0, 1.0 if face == 5 else -1.0), q[0] * a, q[1] * b
    x, y, z = q[0] / a, q[1] / b, (q[2] / c if kind == ELLIPSOID else 0.0)
    n = np.sqrt(x * x + y * y + z * z)
    v = np.arcsin(min(1.0, max(-1.0, q[2]))) * c if kind == ELLIPSOID else q[2] * c
    return (x / n, y / n, z / n), np.arctan2(q[1], q[0]) * a, v


@njit(cache=True, fastmath=True, nogil=True)
def _texture(mips, which, size, u, v, level):  # type: ignore[no-untyped-def]
    """Bilinear, wrapped lookup at the nearest level of a texture's pyramid whose finest side is ``size``."""
    lv, start = int(level + 0.5), 0
    while lv > 0 and size > 1:
        start += size * size
        size //= 2
        lv -= 1
    x, y = u * size - 0.5, v * size - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    xa, xb, ya, yb = x0 % size, (x0 + 1) % size, (y0 % size) * size + start, ((y0 + 1) % size) * size + start
    aa, ab = (1 - fx) * (1 - fy) / 255.0, fx * (1 - fy) / 255.0
    ba, bb = (1 - fx) * fy / 255.0, fx * fy / 255.0
    r = mips[which, ya + xa, 0] * aa + mips[which, ya + xb, 0] * ab
    g = mips[which, ya + xa, 1] * aa + mips[which, ya + xb, 1] * ab
    b = mips[which, ya + xa, 2] * aa + mips[which, ya + xb, 2] * ab
    r += mips[which, yb + xa, 0] * ba + mips[which, yb + xb, 0] * bb
    g += mips[which, yb + xa, 1] * ba + mips[which, yb + xb, 1] * bb
    b += mips[which, yb + xa, 2] * ba + mips[which, yb + xb, 2] * bb
    return r, g, b


@njit(cache=True, fastmath=True, nogil=True)
def _scatter(jitter, axis, k):  # type: ignore[no-untyped-def]
    """Offset in [−1, 1) along an axis towards a part of light ``k``; a pixel's four rays share it out."""
    x = ((jitter >> 2) * 73856093) ^ ((axis + 1) * 19349663) ^ (k * 83492791)
    x = ((x & 0xFFFFFFFF) ^ ((x & 0xFFFFFFFF) >> 13)) * 1274126177 & 0xFFFFFFFF
    part = ((x ^ (x >> 15)) & 0xFFFF) / 65536.0
    return (jitter >> axis & 1) + part - 1.0


@njit(cache=True, fastmath=True, nogil=True)
def _lighting(scene, tree, gloss, jitter, where, stack):  # type: ignore[no-untyped-def]
    """Diffuse light and highlight ``where`` (point, normal, unit view vector); no shadows if jitter < 0."""
    world, lights = scene.world, scene.lights
    point, normal, view = where
    light, shine = 1 + world[4] * normal[0] + world[5] * normal[1] + world[6] * normal[2], 0.0
    light *= world[0]
    for k in range(lights.shape[0]):
        x, y, z = lights[k, 0] - point[0], lights[k, 1] - point[1], lights[k, 2] - point[2]
        dist = np.sqrt(x * x + y * y + z * z) + 1e-6
        if world[8] > 0 and jitter >= 0:
            spread = world[8] * dist
            x, y = x + spread * _scatter(jitter, 0, k), y + spread * _scatter(jitter, 1, k)
            z -= spread * _scatter(jitter, 0, k)
        lambert = (x * normal[0] + y * normal[1] + z * normal[2]) / dist
        if lambert <= 0:
            continue
        power = lights[k, 3]
        if lights[k, 4] > 0:
            power *= lights[k, 4] ** 2 / (lights[k, 4] ** 2 + dist * dist)
        dark = k < world[7] and jitter >= 0
        if dark and nearest(tree, point, (x, y, z), 1.0, True, stack)[1] >= 0:
            continue
        light += power * lambert
        if gloss > 0:
            hx, hy, hz = x / dist - view[0], y / dist - view[1], z / dist - view[2]
            along = hx * normal[0] + hy * normal[1] + hz * normal[2]
            shine += gloss * max(0.0, along / np.sqrt(hx * hx + hy * hy + hz * hz + 1e-9)) ** 40
    return light, shine


@njit(cache=True, fastmath=True, nogil=True)
def _sky(scene, way):  # type: ignore[no-untyped-def]
    """The sky's colour along a ray."""
    world, rgb = scene.world, (1.0, 1.0, 1.0)
    if world[9] >= 0:
        flat = np.sqrt(way[0] ** 2 + way[1] ** 2) + 1e-9
        u, v = np.arctan2(way[1], way[0]) * 0.7, np.arctan2(way[2], flat)
        rgb = _texture(scene.mips, int(world[9]), int(world[11]), u, v, 1.0)
    return world[1] * rgb[0], world[2] * rgb[1], world[3] * rgb[2]


@njit(cache=True, fastmath=True, nogil=True)
def _color(scene, tree, ray, hit, pixel_angle, jitter, stack):  # type: ignore[no-untyped-def]
    """Colour of a hit (distance, primitive, face) on a ray (origin, direction), and where it is.

    Returns the colour, and the point, the normal and the unit view vector there.
    """
    look, mips, side = scene.look, scene.mips, int(scene.world[11])
    t, p, face = hit
    origin, way = ray
    o, d = local(tree.shapes, p, origin, way)
    q = (o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2])
    n, u, v = _surface(look, p, face, scene.world[10] > 0, q)
    u, v = u + look[p, 16], v + look[p, 17]
    normal = (
        look[p, 21] * n[0] + look[p, 24] * n[1] + look[p, 27] * n[2],
        look[p, 22] * n[0] + look[p, 25] * n[1] + look[p, 28] * n[2],
        look[p, 23] * n[0] + look[p, 26] * n[1] + look[p, 29] * n[2],
    )
    length = np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
    view = (way[0] / length, way[1] / length, way[2] / length)
    facing = -(normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2])
    point = (
        origin[0] + t * way[0] + 1e-3 * normal[0],
        origin[1] + t * way[1] + 1e-3 * normal[1],
        origin[2] + t * way[2] + 1e-3 * normal[2],
    )
    pixel, fine = t * pixel_angle * np.sqrt(mips.shape[1] * 0.75) / max(0.15, facing), 1.0
    if look[p, 12] > 0:
        texel = look[p, 13]
        level = np.log2(max(1e-6, pixel * texel))
        fine += look[p, 12] * (2 * _texture(mips, int(look[p, 11]), side, u * texel, v * texel, level)[1] - 1)
    texel = look[p, 6]
    level = np.log2(max(1e-6, pixel * texel))
    rgb = _texture(mips, int(look[p, face]), side, u * texel, v * texel, level)
    light, shine = _lighting(scene, tree, look[p, 10], jitter, (point, normal, view), stack)
    light = (light + look[p, 14]) * fine
    color = (
        rgb[0] * look[p, 7] * light + shine,
        rgb[1] * look[p, 8] * light + shine,
        rgb[2] * look[p, 9] * light + shine,
    )
    return color, (point, normal, view)


@njit(cache=True, fastmath=True, nogil=True)
def _reflected(scene, tree, mirror, where, pixel_angle, stack):  # type: ignore[no-untyped-def]
    """What a surface mirrors, by Schlick's approximation (1994) of Fresnel's equations."""
    point, n, v = where
    facing = -(n[0] * v[0] + n[1] * v[1] + n[2] * v[2])
    way = (v[0] + 2 * facing * n[0], v[1] + 2 * facing * n[1], v[2] + 2 * facing * n[2])
    share = mirror * (0.15 + 0.85 * (1 - min(1.0, max(0.0, facing))) ** 5)
    hit = nearest(tree, point, way, 1e4, False, stack)
    if hit[1] < 0:
        seen = _sky(scene, way)
    else:
        seen = _color(scene, tree, (point, way), hit, 4 * pixel_angle, -1, stack)[0]
    return share * seen[0], share * seen[1], share * seen[2]


@njit(cache=True, fastmath=True, nogil=True)
def _aim(inv_k, pose, u, v):  # type: ignore[no-untyped-def]
    """World ray of unit camera z through the pixel coordinates (u, v)."""
    x, y = inv_k[0, 0] * u + inv_k[0, 2], inv_k[1, 1] * v + inv_k[1, 2]
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2],
    )


@njit(cache=True, fastmath=True, nogil=True)
def _centres(tree, inv_k, pose, depth, what):  # type: ignore[no-untyped-def]
    """Depth (H, W) and hit (H, W), 8 · primitive + face or −1, of the rays through the pixel centres."""
    stack, origin = np.empty(100, np.int32), (pose[0, 3], pose[1, 3], pose[2, 3])
    for row in range(depth.shape[0]):
        for col in range(depth.shape[1]):
            way = _aim(inv_k, pose, col + 0.5, row + 0.5)
            t, p, face = nearest(tree, origin, way, 1e4, False, stack)
            depth[row, col] = t if p >= 0 else 0.0
            what[row, col] = 8 * p + face if p >= 0 else -1


@njit(cache=True, fastmath=True, nogil=True)
def _alone(what, row, col):  # type: ignore[no-untyped-def]
    """The hit that a pixel and its eight neighbours share, or −2."""
    for r in range(max(0, row - 1), min(what.shape[0], row + 2)):
        for c in range(max(0, col - 1), min(what.shape[1], col + 2)):
            if what[r, c] != what[row, col]:
                return -2
    return what[row, col]


@njit(cache=True, fastmath=True, nogil=True)
def _trace(scene, tree, inv_k, pose, what, samples, stride):  # type: ignore[no-untyped-def]
    """Colour (H, W, 3) from samples² rays a pixel, where ``what`` was hit at the pixels' centres.

    Inside a surface, as the centres of the neighbouring pixels tell, only that surface is tried, and only
    every ``stride``-th of the rays is cast.
    """
    height, width = what.shape
    color = np.zeros((height, width, 3), np.float32)
    pixel_angle = inv_k[0, 0] / samples
    stack, origin = np.empty(100, np.int32), (pose[0, 3], pose[1, 3], pose[2, 3])
    for row in range(height):
        for col in range(width):
            alone, rays = _alone(what, row, col), 0
            for s in range(0, samples * samples, stride if alone != -2 else 1):
                rays += 1
                across, down = (s % samples + 0.5) / samples, (s // samples + 0.5) / samples
                way = _aim(inv_k, pose, col + across, row + down)
                t, p, face = 1e30, -1, 0
                if alone >= 0:
                    t, face = one(tree.shapes, alone // 8, origin, way)
                    p = alone // 8 if t < 1e4 else -1
                if p < 0 and alone != -1:
                    t, p, face = nearest(tree, origin, way, 1e4, False, stack)
                if p < 0:
                    rgb = _sky(scene, way)
                else:
                    jitter, hit = (row * width + col) * 4 + s % 4, (t, p, face)
                    rgb, where = _color(scene, tree, (origin, way), hit, pixel_angle, jitter, stack)
                    if scene.look[p, 15] > 0:
                        more = _reflected(scene, tree, scene.look[p, 15], where, pixel_angle, stack)
                        rgb = (rgb[0] + more[0], rgb[1] + more[1], rgb[2] + more[2])
                for c in range(3):
                    color[row, col, c] += rgb[c]
            for c in range(3):
                color[row, col, c] /= rays
    return color


def render(
    scene: Scene, K: Floats, world_from_cam: Floats, shape: tuple[int, int], samples: int = 2, stride: int = 1
) -> tuple[Floats, Floats]:
    """One view of a scene.

    Args:
        scene: what to render.
        K: (3, 3) intrinsics in pixels, centre of the first pixel at (0.5, 0.5).
        world_from_cam: (4, 4).
        shape: (H, W).
        samples: rays a pixel along each axis.
        stride: within a surface, cast only every so many of them; 3 leaves the diagonal of four.

    Returns:
        Linear colour (H, W, 3), about [0, 1], and camera z (H, W), 0 for sky.
    """
    inverse, pose = np.linalg.inv(K.astype(np.float64)), world_from_cam.astype(np.float64)
    boxes = tree(scene.kind, scene.rotation, scene.centre, scene.half)
    depth, what = np.zeros(shape, np.float32), np.zeros(shape, np.int32)
    _centres(boxes, inverse, pose, depth, what)
    return _trace(_packed(scene), boxes, inverse, pose, what, samples, stride), depth
