"""A small ray tracer over boxes, ellipsoids and cylinders: exact depth, textured and shadowed colour.

Everything is analytic, so a depth is right to float precision, and one 192×144 view of forty
primitives takes some tens of milliseconds on one core.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

BOX, ELLIPSOID, CYLINDER, ROOM = 0, 1, 2, 3
"""Kinds of primitive. A room is a box seen from inside: rays hit where they leave it."""

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
        lights: (L, 3) positions; the first casts shadows.
        ambient: share of the light that comes from everywhere.
        sky: (3,) colour where nothing is hit.
        mips: :func:`mipmaps` of the textures.
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


def mipmaps(atlas: Floats) -> NDArray[np.uint8]:
    """All levels of (T, S, S, 3) textures, finest first, as 8-bit texels (T, S² · 4/3, 3)."""
    levels = [atlas]
    while levels[-1].shape[1] > 1:
        a = levels[-1]
        levels.append((a[:, ::2, ::2] + a[:, 1::2, ::2] + a[:, ::2, 1::2] + a[:, 1::2, 1::2]) / 4)
    texels = np.concatenate([a.reshape(len(a), -1, 3) for a in levels], 1)
    return (255 * texels + 0.5).astype(np.uint8)


@njit(cache=True, fastmath=True)
def _box(o, d, inside):  # type: ignore[no-untyped-def]
    """Entry (or exit, from inside) distance and face of the unit box; (inf, 0) for a miss."""
    near, far, face_near, face_far = -1e30, 1e30, 0, 0
    for a in range(3):
        if abs(d[a]) < 1e-9:
            if abs(o[a]) > 1.0:
                return 1e30, 0
            continue
        t1, t2 = (-1.0 - o[a]) / d[a], (1.0 - o[a]) / d[a]
        f1, f2 = 2 * a, 2 * a + 1
        if t1 > t2:
            t1, t2, f1, f2 = t2, t1, f2, f1
        if t1 > near:
            near, face_near = t1, f1
        if t2 < far:
            far, face_far = t2, f2
    if near > far:
        return 1e30, 0
    if inside:
        return (far, face_far) if far > 1e-4 else (1e30, 0)
    return (near, face_near) if near > 1e-4 else (1e30, 0)


@njit(cache=True, fastmath=True)
def _quadric(o, d, cylinder):  # type: ignore[no-untyped-def]
    """First hit of the unit sphere, or of the unit cylinder along z with its caps (faces 4 and 5)."""
    n = 2 if cylinder else 3
    a = b = c = 0.0
    for i in range(n):
        a += d[i] * d[i]
        b += o[i] * d[i]
        c += o[i] * o[i]
    disc = b * b - a * (c - 1.0)
    best, face = 1e30, 0
    if disc > 0 and a > 1e-12:
        t = (-b - np.sqrt(disc)) / a
        if t > 1e-4 and (not cylinder or abs(o[2] + t * d[2]) <= 1.0):
            best = t
    if cylinder and abs(d[2]) > 1e-9:
        for side in range(2):
            t = ((2.0 * side - 1.0) - o[2]) / d[2]
            x, y = o[0] + t * d[0], o[1] + t * d[1]
            if 1e-4 < t < best and x * x + y * y <= 1.0:
                best, face = t, 4 + side
    return best, face


@njit(cache=True, fastmath=True)
def _local(rotation, centre, half, origin, direction, o, d):  # type: ignore[no-untyped-def]
    """Ray in the frame in which the primitive is a unit one; the ray parameter is unchanged."""
    for i in range(3):
        so = sd = 0.0
        for j in range(3):
            so += rotation[i, j] * (origin[j] - centre[j])
            sd += rotation[i, j] * direction[j]
        o[i], d[i] = so / half[i], sd / half[i]


@njit(cache=True, fastmath=True)
def _nearest(scene, origin, direction, limit, o, d):  # type: ignore[no-untyped-def]
    """Distance, primitive and face of the first hit before ``limit``; primitive −1 for none.

    A primitive whose bounding sphere the ray misses is skipped.
    """
    kind, rotation, centre, half = scene.kind, scene.rotation, scene.centre, scene.half
    best, hit, face = limit, -1, 0
    norm = direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2
    for p in range(kind.shape[0]):
        if kind[p] != ROOM:
            across = dist = reach = 0.0
            for i in range(3):
                c = centre[p, i] - origin[i]
                across += c * direction[i]
                dist += c * c
                reach += half[p, i] ** 2
            if dist > reach and (across < 0 or dist - across * across / norm > reach):
                continue
        _local(rotation[p], centre[p], half[p], origin, direction, o, d)
        if kind[p] == BOX or kind[p] == ROOM:
            t, f = _box(o, d, kind[p] == ROOM)
        else:
            t, f = _quadric(o, d, kind[p] == CYLINDER)
        if t < best:
            best, hit, face = t, p, f
    return best, hit, face


@njit(cache=True, fastmath=True)
def _surface(kind, half, face, q, normal, uv):  # type: ignore[no-untyped-def]
    """Object-frame normal and metric texture coordinates at the unit-frame point ``q``."""
    if kind == BOX or kind == ROOM:
        axis = face // 2
        for i in range(3):
            normal[i] = 0.0
        normal[axis] = (1.0 if face % 2 else -1.0) * (-1.0 if kind == ROOM else 1.0)
        uv[0] = q[(axis + 1) % 3] * half[(axis + 1) % 3]
        uv[1] = q[(axis + 2) % 3] * half[(axis + 2) % 3]
    elif kind == CYLINDER and face >= 4:
        normal[0], normal[1], normal[2] = 0.0, 0.0, (1.0 if face == 5 else -1.0)
        uv[0], uv[1] = q[0] * half[0], q[1] * half[1]
    else:
        for i in range(3):
            normal[i] = q[i] / half[i] if (kind == ELLIPSOID or i < 2) else 0.0
        n = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        for i in range(3):
            normal[i] /= n
        uv[0] = np.arctan2(q[1], q[0]) * half[0]
        uv[1] = np.arcsin(min(1.0, max(-1.0, q[2]))) * half[2] if kind == ELLIPSOID else q[2] * half[2]


@njit(cache=True, fastmath=True)
def _texture(texels, u, v, level, rgb):  # type: ignore[no-untyped-def]
    """Bilinear, wrapped lookup at the nearest level of one texture's pyramid."""
    size = int(np.sqrt(texels.shape[0] * 0.75))
    lv, start = int(level + 0.5), 0
    while lv > 0 and size > 1:
        start += size * size
        size //= 2
        lv -= 1
    x, y = u * size - 0.5, v * size - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    xa, xb, ya, yb = x0 % size, (x0 + 1) % size, (y0 % size) * size + start, ((y0 + 1) % size) * size + start
    for c in range(3):
        top = texels[ya + xa, c] * (1 - fx) + texels[ya + xb, c] * fx
        bottom = texels[yb + xa, c] * (1 - fx) + texels[yb + xb, c] * fx
        rgb[c] = (top * (1 - fy) + bottom * fy) / 255.0


