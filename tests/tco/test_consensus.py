"""What the views say together: medians, distances, occlusions, edges, slanted surfaces, missing depths."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tco import consensus
from tco.consensus import agreed, smooth, weighted_median
from tco.geometry import invert, pixel_grid, project, rays, transform, unproject
from tco.options import ConsensusConfig
from tco.schedule import most_overlapping
from tco.toy import Wall, wall
from tco.types import Cameras, Prediction

F64 = torch.float64
VIEWS = 7


@pytest.fixture(scope="module")
def scene() -> Wall:
    return wall(VIEWS)


def robust_mean(values: Tensor, weights: Tensor, width: float) -> Tensor:
    """Around the weighted median."""
    return consensus.robust_mean(values, weights, width, weighted_median(values, weights))


def standard_error(values: Tensor, weights: Tensor) -> Tensor:
    """Around the weighted median."""
    return consensus.standard_error(values, weights, weighted_median(values, weights))


def said(scene: Wall, depth: Tensor, confidence: float = 5.0) -> Prediction:
    every = tuple(range(len(depth)))
    return Prediction(depth, torch.full_like(depth, confidence), scene_cameras(scene), every)


def scene_cameras(scene: Wall) -> Cameras:
    assert scene.priors.cameras is not None
    return scene.priors.cameras


def together(scene: Wall, prediction: Prediction, **changes: float) -> Tensor:
    config = ConsensusConfig(**changes)  # type: ignore[arg-type]
    return agreed(prediction, scene_cameras(scene), scene.views, scene.priors, config).prediction.depth


def off(depth: Tensor, truth: Tensor) -> Tensor:
    return (depth / truth).log().abs()


def test_the_truth_stays(scene: Wall) -> None:
    """The inverse depth of a plane is linear in the pixel, so that bilinear lookup finds it exactly."""
    moved = together(scene, said(scene, scene.depth))
    assert float(off(moved, scene.depth).max()) < 1e-5


def test_one_wrong_view_is_outvoted(scene: Wall) -> None:
    wrong = scene.depth.clone()
    wrong[2] *= 1.08
    moved = together(scene, said(scene, wrong))
    seen = by_enough(scene, 2)
    assert seen.float().mean() > 0.8
    assert float(off(moved[2], scene.depth[2])[seen].median()) < 1e-3
    # The others are as right as they were, but for where hardly anyone else sees them.
    others = torch.stack([off(moved[i], scene.depth[i])[by_enough(scene, i)].median() for i in (0, 1, 3, 4)])
    assert float(others.max()) < 1e-3


def by_enough(scene: Wall, view: int, fewest: int = 3, margin: float = 1) -> Tensor:
    """Pixels (H, W) of a view that at least so many others see, so many pixels from their borders."""
    cameras = scene_cameras(scene)
    h, w = scene.depth.shape[1:]
    points = transform(
        cameras.world_from_cam[view], unproject(scene.depth[view], cameras.K[view]).reshape(-1, 3)
    )
    local = transform(invert(cameras.world_from_cam), points.unsqueeze(0))
    xy, z = project(local, cameras.K)
    inside = (z > 0) & ((xy > margin) & (xy < xy.new_tensor([w - margin, h - margin]))).all(-1)
    return (inside.sum(0) - 1 >= fewest).reshape(h, w)


def test_independent_noise_falls_as_the_mean_of_so_many_falls(scene: Wall) -> None:
    """Seven views with noise of 1 %, smooth over some pixels: σ / √7, a robust mean has a bit more."""
    generator = torch.Generator().manual_seed(3)
    coarse = torch.randn(VIEWS, 1, 6, 8, generator=generator)
    noise = torch.nn.functional.interpolate(coarse, scene.depth.shape[1:], mode="bilinear")[:, 0]
    noise = 0.01 * noise / noise.std()
    moved = together(scene, said(scene, scene.depth * noise.exp()))
    all_see = by_enough(scene, 3, VIEWS - 1)
    assert all_see.float().mean() > 0.4
    before, after = (
        off(d, scene.depth)[3][all_see].square().mean().sqrt() for d in (scene.depth * noise.exp(), moved)
    )
    assert float(before) > 0.008
    assert float(after / before) == pytest.approx(VIEWS**-0.5, rel=0.35)


def test_confidence_decides_between_two_groups(scene: Wall) -> None:
    """Two of seven views are right; they win if their weight is more than that of the five others."""
    wrong = scene.depth.clone()
    right = [1, 3]
    for i in set(range(VIEWS)) - set(right):
        wrong[i] *= 1.06
    for confidence, limit in ((1.1, 0.05), (20.0, 0.005)):
        prediction = said(scene, wrong, 1.1)
        prediction.confidence[right] = confidence
        moved = together(scene, prediction, consensus_width=0.001)
        error = float(off(moved[3], scene.depth[3])[by_enough(scene, 3, VIEWS - 1)].median())
        assert (error > limit) == (confidence == 1.1), (confidence, error)


def test_other_surfaces_are_not_asked(scene: Wall) -> None:
    """What others see far in front or behind is no word on this pixel, whatever their number."""
    shifted = 1.5 * scene.depth
    shifted[0] = scene.depth[0]
    moved = together(scene, said(scene, shifted))
    assert torch.allclose(moved[0], scene.depth[0], rtol=1e-6)


def test_what_lies_between_two_surfaces_is_not_asked() -> None:
    depth = torch.full((1, 6, 8), 2.0)
    depth[:, :, 4:] = 3.0
    expected = torch.ones(1, 6, 8, dtype=torch.bool)
    expected[:, :, 3:5] = False
    assert torch.equal(smooth(depth), expected)
    slope = 1 / (1 + 0.02 * torch.arange(8.0)).expand(1, 6, 8)
    assert bool(smooth(slope).all())


def frontal(distances: list[float]) -> Wall:
    """Cameras straight before the wall z = 0 at these distances, which are the depths."""
    scene = wall(len(distances), slope=0.0)
    cameras = scene_cameras(scene)
    pose = torch.eye(4).repeat(len(distances), 1, 1)
    pose[:, 2, 3] = -torch.tensor(distances)
    pose[:, 0, 3] = 0.1 * torch.arange(len(distances)) * min(distances)
    overlap = 1 - torch.eye(len(distances))
    priors = replace(scene.priors, cameras=Cameras(pose, cameras.K), overlap=overlap)
    depth = torch.tensor(distances)[:, None, None].expand(-1, *scene.depth.shape[1:]).contiguous()
    return replace(scene, priors=priors, depth=depth)


@pytest.mark.parametrize("far", [0.4, 1.0, 1.5, 3.0])
def test_views_at_other_distances_correct_by_lengths_not_by_shares(far: float) -> None:
    """2 % at three times the distance are 6 % of the others' depths, and are gone after one round."""
    scene = frontal([far, *[1.0] * 6])
    wrong = scene.depth.clone()
    wrong[0] *= 1.02
    moved = together(scene, said(scene, wrong), consensus_rounds=1)
    assert float(off(moved[0], scene.depth[0])[by_enough(scene, 0)].median()) < 2e-3


