"""Speed of the CPU renderer: one source of 320×240 (76,800 surfels) into 7 views, forward and backward.

    python benchmarks/render.py [--threads 1 2] [--repeat 5]

Prints, for each number of threads, the best of some runs in seconds; the same of the brute-force twin
on a small image, extrapolated by surfels × pixels × views; the time against the number of surfels; and
the peak of the memory that the renderer allocates.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable

import torch
from torch import Tensor

from tco.geometry import rigid, so3_exp
from tco.render import render
from tco.surfels import from_depth
from tco.types import Cameras


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


def step(height: int, width: int, views: int, engine: str = "cpu") -> Callable[[], tuple[float, float]]:
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


def best(run: Callable[[], tuple[float, float]], repeat: int) -> tuple[float, float]:
    run()
    times = [run() for _ in range(repeat)]
    return min(t[0] for t in times), min(t[1] for t in times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    for threads in args.threads:
        torch.set_num_threads(threads)
        small = sum(best(step(24, 32, 1, "twin"), 1))
        twin = small * (240 * 320 / (24 * 32)) ** 2 * 7
        for engine in ("cpu", "surface"):
            forward, backward = best(step(240, 320, 7, engine), args.repeat)
            total = forward + backward
            print(
                f"{threads} thread(s), {engine}: 76,800 surfels into 7 views of 320×240: {total:.3f} s "
                f"(forward {forward:.3f}, backward {backward:.3f}); "
                f"brute force, extrapolated: {twin:.0f} s, {twin / total:.0f} times as much"
            )
        for height, width in ((60, 80), (120, 160), (240, 320), (480, 640)):
            seconds = sum(best(step(height, width, 2), args.repeat))
            n = height * width
            print(f"  {n:7d} surfels into 2 views: {seconds:.3f} s, {seconds / n * 1e6:.2f} µs a surfel")
    print(f"peak memory of the process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


if __name__ == "__main__":
    main()
