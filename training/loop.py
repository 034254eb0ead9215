"""The loop that trains a network on rendered samples; stops and resumes at any time.

It writes ``state.pt`` (everything, to resume), ``weights.safetensors`` (moving average, what the package
reads) and ``log.csv``. What is trained, on what and by which loss are the four methods of a subclass.
"""

from __future__ import annotations

import argparse
import copy
import csv
import json
import logging
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import timedelta
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
import torch.distributed
import torch.multiprocessing
from torch import Tensor, nn

from tco.backbones.weights import fill, read_file

logger = logging.getLogger(__name__)

Figures = Mapping[str, float | Tensor]


@dataclass(frozen=True)
class LoopConfig:
    """What the loop needs to know.

    Attributes:
        steps: length of the cosine schedule. rate: peak learning rate. warmup: steps to reach it.
        sizes: (share of the steps after which it starts, H, W) of the samples.
        average: decay of the moving average of the weights.
        minutes: if not 0, the schedule runs by the clock and ends after so long, whatever ``steps`` says;
            where a machine is lent for a time. Such a training does not repeat to the last bit.
        stop: if not 0, minutes after which this process stops where it is, to be resumed; the clock of the
            schedule goes on from there.
        held_out: samples with the lowest numbers, kept for validation.
        weight_decay: of AdamW. clip: largest norm of the gradient.
    """

    steps: int = 3000
    rate: float = 1e-3
    warmup: int = 150
    sizes: tuple[tuple[float, int, int], ...] = ((0.0, 96, 128), (0.6, 144, 192), (0.9, 192, 256))
    average: float = 0.995
    minutes: float = 0.0
    stop: float = 0.0
    held_out: int = 16
    seed: int = 0
    weight_decay: float = 1e-4
    clip: float = 2.0


_Config = TypeVar("_Config", bound=LoopConfig)


