"""A finished result read back: positions, visibility and confidence agree with a direct computation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from colmap_tco.dense import finished, point_confidence, thinned
from colmap_tco.errors import InputError
from colmap_tco.maps import write_map
from colmap_tco.pinhole import Pinhole
from colmap_tco.ply import Visibility
from colmap_tco.views import View
from colmap_tco.workspace import dense_paths


def test_a_workspace_without_a_result_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="colmap-tco densify"):
        finished(tmp_path)


def test_thinning_keeps_the_lists_of_the_points_that_stay() -> None:
    lists = [[3], [], [0, 1, 2], [5, 4], [1]]
    start = np.concatenate([[0], np.cumsum([len(part) for part in lists])])
    whole = Visibility(start, np.array([image for part in lists for image in part], np.uint32))
    chosen = np.array([4, 2, 1, 3])
    few = thinned(whole, chosen)
    assert [few[i].tolist() for i in range(len(few))] == [lists[i] for i in chosen]


def test_confidence_is_the_mean_over_the_pixels_of_the_views_that_confirm(tmp_path: Path) -> None:
    """Random points before three cameras, against a loop over points and views."""
    rng, paths = np.random.default_rng(0), dense_paths(tmp_path)
    camera, network = Pinhole(80, 60, 70, 70, 40, 30), Pinhole(80, 60, 70, 70, 40, 30).resized(40, 30)
    views: list[View | None] = []
    maps = rng.uniform(1, 9, (3, 30, 40)).astype(np.float32)
    for i in range(3):
        pose = np.concatenate([np.eye(3), [[0.1 * i], [0.0], [0.0]]], 1)
        views.append(View(f"{i}.png", i, tmp_path, None, camera, network, pose))
        write_map(paths.confidence_map(f"{i}.png"), maps[i])
    views.insert(1, None)  # an image without maps
    points = rng.uniform((-1, -0.8, 4), (1, 0.8, 6), (50, 3))
    lists = [rng.choice(4, rng.integers(1, 5), replace=False) for _ in points]
    start = np.concatenate([[0], np.cumsum([len(part) for part in lists])])
    found = point_confidence(paths, views, points, Visibility(start, np.concatenate(lists).astype(np.uint32)))
    for point, seen, value in zip(points, lists, found, strict=True):
        expected = []
        for position in seen:
            view = views[position]
            if view is not None:
                x, y, z = view.cam_from_world[:, :3] @ point + view.cam_from_world[:, 3]
                row, column = int(35 * y / z + 15), int(35 * x / z + 20)
                expected.append(maps[int(view.name[0]), row, column])
        assert value == pytest.approx(np.mean(expected) if expected else 0, rel=1e-6)
