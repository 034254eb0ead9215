"""Fusion on analytic scenes: exact surfaces, no half-pixel bias, outliers out, nothing twice."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

from colmap_tco import _fusion_noise
from colmap_tco._fusion_shelf import Shelf, ShelfView
from colmap_tco.errors import DensifyError
from colmap_tco.fusion import FusionConfig, FusionMaps, FusionView, fuse, fuse_views
from colmap_tco.fusion_report import FILTERS, FusionReport, Tolerance
from colmap_tco.normals import normals_from_depth
from colmap_tco.pinhole import Pinhole
from colmap_tco.workers import Workers

Floats = NDArray[np.float64]
SIZE = (96, 72)
DISTANCE = 4.0
CAMERA = Pinhole(*SIZE, 100.0, 104.0, SIZE[0] / 2 + 0.7, SIZE[1] / 2 - 0.4)
PIXEL = DISTANCE / CAMERA.fx
"""Size of a pixel at the distance of the scene."""
CONFIG = FusionConfig(num_threads=1, adapt_to_noise=False)
NORMAL = np.array([0.2, 0.1, -1.0]) / np.linalg.norm([0.2, 0.1, -1.0])
RADIUS = 1.0


def rays(shape: tuple[int, int], camera: Pinhole = CAMERA) -> Floats:
    h, w = shape
    u, v = np.meshgrid((np.arange(w) + 0.5) * camera.width / w, (np.arange(h) + 0.5) * camera.height / h)
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)


def plane(origin: Floats, directions: Floats) -> Floats:
    """Depth of the plane NORMAL·X = 0 along rays of unit z."""
    return np.clip(-(origin @ NORMAL) / (directions @ NORMAL), 0, None)


def sphere(origin: Floats, directions: Floats) -> Floats:
    """Depth of the sphere of RADIUS around the origin; 0 beside it."""
    a, b = (directions**2).sum(-1), directions @ origin
    rest = b * b - a * (origin @ origin - RADIUS**2)
    return np.where(rest > 0, (-b - np.sqrt(np.maximum(rest, 0))) / a, 0)


def look_at_origin(eye: Floats) -> Floats:
    z = -eye / np.linalg.norm(eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return np.concatenate([rotation, -(rotation @ eye)[:, None]], 1)


def ramp(points: Floats) -> Floats:
    """A colour (…, 3) that is linear in the position, 40 grey values a unit of length."""
    return 127 + 40 * points


@dataclass
class Scene:
    """Views of a surface; ``disturb`` may change a view's depth before normals are fitted."""

    surface: Callable[[Floats, Floats], Floats] = plane
    count: int = 7
    shape: tuple[int, int] = (SIZE[1], SIZE[0])
    disturb: Callable[[int, Floats], Floats] = staticmethod(lambda _, depth: depth)

    def views(self) -> list[FusionView]:
        return [self.view(i) for i in range(self.count)]

    def eye(self, i: int) -> Floats:
        angle = 0.12 * (i - (self.count - 1) / 2)
        return np.array([DISTANCE * np.sin(angle), 0.5 * np.sin(1.7 * i), -DISTANCE * np.cos(angle)])

    def depth(self, i: int, shape: tuple[int, int]) -> Floats:
        pose = look_at_origin(self.eye(i))
        return self.surface(self.eye(i), rays(shape) @ pose[:, :3])

    def view(self, i: int) -> FusionView:
        pose = look_at_origin(self.eye(i))
        points = self.eye(i) + (rays(SIZE[::-1]) @ pose[:, :3]) * self.depth(i, SIZE[::-1])[..., None]
        image = np.clip(np.rint(ramp(points)), 0, 255).astype(np.uint8)
        depth = self.disturb(i, self.depth(i, self.shape)).astype(np.float32)
        maps = FusionMaps(depth, normals_from_depth(depth, CAMERA), image)
        order = sorted((j for j in range(self.count) if j != i), key=lambda j: (abs(i - j), j))
        return FusionView(f"{i}.jpg", 10 + 2 * i, CAMERA, pose, tuple(order), lambda: maps)


