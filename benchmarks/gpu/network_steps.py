"""Test-time optimisation on the published networks at full size: the published schedule against ours.

    python -m benchmarks.gpu.network_steps [--networks vggt pi3] [--views 10 40 100] [--device cuda] [--small]

Weights are random (of the usual size), pictures are made, cameras stand on a small arc before a wall with
some triangulated points: what is timed does not depend on what the network knows. Each row takes ``--steps``
steps, from encoding to the last prediction. The published schedule re-encodes and decodes all views with
gradients in each step, and runs for the first number of views alone. The paper reports 161.5 s for 10 views
on a TITAN RTX. ``fits`` says which of 24 and 80 GB hold the peak.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from benchmarks.backbone import NETWORKS, Clock, drawn, peak
from benchmarks.uncached import Uncached
from tco.align import KnownCameras
from tco.geometry import rigid, so3_exp
from tco.optimize import optimize
from tco.options import PolishConfig, TCOConfig
from tco.types import Cameras, Priors, SparseDepth, Views

DEPTH = 2.0
"""Distance of the wall, in the unit in which the cameras stand 0.3 apart at most."""


def scene(count: int, size: tuple[int, int], points: int = 300) -> tuple[Views, Priors]:
    """Views of coloured waves on a wall, with exact cameras and points on it."""
    h, w = size
    f = 0.9 * w
    K = torch.tensor([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1.0]]).expand(count, 3, 3).contiguous()
    t = torch.linspace(-1, 1, count).unsqueeze(-1)
    pose = rigid(so3_exp(t * torch.tensor([0.0, -0.05, 0.0])), t * torch.tensor([0.15, 0.02, 0.0]))
    y, x = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], -1)
    images, sparse = [], []
    draw = torch.Generator().manual_seed(0)
    for k in range(count):
        rays = pixels @ K[k].inverse().T @ pose[k, :3, :3].T
        away = (DEPTH - pose[k, 2, 3]) / rays[..., 2]
        wall = pose[k, :3, 3] + away.unsqueeze(-1) * rays
        phase = torch.einsum(
            "hwc,cd->hwd", 25 * wall, torch.tensor([[1.0, 0.4, 0], [0.3, 1, 0.8], [0, 0, 0]])
        )
        images.append((0.5 + 0.4 * torch.sin(phase + phase.roll(1, -1).cos())).permute(2, 0, 1))
        u = torch.randint(w, (points,), generator=draw)
        v = torch.randint(h, (points,), generator=draw)
        xy = torch.stack([u + 0.5, v + 0.5], -1)
        sparse.append(SparseDepth(xy, away[v, u], torch.full((points,), 0.02), torch.arange(points)))
    ones = torch.ones(count, count).fill_diagonal_(0)
    sigma = torch.full((count,), 0.01)
    views = Views(
        torch.stack(images), torch.ones(count, h, w, dtype=torch.bool), tuple(map(str, range(count)))
    )
    return views, Priors(
        Cameras(pose, K), tuple(sparse), overlap=ones, rotation_sigma=sigma, centre_sigma=sigma,
        focal_sigma=sigma,
    )  # fmt: skip


def row(backbone: Any, label: str, count: int, config: TCOConfig, options: argparse.Namespace) -> str:
    """A line of the table."""
    device = torch.device(options.device)
    clock = Clock(device, False)
    views, priors = (part.to(device) for part in scene(count, tuple(options.size)))
    # Kernels are chosen and compiled in a short run that is not timed.
    optimize(backbone, views, priors, replace(config, steps=min(2, config.steps)))
    with peak(device) as memory:
        start = clock()
        outcome = optimize(backbone, views, priors, config)
        seconds = clock() - start
    first, last = (outcome.history[i].get("photometric", float("nan")) for i in (0, -1))
    fits = ", ".join(f"{size} GB" for size in (24, 80) if memory[0] < 0.95 * size) or "neither"
    each = seconds / max(1, config.steps)
    return (
        f"| {label} | {count} | {seconds:.1f} | {each:.3f} | {memory[0]:.1f} | {fits} "
        f"| {first:.4f} → {last:.4f} | {len(outcome.rolled_back)} |"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--networks", nargs="+", choices=list(NETWORKS), default=["vggt"])
    parser.add_argument("--views", type=int, nargs="+", default=[10, 40, 100])
    parser.add_argument("--size", type=int, nargs=2, default=(392, 518), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--dtype", choices=["float32", "bfloat16"], default="bfloat16")
    parser.add_argument("--small", action="store_true", help="networks of a few layers, to try the script")
    parser.add_argument(
        "--recompute", type=int, default=0, help="decoder blocks whose activations are not kept"
    )
    options = parser.parse_args(arguments)
    out, device = sys.stdout, torch.device(options.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    height, width = options.size
    out.write(f"{name}, {options.dtype}, {width}×{height}, {options.steps} steps\n\n")
    out.write("| schedule | views | s | s / step | peak GB | fits | photometric | rolled back |\n")
    out.write("|---" * 8 + "|\n")
    # Steps on the network alone: those on the depths cost the same whatever the network.
    ours = TCOConfig(
        steps=options.steps, lora_targets=("qkv", "proj", "fc1", "fc2"), polish=PolishConfig(polish_looks=0)
    )
    for kind in options.networks:
        wrap, build, *sizes = NETWORKS[kind]
        network = drawn(lambda build=build, sizes=sizes: build(sizes[options.small]), device)
        made = wrap(network, getattr(torch, options.dtype), range(options.recompute))
        backbone = KnownCameras(made.eval().requires_grad_(False))
        for i, count in enumerate(options.views):
            if i == 0:
                published = row(
                    Uncached(backbone), f"{kind}, published", count, ours.reference_schedule(), options
                )
                out.write(published + "\n")
            out.write(row(backbone, f"{kind}, ours", count, ours, options) + "\n")
            out.flush()


if __name__ == "__main__":
    main()
