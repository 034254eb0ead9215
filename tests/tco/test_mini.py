"""The small VGGT: sizes, weights that come and go, a start that can learn, scenes side by side."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tco.backbones import mini
from tco.backbones.base import Backbone
from tco.backbones.checkpoints import save
from tco.backbones.dinov2 import ViTConfig
from tco.backbones.identify import identify
from tco.backbones.mini import MINI, Mini, fresh, load, write
from tco.backbones.vggt import VGGTConfig, VGGTNetwork
from tco.backbones.vggt_heads import cam_from_world, cameras, encoded
from tco.backbones.weights import WeightsError
from tco.geometry import rigid, so3_exp
from tco.types import Cameras, Priors
from tests.tco.published import (
    TINY_VGGT,
    check_any_size,
    check_gradients,
    check_subset,
    randomized,
    some_views,
    tiny_vggt,
)

TINY = VGGTConfig(
    ViTConfig(32, 0, 2, registers=1, side=4, mask_token=False, patch=8), 32, 4, 2, registers=2,
    camera_depth=1, camera_heads=2, features=8, levels=(8, 8, 8, 8), layers=(0, 1, 2, 3), points=False,
)  # fmt: skip


def tiny() -> Mini:
    return Mini(randomized(VGGTNetwork(TINY))).eval().requires_grad_(False)


def test_it_is_a_backbone_of_stride_eight() -> None:
    backbone = tiny()
    assert isinstance(backbone, Backbone)
    assert (backbone.name, backbone.stride, backbone.uses_cameras) == ("mini", 8, False)
    check_any_size(backbone, 3, (24, 40))
    with pytest.raises(ValueError, match=r"42×28.*divisible by 8"):
        backbone.encode(some_views(2, (28, 42)), Priors())
    with pytest.raises(ValueError, match="mini has no head for points"):
        backbone.points(backbone.encode(some_views(2, (24, 40)), Priors()), [0])


def test_some_views_are_decoded_as_all_are_and_adapters_have_gradients(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    views = some_views(4, (24, 40))
    monkeypatch.setattr("tests.tco.published.some_views", lambda count=3, *_: some_views(count, views.size))
    check_subset(tiny(), [2, 0])
    check_gradients(tiny(), cameras=False)


def test_the_file_of_weights_is_small(tmp_path: Path) -> None:
    """Sixteen mebibytes: half of what the parameters take, and the names."""
    with torch.device("meta"):
        count = sum(p.numel() for p in VGGTNetwork(MINI).parameters())
    assert 8e6 < count < 2**23
    path = tmp_path / "w.safetensors"
    write(path, randomized(VGGTNetwork(TINY)))
    small = sum(p.numel() for p in VGGTNetwork(TINY).parameters())
    assert 2 * small < path.stat().st_size < 2 * small + 40_000 and 2 * count + 40_000 < 2**24


def test_weights_come_back_up_to_half_precision(tmp_path: Path) -> None:
    path, backbone = tmp_path / "w.safetensors", tiny()
    write(path, backbone.network)
    assert identify(path).network == "mini"
    back = load(path, dtype=torch.float32)
    assert back.network.config == TINY and not any(p.requires_grad for p in back.parameters())
    for name, tensor in backbone.network.state_dict().items():
        loaded = back.network.state_dict()[name]
        assert loaded.dtype is torch.float32
        torch.testing.assert_close(loaded, tensor, rtol=2**-11, atol=2**-24)
    views = some_views(3, (24, 40))
    with torch.no_grad():
        a, b = (x.decode(x.encode(views, Priors())) for x in (backbone, back))
    torch.testing.assert_close(b.depth, a.depth, rtol=0.02, atol=0)


def test_a_weight_that_half_precision_cannot_hold_is_an_error(tmp_path: Path) -> None:
    network = fresh(TINY)
    with torch.no_grad():
        network.aggregator.camera_token[0, 0, 0, 3] = 1e5
    with pytest.raises(ValueError, match=r"aggregator\.camera_token"):
        write(tmp_path / "w.safetensors", network)


def test_weights_of_a_published_vggt_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    save(path, tiny_vggt().network, TINY_VGGT)
    assert identify(path).network == "vggt"
    with pytest.raises(WeightsError, match="--backbone vggt takes those"):
        load(path)


def test_a_fresh_network_is_of_its_seed_and_leaves_the_generator_alone() -> None:
    torch.manual_seed(5)
    before = torch.get_rng_state()
    a, b, other = (fresh(TINY, seed).state_dict() for seed in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(a[k], b[k]) for k in a)
    assert not torch.equal(a["aggregator.camera_token"], other["aggregator.camera_token"])


def test_every_parameter_of_a_fresh_network_that_is_used_can_learn() -> None:
    """Tokens differ, so that no two learn alike, and each has a gradient from depth and poses."""
    network = fresh(TINY)
    tokens = torch.cat([network.aggregator.camera_token, network.aggregator.register_token], 2)[0].detach()
    assert float(torch.pdist(tokens.flatten(0, 1)).min()) > 0.01
    views = some_views(3, (24, 40))
    found = network.aggregator(network.aggregator.patch_embed(views.images, (3, 5)), (3, 5), range(3))
    poses = network.camera_head(found.camera)
    maps = network.depth_head(found.dense, (3, 5))
    (sum(p.square().sum() for p in poses) + maps.square().sum()).backward()
    encoder = "aggregator.patch_embed."
    unused = {encoder + "cls_token", encoder + "register_tokens"}  # with no blocks, they reach nothing
    still = {n for n, p in network.named_parameters() if p.grad is None or not bool(p.grad.any())}
    assert still == unused


def test_the_first_prediction_is_plain() -> None:
    backbone = Mini(fresh(TINY)).eval()
    with torch.no_grad():
        p = backbone.decode(backbone.encode(some_views(3, (24, 40)), Priors()))
    assert float((p.depth - 1).abs().max()) < 0.5 and float((p.confidence - 2).abs().max()) < 0.5
    angle = 2 * torch.atan(20 / p.cameras.K[:, 0, 0])
    assert bool(((angle > 0.5) & (angle < 2.5)).all())


def test_scenes_side_by_side_are_as_each_alone() -> None:
    network = tiny().network
    images = torch.stack([some_views(3, (24, 40), seed).images for seed in (0, 1)])
    with torch.no_grad():
        tokens = network.aggregator.patch_embed(images.flatten(0, 1), (3, 5))
        both = network.aggregator(tokens, (3, 5), range(6), scenes=2)
        poses = network.camera_head(both.camera.unflatten(0, (2, 3)))
        for scene in range(2):
            part = slice(3 * scene, 3 * scene + 3)
            alone = network.aggregator(tokens[part], (3, 5), range(3))
            torch.testing.assert_close(both.last[part], alone.last, rtol=1e-4, atol=1e-4)
            for together, pose in zip(poses, network.camera_head(alone.camera), strict=True):
                torch.testing.assert_close(together[scene], pose, rtol=1e-4, atol=1e-4)


def test_encoding_is_the_inverse_of_decoding() -> None:
    """Cameras, also turned by more than 180° in parts, come back; a quaternion's real part is positive."""
    turn = torch.tensor([[0.1, -0.4, 0.2], [0, 3.1, 0.3], [-2.0, 2.0, 1.0], [0, 0, 0]])
    pose = rigid(so3_exp(turn), torch.tensor([[1.0, 2, 3], [0, -1, 0], [0.1, 0, 0], [0, 0, 0]]))
    K = torch.tensor([[50.0, 0, 20], [0, 40, 12], [0, 0, 1]]).expand(4, 3, 3)
    code = encoded(Cameras(pose, K), (24, 40))
    assert bool((code[:, 6] >= 0).all())
    back = cameras(code, (24, 40))
    torch.testing.assert_close(back.world_from_cam, pose, rtol=0, atol=2e-5)
    torch.testing.assert_close(back.K, K)
    torch.testing.assert_close(
        cam_from_world(code[None])[0] @ pose, torch.eye(4).expand(4, 4, 4), rtol=0, atol=2e-5
    )
    again = encoded(back, (24, 40))
    torch.testing.assert_close(again, code, rtol=0, atol=1e-4)


def test_the_module_names_the_network_as_the_registry_does() -> None:
    from colmap_tco.published import NETWORKS

    network = NETWORKS["mini"]
    assert network.loader == f"{mini.__name__}:{load.__name__}" and network.kind == Mini.name
    assert network.stride == MINI.encoder.patch and network.image_size % network.stride == 0
