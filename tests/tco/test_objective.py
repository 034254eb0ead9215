"""The compatibility terms: known values, invariances, masks, derivatives, and the published numbers."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.geometry import pixel_grid, rays, skew
from tco.objective import (
    NothingVisibleError,
    ObjectiveConfig,
    color_difference,
    depth_difference,
    geometric,
    match_exposure,
    photometric,
    weights,
)
from tco.render import Rendered
from tco.surfels import SurfelConfig, from_depth
from tco.types import Cameras

PARITY = Path(__file__).parents[3] / "shared" / "parity"
F64 = torch.float64
T, H, W = 2, 12, 16
PLAIN = ObjectiveConfig(occlusion_tolerance=0.0, unpremultiply=False)


@dataclass(frozen=True)
class Targets:
    images: Tensor
    depth: Tensor
    valid: Tensor | None = None


def colors(rendered: Rendered, targets: Targets, config: ObjectiveConfig | None = None) -> Tensor:
    config = config or ObjectiveConfig()
    weight = weights(rendered, targets.depth, targets.valid, config)
    return color_difference(rendered, targets.images, weight, config)


def depths(rendered: Rendered, targets: Targets, config: ObjectiveConfig | None = None) -> Tensor:
    weight = weights(rendered, targets.depth, targets.valid, config or ObjectiveConfig())
    return depth_difference(rendered, targets.depth, weight)


def scene() -> tuple[Rendered, Targets]:
    g = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=F64)

    alpha = 0.2 + 0.7 * rand(T, H, W)
    depth = 1 + rand(T, H, W)
    targets = Targets(rand(T, 3, H, W), depth + 0.1)
    return Rendered(rand(T, H, W, 3) * alpha.unsqueeze(-1), depth, alpha), targets


def test_photometric_is_the_weighted_mean_of_l1() -> None:
    rendered, targets = scene()
    image = targets.images.permute(0, 2, 3, 1)
    error = (rendered.color - image).abs().mean(-1)
    expected = (rendered.alpha * error).sum() / rendered.alpha.sum()
    torch.testing.assert_close(colors(rendered, targets, PLAIN), expected)


def test_a_perfect_rendering_costs_nothing() -> None:
    rendered, targets = scene()
    image = targets.images.permute(0, 2, 3, 1)
    perfect = Rendered(image * rendered.alpha.unsqueeze(-1), targets.depth, rendered.alpha)
    for config in (ObjectiveConfig(), ObjectiveConfig(exposure=True, structure=0.85)):
        assert float(colors(perfect, targets, config)) == pytest.approx(0, abs=1e-9)
    assert float(depths(perfect, targets)) == 0
    assert float(colors(perfect, targets, PLAIN)) > 0.05  # transparency is taken for darkness


def test_geometric_of_a_tilted_plane() -> None:
    """Rendered depth = target + 0.1 x: the L1 is the mean of 0.1 x and the gradients add 0.1."""
    rendered, targets = scene()
    x = torch.arange(W, dtype=F64).expand(T, H, W)
    config = ObjectiveConfig(occlusion_tolerance=10.0)
    tilted = Rendered(rendered.color, targets.depth + 0.1 * x, torch.ones(T, H, W, dtype=F64))
    assert float(depths(tilted, targets, config)) == pytest.approx(0.1 * (W - 1) / 2 + 0.1)


def test_occluded_pixels_do_not_count() -> None:
    """A pixel behind the target's surface by more than the tolerance is an occlusion, one in front is not."""
    rendered, targets = scene()
    ratio = torch.tensor([0.5, 0.99, 1.0, 1.019, 1.021, 3.0], dtype=F64)
    depth = targets.depth.clone()
    depth[0, 0, :6] *= ratio
    weight = weights(Rendered(rendered.color, depth, rendered.alpha), targets.depth, None, ObjectiveConfig())
    assert (weight[0, 0, :6] > 0).tolist() == [True, True, True, True, False, False]
    mean = float(targets.depth.mean())
    config = ObjectiveConfig(occlusion_tolerance=0.0, occlusion_of_mean=0.1)
    depth = targets.depth + torch.where(torch.arange(W) % 2 == 0, 0.099, 0.101) * mean
    weight = weights(Rendered(rendered.color, depth, rendered.alpha), targets.depth, None, config)
    assert bool((weight[..., 0::2] > 0).all()) and not bool(weight[..., 1::2].any())


def test_pixels_outside_the_mask_have_no_influence() -> None:
    rendered, targets = scene()
    valid = torch.rand(T, H, W, generator=torch.Generator().manual_seed(1)) > 0.4
    masked = replace(targets, valid=valid)
    changed = replace(masked, images=torch.where(valid.unsqueeze(1), targets.images, 0.5))
    for config in (PLAIN, ObjectiveConfig(exposure=True)):
        torch.testing.assert_close(colors(rendered, masked, config), colors(rendered, changed, config))
    # A window of SSIM sees the target's own pixels in the place of those without weight.
    structure = ObjectiveConfig(structure=1.0)
    everywhere = replace(rendered, color=torch.where(valid.unsqueeze(-1), rendered.color, 9.0))
    torch.testing.assert_close(colors(rendered, masked, structure), colors(everywhere, masked, structure))


