"""Random scenes: reproducible, geometrically consistent between views, and as varied as they promise."""

from __future__ import annotations

import numpy as np
import pytest

from training.scenes import KINDS, Sample, generate, look_at, path, walk

SHAPE = (72, 96)


@pytest.fixture(scope="module")
def samples() -> dict[str, Sample]:
    return {kind: generate(3, 3, SHAPE, kind) for kind in KINDS}


def world_points(s: Sample, view: int) -> np.ndarray:
    """What each pixel of a view sees (H·W, 3); rays by K and pixel centres at one half."""
    h, w = s.depth.shape[1:]
    y, x = np.mgrid[0:h, 0:w] + 0.5
    ray = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ np.linalg.inv(s.K[view]).T
    pose = np.linalg.inv(s.cam_from_world[view])
    return (ray * s.depth[view].reshape(-1, 1)) @ pose[:3, :3].T + pose[:3, 3]


def seen_by(s: Sample, view: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel indices (N,) y and x in a view, and depth there (N,); −1 outside."""
    local = points @ s.cam_from_world[view, :3, :3].T + s.cam_from_world[view, :3, 3]
    z = np.where(local[:, 2] > 1e-3, local[:, 2], -1)
    x, y = np.floor((local / z[:, None]) @ s.K[view].T)[:, :2].T.astype(int)
    inside = (z > 0) & (x >= 0) & (y >= 0) & (x < s.depth.shape[2]) & (y < s.depth.shape[1])
    return np.where(inside, y, -1), np.where(inside, x, -1), np.where(inside, z, -1)


@pytest.mark.parametrize("kind", KINDS)
def test_depths_of_different_views_agree(samples: dict[str, Sample], kind: str) -> None:
    """A point that one view sees is at another's depth, or behind it: it never floats before the surface."""
    s = samples[kind]
    match = front = total = 0
    color = []
    for a in range(3):
        points, seen = world_points(s, a), s.depth[a].ravel() > 0
        for b in {0, 1, 2} - {a}:
            y, x, z = seen_by(s, b, points)
            ok = seen & (z > 0)
            theirs = s.depth[b][y[ok], x[ok]]
            good = np.abs(z[ok] / np.maximum(theirs, 1e-6) - 1) < 0.02
            match += int(good.sum())
            front += int((z[ok] < 0.95 * theirs).sum())
            total += int(ok.sum())
            ours = s.images[a].reshape(-1, 3)[ok][good].astype(float)
            color.append(np.abs(ours - s.images[b][y[ok], x[ok]][good]).mean(1))
    assert total > 1000
    assert match > 0.6 * total
    assert front < 0.05 * total  # edges, where a pixel stands for two surfaces
    assert np.median(np.concatenate(color)) < 12  # of 255: the same surface in the same light


def test_equal_seeds_give_equal_samples_and_others_do_not() -> None:
    a, b, c = (generate(seed, 2, SHAPE) for seed in (8, 8, 9))
    for name in ("images", "depth", "K", "cam_from_world"):
        assert np.array_equal(getattr(a, name), getattr(b, name))
    assert not np.array_equal(a.images, c.images) and not np.array_equal(a.depth, c.depth)


@pytest.mark.parametrize("kind", KINDS)
def test_a_sample_is_what_its_description_says(samples: dict[str, Sample], kind: str) -> None:
    s = samples[kind]
    assert s.images.shape == (3, *SHAPE, 3) and s.images.dtype == np.uint8
    assert s.depth.shape == (3, *SHAPE) and s.depth.dtype == np.float32
    assert np.isfinite(s.depth).all() and (s.depth >= 0).all()
    assert ((s.depth > 0).mean((1, 2)) >= 0.5).all()
    assert s.images.std() > 3  # some rooms are nearly plain
    R = s.cam_from_world[:, :3, :3].astype(float)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-5)
    assert (s.K[:, 0, 2] == 48).all() and (s.K[:, 1, 2] == 36).all()
    degrees = np.degrees(2 * np.arctan(48 / s.K[:, 0, 0]))
    assert ((degrees >= 41.9) & (degrees <= 80.1)).all()


def test_nothing_touches_the_camera() -> None:
    for seed in range(20, 26):
        depth = generate(seed, 2, (36, 48)).depth
        assert depth[depth > 0].min() >= 0.01 * np.median(depth[depth > 0])


def test_cameras_look_where_they_are_told_and_stand_upright() -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        eye, target = rng.normal(size=3), rng.normal(size=3)
        pose = look_at(eye, target)
        local = np.linalg.inv(pose) @ np.append(target, 1)
        np.testing.assert_allclose(local[:3], [0, 0, np.linalg.norm(target - eye)], atol=1e-9)
        assert pose[2, 0] == pytest.approx(0, abs=1e-9)  # x is horizontal
        assert pose[2, 1] < 0  # y points down
        rolled = look_at(eye, target, 0.3)
        np.testing.assert_allclose(rolled[:3, 2:], pose[:3, 2:])
        assert np.arccos(rolled[:3, 0] @ pose[:3, 0]) == pytest.approx(0.3)


def test_a_path_has_the_baselines_of_a_hand_held_walk() -> None:
    rng = np.random.default_rng(1)
    eye, target = np.array([0.0, -3, 1.5]), np.array([0.0, 0, 1])
    distance = float(np.linalg.norm(target - eye))
    shares = []
    for _ in range(50):
        poses = path(rng, eye, target, 5, distance)
        assert len(poses) == 5
        np.testing.assert_allclose(poses[0][:3, 3], eye)
        shares += [np.linalg.norm(p[:3, 3] - eye) / distance for p in poses[1:]]
    assert np.quantile(shares, 0.05) > 0.005 and np.quantile(shares, 0.95) < 0.5


def test_a_walk_covers_the_room_from_places_in_a_row() -> None:
    s = walk(4, 5, (36, 48))
    assert (s.depth > 0).all()
    centres = np.linalg.inv(s.cam_from_world)[:, :3, 3]
    assert (np.diff(centres[:, 0]) > 0.2).all()
    assert np.array_equal(s.images, walk(4, 5, (36, 48)).images)