@njit(cache=True, fastmath=True)
def _lighting(scene, p, point, normal, view, work):  # type: ignore[no-untyped-def]
    """Diffuse light and highlight at a surface point, seen along the unit vector ``view``."""
    to_light, o, d = work[0], work[1], work[2]
    light, shine = scene.ambient, 0.0
    for k in range(scene.lights.shape[0]):
        dist = lambert = 0.0
        for i in range(3):
            to_light[i] = scene.lights[k, i] - point[i]
            dist += to_light[i] ** 2
        dist = np.sqrt(dist) + 1e-6
        for i in range(3):
            lambert += to_light[i] / dist * normal[i]
        if lambert <= 0:
            continue
        if k == 0:
            _, blocker, _ = _nearest(scene, point, to_light, 1.0, o, d)
            if blocker >= 0 and scene.kind[blocker] != ROOM:
                continue
        light += (1 - scene.ambient) * lambert / scene.lights.shape[0] * 1.6
        if scene.gloss[p] > 0:
            along = norm = 0.0
            for i in range(3):
                h = to_light[i] / dist - view[i]
                along += h * normal[i]
                norm += h * h
            shine += scene.gloss[p] * max(0.0, along / np.sqrt(norm + 1e-9)) ** 40
    return light, shine


@njit(cache=True, fastmath=True)
def _add_color(scene, origin, ray, hit, pixel_angle, work, out):  # type: ignore[no-untyped-def]
    """Add the colour of a hit (distance, primitive, face) to ``out``."""
    t, p, face = hit
    o, d, q, normal, uv, rgb, point, view = (
        work[0],
        work[1],
        work[3],
        work[4],
        work[5],
        work[6],
        work[7],
        work[8],
    )
    rotation, world = scene.rotation[p], work[9]
    _local(rotation, scene.centre[p], scene.half[p], origin, ray, o, d)
    length = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
    for i in range(3):
        q[i] = o[i] + t * d[i]
        view[i] = ray[i] / length
    _surface(scene.kind[p], scene.half[p], face, q, normal, uv)
    facing = 0.0
    for i in range(3):
        world[i] = rotation[0, i] * normal[0] + rotation[1, i] * normal[1] + rotation[2, i] * normal[2]
        facing -= world[i] * view[i]
    for i in range(3):
        point[i] = origin[i] + t * ray[i] + 1e-3 * world[i]
    texel, size = scene.texel[p], np.sqrt(scene.mips.shape[1] * 0.75)
    level = np.log2(max(1e-6, t * pixel_angle * texel * size / max(0.15, facing)))
    _texture(scene.mips[scene.texture[p, face]], uv[0] * texel, uv[1] * texel, level, rgb)
    light, shine = _lighting(scene, p, point, world, view, work)
    for c in range(3):
        out[c] += rgb[c] * scene.tint[p, c] * light + shine


