"""Train the embedded network on rendered samples; stops and resumes at any time.

``python -m training.train --data runs/data --out runs/sweep`` writes ``state.pt`` (everything, to
resume), ``weights.safetensors`` (moving average, what the package ships) and ``log.csv``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor

from tco.backbones.decoder import SweepConfig
from tco.backbones.sweep import Encoded, Stage, Sweep
from tco.backbones.sweeping import BACKGROUND
from tco.hints import further_points, with_more
from tco.options import TCOConfig
from tco.types import Priors, Views
from training.dataset import load
from training.loop import Loop, LoopConfig, arguments, configured, launch

CONTRAST = 10.0
"""Factor by which the pictures' local contrast may be raised."""

Drawn = tuple[tuple[Views, Priors, Tensor], np.random.Generator]


@dataclass(frozen=True)
class TrainConfig(LoopConfig):
    """Everything that decides the result.

    Attributes:
        share: of the samples that have the size reached last; the others keep the size before.
        refined: views a step whose refinement is trained; all views train the coarse stage.
        told: share of the samples with what their views agree on as further points (:mod:`tco.hints`), which
            are the network's own, with its own mistakes.
    """

    share: float = 0.75
    refined: int = 3
    told: float = 0.5


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


def with_sky(depth: Tensor, encoded: Encoded) -> tuple[Tensor, Tensor]:
    """Depth (V, H, W) with the sky, where it is 0, and what is as far put at the end of the sweep.

    The second (V, 1, 1) is the inverse depth ``BACKGROUND``, below which is the background.
    """
    end = 1 / encoded.lo.view(-1, 1, 1)
    return torch.where(depth > 0, depth, end).minimum(end), BACKGROUND * encoded.lo.view(-1, 1, 1)


def fine_loss(stage: Stage, truth: Tensor, floor: Tensor) -> Tensor:
    """Laplace likelihood of the relative error and a clipped relative L1.

    Errors of inverse depths below ``floor`` (V, 1, 1) are relative to that.
    """
    known = truth > 0
    error = (stage.inverse - truth).abs() / truth.maximum(floor)
    log_b = stage.log_error.clamp(math.log(3e-3), 0.0)
    likelihood = error.clamp_max(0.5) * (-log_b).exp() + log_b
    return ((likelihood + 8 * error.clamp_max(0.25)) * known).sum() / known.sum().clamp_min(1)


def slope_loss(stage: Stage, truth: Tensor, floor: Tensor) -> Tensor:
    """Mean absolute difference of the slopes of log-depth at spacings of 1, 2 and 4 pixels, clipped.

    Flat surfaces stay flat and edges sharp: an offset common to neighbours costs nothing here. What is
    farther than ``floor`` (V, 1, 1) has no slope.
    """
    known = truth > floor
    off = torch.where(known, stage.inverse.log() - truth.clamp_min(1e-6).log(), torch.zeros_like(truth))
    total = off.new_zeros(())
    for s in (1, 2, 4):
        for dim in (1, 2):
            n = off.shape[dim] - s
            both = known.narrow(dim, 0, n) & known.narrow(dim, s, n)
            slope = (off.narrow(dim, s, n) - off.narrow(dim, 0, n)).abs().clamp_max(0.2)
            total = total + (slope * both).sum() / both.sum().clamp_min(1)
    return total


@torch.no_grad()
def with_agreed(net: Sweep, encoded: Encoded, views: Views, priors: Priors, seed: int) -> Encoded:
    """The features with what all views agree on as further points, as in a run of eight views or more."""
    assert priors.sparse is not None
    more = further_points(net.draft(encoded), views, priors, TCOConfig(), seed)
    told: Encoded = with_more(net, encoded, priors.sparse, more)
    return told