def test_nothing_visible_is_an_error() -> None:
    rendered, targets = scene()
    nothing = Rendered(rendered.color, rendered.depth * 0, rendered.alpha * 0)
    for term in (colors, depths):
        with pytest.raises(NothingVisibleError, match="sees the surfels"):
            term(nothing, targets)
        with pytest.raises(NothingVisibleError):
            term(rendered, replace(targets, valid=torch.zeros(T, H, W, dtype=torch.bool)))


def test_exposure_is_recovered_exactly_and_makes_the_term_invariant() -> None:
    rendered, targets = scene()
    gain = torch.tensor([[0.7, 1.1, 1.3], [1.6, 0.9, 0.8]], dtype=F64)[:, None, None]
    bias = torch.tensor([[0.1, -0.2, 0.0], [0.05, 0.1, -0.1]], dtype=F64)[:, None, None]
    color = torch.rand(T, H, W, 3, dtype=F64)
    g, b = match_exposure(color, gain * color + bias, rendered.alpha)
    torch.testing.assert_close(g, gain, atol=2e-3, rtol=0)
    torch.testing.assert_close(b, bias, atol=2e-3, rtol=0)
    same = replace(targets, images=(gain * color + bias).permute(0, 3, 1, 2))
    picture = replace(rendered, color=color * rendered.alpha.unsqueeze(-1))
    assert float(colors(picture, same, ObjectiveConfig())) > 0.1
    assert float(colors(picture, same, ObjectiveConfig(exposure=True))) < 1e-3


def test_gain_does_not_reward_misalignment() -> None:
    """Noise against other noise of the same contrast keeps a gain of 1; least squares would give 0."""
    a, b = torch.rand(2, 1, 60, 80, 3, dtype=F64)
    gain, _ = match_exposure(a, b, torch.ones(1, 60, 80, dtype=F64))
    torch.testing.assert_close(gain, torch.ones_like(gain), atol=0.05, rtol=0)


def test_structure_of_two_flat_images_in_closed_form() -> None:
    """Without contrast, SSIM is (2 a b + c) / (a² + b² + c) with c = 0.01²; half of its lack of 1 counts."""
    flat = torch.ones(1, 12, 16, 3, dtype=F64)
    rendered = Rendered(0.2 * flat, flat[..., 0], flat[..., 0])
    targets = Targets(0.8 * flat.permute(0, 3, 1, 2), flat[..., 0])
    similarity = (2 * 0.2 * 0.8 + 1e-4) / (0.2**2 + 0.8**2 + 1e-4)
    expected = 0.15 * 0.6 + 0.85 * (1 - similarity) / 2
    assert float(colors(rendered, targets, ObjectiveConfig(structure=0.85))) == pytest.approx(
        expected, rel=1e-6
    )


def test_structure_ignores_a_small_shift_of_brightness_more_than_l1() -> None:
    rendered, targets = scene()
    image = targets.images.permute(0, 2, 3, 1)
    brighter = replace(rendered, color=(image + 0.05) * rendered.alpha.unsqueeze(-1))
    scrambled = replace(rendered, color=image.flip(1) * rendered.alpha.unsqueeze(-1))
    ssim, l1 = ObjectiveConfig(structure=1.0), ObjectiveConfig()
    ratio_ssim = colors(brighter, targets, ssim) / colors(scrambled, targets, ssim)
    ratio_l1 = colors(brighter, targets, l1) / colors(scrambled, targets, l1)
    assert float(ratio_ssim) < 0.25 * float(ratio_l1)


@pytest.mark.parametrize(
    "config",
    [
        ObjectiveConfig(occlusion_tolerance=1.0),
        ObjectiveConfig(occlusion_tolerance=1.0, unpremultiply=False),
        ObjectiveConfig(occlusion_tolerance=1.0, structure=0.85),
    ],
)
def test_derivatives_match_finite_differences(config: ObjectiveConfig) -> None:
    rendered, targets = scene()
    small = (slice(None), slice(4), slice(5))
    leaves = [t[small].clone().requires_grad_(True) for t in (rendered.color, rendered.depth, rendered.alpha)]
    cut = Targets(targets.images[..., :4, :5], targets.depth[small])
    assert torch.autograd.gradcheck(lambda c, d, a: colors(Rendered(c, d, a), cut, config), leaves)
    assert torch.autograd.gradcheck(lambda c, d, a: depths(Rendered(c, d, a), cut, config), leaves)


