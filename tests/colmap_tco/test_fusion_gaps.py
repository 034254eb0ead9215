"""Gaps of the cloud are filled with what the views agreed on where they were hardly apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from colmap_tco.fusion import EmptyCloudError, FusionMaps, FusionView, fuse
from colmap_tco.fusion_report import FusionReport
from colmap_tco.ply import Cloud
from tests.colmap_tco.test_fusion import CONFIG, PIXEL, Floats, Scene, height, plane, with_maps

HALF_GAP = 0.4
"""The gap is where the world's x is within this of 0."""


def noisy_in_the_middle(scene: Scene) -> Callable[[int, Floats], Floats]:
    """Depths that no two views agree on where x is within the gap."""

    def disturb(i: int, depth: Floats) -> Floats:
        rng = np.random.default_rng(i)
        wrong = depth * np.exp(0.05 * rng.standard_normal(depth.shape))
        return np.where(np.abs(across(scene, i, depth)) < HALF_GAP, wrong, depth)

    return disturb


def across(scene: Scene, i: int, depth: Floats) -> Floats:
    """World x (H, W) of the pixels of a view at these depths."""
    from tests.colmap_tco.test_fusion import look_at_origin, rays

    pose = look_at_origin(scene.eye(i))
    return np.asarray((scene.eye(i) + (rays(depth.shape) @ pose[:, :3]) * depth[..., None])[..., 0])


def with_error(view: FusionView, error: Callable[[Floats], Floats] | float) -> FusionView:
    """The view with a standard error, a number or a function of its depths."""

    def change(maps: FusionMaps) -> FusionMaps:
        depth = maps.depth.astype(float)
        values = error(depth) if callable(error) else np.full(depth.shape, error)
        return replace(maps, error=values.astype(np.float32))

    return with_maps(view, change)


@pytest.fixture(scope="module")
def exact() -> Scene:
    return Scene(plane)


@pytest.fixture(scope="module")
def own(exact: Scene) -> list[FusionView]:
    return Scene(plane, disturb=noisy_in_the_middle(exact)).views()


@pytest.fixture(scope="module")
def agreed(exact: Scene) -> list[FusionView]:
    return [with_error(view, 0.001) for view in exact.views()]


@pytest.fixture(scope="module")
def alone(own: list[FusionView]) -> tuple[Cloud, FusionReport]:
    return fuse(own, CONFIG)


@pytest.fixture(scope="module")
def filled(own: list[FusionView], agreed: list[FusionView]) -> tuple[Cloud, FusionReport]:
    return fuse(own, CONFIG, agreed=agreed)


def rows(cloud: Cloud) -> set[bytes]:
    return {point.tobytes() for point in cloud.points}


def in_gap(cloud: Cloud, margin: float = 0.0) -> Floats:
    return cloud.points[np.abs(cloud.points[:, 0]) < HALF_GAP - margin]


def test_the_gap_is_closed_on_the_surface(
    alone: tuple[Cloud, FusionReport], filled: tuple[Cloud, FusionReport]
) -> None:
    before, after = in_gap(alone[0], 3 * PIXEL), in_gap(filled[0], 3 * PIXEL)
    assert len(after) > 10 * len(before)
    whole, _ = fuse(Scene(plane).views(), CONFIG)
    apart = cKDTree(after).query(in_gap(whole, 3 * PIXEL))[0]
    assert np.quantile(apart, 0.99) < 2 * PIXEL
    new = np.array([p for p in filled[0].points if p.tobytes() not in rows(alone[0])])
    assert np.abs(height(new, plane)).max() < 1e-3


def test_what_was_there_stays_and_nothing_comes_beside_it(
    alone: tuple[Cloud, FusionReport], filled: tuple[Cloud, FusionReport]
) -> None:
    kept = rows(alone[0])
    assert kept <= rows(filled[0])
    new = np.array([p for p in filled[0].points if p.tobytes() not in kept])
    assert len(new) == filled[1].filled == len(filled[0]) - len(alone[0])
    # A pixel of any view is at most 1 / 1.1 of its size at the middle of the scene.
    assert cKDTree(alone[0].points).query(new)[0].min() > 1.2 * PIXEL / 1.1


def test_every_pixel_of_both_maps_is_accounted_for(
    alone: tuple[Cloud, FusionReport], filled: tuple[Cloud, FusionReport]
) -> None:
    (_, before), (cloud, report) = alone, filled
    assert report.pixels["all"] == 2 * before.pixels["all"]
    assert report.pixels["all"] == sum(n for name, n in report.pixels.items() if name != "all")
    assert report.pixels["no_gap"] > 0 and report.pixels["points"] == len(cloud)
    assert report.as_dict()["points_in_gaps"] == report.filled > 0
    assert before.filled == before.pixels["no_gap"] == 0


