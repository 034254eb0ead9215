"""Speed and memory of the engines: one source of 320×240 (76,800 surfels) into 7 views, forward and backward.

    python -m benchmarks.render [--threads 1 2] [--repeat 5] [--output docs/render.md]

The engines are the compiled loops ``cpu`` (composited as published) and ``surface`` (the default), and
``surface_pairs``, the same as ``surface`` in tensor operations over pairs of surfel and pixel, which is what
runs on other devices: it is the measure for compiled loops. The brute-force twins are timed on a small image
and extrapolated by surfels × pixels × views. Seconds are the best of some runs. Each memory is what the peak
of a process of its own rises by.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import torch
from torch import Tensor

from benchmarks.tables import paragraph, publish, to_file
from tco.geometry import rigid, so3_exp
from tco.render import render
from tco.surfels import from_depth
from tco.types import Cameras

ENGINES = {"surface": "surface_twin", "cpu": "twin", "surface_pairs": "surface_twin"}
"""Engine → the twin that defines it."""
SIZES = ((60, 80), (120, 160), (240, 320), (480, 640))
"""Of the images whose surfels are counted, to see that time and memory are linear in them."""
FULL, VIEWS, SMALL = (240, 320), 7, (24, 32)


def scene(height: int, width: int, views: int) -> tuple[Tensor, Tensor, Tensor, Cameras]:
    """A wavy wall at depth 1 to 1.6 with a random texture, and cameras on a small arc around it."""
    torch.manual_seed(0)
    y, x = torch.meshgrid(torch.linspace(0, 6, height), torch.linspace(0, 8, width), indexing="ij")
    depth = 1.3 + 0.2 * torch.sin(x) * torch.cos(y) + 0.1 * (x > 4)
    confidence = 2 + 8 * torch.rand(height, width)
    image = torch.rand(3, height, width)
    step = torch.linspace(-0.5, 0.5, views).unsqueeze(-1)
    pose = rigid(so3_exp(step * torch.tensor([0.05, -0.25, 0.02])), step * torch.tensor([0.3, 0.1, 0.05]))
    f = 0.9 * width
    K = torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]]).expand(views, 3, 3)
    return depth, confidence, image, Cameras(pose, K)


def step(height: int, width: int, views: int, engine: str) -> Callable[[], tuple[float, float]]:
    """A function that renders once with gradients and returns the seconds forward and backward."""
    depth, confidence, image, cameras = scene(height, width, views)
    leaves = [t.clone().requires_grad_(True) for t in (depth, confidence, cameras.world_from_cam, cameras.K)]

    def run() -> tuple[float, float]:
        start = time.perf_counter()
        depth, confidence, pose, K = leaves
        surfels = from_depth(depth, K[views // 2], pose[views // 2], image, confidence)
        rendered = render(surfels, Cameras(pose, K), (height, width), engine)
        loss = (rendered.color - 0.5).abs().mean() + (rendered.depth - 1.2).abs().mean()
        middle = time.perf_counter()
        loss.backward()
        return middle - start, time.perf_counter() - middle

    return run


def measured(
    engine: str, size: tuple[int, int], views: int, threads: int, repeat: int
) -> tuple[float, float, float]:
    """Best seconds forward and backward, and the rise of the peak of this process in MiB."""
    torch.set_num_threads(threads)
    step(16, 16, 1, engine)()  # what is compiled or imported at first use
    run, before = step(*size, views, engine), _peak()
    times = [run() for _ in range(repeat + 1)][1:]
    return min(t[0] for t in times), min(t[1] for t in times), _peak() - before


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def alone(
    engine: str, size: tuple[int, int], views: int, threads: int, repeat: int
) -> tuple[float, float, float]:
    """:func:`measured`, in a process of its own."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(measured, engine, size, views, threads, repeat).result()


def engines(threads: list[int], repeat: int) -> str:
    """Table of all engines."""
    lines = [
        "| engine | threads | forward | backward | together | peak memory | brute force takes |\n"
        "|---|---|---|---|---|---|---|"
    ]
    larger = (FULL[0] * FULL[1] / (SMALL[0] * SMALL[1])) ** 2 * VIEWS
    for count in threads:
        brute = {twin: sum(alone(twin, SMALL, 1, count, 1)[:2]) * larger for twin in set(ENGINES.values())}
        for engine, twin in ENGINES.items():
            forward, backward, memory = alone(engine, FULL, VIEWS, count, repeat)
            total = forward + backward
            lines.append(
                f"| {engine} | {count} | {forward:.2f} s | {backward:.2f} s | {total:.2f} s "
                f"| {memory:.0f} MiB | {brute[twin]:.0f} s, {brute[twin] / total:.0f} times as long |"
            )
    return "\n".join(lines) + "\n"


def growth(threads: int, repeat: int) -> str:
    """Table of seconds and memory against the number of surfels, into two views of as many pixels."""
    lines = ["| surfels | seconds | µs a surfel | peak memory | KiB a surfel |\n|---|---|---|---|---|"]
    for size in SIZES:
        forward, backward, memory = alone("surface", size, 2, threads, repeat)
        count, seconds = size[0] * size[1], forward + backward
        lines.append(
            f"| {count} | {seconds:.3f} | {seconds / count * 1e6:.2f} | {memory:.0f} MiB | "
            f"{memory * 1024 / count:.2f} |"
        )
    return "\n".join(lines) + "\n"


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeat", type=int, default=5)
    to_file(parser)
    return parser


def main() -> None:
    """Measure and publish."""
    args = parser().parse_args()
    text = "# The renderer\n\n" + paragraph(
        f"`python -m benchmarks.render`: a source of 320×240, 76,800 surfels, into {VIEWS} views of that "
        f"size, with the gradients by depth, confidence, poses and intrinsics; the best of {args.repeat} "
        "runs. Memory is what the peak of a process rises by. surface: the default, compiled loops; "
        "surface_pairs: the same in tensor operations, as on other devices; cpu: compiled loops that "
        f"composite as published. Brute force: all surfels on all pixels, one view of {SMALL[1]}×{SMALL[0]}, "
        "extrapolated by surfels × pixels × views."
    )
    text += "\n" + engines(args.threads, args.repeat)
    text += "\n" + paragraph(
        f"Against the number of surfels, engine surface, {max(args.threads)} threads, into two views with as "
        "many pixels as there are surfels:"
    )
    text += "\n" + growth(max(args.threads), args.repeat)
    publish(text, args.output, args.part)


if __name__ == "__main__":
    main()
