"""Depths refined by the pictures: what the field can say, what is found, what is left as it was."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.geometry import invert, project, transform, unproject
from tco.optimize import optimize
from tco.options import PolishConfig, TCOConfig
from tco.polish import EDGE, DepthField, _Polishing, displacement, picture_edges, polish, roughness
from tco.terms import Terms
from tco.toy import Toy, Wall, wall
from tco.types import Prediction

CONFIG = TCOConfig(
    camera_rate=0,
    polish=PolishConfig(
        polish_looks=12, polish_rate=1e-2, polish_sources=2, polish_levels=(4, 16), polish_smoothness=0.0
    ),
)


@pytest.fixture(scope="module")
def scene() -> Wall:
    return wall()


def bump(scene: Wall, height: float) -> Tensor:
    """Factors (V, H, W) of depth: 1 + height in the middle of each view, falling off smoothly."""
    _, h, w = scene.depth.shape
    y = torch.linspace(-1, 1, h).unsqueeze(1)
    x = torch.linspace(-1, 1, w)
    return (1 + height * torch.exp(-4 * (x**2 + y**2))).expand_as(scene.depth)


def predicted(scene: Wall, factor: Tensor) -> Prediction:
    """The true depth times factors, with a confidence of 10."""
    assert scene.priors.cameras is not None
    depth = scene.depth * factor
    return Prediction(depth, torch.full_like(depth, 10.0), scene.priors.cameras, tuple(range(len(depth))))


def refined(scene: Wall, prediction: Prediction, config: TCOConfig = CONFIG, seed: int = 0) -> Prediction:
    terms = Terms(scene.views, scene.priors, config)
    draw = torch.Generator().manual_seed(seed)
    return polish(prediction, prediction.cameras, terms, config, draw).prediction


def off(prediction: Prediction, scene: Wall) -> float:
    return float((prediction.depth / scene.depth - 1).abs().mean())


def test_the_field_is_nothing_at_first_and_a_sum_of_its_levels() -> None:
    depth = torch.ones(3, 21, 30)
    field = DepthField(depth, (1, 4, 16))
    assert [tuple(g.shape) for g in field.grids] == 3 * [(1, 21, 30), (1, 6, 8), (1, 2, 2)]
    assert torch.equal(field([0, 2]), torch.zeros(2, 21, 30))
    with torch.no_grad():
        for grid, value in zip(list(field.grids)[3:6], (1.0, 10.0, 100.0), strict=True):
            grid.fill_(value)
    torch.testing.assert_close(field([1, 0]), torch.stack([torch.full((21, 30), 111.0), torch.zeros(21, 30)]))


def test_only_the_views_that_were_looked_at_move() -> None:
    """Adam's memory of a view neither moves it on nor fades while other views are looked at."""
    field = DepthField(torch.ones(2, 8, 8), (2, 4))
    optimiser = torch.optim.Adam(field.parameters(), 0.1)
    for view in (0, 1, 1):
        before = field([1 - view]).detach().clone()
        optimiser.zero_grad(set_to_none=True)
        field([view]).sum().backward()
        optimiser.step()
        torch.testing.assert_close(field([1 - view]), before, rtol=0, atol=0)
        assert float(field([view]).detach().abs().min()) > 0


def test_a_level_is_linear_between_the_middles_of_its_cells() -> None:
    """A ramp over the cells is that ramp over the pixels: their centres are at +0.5, those of cells at +2."""
    field = DepthField(torch.ones(1, 16, 24), (4,))
    with torch.no_grad():
        field.grids[0][0] = 4 * torch.arange(6.0) + 2
    x = torch.arange(24.0) + 0.5
    torch.testing.assert_close(field([0])[0, :, 2:-2], x[2:-2].expand(16, 20))


