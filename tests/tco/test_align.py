"""Alignment of predicted cameras and depths to given ones: exact where the answer is known, and unit-free."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from tco.align import Aligned, CameraPenalties, KnownCameras, Similarity, align_cameras, scale_to_points
from tco.backbones.base import Backbone
from tco.backbones.dinov2 import ViTConfig
from tco.backbones.vggt import VGGT, VGGTConfig, VGGTNetwork
from tco.geometry import rigid, so3_exp
from tco.lora import LoRAConfig, adapted
from tco.optimize import optimize
from tco.options import TCOConfig
from tco.penalties import (
    focal,
    focal_uncertain,
    rotation,
    rotation_uncertain,
    translation,
    translation_uncertain,
)
from tco.types import Cameras, Priors, SparseDepth, Views

EXACT = {"rtol": 1e-9, "atol": 1e-9}


def poses(count: int, seed: int = 0, line: bool = False) -> Tensor:
    """Random cameras (V, 4, 4) float64; with their centres on a line, if asked for."""
    g = torch.Generator().manual_seed(seed)
    R = so3_exp(torch.randn(count, 3, generator=g, dtype=torch.float64))
    centres = torch.randn(count, 3, generator=g, dtype=torch.float64)
    if line:
        centres = centres[:1] * torch.arange(1.0, count + 1, dtype=torch.float64)[:, None] + centres[-1]
    return rigid(R, centres)


def some_similarity(seed: int = 1) -> Similarity:
    g = torch.Generator().manual_seed(seed)
    turn, t = torch.randn(2, 3, generator=g, dtype=torch.float64)
    return Similarity(torch.tensor(3.7, dtype=torch.float64), so3_exp(turn), 10 * t)


@pytest.mark.parametrize("line", [False, True])
@pytest.mark.parametrize("count", [2, 3, 12])
def test_a_similarity_is_found_again(count: int, line: bool) -> None:
    """Two cameras and cameras on a line are enough, for their orientations count."""
    source, given = poses(count, line=line), some_similarity()
    found = align_cameras(source, given.poses(source))
    for name in ("scale", "R", "t"):
        torch.testing.assert_close(getattr(found, name), getattr(given, name), **EXACT)
    torch.testing.assert_close(found.poses(source), given.poses(source), **EXACT)


def test_poses_move_as_points_do() -> None:
    """A point in a camera's frame, scaled, is seen by the moved camera at the moved place."""
    source, given = poses(5), some_similarity()
    local = torch.randn(5, 3, dtype=torch.float64)
    world = torch.einsum("vij,vj->vi", source[:, :3, :3], local) + source[:, :3, 3]
    moved = given.poses(source)
    again = torch.einsum("vij,vj->vi", moved[:, :3, :3], given.scale * local) + moved[:, :3, 3]
    torch.testing.assert_close(again, given.points(world), **EXACT)


def test_alignment_undoes_its_inverse_and_ignores_either_world() -> None:
    a, b = poses(6), poses(6, seed=5)
    there, back = align_cameras(a, b), align_cameras(b, a)
    torch.testing.assert_close(there.scale * back.scale, torch.ones((), dtype=torch.float64), **EXACT)
    torch.testing.assert_close(there.R @ back.R, torch.eye(3, dtype=torch.float64), **EXACT)
    moved = some_similarity()
    chained = align_cameras(moved.poses(a), b)
    torch.testing.assert_close(chained.poses(moved.poses(a)), there.poses(a), **EXACT)
    assert float(torch.linalg.det(there.R)) == pytest.approx(1)


def test_noise_moves_the_alignment_by_its_own_size() -> None:
    source, given = poses(30), some_similarity()
    target = given.poses(source)
    g = torch.Generator().manual_seed(4)
    target[:, :3, 3] += 1e-3 * torch.randn(30, 3, generator=g, dtype=torch.float64)
    found = align_cameras(source, target)
    assert float((found.R - given.R).norm()) < 1e-3
    assert float(found.scale / given.scale) == pytest.approx(1, abs=1e-3)