def with_maps(view: FusionView, change: Callable[[FusionMaps], FusionMaps]) -> FusionView:
    return replace(view, load=lambda: change(view.load()))


def height(points: Floats, surface: Callable[[Floats, Floats], Floats]) -> Floats:
    """Signed distance (N,) above the surface, in pixels."""
    above = points @ NORMAL if surface is plane else np.linalg.norm(points, axis=1) - RADIUS
    return above / PIXEL


@pytest.mark.parametrize("surface", [plane, sphere])
@pytest.mark.parametrize("shape", [(72, 96), (36, 48), (50, 60)])
def test_points_lie_on_the_surface(
    surface: Callable[[Floats, Floats], Floats], shape: tuple[int, int]
) -> None:
    cloud, report = fuse(Scene(surface, shape=shape).views(), CONFIG)
    error = height(cloud.points, surface)
    bound = 1e-4 if surface is plane else 0.05 * (96 / shape[1]) ** 2
    assert abs(error.mean()) < min(bound, 0.05)
    assert np.abs(error).max() < 12 * bound
    truth = NORMAL if surface is plane else cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip((cloud.normals * truth).sum(1), -1, 1)))
    assert np.median(angles) < (0.1 if surface is plane else 3.0)
    assert report.points["0.jpg"] > 0.2 * np.prod(shape) * (1.0 if surface is plane else 0.5)


def test_no_sideways_bias() -> None:
    """The centre of the sphere that fits the cloud is the sphere's, to a fiftieth of a pixel."""
    cloud, _ = fuse(Scene(sphere).views(), CONFIG)
    system = np.concatenate([2 * cloud.points, np.ones((len(cloud), 1))], 1)
    centre = np.linalg.lstsq(system, (cloud.points**2).sum(1), rcond=None)[0][:3]
    assert np.abs(centre).max() / PIXEL < 0.02


@pytest.mark.parametrize("shape", [(72, 96), (36, 48)])
def test_colours_come_from_the_same_place(shape: tuple[int, int]) -> None:
    cloud, _ = fuse(Scene(plane, shape=shape).views(), CONFIG)
    truth = ramp(cloud.points)
    inside = (np.abs(truth - 127) < 100).all(1)
    error = (cloud.colors - truth)[inside]
    assert np.abs(error.mean(0)).max() < 0.1 * PIXEL * 40 + 0.1
    assert np.abs(error).max() < 1.5


@pytest.mark.parametrize("surface", [plane, sphere])
def test_outliers_are_removed(surface: Callable[[Floats, Floats], Floats]) -> None:
    def disturb(i: int, depth: Floats) -> Floats:
        rng = np.random.default_rng(i)
        wrong = np.zeros(depth.shape, bool)
        for row, col in rng.integers(0, (60, 84), (6, 2)):
            wrong[row : row + 10, col : col + 10] = True
        return np.where(wrong, depth * rng.uniform(0.6, 0.95), depth)

    cloud, report = fuse(Scene(surface, disturb=disturb).views(), replace(CONFIG, min_num_pixels=4))
    error = np.abs(height(cloud.points, surface))
    assert np.quantile(error, 0.95) < 0.1
    assert error.max() < 1.1 * CONFIG.max_depth_error * DISTANCE / PIXEL
    assert report.pixels["max_depth_bend"] > 0
    assert report.comparisons["max_depth_error"] > 0


def test_averaging_reduces_noise_without_bias() -> None:
    def disturb(i: int, depth: Floats) -> Floats:
        rng = np.random.default_rng(i)
        coarse = rng.standard_normal((4, 5))
        smooth = np.kron(coarse, np.ones((18, 20)))[:72, :96]
        return depth * (1 + 0.003 * smooth)

    config = replace(CONFIG, max_depth_bend=0.0, max_normal_error=90.0)
    cloud, _ = fuse(Scene(disturb=disturb).views(), config)
    error = height(cloud.points, plane) * PIXEL / DISTANCE
    assert abs(error.mean()) < 0.0006
    assert error.std() < 0.6 * 0.003


