"""What the views say together: medians, occlusions, edges, slanted surfaces, and the compiled loop."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tco import _consensus_kernels
from tco.consensus import agreed, ask_views, robust_mean, smooth
from tco.options import ConsensusConfig
from tco.schedule import most_overlapping
from tco.toy import Wall, wall
from tco.types import Cameras, Prediction

F64 = torch.float64
VIEWS = 7


@pytest.fixture(scope="module")
def scene() -> Wall:
    return wall(VIEWS)


def said(scene: Wall, depth: Tensor, confidence: float = 5.0) -> Prediction:
    every = tuple(range(len(depth)))
    return Prediction(depth, torch.full_like(depth, confidence), scene_cameras(scene), every)


def scene_cameras(scene: Wall) -> Cameras:
    assert scene.priors.cameras is not None
    return scene.priors.cameras


def overlap(scene: Wall) -> Tensor:
    assert scene.priors.overlap is not None
    return scene.priors.overlap


def together(scene: Wall, prediction: Prediction, **changes: float) -> Tensor:
    config = ConsensusConfig(**changes)  # type: ignore[arg-type]
    return agreed(prediction, scene_cameras(scene), scene.views, overlap(scene), config).depth


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


def by_enough(scene: Wall, view: int, fewest: int = 3) -> Tensor:
    """Pixels (H, W) of a view that at least so many others see."""
    from tco.geometry import invert, project, transform, unproject

    cameras = scene_cameras(scene)
    h, w = scene.depth.shape[1:]
    points = transform(
        cameras.world_from_cam[view], unproject(scene.depth[view], cameras.K[view]).reshape(-1, 3)
    )
    local = transform(invert(cameras.world_from_cam), points.unsqueeze(0))
    xy, z = project(local, cameras.K)
    inside = (z > 0) & ((xy > 1) & (xy < xy.new_tensor([w - 1, h - 1]))).all(-1)
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


def test_invalid_pixels_say_nothing(scene: Wall) -> None:
    """Views whose wrong depths are masked out do not pull."""
    wrong = scene.depth.clone()
    wrong[1:] *= 1.05
    views = replace(scene.views, valid=torch.ones_like(scene.views.valid))
    views.valid[1:] = False
    config = ConsensusConfig()
    moved = agreed(said(scene, wrong), scene_cameras(scene), views, overlap(scene), config)
    assert torch.allclose(moved.depth[0], scene.depth[0], rtol=1e-6)


def test_helpers_are_asked_and_do_not_move(scene: Wall) -> None:
    depth = scene.depth.clone()
    depth[0] *= 1.05
    views = replace(scene.views, helpers=3)
    moved = agreed(said(scene, depth), scene_cameras(scene), views, overlap(scene), ConsensusConfig())
    assert torch.equal(moved.depth[-3:], depth[-3:])
    assert float(off(moved.depth[0], scene.depth[0])[by_enough(scene, 0)].median()) < 2e-3


def test_no_rounds_and_single_views_change_nothing(scene: Wall) -> None:
    prediction = said(scene, 1.02 * scene.depth)
    off_switch = ConsensusConfig(consensus_rounds=0)
    assert agreed(prediction, scene_cameras(scene), scene.views, overlap(scene), off_switch) is prediction
    alone = torch.zeros_like(overlap(scene))
    moved = agreed(prediction, scene_cameras(scene), scene.views, alone, ConsensusConfig())
    assert torch.equal(moved.depth, prediction.depth)


@pytest.mark.parametrize("rounds", [1, 3])
def test_the_compiled_loop_is_its_plain_twin(scene: Wall, rounds: int) -> None:
    """Noise, an edge, masked pixels and a view that looks elsewhere; in double precision."""
    generator = torch.Generator().manual_seed(rounds)
    depth = (scene.depth * (1 + 0.03 * torch.randn(scene.depth.shape, generator=generator))).to(F64)
    depth[:, :, 30:] *= 1.3
    cameras = scene_cameras(scene).to(dtype=F64)
    cameras.world_from_cam[5, :3, :3] @= torch.diag(torch.tensor([-1.0, 1, -1], dtype=F64))
    confidence = 1 + torch.rand(depth.shape, generator=generator, dtype=F64)
    counts = torch.rand(depth.shape, generator=generator) < 0.9
    evidence = torch.stack([1 / depth, confidence, counts.to(F64)], 1)
    config = ConsensusConfig(consensus_rounds=rounds)
    for view in (0, 3, 5):
        others = [other for other in range(VIEWS) if other != view]
        plain = ask_views(evidence, cameras, view, others, config)
        compiled = _consensus_kernels.ask(evidence, cameras, view, others, config)
        torch.testing.assert_close(compiled, plain, rtol=1e-9, atol=0)
        assert view == 5 or float(off(plain, depth[view]).max()) > 1e-3


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
    ],
)
def test_impossible_settings_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="consensus_"):
        ConsensusConfig(**changes)  # type: ignore[arg-type]
