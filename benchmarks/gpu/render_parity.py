"""The renderers of a GPU against those of the CPU: pictures, derivatives, seconds.

    python -m benchmarks.gpu.render_parity [--device cuda] [--size 240 320] [--views 7]

``gsplat`` (``rasterization_2dgs``; ``pip install gsplat`` compiles it on its first use, which needs nvcc)
composites as published, and is compared with the engine ``cpu``; ``surface_pairs``, tensor operations on
the device, is compared with the compiled loops of ``surface``. Differences are norms relative to those of
the CPU's. What cannot run says why.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from benchmarks.render import scene
from tco.render import render
from tco.surfels import from_depth
from tco.types import Cameras

PAIRS = (("gsplat", "cpu"), ("surface_pairs", "surface"))
"""Engines on the device, and those on the CPU that they are compared with."""
PARTS = ("colour", "depth", "alpha", "d depth", "d confidence", "d image", "d pose")


def pictures_and_derivatives(
    engine: str, device: torch.device, size: tuple[int, int], views: int
) -> tuple[list[Tensor], float]:
    """Colour, depth and alpha, and derivatives of a fixed mixture of them; seconds forward and back."""
    depth, confidence, image, cameras = scene(*size, views)
    leaves = [
        t.to(device).requires_grad_(True) for t in (depth, confidence, image, cameras.world_from_cam.clone())
    ]
    K, g = cameras.K.to(device), torch.Generator().manual_seed(1)
    noise = [torch.randn(views, *size, 3, generator=g), *torch.randn(2, views, *size, generator=g)]

    def once() -> list[Tensor]:
        depth, confidence, image, pose = leaves
        middle = views // 2
        surfels = from_depth(depth, K[middle], pose[middle].detach(), image, confidence)
        rendered = render(surfels, Cameras(pose, K), size, engine)
        parts = [rendered.color, rendered.depth * rendered.alpha, rendered.alpha]
        loss = torch.stack([(p * n.to(device)).sum() for p, n in zip(parts, noise, strict=True)]).sum()
        return [*(p.detach() for p in parts), *torch.autograd.grad(loss, leaves)]

    once()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    start = time.perf_counter()
    found = [t.cpu().double() for t in once()]
    return found, time.perf_counter() - start


def row(engine: str, definition: str, device: torch.device, size: tuple[int, int], views: int) -> str:
    """A line of the table: relative differences, and seconds of both."""
    label = f"| {engine} | {definition} |"
    try:
        ours, seconds = pictures_and_derivatives(engine, device, size, views)
    except RuntimeError as error:
        return f"{label} {str(error).splitlines()[0]} |" + " |" * (len(PARTS) + 1)
    theirs, slower = pictures_and_derivatives(definition, torch.device("cpu"), size, views)
    cells = [f"{float((a - b).norm() / b.norm()):.1e}" for a, b in zip(ours, theirs, strict=True)]
    return f"{label} " + " | ".join([*cells, f"{seconds:.3f}", f"{slower:.3f}"]) + " |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--size", type=int, nargs=2, default=(240, 320), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--views", type=int, default=7)
    options = parser.parse_args(arguments)
    device, (height, width) = torch.device(options.device), options.size
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    out = sys.stdout
    out.write(f"{name}, {height * width} surfels into {options.views} views of {width}×{height}\n\n")
    header = ["engine", "compared with", *PARTS, "s", "s of the CPU's"]
    out.write(f"| {' | '.join(header)} |\n" + "|---" * len(header) + "|\n")
    for engine, definition in PAIRS:
        out.write(row(engine, definition, device, (height, width), options.views) + "\n")
        out.flush()


if __name__ == "__main__":
    main()
