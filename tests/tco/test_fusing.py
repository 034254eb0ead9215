"""Correlations of several sources fused: a softmax by hand, loops and torch alike, what nobody sees."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch
from torch import Tensor, nn

from tco.backbones._fuse_kernels import CELLS
from tco.backbones.fusing import MOST, Fusing

GROUPS, CHANNELS, SOURCES = 5, 7, 3


def layers(scale: float = 1.0) -> nn.Sequential:
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(GROUPS + 2, 11), nn.ReLU(), nn.Linear(11, CHANNELS + 1))
    with torch.no_grad():
        net[2].weight[-1] *= scale
    return net


def said(cells: tuple[int, ...], sources: int = SOURCES) -> list[tuple[Tensor, Tensor]]:
    """Correlations, 0 where not seen, of random cells, of which a third is seen by each source."""
    generator = torch.Generator().manual_seed(1)
    seen = (torch.rand(sources, *cells, generator=generator) < 1 / 3).float()
    correlations = torch.randn(sources, *cells, GROUPS, generator=generator) * seen.unsqueeze(-1)
    return list(zip(correlations, seen, strict=True))


def fused(net: nn.Sequential, parts: list[tuple[Tensor, Tensor]], loops: bool) -> Tensor:
    """In compiled loops, which are taken where no gradients are recorded, or by torch."""
    fusing = Fusing(net, lambda _: nullcontext())
    with torch.set_grad_enabled(not loops):
        for part in parts:
            fusing.add(*part)
        return fusing.result().detach()


@pytest.mark.parametrize("cells", [(1,), (CELLS - 1,), (CELLS + 1,), (2, 3, 7, 50)])
@pytest.mark.parametrize("scale", [1.0, 100.0], ids=["free", "bounded"])
@pytest.mark.parametrize("threads", [1, 3])
def test_loops_are_what_torch_says(cells: tuple[int, ...], scale: float, threads: int) -> None:
    net, parts, whole = layers(scale), said(cells), torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        loops = fused(net, parts, True)
    finally:
        torch.set_num_threads(whole)
    torch.testing.assert_close(loops, fused(net, parts, False), rtol=1e-5, atol=1e-5)
    assert loops.shape == (*cells, CHANNELS)


@pytest.mark.parametrize("loops", [True, False])
def test_it_is_a_softmax_over_the_sources_that_see_a_cell(loops: bool) -> None:
    """In float64 and all sources at once, the mean of their channels by e to the power of what they weigh."""
    net, parts = layers(), said((40,))
    correlations, seen = (torch.stack(x).double() for x in zip(*parts, strict=True))
    with torch.no_grad():
        out = layers().double()(
            torch.cat([correlations, seen.unsqueeze(-1), correlations.mean(-1, keepdim=True)], -1)
        )
    assert float(out[..., -1].abs().max()) < MOST
    share = out[..., -1].masked_fill(seen == 0, -torch.inf).softmax(0).nan_to_num()
    expected = (share.unsqueeze(-1) * out[..., :-1]).sum(0)
    found = fused(net, parts, loops)
    torch.testing.assert_close(found, expected.float(), rtol=1e-4, atol=1e-5)
    nobody = seen.sum(0) == 0
    assert nobody.any() and not nobody.all() and not found[nobody].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["loops", "torch"])
def test_the_result_is_made_where_it_is_wanted(dtype: torch.dtype) -> None:
    net, parts = layers().to(dtype), [(a.to(dtype), b.to(dtype)) for a, b in said((4, 30))]
    whole = torch.full((2, 4, 30, CHANNELS), torch.nan, dtype=dtype)
    fusing = Fusing(net, lambda _: nullcontext(), whole[1])
    with torch.no_grad():
        for part in parts:
            fusing.add(*part)
        result = fusing.result()
    assert result.data_ptr() == whole[1].data_ptr() and bool(whole[0].isnan().all())
    torch.testing.assert_close(whole[1].float(), fused(layers(), said((4, 30)), False), rtol=1e-5, atol=1e-5)


def test_a_place_whose_rows_do_not_follow_one_another_is_refused() -> None:
    """Loops would write into a copy of it."""
    into = torch.zeros(5, CHANNELS, 6).transpose(1, 2)
    with torch.no_grad(), pytest.raises(RuntimeError, match="view"):
        Fusing(layers(), lambda _: nullcontext(), into).add(*said((5, 6))[0])


@pytest.mark.parametrize("loops", [True, False])
def test_the_order_of_sources_is_of_no_account(loops: bool) -> None:
    parts = said((300,))
    torch.testing.assert_close(fused(layers(), parts, loops), fused(layers(), parts[::-1], loops))


def test_gradients_flow_to_layers_and_correlations() -> None:
    """Against finite differences, in float64."""
    net, parts = layers().double(), said((6,))
    seen = [s.double() for _, s in parts]

    def result(*correlations: Tensor) -> Tensor:
        fusing = Fusing(net, lambda _: nullcontext())
        for c, s in zip(correlations, seen, strict=True):
            fusing.add(c * s.unsqueeze(-1), s)
        return fusing.result()

    inputs = [c.double().requires_grad_() for c, _ in parts]
    assert torch.autograd.gradcheck(result, inputs)
    weight, sums = net[0].weight, list[float]()
    result(*inputs).sum().backward()
    with torch.no_grad():
        for step in (1e-6, -2e-6):
            weight[2, 1] += step
            sums.append(float(result(*inputs).sum()))
    assert weight.grad is not None
    assert float(weight.grad[2, 1]) == pytest.approx((sums[0] - sums[1]) / 2e-6, rel=1e-5)


def test_nothing_added_cannot_be_fused() -> None:
    with pytest.raises(ValueError, match="nothing was added"):
        Fusing(layers(), lambda _: nullcontext()).result()