def test_gain_and_bias_of_exposure_are_constants_of_the_step() -> None:
    """Value and gradient are those of the colours that were matched beforehand, compared as they are."""
    rendered, targets = scene()
    color = rendered.color.clone().requires_grad_(True)
    plain, matched = (ObjectiveConfig(occlusion_tolerance=1.0, exposure=on) for on in (False, True))
    weight = weights(rendered, targets.depth, None, plain)
    alpha = rendered.alpha.clamp_min(1 / 255).unsqueeze(-1)
    gain, bias = match_exposure(rendered.color / alpha, targets.images.permute(0, 2, 3, 1), weight)
    assert float((gain - 1).abs().max()) > 0.05
    ours = colors(replace(rendered, color=color), targets, matched)
    theirs = colors(replace(rendered, color=gain * color + bias * alpha), targets, plain)
    torch.testing.assert_close(ours, theirs)
    gradients = (torch.autograd.grad(value, color)[0] for value in (ours, theirs))
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("slope", [0.0, 0.3, -0.3])
def test_the_photometric_term_is_lowest_at_the_true_depth(slope: float) -> None:
    """A textured plane z = 2 + slope · x, seen from the side: of all scales of the depth, 1 is the best."""
    h, w = 24, 32
    K = torch.tensor([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]], dtype=F64)
    g = torch.Generator().manual_seed(0)
    waves = 3 * torch.randn(3, 8, 2, generator=g, dtype=F64)

    def view(centre: Tensor) -> tuple[Tensor, Tensor]:
        ray = rays(pixel_grid(h, w, K).reshape(-1, 2), K)
        depth = (2 + slope * centre[0] - centre[2]) / (ray[:, 2] - slope * ray[:, 0])
        point = centre + depth.unsqueeze(-1) * ray
        color = 0.5 + 0.1 * torch.sin(torch.einsum("cki,pi->cpk", waves, point[:, :2])).sum(-1)
        return depth.reshape(h, w), color.reshape(3, h, w)

    pose = torch.eye(4, dtype=F64).repeat(2, 1, 1)
    pose[1, :3, 3] = torch.tensor([0.2, 0.05, 0.1])
    (depth, image), (other_depth, other) = view(pose[0, :3, 3]), view(pose[1, :3, 3])
    inner = torch.zeros(1, h, w, dtype=torch.bool)
    inner[:, 3:-3, 3:-6] = True
    scales = [0.98, 0.985, 0.99, 0.995, 1.0, 1.005, 1.01, 1.015, 1.02]
    losses = []
    for scale in scales:
        surfels = from_depth(scale * depth, K, pose[0], image, torch.full((h, w), 10.0, dtype=F64))
        cameras = Cameras(pose[1:], K.unsqueeze(0))
        losses.append(float(photometric(surfels, other[None], cameras, 1.1 * other_depth[None], inner)))
    assert abs(scales[int(np.argmin(losses))] - 1) < 0.006


def _tangent(gradient: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives by rotation and translation (V, 3) of a gradient by the entries of poses (V, 4, 4)."""
    basis = skew(torch.eye(3, dtype=pose.dtype))
    turned = torch.einsum("kij,vjl->vkil", basis, pose[:, :3, :3])
    return torch.einsum("vkil,vil->vk", turned, gradient[:, :3, :3]), gradient[:, :3, 3]


@pytest.mark.skipif(not PARITY.exists(), reason="the published numbers are not beside this checkout")
@pytest.mark.parametrize("term", ["photo", "geom"])
def test_parity_with_the_published_code(term: str) -> None:
    data = {k: torch.from_numpy(v) for k, v in np.load(PARITY / "tco_losses.npz").items()}
    expected = json.loads((PARITY / "tco_losses.json").read_text())[f"{term}_loss"]
    depth = data["depth"].clone().requires_grad_(True)
    pose = data["cam_to_world"].clone().requires_grad_(True)
    v = int(data[f"{term}_source_view"][0])
    surfels = from_depth(
        depth[v],
        data["K"][v],
        pose[v],
        data["images"][v],
        data["conf"][v],
        config=SurfelConfig(pixel_centre=0.0),
    )
    cameras = Cameras(pose, data["K"])
    config = ObjectiveConfig.reference()
    if term == "photo":
        loss = photometric(surfels, data["images"], cameras, depth, config=config)
    else:
        loss = geometric(surfels, cameras, depth, config=config)
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    loss.backward()
    assert depth.grad is not None and pose.grad is not None
    by_depth = data[f"{term}_grad_depth"]
    assert float((depth.grad - by_depth).norm()) < 1e-4 * float(by_depth.norm())
    ours, theirs = (_tangent(g, data["cam_to_world"]) for g in (pose.grad, data[f"{term}_grad_pose"]))
    for a, b in zip(ours, theirs, strict=True):
        assert float((a - b).norm()) < 1e-3 * float(b.norm())