@pytest.mark.parametrize(("colours", "left"), [(True, 0.6), (False, 0.7)])
def test_colours_are_warped_and_find_the_wall(scene: Wall, colours: bool, left: float) -> None:
    """Alone they take much of a bump away; their mean less, as this wall's colours have nothing in common."""
    wrong = predicted(scene, bump(scene, 0.02))
    assert scene.priors.cameras is not None
    polished = replace(CONFIG.polish, polish_colours=colours)
    config = replace(CONFIG, sparse_weight=0.0, polish=polished)
    terms = Terms(scene.views, scene.priors, config)
    done = polish(wrong, scene.priors.cameras, terms, config, torch.Generator().manual_seed(0))
    assert all(step.keys() == {"warped", "loss"} for step in done.history)
    assert off(done.prediction, scene) < left * off(wrong, scene)


def test_the_mean_of_the_colours_is_all_that_is_looked_at_unless_all_are_wanted(scene: Wall) -> None:
    """What is added to one colour and taken from another is not seen."""
    hue = torch.zeros_like(scene.views.images)
    hue[:, 0] = 0.1 * torch.rand(hue[:, 0].shape, generator=torch.Generator().manual_seed(0))
    hue[:, 2] = -hue[:, 0]
    tinted = replace(scene, views=replace(scene.views, images=scene.views.images + hue))
    wrong = predicted(scene, bump(scene, 0.02))
    moved = []
    for colours in (False, True):
        config = replace(CONFIG, polish=replace(CONFIG.polish, polish_colours=colours))
        plain, other = (refined(s, wrong, config).depth for s in (scene, tinted))
        moved.append(float((plain / other - 1).abs().mean()))
    assert moved[0] < 1e-4 and moved[1] > 1e-3


def test_roughness_is_the_mean_step_and_edges_of_the_picture_are_free() -> None:
    """A ramp of 0.01 a pixel across; the picture has a step of twice ``EDGE`` between columns 3 and 4."""
    picture = torch.zeros(1, 3, 6, 8)
    edges = [e[0] for e in picture_edges(picture)]
    ramp = (0.01 * torch.arange(8.0)).expand(6, 8)
    assert float(roughness(ramp, edges)) == pytest.approx(0.01, rel=1e-5)
    assert float(roughness(torch.full((6, 8), 0.3), edges)) == 0
    picture[..., 4:] = 2 * EDGE
    edges = [e[0] for e in picture_edges(picture)]
    assert float(roughness(ramp, edges)) == pytest.approx(0.01 * (6 + np.exp(-2)) / 7, rel=1e-5)
    turned = [edges[1].T, edges[0].T]
    assert float(roughness(ramp.T, turned)) == pytest.approx(float(roughness(ramp, edges)))


def test_smoothness_takes_the_noise_of_the_pictures_away(scene: Wall) -> None:
    """Grids of single pixels follow noise in the colours; with a weight, the wall stays truer."""
    noise = 0.05 * torch.randn(scene.views.images.shape, generator=torch.Generator().manual_seed(0))
    noisy = replace(scene, views=replace(scene.views, images=(scene.views.images + noise).clamp(0, 1)))
    right = predicted(scene, torch.ones_like(scene.depth))
    errors = []
    for weight in (0.0, 1.0):
        polished = replace(CONFIG.polish, polish_smoothness=weight, polish_levels=(1,))
        errors.append(off(refined(noisy, right, replace(CONFIG, polish=polished)), scene))
    assert errors[1] < 0.5 * errors[0]


def test_cells_must_have_a_size() -> None:
    for levels in ((), (0, 2)):
        with pytest.raises(ValueError, match="at least a pixel"):
            DepthField(torch.ones(1, 4, 4), levels)
    with pytest.raises(ValueError, match="a source and a level"):
        PolishConfig(polish_levels=())


def test_a_bump_is_taken_away(scene: Wall) -> None:
    """By the colours, with the points and without."""
    wrong = predicted(scene, bump(scene, 0.04))
    colours = replace(CONFIG, sparse_weight=0.0)
    by_colours, by_all = (off(refined(scene, wrong, c), scene) / off(wrong, scene) for c in (colours, CONFIG))
    assert by_colours < 0.6 and by_all < 0.75