def test_near_views_weigh_more() -> None:
    """One view at a fifth of the distance outvotes three that are wrong alike; one at half does not."""
    for near, expected in ((0.2, 1.0), (0.5, 1.03)):
        scene = frontal([1.0, 1.0, 1.0, near])
        wrong = scene.depth.clone()
        wrong[:3] *= 1.03
        moved = together(scene, said(scene, wrong), consensus_width=1e-4, consensus_rounds=1)
        seen = by_enough(scene, 0, 3)
        assert float(moved[0][seen].median()) == pytest.approx(expected, abs=2e-3), near


def test_a_second_round_asks_where_the_first_led() -> None:
    """On a slanted wall the first answer is that for another place, and the second nearly right."""
    scene = wall(VIEWS, slope=0.8)
    wrong = scene.depth.clone()
    wrong[0] *= 1.08
    seen = by_enough(scene, 0)
    first, second = (
        float(off(together(scene, said(scene, wrong), consensus_rounds=n)[0], scene.depth[0])[seen].median())
        for n in (1, 2)
    )
    assert second < 0.5 * first


def test_the_own_word_stays_where_it_was(scene: Wall) -> None:
    """The view's own depth is asked in every round as it was first said, not where the pixel has moved to.

    Against six views that are 5 % off, a right one that weighs as much as they do ends halfway: with a wide
    kernel the mean of all, in one round as in two.
    """
    wrong = 1.05 * scene.depth
    wrong[3] = scene.depth[3]
    prediction = said(scene, wrong, 1.0)
    prediction.confidence[3] = 6.0
    moved = together(scene, prediction, consensus_width=1e3)
    seen = by_enough(scene, 3, VIEWS - 1)
    assert float((moved[3] / scene.depth[3]).log()[seen].median()) == pytest.approx(0.0244, abs=2e-3)


