"""Region of interest, background filters and thinning within the fusion: what they remove, and the counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from colmap_tco.errors import DensifyError
from colmap_tco.fusion import FusionConfig, FusionView, fuse
from colmap_tco.fusion_report import FusionReport
from colmap_tco.ply import Cloud
from tests.colmap_tco.test_fusion import CONFIG, DISTANCE, SIZE, Scene, smooth_noise, sphere

Floats = NDArray[np.float64]
BOX = (-0.3, -0.5, -2.0, 0.6, 0.4, 2.0)
BEHIND = 40.0


@pytest.fixture(scope="module")
def views() -> list[FusionView]:
    return Scene(sphere).views()


@pytest.fixture(scope="module")
def whole(views: list[FusionView]) -> Cloud:
    return fuse(views, CONFIG)[0]


def balanced(report: FusionReport) -> bool:
    """Whether every pixel has one fate, and the points by view are all points."""
    fates = sum(number for name, number in report.pixels.items() if name != "all")
    return report.pixels["all"] == fates and sum(report.points.values()) == report.pixels["points"]


def test_a_region_cuts_the_cloud_and_changes_nothing_else(views: list[FusionView], whole: Cloud) -> None:
    cut, report = fuse(views, replace(CONFIG, roi=BOX))
    inside = np.flatnonzero(((whole.points >= BOX[:3]) & (whole.points <= BOX[3:])).all(1))
    assert 0.1 * len(whole) < len(cut) < 0.9 * len(whole)
    expected = whole.select(inside)
    for name in ("points", "normals", "colors"):
        assert np.array_equal(getattr(cut, name), getattr(expected, name))
    assert np.array_equal(cut.visibility.images, expected.visibility.images)
    assert report.pixels["roi"] == len(whole) - len(cut)
    assert balanced(report)


def test_an_empty_region_is_named(views: list[FusionView]) -> None:
    with pytest.raises(DensifyError, match=r"outside the region of interest \(roi\)"):
        fuse(views, replace(CONFIG, roi=(50.0, 50, 50, 60, 60, 60)))


@pytest.mark.parametrize("roi", [(1.0, 2.0, 3.0), (0.0, 0, 0, 1, -1, 1), (0.0, 0, 0, 1, 1, float("nan"))])
def test_a_region_that_is_none_is_refused(views: list[FusionView], roi: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="roi must be xmin,ymin,zmin,xmax,ymax,zmax"):
        fuse(views, replace(CONFIG, roi=roi))


@pytest.mark.parametrize("name", ["voxel_size", "max_points", "max_depth_ratio", "min_tri_angle"])
def test_negative_limits_are_refused(views: list[FusionView], name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must not be negative"):
        fuse(views, replace(CONFIG, **{name: -1}))


@pytest.mark.parametrize("limit", [{"voxel_size": 0.1}, {"max_points": 700}])
def test_thinned_points_are_points_of_the_whole_cloud(
    views: list[FusionView], whole: Cloud, limit: dict[str, float]
) -> None:
    few, report = fuse(views, replace(CONFIG, **limit))
    assert 300 < len(few) < 0.5 * len(whole)
    assert report.pixels["thinned"] == len(whole) - len(few)
    assert balanced(report)
    rows = {point.tobytes(): i for i, point in enumerate(whole.points)}
    for i in range(0, len(few), 31):
        original = rows[few.points[i].tobytes()]
        assert few.visibility[i].tolist() == whole.visibility[original].tolist()
        assert np.array_equal(few.colors[i], whole.colors[original])


def wall_behind(origin: Floats, directions: Floats) -> Floats:
    """The sphere, and what is behind it a wall at z = BEHIND."""
    front = sphere(origin, directions)
    return np.where(front > 0, front, (BEHIND - origin[2]) / directions[..., 2])


def test_background_beyond_the_points_of_the_model_is_dropped() -> None:
    views = [replace(view, reach=DISTANCE) for view in Scene(wall_behind).views()]
    config = replace(CONFIG, max_depth_bend=0.0, min_tri_angle=0.0)
    far = sum(int((view.load().depth > 3 * DISTANCE).sum()) for view in views)
    kept, report = fuse(views, config)
    assert report.pixels["max_depth_ratio"] == far > 7 * 0.3 * SIZE[0] * SIZE[1]
    assert kept.points[:, 2].max() < 2
    assert balanced(report)
    for off in (replace(config, max_depth_ratio=0.0), replace(config, max_depth_ratio=20.0)):
        cloud, report = fuse(views, off)
        assert report.pixels["max_depth_ratio"] == 0
        assert cloud.points[:, 2].max() > BEHIND - 1


FRONT, BACK = -0.7, 0.6


def step(origin: Floats, directions: Floats) -> Floats:
    """A wall at z = BACK, and left of x = 0 a plate before it at z = FRONT."""
    front = (FRONT - origin[2]) / directions[..., 2]
    back = (BACK - origin[2]) / directions[..., 2]
    return np.where(origin[0] + directions[..., 0] * front < 0, front, back)


@pytest.mark.parametrize("width", [0.7, 1.0, 2.0])
def test_smeared_edges_leave_no_points_between_the_surfaces(width: float) -> None:
    """With the default settings, where every view has a ramp of some pixels between plate and wall."""

    def smear(i: int, depth: Floats) -> Floats:
        return gaussian_filter(depth * (1 + smooth_noise(i, depth.shape, 0.003)), width)

    def away(config: FusionConfig) -> Floats:
        cloud, _ = fuse(Scene(step, count=9, disturb=smear).views(), config)
        assert len(cloud) > 5000
        return np.minimum(np.abs(cloud.points[:, 2] - FRONT), np.abs(cloud.points[:, 2] - BACK))

    bound = 2 * 0.01 * DISTANCE  # twice the tolerance; plate and wall are 1.3 apart
    assert away(FusionConfig(num_threads=1)).max() < bound
    none = FusionConfig(
        num_threads=1, max_depth_bend=0.0, max_view_angle=90.0, max_conflicts=0.0, max_normal_error=60.0,
        min_num_pixels=2,
    )  # fmt: skip
    assert width < 2 or (away(none) > bound).sum() > 100


def test_an_empty_result_names_the_conflicts() -> None:
    """Each surface is a tenth farther than that of the view before: later views look through earlier ones."""
    views = Scene(disturb=lambda i, depth: depth * 1.1**i).views()
    with pytest.raises(
        DensifyError, match=r"dropped because other views look through them \(max_conflicts\)"
    ):
        fuse(views, CONFIG)


def widest_angle(cloud: Cloud, point: int, by_index: dict[int, Floats]) -> float:
    """Degrees of the largest angle at a point between the centres of two views that confirm it."""
    rays = np.stack([by_index[i] - cloud.points[point] for i in cloud.visibility[point].tolist()])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1).min())))


def test_points_that_are_seen_from_one_direction_alone_are_dropped() -> None:
    scene = Scene(wall_behind)
    views = scene.views()
    config = FusionConfig(
        num_threads=1, adapt_to_noise=False, max_depth_bend=0.0, max_depth_ratio=0.0, min_num_pixels=3
    )
    centres = {view.index: scene.eye(i) for i, view in enumerate(views)}
    loose, none = fuse(views, replace(config, min_tri_angle=0.0))
    strict, report = fuse(views, replace(config, min_tri_angle=4.0))
    assert none.pixels["min_tri_angle"] == 0 < report.pixels["min_tri_angle"]
    assert balanced(report)
    # The views span 0.72 rad of a circle of 4 units: 41 degrees at the sphere, less than 4.2 at the wall.
    assert (loose.points[:, 2] > 30).sum() > 20 * (strict.points[:, 2] > 30).sum()
    assert (strict.points[:, 2] < 2).sum() > 0.95 * (loose.points[:, 2] < 2).sum()
    angles = [widest_angle(strict, i, centres) for i in range(0, len(strict), 41)]
    assert min(angles) >= 4.0 - 0.1


def test_an_empty_result_names_the_angle(views: list[FusionView]) -> None:
    with pytest.raises(DensifyError, match=r"same direction \(min_tri_angle\)"):
        fuse(views, replace(CONFIG, min_tri_angle=80.0))
