"""A source's pixels looked up in other views: agreement in depth and colour, occlusions, derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.objective import NothingVisibleError, ObjectiveConfig
from tco.toy import Wall, wall
from tco.types import Cameras, Prediction, Views
from tco.warping import Warped, warp, warped_photometric

F64 = torch.float64
PLAIN = ObjectiveConfig()


def blank(like: Tensor, views: int) -> Views:
    """Black pictures of which all pixels are valid."""
    h, w = like.shape[-2:]
    shape = torch.zeros(views, 3, h, w, dtype=like.dtype)
    return Views(shape, torch.ones(views, h, w, dtype=torch.bool), tuple(str(i) for i in range(views)))


def two_views_of_a_wall(distance: float) -> tuple[Tensor, Cameras, Prediction]:
    """Depth of a frontal wall in the first view, two cameras, and the second's exact prediction."""
    K = torch.tensor([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]], dtype=F64).expand(2, 3, 3)
    pose = torch.eye(4, dtype=F64).repeat(2, 1, 1)
    pose[1, :3, 3] = torch.tensor([0.2, 0.05, 0.5])
    depth = torch.tensor([distance, distance - 0.5], dtype=F64)[:, None, None].expand(2, 24, 32)
    return depth[0], Cameras(pose, K), Prediction(depth, 2 * torch.ones_like(depth), Cameras(pose, K), (0, 1))


def test_the_ratio_of_depths_is_one_where_they_agree() -> None:
    """1 % more depth is 2.02 − 0.5 against 1.5."""
    depth, cameras, context = two_views_of_a_wall(2.0)
    for factor, expected in ((1.0, 1.0), (1.01, 1.52 / 1.5)):
        found = warp(factor * depth, blank(depth, 2), cameras, 0, [1], context)
        assert int(found.valid.sum()) > 100
        ratios = found.ratio[found.valid]
        torch.testing.assert_close(ratios, torch.full_like(ratios, expected), rtol=1e-12, atol=0)


def test_no_overlap_is_an_error() -> None:
    depth, cameras, context = two_views_of_a_wall(2.0)
    pose = cameras.world_from_cam.clone()
    pose[1, :3, 3] = torch.tensor([100.0, 0, 0])
    with pytest.raises(NothingVisibleError, match="view 0"):
        warp(depth, blank(depth, 2), Cameras(pose, cameras.K), 0, [1], context)


def test_derivatives_by_cameras_match_finite_differences() -> None:
    depth, cameras, context = two_views_of_a_wall(2.0)
    bumpy = depth + 0.05 * torch.rand(24, 32, generator=torch.Generator().manual_seed(0), dtype=F64)
    wavy = replace(context, depth=context.depth + 0.1 * torch.sin(torch.arange(32.0, dtype=F64) / 3))
    scale = torch.ones((), dtype=F64, requires_grad=True)
    shift = torch.full((3,), 1e-3, dtype=F64, requires_grad=True)

    def f(scale: Tensor, shift: Tensor) -> Tensor:
        pose = torch.cat([cameras.world_from_cam[:1, :3, 3] + shift, cameras.world_from_cam[1:, :3, 3]])
        poses = torch.cat(
            [cameras.world_from_cam[..., :3], torch.nn.functional.pad(pose, (0, 1), value=1)[..., None]], -1
        )
        found = warp(scale * bumpy, blank(depth, 2), Cameras(poses, cameras.K * scale), 0, [1], wavy)
        return found.ratio[found.valid].square().mean()

    assert torch.autograd.gradcheck(f, (scale, shift), eps=1e-7, atol=1e-5)


@pytest.fixture(scope="module")
def scene() -> Wall:
    return wall()


def looked_up(scene: Wall, factor: float | Tensor = 1.0, targets: tuple[int, ...] = (1, 2)) -> Warped:
    """The first view of the wall, its depth times a factor, in others whose depths are true."""
    cameras = scene.priors.cameras
    assert cameras is not None
    context = Prediction(
        scene.depth, torch.full_like(scene.depth, 5.0), cameras, tuple(range(len(scene.depth)))
    )
    return warp(factor * scene.depth[0], scene.views, cameras, 0, targets, context)


def opaque(scene: Wall) -> Tensor:
    return torch.ones_like(scene.depth[0])