def test_reach_is_the_bound_it_says(scene: Wall) -> None:
    others = 1.1 * scene.depth
    others[0] = scene.depth[0]
    near = together(scene, said(scene, others), consensus_reach=0.05)
    assert torch.allclose(near[0], scene.depth[0], rtol=1e-6)
    wide = together(scene, said(scene, others), consensus_reach=0.3)
    assert float((wide[0] / scene.depth[0])[by_enough(scene, 0)].median()) > 1.08


def test_reach_counts_in_both_views() -> None:
    """30 % behind what a near view should see is another surface, if only 10 % of the far view's depth."""
    scene = frontal([3.0, 1.0, 1.0, 1.0])
    for factor, stays in ((1.1, False), (1.3, True), (1 / 1.3, True)):
        wrong = scene.depth.clone()
        wrong[1:] *= factor
        moved = together(scene, said(scene, wrong), consensus_rounds=1)
        seen = by_enough(scene, 0)
        assert torch.allclose(moved[0][seen], scene.depth[0][seen], rtol=1e-4) == stays, factor


def test_as_many_views_are_asked_as_wanted(scene: Wall) -> None:
    """View 3 shares most with view 2; asked alone, a word of more weight than the own one decides."""
    assert scene.priors.overlap is not None
    best = most_overlapping(scene.priors.overlap, 3, 1)[0]
    wrong = 1.05 * scene.depth
    wrong[best] = scene.depth[best]
    prediction = said(scene, wrong, 5.0)
    prediction.confidence[best] = 8.0
    moved = together(scene, prediction, consensus_views=1, consensus_width=1e-4)
    seen = by_enough(scene, 3, VIEWS - 1)
    assert float(off(moved[3], scene.depth[3])[seen].median()) < 1e-3
    everyone = together(scene, prediction, consensus_width=1e-4)
    assert float(off(everyone[3], scene.depth[3])[seen].median()) > 0.04


def test_the_order_of_the_views_is_no_matter(scene: Wall) -> None:
    """All are asked as they were, none as it has become."""
    generator = torch.Generator().manual_seed(5)
    depth = scene.depth * (0.02 * torch.randn(scene.depth.shape, generator=generator)).exp()
    moved = together(scene, said(scene, depth))
    turned = list(range(VIEWS))[::-1]
    cameras = scene_cameras(scene)[turned]
    assert scene.priors.overlap is not None
    overlap = scene.priors.overlap[turned][:, turned]
    priors = replace(scene.priors, cameras=cameras, overlap=overlap)
    views = replace(scene.views, valid=scene.views.valid[turned])
    prediction = replace(said(scene, depth[turned]), cameras=cameras)
    fewer = replace(priors, sparse=None, centre_sigma=None)
    again = agreed(prediction, cameras, views, fewer, ConsensusConfig()).prediction
    torch.testing.assert_close(again.depth.flip(0), moved, rtol=1e-5, atol=0)


def test_edges_say_nothing(scene: Wall) -> None:
    """The maps of views with a step in them are as if the pixels beside it were not valid."""
    depth = scene.depth.clone()
    depth[1:, :, 32:] *= 1.15
    moved = together(scene, said(scene, depth))
    views = replace(scene.views, valid=scene.views.valid & smooth(depth))
    expected = agreed(said(scene, depth), scene_cameras(scene), views, scene.priors, ConsensusConfig())
    assert torch.equal(moved, expected.prediction.depth)
    assert not bool(smooth(depth)[1:].all())