def test_centres_without_extent_have_no_scale() -> None:
    still = poses(4)
    still[:, :3, 3] = 1.0
    for a, b in ((still, poses(4)), (poses(4), still)):
        with pytest.raises(ValueError, match="all coincide"):
            align_cameras(a, b)
    with pytest.raises(ValueError, match="at least two"):
        align_cameras(poses(1), poses(1))


def points_of(depth: Tensor, factor: float, count: int = 40, seed: int = 0) -> SparseDepth:
    """Points at pixel centres of a map (H, W), ``factor`` times as deep."""
    g = torch.Generator().manual_seed(seed)
    h, w = depth.shape
    x, y = torch.randint(0, w, (count,), generator=g), torch.randint(0, h, (count,), generator=g)
    xy = torch.stack([x + 0.5, y + 0.5], -1).to(depth)
    return SparseDepth(xy, factor * depth[y, x], torch.full_like(xy[:, 0], 0.01), torch.arange(count))


def depth_map(seed: int = 0) -> Tensor:
    return 1 + torch.rand(14, 28, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_scale_of_exact_points_is_exact_and_few_wrong_ones_do_not_matter() -> None:
    depth = depth_map()
    points = points_of(depth, 0.3)
    scale = scale_to_points(depth, points)
    assert scale is not None and float(scale) == pytest.approx(0.3, rel=1e-12)
    wrong = points.depth.clone()
    wrong[:12] *= 5
    robust = scale_to_points(depth, replace(points, depth=wrong))
    assert robust is not None and float(robust) == pytest.approx(0.3, rel=2e-3)


def test_precise_points_count_more() -> None:
    depth = depth_map()
    points = points_of(depth, 1.0)
    z, sigma = points.depth.clone(), points.sigma.clone()
    z[:20] *= 1.02
    sigma[20:] *= 10
    scale = scale_to_points(depth, replace(points, depth=z, sigma=sigma))
    assert scale is not None and 1.015 < float(scale) < 1.02


@pytest.mark.parametrize("unit", [1e-3, 1.0, 250.0])
def test_scaled_depth_knows_no_unit_nor_does_its_gradient(unit: float) -> None:
    """d ↦ s(d) d is constant along d, so the gradient of anything made of it is orthogonal to d."""
    points = points_of(depth_map(1), 0.7)

    def scaled(depth: Tensor) -> Tensor:
        scale = scale_to_points(depth, points)
        assert scale is not None
        return scale * depth

    depth = depth_map().requires_grad_()
    torch.testing.assert_close(scaled(unit * depth), scaled(depth), **EXACT)
    weight = depth_map(2)
    (gradient,) = torch.autograd.grad((weight * scaled(depth)).sum(), depth)
    depth = depth.detach()
    assert float((gradient * depth).sum().abs()) < 1e-9 * float(gradient.norm() * depth.norm())


def test_the_gradient_of_the_scale_is_its_derivative() -> None:
    """Along changes of depth that leave the weights alone: those far from any point but one."""
    depth, points = depth_map(), points_of(depth_map(), 0.3)
    direction = depth * 1e-6  # a change of unit, of which the weights know nothing
    leaf = depth.clone().requires_grad_()
    ahead, behind = scale_to_points(depth + direction, points), scale_to_points(depth - direction, points)
    scale = scale_to_points(leaf, points)
    assert scale is not None and ahead is not None and behind is not None
    (gradient,) = torch.autograd.grad(scale, leaf)
    assert float((gradient * direction).sum()) == pytest.approx(float(ahead - behind) / 2, rel=1e-6)


def test_three_points_tell_no_scale() -> None:
    depth = depth_map()
    assert scale_to_points(depth, points_of(depth, 1.0, count=3)) is None
    outside = replace(points_of(depth, 1.0), xy=torch.full((40, 2), -5.0, dtype=torch.float64))
    assert scale_to_points(depth, outside) is None


TINY = VGGTConfig(
    encoder=ViTConfig(channels=48, depth=1, heads=2), channels=48, depth=4, heads=2, camera_depth=1,
    camera_heads=2, features=8, levels=(8, 8, 8, 8), layers=(0, 1, 2, 3),
)  # fmt: skip
VIEWS, SIZE = 3, (28, 42)


@pytest.fixture(scope="module")
def network() -> VGGT:
    torch.manual_seed(0)
    inner = VGGTNetwork(TINY)
    with torch.no_grad():
        for p in inner.parameters():
            p.copy_(0.2 * torch.randn_like(p))
    return VGGT(inner).eval().requires_grad_(False)


@pytest.fixture(scope="module")
def scene() -> tuple[Views, Priors]:
    g = torch.Generator().manual_seed(3)
    images = torch.rand(VIEWS, 3, *SIZE, generator=g)
    views = Views(images, torch.ones(VIEWS, *SIZE, dtype=torch.bool), ("a", "b", "c"))
    pose = torch.eye(4).repeat(VIEWS, 1, 1)
    pose[:, 0, 3] = torch.tensor([0.0, 0.1, 0.2])
    K = torch.tensor([[40.0, 0, 21], [0, 40, 14], [0, 0, 1]]).repeat(VIEWS, 1, 1)
    depth = 1 + 0.2 * torch.rand(VIEWS, *SIZE, generator=g)
    sparse = tuple(points_of(d, 1.0, seed=i) for i, d in enumerate(depth))
    tight = torch.full((VIEWS,), 0.01)
    overlap = torch.full((VIEWS, VIEWS), 30.0).fill_diagonal_(0)
    return views, Priors(
        Cameras(pose, K), sparse, overlap=overlap, rotation_sigma=tight, centre_sigma=tight, focal_sigma=tight
    )


def test_predictions_have_the_given_cameras_and_scale(network: VGGT, scene: tuple[Views, Priors]) -> None:
    views, priors = scene
    wrapped = KnownCameras(network)
    assert isinstance(wrapped, Backbone) and not wrapped.uses_cameras and wrapped.stride == 14
    encoded = wrapped.encode(views, priors)
    with torch.no_grad():
        plain, aligned = network.decode(encoded.inner), wrapped.decode(encoded)
    assert aligned.cameras is priors.cameras and aligned.views == (0, 1, 2)
    assert priors.sparse is not None
    for before, after, points in zip(plain.depth, aligned.depth, priors.sparse, strict=True):
        ratio = after / before
        torch.testing.assert_close(ratio, ratio[0, :1].expand_as(ratio), rtol=1e-4, atol=0)
        left = scale_to_points(after, points)
        assert left is not None and float(left) == pytest.approx(1, abs=1e-4)
    assert wrapped.agreement.keys() == {"rotation_degrees", "centre", "centre_over_depth"}
    assert not wrapped.history
    with torch.no_grad():
        one = wrapped.decode(encoded, [1])
    torch.testing.assert_close(one.depth[0], aligned.depth[1], rtol=1e-3, atol=1e-4)


def test_centres_in_one_place_agree_with_nothing(network: VGGT, scene: tuple[Views, Priors]) -> None:
    """They are off by what the given ones are from their middle; the rotations are compared all the same."""
    priors = scene[1]
    assert priors.cameras is not None and priors.sparse is not None
    given = priors.cameras
    poses = given.world_from_cam.clone()
    poses[:, :3, 3] = 1.0
    wrapped = KnownCameras(network)
    wrapped._compare(Cameras(poses, given.K), given, priors.sparse)
    assert wrapped.agreement["rotation_degrees"] < 0.1
    centres = given.world_from_cam[:, :3, 3]
    away = (centres - centres.mean(0)).norm(dim=-1)
    assert wrapped.agreement["centre"] == pytest.approx(float(away.median() / away.mean()))
    wrapped._compare(Cameras(poses[:1], given.K[:1]), given[:1], priors.sparse[:1])
    assert wrapped.agreement == {}


def test_hidden_points_do_not_tell_the_scale(network: VGGT, scene: tuple[Views, Priors]) -> None:
    views, priors = scene
    assert priors.sparse is not None
    wrapped = KnownCameras(network)
    encoded: Aligned = wrapped.encode(views, priors)
    other = replace(priors.sparse[1], depth=2 * priors.sparse[1].depth)
    with torch.no_grad():
        before, after = wrapped.decode(encoded), wrapped.decode(wrapped.with_points(encoded, {1: other}))
    torch.testing.assert_close(after.depth[1], 2 * before.depth[1], rtol=1e-4, atol=0)
    torch.testing.assert_close(after.depth[0], before.depth[0], rtol=1e-4, atol=0)


@pytest.mark.parametrize("without", [(0,), (0, 1, 2)])
def test_views_without_points_get_the_scale_of_the_others_or_of_the_cameras(
    network: VGGT, scene: tuple[Views, Priors], without: tuple[int, ...]
) -> None:
    views, priors = scene
    assert priors.sparse is not None and priors.cameras is not None
    none = torch.zeros(len(priors.sparse[0]), dtype=torch.bool)
    sparse = tuple(p[none] if i in without else p for i, p in enumerate(priors.sparse))
    wrapped = KnownCameras(network)
    encoded = wrapped.encode(views, replace(priors, sparse=sparse))
    with torch.no_grad():
        plain, aligned = network.decode(encoded.inner), wrapped.decode(encoded)
    ratio = (aligned.depth / plain.depth).flatten(1).median(1).values
    if len(without) == 3:
        expected = align_cameras(plain.cameras.world_from_cam, priors.cameras.world_from_cam).scale
        torch.testing.assert_close(ratio, expected.expand(3), rtol=1e-4, atol=0)
    else:
        assert float(ratio[0]) == pytest.approx(float(ratio[1:].min()), rel=1e-4)


def test_depth_carries_the_gradient_of_the_camera_penalties(
    network: VGGT, scene: tuple[Views, Priors]
) -> None:
    """The gradient of a loss of the wrapped depth is that of the loss plus the weighted penalties."""
    views, priors = scene
    given = priors.cameras
    assert given is not None
    weights = CameraPenalties(rotation=0.5, translation=3.0, focal=0.02)
    wrapped = KnownCameras(network, weights)
    encoded = wrapped.encode(views, priors)
    target = torch.rand(SIZE, generator=torch.Generator().manual_seed(8))
    with adapted(wrapped.decoder(), LoRAConfig(targets=("qkv",))) as parameters:
        with torch.no_grad():
            for p in parameters:
                p.copy_(0.05 * torch.randn(p.shape, generator=torch.Generator().manual_seed(p.numel())))
        depth = wrapped.decode(encoded, [1]).depth[0]
        ours = torch.autograd.grad((depth * target).mean(), parameters)
        plain = network.decode(encoded.inner, [1])
        assert priors.sparse is not None
        scale = scale_to_points(plain.depth[0], priors.sparse[1])
        pose = plain.cameras.world_from_cam
        terms = {
            "rotation": rotation(pose, given.world_from_cam),
            "translation": translation(pose, given.world_from_cam),
            "focal": focal(plain.cameras.K, given.K),
        }
        loss = (scale * plain.depth[0] * target).mean() + sum(
            getattr(weights, name) * value for name, value in terms.items()
        )
        theirs = torch.autograd.grad(loss, parameters)
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5)
    assert wrapped.history == [pytest.approx({k: float(v.detach()) for k, v in terms.items()}, rel=1e-4)]


