"""Gaps of the cloud are filled with what the views agreed on where they were hardly apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from colmap_tco import _fusion_kernels as kernels
from colmap_tco._fusion_gaps import Covered
from colmap_tco.fusion import EmptyCloudError, FusionMaps, FusionView, fuse
from colmap_tco.fusion_report import FusionReport
from colmap_tco.pinhole import Pinhole
from colmap_tco.ply import Cloud
from colmap_tco.workers import Workers
from tests.colmap_tco.test_fusion import (
    CONFIG,
    NORMAL,
    PIXEL,
    Floats,
    Scene,
    height,
    look_at_origin,
    plane,
    rays,
    with_maps,
)

HALF_GAP = 0.4
"""The gap is where the world's x is within this of 0."""


def across(scene: Scene, i: int, depth: Floats) -> Floats:
    """World x (H, W) of the pixels of a view at these depths."""
    pose = look_at_origin(scene.eye(i))
    return np.asarray((scene.eye(i) + (rays(depth.shape) @ pose[:, :3]) * depth[..., None])[..., 0])


def noisy_in_the_middle(scene: Scene) -> Callable[[int, Floats], Floats]:
    """Depths that no two views agree on where x is within the gap."""

    def disturb(i: int, depth: Floats) -> Floats:
        rng = np.random.default_rng(i)
        wrong = depth * np.exp(0.05 * rng.standard_normal(depth.shape))
        return np.where(np.abs(across(scene, i, depth)) < HALF_GAP, wrong, depth)

    return disturb


def smooth_noise(sigma: float, width: float) -> Callable[[int, Floats], Floats]:
    """Noise of the depths, another in each view, so smooth that normals stay."""

    def disturb(i: int, depth: Floats) -> Floats:
        noise = gaussian_filter(np.random.default_rng(50 + i).standard_normal(depth.shape), width)
        return np.asarray(depth * np.exp(sigma * noise / noise.std()))

    return disturb


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


def balanced(report: FusionReport) -> bool:
    fates = sum(number for name, number in report.pixels.items() if name != "all")
    return report.pixels["all"] == fates and sum(report.points.values()) == report.pixels["points"]


def test_the_gap_is_closed_on_the_surface(
    alone: tuple[Cloud, FusionReport], filled: tuple[Cloud, FusionReport]
) -> None:
    before, after = in_gap(alone[0], 3 * PIXEL), in_gap(filled[0], 3 * PIXEL)
    assert len(after) > 10 * len(before)
    whole, _ = fuse(Scene(plane).views(), CONFIG)
    apart = cKDTree(after).query(in_gap(whole, 3 * PIXEL))[0]
    assert np.quantile(apart, 0.99) < 2 * PIXEL
    assert np.abs(height(filled[0].points[len(alone[0]) :], plane)).max() < 1e-3


def test_what_was_there_stays_and_comes_first(
    alone: tuple[Cloud, FusionReport], filled: tuple[Cloud, FusionReport]
) -> None:
    count = len(alone[0])
    assert filled[0].points[:count].tobytes() == alone[0].points.tobytes()
    new = filled[0].points[count:]
    assert np.abs(new[:, 0]).max() < HALF_GAP + 2 * PIXEL
    assert cKDTree(alone[0].points).query(new)[0].min() > 0.4 * PIXEL
    for i in range(0, count, 97):
        assert filled[0].visibility[i].tolist() == alone[0].visibility[i].tolist()


def test_every_pixel_of_both_maps_is_accounted_for(
    alone: tuple[Cloud, FusionReport], filled: tuple[Cloud, FusionReport]
) -> None:
    (_, before), (cloud, report) = alone, filled
    assert report.gaps is not None and balanced(report) and balanced(report.gaps)
    assert report.pixels == before.pixels and before.gaps is None
    assert report.gaps.pixels["all"] == report.pixels["all"]
    assert report.pixels["points"] + report.gaps.pixels["points"] == len(cloud)
    told = report.as_dict()["gaps"]
    assert isinstance(told, dict) and told["pixels"] == report.gaps.pixels
    assert before.as_dict()["gaps"] is None


def test_points_in_gaps_know_their_views(
    own: list[FusionView], alone: tuple[Cloud, FusionReport], filled: tuple[Cloud, FusionReport]
) -> None:
    cloud, report = filled
    assert report.gaps is not None
    end = len(alone[0])
    for view in own:
        start, end = end, end + report.gaps.points[view.name]
        assert all(view.index in cloud.visibility[i].tolist() for i in range(start, end))
    assert end == len(cloud)


@pytest.mark.parametrize("worse", [0.004, 0.0])
def test_where_the_views_were_apart_the_gap_stays(
    exact: Scene, own: list[FusionView], alone: tuple[Cloud, FusionReport], worse: float
) -> None:
    """Of errors of 0.1 % and of 0.4 % the first alone is below the limit; 0 says that it is not known."""
    views = []
    for i, view in enumerate(exact.views()):

        def error(depth: Floats, i: int = i) -> Floats:
            return np.where(across(exact, i, depth) > 0, 0.001, worse)

        views.append(with_error(view, error))
    cloud, report = fuse(own, CONFIG, agreed=views)
    new = cloud.points[len(alone[0]) :]
    assert len(new) > 500 and new[:, 0].min() > -PIXEL
    assert report.gaps is not None and balanced(report.gaps)
    assert report.gaps.pixels["max_agreed_error"] > 0.3 * report.gaps.pixels["all"]
    loose, _ = fuse(own, replace(CONFIG, max_agreed_error=0.005), agreed=views)
    assert (len(loose) > len(cloud) + 0.7 * len(new)) == (worse > 0)


