"""Points and normals are means that one wrong vote hardly moves, and that lose little where all are good."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from colmap_tco.fusion import FusionMaps, FusionView, fuse
from tests.colmap_tco.test_fusion import (
    CONFIG,
    DISTANCE,
    NORMAL,
    PIXEL,
    Floats,
    Scene,
    height,
    look_at_origin,
    plane,
    with_maps,
)

WRONG = 0.009
"""Relative error of one view's depths, within the tolerance of 0.01."""
COUNT = 5


def angles(normals: Floats) -> Floats:
    """Degrees (N,) between unit vectors (N, 3) and the plane's normal."""
    return np.asarray(np.degrees(np.arccos(np.clip(normals @ NORMAL, -1, 1))))


@pytest.mark.parametrize("wrong", range(COUNT))
def test_a_wrong_view_among_five_moves_points_by_a_tenth_of_what_it_moves_a_mean(wrong: int) -> None:
    """Its surface is a parallel plane, a share WRONG of its distance away, and a mean a fifth of that off."""
    scene = Scene(count=COUNT, disturb=lambda i, depth: depth * (1 + WRONG * (i == wrong)))
    cloud, _ = fuse(scene.views(), CONFIG)
    seen_by_all = np.diff(cloud.visibility.start) == COUNT
    assert seen_by_all.sum() > 3000
    of_a_mean = WRONG * abs(scene.eye(wrong) @ NORMAL) / COUNT
    off = np.abs(height(cloud.points[seen_by_all], plane)) * PIXEL
    assert off.max() < 0.12 * of_a_mean


@pytest.mark.parametrize("wrong", [0, 3])
def test_a_wrong_normal_among_five_turns_the_mean_by_a_tenth_of_what_it_turns_a_plain_one(wrong: int) -> None:
    cos, sin = np.cos(np.radians(9.0)), np.sin(np.radians(9.0))
    turn = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]], np.float32)
    views = Scene(count=COUNT).views()
    views[wrong] = with_maps(views[wrong], lambda maps: replace(maps, normal=maps.normal @ turn))
    cloud, _ = fuse(views, CONFIG)
    turned = np.median(views[wrong].load().normal, (0, 1)) @ views[wrong].cam_from_world[:, :3]
    total = turned + (COUNT - 1) * NORMAL
    of_a_mean = float(angles(total[None] / np.linalg.norm(total))[0])
    assert of_a_mean > 1.5
    seen_by_all = np.diff(cloud.visibility.start) == COUNT
    assert seen_by_all.sum() > 3000
    assert np.quantile(angles(cloud.normals[seen_by_all].astype(float)), 0.95) < 0.15 * of_a_mean


def noisy(seed: int, sigma: float) -> list[FusionView]:
    """Views of the plane whose depths and normals err independently at every pixel."""

    def disturb(i: int, maps: FusionMaps) -> FusionMaps:
        rng = np.random.default_rng([seed, i])
        depth = maps.depth * (1 + sigma * rng.standard_normal(maps.depth.shape))
        exact = NORMAL @ look_at_origin(Scene().eye(i))[:, :3].T
        normal = exact + 0.02 * rng.standard_normal(maps.normal.shape)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        return replace(maps, depth=depth.astype("f4"), normal=normal.astype("f4"))

    views = Scene().views()
    return [with_maps(view, lambda maps, i=i: disturb(i, maps)) for i, view in enumerate(views)]  # type: ignore[misc]


@pytest.mark.parametrize("sigma", [0.0005, 0.002, 0.006])
def test_good_votes_lose_less_than_a_tenth_of_a_means_efficiency(
    monkeypatch: pytest.MonkeyPatch, sigma: float
) -> None:
    """Noise far below the tolerance, and nearly as wide. Widths without end make a plain mean of it."""
    config = replace(CONFIG, max_depth_bend=0.0, max_reproj_error=4.0)
    robust, _ = fuse(noisy(1, sigma), config)
    for name in ("_DEPTH_WIDTH", "_NORMAL_WIDTH"):
        monkeypatch.setattr(f"colmap_tco._fusion_noise.{name}", 1e6)
    mean, _ = fuse(noisy(1, sigma), config)
    assert abs(len(robust) - len(mean)) < 0.01 * len(mean)
    of_robust, of_mean = (height(cloud.points, plane) * PIXEL / DISTANCE for cloud in (robust, mean))
    assert of_mean.std() < 0.7 * sigma
    assert of_mean.var() > 0.93 * of_robust.var()
    assert abs(of_robust.mean()) < 0.02 * sigma
    turned = [np.mean(angles(cloud.normals.astype(float)) ** 2) for cloud in (mean, robust)]
    assert turned[0] > 0.93 * turned[1]
