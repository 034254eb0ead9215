"""Bytes counted from shapes are those that the same operations take in earnest."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from benchmarks import counting
from benchmarks.counting import Alive, count, tensors
from tco.backbones.pi3 import Pi3, Pi3Network
from tco.backbones.vggt import VGGT, VGGTNetwork
from tests.tco.published import TINY_PI3, TINY_VGGT


def test_storages_count_from_their_making_until_they_are_freed() -> None:
    layer = nn.Linear(10, 10).requires_grad_(False)
    x = torch.zeros(7, 10)
    with Alive(layer) as alive:
        a = torch.zeros(100)
        b = a[:50]  # shares the storage
        assert alive.now == alive.most == 400
        del a
        assert alive.now == 400
        del b
        assert alive.now == 0
        y = layer(x)
        assert y.shape == (7, 10)
        del y
        layer.weight.view(-1)  # the network's own
    assert alive.now == 0 and alive.most >= 400


@pytest.mark.parametrize("name", ["vggt", "pi3"])
def test_counting_without_content_gives_what_running_gives(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny = {"vggt": (VGGTNetwork, TINY_VGGT, VGGT), "pi3": (Pi3Network, TINY_PI3, Pi3)}[name]
    monkeypatch.setitem(counting.NETWORKS, name, tiny)
    size = (3, 56, 42)
    without = count(name, torch.float32, size)
    monkeypatch.setattr(counting, "IN_EARNEST", (name,))
    running = count(name, torch.float32, size)
    assert without.weights == running.weights
    assert without.weights == sum(4 * t.numel() for t in tensors(counting.random(name, torch.float32)))
    assert without.forward == pytest.approx(running.forward, rel=0.05)
    assert without.optimised == pytest.approx(running.optimised, rel=0.05)
    assert without.recomputed == pytest.approx(running.recomputed, rel=0.05)
    assert without.recomputed < without.optimised
    larger = count(name, torch.float32, (6, 56, 42))
    assert running.forward < larger.forward and running.optimised < larger.optimised < 3 * running.optimised


def test_types_are_those_of_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """In bfloat16 CUDA keeps less for attention and more for norms; in float32 all is alike.

    Wide enough that the activations of the blocks are most of what is kept.
    """
    wide = replace(TINY_VGGT, channels=128, encoder=replace(TINY_VGGT.encoder, channels=128))
    monkeypatch.setitem(counting.NETWORKS, "vggt", (VGGTNetwork, wide, VGGT))
    size, plain = (4, 112, 112), torch.nn.functional.layer_norm
    for dtype, same in ((torch.float32, True), (torch.bfloat16, False)):
        cpu, cuda = (count("vggt", dtype, size, device) for device in ("cpu", "cuda"))
        assert (cpu == cuda) is same
        assert cuda.optimised == cpu.optimised if same else cuda.optimised < 0.97 * cpu.optimised
    assert torch.nn.functional.layer_norm is plain