def test_points_that_are_noisy_leave_no_gap() -> None:
    """Own depths 0.4 % off, five pixels of a fine view, cover the surface although they lie beside it."""
    shape = (360, 480)
    noisy = Scene(plane, shape=shape, disturb=smooth_noise(0.004, 12)).views()
    true = [with_error(view, 0.001) for view in Scene(plane, shape=shape).views()]
    config = replace(CONFIG, max_normal_error=60.0)
    cloud, report = fuse(noisy, config, agreed=true)
    assert report.gaps is not None and report.pixels["points"] > 0.8 * np.prod(shape)
    fine = PIXEL * 96 / 480
    assert np.abs(height(cloud.points, plane)).mean() * PIXEL > 0.3 * fine
    inside = (np.abs(cloud.points[:, :2]) < 0.8).all(1)
    assert inside[report.pixels["points"] :].sum() < 0.005 * inside.sum()


def test_what_views_look_through_stays_away() -> None:
    """Three of nine views agree on a plate that six see through, to a wall of which they are unsure."""
    scene = Scene(plane, count=9)

    def plate(i: int, depth: Floats) -> Floats:
        directions = rays(depth.shape) @ look_at_origin(scene.eye(i))[:, :3]
        front = (0.8 - scene.eye(i) @ NORMAL) / (directions @ NORMAL)
        points = scene.eye(i) + directions * front[..., None]
        near = np.linalg.norm(points[..., :2], axis=-1) < 0.4
        return np.where(near & (i in (3, 4, 5)), front, depth)

    def error(view: FusionView) -> FusionView:
        return with_error(view, lambda depth: np.where(depth < 0.9 * np.median(depth), 0.001, 0.02))

    def floating(cloud: Cloud) -> int:
        return int((height(cloud.points, plane) > 5).sum())

    views = Scene(plane, count=9, disturb=plate).views()
    config = replace(CONFIG, min_num_pixels=3)
    cloud, report = fuse(views, config, agreed=[error(view) for view in views])
    assert report.gaps is not None and report.gaps.pixels["max_conflicts"] > 100
    assert floating(cloud) < 20
    # They are there, if nobody is asked who sees through them.
    assert floating(fuse(views, replace(config, max_conflicts=0.0))[0]) > 200


def test_gaps_stay_where_that_is_asked_for(
    own: list[FusionView], agreed: list[FusionView], alone: tuple[Cloud, FusionReport]
) -> None:
    cloud, report = fuse(own, replace(CONFIG, max_agreed_error=0.0), agreed=agreed)
    assert cloud.points.tobytes() == alone[0].points.tobytes() and report.gaps is None


def test_a_cloud_of_nothing_is_not_filled(agreed: list[FusionView]) -> None:
    """What the views agreed on when they were asked is no evidence where nothing else is there."""
    apart = Scene(plane, disturb=lambda i, depth: depth * 1.1**i).views()
    with pytest.raises(EmptyCloudError, match="min_num_pixels"):
        fuse(apart, CONFIG, agreed=agreed)


def test_a_region_within_the_gap_holds_the_points_that_are_there_without_it(
    own: list[FusionView], agreed: list[FusionView], filled: tuple[Cloud, FusionReport]
) -> None:
    box = (-0.2, -9.0, -9.0, 0.2, 9.0, 9.0)
    cut, report = fuse(own, replace(CONFIG, roi=box), agreed=agreed)
    inside = np.abs(filled[0].points[:, 0]) <= 0.2
    assert cut.points.tobytes() == filled[0].points[inside].tobytes() and len(cut) > 300
    assert report.gaps is not None and balanced(report) and balanced(report.gaps)


@pytest.mark.parametrize("cache", [4.0, 1e-6])
def test_threads_and_memory_do_not_change_it(
    own: list[FusionView], agreed: list[FusionView], filled: tuple[Cloud, FusionReport], cache: float
) -> None:
    again, report = fuse(own, replace(CONFIG, num_threads=2, cache_size=cache), agreed=agreed)
    assert again.points.tobytes() == filled[0].points.tobytes()
    assert report.gaps is not None and filled[1].gaps is not None
    assert report.gaps.pixels == filled[1].gaps.pixels


def test_thinning_counts_both(
    own: list[FusionView], agreed: list[FusionView], filled: tuple[Cloud, FusionReport]
) -> None:
    few, report = fuse(own, replace(CONFIG, max_points=700), agreed=agreed)
    assert rows(few) <= rows(filled[0])
    assert report.gaps is not None and balanced(report) and balanced(report.gaps)
    assert report.pixels["points"] + report.gaps.pixels["points"] == len(few)
    assert report.gaps.pixels["points"] > 50


