"""The renderers of a GPU against those of the CPU: pictures, derivatives, seconds.

    python -m benchmarks.gpu.render_parity [--device cuda] [--size 240 320] [--views 7]

``gsplat`` (``rasterization_2dgs``; ``pip install gsplat`` compiles it on its first use, which needs nvcc)
composites as published, and is compared with the engine ``cpu``; ``surface_pairs``, tensor operations on
the device, is compared with the compiled loops of ``surface``. Differences are norms relative to those of
the CPU's; derivatives by poses are those along rotations and translations. No surfel is more opaque than 0.9,
so that the bound of alpha, 0.99 here and 0.999 in gsplat up to 1.5.3, does not matter.

What cannot run says why. The exit code is 1 if a difference is larger than ``BOUNDS`` allow, or if an engine
could not run on a CUDA device.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from benchmarks.render import scene
from tco.geometry import rigid, so3_exp
from tco.render import render
from tco.surfels import from_depth
from tco.types import Cameras

PAIRS = (("gsplat", "cpu"), ("surface_pairs", "surface"))
"""Engines on the device, and those on the CPU that they are compared with."""
BOUNDS = {"gsplat": (2e-3, 2e-2), "surface_pairs": (1e-4, 1e-3)}
"""Largest relative differences of pictures and of derivatives. gsplat's arithmetic is float32 with the
compiler's fast approximations, ours in float64."""
PARTS = ("colour", "depth", "alpha", "d depth", "d confidence", "d image", "d pose")


def pictures_and_derivatives(
    engine: str, device: torch.device, size: tuple[int, int], views: int
) -> tuple[list[Tensor], float]:
    """Colour, depth and alpha, and derivatives of a fixed mixture of them; seconds forward and back."""
    depth, confidence, image, cameras = scene(*size, views)
    motion = torch.zeros(views, 6)  # rotation and translation of each camera, in its own frame
    leaves = [t.to(device).requires_grad_(True) for t in (depth, confidence, image, motion)]
    start_pose, K = cameras.world_from_cam.to(device), cameras.K.to(device)
    g = torch.Generator().manual_seed(1)
    noise = [torch.randn(views, *size, 3, generator=g), *torch.randn(2, views, *size, generator=g)]

    def once() -> list[Tensor]:
        depth, confidence, image, motion = leaves
        pose = start_pose @ rigid(so3_exp(motion[:, :3]), motion[:, 3:])
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


def row(
    engine: str, definition: str, device: torch.device, size: tuple[int, int], views: int
) -> tuple[str, bool]:
    """A line of the table: relative differences, seconds of both; and whether all is within the bounds."""
    label = f"| {engine} | {definition} |"
    try:
        ours, seconds = pictures_and_derivatives(engine, device, size, views)
    except (RuntimeError, OSError) as error:
        told = str(error).splitlines()[0]
        return f"{label} {told} |" + " |" * (len(PARTS) + 2), device.type != "cuda"
    theirs, slower = pictures_and_derivatives(definition, torch.device("cpu"), size, views)
    found = [float((a - b).norm() / b.norm()) for a, b in zip(ours, theirs, strict=True)]
    picture, derivative = BOUNDS[engine]
    good = all(
        x <= (derivative if part.startswith("d ") else picture) for part, x in zip(PARTS, found, strict=True)
    )
    cells = [*(f"{x:.1e}" for x in found), f"{seconds:.3f}", f"{slower:.3f}", "yes" if good else "NO"]
    return f"{label} " + " | ".join(cells) + " |", good


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; the exit code."""
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
    header = ["engine", "compared with", *PARTS, "s", "s of the CPU's", "within bounds"]
    out.write(f"| {' | '.join(header)} |\n" + "|---" * len(header) + "|\n")
    good = True
    for engine, definition in PAIRS:
        line, within = row(engine, definition, device, (height, width), options.views)
        good &= within
        out.write(line + "\n")
        out.flush()
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
