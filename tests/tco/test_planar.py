"""Planes among depths: the least energy, planes that are found and their errors, pixels that take them."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.consensus import Agreement, agreed
from tco.options import ConsensusConfig
from tco.planar import run
from tco.planar._kernels import least_labels
from tco.planar.fit import ALIKE, DRAWN, LEAST, _chosen, _drawn, _Pixels, find, refit, votes_for
from tco.planar.label import ACROSS, BINS, MOST_UNLIKE, borders, labelled, rarity
from tco.planar.run import flattened, together
from tco.planar.view import ERROR, SIDE, Floats, Labels, Plane, Shown, normals, shown
from tco.toy import Wall, wall
from tco.types import Cameras, Prediction, Views

SLOPE = 0.3
NORMAL = np.array([-SLOPE, 0, 1]) / math.hypot(SLOPE, 1)
OFFSET = 2 / math.hypot(SLOPE, 1)
CONFIG = ConsensusConfig()
TERMS = (0.1, 0.1)


@pytest.fixture(scope="module")
def scene() -> Wall:
    return wall(6, (96, 128), SLOPE)


def cameras(scene: Wall) -> Cameras:
    assert scene.priors.cameras is not None
    return scene.priors.cameras


def agreement(scene: Wall, depth: Tensor, confidence: Tensor | float = 6.0) -> Agreement:
    sure = torch.as_tensor(confidence) * torch.ones_like(depth)
    prediction = Prediction(depth, sure, cameras(scene), tuple(range(len(depth))))
    return Agreement(prediction, torch.full_like(depth, 0.01))


def seen(scene: Wall, depth: Tensor, confidence: Tensor | float = 6.0, stride: int = 1) -> list[Shown]:
    prediction = agreement(scene, depth, confidence).prediction
    return [shown(prediction, cameras(scene), scene.views, i, stride) for i in range(len(depth))]


def noisy(scene: Wall, share: float, seed: int = 0) -> Tensor:
    """Depths with errors of a few pixels' length, of this standard deviation."""
    coarse = torch.randn(len(scene.depth), 1, 24, 32, generator=torch.Generator().manual_seed(seed))
    waves = torch.nn.functional.interpolate(coarse, scene.depth.shape[1:], mode="bilinear")[:, 0]
    return scene.depth * (1 + share * waves / waves.std())


def energy(labels: np.ndarray, unary: Floats, logs: Floats, right: Floats, down: Floats) -> float:  # type: ignore[type-arg]
    """As the module's docstring has it, term by term."""
    tau, kappa = TERMS
    h, w = labels.shape
    total = 0.0
    for y, x in itertools.product(range(h), range(w)):
        one = labels[y, x]
        total += float(unary[y, x, one])
        for (v, u), weight in (((y, x + 1), right[y, x]), ((y + 1, x), down[y, x])):
            if v < h and u < w and not (one == labels[v, u] and one > 0):
                step = min(1, abs(float(logs[y, x, one] - logs[v, u, labels[v, u]])) / tau)
                total += float(weight) * (step + kappa * (one != labels[v, u]))
    return total


def puzzle(seed: int, shape: tuple[int, int], labels: int = 3) -> tuple[Floats, Floats, Floats, Floats]:
    rng = np.random.default_rng(seed)
    unary = rng.random((*shape, labels), np.float32)
    logs = (0.1 * rng.standard_normal((*shape, labels))).astype(np.float32)
    return unary, logs, *rng.random((2, *shape), np.float32)


@pytest.mark.parametrize("shape", [(1, 6), (6, 1), (2, 3), (3, 2)])
@pytest.mark.parametrize("seed", range(4))
def test_labels_have_the_least_energy(shape: tuple[int, int], seed: int) -> None:
    """Exact on a line; on a grid these small problems are solved, too."""
    problem = puzzle(seed, shape)
    found = energy(least_labels(*problem, TERMS, 20), *problem)
    every = itertools.product(range(3), repeat=shape[0] * shape[1])
    least = min(energy(np.array(labels).reshape(shape), *problem) for labels in every)
    assert found == pytest.approx(least, rel=1e-5 if 1 in shape else 0.03)


@pytest.mark.parametrize("labels", [1, 7, 8, 9])
def test_any_number_of_labels_will_do(labels: int) -> None:
    """Loops are over a multiple of eight; what is added to have that is never taken."""
    problem = puzzle(3, (1, 4), labels)
    found = least_labels(*problem, TERMS, 20)
    every = itertools.product(range(labels), repeat=4)
    least = min(energy(np.array(each).reshape(1, 4), *problem) for each in every)
    assert energy(found, *problem) == pytest.approx(least, rel=1e-5)


