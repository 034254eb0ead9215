"""VGGT: the published numbers, the first view as the reference, parts with known answers, the protocol."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from tco.backbones.base import Backbone
from tco.backbones.dinov2 import ViTConfig
from tco.backbones.transformer import rotary
from tco.backbones.vggt import VGGT, VGGTConfig, VGGTNetwork
from tco.backbones.vggt_heads import (
    CameraHead,
    Fusion,
    cam_from_world,
    cameras,
    depth_of,
    points_of,
    resized,
    with_places,
)
from tco.geometry import invert
from tco.lora import LoRAConfig, adapted
from tco.types import Prediction, Priors, Views
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
    tiny_vggt,
    views_of,
)

SMALL = VGGTConfig(
    ViTConfig.vits14(), 384, 4, 6, camera_depth=2, camera_heads=12, features=64, levels=(48, 96, 192, 192),
    layers=(0, 1, 2, 3),
)  # fmt: skip


@torch.no_grad()
def differences(config: VGGTConfig, name: str) -> dict[str, float]:
    """Relative differences of all outputs from the reference, by name."""
    known = reference(name)
    network = by_rule(lambda: VGGTNetwork(config), known.salt)
    backbone = VGGT(network).eval()
    encoded = backbone.encode(views_of(known.images), Priors())
    every = range(len(known.images))
    features = backbone.features(encoded, every)
    poses = torch.stack(network.camera_head(features.camera))
    prediction, (points, sure) = backbone.decode(encoded), backbone.points(encoded, every)
    ours = {
        "last_tokens": features.last[:, :8, :16],
        "pose_enc": poses,
        "extrinsics": cam_from_world(poses[-1])[:, :3],
        "depth": prediction.depth,
        "depth_conf": prediction.confidence,
        "world_points": points,
        "world_points_conf": sure,
    }
    assert ours.keys() == known.arrays.keys()
    torch.testing.assert_close(
        prediction.cameras.world_from_cam, invert(cam_from_world(poses[-1])), rtol=1e-4, atol=1e-4
    )
    return {key: difference(value, known.arrays[key]) for key, value in ours.items()}


def test_the_small_network_gives_the_published_numbers() -> None:
    found = differences(SMALL, "vggt_small")
    assert max(found.values()) < TOLERANCE, found


@pytest.mark.slow
def test_vggt_1b_gives_the_published_numbers() -> None:
    found = differences(VGGTConfig.vggt_1b(), "vggt_1b")
    assert max(found.values()) < TOLERANCE, found


@pytest.mark.parametrize(("config", "name"), [(SMALL, "vggt_small"), (VGGTConfig.vggt_1b(), "vggt_1b")])
def test_names_and_shapes_are_the_published(config: VGGTConfig, name: str) -> None:
    with torch.device("meta"):
        network = VGGTNetwork(config)
    assert {k: tuple(t.shape) for k, t in network.state_dict().items()} == reference(name).shapes


@pytest.fixture(scope="module")
def backbone() -> VGGT:
    return tiny_vggt()


@torch.no_grad()
def predicted(backbone: Backbone, views: Views) -> Prediction:
    return backbone.decode(backbone.encode(views, Priors()))


def reordered(views: Views, order: list[int]) -> Views:
    return Views(views.images[order], views.valid[order], tuple(views.names[i] for i in order))


def test_it_is_a_backbone(backbone: VGGT) -> None:
    assert isinstance(backbone, Backbone)
    encoded = backbone.encode(some_views(), Priors())
    assert backbone.with_points(encoded, {}) is encoded


def test_the_order_of_all_views_but_the_first_does_not_matter(backbone: VGGT) -> None:
    views, order = some_views(5), [0, 3, 1, 4, 2]
    plain, moved = predicted(backbone, views), predicted(backbone, reordered(views, order))
    torch.testing.assert_close(moved.depth, plain.depth[order], rtol=1e-4, atol=0)
    torch.testing.assert_close(moved.cameras.K, plain.cameras.K[order], rtol=1e-4, atol=0)
    torch.testing.assert_close(
        moved.cameras.world_from_cam, plain.cameras.world_from_cam[order], rtol=1e-4, atol=1e-5
    )


def test_the_first_view_is_told_apart(backbone: VGGT) -> None:
    views, order = some_views(3), [1, 0, 2]
    plain, moved = predicted(backbone, views), predicted(backbone, reordered(views, order))
    assert difference(moved.depth, plain.depth[order]) > 1e-3
    assert difference(moved.cameras.world_from_cam, plain.cameras.world_from_cam[order]) > 1e-3


def test_equal_views_after_the_first_are_predicted_equally(backbone: VGGT) -> None:
    views = some_views(3)
    same = Views(views.images[:1].expand(3, -1, -1, -1), views.valid, views.names)
    depth = predicted(backbone, same).depth
    torch.testing.assert_close(depth[1], depth[2], rtol=1e-5, atol=0)
    assert difference(depth[0], depth[1]) > 1e-3


def test_every_view_is_seen_by_the_others(backbone: VGGT) -> None:
    views = some_views(3)
    images = views.images.clone()
    images[2] = 1 - images[2]
    plain, changed = predicted(backbone, views), predicted(backbone, views_of(images))
    assert difference(changed.depth[0], plain.depth[0]) > 1e-4


def test_two_runs_give_the_same_bits(backbone: VGGT) -> None:
    a, b = (predicted(backbone, some_views()) for _ in range(2))
    assert torch.equal(a.depth, b.depth) and torch.equal(a.cameras.world_from_cam, b.cameras.world_from_cam)


@pytest.mark.parametrize("chosen", [[2], [3, 0], [1, 2, 3, 0]])
def test_some_views_are_decoded_as_all_are(backbone: VGGT, chosen: list[int]) -> None:
    check_subset(backbone, chosen)


@pytest.mark.parametrize(("count", "size"), [(1, (28, 42)), (3, (70, 28)), (5, (14, 56)), (6, (28, 28))])
def test_any_number_and_size(backbone: VGGT, count: int, size: tuple[int, int]) -> None:
    check_any_size(backbone, count, size)


@pytest.mark.parametrize("size", [(30, 42), (42, 30)])
def test_a_canvas_that_is_not_made_of_patches_is_refused(backbone: VGGT, size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"{size[1]}×{size[0]}.*divisible by 14"):
        backbone.encode(some_views(2, size), Priors())


def test_gradients_of_adapters() -> None:
    check_gradients(tiny_vggt(), cameras=False)


def test_cameras_have_gradients_too(backbone: VGGT) -> None:
    encoded = backbone.encode(some_views(), Priors())
    with adapted(backbone.decoder(), LoRAConfig()) as parameters:
        with torch.no_grad():
            for p in parameters:
                p.add_(0.02)
        backbone.decode(encoded, [0]).cameras.world_from_cam[1, 0, 3].backward()
        assert all(p.grad is not None and bool(p.grad.any()) for p in parameters)


def test_recomputing_changes_no_gradient(backbone: VGGT) -> None:
    check_recomputing(backbone, tiny_vggt(recompute=range(1, 3)))


def test_bfloat16(backbone: VGGT) -> None:
    check_bfloat16(backbone, tiny_vggt(dtype=torch.bfloat16))


def test_adapters_reach_the_decoder_and_not_the_encoder(backbone: VGGT) -> None:
    inside = {id(p) for p in backbone.decoder().parameters()}
    names = {name for name, p in backbone.network.named_parameters() if id(p) in inside}
    assert names == {
        name
        for name in backbone.network.state_dict()
        if name.startswith(("aggregator.frame_blocks.", "aggregator.global_blocks."))
    }


def test_each_iteration_of_the_cameras_answers_for_its_own_change_alone() -> None:
    """The published head cuts what came before, in the sum too: of a bias that all add, the last counts."""
    torch.manual_seed(0)
    head = CameraHead(32, 4, 1)
    poses = head(torch.randn(3, 32), iterations=4)
    for pose in poses:
        (grad,) = torch.autograd.grad(pose[:, :7].sum(), head.pose_branch.fc2.bias, retain_graph=True)
        torch.testing.assert_close(grad[:7], torch.full((7,), 3.0))


def test_encoded_poses_become_cameras() -> None:
    # A quarter turn about y, of any length of the quaternion, and fields of view of 60° and 90°.
    half = 3 * math.sqrt(0.5)
    pose = torch.tensor([[1.0, 2.0, 3.0, 0.0, half, 0.0, half, math.radians(60), math.radians(90)]])
    made = cameras(pose, (300, 400))
    cam = cam_from_world(pose)[0]
    torch.testing.assert_close(cam @ torch.tensor([0.0, 0.0, 1.0, 1.0]), torch.tensor([2.0, 2.0, 3.0, 1.0]))
    torch.testing.assert_close(cam @ made.world_from_cam[0], torch.eye(4))
    fy = 150 / math.tan(math.radians(30))
    torch.testing.assert_close(made.K[0], torch.tensor([[200, 0, 200], [0, fy, 150], [0, 0, 1.0]]))


def test_a_field_of_view_of_zero_gives_a_finite_camera() -> None:
    pose = torch.tensor([[0.0, 0, 0, 0, 0, 0, 1, 0, 0]], requires_grad=True)
    made = cameras(pose, (28, 42))
    assert bool(torch.isfinite(made.K).all())
    made.K.sum().backward()
    assert pose.grad is not None and bool(torch.isfinite(pose.grad).all())


def test_activations() -> None:
    x = torch.tensor([-2.0, 0.0, 1.5]).view(1, 1, 1, 3)
    depth, sure = depth_of(x.expand(1, 2, 1, 3))
    torch.testing.assert_close(depth, x[0].exp())
    torch.testing.assert_close(sure, 1 + x[0].exp())
    points, _ = points_of(x.expand(1, 4, 1, 3))
    assert points.shape == (1, 1, 3, 3)
    # The inverse of the activation, sign(y) · log(1 + |y|), gives the map back.
    torch.testing.assert_close(points.sign() * points.abs().log1p(), x.unsqueeze(-1)[:, 0].expand(1, 1, 3, 3))


def test_a_pointwise_convolution_and_an_interpolation_commute() -> None:
    torch.manual_seed(0)
    fusion = Fusion(6, first=False)
    x, skip = torch.randn(2, 6, 4, 5), torch.randn(2, 6, 4, 5)
    y = x + fusion.resConfUnit1(skip) if isinstance(fusion.resConfUnit1, nn.Module) else x
    published = fusion.out_conv(resized(fusion.resConfUnit2(y), (8, 10)))
    torch.testing.assert_close(fusion(x, skip, (8, 10)), published)


def test_places_are_those_of_the_image() -> None:
    """The embedding of a cell is (sin, cos) of x and then of y at its centre, over half the diagonal."""
    height, width, h, w = 56, 84, 4, 6
    table = 10 * with_places(torch.zeros(1, 8, h, w), (height, width))[0]
    row, column = 3, 1
    unit = 0.5 * math.hypot(height, width)
    x = ((column + 0.5) * width / w - width / 2) / unit
    y = ((row + 0.5) * height / h - height / 2) / unit
    expected = [f(v * s) for v in (x, y) for f in (math.sin, math.cos) for s in (1.0, 0.1)]
    torch.testing.assert_close(table[:, row, column], torch.tensor(expected))


def test_rotary_products_depend_on_the_displacement_alone() -> None:
    torch.manual_seed(0)
    q, k = torch.randn(16), torch.randn(16)
    turn = rotary((4, 5), 2, 16, torch.device("cpu"))
    tokens = 2 + 4 * 5
    a, b = (turn(v.expand(1, tokens, 1, 16))[0, :, 0] for v in (q, k))
    scores = (a @ b.T)[2:, 2:].view(4, 5, 4, 5)
    for dy, dx in ((0, 0), (1, 2), (2, 1)):
        same = torch.stack([scores[y, x, y + dy, x + dx] for y in range(2) for x in range(3)])
        torch.testing.assert_close(same, same[0].expand(6))
    assert float((scores[0, 0, 0, 1] - scores[0, 0, 1, 0]).abs()) > 1e-2


def test_rotary_leaves_special_tokens_and_lengths() -> None:
    torch.manual_seed(0)
    x = torch.randn(2, 3 + 6, 4, 16)
    turned = rotary((2, 3), 3, 16, torch.device("cpu"))(x)
    torch.testing.assert_close(turned[:, :3], x[:, :3])
    torch.testing.assert_close(turned.norm(dim=-1), x.norm(dim=-1))
    assert difference(turned[:, 3:], x[:, 3:]) > 0.1


def test_positions_of_the_training_size_are_not_touched(backbone: VGGT) -> None:
    encoder = backbone.network.aggregator.patch_embed
    assert torch.equal(encoder.positions((5, 5)), encoder.pos_embed[:, 1:])


def test_positions_that_are_constant_or_linear_stay_so(backbone: VGGT) -> None:
    encoder = tiny_vggt().network.aggregator.patch_embed
    y, x = torch.meshgrid(torch.arange(5.0) + 0.5, torch.arange(5.0) + 0.5, indexing="ij")
    with torch.no_grad():
        encoder.pos_embed.zero_()
        encoder.pos_embed[0, 1:, 0] = 3
        encoder.pos_embed[0, 1:, 1] = x.flatten()
        encoder.pos_embed[0, 1:, 2] = y.flatten()
        grown = encoder.positions((10, 15)).unflatten(1, (10, 15))[0]
    torch.testing.assert_close(grown[..., 0], torch.full((10, 15), 3.0))
    middle = slice(4, -4)  # away from the border, where the kernel is cut off
    torch.testing.assert_close(grown[middle, 7, 2], ((torch.arange(10.0) + 0.5) / 2)[middle])
    torch.testing.assert_close(grown[5, 6:-6, 1], ((torch.arange(15.0) + 0.5) / 3)[6:-6])
