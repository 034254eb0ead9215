"""Seconds of structural similarity and its gradient: ours, filtered by OpenCV, against kornia's.

``python -m benchmarks.ssim [--size 192 256] [--targets 4]`` prints CPU seconds of both, on one thread, and
how far apart their values and gradients are. One comparison is what polishing makes of a source.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch
from kornia.metrics import ssim as kornias
from torch import Tensor

from tco.ssim import ssim

REPEATS = 20


def timed(work: Callable[[], Tensor], image: Tensor) -> tuple[float, Tensor, Tensor]:
    """CPU seconds of a comparison with its gradient, its value and its gradient; the first is not counted."""
    (grad,) = torch.autograd.grad(work().mean(), image)
    start = time.process_time()
    for _ in range(REPEATS):
        torch.autograd.grad(work().mean(), image)
    return (time.process_time() - start) / REPEATS, work().detach(), grad


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=int, nargs=2, default=(192, 256), metavar=("H", "W"))
    parser.add_argument("--targets", type=int, default=4)
    parser.add_argument("--window", type=int, default=7)
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    shown, image = torch.rand(args.targets, 3, *args.size, requires_grad=True), torch.rand(1, 3, *args.size)
    every = image.expand_as(shown).contiguous()
    theirs = timed(lambda: kornias(shown, every, args.window), shown)
    ours = timed(lambda: ssim(shown, image, args.window), shown)
    pairs = zip(ours[1:], theirs[1:], strict=True)
    value, grad = (float((a - b).abs().max() / b.abs().max()) for a, b in pairs)
    print(f"kornia {theirs[0]:.4f} s, ours {ours[0]:.4f} s: ratio {ours[0] / theirs[0]:.2f}")
    print(f"largest difference, relative to the largest: value {value:.1e}, gradient {grad:.1e}")


if __name__ == "__main__":
    main()