def test_maps_of_half_the_size_fill_gaps_of_half_the_points(exact: Scene) -> None:
    half = (36, 48)
    own = Scene(plane, shape=half, disturb=noisy_in_the_middle(exact)).views()
    agreed = [with_error(view, 0.001) for view in Scene(plane, shape=half).views()]
    cloud, report = fuse(own, CONFIG, agreed=agreed)
    new = cloud.points[report.pixels["points"] :]
    assert len(new) > 100 and np.abs(new[:, 0]).max() < HALF_GAP + 4 * PIXEL
    assert cKDTree(cloud.points[: report.pixels["points"]]).query(new)[0].min() > 0.8 * PIXEL


def test_large_coordinates_cost_nothing(own: list[FusionView], agreed: list[FusionView]) -> None:
    shift = np.array([4e5, 5e6, 300.0])

    def moved(view: FusionView) -> FusionView:
        pose = view.cam_from_world.copy()
        pose[:, 3] -= pose[:, :3] @ shift
        return replace(view, cam_from_world=pose)

    near, _ = fuse(own, CONFIG, agreed=agreed)
    far, report = fuse([moved(v) for v in own], CONFIG, agreed=[moved(v) for v in agreed])
    assert report.gaps is not None and report.gaps.pixels["points"] > 500
    assert abs(len(near) - len(far)) < 0.002 * len(near)
    assert cKDTree(near.points).query(far.points - shift)[0].max() < 1.5 * PIXEL


def test_progress_is_told_of_each_view_of_both(own: list[FusionView], agreed: list[FusionView]) -> None:
    told: list[int] = []
    fuse(own, CONFIG, lambda: told.append(1), agreed)
    assert len(told) == 2 * len(own)


def test_wrong_input_is_refused(own: list[FusionView], agreed: list[FusionView], exact: Scene) -> None:
    cut = [with_maps(view, lambda maps: replace(maps, error=np.ones((2, 2), "f4"))) for view in agreed]
    with pytest.raises(ValueError, match=r"error .* does not fit the depths"):
        fuse(own, CONFIG, agreed=cut)
    with pytest.raises(ValueError, match="need the standard error"):
        fuse(own, CONFIG, agreed=exact.views())
    for others in (agreed[::-1], agreed[:-1]):
        with pytest.raises(ValueError, match="same views in the same order"):
            fuse(own, CONFIG, agreed=others)
    with pytest.raises(ValueError, match="max_agreed_error must not be negative"):
        fuse(own, replace(CONFIG, max_agreed_error=-1.0), agreed=agreed)


def marked(depths: list[float], focal: float, neighbours: tuple[tuple[int, ...], tuple[int, ...]]) -> Floats:
    """What points at these depths, one above each fourth pixel, cover in a map of depth 4 with focal 100.

    They are of another view in the same place, whose maps have this focal length.
    """
    camera = kernels.camera(np.array([100.0, 100.0, 24.0, 4.0]))
    maps = Pinhole(48, 8, 100.0, 100.0, 24.0, 4.0)
    views = [
        FusionView(f"{i}.jpg", i, maps, np.eye(4)[:3], neighbours[i], lambda: FusionMaps(*3 * [np.zeros(1)]))
        for i in range(2)
    ]
    covered = Covered(views, 50)
    assert not covered
    z = np.array(depths)
    column = 4.0 * np.arange(len(z)) + 2.5
    points = np.stack([(column - 24) / 100 * z, 0.5 / 100 * z, z], -1)
    covered.add(0, points, kernels.camera(np.array([focal, focal, 24.0, 4.0])))
    assert covered
    depth = np.full((8, 48), 4.0, np.float32)
    taken = np.zeros((8, 48), np.uint8)
    covered.mark(1, depth, camera, 0.01, taken, Workers(1))
    return taken


def test_points_cover_the_pixels_that_show_them_and_none_behind_or_before() -> None:
    taken = marked([4.0, 4.03, 4.05, 3.97, 3.9, 8.0, 2.0], 100.0, ((1,), ()))
    covers = [bool(taken[4, 4 * i + 2]) for i in range(7)]
    assert covers == [True, True, False, True, False, False, False]
    # One pixel each: the next are a whole pixel off, and 0.75 are covered.
    assert taken.sum() == 3


@pytest.mark.parametrize(("focal", "pixels"), [(100.0, 1), (50.0, 9), (10.0, 9), (400.0, 1)])
def test_points_of_coarse_maps_cover_more_and_fine_ones_their_pixel(focal: float, pixels: int) -> None:
    assert marked([4.0], focal, ((1,), ())).sum() == pixels


@pytest.mark.parametrize("neighbours", [((1,), ()), ((), (0,))])
def test_it_is_enough_that_one_is_the_others_neighbour(neighbours: tuple[tuple[int, ...], ...]) -> None:
    assert marked([4.0], 100.0, (neighbours[0], neighbours[1])).sum() == 1
    assert marked([4.0], 100.0, ((), ())).sum() == 0
