"""Adapters: unchanged at the start, the algebra of W + B A inside, nothing left behind."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from tco.lora import LoRAConfig, adapted, matches, select


class Block(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.qkv = nn.Linear(6, 18)
        self.proj = nn.Linear(18, 6, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.proj(torch.tanh(self.qkv(x)))


class Net(nn.Module):
    """A linear block, a batch norm and convolutions in two and three dimensions."""

    def __init__(self) -> None:
        super().__init__()
        self.blocks = nn.ModuleList([Block(), Block()])
        self.bn = nn.BatchNorm1d(6)
        self.conv2 = nn.Conv2d(6, 5, 3, stride=2, padding=1, padding_mode="reflect")
        self.conv3 = nn.Conv3d(1, 4, (3, 1, 3), padding=(1, 0, 1), dilation=(1, 1, 1), stride=(1, 2, 1))
        self.grouped = nn.Conv2d(6, 6, 3, groups=3)
        self.head = nn.Linear(4, 2)

    def forward(self, x: Tensor) -> Tensor:
        for block in self.blocks:
            x = block(x)
        x = self.bn(x.flatten(0, 2)).reshape(x.shape)
        y = self.conv2(x.permute(0, 3, 1, 2))
        return self.head(self.conv3(y.unsqueeze(1)).mean((-1, -2, -3)))


TARGETS = ("qkv", "proj", "conv2", "conv3")


@pytest.fixture
def net() -> Net:
    torch.manual_seed(0)
    return Net().double()


@pytest.fixture
def x() -> Tensor:
    return torch.randn(2, 8, 9, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


Snapshot = tuple[dict[str, Tensor], list[bool], list[bool]]


def snapshot(net: nn.Module) -> Snapshot:
    state = {k: v.clone() for k, v in net.state_dict().items()}
    return state, [p.requires_grad for p in net.parameters()], [m.training for m in net.modules()]


def assert_same(before: Snapshot, net: nn.Module) -> None:
    state, flags, modes = before
    after = snapshot(net)
    assert list(after[0]) == list(state)
    assert all(torch.equal(after[0][k], v) for k, v in state.items())
    assert (after[1], after[2]) == (flags, modes)
    assert all(not m._forward_hooks and "_conv_forward" not in vars(m) for m in net.modules())


def test_output_is_unchanged_at_the_start(net: Net, x: Tensor) -> None:
    net.eval()
    reference = net(x)
    with adapted(net, LoRAConfig(targets=TARGETS)) as parameters:
        assert torch.equal(net(x), reference)
        assert len(parameters) == 2 * 6
    assert torch.equal(net(x), reference)


@pytest.mark.parametrize("name", ["blocks.1.qkv", "conv2", "conv3"])
def test_equals_the_layer_with_the_summed_weight(net: Net, name: str) -> None:
    layer = net.get_submodule(name)
    assert isinstance(layer, nn.Linear | nn.Conv2d | nn.Conv3d)
    channels = layer.weight.shape[1]
    x = torch.randn({2: (7, channels), 4: (2, channels, 8, 9), 5: (2, channels, 4, 6, 7)}[layer.weight.dim()])
    x = x.double()
    with adapted(net, LoRAConfig(rank=3, alpha=5.0, targets=(name,))) as (a, b):
        nn.init.normal_(b)
        got = layer(x)
        delta = 5.0 / 3 * (b @ a.flatten(1)).reshape(layer.weight.shape).detach()
    with torch.no_grad():
        layer.weight += delta
    torch.testing.assert_close(got, layer(x))


def test_only_adapters_get_gradients_and_can_learn(net: Net, x: Tensor) -> None:
    target = torch.randn(2, 2, dtype=torch.float64)
    before = snapshot(net)
    with adapted(net, LoRAConfig(targets=TARGETS)) as parameters:
        optimizer = torch.optim.Adam(parameters, lr=1e-2)
        losses = []
        for _ in range(30):
            optimizer.zero_grad()
            loss = ((net(x) - target) ** 2).mean()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
        assert all(p.grad is None for p in net.parameters())
        assert all(p.grad is not None and bool(p.grad.any()) for p in parameters)
    assert losses[-1] < 0.5 * losses[0]
    assert_same(before, net)


def test_restores_after_an_exception_in_a_half_trained_state(net: Net, x: Tensor) -> None:
    net.conv2.eval()
    net.head.weight.requires_grad_(False)
    before = snapshot(net)
    config = LoRAConfig(targets=("qkv",), unfrozen=("head", "bn"))
    with pytest.raises(RuntimeError, match="half way"), adapted(net, config) as parameters:
        net.train()
        net(x).square().sum().backward()
        torch.optim.SGD(parameters, lr=1.0).step()
        assert not torch.equal(net.head.weight, before[0]["head.weight"])
        raise RuntimeError("half way")
    assert_same(before, net)
    assert all(p.grad is None for p in net.parameters())


def test_state_dict_is_the_same_inside(net: Net) -> None:
    names = list(net.state_dict())
    with adapted(net, LoRAConfig(targets=TARGETS)):
        assert list(net.state_dict()) == names


def test_deterministic_by_seed_and_by_generator(net: Net) -> None:
    def draw(seed: int, generator: torch.Generator | None = None) -> list[Tensor]:
        with adapted(net, LoRAConfig(targets=TARGETS, seed=seed), generator) as parameters:
            return [p.detach().clone() for p in parameters]

    first, again, other = draw(3), draw(3), draw(4)
    given = draw(4, torch.Generator().manual_seed(3))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(first, given, strict=True))
    assert not torch.equal(first[0], other[0])


@pytest.mark.parametrize("name", ["head", "conv3"])
def test_nested_adapters_add(net: Net, x: Tensor, name: str) -> None:
    net.eval()
    plain = net(x)
    config = LoRAConfig(targets=(name,))
    with adapted(net, config) as (_, b1):
        nn.init.ones_(b1)
        once = net(x)
        with adapted(net, config) as (_, b2):
            nn.init.ones_(b2)
            twice = net(x)
        assert torch.equal(net(x), once)
    assert torch.equal(net(x), plain)
    assert not torch.equal(once, plain)
    torch.testing.assert_close(twice - plain, 2 * (once - plain))


def test_half_precision_layers_get_float32_adapters(x: Tensor) -> None:
    layer = nn.Sequential(nn.Linear(6, 4)).to(torch.bfloat16)
    with adapted(layer, LoRAConfig(targets=("0",))) as parameters:
        assert {p.dtype for p in parameters} == {torch.float32}
        assert layer(x.to(torch.bfloat16)).dtype == torch.bfloat16


@pytest.mark.parametrize(
    ("name", "pattern", "expected"),
    [
        ("blocks.3.attn.qkv", "qkv", True),
        ("blocks.3.attn.qkv", "attn.qkv", True),
        ("blocks.3.attn.qkv", "blocks.[0-2].*", False),
        ("blocks.3.attn.qkv", "blocks.[3-5].*", True),
        ("blocks.3.attn.qkv_norm", "qkv", False),
        ("blocks.3.myproj", "proj", False),
        ("proj", "proj", True),
    ],
)
def test_patterns(name: str, pattern: str, expected: bool) -> None:
    assert matches(name, pattern) is expected


def test_selection_keeps_the_order_of_the_module(net: Net) -> None:
    assert list(select(net, ("proj", "qkv"))) == [f"blocks.{i}.{n}" for i in (0, 1) for n in ("qkv", "proj")]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (LoRAConfig(targets=("qkv", "fc9")), "'fc9' fits no Linear"),
        (LoRAConfig(targets=("bn",)), "'bn' fits no Linear"),
        (LoRAConfig(targets=("grouped",)), "3 groups"),
        (LoRAConfig(targets=("qkv",), unfrozen=("nothing",)), "'nothing' fits no parameters"),
    ],
)
def test_what_cannot_be_adapted_is_an_error(net: Net, config: LoRAConfig, message: str) -> None:
    before = snapshot(net)
    with pytest.raises(ValueError, match=message), adapted(net, config):
        pass
    assert_same(before, net)


def test_layers_that_are_read_but_never_called_are_refused() -> None:
    with (
        pytest.raises(ValueError, match="never called"),
        adapted(nn.MultiheadAttention(8, 2), LoRAConfig(targets=("out_proj",))),
    ):
        pass


def test_rank_must_be_positive() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        LoRAConfig(rank=0)