def test_a_plane_costs_nothing_within_and_a_surface_its_steps() -> None:
    """Two labels with the same steep depths: without costs of their own the plane is taken everywhere."""
    logs = np.repeat(0.05 * np.arange(8, dtype=np.float32)[None, :, None], 2, -1).repeat(5, 0)
    unary = np.zeros_like(logs)
    unary[..., 1] = 0.2
    ones = np.ones(logs.shape[:2], np.float32)
    assert (least_labels(unary, logs, ones, ones, TERMS, 3) == 1).all()
    assert (least_labels(unary, np.zeros_like(logs), ones, ones, TERMS, 3) == 0).all()


def test_depth_of_the_plane_is_the_walls(scene: Wall) -> None:
    plane = Plane(NORMAL, OFFSET, np.zeros(3), np.zeros((2, 3)), np.zeros((3, 3)))
    for stride in (1, 2, 3):
        for i, view in enumerate(seen(scene, scene.depth, stride=stride)):
            assert np.allclose(plane.depth(view), view.depth, rtol=1e-5), (stride, i)
    turned = Plane(-NORMAL, -OFFSET, plane.centre, plane.axes, plane.covariance)
    assert np.allclose(turned.depth(view), view.depth, rtol=1e-5)
    behind = Plane(NORMAL, -OFFSET, plane.centre, plane.axes, plane.covariance)
    assert (behind.depth(view) == 0).all()


def test_error_of_a_plane_is_the_spread_of_its_depth(scene: Wall) -> None:
    """Planes drawn by the covariance meet the rays with a relative spread that is the stated error."""
    view = seen(scene, scene.depth, stride=8)[1]
    axes = np.stack([np.cross(NORMAL, [0.0, 1.0, 0.0]), [0.0, 1.0, 0.0]])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    root = 0.002 * np.array([[1, 0.3, 0], [0, 1.5, 0.2], [0, 0, 1.2]])
    centre = np.array([0.2, 0.1, 2 + 0.2 * SLOPE])
    plane = Plane(NORMAL, OFFSET, centre, axes, root.T @ root)
    rng, depths = np.random.default_rng(0), []
    for a, b, c in rng.standard_normal((4000, 3)) @ root:
        # The surface centre + u e1 + v e2 + (a u + b v + c) n, as a plane again.
        normal = NORMAL - a * axes[0] - b * axes[1]
        offset = normal @ (centre + c * NORMAL)
        depths.append(replace(plane, normal=normal, offset=offset).depth(view))
    spread = np.std(depths, 0) / plane.depth(view)
    assert np.allclose(plane.error(view, plane.depth(view)), spread, rtol=0.06)


def test_pixels_vote_for_the_planes_that_they_are_on(scene: Wall) -> None:
    """The compiled sums are those of ``near``."""
    view = seen(scene, noisy(scene, 0.02), 3.0)[0]
    rng, n = np.random.default_rng(4), normals(view)
    pick = np.flatnonzero((n != 0).any(-1))
    pixels = _Pixels.of(view, pick, n.reshape(-1, 3)[pick])
    planes = pixels[rng.choice(len(pick), 40)]
    offsets = (planes.points * planes.normals).sum(-1) + rng.normal(0, 0.02, 40)
    found = votes_for(pixels, planes.normals, offsets)
    for normal, offset, votes in zip(planes.normals, offsets, found, strict=True):
        assert votes == pytest.approx(float(pixels.weight @ pixels.near(normal, offset)), rel=2e-3)
    assert found.min() < 0.5 * found.max()


def test_a_pixel_more_or_less_changes_one_that_is_drawn(scene: Wall) -> None:
    """And so nothing else depends on it: what is drawn of all other views stays as it was."""

    def places(views: list[Shown]) -> set[tuple[float, ...]]:
        drawn, lots = _drawn(views, 40, np.random.default_rng(0))
        assert len(drawn.depth) == 6 * 750
        return set(map(tuple, np.column_stack([drawn.points, lots])))

    views, full = seen(scene, noisy(scene, 0.02)), places(seen(scene, noisy(scene, 0.02)))
    sure = views[2].sure.copy()
    points = views[2].points.reshape(-1, 3)
    gone = next(i for i in range(2000, len(points)) if tuple(points[i]) in {row[:3] for row in full})
    sure.flat[gone] = 0
    other = places([*views[:2], replace(views[2], sure=sure), *views[3:]])
    assert len(full - other) == len(other - full) == 1
    assert next(iter(full - other))[:3] == tuple(points[gone])


