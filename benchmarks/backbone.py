"""Speed and memory of the published networks with random weights: forward, and the decoding of a TCO step.

    python benchmarks/backbone.py [--networks vggt pi3] [--views 2 4 8 16 32] [--size 392 518]
        [--device cpu] [--dtype float32] [--threads 2] [--repeat 1] [--cpu-time] [--small]

``forward`` encodes all views and decodes depth, confidence and cameras of all. ``step`` is what test-time
optimisation does with the network in every step: with low-rank adapters, decode the cameras of all views and
the depth of one, and go back. The operations are counted from the shapes, on the meta device, without those
that recomputing adds. The share is of the rate at which the device multiplies matrices of the same dtype,
measured before and after each row, so that other programs slow both. ``--cpu-time`` divides by the CPU time
of the process instead of the wall clock, for one thread on a machine that is not idle.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from tco.backbones.dinov2 import ViTConfig
from tco.backbones.pi3 import Pi3, Pi3Config, Pi3Network
from tco.backbones.vggt import VGGT, VGGTConfig, VGGTNetwork
from tco.lora import LoRAConfig, adapted
from tco.types import Priors, Views

SMALL = ViTConfig(64, 2, 2)
NETWORKS: dict[str, tuple[type[Any], type[Any], Any, Any]] = {
    "vggt": (
        VGGT,
        VGGTNetwork,
        VGGTConfig.vggt_1b(),
        VGGTConfig(
            SMALL, 64, 4, 2, camera_depth=1, features=16, levels=(16, 16, 16, 16), layers=(0, 1, 2, 3)
        ),
    ),
    "pi3": (
        Pi3,
        Pi3Network,
        Pi3Config.large(),
        Pi3Config(replace(SMALL, mask_token=False), 64, 4, 2, hidden=64, head_depth=1, head_heads=2, pose=16),
    ),
}
"""Backbone, network, published sizes, and small ones to try the script with."""


@dataclass(frozen=True)
class Clock:
    """Seconds on a device: of the wall, or of the CPU that this process was given."""

    device: torch.device
    cpu_time: bool

    def __call__(self) -> float:
        """Now, when all that was asked of the device is done."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.process_time() if self.cpu_time else time.perf_counter()


def drawn(build: Callable[[], nn.Module], device: torch.device) -> nn.Module:
    """A network with random weights of the usual size, from one small table of random numbers."""
    with torch.device("meta"):
        network = build()
    network.to_empty(device=device)
    pool = torch.randn(1 << 20, device=device)
    with torch.no_grad():
        for name, p in [*network.named_parameters(), *network.named_buffers()]:
            if p.ndim < 2 or "image_" in name:
                p.fill_(1.0 if name.endswith(("weight", "std")) else 0.01)
                continue
            flat, scale = p.view(-1), p[0].numel() ** -0.5
            for i in range(0, len(flat), len(pool)):
                part = flat[i : i + len(pool)]
                torch.mul(pool[: len(part)], scale, out=part)
    return network


def views_of(count: int, size: tuple[int, int], device: torch.device | str) -> Views:
    """Views of noise."""
    images = torch.rand(count, 3, *size, device=device)
    valid = torch.ones(count, *size, dtype=torch.bool, device=device)
    return Views(images, valid, tuple(str(i) for i in range(count)))


def forward(backbone: Any, views: Views) -> None:
    """Encode, and decode everything."""
    with torch.no_grad():
        backbone.decode(backbone.encode(views, Priors()))


def step(backbone: Any, views: Views) -> Callable[[], None]:
    """A function that decodes one view with adapters, forward and back; encoding is done here, once."""
    with torch.no_grad():
        encoded = backbone.encode(views, Priors())
        context = backbone.decode(encoded)

    def run() -> None:
        with adapted(backbone.decoder(), LoRAConfig()):
            p = backbone.decode(encoded, [0], context)
            (p.depth.mean() + p.confidence.mean() + p.cameras.world_from_cam.sum()).backward()

    return run


def work(backbone: Any, views: Views, kind: str) -> Callable[[], None]:
    """The function that a row times."""
    return step(backbone, views) if kind == "step" else lambda: forward(backbone, views)