class Loop(ABC):
    """Network, its moving average, optimiser and step count; saved and restored as one file.

    ``shown`` counts the samples that this process trained on.

    Several processes, one thread each, take a sample each and average their gradients: on a CPU two
    threads in one process wait for each other longer than they gain.
    """

    config: LoopConfig
    net: nn.Module
    mean: nn.Module

    def __init__(
        self, config: LoopConfig, data: Sequence[Path], out: Path, rank: int = 0, device: str = "cpu"
    ) -> None:
        self.config, self.data, self.out, self.rank = config, list(data), out, rank
        self.device = torch.device(device)
        self.began, self.spent = time.monotonic(), 0.0
        self.finished = False
        torch.manual_seed(config.seed)
        self.net = self.network().to(self.device)
        self.mean = copy.deepcopy(self.net).eval()
        self.optimiser = torch.optim.AdamW(
            self.net.parameters(), config.rate, weight_decay=config.weight_decay
        )
        self.step = self.shown = 0
        self.refresh()
        out.mkdir(parents=True, exist_ok=True)
        if (out / "state.pt").exists():
            self._resume(out / "state.pt")

    @abstractmethod
    def network(self) -> nn.Module:
        """The network before the first step."""

    @abstractmethod
    def loss(self) -> tuple[Tensor, Figures]:
        """Loss of the samples of this step, and figures for the log."""

    @abstractmethod
    def validate(self) -> dict[str, float]:
        """Mean figures of the averaged weights on the held-out samples."""

    @abstractmethod
    def export(self, path: Path) -> None:
        """Write the averaged weights as the package reads them."""

    def _resume(self, path: Path) -> None:
        # Read on the CPU: the optimiser keeps its step counts there, and would wait for those on a GPU.
        state = torch.load(path, map_location="cpu", weights_only=True)
        self.net.load_state_dict(state["net"])
        self.mean.load_state_dict(state["mean"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step, self.spent = int(state["step"]), float(state.get("spent", 0.0))
        self.shown = int(state.get("shown", 0))
        logger.info("resumed at step %d, after %.1f minutes", self.step, self.spent / 60)

    def start_from(self, weights: Path) -> None:
        """Take the weights of an earlier training; does nothing to one that was resumed.

        Raises:
            WeightsError: they are of another network.
        """
        if self.step == 0:
            fill(self.net, read_file(weights)[0], weights)
            self.mean.load_state_dict(self.net.state_dict())

    def save(self) -> None:
        """Write the state and the averaged weights, atomically."""
        state = {
            "net": self.net.state_dict(), "mean": self.mean.state_dict(),
            "optimiser": self.optimiser.state_dict(), "step": self.step, "spent": self.clock(),
            "shown": self.shown,
        }  # fmt: skip
        torch.save(state, self.out / "state.part")
        (self.out / "state.part").replace(self.out / "state.pt")
        self.export(self.out / "weights.part")
        (self.out / "weights.part").replace(self.out / "weights.safetensors")

    def clock(self) -> float:
        """Seconds that all runs of this training took so far."""
        return self.spent + time.monotonic() - self.began

    def progress(self, step: int) -> float:
        """Share of the schedule that is behind a step, by count or by the clock."""
        c = self.config
        return min(1.0, self.clock() / (60 * c.minutes) if c.minutes else step / c.steps)

    def rate(self) -> float:
        """Cosine from the peak to a fiftieth of it, after a linear warm-up."""
        c = self.config
        t = self.progress(self.step)
        return (
            c.rate
            * min(1.0, (self.step + 1) / c.warmup)
            * (0.02 + 0.98 * (0.5 + 0.5 * math.cos(math.pi * t)))
        )

    def refresh(self) -> None:
        """List the samples anew: more may have been rendered.

        Raises:
            SystemExit: a folder has no more samples than are held out of training.
        """
        self.files = [sorted(folder.glob("*.npz")) for folder in self.data]
        for folder, files in zip(self.data, self.files, strict=True):
            if len(files) <= self.config.held_out:
                raise SystemExit(
                    f"{folder}: {len(files)} samples, and {self.config.held_out} are held out; render more "
                    "with python -m training.dataset"
                )

    def one(self) -> dict[str, float] | None:
        """One optimisation step; None if its gradient was not finite."""
        c = self.config
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate()
        self.optimiser.zero_grad(set_to_none=True)
        loss, figures = self.loss()
        loss.backward()
        self._share()
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), c.clip)
        if not torch.isfinite(norm):
            logger.warning("step %d: gradient is not finite, skipped", self.step)
            return None
        self.optimiser.step()
        decay = min(c.average, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            for a, b in zip(self.mean.parameters(), self.net.parameters(), strict=True):
                a.lerp_(b, 1 - decay)
        return {name: float(value) for name, value in figures.items()}

    def _over(self) -> bool:
        """Whether this step is the last, of the schedule or of this process."""
        late = self.config.stop > 0 and time.monotonic() - self.began >= 60 * self.config.stop
        return late or self.progress(self.step + 1) >= 1

    def _share(self) -> None:
        """Average the gradients over the processes; all stop as soon as one is at the end."""
        self.finished = self._over()
        if not torch.distributed.is_initialized():
            return
        grads = [p.grad if p.grad is not None else torch.zeros_like(p) for p in self.net.parameters()]
        end = torch.tensor([float(self.finished)], device=self.device)
        flat = torch.cat([end, *(g.reshape(-1) for g in grads)]).cpu()
        torch.distributed.all_reduce(flat)
        self.finished = bool(flat[0] > 0)
        flat = flat[1:].to(self.device) / torch.distributed.get_world_size()
        for p, g in zip(self.net.parameters(), flat.split([g.numel() for g in grads]), strict=True):
            p.grad = g.view_as(p)

    def run(self, every: int = 100, validation: int = 500) -> None:
        """Train to the end of the schedule; the first process writes the log and the files."""
        rows: list[dict[str, float]] = []
        start = time.monotonic()
        self.finished = self.progress(self.step) >= 1
        while not self.finished:
            figures = self.one()
            self.step += 1
            if figures is not None:
                rows.append(figures)
            if self.step % every == 0 or self.finished:
                self.refresh()
                if self.rank == 0 and rows:
                    means = {k: float(np.nanmean([r[k] for r in rows])) for k in rows[0]}
                    self.log("train", means, (time.monotonic() - start) / len(rows))
                    self.save()
                rows, start = [], time.monotonic()
            if self.step % validation == 0 and self.rank == 0:
                self.log("valid", self.validate(), 0.0)
                start = time.monotonic()

    def log(self, kind: str, figures: dict[str, float], seconds: float) -> None:
        """Append a line to log.csv and to the log."""
        path = self.out / "log.csv"
        fresh = not path.exists()
        with path.open("a", newline="") as f:
            writer = csv.writer(f)
            if fresh:
                writer.writerow(["step", "kind", *figures, "seconds"])
            writer.writerow([self.step, kind, *(f"{x:.4f}" for x in figures.values()), f"{seconds:.3f}"])
        text = " ".join(f"{k} {v:.3f}" for k, v in figures.items())
        logger.info("%d %s %s (%.2f s a step)", self.step, kind, text, seconds)


def arguments(description: str, plain: LoopConfig) -> argparse.ArgumentParser:
    """A parser with what all trainings share."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="folders, the largest size last")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=plain.steps)
    parser.add_argument("--rate", type=float, default=plain.rate)
    parser.add_argument("--minutes", type=float, default=plain.minutes)
    parser.add_argument("--sizes", type=Path, help="JSON of the configuration's sizes")
    parser.add_argument("--seed", type=int, default=plain.seed, help="of what is drawn")
    parser.add_argument("--threads", type=int, default=1, help="of each process")
    parser.add_argument("--device", default="cpu", help="cuda: several workers keep one GPU busy")
    parser.add_argument("--init", type=Path, help="weights to start from")
    return parser


def configured(plain: _Config, args: argparse.Namespace) -> _Config:
    """The configuration with all that the command line says of its fields; sizes are read from their file."""
    given = {f.name: getattr(args, f.name) for f in fields(plain) if hasattr(args, f.name)}
    sizes = given.pop("sizes")
    if sizes is not None:
        given["sizes"] = tuple(tuple(s) for s in json.loads(sizes.read_text()))
    return replace(plain, **given)


def launch(build: Callable[[int], Loop], args: argparse.Namespace, workers: int = 1) -> None:
    """Run a training in so many processes; ``build`` makes the one of a rank, and can be pickled."""
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "meeting").unlink(missing_ok=True)
    if workers > 1:
        torch.multiprocessing.spawn(work, (build, args, workers), workers)
    else:
        work(0, build, args, workers)


def work(rank: int, build: Callable[[int], Loop], args: argparse.Namespace, workers: int) -> None:
    """One of the processes."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(args.threads)
    if workers > 1:
        torch.distributed.init_process_group(
            "gloo", f"file://{(args.out / 'meeting').resolve()}", rank=rank, world_size=workers,
            timeout=timedelta(hours=1),
        )  # fmt: skip
    trainer = build(rank)
    if args.init is not None:
        trainer.start_from(args.init)
    trainer.run()