def test_planes_are_drawn_by_weight_and_judges_without(scene: Wall) -> None:
    """Three times the weight is three times the chance; at every turn others are drawn."""
    view = seen(scene, scene.depth)[0]
    pick, lots = np.arange(view.depth.size), np.random.default_rng(1).random(view.depth.size)
    pixels = _Pixels.of(view, pick, np.broadcast_to(NORMAL, (len(pick), 3)))
    heavy = np.random.default_rng(2).random(len(pick)) < 0.5
    pixels = replace(pixels, weight=np.where(heavy, 3.0, 1.0), error=heavy.astype(float))
    drawn, judges = zip(*(_chosen(pixels, lots, turn) for turn in range(32)), strict=True)
    share = np.mean([part.error.mean() for part in drawn])
    assert share == pytest.approx(0.75 * heavy.mean() / (0.25 + 0.5 * heavy.mean()), abs=0.015)
    assert np.mean([part.error.mean() for part in judges]) == pytest.approx(heavy.mean(), abs=0.01)
    assert all(len(part.depth) == DRAWN for part in drawn)
    once = len(np.unique(np.concatenate([part.points for part in drawn]), axis=0))
    assert once > 0.6 * min(32 * DRAWN, len(pick))


def test_the_wall_is_found_among_outliers(scene: Wall) -> None:
    depth = noisy(scene, 0.005)
    depth[:, :, 90:] *= 1.5
    confidence = torch.full_like(depth, 6.0)
    confidence[:, :, 90:] = 1.5
    planes = find(seen(scene, depth, confidence), 6, CONFIG, np.random.default_rng(0))
    best = planes[0]
    side = math.copysign(1, best.normal @ NORMAL)
    assert abs(best.normal @ NORMAL) > math.cos(math.radians(1.0))
    assert side * best.offset == pytest.approx(OFFSET, rel=0.01)


def test_no_more_planes_than_asked_and_none_that_explain_little(scene: Wall) -> None:
    depth = scene.depth.clone()
    depth[:, :, 64:] *= 1.3
    views = seen(scene, depth)
    assert len(find(views, 6, CONFIG, np.random.default_rng(0))) >= 2
    one = find(views, 6, replace(CONFIG, planes=1), np.random.default_rng(0))
    assert len(one) == 1
    assert len(find(views, 6, replace(CONFIG, plane_share=0.6), np.random.default_rng(0))) == 0


def fitted(scene: Wall, depth: Tensor, confidence: float) -> Plane:
    views = seen(scene, depth, confidence)
    start = find(views, 6, replace(CONFIG, planes=1), np.random.default_rng(0))
    labels = [np.ones(view.depth.shape, np.int64) for view in views]
    return refit(views, labels, start, CONFIG)[0]


def test_covariance_is_that_of_so_many_independent_errors(scene: Wall) -> None:
    """At the centre the variance is that of σ d |n·r| over n = V / ALIKE errors, and goes with σ²."""
    plane = fitted(scene, scene.depth, 2.0)
    at_centre = math.sqrt(plane.covariance[2, 2])
    views = seen(scene, scene.depth)
    across = np.stack([view.depth * np.abs(view.directions @ NORMAL) for view in views])
    inverse = np.mean(1 / across**2)
    assert at_centre == pytest.approx(ERROR / math.sqrt(inverse * 6 / ALIKE), rel=0.1)
    surer = fitted(scene, scene.depth, 1 + ERROR / LEAST)
    assert np.allclose(surer.covariance, plane.covariance * (LEAST / ERROR) ** 2, rtol=1e-3)


def test_refit_forgets_planes_that_few_took(scene: Wall) -> None:
    views = seen(scene, scene.depth)
    planes = find(views, 6, CONFIG, np.random.default_rng(0))
    labels = [np.zeros(view.depth.shape, np.int64) for view in views]
    assert refit(views, labels, planes, CONFIG) == []


def patch(scene: Wall) -> Tensor:
    """Where (V, H, W) one world region is, of a third of the wall's width."""
    x = torch.stack([torch.from_numpy(view.points) for view in seen(scene, scene.depth)])[..., :2]
    return (x.abs() < 0.35).all(-1)


