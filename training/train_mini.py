"""Train the image-only network ``mini`` on rendered samples; stops and resumes at any time.

``python -m training.train_mini --data runs/mini/data --out runs/mini/out`` writes what :mod:`training.loop`
says. It is made for one process on one GPU, which holds all samples; the pictures of a batch are as many as
``--pixels`` allow. ``benchmarks/gpu/train_mini.py`` renders beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tco.backbones.checkpoints import load_network
from tco.backbones.mini import MINI, fresh, write
from tco.backbones.transformer import compute_dtype
from tco.backbones.vggt import VGGTConfig, VGGTNetwork
from training.loop import Loop, LoopConfig, arguments, configured, launch
from training.pool import Held, Pool, gathered, hold
from training.supervision import losses


@dataclass(frozen=True)
class MiniConfig(LoopConfig):
    """Everything that decides the result.

    Attributes:
        network: sizes of the network.
        views: fewest and most views of a scene; the number is drawn for each batch.
        pixels: of all pictures of a batch.
        shape: (H, W) at which samples are held, the largest of ``sizes``.
    """

    steps: int = 20_000
    rate: float = 6e-4
    warmup: int = 500
    sizes: tuple[tuple[float, int, int], ...] = ((0.0, 96, 128), (0.7, 144, 192))
    average: float = 0.999
    weight_decay: float = 0.05
    clip: float = 1.0
    network: VGGTConfig = MINI
    views: tuple[int, int] = (2, 8)
    pixels: int = 256 * 96 * 128
    shape: tuple[int, int] = (144, 192)


class MiniTrainer(Loop):
    """Training of ``mini``; a batch of scenes a step."""

    config: MiniConfig
    net: VGGTNetwork
    mean: VGGTNetwork

    def __init__(
        self, config: MiniConfig, data: Sequence[Path], out: Path, rank: int = 0, device: str = "cpu"
    ) -> None:
        place = torch.device(device)
        self.dtype = compute_dtype(place) if place.type == "cuda" else torch.float32
        self.pool = Pool(config.shape, place)
        self.held_out: list[Held] = []
        super().__init__(config, data, out, rank, device)

    def network(self) -> VGGTNetwork:
        """A fresh network."""
        return fresh(self.config.network, self.config.seed)

    def start_from(self, weights: Path) -> None:
        """Take the weights of a file that :func:`tco.backbones.mini.write` wrote.

        Raises:
            WeightsError: they are of another network.
        """
        if self.step == 0:
            tensors = load_network(weights, VGGTNetwork, self.config.network).state_dict()
            self.net.load_state_dict(tensors)
            self.mean.load_state_dict(tensors)

    def export(self, path: Path) -> None:
        """Write the averaged weights in half precision."""
        write(path, self.mean)

    def refresh(self) -> None:
        """List the samples anew and take those in that are; those held out are the first that there were."""
        super().refresh()
        c = self.config
        if not self.held_out:
            kept = [file for files in self.files for file in files[: c.held_out]]
            self.held_out = [hold(file, c.shape, self.device) for file in kept]
            self.pool.seen.update(kept)
        self.pool.extend(file for files in self.files for file in files)

    def loss(self) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of this step's batch."""
        c = self.config
        rng = np.random.default_rng((c.seed, self.step, self.rank))
        _, height, width = [s for s in c.sizes if s[0] <= self.progress(self.step)][-1]
        least, most = c.views
        views = int(rng.integers(least, min(most, self.pool.most) + 1))
        batch = self.pool.draw(rng, views, c.pixels, (height, width))
        self.shown += len(batch.images)
        return losses(self.net, batch, self.dtype)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Mean figures of the averaged weights on the held-out samples, all their views, as rendered."""
        rows = []
        for sample in self.held_out:
            batch = gathered([sample], [range(len(sample))], self.config.shape)
            rows.append({k: float(v) for k, v in losses(self.mean, batch, self.dtype)[1].items()})
        return {k: float(np.mean([r[k] for r in rows])) for k in rows[0]}


def trainer(config: MiniConfig, data: Sequence[Path], out: Path, device: str, rank: int) -> MiniTrainer:
    """The training of one process."""
    return MiniTrainer(config, data, out, rank, device)


def main() -> None:
    """Command line of the trainer."""
    plain = MiniConfig()
    parser = arguments(__doc__ or "", plain)
    parser.add_argument("--stop", type=float, default=plain.stop, help="minutes after which this run stops")
    parser.add_argument("--pixels", type=int, default=plain.pixels, help="of all pictures of a batch")
    args = parser.parse_args()
    config = configured(plain, args)
    if args.sizes is not None:
        config = replace(config, shape=config.sizes[-1][1:])
    launch(partial(trainer, config, args.data, args.out, args.device), args)


if __name__ == "__main__":
    main()
