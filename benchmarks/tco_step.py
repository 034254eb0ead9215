"""The published schedule against ours on one real set: seconds a step, memory, loss, time to the same loss.

    python -m benchmarks.tco_step [--sets livingroom] [--output docs/tco_step.md]

All lower the same objective with the same network. The published schedule draws a source uniformly, encodes
and decodes all views with gradients in every step, and renders into all other views, with all products in
float32. Ours is measured in float32, too, and in the type that the processor is fastest in. Each schedule is
run in a process of its own. The loss that is compared is none's own: after every few steps the photometric
term is evaluated for every view into its three best partners, with all depths of that moment, off the clock.
"""

from __future__ import annotations

import argparse
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from multiprocessing import get_context
from typing import Any

import torch

from benchmarks.real import RealSet, arguments, load, within
from benchmarks.tables import paragraph, publish, weights_told
from benchmarks.uncached import Uncached
from tco.backbones.base import Backbone
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.objective import NothingVisibleError, ObjectiveConfig, photometric
from tco.optimize import optimize
from tco.options import PolishConfig, TCOConfig
from tco.surfels import from_depth
from tco.types import Prediction


@dataclass(frozen=True)
class Curve:
    """Seconds and loss every some steps; the process's peak memory in MiB; share within 5 % at the end."""

    every: int
    seconds: list[float]
    loss: list[float]
    memory: float
    accuracy: float

    @property
    def per_step(self) -> float:
        """Seconds a step."""
        return self.seconds[-1] / (self.every * (len(self.seconds) - 1))


def common_loss(real: RealSet, prediction: Prediction) -> float:
    """Photometric term of every view into its three best partners, mean."""
    cameras, overlap = real.given.cameras, real.given.overlap
    assert cameras is not None and overlap is not None
    values = []
    for source in range(len(real.views)):
        targets = overlap[source].topk(min(3, len(real.views) - 1)).indices
        surfels = from_depth(
            prediction.depth[source], cameras.K[source], cameras.world_from_cam[source],
            real.views.images[source], prediction.confidence[source], valid=real.views.valid[source],
        )  # fmt: skip
        try:
            value = photometric(
                surfels, real.views.images[targets], cameras[targets], prediction.depth[targets],
                real.views.valid[targets], ObjectiveConfig(exposure=True, structure=0.5),
            )  # fmt: skip
        except NothingVisibleError:
            continue
        values.append(float(value))
    return sum(values) / len(values)


SCHEDULES = {"published": torch.float32, "ours in float32": torch.float32, "ours": None}
"""Name → type of the network's products."""


def measure(name: str, args: argparse.Namespace, schedule: str) -> Curve:
    """One schedule on one set."""
    torch.set_num_threads(args.threads)
    real = load(name, args.size, args.views)
    network = load_sweep(args.weights or EMBEDDED, dtype=SCHEDULES[schedule])
    # Fixed cameras, and the network alone: the loss that is compared is that of its depths.
    config = TCOConfig(steps=args.steps, camera_rate=0, polish=PolishConfig(polish_looks=0))
    backbone: Backbone = network
    if schedule == "published":
        config, backbone = config.reference_schedule(), Uncached(network)
    with torch.no_grad():
        features = network.encode(real.views, real.given)
    seconds, loss, paused = [0.0], [common_loss(real, _depths(network, features))], 0.0
    every = max(1, args.steps // 8)
    clock = time.process_time if args.cpu_time else time.perf_counter
    # What is compiled at first use is no part of a step.
    optimize(backbone, real.views, real.given, replace(config, steps=1))
    start = clock()

    def report(step: int, _: dict[str, float]) -> None:
        nonlocal paused
        if (step + 1) % every:
            return
        now = clock()
        seconds.append(now - start - paused)
        loss.append(common_loss(real, _depths(network, features)))
        paused += clock() - now

    outcome = optimize(backbone, real.views, real.given, config, report=report)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return Curve(every, seconds, loss, peak, within(outcome.prediction, real.truth))


@torch.no_grad()
def _depths(network: Backbone, features: Any) -> Prediction:
    return network.decode(features)


def time_to(curve: Curve, loss: float) -> float | None:
    """Seconds after which a curve has come down to a loss, interpolated; None if it never does."""
    for (t0, a), (t1, b) in pairwise(zip(curve.seconds, curve.loss, strict=True)):
        if b <= loss:
            return t0 if a <= loss else t0 + (t1 - t0) * (a - loss) / (a - b)
    return None


def table(name: str, curves: dict[str, Curve]) -> str:
    """Markdown of one set."""
    goal = max(min(curve.loss) for curve in curves.values())
    times = {label: time_to(curve, goal) for label, curve in curves.items()}
    lines = [
        f"## {name}\n",
        "| schedule | s / step | peak MiB | loss at the start → end | within 5 % | seconds to loss "
        f"{goal:.4f} |\n|---|---|---|---|---|---|",
    ]
    for label, curve in curves.items():
        t = times[label]
        lines.append(
            f"| {label} | {curve.per_step:.2f} | {curve.memory:.0f} | {curve.loss[0]:.4f} → "
            f"{curve.loss[-1]:.4f} | {curve.accuracy:.3f} | {'never' if t is None else f'{t:.0f}'} |"
        )
    slow = times["published"]
    gains = [f"{slow / t:.1f} ({label})" for label, t in times.items() if slow and t and label != "published"]
    lines.append(f"\nTimes fewer seconds to the same loss: {', '.join(gains)}.\n" if gains else "")
    for label, curve in curves.items():
        points = ", ".join(f"{t:.0f} s {v:.4f}" for t, v in zip(curve.seconds, curve.loss, strict=True))
        lines.append(f"- {label}: {points}")
    return "\n".join(lines) + "\n\n"


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = arguments(__doc__ or "", ("livingroom",))
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument(
        "--cpu_time", action="store_true", help="seconds of the CPU, where others use it, too"
    )
    return parser


def main() -> None:
    """Measure and publish."""
    args = parser().parse_args()
    text = "# Published schedule and ours\n\n" + paragraph(
        f"`python -m benchmarks.tco_step`: {weights_told(args.weights or EMBEDDED)}, "
        f"{args.views or 'all'} views of {args.size} pixels, {args.steps} steps, {args.threads} threads, the "
        f"same objective and network. Seconds are those of {'the CPU' if args.cpu_time else 'a clock'}; on "
        "other machines they differ, and their ratio should not. Memory is the peak of the process."
    )
    text += "\n"
    for name in args.sets:
        curves = {}
        for schedule in SCHEDULES:
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                curves[schedule] = pool.submit(measure, name, args, schedule).result()
        text += table(name, curves)
    publish(text, args.output, args.part)


if __name__ == "__main__":
    main()