def test_optimisation_runs_through_and_lowers_the_penalties(
    network: VGGT, scene: tuple[Views, Priors]
) -> None:
    """With nothing else to gain, the network's poses come nearer to the given ones; it is left as it was."""
    views, priors = scene
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    wrapped = KnownCameras(network, CameraPenalties(focal=0.0))
    config = TCOConfig(
        steps=10, rate=2e-2, lora_targets=("qkv", "proj", "fc1", "fc2"), photometric_weight=0.0,
        sparse_weight=1e-6,
    )  # fmt: skip
    outcome = optimize(wrapped, views, priors, config)
    sums = [step["rotation"] + 2 * step["translation"] for step in wrapped.history]
    assert len(sums) == 10 and min(sums[-3:]) < 0.9 * sums[0]
    assert outcome.prediction.depth.shape == (VIEWS, *SIZE)
    assert all(torch.equal(before[name], tensor) for name, tensor in network.state_dict().items())


def test_the_settings_say_what_holds_the_networks_cameras(network: VGGT, scene: tuple[Views, Priors]) -> None:
    """By uncertainty: each error in its standard deviation, all with the weight and kernel of cameras."""
    views, priors = scene
    assert CameraPenalties.of(TCOConfig()) == CameraPenalties(1.0, 2.0, 0.01)
    config = TCOConfig(own_cameras="uncertainty", camera_weight=0.02, camera_kernel="cauchy")
    wrapped = KnownCameras(network, CameraPenalties.of(config))
    encoded = wrapped.encode(views, priors)
    given, sigma = priors.cameras, priors.rotation_sigma
    assert given is not None and sigma is not None
    with adapted(wrapped.decoder(), LoRAConfig(targets=("qkv",))) as parameters:
        with torch.no_grad():
            for p in parameters:
                p.copy_(0.05 * torch.randn(p.shape, generator=torch.Generator().manual_seed(p.numel())))
        ours = torch.autograd.grad(0 * wrapped.decode(encoded, [1]).depth.sum(), parameters)
        plain = network.decode(encoded.inner, [1]).cameras
        poses = plain.world_from_cam, given.world_from_cam
        terms = {
            "rotation": rotation_uncertain(*poses, sigma, "cauchy"),
            "translation": translation_uncertain(*poses, sigma, "cauchy"),
            "focal": focal_uncertain(plain.K, given.K, sigma, "cauchy"),
        }
        theirs = torch.autograd.grad(0.02 * torch.stack(list(terms.values())).sum(), parameters)
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5)
    assert any(float(g.abs().max()) > 0 for g in ours)
    assert wrapped.history == [pytest.approx({k: float(v.detach()) for k, v in terms.items()}, rel=1e-4)]
    with pytest.raises(ValueError, match="have no standard deviations"):
        wrapped.penalties.known(replace(priors, focal_sigma=None))