def test_unsure_bumps_go_and_sure_ones_stay(scene: Wall) -> None:
    there, depth = patch(scene), scene.depth.clone()
    assert 0.03 < there.float().mean() < 0.3
    depth[there] *= 0.88 * (noisy(scene, 0.1) / scene.depth)[there]
    confidence = torch.full_like(depth, 15.0)
    confidence[there] = 1.02
    flat = flattened(agreement(scene, depth, confidence), cameras(scene), scene.views, CONFIG)
    off = (flat.agreement.prediction.depth / scene.depth - 1).abs()
    assert (flat.labels[there] > 0).float().mean() > 0.95
    assert off[there].median() < 2e-3
    sure = flattened(agreement(scene, depth, 15.0), cameras(scene), scene.views, CONFIG)
    kept = (sure.agreement.prediction.depth / depth - 1).abs()
    assert kept[there].median() < 5e-3
    assert (kept[there] < 0.02).float().mean() > 0.97


def test_noise_on_a_wall_falls(scene: Wall) -> None:
    depth = noisy(scene, 0.01)
    given = agreement(scene, depth, 1.5)
    flat = flattened(given, cameras(scene), scene.views, CONFIG).agreement.prediction.depth
    before, after = ((d / scene.depth - 1).square().mean().sqrt() for d in (depth, flat))
    assert after < 0.2 * before


def test_a_curved_surface_stays_curved(scene: Wall) -> None:
    """A ball of diameter of the picture before the wall: no point of it moves by more than it is unsure."""
    h, w = scene.depth.shape[1:]
    y, x = torch.meshgrid(torch.linspace(-0.75, 0.75, h), torch.linspace(-1, 1, w), indexing="ij")
    ball = 1.2 - 0.5 * (1 - x**2 - y**2).clamp_min(0).sqrt()
    depth = torch.where(x**2 + y**2 < 1, ball.clamp(max=1.2), scene.depth)
    flat = flattened(agreement(scene, depth, 12.0), cameras(scene), scene.views, CONFIG)
    moved = (flat.agreement.prediction.depth / depth).log().abs()[:, x**2 + y**2 < 0.9]
    assert moved.median() < 0.01
    assert torch.quantile(moved.reshape(-1)[::7], 0.99) < 0.05


def test_what_does_not_count_stays(scene: Wall) -> None:
    depth = noisy(scene, 0.01)
    depth[0, 10:20, 10:20] = 0
    depth[1, 30:40, 30:40] = math.inf
    valid = scene.views.valid.clone()
    valid[2, :, :30] = False
    views = replace(scene.views, valid=valid, helpers=2)
    before = depth.clone()
    flat = flattened(agreement(scene, depth, 1.5), cameras(scene), views, CONFIG)
    after = flat.agreement.prediction.depth
    assert torch.equal(depth, before)
    for where in (
        (0, slice(10, 20), slice(10, 20)),
        (1, slice(30, 40), slice(30, 40)),
        (2, slice(None), slice(30)),
    ):
        assert torch.equal(after[where], before[where])
        assert not flat.labels[where].any()
    assert torch.equal(after[4:], before[4:])
    assert (after[0, 40:60] != before[0, 40:60]).float().mean() > 0.9


def test_nothing_to_see_is_no_error(scene: Wall) -> None:
    none = torch.zeros_like(scene.depth)
    flat = flattened(agreement(scene, none), cameras(scene), scene.views, CONFIG)
    assert torch.equal(flat.agreement.prediction.depth, none)
    assert flat.planes == ()
    one = Views(scene.views.images[:1], scene.views.valid[:1], ("one",))
    alone = Agreement(
        Prediction(scene.depth[:1], torch.full_like(scene.depth[:1], 6.0), cameras(scene)[:1], (0,)),
        torch.full_like(scene.depth[:1], math.inf),
    )
    found = flattened(alone, cameras(scene)[:1], one, CONFIG)
    assert torch.allclose(found.agreement.prediction.depth, scene.depth[:1], rtol=1e-3)


def test_the_same_seed_gives_the_same_depths_on_any_number_of_threads(scene: Wall) -> None:
    depth, threads = noisy(scene, 0.01), torch.get_num_threads()
    try:
        found = []
        for count in (1, 2):
            torch.set_num_threads(count)
            flat = flattened(agreement(scene, depth, 1.5), cameras(scene), scene.views, CONFIG, 3)
            found.append(flat.agreement.prediction.depth)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*found)
    assert not torch.equal(found[0], depth)


