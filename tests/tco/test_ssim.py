"""Structural similarity: against kornia's, its gradient, and what follows from its definition."""

from __future__ import annotations

import pytest
import torch
from kornia.metrics import ssim as kornias

from tco.ssim import smooth, ssim


def pictures(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("window", [3, 7, 11])
def test_it_is_kornias_value_and_gradient(window: int) -> None:
    a, b = pictures(2, 3, 17, 22).requires_grad_(), pictures(1, 3, 17, 22, seed=1)
    ours, theirs = ssim(a, b, window), kornias(a, b.expand_as(a), window)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)
    weight = pictures(2, 3, 17, 22, seed=2)
    mine, reference = (torch.autograd.grad((weight * x).sum(), a)[0] for x in (ours, theirs))
    torch.testing.assert_close(mine, reference, rtol=0, atol=1e-8 * float(reference.abs().max()))


def test_its_gradients_are_those_of_finite_differences() -> None:
    a, b = (pictures(2, 9, 8, seed=s).requires_grad_() for s in (0, 1))
    assert torch.autograd.gradcheck(lambda a, b: ssim(a, b, 7), (a, b))


def test_single_precision_is_close_to_double() -> None:
    a, b = pictures(3, 30, 40), pictures(3, 30, 40, seed=1)
    torch.testing.assert_close(ssim(a.float(), b.float(), 7).double(), ssim(a, b, 7), rtol=0, atol=2e-4)


def test_an_image_is_like_itself_and_unlike_its_negative() -> None:
    a = pictures(1, 20, 20)
    torch.testing.assert_close(ssim(a, a, 7), torch.ones_like(a))
    assert float(ssim(a, 1 - a, 7).max()) < 0
    torch.testing.assert_close(ssim(a, 1 - a, 7), ssim(1 - a, a, 7))


def test_the_filter_keeps_constants_and_the_gradients_sum() -> None:
    x = torch.full((2, 12, 9), 0.3, dtype=torch.float64, requires_grad=True)
    smoothed = smooth(x, 7)
    torch.testing.assert_close(smoothed, x)
    grad = pictures(2, 12, 9)
    smoothed.backward(grad)
    assert x.grad is not None
    torch.testing.assert_close(x.grad.sum(), grad.sum())


@pytest.mark.parametrize(("window", "size"), [(6, 20), (11, 5)])
def test_windows_that_do_not_fit_are_refused(window: int, size: int) -> None:
    with pytest.raises(ValueError, match=f"not {window}"):
        ssim(torch.zeros(size, size), torch.zeros(size, size), window)