def test_points_are_in_the_order_that_the_report_counts(
    own: list[FusionView], filled: tuple[Cloud, FusionReport]
) -> None:
    """Thinning takes the counts of views from the order of the cloud."""
    cloud, report = filled
    assert sum(report.points.values()) == len(cloud)
    end = 0
    for view in own:
        start, end = end, end + report.points[view.name]
        assert all(view.index in cloud.visibility[i].tolist() for i in range(start, end))


def test_where_the_views_were_apart_the_gap_stays(
    exact: Scene, own: list[FusionView], alone: tuple[Cloud, FusionReport]
) -> None:
    """Of errors of 0.1 % and of 0.3 % the first alone is below the limit; 0 says that it is not known."""
    for worse in (0.003, 0.0):
        views = []
        for i, view in enumerate(exact.views()):

            def error(depth: Floats, i: int = i, worse: float = worse) -> Floats:
                return np.where(across(exact, i, depth) > 0, 0.001, worse)

            views.append(with_error(view, error))
        cloud, report = fuse(own, CONFIG, agreed=views)
        kept = rows(alone[0])
        new = np.array([p for p in cloud.points if p.tobytes() not in kept])
        assert len(new) > 500 and new[:, 0].min() > -PIXEL
        assert report.pixels["max_agreed_error"] > 0.3 * report.pixels["all"] / 2
        loose, _ = fuse(own, replace(CONFIG, max_agreed_error=0.005), agreed=views)
        assert (len(loose) > len(cloud) + 0.7 * len(new)) == (worse > 0)


def test_gaps_stay_where_that_is_asked_for(
    own: list[FusionView], agreed: list[FusionView], alone: tuple[Cloud, FusionReport]
) -> None:
    cloud, report = fuse(own, replace(CONFIG, max_agreed_error=0.0), agreed=agreed)
    assert cloud.points.tobytes() == alone[0].points.tobytes()
    assert report.filled == 0 and report.pixels["all"] == alone[1].pixels["all"]


def test_a_cloud_of_nothing_is_not_filled(agreed: list[FusionView]) -> None:
    """What the views agreed on when they were asked is no evidence where nothing else is there."""
    apart = Scene(plane, disturb=lambda i, depth: depth * 1.1**i).views()
    with pytest.raises(EmptyCloudError, match="min_num_pixels"):
        fuse(apart, CONFIG, agreed=agreed)


def test_threads_and_thinning_do_not_change_it(
    own: list[FusionView], agreed: list[FusionView], filled: tuple[Cloud, FusionReport]
) -> None:
    again, _ = fuse(own, replace(CONFIG, num_threads=2), agreed=agreed)
    assert again.points.tobytes() == filled[0].points.tobytes()
    few, report = fuse(own, replace(CONFIG, max_points=700), agreed=agreed)
    assert rows(few) <= rows(filled[0]) and sum(report.points.values()) == len(few)
    assert report.pixels["thinned"] == len(filled[0]) - len(few)
    with pytest.raises(ValueError, match="max_agreed_error must not be negative"):
        fuse(own, replace(CONFIG, max_agreed_error=-1.0), agreed=agreed)


def test_progress_is_told_of_each_view_of_both(own: list[FusionView], agreed: list[FusionView]) -> None:
    told: list[int] = []
    fuse(own, CONFIG, lambda: told.append(1), agreed)
    assert len(told) == 2 * len(own)


def test_large_coordinates_cost_nothing(own: list[FusionView], agreed: list[FusionView]) -> None:
    shift = np.array([4e5, 5e6, 300.0])

    def moved(view: FusionView) -> FusionView:
        pose = view.cam_from_world.copy()
        pose[:, 3] -= pose[:, :3] @ shift
        return replace(view, cam_from_world=pose)

    near, _ = fuse(own, CONFIG, agreed=agreed)
    far, report = fuse([moved(v) for v in own], CONFIG, agreed=[moved(v) for v in agreed])
    assert abs(len(near) - len(far)) < 0.002 * len(near) and report.filled > 0
    assert cKDTree(near.points).query(far.points - shift)[0].max() < 1.5 * PIXEL


def test_errors_of_another_size_are_refused(own: list[FusionView], agreed: list[FusionView]) -> None:
    wrong = [with_maps(view, lambda maps: replace(maps, error=maps.error[:5])) for view in agreed]  # type: ignore[index]
    with pytest.raises(ValueError, match=r"error .* does not fit the depths"):
        fuse(own, CONFIG, agreed=wrong)