def test_unit_of_length_does_not_matter(scene: Wall) -> None:
    depth = noisy(scene, 0.01)
    pose = cameras(scene).world_from_cam.clone()
    pose[:, :3, 3] *= 4
    small = flattened(agreement(scene, depth, 1.5), cameras(scene), scene.views, CONFIG)
    large = flattened(
        agreement(scene, 4 * depth, 1.5), Cameras(pose, cameras(scene).K), scene.views, CONFIG
    )  # fmt: skip
    assert (small.labels > 0).any()
    assert torch.equal(small.labels, large.labels)
    assert torch.allclose(4 * small.agreement.prediction.depth, large.agreement.prediction.depth, rtol=1e-5)


def test_colours_that_are_not_on_the_plane_are_rare_there() -> None:
    """Half the view is on the plane and red, half is blue: blue is e^MOST rarer, red is not rare."""
    colours = np.zeros((4, 8), np.int64)
    red, blue = (BINS - 1) * BINS**2, BINS - 1
    colours[:, :4], colours[:, 4:] = red, blue
    near = (colours == red).astype(np.float32)
    found, hardly = rarity(colours, np.ones((4, 8)), np.stack([near, 1e-5 * near]))
    assert found[red] == 0
    assert found[blue] == MOST_UNLIKE
    assert 0 < hardly[blue] < 1e-2


def test_borders_follow_the_picture_and_spare_what_has_no_depth(scene: Wall) -> None:
    view = seen(scene, scene.depth)[0]
    image = np.zeros_like(view.image)
    image[:, 64:] = 0.5
    known = np.ones_like(view.known)
    known[10, 10] = False
    right, down = borders(replace(view, image=image, known=known), 2.0)
    whole = 2.0 * math.sqrt(view.depth.size) / SIDE
    assert right[50, 20] == pytest.approx(whole)
    assert right[50, 63] == pytest.approx(ACROSS * whole, rel=1e-3)
    assert down[50, 63] == pytest.approx(whole)
    assert right[10, 10] == right[10, 9] == down[10, 10] == down[9, 10] == 0
    assert (right[:, -1] == 0).all()
    assert (down[-1] == 0).all()


def test_a_plane_that_is_not_known_well_is_not_taken(scene: Wall) -> None:
    """The same plane, once with an error of 0.1 % and once of 30 %, against depths that are unsure."""
    view = seen(scene, 0.97 * noisy(scene, 0.01), 1.2)[0]
    axes = np.stack([np.cross(NORMAL, [0.0, 1.0, 0.0]), [0.0, 1.0, 0.0]])
    taken = []
    for error in (0.001, 0.3):
        plane = Plane(NORMAL, OFFSET, np.array([0.0, 0, 2]), axes, np.diag([0, 0, (2 * error) ** 2]))
        taken.append(float((labelled(view, [plane], CONFIG) == 1).mean()))
    assert taken[0] > 0.95
    assert taken[1] == 0


def test_consensus_comes_first_and_uncertain_cameras_keep_their_depths(scene: Wall) -> None:
    depth = noisy(scene, 0.01)
    prediction = agreement(scene, depth, 1.5).prediction
    asked = agreed(prediction, cameras(scene), scene.views, scene.priors, CONFIG)
    none = together(prediction, cameras(scene), scene.views, scene.priors, replace(CONFIG, planes=0))
    assert torch.equal(none.agreement.prediction.depth, asked.prediction.depth)
    some = together(prediction, cameras(scene), scene.views, scene.priors, CONFIG)
    expected = flattened(asked, cameras(scene), scene.views, CONFIG)
    assert torch.equal(some.agreement.prediction.depth, expected.agreement.prediction.depth)
    assert (some.agreement.error >= asked.error).all()
    assert torch.equal(some.agreement.error[some.labels == 0], asked.error[some.labels == 0])
    assert torch.equal(some.before.prediction.depth, asked.prediction.depth)
    assert torch.equal(some.before.error, asked.error)
    alone = together(
        prediction, cameras(scene), scene.views, scene.priors, replace(CONFIG, consensus_rounds=0)
    )
    assert torch.equal(alone.agreement.prediction.depth, depth)
    assert (some.labels > 0).float().mean() > 0.5
    assert scene.priors.rotation_sigma is not None
    unsure = replace(scene.priors, rotation_sigma=100 * scene.priors.rotation_sigma)
    kept = together(prediction, cameras(scene), scene.views, unsure, CONFIG)
    assert torch.equal(kept.agreement.prediction.depth, depth)
    assert not kept.labels.any()