@njit(cache=True, fastmath=True, parallel=True)
def _trace(scene, inv_k, pose, shape, samples):  # type: ignore[no-untyped-def]
    """Colour (H, W, 3) from samples² rays a pixel and depth (H, W) of the centre ray; 0 is sky."""
    height, width = shape
    color = np.zeros((height, width, 3), np.float32)
    depth = np.zeros((height, width), np.float32)
    pixel_angle = inv_k[0, 0] / samples
    for row in prange(height):
        work, ray, origin = np.empty((10, 3)), np.empty(3), pose[:3, 3].copy()
        for col in range(width):
            for s in range(samples * samples + 1):
                middle = s == samples * samples
                dx = 0.5 if middle else (s % samples + 0.5) / samples
                dy = 0.5 if middle else (s // samples + 0.5) / samples
                x, y = inv_k[0, 0] * (col + dx) + inv_k[0, 2], inv_k[1, 1] * (row + dy) + inv_k[1, 2]
                for i in range(3):
                    ray[i] = pose[i, 0] * x + pose[i, 1] * y + pose[i, 2]
                t, p, face = _nearest(scene, origin, ray, 1e4, work[0], work[1])
                if middle:
                    depth[row, col] = t if p >= 0 else 0.0
                elif p < 0:
                    color[row, col] += scene.sky
                else:
                    _add_color(scene, origin, ray, (t, p, face), pixel_angle, work, color[row, col])
            color[row, col] /= samples * samples
    return color, depth


def render(
    scene: Scene, K: Floats, world_from_cam: Floats, shape: tuple[int, int], samples: int = 2
) -> tuple[Floats, Floats]:
    """One view of a scene.

    Args:
        scene: what to render.
        K: (3, 3) intrinsics in pixels, centre of the first pixel at (0.5, 0.5).
        world_from_cam: (4, 4).
        shape: (H, W).
        samples: rays a pixel along each axis.

    Returns:
        Linear colour (H, W, 3), about [0, 1], and camera z (H, W), 0 for sky.
    """
    inverse = np.linalg.inv(K.astype(np.float64))
    color, depth = _trace(scene, inverse, world_from_cam.astype(np.float64), shape, samples)
    return color, depth
