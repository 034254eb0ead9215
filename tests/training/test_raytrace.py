"""Rendered depth against intersections computed in another way, and colours of known light."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from training.raytrace import BOX, CYLINDER, ELLIPSOID, ROOM, Scene, mipmaps, render

Floats = NDArray[np.float64]
SHAPE = (30, 40)
K = np.array([[45.0, 0, 20], [0, 45.0, 15], [0, 0, 1]], np.float32)
UPRIGHT = np.eye(4, dtype=np.float32)
SKY = (0.1, 0.2, 0.3)


def scene(
    *parts: tuple[int, Floats, Floats, Floats],
    ambient: float = 1.0,
    lights: Floats | None = None,
    texture: Floats | None = None,
) -> Scene:
    """Primitives (kind, object_from_world, centre, half) of white texture, lit from everywhere."""
    kind, rotation, centre, half = zip(*parts, strict=True)
    f, count = np.float32, len(parts)
    atlas = np.ones((1, 4, 4, 3), f) if texture is None else texture.astype(f)
    return Scene(
        np.array(kind, np.int32), np.array(rotation, f), np.array(centre, f), np.array(half, f),
        np.zeros((count, 6), np.int32), np.full(count, 0.25, f), np.ones((count, 3), f), np.zeros(count, f),
        (np.zeros((1, 3)) if lights is None else lights).astype(f), ambient, np.array(SKY, f), mipmaps(atlas),
    )  # fmt: skip


def turn(rng: np.random.Generator) -> Floats:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def camera(eye: Floats, target: Floats) -> Floats:
    """world_from_cam."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.1, 0.3, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack([x, np.cross(z, x), z, eye], -1)
    return pose


def local_rays(pose: Floats, rotation: Floats, centre: Floats, half: Floats) -> tuple[Floats, Floats]:
    """Origin (3,) and directions (H·W, 3), of unit camera z, where the primitive is a unit one."""
    y, x = np.meshgrid(np.arange(SHAPE[0]) + 0.5, np.arange(SHAPE[1]) + 0.5, indexing="ij")
    ray = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1).reshape(-1, 3)
    world = ray @ pose[:3, :3].T
    return rotation @ (pose[:3, 3] - centre) / half, world @ rotation.T / half


def smallest(candidates: list[tuple[Floats, NDArray[np.bool_]]], first: bool = True) -> Floats:
    """Of the hits (t, whether it counts) the nearest before the camera, or the furthest; 0 for none."""
    t = np.stack([np.where(good & (t > 1e-4), t, np.inf if first else -np.inf) for t, good in candidates])
    best = t.min(0) if first else t.max(0)
    return np.where(np.isfinite(best), best, 0)


def faces(o: Floats, d: Floats) -> list[tuple[Floats, NDArray[np.bool_]]]:
    """Hits of the planes of the six faces of the unit box, within the faces."""
    hits = []
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in range(3):
            others = [a for a in range(3) if a != axis]
            for side in (-1.0, 1.0):
                t = (side - o[axis]) / d[:, axis]
                hits.append((t, (np.abs(o[others] + t[:, None] * d[:, others]) <= 1).all(1)))
    return hits


def box(o: Floats, d: Floats) -> Floats:
    return smallest(faces(o, d))


def inside_of_a_box(o: Floats, d: Floats) -> Floats:
    return smallest(faces(o, d), first=False)


def roots(a: Floats, b: Floats, c: float) -> list[Floats]:
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - a * c)
    return [(-b - root) / a, (-b + root) / a]


def ellipsoid(o: Floats, d: Floats) -> Floats:
    hits = roots((d * d).sum(1), d @ o, float(o @ o) - 1)
    return smallest([(t, np.isfinite(t)) for t in hits])