def test_the_truth_is_left_alone(scene: Wall) -> None:
    """Adam's steps have a size of their own: what remains is of the order of one, which is the rate."""
    right = predicted(scene, torch.ones_like(scene.depth))
    assert off(refined(scene, right), scene) < CONFIG.polish.polish_rate


def test_other_parts_of_the_prediction_stay(scene: Wall) -> None:
    wrong = predicted(scene, bump(scene, 0.04))
    before = wrong.depth.clone()
    done = refined(scene, wrong)
    assert torch.equal(wrong.depth, before) and torch.equal(done.confidence, wrong.confidence)
    assert done.views == wrong.views and done.cameras is wrong.cameras
    assert not done.depth.requires_grad


def test_the_same_seed_gives_the_same_depths(scene: Wall) -> None:
    wrong = predicted(scene, bump(scene, 0.04))
    short = replace(CONFIG, polish=replace(CONFIG.polish, polish_looks=2))
    first, again, other = (refined(scene, wrong, short, seed).depth for seed in (3, 3, 4))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_hidden_pixels_are_found_by_depths_of_the_moment(scene: Wall) -> None:
    """What the targets' depths are told to be follows their fields; a step moves those of its sources."""
    right = predicted(scene, torch.ones_like(scene.depth))
    run = _Polishing(
        right, right.cameras, Terms(scene.views, scene.priors, CONFIG), CONFIG,
        torch.Generator().manual_seed(0), (),
    )  # fmt: skip
    run.gradients()
    with torch.no_grad():
        for grid in run.field.grids:
            if grid.grad is not None:
                grid.add_(0.05)
    run.renew()
    told = (run.now.depth / scene.depth).flatten(1).median(1).values
    expected = torch.ones_like(told)
    expected[run.drawn] = math.exp(0.05 * len(CONFIG.polish.polish_levels))
    assert len(run.drawn) == CONFIG.polish.polish_sources < len(told)
    torch.testing.assert_close(told, expected)