def test_focal_lengths_and_principal_points_are_those_of_each_view() -> None:
    """Cameras whose pixels are not square and not centred, a different one each; the truth stays."""
    scene = wall(5)
    cameras = scene_cameras(scene)
    K = cameras.K.clone()
    for i in range(5):
        K[i, 0, 0] *= 1 + 0.1 * i
        K[i, 1, 1] *= 1.3 - 0.1 * i
        K[i, :2, 2] += torch.tensor([3.0 - i, i - 2.0])
    normal = torch.tensor([-0.3, 0.0, 1.0])
    h, w = scene.depth.shape[1:]
    ray = rays(pixel_grid(h, w, K).reshape(1, -1, 2), K) @ cameras.world_from_cam[:, :3, :3].transpose(1, 2)
    depth = (2 - cameras.world_from_cam[:, :3, 3] @ normal).unsqueeze(-1) / (ray @ normal)
    depth = depth.reshape(5, h, w)
    priors = replace(scene.priors, cameras=Cameras(cameras.world_from_cam, K))
    own = replace(scene, priors=priors, depth=depth)
    wrong = depth.clone()
    wrong[1] *= 1.04
    moved = together(own, said(own, wrong))
    assert float(off(moved[1], depth[1])[by_enough(own, 1)].median()) < 2e-3
    others = [0, 2, 3, 4]
    assert float(off(together(own, said(own, depth))[others], depth[others]).max()) < 1e-5


