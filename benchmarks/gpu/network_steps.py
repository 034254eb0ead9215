"""Test-time optimisation on the published networks at full size: the published schedule against ours.

    python -m benchmarks.gpu.network_steps [--networks vggt] [--views 10 40 100] [--device cuda] [--small]

Weights are made by a rule (:mod:`benchmarks.rule`), pictures are made, cameras stand on a small arc before a
wall with some triangulated points: what is timed does not depend on what the network knows. The first number
of views takes all ``--steps`` steps, from encoding to the last prediction, on the published schedule and on
ours. The published one re-encodes and decodes all views with gradients in each step; the paper reports
161.5 s for 10 views on a TITAN RTX. The other numbers of views take ``--timed`` steps, and the seconds of
all are extrapolated from these, with the predictions of all views between them. From 40 views on, what the
backward pass needs is computed again there (``--recompute`` chooses the blocks). ``fits`` says which of 24
and 80 GB hold the peak. A row that does not fit the device says so, and the next one follows.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from benchmarks.backbone import NETWORKS, Clock, peak, steps_of, timed
from benchmarks.rule import by_rule
from benchmarks.uncached import Uncached
from benchmarks.wall import scene
from colmap_tco.errors import is_out_of_memory
from colmap_tco.memory import release
from tco.align import KnownCameras
from tco.options import TCOConfig

MANY = 40
"""From so many views on, activations are computed again: kept, they would fill 80 GB at 30 views."""
EVERY_BLOCK = 1000
COLUMNS = (
    "schedule", "views", "blocks computed again", "s", "s / step", "peak GB", "fits", "photometric",
    "rolled back",
)  # fmt: skip


def row(backbone: Any, label: str, count: int, config: TCOConfig, options: argparse.Namespace) -> str:
    """A line of the table; where memory does not suffice, it says so."""
    device = torch.device(options.device)
    try:
        cells = figures(backbone, count, config, options)
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        cells = ["out of memory", *(len(COLUMNS) - 4) * [""]]
    release(device)  # after the block: the error held what had been allocated
    blocks = str(min(options.recomputed(count), options.blocks))
    return "| " + " | ".join([label, str(count), blocks, *cells]) + " |"


def figures(backbone: Any, count: int, config: TCOConfig, options: argparse.Namespace) -> list[str]:
    """What a row says: seconds of all steps and of one, peak, colours of first and last step, roll-backs."""
    device = torch.device(options.device)
    clock = Clock(device, False)
    views, priors = (part.to(device) for part in scene(count, tuple(options.size)))
    # Kernels are chosen and compiled in a step that is not timed.
    timed(backbone, views, priors, replace(config, steps=1), clock)
    with peak(device) as memory:
        found = timed(backbone, views, priors, config, clock)
    whole = f"{found.whole(options.steps, config.refresh):.1f}"
    if config.steps < options.steps:
        whole += f" extrapolated from {config.steps} steps"
    first, last = (found.outcome.history[i].get("photometric", float("nan")) for i in (0, -1))
    fits = ", ".join(f"{size} GB" for size in (24, 80) if memory[0] < 0.95 * size) or "neither"
    colours = f"{first:.4f} → {last:.4f}"
    rolled_back = str(len(found.outcome.rolled_back))
    return [whole, f"{found.each:.3f}", f"{memory[0]:.1f}", fits, colours, rolled_back]


def rows(kind: str, options: argparse.Namespace) -> Iterator[str]:
    """The lines of a network, which is gone before the next one is made."""
    wrap, build, *sizes = NETWORKS[kind]
    config = sizes[options.small]
    network = by_rule(partial(build, config), options.device)
    made = wrap(network, getattr(torch, options.dtype)).eval().requires_grad_(False)
    options.blocks, backbone = config.depth, KnownCameras(made)
    for i, count in enumerate(options.views):
        ours = steps_of(options.steps if i == 0 else min(options.steps, options.timed))
        made.recompute = range(options.recomputed(count))
        if i == 0:
            published, label = ours.reference_schedule(), f"{kind}, published schedule"
            if options.objective != "ours":
                theirs = replace(ours.ablation, published_objective=True, renderer=options.objective)
                published, label = replace(ours, ablation=theirs).reference_schedule(), f"{kind}, published"
            yield row(Uncached(backbone), label, count, published, options)
        yield row(backbone, f"{kind}, ours", count, ours, options)


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Command line; ``recomputed`` is a function of the number of views."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--networks", nargs="+", choices=list(NETWORKS), default=["vggt"])
    parser.add_argument("--views", type=int, nargs="+", default=[10, 40, 100])
    parser.add_argument("--size", type=int, nargs=2, default=(392, 518), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument(
        "--timed", type=int, choices=range(2, 11), default=4,
        help="steps that are taken with all but the first number of views: fewer than 11, as the depths of "
        "all views are computed anew then",
    )  # fmt: skip
    parser.add_argument(
        "--objective", choices=["ours", "cpu", "gsplat"], default="ours",
        help="of the published schedule; cpu and gsplat: the published one, rendered by that engine",
    )  # fmt: skip
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--dtype", choices=["float32", "bfloat16"], default="bfloat16")
    parser.add_argument("--small", action="store_true", help="networks of a few layers, to try the script")
    parser.add_argument(
        "--recompute", type=int,
        help=f"decoder blocks whose activations are not kept; default: none with fewer than {MANY} views, "
        "else all",
    )  # fmt: skip
    options = parser.parse_args(arguments)
    automatic = options.recompute is None
    options.recomputed = lambda count: EVERY_BLOCK * (count >= MANY) if automatic else options.recompute
    return options


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table that the command line asks for."""
    options = parsed(arguments)
    out, device = sys.stdout, torch.device(options.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    height, width = options.size
    out.write(f"{name}, {options.dtype}, {width}×{height}, {options.steps} steps\n\n")
    out.write(f"| {' | '.join(COLUMNS)} |\n" + "|---" * len(COLUMNS) + "|\n")
    for kind in options.networks:
        for line in rows(kind, options):
            out.write(line + "\n")
            out.flush()
        release(device)


if __name__ == "__main__":
    main()