def test_what_a_target_shows_is_what_the_source_shows_where_the_depth_is_true(scene: Wall) -> None:
    """Depths agree to rounding, colours to what interpolation leaves; not at wrong ones."""
    right, wrong = looked_up(scene), looked_up(scene, 1.05)
    assert float((right.ratio[right.valid] - 1).abs().max()) < 1e-4
    image = scene.views.images[0].permute(1, 2, 0)
    errors = [float((w.color - image).abs().mean(-1)[w.valid].mean()) for w in (right, wrong)]
    assert errors[0] < 0.25 * errors[1]


@pytest.mark.parametrize("structure", [0.0, 0.5])
def test_the_colours_agree_best_at_the_true_depth(scene: Wall, structure: float) -> None:
    config = ObjectiveConfig(structure=structure, exposure=True)
    factors = np.linspace(0.98, 1.02, 41)
    losses = [
        float(warped_photometric(looked_up(scene, float(f)), scene.views.images[0], opaque(scene), config))
        for f in factors
    ]
    assert abs(factors[int(np.argmin(losses))] - 1) < 1.1e-3


def test_a_pixel_that_a_target_sees_something_nearer_at_does_not_count(scene: Wall) -> None:
    """The target's depth is halved on its left: the pixels that fall there have no part in the loss."""
    cameras = scene.priors.cameras
    assert cameras is not None
    depth = scene.depth.clone()
    left = torch.zeros_like(depth[1], dtype=torch.bool)
    left[:, : depth.shape[2] // 2] = True
    depth[1, left] *= 0.5
    images = scene.views.images.clone()
    images[1, :, left] = 0.0
    views = replace(scene.views, images=images)
    context = Prediction(depth, torch.full_like(depth, 5.0), cameras, tuple(range(len(depth))))
    warped = warp(scene.depth[0], views, cameras, 0, [1], context)
    with_black = float(warped_photometric(warped, images[0], opaque(scene), PLAIN))
    seen = warped.valid & (warped.ratio < 1.02)
    assert 0.2 < float(seen.float().mean()) < 0.8
    alone = replace(warped, valid=seen)
    assert with_black == pytest.approx(float(warped_photometric(alone, images[0], opaque(scene), PLAIN)))
    everything = replace(warped, ratio=torch.ones_like(warped.ratio))
    assert float(warped_photometric(everything, images[0], opaque(scene), PLAIN)) > 3 * with_black


def test_pixels_count_by_their_opacity(scene: Wall) -> None:
    """The mean of two halves, weighted by opacity, is the mean over both: nothing couples them."""
    half = torch.zeros_like(opaque(scene))
    half[:, : half.shape[1] // 2] = 1.0
    warped, image = looked_up(scene, 1 - 0.03 * half, (1,)), scene.views.images[0]
    parts = [float(warped_photometric(warped, image, o, PLAIN)) for o in (half, 1 - half)]
    assert parts[0] > 2 * parts[1]
    sums = [float((o * warped.valid[0]).sum()) for o in (half, 1 - half)]
    mixed = float(warped_photometric(warped, image, 0.3 * half + 0.9 * (1 - half), PLAIN))
    weights = np.array([0.3, 0.9]) * sums
    assert mixed == pytest.approx(float(np.dot(weights, parts) / weights.sum()), rel=1e-5)


def test_a_source_that_no_target_sees_is_an_error(scene: Wall) -> None:
    warped = looked_up(scene)
    behind = replace(warped, ratio=2 * torch.ones_like(warped.ratio))
    with pytest.raises(NothingVisibleError, match="what the source view sees"):
        warped_photometric(behind, scene.views.images[0], opaque(scene), PLAIN)


def test_derivatives_of_the_warped_colours_match_finite_differences(scene: Wall) -> None:
    """By depth and by a target's position, in float64, with structure."""
    cameras = scene.priors.cameras
    assert cameras is not None
    config = ObjectiveConfig(structure=0.5)
    views = replace(scene.views, images=scene.views.images.to(F64))
    exact = Cameras(cameras.world_from_cam.to(F64), cameras.K.to(F64))
    depth = scene.depth.to(F64)
    context = Prediction(depth, torch.full_like(depth, 5.0), exact, tuple(range(len(depth))))

    def f(scale: Tensor, shift: Tensor) -> Tensor:
        pose = exact.world_from_cam.clone()
        pose[1, :3, 3] = pose[1, :3, 3] + shift
        there = warp(scale * depth[0], views, Cameras(pose, exact.K), 0, [1, 2], context)
        return warped_photometric(there, views.images[0], opaque(scene).to(F64), config)

    scale = torch.tensor(1.003, dtype=F64, requires_grad=True)
    shift = torch.full((3,), 1e-3, dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(f, (scale, shift), eps=1e-7, atol=2e-4, rtol=2e-3)
