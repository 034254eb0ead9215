"""Speed and memory of the published networks with random weights: forward, and a step of optimisation.

    python -m benchmarks.backbone [--networks vggt pi3] [--views 2 4 8 16 32] [--size 392 518]
        [--device cpu] [--dtype float32] [--threads 2] [--repeat 1] [--last 6] [--recompute] [--cpu-time]
        [--small] [--output FILE]

``forward`` encodes all views and decodes depth, confidence and cameras of all. ``step`` is a step of
``tco.optimize`` on a made-up scene: with low-rank adapters, decode the cameras of all views and the depth of
one, render it into four others, compare, go back, and take the step of Adam; the first step is not timed.
Operations are the network's alone, counted from the shapes on the meta device, without those that recomputing
adds, so the share of a step counts all else as time lost. The share is of the rate at which the device
multiplies matrices of the same dtype, measured before and after each row, so that other programs slow both.
``--cpu-time`` divides by the CPU time of the process instead of the wall clock, for one thread on a machine
that is not idle. With ``--last`` a step adapts so many last blocks alone (of VGGT pairs), and those before
are run once, ahead of all steps. A row that does not fit the memory says so; ``--recompute`` makes steps fit
that do not.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.wall import scene
from colmap_tco.errors import is_out_of_memory
from colmap_tco.memory import release
from tco.align import KnownCameras
from tco.backbones.dinov2 import ViTConfig
from tco.backbones.pi3 import Pi3, Pi3Config, Pi3Network
from tco.backbones.vggt import VGGT, VGGTConfig, VGGTNetwork
from tco.lora import LoRAConfig, adapted, changed
from tco.optimize import Outcome, optimize
from tco.options import PolishConfig, TCOConfig
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

LENGTHS = {"cuda": 8192}
"""Side of the matrices that a device's rate is measured with; those of a CPU have 2048."""

COLUMNS = (
    "network", "views", "pass", "seconds", "TFLOP", "GFLOP/s", "matrix rate, GFLOP/s", "share", "peak, GB"
)  # fmt: skip


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


def targets(name: str, small: bool, last: int) -> tuple[str, ...]:
    """Patterns of the layers that a step adapts: of all blocks, or of so many last ones."""
    depth = NETWORKS[name][2 + small].depth
    return tuple(f"{i}.*" for i in range(max(0, depth - last), depth)) if last else LoRAConfig().targets


def operations(name: str, small: bool, count: int, size: tuple[int, int], kind: str, last: int = 0) -> int:
    """Floating-point operations of the network in a row; a multiplication and an addition are two.

    Those of a step are the decoding of one view with adapters on all blocks, or so many last ones, and its
    way back.
    """
    with torch.device("meta"):
        backbone, network, *sizes = NETWORKS[name]
        made = backbone(network(sizes[small])).eval().requires_grad_(False)
    views = views_of(count, size, "meta")
    if kind == "forward":
        with FlopCounterMode(display=False) as counter:
            forward(made, views)
        return counter.get_total_flops()
    with torch.no_grad():
        encoded = made.encode(views, Priors())
        context = made.decode(encoded)
    config = LoRAConfig(targets=targets(name, small, last))
    encoded = made.ahead(encoded, changed(made.decoder(), config))
    with adapted(made.decoder(), config), FlopCounterMode(display=False) as counter:
        p = made.decode(encoded, [0], context)
        (p.depth.mean() + p.confidence.mean() + p.cameras.world_from_cam.sum()).backward()
    return counter.get_total_flops()