def test_every_step_knows_what_the_ones_before_moved(scene: Wall, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the others are told of a source is what its own field says of it."""
    known: list[bool] = []
    of_source = Terms.of_source

    def watched(
        self: Terms, source: int, targets: Sequence[int], mine: Prediction, now: Prediction, *rest: Any
    ) -> dict[str, Tensor]:
        known.append(torch.allclose(now.depth[source], mine.depth[0].detach(), rtol=1e-6, atol=0))
        return of_source(self, source, targets, mine, now, *rest)

    monkeypatch.setattr(Terms, "of_source", watched)
    moved = refined(scene, predicted(scene, bump(scene, 0.04))).depth
    assert len(known) >= 2 * len(moved) and all(known)


def test_what_a_target_hides_is_not_compared_until_its_depth_says_otherwise(scene: Wall) -> None:
    """View 1 is told that something stands before the left half of the wall: view 0 learns nothing of it."""
    config = replace(
        CONFIG, structure=0.0, exposure=False, sparse_weight=0.0,
        polish=replace(CONFIG.polish, polish_levels=(1,), polish_sources=4),
    )  # fmt: skip
    overlap = torch.zeros(4, 4)
    overlap[0, 1] = overlap[1, 0] = 10.0
    assert scene.priors.cameras is not None
    cameras, width = scene.priors.cameras, scene.depth.shape[2]
    left = (torch.arange(width) < width // 2).expand_as(scene.depth[1])
    start = predicted(scene, bump(scene, 0.005))
    start.depth[1] *= torch.where(left, 0.5, 1.0)
    terms = Terms(scene.views, replace(scene.priors, overlap=overlap), config)
    run = _Polishing(start, cameras, terms, config, torch.Generator().manual_seed(0), ())
    there = invert(cameras.world_from_cam[1:2]) @ cameras.world_from_cam[0]
    points = unproject(start.depth[0], cameras.K[0]).reshape(1, -1, 3)
    x = project(transform(there, points), cameras.K[1:2])[0][..., 0].reshape(scene.depth[0].shape)
    behind, free = (x > 1) & (x < width // 2 - 1), (x > width // 2 + 1) & (x < width - 1)
    run.gradients()
    first = run.field.grids[0].grad
    assert first is not None
    assert float(first[0][behind].abs().max()) == 0
    assert float((first[0][free] != 0).float().mean()) > 0.9
    with torch.no_grad():
        run.field.grids[1] += torch.where(left, math.log(2), 0.0)
    run.renew()
    run.field.grids[0].grad = None
    run.gradients()
    second = run.field.grids[0].grad
    assert second is not None
    assert float((second[0][behind] != 0).float().mean()) > 0.9


def test_views_that_share_nothing_are_drawn_to_their_points(scene: Wall) -> None:
    alone = replace(scene, priors=replace(scene.priors, overlap=torch.zeros(4, 4)))
    far = predicted(scene, torch.full_like(scene.depth, 1.03))
    terms = Terms(alone.views, alone.priors, CONFIG)
    done = polish(far, far.cameras, terms, CONFIG, torch.Generator().manual_seed(0))
    assert all(step.keys() == {"sparse", "loss"} for step in done.history)
    assert off(done.prediction, scene) < 0.6 * off(far, scene)


def test_dense_depths_among_the_priors_are_used(scene: Wall) -> None:
    """With no other term: the bump goes, as the prior has none."""
    known = replace(scene, priors=replace(scene.priors, depth=scene.depth))
    config = replace(CONFIG, depth_weight=1.0, photometric_weight=0.0, sparse_weight=0.0)
    wrong = predicted(scene, bump(scene, 0.04))
    terms = Terms(known.views, known.priors, config)
    done = polish(wrong, wrong.cameras, terms, config, torch.Generator().manual_seed(0))
    assert all(step.keys() == {"depth", "loss"} for step in done.history)
    assert done.history[-1]["depth"] < 0.7 * done.history[0]["depth"]


def test_what_is_not_finite_is_skipped(scene: Wall, caplog: pytest.LogCaptureFixture) -> None:
    """Points of infinite depth: no step is taken, and the depths are as they were."""
    assert scene.priors.sparse is not None
    broken = tuple(replace(s, depth=s.depth * math.inf) for s in scene.priors.sparse)
    bad = replace(scene, priors=replace(scene.priors, sparse=broken))
    config = replace(CONFIG, polish=replace(CONFIG.polish, polish_looks=1))
    start = predicted(scene, bump(scene, 0.04))
    with caplog.at_level(logging.WARNING):
        done = polish(
            start,
            start.cameras,
            Terms(bad.views, bad.priors, config),
            config,
            torch.Generator().manual_seed(0),
        )
    assert done.skipped == [0, 1] and "not finite; skipped" in caplog.text
    torch.testing.assert_close(done.prediction.depth, start.depth)


def test_it_follows_the_steps_on_the_network(scene: Wall) -> None:
    config = replace(CONFIG, steps=2, lora_targets=("plane",), polish=PolishConfig(polish_looks=1))
    seen: list[int] = []
    watched = scene.priors.sparse or ()
    outcome = optimize(
        Toy(), scene.views, scene.priors, config, report=lambda step, _: seen.append(step), watched=watched
    )
    assert all(0 < step["held_out"] < 1 for step in outcome.history)
    assert seen == list(range(config.all_steps(4))) and len(outcome.history) == config.all_steps(4) == 4
    plain = optimize(Toy(), scene.views, scene.priors, replace(config, polish=PolishConfig(polish_looks=0)))
    assert len(plain.history) == 2 and not torch.equal(plain.prediction.depth, outcome.prediction.depth)
    none = optimize(Toy(), scene.views, scene.priors, replace(config, steps=0))
    assert none.history == [] and replace(config, steps=0).all_steps(4) == 0
    assert config.reference_schedule().all_steps(4) == 2


@pytest.mark.parametrize("views", [2, 15, 16, 40, 100])
def test_each_view_comes_as_often_however_many_there_are(views: int) -> None:
    for sources in (2, 3):
        config = PolishConfig(polish_sources=sources)
        visits = sources * config.steps(views) / views
        assert config.polish_looks <= visits < config.polish_looks + sources / views


def test_views_that_only_help_stay_as_they_are(scene: Wall) -> None:
    """The others are refined all the same."""
    wrong = predicted(scene, bump(scene, 0.04))
    helped = replace(scene, views=replace(scene.views, helpers=2))
    got = refined(helped, wrong)
    assert torch.equal(got.depth[2:], wrong.depth[2:])
    error, before = ((p.depth / scene.depth - 1).abs()[:2].mean() for p in (got, wrong))
    assert error < 0.7 * before


def test_a_pixel_is_moved_by_each_uncertainty_of_its_camera(scene: Wall) -> None:
    """By f σ_R, by f σ_c / d, by σ_f times its distance from the centre; as a share of the longer side."""
    cameras, sparse = scene.priors.cameras, scene.priors.sparse
    assert cameras is not None and sparse is not None
    size, f = (48, 64), float(cameras.K[0, 0, 0])
    one = torch.ones(4)
    exact = replace(scene.priors, rotation_sigma=None, centre_sigma=None, focal_sigma=None)
    assert displacement(exact, size) == 0
    turned = displacement(replace(exact, rotation_sigma=0.01 * one), size)
    assert turned == pytest.approx(0.01 * f / 64, rel=1e-5)
    depth = sorted(float(s.depth.median()) for s in sparse)[2]  # of the lower one of the two in the middle
    moved = displacement(replace(exact, centre_sigma=0.02 * one), size)
    assert moved == pytest.approx(0.02 * f / depth / 64, rel=1e-5)
    zoomed = displacement(replace(exact, focal_sigma=0.03 * one), size)
    assert 0.03 * 0.25 * 48 / 64 < zoomed < 0.03 * 0.5 * 80 / 64
    both = replace(exact, rotation_sigma=0.01 * one, focal_sigma=0.03 * one)
    assert displacement(both, size) == pytest.approx(math.hypot(turned, zoomed), rel=1e-4)


def test_depths_do_not_make_up_for_uncertain_cameras(scene: Wall, caplog: pytest.LogCaptureFixture) -> None:
    config = replace(CONFIG, steps=1, lora_targets=("plane",), polish=PolishConfig(polish_looks=1))
    for sigma, looked in ((1e-4, True), (0.1, False)):
        priors = replace(scene.priors, rotation_sigma=torch.full((4,), sigma))
        with caplog.at_level(logging.WARNING):
            outcome = optimize(Toy(), scene.views, priors, config)
        assert (outcome.before is not None) is looked
        assert ("depths are not refined" in caplog.text) is not looked


@pytest.mark.parametrize(("sigma", "steps", "least", "taken"), [
    (1e-4, 1, 4, 1), (0.1, 1, 4, 4), (0.1, 6, 4, 6), (0.1, 1, 0, 1), (0.1, 0, 4, 0),
])  # fmt: skip
def test_uncertain_cameras_get_the_steps_that_depths_do_not(
    scene: Wall, sigma: float, steps: int, least: int, taken: int
) -> None:
    polish = PolishConfig(polish_looks=0)
    config = replace(CONFIG, steps=steps, uncertain_steps=least, lora_targets=("plane",), polish=polish)
    priors = replace(scene.priors, rotation_sigma=torch.full((4,), sigma))
    assert len(optimize(Toy(), scene.views, priors, config).history) == taken
