"""Published networks for the tests: tiny ones with random weights, and the reference numbers of full ones."""

from __future__ import annotations

import importlib.util
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tco.backbones.base import Backbone
from tco.backbones.da3 import DA3, DA3Config, DA3Network
from tco.backbones.dinov2 import Patches, ViTConfig
from tco.backbones.pi3 import Pi3, Pi3Config, Pi3Network
from tco.backbones.vggt import VGGT, VGGTConfig, VGGTNetwork
from tco.lora import LoRAConfig, adapted
from tco.types import Priors, Views

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "parity"
TOLERANCE = 1e-4

TINY_ENCODER = ViTConfig(channels=32, depth=2, heads=2, registers=2, side=5)
TINY_VGGT = VGGTConfig(
    TINY_ENCODER, 32, 4, 2, registers=2, camera_depth=1, camera_heads=2, features=8, levels=(8, 8, 16, 16),
    layers=(0, 1, 2, 3),
)  # fmt: skip
TINY_DA3 = DA3Config(48, 8, 2, 2, (3, 5, 6, 7), 8, (8, 8, 8, 8), side=4)
TINY_PI3 = Pi3Config(
    replace(TINY_ENCODER, mask_token=False), 32, 4, 2, registers=2, hidden=32, head_depth=1, head_heads=2,
    pose=16,
)  # fmt: skip

_Network = TypeVar("_Network", bound=nn.Module)


@dataclass(frozen=True)
class Reference:
    """Reference numbers of one network.

    Attributes:
        salt: of the rule of its weights.
        images: (V, 3, H, W) that it was run on.
        shapes: of its state dict.
        arrays: what came out.
    """

    salt: int
    images: Tensor
    shapes: dict[str, tuple[int, ...]]
    arrays: dict[str, np.ndarray]