def test_planes_that_few_views_see_are_kept() -> None:
    """Ten views of one wall and three of an oblique one: in whatever order, each gets its plane."""
    front, back = wall(10, (96, 128), SLOPE), wall(13, (96, 128), -1.2)
    truth = torch.cat([front.depth, back.depth[10:]])
    depth = noisy_of(truth)
    poses = torch.cat([cameras(front).world_from_cam, cameras(back).world_from_cam[10:]])
    both = Cameras(poses, cameras(back).K)
    images = torch.cat([front.views.images, back.views.images[10:]])
    names = tuple(map(str, range(13)))
    for shift in range(3):
        order = torch.arange(13).roll(shift)
        given = Prediction(depth[order], torch.full_like(depth, 1.5), both[order], tuple(range(13)))
        views = Views(images[order], torch.ones_like(depth, dtype=torch.bool), names)
        flat = flattened(Agreement(given, torch.full_like(depth, 0.01)), both[order], views, CONFIG)
        on = flat.labels > 0
        assert len(flat.planes) == 2
        assert (on.float().mean((1, 2)) > torch.where(order < 10, 0.9, 0.5)).all()
        off = (flat.agreement.prediction.depth / truth[order] - 1).abs()
        assert all(off[i][on[i]].median() < 0.003 for i in range(13))


def noisy_of(depth: Tensor) -> Tensor:
    """With errors of 1 %."""
    coarse = torch.randn(len(depth), 1, 24, 32, generator=torch.Generator().manual_seed(5))
    waves = torch.nn.functional.interpolate(coarse, depth.shape[1:], mode="bilinear")[:, 0]
    return depth * (1 + 0.01 * waves / waves.std())


def test_what_is_no_number_harms_its_own_pixels_alone(scene: Wall) -> None:
    depth, confidence = noisy(scene, 0.01), torch.full_like(scene.depth, 1.5)
    depth[0, 5, 5], confidence[0, 5, 5] = 0, math.inf
    confidence[1, 40:44, 40:44] = math.nan
    images = scene.views.images.clone()
    images[2, :, 8, 8] = math.nan
    views = replace(scene.views, images=images)
    flat = flattened(agreement(scene, depth, confidence), cameras(scene), views, CONFIG)
    assert ((flat.labels > 0).float().mean((1, 2)) > 0.8).all()
    assert torch.isfinite(flat.agreement.prediction.depth).all()


def test_colours_that_nothing_sure_shows_are_not_rare() -> None:
    colours = np.array([[0, BINS**3 - 1]])
    sure = np.array([[1.0, 0.0]])
    near = np.ones((1, 1, 2), np.float32)
    assert (rarity(colours, sure, near)[0, colours] == 0).all()
    assert (rarity(colours, np.zeros((1, 2)), near) == 0).all()


def test_a_plane_behind_the_camera_is_never_taken() -> None:
    """A floor and its horizon: above it, keeping the depth is all there is, however smooth it shall be."""
    floor = wall(3, (48, 64), 0.0)
    normal = np.array([0.0, 1.0, 0.0])
    prediction = Prediction(floor.depth, torch.full_like(floor.depth, 1.02), cameras(floor), (0, 1, 2))
    views = [shown(prediction, cameras(floor), floor.views, i) for i in range(3)]
    plane = Plane(normal, 1.0, np.array([0.0, 1, 2]), np.eye(3)[[0, 2]], np.zeros((3, 3)))
    for view in views:
        label = labelled(view, [plane], replace(CONFIG, plane_smoothness=20.0))
        assert not label[plane.depth(view) == 0].any()


def test_labels_of_large_pictures_are_coarser_and_their_depths_are_not(
    scene: Wall, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []

    def counted(view: Shown, *args: Any, **kwargs: Any) -> Labels:
        sizes.append(view.depth.size)
        return labelled(view, *args, **kwargs)

    monkeypatch.setattr(run, "LARGEST", 4000)
    monkeypatch.setattr(run, "labelled", counted)
    depth = noisy(scene, 0.01)
    flat = flattened(agreement(scene, depth, 1.5), cameras(scene), scene.views, CONFIG)
    assert max(sizes[:-6]) <= 2000 < max(sizes[-6:]) <= 4000
    label = flat.labels[0]
    assert torch.equal(label[::2, ::2], label[1::2, 1::2])
    on = flat.labels > 0
    assert on.float().mean() > 0.75
    off = (flat.agreement.prediction.depth / scene.depth - 1).abs()[on]
    assert off.max() < 0.01