def test_bands_make_no_difference(scene: Wall, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(6)
    depth = scene.depth * (0.02 * torch.randn(scene.depth.shape, generator=generator)).exp()
    whole = together(scene, said(scene, depth))
    monkeypatch.setattr(consensus, "BAND", 1000)
    torch.testing.assert_close(together(scene, said(scene, depth)), whole, rtol=1e-6, atol=0)


@pytest.mark.parametrize("missing", [0.0, float("inf"), float("nan")])
def test_depths_that_are_none_stay_none_and_say_nothing(scene: Wall, missing: float) -> None:
    depth = scene.depth.clone()
    depth[2, 10:20, 10:20] = missing
    depth[0] *= 1.02
    found = agreed(said(scene, depth), scene_cameras(scene), scene.views, scene.priors, ConsensusConfig())
    moved = found.prediction.depth
    torch.testing.assert_close(moved[2, 10:20, 10:20], depth[2, 10:20, 10:20], equal_nan=True)
    assert bool(found.error[2, 10:20, 10:20].isinf().all()) and bool((found.error >= 0).all())
    there = torch.ones_like(depth, dtype=torch.bool)
    there[2, 10:20, 10:20] = False
    assert bool(torch.isfinite(moved[there]).all()) and bool((moved[there] > 0).all())
    assert float(off(moved[0], scene.depth[0])[by_enough(scene, 0)].median()) < 1e-3


def test_what_stands_for_no_depth_is_not_asked_about() -> None:
    """A wall at about the depth 1, which a missing depth is while the views are asked."""
    scene = wall(VIEWS)
    cameras = scene_cameras(scene)
    pose = cameras.world_from_cam.clone()
    pose[:, :3, 3] /= 2
    near = replace(scene, priors=replace(scene.priors, cameras=Cameras(pose, cameras.K)))
    depth = scene.depth / 2
    depth[3, 20:30, 20:40] = 0
    found = agreed(said(near, depth), scene_cameras(near), near.views, near.priors, ConsensusConfig())
    assert bool((found.prediction.depth[3, 20:30, 20:40] == 0).all())
    assert bool(found.error[3, 20:30, 20:40].isinf().all())
    assert bool(found.error[3, 22:28, 12:16].isfinite().all())


def test_nothing_is_asked_where_cameras_are_uncertain(scene: Wall, caplog: pytest.LogCaptureFixture) -> None:
    wrong = scene.depth.clone()
    wrong[2] *= 1.08
    assert scene.priors.rotation_sigma is not None
    shaky = replace(scene.priors, rotation_sigma=10 * scene.priors.rotation_sigma)
    prediction = said(scene, wrong)
    same = agreed(prediction, scene_cameras(scene), scene.views, shaky, ConsensusConfig())
    assert same.prediction is prediction and bool(same.error.isinf().all())
    assert "--consensus_uncertainty" in caplog.text
    wide = ConsensusConfig(consensus_uncertainty=1.0)
    assert agreed(prediction, scene_cameras(scene), scene.views, shaky, wide).prediction is not prediction


def test_gradients_and_stages_end_here(scene: Wall) -> None:
    prediction = said(scene, scene.depth.clone().requires_grad_())
    prediction = replace(prediction, stages=(torch.zeros(VIEWS),))
    moved = agreed(prediction, scene_cameras(scene), scene.views, scene.priors, ConsensusConfig()).prediction
    assert not moved.depth.requires_grad and moved.stages == ()


def test_some_of_the_views_cannot_agree(scene: Wall) -> None:
    part = said(scene, scene.depth[:3])
    with pytest.raises(ValueError, match="all 7 views"):
        agreed(part, scene_cameras(scene), scene.views, scene.priors, ConsensusConfig())
    with pytest.raises(ValueError, match="overlap"):
        agreed(
            said(scene, scene.depth), scene_cameras(scene), scene.views,
            replace(scene.priors, overlap=None), ConsensusConfig(),
        )  # fmt: skip


def test_invalid_pixels_say_nothing(scene: Wall) -> None:
    """Views whose wrong depths are masked out do not pull."""
    wrong = scene.depth.clone()
    wrong[1:] *= 1.05
    views = replace(scene.views, valid=torch.ones_like(scene.views.valid))
    views.valid[1:] = False
    config = ConsensusConfig()
    moved = agreed(said(scene, wrong), scene_cameras(scene), views, scene.priors, config).prediction
    assert torch.allclose(moved.depth[0], scene.depth[0], rtol=1e-6)


def test_helpers_are_asked_and_do_not_move(scene: Wall) -> None:
    depth = scene.depth.clone()
    depth[0] *= 1.05
    views = replace(scene.views, helpers=3)
    found = agreed(said(scene, depth), scene_cameras(scene), views, scene.priors, ConsensusConfig())
    moved = found.prediction
    assert torch.equal(moved.depth[-3:], depth[-3:]) and bool(found.error[-3:].isinf().all())
    assert float(off(moved.depth[0], scene.depth[0])[by_enough(scene, 0)].median()) < 2e-3


def test_no_rounds_and_single_views_change_nothing(scene: Wall) -> None:
    prediction = said(scene, 1.02 * scene.depth)
    off_switch = ConsensusConfig(consensus_rounds=0)
    same = agreed(prediction, scene_cameras(scene), scene.views, scene.priors, off_switch)
    assert same.prediction is prediction and bool(same.error.isinf().all())
    assert scene.priors.overlap is not None
    alone = replace(scene.priors, overlap=torch.zeros_like(scene.priors.overlap))
    moved = agreed(prediction, scene_cameras(scene), scene.views, alone, ConsensusConfig()).prediction
    assert torch.equal(moved.depth, prediction.depth)


def test_standard_error_by_hand() -> None:
    values = torch.tensor([[0.0], [0.1], [0.2], [-0.3], [5.0]], dtype=F64)
    weights = torch.tensor([[2.0], [1.0], [1.0], [1.0], [1.0]], dtype=F64)
    # In order −0.3 (1), 0 (3 of 6: the lower median). Distances 0 (2), 0.1 (3 of 6), 0.2 (the upper median).
    count = 36 / 8
    expected = 1.4826 * 0.2 * (count / (count - 0.8)) * (torch.pi / 2 / count) ** 0.5
    assert float(standard_error(values, weights)) == pytest.approx(expected, rel=1e-12)
    for few in (torch.tensor([4.0, 1, 1, 1, 1]), torch.tensor([1.0, 1, 1, 1, 0]), torch.zeros(5)):
        assert float(standard_error(values, few.to(F64).unsqueeze(1))) == float("inf")


@pytest.mark.parametrize("count", [5, 6, 9, 15])
@pytest.mark.parametrize("most", [1.0, 5.0])
def test_standard_error_of_normal_noise_is_that_of_the_mean_that_is_taken(count: int, most: float) -> None:
    """On average, and up to what even numbers of values add: the upper of two medians is taken for safety."""
    generator = torch.Generator().manual_seed(8)
    values = 0.01 * torch.randn(count, 20_000, generator=generator, dtype=F64)
    weights = 1 + (most - 1) * torch.rand(count, 20_000, generator=generator, dtype=F64)
    told = standard_error(values, weights)
    known = told.isfinite()
    assert known.double().mean() > 0.8
    found = robust_mean(values, weights, ConsensusConfig().consensus_width)[known].std()
    assert 0.95 < float(told[known].mean() / found) < 1.4
    if count % 2:
        assert float(told[known].mean() / found) < 1.15


def test_the_error_is_what_is_left_of_the_noise(scene: Wall) -> None:
    """Where all views see the wall, and infinite where fewer than five do."""
    generator = torch.Generator().manual_seed(9)
    coarse = torch.randn(VIEWS, 1, 6, 8, generator=generator)
    noise = torch.nn.functional.interpolate(coarse, scene.depth.shape[1:], mode="bilinear")[:, 0]
    depth = scene.depth * (0.01 * noise / noise.std()).exp()
    found = agreed(said(scene, depth), scene_cameras(scene), scene.views, scene.priors, ConsensusConfig())
    all_see = by_enough(scene, 3, VIEWS - 1)
    real = off(found.prediction.depth, scene.depth)[3][all_see].square().mean().sqrt()
    told = found.error[3][all_see].square().mean().sqrt()
    assert float(told / real) == pytest.approx(1.15, rel=0.25)
    few = ~by_enough(scene, 0, 4, margin=-1)
    assert bool(few.any()) and bool(found.error[0][few].isinf().all())
    assert bool(found.error[0][by_enough(scene, 0, 4)].isfinite().all())


def test_robust_mean_by_hand() -> None:
    values = torch.tensor([[0.0], [0.1], [5.0]], dtype=F64)
    even = torch.ones_like(values)
    far = 1 / (1 + (4.9 / 0.1) ** 2)
    expected = (0.0 * 0.5 + 0.1 + 5.0 * far) / (0.5 + 1 + far)
    assert float(robust_mean(values, even, 0.1)) == pytest.approx(expected)
    heavy = torch.tensor([[1.0], [1.0], [3.0]], dtype=F64)
    assert float(robust_mean(values, heavy, 1e-6)) == pytest.approx(5.0)
    # The order of the values is no matter, nor is one of no weight.
    turned = robust_mean(values.flip(0), heavy.flip(0), 0.1)
    assert float(turned) == pytest.approx(float(robust_mean(values, heavy, 0.1)))
    more = robust_mean(
        torch.cat([values, values.new_full((1, 1), -9)]), torch.cat([even, even.new_zeros(1, 1)]), 0.1
    )
    assert float(more) == pytest.approx(expected)
    # Of two alike the lower one is the median.
    assert float(robust_mean(torch.tensor([[0.0], [1.0]]), torch.ones(2, 1), 0.01)) < 0.01


def test_most_overlapping_views_first() -> None:
    shared = torch.tensor([[0.0, 3, 0, 9], [3, 0, 1, 1], [0, 1, 0, 2], [9, 1, 2, 0]])
    assert most_overlapping(shared, 0, 5) == [3, 1]
    assert most_overlapping(shared, 1, 2) == [0, 2]


@pytest.mark.parametrize(
    "changes",
    [
        {"consensus_rounds": -1},
        {"consensus_views": 0},
        {"consensus_reach": 0.0},
        {"consensus_width": 0.0},
        {"consensus_uncertainty": -1.0},
    ],
)
def test_impossible_settings_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="consensus_"):
        ConsensusConfig(**changes)  # type: ignore[arg-type]