def rule() -> ModuleType:
    """The rule that makes weights from names; skips where it is not there."""
    path = FOLDER / "rule_weights.py"
    if not path.is_file():
        pytest.skip("the reference numbers in ../shared/parity are not there")
    spec = importlib.util.spec_from_file_location("rule_weights", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def reference(name: str) -> Reference:
    """The reference numbers of a name; skips where they are not there."""
    images = rule().rule_images
    table: dict[str, Any] = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    shapes = {key: tuple(shape) for key, shape in table["state_dict"].items()}
    with np.load(FOLDER / f"{name}.npz") as file:
        arrays = dict(file)
    salt = table["salt"]
    return Reference(salt, torch.from_numpy(images(table["views"], *table["size_hw"], salt)), shapes, arrays)


def by_rule(build: Callable[[], _Network], salt: int) -> _Network:
    """A network with weights by the rule; constant buffers keep their values."""
    array = rule().rule_array
    with torch.device("meta"):
        network = build()
    constants = {"image_mean": (0.485, 0.456, 0.406), "image_std": (0.229, 0.224, 0.225)}
    tensors = {
        name: torch.tensor(constants[name]).view(t.shape)
        if name in constants
        else torch.from_numpy(np.ascontiguousarray(array(name, tuple(t.shape), salt)))
        for name, t in network.state_dict().items()
    }
    network.load_state_dict(tensors, assign=True)
    return network


def views_of(images: Tensor) -> Views:
    """Views that are valid everywhere."""
    valid = torch.ones(len(images), *images.shape[2:], dtype=torch.bool)
    return Views(images, valid, tuple(f"{i}.png" for i in range(len(images))))


def some_views(count: int = 3, size: tuple[int, int] = (42, 56), seed: int = 0) -> Views:
    """Views of noise."""
    return views_of(torch.rand(count, 3, *size, generator=torch.Generator().manual_seed(seed)))


def difference(ours: Tensor, theirs: np.ndarray | Tensor) -> float:
    """‖ours − theirs‖ / ‖theirs‖ in float64."""
    a, b = ours.detach().double(), torch.as_tensor(theirs).detach().double()
    assert a.shape == b.shape
    return float((a - b).norm() / b.norm())


def randomized(network: _Network, seed: int = 0) -> _Network:
    """Weights that let every part of a network be seen in its output: no zeros, no tiny layer scales."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, p in network.named_parameters():
            noise = torch.randn(p.shape, generator=generator)
            if p.ndim > 1:
                p.copy_(0.5 * noise if "token" in name else noise / math.sqrt(p[0].numel()))
            else:
                p.copy_(0.5 + 0.1 * noise if name.endswith(("weight", "gamma")) else 0.1 * noise)
    return network


def tiny_vggt(**options: Any) -> VGGT:
    """A small VGGT with random weights."""
    return VGGT(randomized(VGGTNetwork(TINY_VGGT)), **options).eval().requires_grad_(False)


def tiny_pi3(**options: Any) -> Pi3:
    """A small π³ with random weights."""
    return Pi3(randomized(Pi3Network(TINY_PI3)), **options).eval().requires_grad_(False)


def tiny_da3(**options: Any) -> DA3:
    """A small Depth Anything 3 with random weights, whose fields of view are positive."""
    network = randomized(DA3Network(TINY_DA3))
    torch.nn.init.constant_(network.get_parameter("model.cam_dec.fc_fov.0.bias"), 1.0)
    return DA3(network, **options).eval().requires_grad_(False)


def check_subset(backbone: Backbone, chosen: Sequence[int]) -> None:
    """Decoding some views gives their maps as decoding all does, in the order asked for."""
    with torch.no_grad():
        encoded = backbone.encode(some_views(4), Priors())
        full, part = backbone.decode(encoded), backbone.decode(encoded, chosen)
    assert part.views == tuple(chosen)
    assert full.views == (0, 1, 2, 3)
    torch.testing.assert_close(part.depth, full.depth[list(chosen)], rtol=1e-4, atol=0)
    torch.testing.assert_close(part.confidence, full.confidence[list(chosen)], rtol=1e-4, atol=0)
    torch.testing.assert_close(part.cameras.K, full.cameras.K, rtol=1e-4, atol=0)
    torch.testing.assert_close(part.cameras.world_from_cam, full.cameras.world_from_cam, rtol=1e-4, atol=1e-5)


def check_any_size(backbone: Backbone, count: int, size: tuple[int, int]) -> None:
    """Any number of views, of any size divisible by 14, gives maps of that size and proper cameras."""
    with torch.no_grad():
        prediction = backbone.decode(backbone.encode(some_views(count, size), Priors()))
    assert prediction.depth.shape == prediction.confidence.shape == (count, *size)
    assert bool((prediction.depth > 0).all()) and bool((prediction.confidence > 1).all())
    assert all(bool(torch.isfinite(t).all()) for t in (prediction.depth, prediction.confidence))
    K, pose = prediction.cameras.K, prediction.cameras.world_from_cam
    assert K.shape == (count, 3, 3) and pose.shape == (count, 4, 4)
    assert torch.equal(K[:, :2, 2], torch.tensor([[0.5 * size[1], 0.5 * size[0]]]).expand(count, 2))
    assert bool((K[:, 0, 0] > 0).all()) and bool((K[:, 1, 1] > 0).all())
    R = pose[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand(count, 3, 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(count))


def sum_of(backbone: Backbone, encoded: Patches, cameras: bool = True) -> Tensor:
    """A scalar that the prediction of view 1 and, by choice, the cameras of all views go into."""
    p = backbone.decode(encoded, [1])
    parts = [p.depth.log(), p.confidence.log()]
    if cameras:
        parts += [p.cameras.world_from_cam, p.cameras.K[1] / 100]
    weighted = [(part * torch.linspace(-1, 2, part.numel()).view(part.shape)).mean() for part in parts]
    return torch.stack(weighted).sum()


def check_gradients(backbone: Any, cameras: bool) -> None:
    """Adapters on the decoder: every one has a gradient, and along a line it is that of finite differences.

    ``cameras``: whether those are part of it; a head that feeds its output back without gradients, as
    VGGT's does, has none that finite differences could confirm.
    """
    backbone.network.double()
    encoded = backbone.encode(views_of(some_views().images.double()), Priors())
    assert not encoded.tokens.requires_grad
    with adapted(backbone.decoder(), LoRAConfig(targets=("qkv", "proj", "fc1", "fc2"))) as parameters:
        generator = torch.Generator().manual_seed(1)
        directions = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in parameters]
        with torch.no_grad():
            for p, d in zip(parameters, directions, strict=True):
                p.add_(0.02 * d)
        sum_of(backbone, encoded, cameras).backward()
        assert all(p.grad is not None and bool(p.grad.any()) for p in parameters)
        slope = sum(float((p.grad * d).sum()) for p, d in zip(parameters, directions, strict=True))
        values, step = [], 1e-6
        for sign in (1, -2):
            with torch.no_grad():
                for p, d in zip(parameters, directions, strict=True):
                    p.add_(sign * step * d)
                values.append(float(sum_of(backbone, encoded, cameras)))
    assert slope == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-4)


def check_recomputing(plain: Any, recomputing: Any) -> None:
    """What is computed again in the backward pass gives the same gradients."""
    found = []
    for backbone in (plain, recomputing):
        with adapted(backbone.decoder(), LoRAConfig()) as parameters:
            sum_of(backbone, backbone.encode(some_views(), Priors())).backward()
            found.append([p.grad.clone() for p in parameters if p.grad is not None])
    assert len(found[0]) == len(found[1]) > 0
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b)


def check_bfloat16(plain: Backbone, half: Backbone) -> None:
    """Products in bfloat16 change the depth by no more than their rounding, and the heads are float32."""
    with torch.no_grad():
        a, b = (x.decode(x.encode(some_views(), Priors())) for x in (plain, half))
    assert b.depth.dtype is b.confidence.dtype is b.cameras.K.dtype is torch.float32
    assert 1e-5 < difference(b.depth.log(), a.depth.log()) < 0.05