def cylinder(o: Floats, d: Floats) -> Floats:
    side = roots((d[:, :2] ** 2).sum(1), d[:, :2] @ o[:2], float(o[:2] @ o[:2]) - 1)
    hits = [(t, np.abs(o[2] + t * d[:, 2]) <= 1) for t in side]
    for cap in (-1.0, 1.0):
        t = (cap - o[2]) / d[:, 2]
        hits.append((t, ((o[:2] + t[:, None] * d[:, :2]) ** 2).sum(1) <= 1))
    return smallest(hits)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [(BOX, box), (ELLIPSOID, ellipsoid), (CYLINDER, cylinder), (ROOM, inside_of_a_box)],
    ids=["box", "ellipsoid", "cylinder", "room"],
)
@pytest.mark.parametrize("seed", range(4))
def test_depth_is_that_of_the_analytic_intersection(
    kind: int, expected: Callable[[Floats, Floats], Floats], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    rotation, centre, half = turn(rng), rng.normal(size=3), rng.uniform(0.5, 1.2, 3)
    if kind == CYLINDER:
        half[1] = half[0]
    direction = rng.normal(size=3)
    eye = centre + direction / np.linalg.norm(direction) * (0.3 * half.min() if kind == ROOM else 4.0)
    pose = camera(eye, centre + rng.normal(0, 0.1, 3))
    _, depth = render(scene((kind, rotation, centre, half)), K, pose.astype(np.float32), SHAPE, 1)
    truth = expected(*local_rays(pose, rotation, centre, half)).reshape(SHAPE)
    assert (truth > 0).mean() > 0.1
    hit = (depth > 0) & (truth > 0)
    assert ((depth > 0) != (truth > 0)).mean() < 0.01  # silhouettes, to rounding
    np.testing.assert_allclose(depth[hit], truth[hit], rtol=1e-4)
    if kind == ROOM:
        assert hit.all()


def test_depth_is_camera_z_and_not_the_length_of_the_ray() -> None:
    wall = (BOX, np.eye(3), np.array([0, 0, 3.5]), np.array([9, 9, 0.5]))
    _, depth = render(scene(wall), K, UPRIGHT, SHAPE, 1)
    np.testing.assert_allclose(depth, 3.0, rtol=1e-6)


def test_pixel_centres_are_at_one_half() -> None:
    """What is symmetric about the optical axis is symmetric in the picture."""
    ball = (ELLIPSOID, np.eye(3), np.array([0, 0, 3.0]), np.array([0.8, 0.8, 0.8]))
    _, depth = render(scene(ball), K, UPRIGHT, SHAPE, 1)
    for axis in (0, 1):
        np.testing.assert_allclose(np.flip(depth, axis), depth, atol=1e-5)
    y, x = 14, 19  # half a pixel from the principal point, both ways
    a = 2 * (0.5 / 45) ** 2 + 1
    nearest = (3 - np.sqrt(9 - a * (9 - 0.64))) / a
    assert depth[y, x] == pytest.approx(nearest, rel=1e-5)


def test_the_nearest_primitive_hides_the_others_and_the_sky_is_what_is_left() -> None:
    far = (BOX, np.eye(3), np.array([0, 0, 5.0]), np.array([1.0, 9, 0.5]))
    near = (BOX, np.eye(3), np.array([0, 0, 2.0]), np.array([0.2, 0.2, 0.1]))
    behind = (BOX, np.eye(3), np.array([0, 0, -3.0]), np.array([9.0, 9, 0.5]))
    for parts in ((far, near, behind), (behind, near, far)):
        color, depth = render(scene(*parts), K, UPRIGHT, SHAPE, 2)
        assert depth[15, 20] == pytest.approx(1.9)
        assert depth[2, 20] == pytest.approx(4.5)
        assert depth[2, 2] == 0
        np.testing.assert_allclose(color[2, 2], SKY, atol=1e-6)
        np.testing.assert_allclose(color[15, 20], 1.0, atol=1e-6)


def test_light_falls_off_with_the_angle_and_is_blocked() -> None:
    """A wall at z = 4 facing the camera; one light, at the camera: Lambert's law, and a shadow."""
    wall = (BOX, np.eye(3), np.array([0, 0, 4.5]), np.array([20.0, 20, 0.5]))
    light = np.array([[0.0, 0, 0]])
    color, _ = render(scene(wall, ambient=0.3, lights=light), K, UPRIGHT, SHAPE, 1)
    y, x = np.meshgrid(np.arange(SHAPE[0]) + 0.5, np.arange(SHAPE[1]) + 0.5, indexing="ij")
    cosine = 1 / np.sqrt(1 + ((x - 20) / 45) ** 2 + ((y - 15) / 45) ** 2)
    np.testing.assert_allclose(color[..., 0], 0.3 + 0.7 * 1.6 * cosine, rtol=2e-3)

    # A screen before the light ends at y = −2, z = 1.9: its shadow on the wall ends at −4 + 2 · 4 / 1.9.
    screen = (BOX, np.eye(3), np.array([0, -7.0, 2.0]), np.array([20.0, 5.0, 0.1]))
    high = np.array([[0.0, -4.0, 0.0]])
    shaded, depth = render(scene(wall, screen, ambient=0.3, lights=high), K, UPRIGHT, SHAPE, 1)
    np.testing.assert_allclose(depth, 4.0, rtol=1e-6)
    height, edge = (y - 15) / 45 * 4, -4 + 8 / 1.9
    np.testing.assert_allclose(shaded[height < edge - 0.02], 0.3, rtol=1e-5)
    assert (shaded[height > edge + 0.02] > 0.5).all()


def test_the_texture_is_looked_up_where_the_surface_is() -> None:
    """A face from −2 to 2 at a quarter of a texture a unit shows one texture: dark left, bright right."""
    ramp = np.broadcast_to((np.arange(64) / 64)[None, None, :, None], (1, 64, 64, 3))
    wall = (BOX, np.eye(3), np.array([0, 0, 4.5]), np.array([2.0, 2.0, 0.5]))
    color, _ = render(scene(wall, texture=ramp), K, UPRIGHT, SHAPE, 2)
    x = (np.arange(SHAPE[1]) + 0.5 - 20) / 45 * 4
    row, u = color[15, :, 0], (x * 0.25) % 1
    inner = (np.abs(x) < 1.7) & (u > 0.05) & (u < 0.95)
    np.testing.assert_allclose(row[inner], u[inner], atol=0.03)


def test_mipmaps_keep_the_mean_at_every_level() -> None:
    atlas = np.random.default_rng(0).random((3, 16, 16, 3)).astype(np.float32)
    texels = mipmaps(atlas)
    assert texels.shape == (3, 256 + 64 + 16 + 4 + 1, 3) and texels.dtype == np.uint8
    start = 0
    for size in (16, 8, 4, 2, 1):
        level = texels[:, start : start + size * size] / 255
        np.testing.assert_allclose(level.mean(1), atlas.mean((1, 2)), atol=0.005)
        start += size * size
    np.testing.assert_allclose(texels[:, 256].astype(float) / 255, atlas[:, :2, :2].mean((1, 2)), atol=0.003)


def test_of_many_primitives_the_nearest_is_found() -> None:
    """What the tree finds is the smallest of what each primitive gives alone."""
    rng = np.random.default_rng(7)
    kinds = rng.choice([BOX, ELLIPSOID, CYLINDER], 40)
    parts = [(int(k), turn(rng), rng.normal(0, 1.5, 3), np.full(3, rng.uniform(0.05, 0.5))) for k in kinds]
    pose = camera(np.array([0, -5.0, 0.5]), np.zeros(3)).astype(np.float32)
    _, depth = render(scene(*parts), K, pose, SHAPE, 1)
    alone = np.stack([render(scene(part), K, pose, SHAPE, 1)[1] for part in parts])
    first = np.where(alone > 0, alone, np.inf).min(0)
    np.testing.assert_allclose(depth, np.where(np.isfinite(first), first, 0), rtol=1e-6)
    assert 0.2 < (depth > 0).mean() < 1


def test_fewer_rays_within_a_surface_give_nearly_the_same_picture() -> None:
    rng = np.random.default_rng(2)
    parts = [(BOX, turn(rng), rng.normal(0, 1, 3), rng.uniform(0.2, 0.6, 3)) for _ in range(6)]
    pose = camera(np.array([0, -5.0, 0.5]), np.zeros(3)).astype(np.float32)
    lit = scene(*parts, ambient=0.2, lights=np.array([[3.0, -6, 4]]))
    (full, depth), (quick, same) = (render(lit, K, pose, SHAPE, 2, stride) for stride in (1, 3))
    assert np.array_equal(depth, same)
    assert np.abs(full - quick).mean() < 0.01


WALL = (BOX, np.eye(3), np.array([0, 0, 4.5]), np.array([20.0, 20, 0.5]))


def test_power_falls_by_half_at_its_reach_and_lean_adds_to_ambient_light() -> None:
    base = scene(WALL, ambient=0.1, lights=np.zeros((1, 3)))
    for reach, share in ((0.0, 1.0), (4.0, 0.5), (2.0, 0.2)):
        color, _ = render(base._replace(power=np.array([[0.8, reach]])), K, UPRIGHT, SHAPE, 1)
        assert color[15, 20, 0] == pytest.approx(0.1 + 0.8 * share, rel=2e-3)
    leaning = base._replace(power=np.zeros((1, 2)), lean=np.array([0, 0, -0.5]))  # the wall faces −z
    color, _ = render(leaning, K, UPRIGHT, SHAPE, 1)
    np.testing.assert_allclose(color, 0.15, rtol=1e-5)


def test_glow_adds_light_and_detail_scales_it() -> None:
    """Texture of one half everywhere: a detail of amplitude a about one half changes nothing."""
    grey = np.full((1, 4, 4, 3), 0.5)
    base = scene(WALL, ambient=0.4, texture=grey)._replace(power=np.zeros((1, 2)), glow=np.array([0.6]))
    level = 128 / 255
    color, _ = render(base, K, UPRIGHT, SHAPE, 1)
    np.testing.assert_allclose(color, level * 1.0, rtol=1e-5)
    color, _ = render(base._replace(detail=np.array([[0.0, 0.2, 1.0]])), K, UPRIGHT, SHAPE, 1)
    np.testing.assert_allclose(color, level * (1 + 0.2 * (2 * level - 1)), rtol=1e-5)


def test_a_mirror_shows_what_is_before_it() -> None:
    """A black floor of mirror m adds m · (0.15 + 0.85 · (1 − cos)⁵) of the sky, which is all it sees."""
    floor = (BOX, np.eye(3), np.array([0, 2.0, 0]), np.array([50.0, 1.0, 50]))  # y points down; top at y = 1
    dark = scene(floor, ambient=0.0, texture=np.zeros((1, 4, 4, 3)))._replace(power=np.zeros((1, 2)))
    color, depth = render(dark._replace(mirror=np.array([0.5])), K, UPRIGHT, SHAPE, 1)
    y, x = np.meshgrid(np.arange(SHAPE[0]) + 0.5, np.arange(SHAPE[1]) + 0.5, indexing="ij")
    ray = np.stack([(x - 20) / 45, (y - 15) / 45, np.ones_like(x)], -1)
    cosine = ray[..., 1] / np.linalg.norm(ray, axis=-1)
    hit = depth > 0
    assert hit.any() and not hit.all()
    share = 0.5 * (0.15 + 0.85 * (1 - cosine[hit]) ** 5)
    np.testing.assert_allclose(color[hit], share[:, None] * np.array(SKY), rtol=1e-4)


def test_a_soft_light_casts_a_penumbra_and_no_light_leaks() -> None:
    """The screen of the hard shadow's test: full light and full shadow where no part of the light decides."""
    screen = (BOX, np.eye(3), np.array([0, -7.0, 2.0]), np.array([20.0, 5.0, 0.1]))
    lit = scene(WALL, screen, ambient=0.3, lights=np.array([[0.0, -4.0, 0.0]]))
    hard, _ = render(lit, K, UPRIGHT, SHAPE, 2)
    soft, _ = render(lit._replace(softness=0.03), K, UPRIGHT, SHAPE, 2)
    height, edge = ((np.arange(SHAPE[0]) + 0.5) - 15) / 45 * 4, -4 + 8 / 1.9
    far = np.abs(height - edge) > 0.5
    np.testing.assert_allclose(soft[far], hard[far], atol=0.05)
    near = np.abs(height - edge) < 0.1
    assert ((soft[near] > 0.35) & (soft[near] < 0.9)).any()
