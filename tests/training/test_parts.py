"""Building blocks of the scenes: walls with holes, rods, textures by name and camera paths."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from training import furniture, materials
from training.builder import Builder, Light, Place
from training.materials import MAKERS, RANGES, Material
from training.paths import advance, arc, look_at, pan
from training.raytrace import CYLINDER, render
from training.rooms import wall

WHITE = Material(0)
EYE, TARGET = np.array([0.0, -4.0, 1.0]), np.array([0.0, 0.0, 1.0])


def test_a_wall_is_seen_through_where_its_holes_are_and_nowhere_else() -> None:
    b = Builder(np.random.default_rng(0))
    wall(Place(b, (-3, 0, 0)), 6.0, 3.0, 0.2, [(1.0, 2.0, 0.5, 1.5), (3.0, 4.5, 0.0, 2.0)], WHITE)
    K = np.array([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]], np.float32)
    scene = b.scene(Light(np.zeros((1, 3)), 1.0, np.zeros(3)))
    _, depth = render(scene, K, look_at(EYE, TARGET).astype(np.float32), (60, 80), 1)
    v, u = np.mgrid[0:60, 0:80] + 0.5
    x, z = (u - 40) / 60, 1 - (v - 30) / 60
    free = np.ones_like(x, bool)
    for away in (4.0, 4.2):  # front and back of the wall
        x_at, z_at = x * away, 1 + (z - 1) * away
        inside = ((x_at > -1.98) & (x_at < -1.02) & (z_at > 0.52) & (z_at < 1.48)) | (
            (x_at > 0.02) & (x_at < 1.48) & (z_at > 0.02) & (z_at < 1.98)
        )
        free &= inside
    x, z = 4 * x, 1 + 4 * (z - 1)
    solid = (
        (np.abs(x) < 2.95)
        & (z > 0.05)
        & (z < 2.95)
        & ~(((x > -2.02) & (x < -0.98) & (z > 0.48) & (z < 1.52)) | ((x > -0.02) & (x < 1.52) & (z < 2.02)))
    )
    assert free.sum() > 100 and (depth[free] == 0).all()
    np.testing.assert_allclose(depth[solid], 4.0, rtol=1e-6)


@pytest.mark.parametrize("end", [(1.0, 2.0, 3.0), (0.0, 0.0, 2.0), (-1.0, 0.0, 0.0)])
def test_a_rod_runs_from_end_to_end(end: tuple[float, float, float]) -> None:
    b = Builder(np.random.default_rng(0))
    Place(b, (1, 2, 0), 0.7).inner((0.5, 0, 0)).rod((0, 0, 0), end, 0.1, WHITE)
    part = b.parts[0]
    assert part.kind == CYLINDER
    np.testing.assert_allclose(part.rotation @ part.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(part.rotation) == pytest.approx(1)
    turn = np.array([[np.cos(0.7), -np.sin(0.7), 0], [np.sin(0.7), np.cos(0.7), 0], [0, 0, 1]])
    start = np.array([1, 2, 0]) + turn @ [0.5, 0, 0]
    tips = [part.centre + side * part.half[2] * part.rotation[2] for side in (-1, 1)]
    np.testing.assert_allclose(tips, [start, start + turn @ end], atol=1e-8)


@pytest.mark.parametrize("piece", ["table", "chair", "desk", "sofa", "shelf", "block"])
def test_furniture_stands_on_the_floor(piece: str) -> None:
    for seed in range(5):
        b = Builder(np.random.default_rng(seed), plainness=0.5)
        getattr(furniture, piece)(Place(b, (0, 0, 0)))
        reach = [np.abs(part.rotation[:, 2]) @ part.half for part in b.parts]
        low = min(part.centre[2] - r for part, r in zip(b.parts, reach, strict=True))
        high = max(part.centre[2] + r for part, r in zip(b.parts, reach, strict=True))
        assert -0.06 < low < 0.1 and 0.2 < high < 3.5


def test_textures_have_the_numbers_that_their_names_say() -> None:
    assert RANGES["plain"][0] == 0 and RANGES["any"][0] == RANGES["plain"][1]
    spans = sorted(RANGES.values())
    assert all(a[1] == b[0] for a, b in pairwise(spans))
    assert all(RANGES[name][1] - RANGES[name][0] == count for name, (_, count) in MAKERS.items())


@pytest.mark.parametrize("name", MAKERS)
def test_textures_are_pictures(name: str) -> None:
    image = MAKERS[name][0](np.random.default_rng(1))
    assert image.shape == (materials.SIZE, materials.SIZE, 3) and image.dtype == np.float32
    assert image.min() >= 0 and image.max() <= 1.0001
    if name == "grain":
        assert abs(image.mean() - 0.5) < 0.1


@pytest.mark.parametrize("way", [arc, pan, advance])
def test_paths_start_near_the_eye_and_keep_what_is_seen_in_view(way: object) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        poses = way(rng, EYE, TARGET, 6, 4.0)  # type: ignore[operator]
        assert len(poses) == 6
        assert np.linalg.norm(poses[0][:3, 3] - EYE) < 1.2
        centres = np.stack([p[:3, 3] for p in poses])
        gaps = np.linalg.norm(centres[:, None] - centres[None], axis=-1)[np.triu_indices(6, 1)]
        assert 0.003 * 4 < gaps.max() < 1.3 * 4
        for pose in poses:
            aim = (TARGET - pose[:3, 3]) / np.linalg.norm(TARGET - pose[:3, 3])
            assert pose[:3, 2] @ aim > 0.3


def test_an_arc_keeps_its_distance() -> None:
    poses = arc(np.random.default_rng(5), EYE, TARGET, 6, 4.0)
    for pose in poses:
        assert np.linalg.norm(pose[:3, 3] - TARGET) == pytest.approx(4.0, rel=0.15)
