"""Structural similarity of images, with its gradient, quick enough to be taken hundreds of times a run.

Z. Wang et al., Image quality assessment, IEEE TIP 2004: local means, variances and covariance under a
Gaussian window of standard deviation 1.5, of the image reflected at its borders. The windows are filtered by
OpenCV on the CPU, where torch's convolution of single channels takes many times as long
(``benchmarks/ssim.py``), and by kornia elsewhere.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

SIGMA = 1.5
"""Standard deviation of the window in pixels."""
C1, C2 = 0.01**2, 0.03**2
"""Stabilisers for images in [0, 1]."""


def ssim(a: Tensor, b: Tensor, window: int) -> Tensor:
    """Similarity (…, H, W) in [−1, 1] of each pixel and channel of images in [0, 1].

    Args:
        a: (…, H, W), differentiable.
        b: as ``a``, or broadcast to it; what its windows hold is found once for all of ``a``.
        window: side of the Gaussian window in pixels, odd, below 2 H and 2 W.

    Raises:
        ValueError: the window is even, or too large for the images.
    """
    if window % 2 == 0 or window // 2 >= min(a.shape[-2:]):
        size = tuple(a.shape[-2:])
        raise ValueError(
            f"the window must be odd and below twice the sides {size} of the images, not {window}"
        )
    mean_a, mean_b = smooth(a, window), smooth(b, window)
    both = mean_a * mean_b
    squares = mean_a.square() + mean_b.square()
    covariance = smooth(a * b, window) - both
    variances = smooth(a.square(), window) + smooth(b.square(), window) - squares
    return (2 * both + C1) * (2 * covariance + C2) / ((squares + C1) * (variances + C2))


def smooth(x: Tensor, window: int) -> Tensor:
    """Mean (…, H, W) under a Gaussian window, of the image reflected about its outermost pixels."""
    planes = x.reshape(-1, *x.shape[-2:])
    if x.device.type == "cpu" and x.dtype in (torch.float32, torch.float64):
        smoothed = _Smooth.apply(planes, window)
    else:
        from kornia.filters import gaussian_blur2d

        smoothed = gaussian_blur2d(planes.unsqueeze(0), window, (SIGMA, SIGMA)).squeeze(0)
    return smoothed.reshape(x.shape)


class _Smooth(torch.autograd.Function):
    """Gaussian filter of planes (N, H, W) by OpenCV; the transpose is the same, its border folded back."""

    @staticmethod
    def forward(ctx: Any, planes: Tensor, window: int) -> Tensor:
        ctx.window = window
        return _each(planes.detach(), window, cv2.BORDER_REFLECT_101)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        # The filter reads pixels i and −i of the reflected image, which are one: their gradients add.
        p = ctx.window // 2
        spread = _each(torch.nn.functional.pad(grad, (p, p, p, p)), ctx.window, cv2.BORDER_CONSTANT)
        return _fold(_fold(spread, p).mT, p).mT, None


def _each(planes: Tensor, window: int, border: int) -> Tensor:
    """Each plane filtered on its own."""
    source = planes.contiguous().numpy()
    target = np.empty_like(source)
    for plane, out in zip(source, target, strict=True):
        cv2.GaussianBlur(plane, (window, window), SIGMA, dst=out, sigmaY=SIGMA, borderType=border)
    return torch.from_numpy(target)


def _fold(spread: Tensor, p: int) -> Tensor:
    """Rows of planes (N, H + 2 p, W) that were reflected, added to the rows they are copies of."""
    inner = spread[:, p:-p].clone()
    inner[:, 1 : p + 1] += spread[:, :p].flip(1)
    inner[:, -p - 1 : -1] += spread[:, -p:].flip(1)
    return inner
