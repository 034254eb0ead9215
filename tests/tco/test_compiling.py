"""A compiled network is the network, with adapters and without."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from tco.backbones.compiling import compiled
from tco.lora import LoRAConfig, adapted
from tco.types import Priors
from tests.tco.published import some_views, sum_of, tiny_da3, tiny_pi3, tiny_vggt


@pytest.fixture(autouse=True)
def nothing_compiled() -> Iterator[None]:
    """Neither code nor settings of other tests, nor for them."""
    config = torch._dynamo.config
    before = config.skip_nnmodule_hook_guards
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()
    config.skip_nnmodule_hook_guards = before


def answers(backbone: Any) -> list[Tensor]:
    """Depths without adapters, with them, and without again; gradients of the adapters between."""
    encoded = backbone.encode(some_views(), Priors())

    @torch.no_grad()
    def depth() -> Tensor:
        return backbone.decode(encoded).depth

    found = [depth()]
    with adapted(backbone.decoder(), LoRAConfig()) as parameters:
        with torch.no_grad():
            for p in parameters:
                p.add_(0.02)
        found.append(depth())
        sum_of(backbone, encoded).backward()
        found += [p.grad.clone() for p in parameters if p.grad is not None]
        with torch.no_grad():
            for p in parameters:
                p.add_(0.01)
        found.append(depth())
    return [*found, depth()]


@pytest.mark.parametrize("tiny", [tiny_vggt, tiny_pi3, pytest.param(tiny_da3, marks=pytest.mark.slow)])
def test_adapters_are_seen_by_what_was_compiled_before_them(tiny: Callable[[], Any]) -> None:
    """The first prediction is made, and compiled, without gradients and without adapters."""
    calls = []

    def backend(graph: torch.fx.GraphModule, _: object) -> Callable[..., Any]:
        calls.append(graph)
        return graph.forward

    if tiny is tiny_da3:
        pytest.importorskip("depth_anything_3")
    plain, ours = answers(tiny()), answers(compiled(tiny(), backend=backend))
    assert calls
    for a, b in zip(plain, ours, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)
    first, adapted_depth, *_, later, last = ours
    assert torch.equal(first, last)
    assert not torch.allclose(first, adapted_depth, rtol=1e-3)
    assert not torch.allclose(adapted_depth, later, rtol=1e-3)