def losses(
    net: Sweep, sample: tuple, refined: list[int], sources: int, told: int | None = None
) -> tuple[Tensor, dict[str, float]]:
    """Total loss of one sample, and figures for the log; ``told``, if any, is the seed of further points."""
    views, priors, depth = sample
    encoded = net.encode(views, priors, sources)
    if told is not None:
        encoded = with_agreed(net, encoded, views, priors, told)
    first = net.coarse(encoded, range(len(views)))
    depth, floor = with_sky(depth, encoded)
    total = coarse_loss(first, encoded, pooled(depth, 4))
    world = first.detached().doubled()
    stage = first[torch.tensor(refined, device=depth.device)]
    figures = {"coarse": float(total.detach())}
    for k in range(len(net.config.spacing)):
        stage = net.refine(k, encoded, refined, stage, world)
        last = k + 1 == len(net.config.spacing)
        truth = pooled(depth[refined], 1 if last else 2)
        term = fine_loss(stage, truth, floor[refined]) + 2 * slope_loss(stage, truth, floor[refined])
        total = total + (1.0 if last else 0.5) * term
        if not last:
            inverse, error = world.inverse.clone(), world.log_error.clone()
            inverse[refined], error[refined] = stage.inverse.detach(), stage.log_error.detach()
            world = Stage(inverse, error)
    surface = truth > floor[refined]
    off = (stage.inverse / truth - 1).abs()[surface]
    figures.update(
        fine=float(term.detach()),
        d2=float((off < 0.02).float().mean()),
        d5=float((off < 0.05).float().mean()),
        sky=float((stage.inverse < floor[refined])[~surface].float().mean())
        if (~surface).any()
        else math.nan,
    )
    return total, figures


class Trainer(Loop):
    """Training of the embedded network; a sample a step and process."""

    config: TrainConfig
    net: Sweep
    mean: Sweep

    def __init__(
        self, config: TrainConfig, data: Sequence[Path], out: Path, rank: int = 0, device: str = "cpu"
    ) -> None:
        self.ahead = ThreadPoolExecutor(1)
        self.next: tuple[int, Future[Drawn]] | None = None
        super().__init__(config, data, out, rank, device)

    def network(self) -> Sweep:
        """The embedded network."""
        return Sweep(SweepConfig(equalise=CONTRAST))

    def export(self, path: Path) -> None:
        """Write the averaged weights with the sizes of the network."""
        info = {"config": json.dumps(self.mean.metadata()), "steps": str(self.step)}
        save_file({k: v.contiguous().cpu() for k, v in self.mean.state_dict().items()}, path, info)

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

    def loss(self) -> tuple[Tensor, Mapping[str, float]]:
        """Loss of this step's sample, with some views refined and some of the others as sources."""
        sample, rng = self.drawn()
        self.shown += 1
        refined = sorted(rng.choice(len(sample[0]), self.config.refined, replace=False).tolist())
        sources = int(rng.integers(2, len(sample[0])))
        told = int(rng.integers(2**31)) if rng.random() < self.config.told else None
        return losses(self.net, sample, refined, sources, told)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Mean figures of the averaged weights on the held-out samples."""
        rows = []
        for path in (f for files in self.files for f in files[: self.config.held_out]):
            sample = load(path, 7, (96, 128))
            if sample is not None:
                moved = tuple(x.to(self.device) for x in sample)
                rows.append(losses(self.mean, moved, [0, 3], 5)[1])
        return {k: float(np.nanmean([r[k] for r in rows])) for k in rows[0]}


def trainer(config: TrainConfig, data: Sequence[Path], out: Path, device: str, rank: int) -> Trainer:
    """The training of one process."""
    return Trainer(config, data, out, rank, device)


def main() -> None:
    """Command line of the trainer."""
    parser = arguments(__doc__ or "", TrainConfig())
    parser.add_argument("--share", type=float, default=TrainConfig.share, help="of the size reached last")
    parser.add_argument("--told", type=float, default=TrainConfig.told, help="of what views agree on")
    parser.add_argument("--workers", type=int, default=2, help="processes that share each step")
    args = parser.parse_args()
    config = configured(TrainConfig(), args)
    launch(partial(trainer, config, args.data, args.out, args.device), args, args.workers)


if __name__ == "__main__":
    main()
