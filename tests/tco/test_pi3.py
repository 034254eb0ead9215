"""π³: the published numbers, equivariance to the order of views, focal lengths, rotations, the protocol."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.backbones.base import Backbone
from tco.backbones.pi3 import Pi3, Pi3Config, Pi3Network, centred
from tco.backbones.pi3_heads import FOCAL, fitted_intrinsics, nearest_rotation, recovered_focal
from tco.geometry import pixel_grid, rays, so3_exp, transform
from tco.types import Cameras, Prediction, Priors, Views
from tests.tco.published import (
    TOLERANCE,
    by_rule,
    check_any_size,
    check_bfloat16,
    check_gradients,
    check_recomputing,
    check_subset,
    difference,
    reference,
    some_views,
    tiny_pi3,
    views_of,
)


@pytest.mark.slow
@torch.no_grad()
def test_pi3_gives_the_published_numbers() -> None:
    known = reference("pi3_large")
    backbone = Pi3(by_rule(lambda: Pi3Network(Pi3Config.large()), known.salt)).eval()
    encoded = backbone.encode(views_of(known.images), Priors())
    tokens = backbone.tokens(encoded)
    pose, every = backbone.poses(tokens, encoded), range(len(known.images))
    ray, depth, logit = backbone.maps(tokens, encoded, every)
    local = torch.cat([ray, torch.ones_like(depth).unsqueeze(-1)], -1) * depth.unsqueeze(-1)
    points = transform(pose.unsqueeze(1), local)
    assert difference(pose, known.arrays["camera_poses"]) < TOLERANCE
    assert difference(logit.unsqueeze(-1), known.arrays["conf"]) < TOLERANCE
    # Depths go through an exponential and span many orders of magnitude: each point is compared by itself.
    for ours, name in ((local, "local_points"), (points, "points")):
        theirs = known.arrays[name].astype(np.float64)
        error = np.linalg.norm(ours.double().numpy() - theirs, axis=-1) / np.linalg.norm(theirs, axis=-1)
        assert error.max() < TOLERANCE, name


def test_names_and_shapes_are_the_published() -> None:
    with torch.device("meta"):
        network = Pi3Network(Pi3Config.large())
    assert {k: tuple(t.shape) for k, t in network.state_dict().items()} == reference("pi3_large").shapes


@pytest.fixture(scope="module")
def backbone() -> Pi3:
    return tiny_pi3()


@torch.no_grad()
def predicted(backbone: Backbone, views: Views) -> Prediction:
    return backbone.decode(backbone.encode(views, Priors()))


def test_it_is_a_backbone(backbone: Pi3) -> None:
    assert isinstance(backbone, Backbone)
    encoded = backbone.encode(some_views(), Priors())
    assert backbone.with_points(encoded, {}) is encoded


@pytest.mark.parametrize("order", [[1, 0, 2, 3, 4], [4, 2, 0, 3, 1]])
def test_views_in_another_order_are_predicted_in_that_order(backbone: Pi3, order: list[int]) -> None:
    views = some_views(5)
    moved = Views(views.images[order], views.valid[order], tuple(views.names[i] for i in order))
    a, b = predicted(backbone, views), predicted(backbone, moved)
    torch.testing.assert_close(b.depth, a.depth[order], rtol=1e-4, atol=0)
    torch.testing.assert_close(b.confidence, a.confidence[order], rtol=1e-4, atol=0)
    torch.testing.assert_close(b.cameras.K, a.cameras.K[order], rtol=1e-4, atol=0)
    torch.testing.assert_close(
        b.cameras.world_from_cam, a.cameras.world_from_cam[order], rtol=1e-4, atol=1e-5
    )
    assert difference(a.depth[1:], a.depth[:-1]) > 1e-3


def test_every_view_is_seen_by_the_others(backbone: Pi3) -> None:
    views = some_views(3)
    images = views.images.clone()
    images[2] = 1 - images[2]
    plain, changed = predicted(backbone, views), predicted(backbone, views_of(images))
    assert difference(changed.depth[0], plain.depth[0]) > 1e-4


def test_two_runs_give_the_same_bits(backbone: Pi3) -> None:
    a, b = (predicted(backbone, some_views()) for _ in range(2))
    assert torch.equal(a.depth, b.depth) and torch.equal(a.cameras.world_from_cam, b.cameras.world_from_cam)


@pytest.mark.parametrize("chosen", [[2], [3, 0]])
def test_some_views_are_decoded_as_all_are(backbone: Pi3, chosen: list[int]) -> None:
    check_subset(backbone, chosen)


@torch.no_grad()
def test_views_that_are_not_decoded_keep_the_focal_length_of_the_context(backbone: Pi3) -> None:
    encoded = backbone.encode(some_views(4), Priors())
    full = backbone.decode(encoded)
    other = centred(torch.tensor([50.0, 60, 70, 80]), (42, 56))
    context = replace(full, cameras=Cameras(full.cameras.world_from_cam, other))
    K = backbone.decode(encoded, [2], context).cameras.K
    assert K[[0, 1, 3], 0, 0].tolist() == K[[0, 1, 3], 1, 1].tolist() == [50, 60, 80]
    torch.testing.assert_close(K[2], full.cameras.K[2])


@pytest.mark.parametrize(("count", "size"), [(1, (28, 42)), (3, (70, 28)), (5, (14, 56)), (6, (28, 28))])
def test_any_number_and_size(backbone: Pi3, count: int, size: tuple[int, int]) -> None:
    check_any_size(backbone, count, size)


@pytest.mark.parametrize("size", [(30, 42), (42, 30)])
def test_a_canvas_that_is_not_made_of_patches_is_refused(backbone: Pi3, size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"{size[1]}×{size[0]}.*divisible by 14"):
        backbone.encode(some_views(2, size), Priors())


def test_gradients_of_adapters() -> None:
    check_gradients(tiny_pi3(), cameras=True)


def test_recomputing_changes_no_gradient(backbone: Pi3) -> None:
    check_recomputing(backbone, tiny_pi3(recompute=range(1, 3)))


def test_bfloat16(backbone: Pi3) -> None:
    check_bfloat16(backbone, tiny_pi3(dtype=torch.bfloat16))


def test_adapters_reach_the_decoder_alone(backbone: Pi3) -> None:
    inside = {id(p) for p in backbone.decoder().parameters()}
    names = {name for name, p in backbone.network.named_parameters() if id(p) in inside}
    assert names == {name for name in backbone.network.state_dict() if name.startswith("decoder.")}


def pinhole(focal: Tensor, size: tuple[int, int]) -> Tensor:
    """Rays x / z, y / z (V, H, W, 2) of the pixels of centred cameras."""
    xy = pixel_grid(*size, focal).reshape(-1, 2)
    return rays(xy, centred(focal, size))[..., :2].unflatten(1, size)


@pytest.mark.parametrize("size", [(28, 42), (56, 14)])
def test_the_focal_length_of_a_pinhole_camera_is_recovered(size: tuple[int, int]) -> None:
    focal = torch.tensor([15.0, 40.0, 300.0], dtype=torch.float64)
    weight = torch.rand(3, *size, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(recovered_focal(pinhole(focal, size), weight), focal)


def test_pixels_without_weight_do_not_count() -> None:
    size, focal = (28, 42), torch.tensor([40.0])
    ray = pinhole(focal, size)
    weight = torch.ones(1, *size)
    weight[:, :, :10] = 0
    ray[:, :, :10] = 100
    torch.testing.assert_close(recovered_focal(ray, weight), focal)


def test_noise_of_the_rays_does_not_bias_the_focal_length() -> None:
    """With noise as large as the rays, the regression the other way round would be off by half."""
    size, focal = (140, 140), torch.full((8,), 100.0)
    ray = pinhole(focal, size)
    noise = ray.std() * torch.randn(ray.shape, generator=torch.Generator().manual_seed(0))
    found = recovered_focal(ray + noise, torch.ones(8, *size))
    assert float((found / focal - 1).abs().max()) < 0.03
    u = pinhole(torch.ones(8), size)
    other_way = (u * (ray + noise)).sum((1, 2, 3)) / ((ray + noise) ** 2).sum((1, 2, 3))
    assert float((other_way / focal).max()) < 0.6


def test_the_focal_length_is_differentiable() -> None:
    focal = torch.tensor([20.0, 30.0], dtype=torch.float64)
    noise = 0.05 * torch.randn(2, 4, 6, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ray = (pinhole(focal, (4, 6)) + noise).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda r: recovered_focal(r, torch.ones(2, 4, 6).double()), (ray,))


def test_rays_of_no_camera_give_a_focal_length_within_bounds() -> None:
    size, unit = (28, 42), 0.5 * math.hypot(28, 42)
    ray = pinhole(torch.tensor([40.0]), size)
    for nonsense, bound in ((-ray, FOCAL[1]), (0 * ray, FOCAL[1]), (1e4 * ray, FOCAL[0])):
        found = recovered_focal(nonsense, torch.ones(1, *size))
        torch.testing.assert_close(found, torch.tensor([bound * unit]))
    assert bool(torch.isfinite(recovered_focal(ray, torch.zeros(1, *size))).all())


def test_fitted_intrinsics_are_those_of_any_pinhole_camera() -> None:
    """Two focal lengths and a principal point off the middle, exactly; and the derivative is one."""
    K = torch.tensor([[[60.0, 0, 31.5], [0, 75, 14.2], [0, 0, 1]], [[40, 0, 20], [0, 38, 16], [0, 0, 1]]])
    K = K.double()
    ray = rays(pixel_grid(28, 42, K).reshape(1, -1, 2), K)[..., :2].reshape(2, 28, 42, 2)
    torch.testing.assert_close(fitted_intrinsics(ray), K, rtol=1e-5, atol=1e-4)
    small = ray[:, ::7, ::7].clone().requires_grad_(True)
    assert torch.autograd.gradcheck(fitted_intrinsics, (small,))


def test_as_published_the_cameras_are_fitted_and_points_are_the_point_map(backbone: Pi3) -> None:
    """Only the intrinsics differ: of all views if all are decoded, else the others' are the context's."""
    views = some_views()
    with torch.no_grad():
        encoded = backbone.encode(views, Priors())
        plain = backbone.decode(encoded)
        backbone.as_published = True
        try:
            fitted = backbone.decode(encoded)
            one = backbone.decode(encoded, [1], plain)
        finally:
            backbone.as_published = False
    assert fitted.rays is not None and plain.rays is not None
    torch.testing.assert_close(fitted.cameras.K, fitted_intrinsics(fitted.rays))
    for name in ("depth", "rays", "confidence"):
        assert torch.equal(getattr(plain, name), getattr(fitted, name))
    assert torch.equal(one.cameras.K[[0, 2]], plain.cameras.K[[0, 2]])
    torch.testing.assert_close(one.cameras.K[1], fitted.cameras.K[1])


def matrices(count: int = 6) -> Tensor:
    """Random matrices, half of them with a negative determinant."""
    M = torch.randn(count, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    M[:, 0] *= torch.where(torch.arange(count) % 2 == 0, 1, -1).view(-1, 1) * torch.linalg.det(M).sign().view(
        -1, 1
    )
    return M


def test_the_nearest_rotation_is_nearest() -> None:
    M = matrices()
    R = nearest_rotation(M)
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand_as(R))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(R)).double())
    distance = (R - M).norm(dim=(1, 2))
    for k in range(200):
        turn = so3_exp(torch.randn(3, dtype=torch.float64, generator=torch.Generator().manual_seed(k)))
        for angle in (turn, so3_exp(0.01 * (turn[0] - turn[1]))):
            assert bool(((angle @ R - M).norm(dim=(1, 2)) >= distance - 1e-12).all())


def test_a_rotation_is_its_own_nearest() -> None:
    R = so3_exp(torch.tensor([[0.3, -2.0, 0.7], [0, 0, 0], [3.1, 0, 0]], dtype=torch.float64))
    torch.testing.assert_close(nearest_rotation(R), R)


def test_the_nearest_rotation_is_differentiable() -> None:
    M = matrices().requires_grad_(True)
    assert torch.autograd.gradcheck(nearest_rotation, (M,))


def test_it_is_differentiable_at_a_rotation_where_singular_vectors_are_not() -> None:
    R = so3_exp(torch.tensor([[0.3, -2.0, 0.7], [0, 0, 0]], dtype=torch.float64)).requires_grad_(True)
    assert torch.autograd.gradcheck(nearest_rotation, (R,))


def test_where_several_rotations_are_nearest_the_gradient_is_finite() -> None:
    M = torch.zeros(2, 3, 3, dtype=torch.float64)
    M[1] = torch.diag(torch.tensor([1.0, 0.5, -0.5]))
    M.requires_grad_(True)
    nearest_rotation(M)[:, 0, 1].sum().backward()
    assert M.grad is not None and bool(torch.isfinite(M.grad).all())