@dataclass(frozen=True)
class Timed:
    """Seconds of an optimisation, and what came out.

    Attributes:
        ends: from its start to the end of each step; the first holds encoding and a prediction of all views.
        after: from the last step to the end, which is a prediction of all views.
        outcome: the result.
    """

    ends: tuple[float, ...]
    after: float
    outcome: Outcome

    @property
    def each(self) -> float:
        """A step: the mean of those after the first, for which kernels may have been chosen or compiled."""
        return (self.ends[-1] - self.ends[0]) / max(1, len(self.ends) - 1)

    def whole(self, steps: int, refresh: int) -> float:
        """So many steps, where the depths of all views are computed anew every ``refresh`` steps.

        Where fewer were taken, at most ``refresh``, the rest is extrapolated.
        """
        if len(self.ends) == steps:
            return self.ends[-1] + self.after
        return self.ends[0] + (steps - 1) * self.each + (1 + (steps - 1) // refresh) * self.after


def timed(backbone: Any, views: Views, priors: Priors, config: TCOConfig, clock: Clock) -> Timed:
    """Optimise, and look at the clock after every step."""
    ends: list[float] = []
    start = clock()
    outcome = optimize(backbone, views, priors, config, report=lambda *_: ends.append(clock() - start))
    return Timed(tuple(ends), clock() - start - ends[-1], outcome)


def steps_of(steps: int, targets: tuple[str, ...] = LoRAConfig().targets) -> TCOConfig:
    """Steps on the network alone: those on the depths cost the same whatever the network."""
    return TCOConfig(steps=steps, lora_targets=targets, polish=PolishConfig(polish_looks=0))


def seconds(backbone: Any, kind: str, count: int, options: argparse.Namespace, clock: Clock) -> float:
    """The best of ``--repeat`` passes; before the first, on CUDA, one that is not timed.

    The first step of an optimisation is never timed: kernels may have to be compiled for it.
    """
    size = tuple(options.size)
    if kind == "step":
        views, priors = (part.to(clock.device) for part in scene(count, size))
        config = steps_of(1 + options.repeat, targets(backbone.name, options.small, options.last))
        ends = timed(KnownCameras(backbone), views, priors, config, clock).ends
        return min(later - earlier for earlier, later in pairwise(ends))
    torch.manual_seed(0)
    views, times = views_of(count, size, clock.device), []
    if clock.device.type == "cuda":
        forward(backbone, views)
    for _ in range(options.repeat):
        start = clock()
        forward(backbone, views)
        times.append(clock() - start)
    return min(times)


def matrix_rate(clock: Clock, dtype: torch.dtype, length: int) -> float:
    """Operations a second of products of (2 length, length) and (length, length), the best of several.

    A GPU, which is done with one before the next is asked for, gets ten at once and some to warm up.
    """
    a = torch.randn(2 * length, length, device=clock.device, dtype=dtype)
    b = torch.randn(length, length, device=clock.device, dtype=dtype)
    at_once = 10 if clock.device.type == "cuda" else 1
    best = float("inf")
    for _ in range(6):
        start = clock()
        for _ in range(at_once):
            torch.nn.functional.linear(a, b)
        best = min(best, clock() - start)
    return at_once * 4 * length**3 / best


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
    """One line of the table; where memory does not suffice, it says so."""
    clock = Clock(torch.device(options.device), options.cpu_time)
    try:
        cells = figures(backbone, name, kind, count, options)
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        cells = ["out of memory", *6 * [""]]
    release(clock.device)  # after the block: the error held what had been allocated
    return "| " + " | ".join([name, str(count), kind, *cells]) + " |"


def figures(backbone: Any, name: str, kind: str, count: int, options: argparse.Namespace) -> list[str]:
    """What a row says: seconds, operations, rates, share and peak."""
    clock = Clock(torch.device(options.device), options.cpu_time)
    dtype, length = getattr(torch, options.dtype), LENGTHS.get(clock.device.type, 2048)
    length = 128 if options.small else length
    before = matrix_rate(clock, dtype, length)
    with peak(clock.device) as memory:
        best = seconds(backbone, kind, count, options, clock)
    rate = (before + matrix_rate(clock, dtype, length)) / 2
    flop = operations(name, options.small, count, tuple(options.size), kind, options.last)
    share = f"{100 * flop / best / rate:.0f} %"
    speeds = [f"{flop / 1e12:.2f}", f"{flop / best / 1e9:.0f}", f"{rate / 1e9:.0f}", share]
    return [f"{best:.2f}", *speeds, f"{memory[0]:.1f}"]


def table(options: argparse.Namespace) -> Iterator[str]:
    """The lines of the table, each as soon as it is known."""
    height, width = options.size
    device = torch.device(options.device)
    again = ", activations computed again" if options.recompute else ""
    again += f", adapters on the last {options.last} blocks" if options.last else ""
    yield f"{width}×{height}, {options.dtype}, {device}, {options.threads} threads{again}"
    yield ""
    yield f"| {' | '.join(COLUMNS)} |"
    yield "|---" * len(COLUMNS) + "|"
    for name in options.networks:
        wrap, build, *sizes = NETWORKS[name]
        network = drawn(lambda build=build, sizes=sizes: build(sizes[options.small]), device)
        recompute = range(1000) if options.recompute else range(0)
        backbone = wrap(network, getattr(torch, options.dtype), recompute).eval().requires_grad_(False)
        for count in options.views:
            for kind in options.passes:
                yield row(backbone, name, kind, count, options)
        del network, backbone


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
    parser.add_argument("--last", type=int, default=0, help="blocks that a step adapts; 0: all")
    parser.add_argument("--small", action="store_true", help="networks of a few layers, to try the script")
    parser.add_argument("--recompute", action="store_true", help="recompute all activations in the step")
    parser.add_argument("--output", type=Path, help="Markdown file to write as well")
    options = parser.parse_args(arguments)
    if options.cpu_time and (options.threads != 1 or options.device != "cpu"):
        parser.error("--cpu-time goes with --device cpu --threads 1")
    torch.set_num_threads(options.threads)
    lines = []
    for line in table(options):
        print(line, flush=True)
        lines.append(line)
    if options.output is not None:
        text = "\n".join(["# Speed of the published networks", "", *lines])
        options.output.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
