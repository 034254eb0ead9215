"""Train the embedded network on rendered samples; stops and resumes at any time.

``python -m training.train --data runs/data --out runs/sweep`` writes ``state.pt`` (everything, to
resume), ``weights.safetensors`` (moving average, what the package ships) and ``log.csv``.
"""

from __future__ import annotations

import argparse
import copy
import csv
import json
import logging
import math
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import torch
import torch.distributed
import torch.multiprocessing
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor

from tco.backbones.sweep import Encoded, Stage, Sweep
from tco.backbones.weights import fill, read_file
from tco.types import Priors, Views
from training.dataset import load

logger = logging.getLogger(__name__)

Drawn = tuple[tuple[Views, Priors, Tensor], np.random.Generator]


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides the result.

    Attributes:
        steps: length of the cosine schedule. rate: peak learning rate. warmup: steps to reach it.
        sizes: (share of the steps after which it starts, H, W) of the samples.
        share: of the samples that have the size reached last; the others keep the size before.
        refined: views a step whose refinement is trained; all views train the coarse stage.
        average: decay of the moving average of the weights.
        minutes: if not 0, the schedule runs by the clock and ends after so long, whatever ``steps`` says;
            where a machine is lent for a time. Such a training does not repeat to the last bit.
        held_out: samples with the lowest numbers, kept for validation.
    """

    steps: int = 3000
    rate: float = 1e-3
    warmup: int = 150
    sizes: tuple[tuple[float, int, int], ...] = ((0.0, 96, 128), (0.6, 144, 192), (0.9, 192, 256))
    share: float = 0.75
    refined: int = 3
    average: float = 0.995
    minutes: float = 0.0
    held_out: int = 16
    seed: int = 0


def pooled(depth: Tensor, factor: int) -> Tensor:
    """Inverse depth (V, h, w), 0 where unknown: the mean where the surface is smooth, else one pixel's."""
    inverse = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), torch.zeros_like(depth)).unsqueeze(1)
    mean = F.avg_pool2d(inverse, factor).squeeze(1)
    top, low = F.max_pool2d(inverse, factor).squeeze(1), -F.max_pool2d(-inverse, factor).squeeze(1)
    middle = inverse[:, 0, factor // 2 :: factor, factor // 2 :: factor]
    return torch.where(top < 1.08 * low, mean, middle)


def coarse_loss(stage: Stage, encoded: Encoded, truth: Tensor) -> Tensor:
    """Cross-entropy over planes, linear between the two nearest, and a clipped L1 on the index.

    What lies outside the sweep belongs to its first or last plane.
    """
    assert stage.scores is not None
    lo, step = encoded.lo.view(-1, 1, 1), encoded.step.view(-1, 1, 1)
    planes = stage.scores.shape[1]
    known = truth > 0
    index = ((truth - lo) / step).clamp(0, planes - 1.001)
    below = index.floor().long()
    part = index - below
    logp = stage.scores.log_softmax(1)
    entropy = -(1 - part) * logp.gather(1, below.unsqueeze(1)).squeeze(1)
    entropy = entropy - part * logp.gather(1, below.unsqueeze(1) + 1).squeeze(1)
    off = ((stage.inverse - lo) / step - index).abs().clamp_max(4)
    return ((entropy + 0.3 * off) * known).sum() / known.sum().clamp_min(1)


def fine_loss(stage: Stage, truth: Tensor) -> Tensor:
    """Laplace likelihood of the relative error and a clipped relative L1."""
    known = truth > 0
    error = (stage.inverse / truth.clamp_min(1e-6) - 1).abs()
    log_b = stage.log_error.clamp(math.log(3e-3), 0.0)
    likelihood = error.clamp_max(0.5) * (-log_b).exp() + log_b
    return ((likelihood + 8 * error.clamp_max(0.25)) * known).sum() / known.sum().clamp_min(1)


def slope_loss(stage: Stage, truth: Tensor) -> Tensor:
    """Mean absolute difference of the slopes of log-depth at spacings of 1, 2 and 4 pixels, clipped.

    Flat surfaces stay flat and edges sharp: an offset common to neighbours costs nothing here.
    """
    known = truth > 0
    off = torch.where(known, stage.inverse.log() - truth.clamp_min(1e-6).log(), torch.zeros_like(truth))
    total = off.new_zeros(())
    for s in (1, 2, 4):
        for dim in (1, 2):
            n = off.shape[dim] - s
            both = known.narrow(dim, 0, n) & known.narrow(dim, s, n)
            slope = (off.narrow(dim, s, n) - off.narrow(dim, 0, n)).abs().clamp_max(0.2)
            total = total + (slope * both).sum() / both.sum().clamp_min(1)
    return total


def losses(net: Sweep, sample: tuple, refined: list[int], sources: int) -> tuple[Tensor, dict[str, float]]:
    """Total loss of one sample, and figures for the log."""
    views, priors, depth = sample
    encoded = net.encode(views, priors, sources)
    first = net.coarse(encoded, range(len(views)))
    total = coarse_loss(first, encoded, pooled(depth, 4))
    world = first.detached().doubled()
    stage = first[torch.tensor(refined, device=depth.device)]
    figures = {"coarse": float(total.detach())}
    for k in range(len(net.config.spacing)):
        stage = net.refine(k, encoded, refined, stage, world)
        last = k + 1 == len(net.config.spacing)
        truth = pooled(depth[refined], 1 if last else 2)
        term = fine_loss(stage, truth) + 2 * slope_loss(stage, truth)
        total = total + (1.0 if last else 0.5) * term
        if not last:
            inverse, error = world.inverse.clone(), world.log_error.clone()
            inverse[refined], error[refined] = stage.inverse.detach(), stage.log_error.detach()
            world = Stage(inverse, error)
    known = truth > 0
    off = (stage.inverse / truth.clamp_min(1e-6) - 1).abs()[known]
    figures.update(
        fine=float(term.detach()),
        d2=float((off < 0.02).float().mean()),
        d5=float((off < 0.05).float().mean()),
    )
    return total, figures


class Trainer:
    """Network, its moving average, optimiser and step count; saved and restored as one file.

    Several processes, one thread each, take a sample each and average their gradients: on a CPU two
    threads in one process wait for each other longer than they gain.
    """

    def __init__(
        self, config: TrainConfig, data: Sequence[Path], out: Path, rank: int = 0, device: str = "cpu"
    ) -> None:
        self.config, self.data, self.out, self.rank = config, list(data), out, rank
        self.device = torch.device(device)
        self.began = time.monotonic()
        self.finished = False
        self.ahead = ThreadPoolExecutor(1)
        self.next: tuple[int, Future[Drawn]] | None = None
        torch.manual_seed(config.seed)
        self.net = Sweep().to(self.device)
        self.mean = copy.deepcopy(self.net).eval()
        self.optimiser = torch.optim.AdamW(self.net.parameters(), config.rate, weight_decay=1e-4)
        self.step = 0
        self.refresh()
        out.mkdir(parents=True, exist_ok=True)
        if (out / "state.pt").exists():
            state = torch.load(out / "state.pt", map_location=self.device, weights_only=True)
            self.net.load_state_dict(state["net"])
            self.mean.load_state_dict(state["mean"])
            self.optimiser.load_state_dict(state["optimiser"])
            self.step = int(state["step"])
            logger.info("resumed at step %d", self.step)

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
            "optimiser": self.optimiser.state_dict(), "step": self.step,
        }  # fmt: skip
        torch.save(state, self.out / "state.part")
        (self.out / "state.part").replace(self.out / "state.pt")
        info = {"config": json.dumps(self.mean.metadata()), "steps": str(self.step)}
        tensors = {k: v.contiguous().cpu() for k, v in self.mean.state_dict().items()}
        save_file(tensors, self.out / "weights.part", info)
        (self.out / "weights.part").replace(self.out / "weights.safetensors")

    def progress(self, step: int) -> float:
        """Share of the schedule that is behind a step, by count or by the clock."""
        c = self.config
        done = (time.monotonic() - self.began) / (60 * c.minutes) if c.minutes else step / c.steps
        return min(1.0, done)

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

    def draw(self, step: int) -> Drawn:
        """A sample for a step of this process, and the generator that drew it.

        The largest size is drawn from the last folder alone, the others evenly from all samples.
        """
        c = self.config
        rng = np.random.default_rng((c.seed, step, self.rank))
        progress = self.progress(step)
        reached = [s for s in c.sizes if s[0] <= progress]
        _, h, w = reached[-1 if rng.random() < c.share else max(-2, -len(reached))]
        largest = (h, w) == tuple(c.sizes[-1][1:])
        files = [f for folder in self.files[-1 if largest else 0 :] for f in folder[c.held_out :]]
        while True:
            sample = load(files[rng.integers(len(files))], int(rng.integers(2**31)), (h, w))
            if sample is not None:
                return sample, rng

    def drawn(self) -> Drawn:
        """The sample of this step; on another device than the CPU the next one is prepared meanwhile."""
        if self.device.type == "cpu":
            return self.draw(self.step)
        if self.next is not None and self.next[0] == self.step:
            (views, priors, depth), rng = self.next[1].result()
        else:
            (views, priors, depth), rng = self.draw(self.step)
        self.next = (self.step + 1, self.ahead.submit(self.draw, self.step + 1))
        return (views.to(self.device), priors.to(self.device), depth.to(self.device)), rng

    def one(self) -> dict[str, float] | None:
        """One optimisation step; None if its gradient was not finite."""
        c = self.config
        sample, rng = self.drawn()
        refined = sorted(rng.choice(len(sample[0]), c.refined, replace=False).tolist())
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate()
        self.optimiser.zero_grad(set_to_none=True)
        loss, figures = losses(self.net, sample, refined, int(rng.integers(2, len(sample[0]))))
        loss.backward()
        self.share()
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), 2.0)
        if not torch.isfinite(norm):
            logger.warning("step %d: gradient is not finite, skipped", self.step)
            return None
        self.optimiser.step()
        decay = min(c.average, (self.step + 1) / (self.step + 10))
        with torch.no_grad():
            for a, b in zip(self.mean.parameters(), self.net.parameters(), strict=True):
                a.lerp_(b, 1 - decay)
        return figures

    def share(self) -> None:
        """Average the gradients over the processes; all stop as soon as one is at the end."""
        self.finished = self.progress(self.step + 1) >= 1
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

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Mean figures of the averaged weights on the held-out samples."""
        rows = []
        for path in (f for files in self.files for f in files[: self.config.held_out]):
            sample = load(path, 7, (96, 128))
            if sample is not None:
                moved = tuple(x.to(self.device) for x in sample)
                rows.append(losses(self.mean, moved, [0, 3], 5)[1])
        return {k: float(np.mean([r[k] for r in rows])) for k in rows[0]}

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
                    means = {k: float(np.mean([r[k] for r in rows])) for k in rows[0]}
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


def work(rank: int, config: TrainConfig, args: argparse.Namespace) -> None:
    """One of the processes."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(args.threads)
    if args.workers > 1:
        torch.distributed.init_process_group(
            "gloo", f"file://{(args.out / 'meeting').resolve()}", rank=rank, world_size=args.workers,
            timeout=timedelta(hours=1),
        )  # fmt: skip
    trainer = Trainer(config, args.data, args.out, rank, args.device)
    if args.init is not None:
        trainer.start_from(args.init)
    trainer.run()


def main() -> None:
    """Command line of the trainer."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="folders, the largest size last")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=TrainConfig.steps)
    parser.add_argument("--rate", type=float, default=TrainConfig.rate)
    parser.add_argument("--minutes", type=float, default=TrainConfig.minutes)
    parser.add_argument("--sizes", type=Path, help="JSON of TrainConfig.sizes")
    parser.add_argument("--share", type=float, default=TrainConfig.share, help="of the size reached last")
    parser.add_argument("--workers", type=int, default=2, help="processes that share each step")
    parser.add_argument("--threads", type=int, default=1, help="of each process")
    parser.add_argument("--device", default="cpu", help="cuda: several workers keep one GPU busy")
    parser.add_argument("--init", type=Path, help="weights to start from")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "meeting").unlink(missing_ok=True)
    config = TrainConfig(steps=args.steps, rate=args.rate, minutes=args.minutes, share=args.share)
    if args.sizes is not None:
        config = replace(config, sizes=tuple(tuple(s) for s in json.loads(args.sizes.read_text())))
    if args.workers > 1:
        torch.multiprocessing.spawn(work, (config, args), args.workers)
    else:
        work(0, config, args)


if __name__ == "__main__":
    main()