def operations(name: str, small: bool, count: int, size: tuple[int, int], kind: str) -> int:
    """Floating-point operations of a row; a multiplication and an addition are two."""
    with torch.device("meta"):
        backbone, network, *sizes = NETWORKS[name]
        made = backbone(network(sizes[small])).eval().requires_grad_(False)
    run = work(made, views_of(count, size, "meta"), kind)
    with FlopCounterMode(display=False) as counter:
        run()
    return counter.get_total_flops()


def matrix_rate(clock: Clock, dtype: torch.dtype, length: int) -> float:
    """Operations a second of a product of (2 length, length) and (length, length), best of several."""
    a = torch.randn(2 * length, length, device=clock.device, dtype=dtype)
    b = torch.randn(length, length, device=clock.device, dtype=dtype)
    best = float("inf")
    for _ in range(6):
        start = clock()
        torch.nn.functional.linear(a, b)
        best = min(best, clock() - start)
    return 4 * length**3 / best


@contextmanager
def peak(device: torch.device) -> Iterator[list[float]]:
    """The list gets the most memory, in GB, that this process held inside the block.

    On CUDA what PyTorch allocated; on Linux the resident pages; elsewhere those since the start.
    """
    out: list[float] = []
    reset, status = Path("/proc/self/clear_refs"), Path("/proc/self/status")
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    elif reset.exists():
        reset.write_text("5", encoding="ascii")
    yield out
    if device.type == "cuda":
        out.append(torch.cuda.max_memory_allocated(device) / 1e9)
    elif status.exists():
        line = next(text for text in status.read_text().splitlines() if text.startswith("VmHWM"))
        out.append(int(line.split()[1]) * 1024 / 1e9)
    else:
        out.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9)


def row(backbone: Any, name: str, kind: str, count: int, options: argparse.Namespace) -> str:
    """One line of the table."""
    clock = Clock(torch.device(options.device), options.cpu_time)
    dtype, size = getattr(torch, options.dtype), tuple(options.size)
    length = 128 if options.small else 2048
    flop = operations(name, options.small, count, size, kind)
    torch.manual_seed(0)
    run = work(backbone, views_of(count, size, clock.device), kind)
    before, best = matrix_rate(clock, dtype, length), float("inf")
    with peak(clock.device) as memory:
        for _ in range(options.repeat):
            start = clock()
            run()
            best = min(best, clock() - start)
    rate = (before + matrix_rate(clock, dtype, length)) / 2
    cells = (
        f"{name} | {count} | {kind} | {best:.2f} | {flop / 1e12:.2f} | {flop / best / 1e9:.0f} | "
        f"{rate / 1e9:.0f} | {100 * flop / best / rate:.0f} % | {memory[0]:.1f}"
    )
    return f"| {cells} |"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table that the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--networks", nargs="+", choices=list(NETWORKS), default=list(NETWORKS))
    parser.add_argument("--views", type=int, nargs="+", default=[2, 4, 8, 16, 32])
    parser.add_argument("--passes", nargs="+", choices=["forward", "step"], default=["forward", "step"])
    parser.add_argument("--size", type=int, nargs=2, default=(392, 518), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--dtype", choices=["float32", "bfloat16"], default="float32")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--cpu-time", action="store_true", help="CPU time of this process, for one thread")
    parser.add_argument("--small", action="store_true", help="networks of a few layers, to try the script")
    parser.add_argument("--recompute", action="store_true", help="recompute all activations in the step")
    options = parser.parse_args(arguments)
    if options.cpu_time and (options.threads != 1 or options.device != "cpu"):
        parser.error("--cpu-time goes with --device cpu --threads 1")
    torch.set_num_threads(options.threads)
    height, width = options.size
    print(f"{width}×{height}, {options.dtype}, {options.device}, {options.threads} threads\n")
    print("| network | views | pass | seconds | TFLOP | GFLOP/s | matrix rate, GFLOP/s | share | peak, GB |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name in options.networks:
        wrap, build, *sizes = NETWORKS[name]
        network = drawn(
            lambda build=build, sizes=sizes: build(sizes[options.small]), torch.device(options.device)
        )
        recompute = range(1000) if options.recompute else range(0)
        backbone = wrap(network, getattr(torch, options.dtype), recompute).eval().requires_grad_(False)
        for count in options.views:
            for kind in options.passes:
                print(row(backbone, name, kind, count, options), flush=True)


if __name__ == "__main__":
    main()
