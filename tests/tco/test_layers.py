"""Convolutions of the embedded network that are computed in a way of their own are convolutions."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tco.backbones.layers import Conv3d, ScoreConv3d
from tco.lora import LoRAConfig, adapted

MADE: dict[str, Callable[[], nn.Conv3d]] = {
    "small": lambda: Conv3d(5, 6, 3, padding=1, bias=False),
    "strided": lambda: Conv3d(5, 6, 3, stride=2, padding=1),
    "dilated": lambda: Conv3d(5, 6, 3, padding=1, dilation=2),
    "score": lambda: ScoreConv3d(5),
}


def plain(layer: nn.Conv3d, x: Tensor) -> Tensor:
    """What the layer should give, by PyTorch in float64."""
    bias = None if layer.bias is None else layer.bias.double()
    return F.conv3d(x.double(), layer.weight.double(), bias, layer.stride, layer.padding, layer.dilation)


@pytest.fixture(params=list(MADE))
def layer(request: pytest.FixtureRequest) -> nn.Conv3d:
    torch.manual_seed(1)
    return MADE[request.param]()


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("batch", [1, 2])
def test_it_is_the_convolution(layer: nn.Conv3d, batch: int, last: bool, recorded: bool) -> None:
    x = torch.randn(batch, 5, 6, 7, 9)
    x = x.contiguous(memory_format=torch.channels_last_3d) if last else x
    with torch.set_grad_enabled(recorded):
        found = layer(x)
    torch.testing.assert_close(found.detach().double(), plain(layer, x).detach(), rtol=1e-5, atol=1e-5)
    assert found.requires_grad == recorded


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_those_of_the_convolution(layer: nn.Conv3d, dtype: torch.dtype) -> None:
    layer = layer.to(dtype)
    x = torch.randn(1, 5, 4, 5, 6, dtype=dtype, requires_grad=True)
    ways = torch.randn_like(layer(x))
    ends = [x, *layer.parameters()]
    found, true = (torch.autograd.grad((y * ways).sum(), ends) for y in (layer(x), plain(layer, x)))
    for mine, theirs in zip(found, true, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4 if dtype == torch.float32 else 1e-9)


def test_products_are_in_the_type_that_is_asked_for(layer: nn.Conv3d) -> None:
    x = torch.randn(1, 5, 6, 7, 9)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        found = layer(x)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.double(), plain(layer, x), rtol=0.05, atol=0.05)


def test_an_adapter_changes_the_weights_that_are_used(layer: nn.Conv3d) -> None:
    x, changed = torch.randn(1, 5, 6, 7, 9), copy.deepcopy(layer)
    with (
        adapted(nn.Sequential(layer), LoRAConfig(rank=2, alpha=2.0, targets=("0",))) as (a, b),
        torch.no_grad(),
    ):
        b.normal_(generator=torch.Generator().manual_seed(0))
        changed.weight += (b @ a.flatten(1)).reshape(layer.weight.shape)
        found = layer(x)
    torch.testing.assert_close(found.double(), plain(changed, x), rtol=1e-5, atol=1e-5)
    assert not torch.allclose(found.double(), plain(layer, x), atol=1e-3)