def test_nothing_is_fused_twice() -> None:
    cloud, _ = fuse(Scene().views(), CONFIG)
    gaps = cKDTree(cloud.points).query(cloud.points, k=2)[0][:, 1] / PIXEL
    assert np.quantile(gaps, 0.01) > 0.5
    assert gaps.min() > 0.3
    seen = cKDTree(cloud.points).query(cloud.points[::7], k=1, workers=1)[0]
    assert seen.max() == 0


@dataclass
class Vote:
    """Of a neighbour on the pixels (H, W) of a reference: whether it agrees, its relative depth error, its
    normal (H, W, 3) in the world and its position (3,)."""

    agrees: NDArray[np.bool_]
    error: Floats
    normal: Floats
    eye: Floats


def votes_by_hand(
    reference: FusionView, views: list[FusionView], config: FusionConfig
) -> tuple[Floats, Floats, list[Vote]]:
    """A plain twin of the vote: support and conflicts of every pixel of the reference, (H, W) each."""
    maps, pose = reference.load(), reference.cam_from_world
    shape = maps.depth.shape
    normals = maps.normal @ pose[:, :3]
    points = (rays(shape) * maps.depth[..., None] - pose[:, 3]) @ pose[:, :3]
    support, conflicts, votes = np.ones(shape), np.zeros(shape), []
    for other in (views[n] for n in reference.neighbours):
        theirs, move = other.load(), other.cam_from_world
        x, y, z = np.moveaxis(points @ move[:, :3].T + move[:, 3], -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            col = np.floor((CAMERA.fx * x / z + CAMERA.cx) * shape[1] / CAMERA.width)
            row = np.floor((CAMERA.fy * y / z + CAMERA.cy) * shape[0] / CAMERA.height)
        seen = (z > 0) & (col >= 0) & (col < shape[1]) & (row >= 0) & (row < shape[0])
        row, col = np.where(seen, row, 0).astype(int), np.where(seen, col, 0).astype(int)
        n, ray = theirs.normal[row, col], np.stack([x / z, y / z, np.ones_like(z)], -1)
        with np.errstate(invalid="ignore"):
            ratio = (n * rays(shape)[row, col]).sum(-1) / (n * ray).sum(-1)
        surface = theirs.depth[row, col] * np.where((ratio > 1 / 1.05) & (ratio < 1.05), ratio, 1)
        seen &= surface > 0
        off = (surface - z) / z / config.max_depth_error
        back = (ray * surface[..., None] - move[:, 3]) @ move[:, :3] @ pose[:, :3].T + pose[:, 3]
        here = rays(shape)
        du = CAMERA.fx * shape[1] / CAMERA.width * (back[..., 0] / back[..., 2] - here[..., 0])
        dv = CAMERA.fy * shape[0] / CAMERA.height * (back[..., 1] / back[..., 2] - here[..., 1])
        cosine = (n @ move[:, :3] * normals).sum(-1)
        agrees = (np.abs(off) <= 1) & (np.hypot(du, dv) <= config.max_reproj_error)
        agrees &= seen & (cosine >= np.cos(np.radians(config.max_normal_error)))
        support += agrees
        conflicts += seen & (off > 3)
        votes.append(Vote(agrees, off * config.max_depth_error, n @ move[:, :3], -move[:, :3].T @ move[:, 3]))
    return support, conflicts, votes


def means_by_hand(
    reference: FusionView, votes: list[Vote], widths: tuple[float, float]
) -> tuple[Floats, Floats]:
    """A plain twin of the robust mean: points and normals (H, W, 3) in the world."""
    maps, pose = reference.load(), reference.cam_from_world
    eye, own = -pose[:, :3].T @ pose[:, 3], maps.normal @ pose[:, :3]
    start = eye + (rays(maps.depth.shape) * maps.depth[..., None]) @ pose[:, :3]
    weight = np.stack([np.ones(maps.depth.shape), *(vote.agrees.astype(float) for vote in votes)])
    surface = np.stack([start, *(start + (start - v.eye) * v.error[..., None] for v in votes)])
    normal = np.stack([own, *(vote.normal for vote in votes)])
    away = np.abs(np.stack([((start - e) * own).sum(-1) for e in (eye, *(v.eye for v in votes))]))
    surface[weight == 0], normal[weight == 0] = 0, 0
    by_place, by_turn = weight, weight
    for _ in range(3):  # a plain mean, and two with weights
        point = (by_place[..., None] * surface).sum(0) / by_place.sum(0)[..., None]
        turn = (by_turn[..., None] * normal).sum(0)
        turn /= np.maximum(np.linalg.norm(turn, axis=-1, keepdims=True), 1e-9)
        with np.errstate(divide="ignore", invalid="ignore"):
            off = ((surface - point) * own).sum(-1) / away / widths[0]
        by_place = weight / (1 + off**2)
        by_turn = weight / (1 + ((normal - turn) ** 2).sum(-1) / widths[1] ** 2)
    return point, turn


@pytest.mark.parametrize("shape", [(72, 96), (36, 48)])
@pytest.mark.parametrize("noise", [0.003, 0.02])
def test_votes_and_means_agree_with_plain_twins(shape: tuple[int, int], noise: float) -> None:
    """With the filters off, the first view's points are those that the twin accepts, where it has them."""

    def disturb(i: int, depth: Floats) -> Floats:
        rng = np.random.default_rng(i)
        lumps = np.kron(rng.standard_normal((9, 12)), np.ones((shape[0] // 9, shape[1] // 12)))
        return depth * (1 + noise * lumps) * (rng.random(depth.shape) > 0.1)

    config = replace(
        CONFIG,
        min_num_pixels=3,
        max_reproj_error=0.5,
        max_normal_error=60.0,
        max_depth_bend=0.0,
        max_view_angle=90.0,
    )
    views = Scene(sphere, count=6, shape=shape, disturb=disturb).views()
    for view in views:
        drop = (view.load().normal == 0).all(-1)
        view.load().depth[drop] = 0
    support, conflicts, votes = votes_by_hand(views[0], views, config)
    accepted = (views[0].load().depth > 0) & (support >= 3) & (conflicts <= support)
    cloud = next(iter(fuse_views(views, config, FusionReport())))
    assert 0.01 * accepted.size < accepted.sum() < 0.98 * accepted.size
    lengths = np.diff(cloud.visibility.start)
    assert abs(len(cloud) - accepted.sum()) <= 2
    if len(cloud) == accepted.sum():
        same = lengths == support[accepted]
        assert same.mean() > 0.99
        with Workers(1) as workers:
            widths = _fusion_noise.widths(
                _fusion_noise.noise(Shelf(views, config, workers), views, config), config
            )
        points, normals = (array[accepted] for array in means_by_hand(views[0], votes, widths))
        assert np.abs(cloud.points - points)[same].max() < 2e-6 * DISTANCE
        assert np.abs(cloud.normals - normals)[same].max() < 1e-4


def test_every_pixel_is_accounted_for() -> None:
    _, report = fuse(Scene(sphere).views(), CONFIG)
    rest = sum(number for name, number in report.pixels.items() if name != "all")
    assert report.pixels["all"] == rest == 7 * SIZE[0] * SIZE[1]
    assert sum(report.points.values()) == report.pixels["points"]


def test_visibility_names_views_that_see_the_point() -> None:
    views = Scene(sphere).views()
    cloud, _ = fuse(views, CONFIG)
    by_index = {view.index: view for view in views}
    counts = np.diff(cloud.visibility.start)
    assert counts.min() >= CONFIG.min_num_pixels
    for i in range(0, len(cloud), 97):
        images = cloud.visibility[i].tolist()
        assert images == sorted(set(images))
        for image in images:
            pose = by_index[image].cam_from_world
            x, y, z = pose[:, :3] @ cloud.points[i] + pose[:, 3]
            col, row = int(CAMERA.fx * x / z + CAMERA.cx), int(CAMERA.fy * y / z + CAMERA.cy)
            assert abs(by_index[image].load().depth[row, col] / z - 1) < 0.05


def fused_bytes(views: list[FusionView], config: FusionConfig = CONFIG) -> tuple[bytes, ...]:
    cloud, _ = fuse(views, config)
    parts = (cloud.points, cloud.normals, cloud.colors, cloud.visibility.start, cloud.visibility.images)
    return tuple(part.tobytes() for part in parts)


def noisy_views(count: int = 7) -> list[FusionView]:
    return Scene(
        sphere, count, disturb=lambda i, d: d * np.random.default_rng(i).normal(1, 0.001, d.shape)
    ).views()


def test_the_order_of_a_neighbour_list_does_not_matter() -> None:
    views = noisy_views()
    turned = [replace(view, neighbours=view.neighbours[::-1]) for view in views]
    assert fused_bytes(views) == fused_bytes(turned)


def test_threads_and_repetition_give_identical_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """In pieces of 500 pixels and 7 rows, so that the threads really share a view of this size."""
    views = noisy_views(4)
    whole = fused_bytes(views)
    monkeypatch.setattr("colmap_tco._fusion_reference._RANGE", 500)
    monkeypatch.setattr("colmap_tco._fusion_shelf._ROWS", 7)
    for threads in (1, 2, 5, 5):
        assert fused_bytes(views, replace(CONFIG, num_threads=threads)) == whole
    monkeypatch.setattr("colmap_tco._fusion_reference._BLOCK_BYTES", 100_000)
    assert fused_bytes(views, replace(CONFIG, num_threads=5)) == whole


def test_a_small_cache_gives_the_same_cloud_in_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the report, and by the views that anything holds: one more than fits while the next is read."""
    views = noisy_views()
    whole = fused_bytes(views)
    _, generous = fuse(views, CONFIG)
    one, made, most = generous.peak_bytes / len(views), list[weakref.ref[ShelfView]](), 0

    def prepare(shelf: Shelf, position: int) -> ShelfView:
        nonlocal most
        view = read(shelf, position)
        made.append(weakref.ref(view))
        most = max(most, sum(ref() is not None for ref in made))
        return view

    read = Shelf._prepare
    monkeypatch.setattr(Shelf, "_prepare", prepare)
    for held in (1.0, 3.5, 5.2):
        most = 0
        config = replace(CONFIG, cache_size=held * one / 1e9)
        assert fused_bytes(views, config) == whole
        _, report = fuse(views, config)
        assert report.peak_bytes <= max(held, 2) * one
        assert report.loads > generous.loads == len(views)
        assert most <= max(int(held), 2) + 1


def test_the_report_tells_the_memory_of_the_points() -> None:
    """Of all of them, thinned out or not: 47 bytes, 4 for each view that agrees, and one number more."""
    cloud, report = fuse(noisy_views(), CONFIG)
    assert report.cloud_bytes == cloud.nbytes == 47 * len(cloud) + 4 * len(cloud.visibility.images) + 8
    few, thinned = fuse(noisy_views(), replace(CONFIG, max_points=100))
    assert len(few) <= 100 and thinned.cloud_bytes == report.cloud_bytes
    assert thinned.as_dict()["cloud_megabytes"] == round(cloud.nbytes / 1e6, 1) > 0


def test_far_coordinates_lose_nothing() -> None:
    offset = np.array([4.5e6, -3.1e6, 812.0])
    views = Scene(sphere).views()
    moved = []
    for view in views:
        pose = view.cam_from_world.copy()
        pose[:, 3] -= pose[:, :3] @ offset
        moved.append(replace(view, cam_from_world=pose))
    near, far = fuse(views, CONFIG)[0], fuse(moved, CONFIG)[0]
    assert len(near) == len(far)
    assert np.abs(far.points - offset - near.points).max() < 1e-6


@pytest.mark.parametrize("count", [2, 3])
def test_few_views_lower_the_number_that_must_agree(count: int) -> None:
    cloud, report = fuse(Scene(count=count).views(), CONFIG)
    assert len(cloud) == report.lowered > 1000
    assert set(np.diff(cloud.visibility.start).tolist()) == {count}


def test_a_single_view_confirms_nothing() -> None:
    with pytest.raises(DensifyError, match="min_num_pixels"):
        fuse(Scene(count=1).views(), CONFIG)
    cloud, _ = fuse(Scene(count=1).views(), replace(CONFIG, min_num_pixels=1))
    assert len(cloud) == SIZE[0] * SIZE[1]


def removed(name: str, maps: FusionMaps) -> FusionMaps:
    """Maps that one filter removes."""
    if name == "no_depth":
        return replace(maps, depth=maps.depth * 0)
    if name == "mask":
        return replace(maps, mask=np.zeros(maps.depth.shape, bool))
    if name == "min_confidence":
        return replace(maps, confidence=np.full(maps.depth.shape, 1.5, np.float32))
    if name == "no_normal":
        return replace(maps, normal=maps.normal * 0)
    if name == "max_view_angle":
        return replace(maps, normal=-maps.normal)
    if name == "max_depth_bend":
        return replace(
            maps, depth=maps.depth * (1 + 0.2 * (np.indices(maps.depth.shape).sum(0) % 2)).astype("f4")
        )
    return maps


@pytest.mark.parametrize(
    "name",
    [
        n
        for n in FILTERS
        if n not in ("max_agreed_error", "max_conflicts", "min_num_pixels", "min_tri_angle", "roi")
    ],
)
def test_an_empty_result_names_the_filter(name: str) -> None:
    views = [with_maps(view, lambda maps: removed(name, maps)) for view in Scene().views()]
    if name == "max_depth_ratio":
        views = [replace(view, reach=0.1 * DISTANCE) for view in views]
    with pytest.raises(DensifyError, match=FILTERS[name].split("(")[0]) as error:
        fuse(views, replace(CONFIG, min_confidence=2.0 if name == "min_confidence" else 1.0))
    assert str(7 * SIZE[0] * SIZE[1]) in str(error.value)


@pytest.mark.parametrize(
    ("test", "disturb"),
    [
        ("max_depth_error", lambda i, depth: depth * (1 + 0.02 * i)),
        ("max_normal_error", lambda i, depth: depth),
    ],
)
def test_an_empty_result_names_the_test_that_failed(
    test: str, disturb: Callable[[int, Floats], Floats]
) -> None:
    views = Scene(disturb=disturb).views()
    if test == "max_normal_error":
        turned = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]], np.float32)
        views[::2] = [with_maps(v, lambda m: replace(m, normal=m.normal @ turned)) for v in views[::2]]
    with pytest.raises(DensifyError, match=f"failed by {test}"):
        fuse(views, CONFIG)


@pytest.mark.parametrize("shape", [(72, 96), (36, 48)])
def test_reprojection_error_is_in_pixels_of_the_depth_map(shape: tuple[int, int]) -> None:
    """A depth error of 0.8 % over a baseline b moves the point by 0.008 f b / z pixels."""
    scene = Scene(count=2, shape=shape, disturb=lambda i, depth: depth * (1.004 if i % 2 else 0.996))
    baseline = np.linalg.norm(scene.eye(0) - scene.eye(1))
    moved = 0.008 * CAMERA.fx * baseline / DISTANCE * shape[1] / CAMERA.width
    assert len(fuse(scene.views(), replace(CONFIG, max_reproj_error=1.5 * moved))[0]) > 0.4 * np.prod(shape)
    with pytest.raises(DensifyError, match="failed by max_reproj_error"):
        fuse(scene.views(), replace(CONFIG, max_reproj_error=0.6 * moved))


def smooth_noise(i: int, shape: tuple[int, ...], sigma: float) -> Floats:
    """A field of standard deviation ``sigma`` that varies over some ten pixels."""
    field = np.random.default_rng(i).standard_normal(shape)
    for axis in (0, 1):
        field = uniform_filter1d(uniform_filter1d(field, 9, axis), 9, axis)
    return field * sigma / field.std()


@pytest.mark.parametrize("sigma", [0.003, 0.02])
def test_tolerances_widen_to_the_noise_of_the_depths(sigma: float) -> None:
    views = Scene(disturb=lambda i, depth: depth * (1 + smooth_noise(i, depth.shape, sigma))).views()
    adapted, report = fuse(views, replace(CONFIG, adapt_to_noise=True))
    strict = FusionReport()
    points = sum(len(part) for part in fuse_views(views, CONFIG, strict))
    assert report.tolerance is not None
    assert strict.tolerance == Tolerance(
        CONFIG.max_depth_error, CONFIG.max_reproj_error, CONFIG.max_normal_error
    )
    expected = max(0.01, 1.5 * 0.674 * np.sqrt(2) * sigma)
    assert report.tolerance.depth == pytest.approx(expected, rel=0.25)
    assert len(adapted) >= points
    assert report.pixels["already_fused"] > strict.pixels["already_fused"] or sigma < 0.01
    error = height(adapted.points, plane) * PIXEL / DISTANCE
    assert abs(error.mean()) < 0.25 * sigma
    assert error.std() < 0.8 * sigma


def test_exact_depths_keep_the_given_tolerances() -> None:
    _, report = fuse(Scene(plane).views(), replace(CONFIG, adapt_to_noise=True))
    assert report.tolerance == Tolerance(
        CONFIG.max_depth_error, CONFIG.max_reproj_error, CONFIG.max_normal_error
    )


def test_tolerances_are_bounded_where_nothing_agrees() -> None:
    views = Scene(
        disturb=lambda i, depth: depth * np.random.default_rng(i).uniform(0.9, 1.1, depth.shape)
    ).views()
    report = FusionReport()
    list(fuse_views(views, replace(CONFIG, adapt_to_noise=True, max_depth_bend=0.0), report))
    assert report.tolerance is not None
    assert report.tolerance.depth <= CONFIG.most_depth_error
    assert report.tolerance.reproj <= 4 * CONFIG.max_reproj_error
    assert report.tolerance.normal <= 45


def test_points_that_others_look_through_are_dropped() -> None:
    """A blob in front of the surface that two of eight views claim, and the other six see through."""

    def disturb(i: int, depth: Floats) -> Floats:
        point = np.array([0.0, 0.0, -1.0])
        if i not in (3, 4):
            return depth
        pose = look_at_origin(Scene(count=8).eye(i))
        x, y, z = pose[:, :3] @ point + pose[:, 3]
        row, col = int(CAMERA.fy * y / z + CAMERA.cy), int(CAMERA.fx * x / z + CAMERA.cx)
        rows, cols = np.indices(depth.shape)
        near = np.maximum(np.abs(rows - row), np.abs(cols - col)) < 8
        return np.where(near, z, depth)

    views = Scene(count=8, disturb=disturb).views()
    config = replace(CONFIG, min_num_pixels=2, max_normal_error=30.0)
    blob = height(fuse(views, replace(config, max_conflicts=0.0))[0].points, plane) > 5
    assert blob.sum() > 20
    cloud, report = fuse(views, config)
    assert not (height(cloud.points, plane) > 5).any()
    assert report.pixels["max_conflicts"] > 20


def test_confidence_widens_the_tolerance_when_asked() -> None:
    def maps_of(i: int, maps: FusionMaps) -> FusionMaps:
        scale = 1 + 0.02 * (-1) ** i
        return replace(maps, depth=maps.depth * np.float32(scale), confidence=np.full_like(maps.depth, 2.0))

    views = [with_maps(v, lambda m, i=i: maps_of(i, m)) for i, v in enumerate(Scene().views())]  # type: ignore[misc]
    config = replace(CONFIG, max_reproj_error=10.0)
    few = fuse(views, replace(config, min_num_pixels=3))[0]
    assert np.diff(few.visibility.start).max() == 4
    wide = fuse(views, replace(config, sigma_at_one=0.06))[0]
    assert np.diff(wide.visibility.start).max() == 7
    with pytest.raises(DensifyError):
        fuse(views, replace(config, sigma_at_one=0.06, most_depth_error=0.01))


def test_confident_views_weigh_more() -> None:
    def maps_of(i: int, maps: FusionMaps) -> FusionMaps:
        sure = i == 3
        depth = maps.depth if sure else maps.depth * np.float32(1.004)
        return replace(maps, depth=depth, confidence=np.full_like(maps.depth, 200.0 if sure else 2.0))

    views = [with_maps(v, lambda m, i=i: maps_of(i, m)) for i, v in enumerate(Scene().views())]  # type: ignore[misc]
    cloud, _ = fuse(views, CONFIG)
    sure = np.array([16 in cloud.visibility[i] for i in range(len(cloud))])
    off = np.abs(height(cloud.points, plane)) * PIXEL / DISTANCE
    assert np.median(off[sure]) < 0.001
    assert np.median(off[~sure]) > 0.003


def test_streaming_yields_one_cloud_a_view() -> None:
    report = FusionReport()
    parts = list(fuse_views(Scene().views(), CONFIG, report))
    assert [len(part) for part in parts] == list(report.points.values())
    assert report.as_dict()["points_by_view"] == report.points


@pytest.mark.parametrize("neighbours", [(0,), (1, 1), (7,), (-1,)])
def test_refuses_neighbours_that_are_not_other_views(neighbours: tuple[int, ...]) -> None:
    views = Scene().views()
    views[0] = replace(views[0], neighbours=neighbours)
    with pytest.raises(ValueError, match=r"0\.jpg: neighbours"):
        fuse(views, CONFIG)


@pytest.mark.parametrize(
    "change",
    [
        lambda m: replace(m, normal=m.normal[:-1]),
        lambda m: replace(m, confidence=m.depth[1:]),
        lambda m: replace(m, image=m.image.astype(float)),
        lambda m: replace(m, depth=m.depth * np.nan),
    ],
)
def test_refuses_maps_that_do_not_fit(change: Callable[[FusionMaps], FusionMaps]) -> None:
    views = Scene().views()
    views[1] = with_maps(views[1], change)
    with pytest.raises(ValueError, match=r"1\.jpg"):
        fuse(views, CONFIG)


@pytest.mark.parametrize("wrong", [0.0, np.nan, np.inf])
def test_confidences_must_be_numbers_above_zero_where_a_pixel_takes_part(wrong: float) -> None:
    def with_confidence(where: tuple[int, int]) -> list[FusionView]:
        def change(maps: FusionMaps) -> FusionMaps:
            confidence, depth = np.full(maps.depth.shape, 5.0, np.float32), maps.depth.copy()
            confidence[where], depth[0, 0] = wrong, 0.0
            return replace(maps, confidence=confidence, depth=depth)

        return [with_maps(view, change) for view in Scene().views()]

    config = replace(CONFIG, min_confidence=0.0)
    cloud, _ = fuse(with_confidence((0, 0)), config)
    assert np.isfinite(cloud.points).all()
    with pytest.raises(ValueError, match="confidences above 0"):
        fuse(with_confidence((30, 40)), config)


def test_confidence_that_is_asked_for_must_be_there() -> None:
    with pytest.raises(ValueError, match=r"0\.jpg: .* needs a confidence"):
        fuse(Scene().views(), replace(CONFIG, sigma_at_one=1.5))


def test_guesses_are_dropped_by_default_and_maps_without_confidence_are_not() -> None:
    """An error of 30 % is expected of the left half of each map, of 10 % of the right one."""

    def half(maps: FusionMaps) -> FusionMaps:
        left = np.arange(maps.depth.shape[1]) < maps.depth.shape[1] // 2
        both = np.where(left, 1 + 0.02 / 0.3, 1 + 0.02 / 0.1).astype(np.float32)
        return replace(maps, confidence=np.broadcast_to(both, maps.depth.shape).copy())

    views = Scene().views()
    assert fuse(views, FusionConfig())[1].pixels["min_confidence"] == 0
    _, report = fuse([with_maps(view, half) for view in views], FusionConfig())
    assert report.pixels["min_confidence"] == 7 * SIZE[0] * SIZE[1] // 2


@pytest.mark.parametrize("name", ["min_num_pixels", "max_depth_error", "cache_size"])
def test_refuses_settings_out_of_range(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        fuse(Scene().views(), replace(CONFIG, **{name: 0}))