def test_cameras_that_are_known_badly_pull_less(network: VGGT, scene: tuple[Views, Priors]) -> None:
    """Three times the standard deviation, with errors far beyond it: a third of the pull, as Huber's does."""
    views, priors = scene
    pulls = []
    for factor in (1.0, 3.0):
        wide = {f.name: factor * getattr(priors, f.name) for f in fields(priors) if f.name.endswith("_sigma")
                and getattr(priors, f.name) is not None}  # fmt: skip
        wrapped = KnownCameras(network, CameraPenalties.of(TCOConfig(own_cameras="uncertainty")))
        encoded = wrapped.encode(views, replace(priors, **wide))
        with adapted(wrapped.decoder(), LoRAConfig(targets=("qkv",))) as parameters:
            grads = torch.autograd.grad(0 * wrapped.decode(encoded, [1]).depth.sum(), parameters)
        pulls.append(torch.cat([g.flatten() for g in grads]))
    assert float(pulls[0].norm()) > 1e-3
    assert float((pulls[1] - pulls[0] / 3).norm()) < 0.05 * float(pulls[0].norm())


def test_what_cannot_be_aligned_is_refused(network: VGGT, scene: tuple[Views, Priors]) -> None:
    views, priors = scene
    wrapped = KnownCameras(network)
    for missing in ({"cameras": None}, {"sparse": None}):
        with pytest.raises(ValueError, match="vggt can only be aligned"):
            wrapped.encode(views, replace(priors, **missing))
    from tco.backbones.weights import load_sweep

    with pytest.raises(ValueError, match="needs no alignment"):
        KnownCameras(load_sweep())
