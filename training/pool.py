"""Rendered samples held in the memory of the device that trains, and batches drawn from them.

Reading, decoding and blurring pictures on 16 processor cores gives some hundred samples a second; a small
network on a large GPU sees more. So pictures stay on the device as bytes and what a camera does to them is
computed there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from training.dataset import read, resized
from training.supervision import Scenes

Rng = np.random.Generator


@dataclass(frozen=True)
class Held:
    """One sample of V views.

    Attributes:
        images: (V, 3, H, W) uint8, on the device.
        depth: (V, H, W) half precision, on the device, in units of its median, 0 where unknown.
        world_from_cam: (V, 4, 4), in the same unit, and K: (V, 3, 3); on the CPU.
    """

    images: Tensor
    depth: Tensor
    world_from_cam: Tensor
    K: Tensor

    def __len__(self) -> int:
        return len(self.K)


def hold(path: Path, shape: tuple[int, int], device: torch.device) -> Held:
    """A sample from disk at a size (H, W)."""
    s = resized(read(path), shape)
    unit = float(np.median(s.depth[s.depth > 0]))
    pose = np.linalg.inv(s.cam_from_world.astype(np.float64))
    pose[:, :3, 3] /= unit
    return Held(
        torch.from_numpy(np.ascontiguousarray(s.images.transpose(0, 3, 1, 2))).to(device),
        torch.from_numpy((s.depth / unit).astype(np.float16)).to(device),
        torch.from_numpy(pose.astype(np.float32)),
        torch.from_numpy(s.K),
    )


class Pool:
    """Samples of one size, which may grow while batches are drawn.

    Attributes:
        samples: those that are there.
        most: views of the largest.
    """

    def __init__(self, shape: tuple[int, int], device: torch.device, threads: int = 4) -> None:
        self.shape, self.device = shape, device
        self.samples: list[Held] = []
        self.views = np.zeros(0, int)
        self.seen: set[Path] = set()
        self.readers, self.ahead = ThreadPoolExecutor(threads), ThreadPoolExecutor(1)
        self.coming: Future[list[Held]] | None = None

    @property
    def most(self) -> int:
        """Views of the sample that has most."""
        return int(self.views.max())

    def extend(self, files: Iterable[Path]) -> None:
        """Add samples: the first ones now, later ones as soon as they are read, between two calls of this."""
        if self.coming is not None:
            if not self.coming.done():
                return
            self._add(self.coming.result())
            self.coming = None
        new = [file for file in files if file not in self.seen]
        self.seen.update(new)
        if new and self.samples:
            self.coming = self.ahead.submit(self._read, new)
        elif new:
            self._add(self._read(new))

    def _read(self, files: Sequence[Path]) -> list[Held]:
        return list(self.readers.map(lambda file: hold(file, self.shape, self.device), files))

    def _add(self, more: Sequence[Held]) -> None:
        self.samples = [*self.samples, *more]
        self.views = np.array([len(sample) for sample in self.samples])

    def draw(self, rng: Rng, views: int, pixels: int, size: tuple[int, int]) -> Scenes:
        """A batch of so many views a scene, as many scenes as ``pixels`` allow, at a size (H, W).

        Of each scene some views in any order: so any can be the reference.
        """
        count = max(1, pixels // (views * size[0] * size[1]))
        fits = np.flatnonzero(self.views >= views)
        chosen = [self.samples[i] for i in rng.choice(fits, count, replace=count > len(fits))]
        orders = [rng.permutation(len(sample))[:views].tolist() for sample in chosen]
        batch = gathered(chosen, orders, size)
        batch = mirrored(batch) if rng.random() < 0.5 else batch
        return Scenes(photographed(batch.images, rng), batch.depth, batch.world_from_cam, batch.K)


def gathered(samples: Sequence[Held], orders: Sequence[Sequence[int]], size: tuple[int, int]) -> Scenes:
    """Views of samples as one batch at a size (H, W): pictures averaged, depths of the nearest pixel."""
    pairs = [(s, i) for s, order in zip(samples, orders, strict=True) for i in order]
    device = samples[0].images.device
    images = torch.stack([s.images[i] for s, i in pairs]).float() / 255
    depth = torch.stack([s.depth[i] for s, i in pairs]).float()
    poses = torch.stack([s.world_from_cam[list(o)] for s, o in zip(samples, orders, strict=True)])
    K = torch.stack([s.K[list(o)] for s, o in zip(samples, orders, strict=True)])
    height, width = depth.shape[1:]
    if size != (height, width):
        images = F.interpolate(images, size, mode="bilinear", antialias=True)
        rows = ((torch.arange(size[0], device=device) + 0.5) * height / size[0]).long()
        columns = ((torch.arange(size[1], device=device) + 0.5) * width / size[1]).long()
        depth = depth[:, rows[:, None], columns]
        K = K * torch.tensor([[size[1] / width], [size[0] / height], [1.0]])
    shape = (len(samples), len(orders[0]))
    return Scenes(images.unflatten(0, shape), depth.unflatten(0, shape), poses.to(device), K.to(device))


def mirrored(scenes: Scenes) -> Scenes:
    """The mirror images of all scenes: every left is a right."""
    mirror = torch.diag(scenes.K.new_tensor([-1.0, 1.0, 1.0, 1.0]))
    K = scenes.K.clone()
    K[..., 0, 2] = scenes.size[1] - K[..., 0, 2]
    return Scenes(scenes.images.flip(-1), scenes.depth.flip(-1), mirror @ scenes.world_from_cam @ mirror, K)


def photographed(images: Tensor, rng: Rng) -> Tensor:
    """What cameras would add: exposure and white balance a view, tone curve and saturation a scene, noise.

    The order of the colour channels is drawn, too: materials have any hue. Pictures are (B, V, 3, H, W) in
    [0, 1]; :func:`training.photo.photographed` has more of all this, on the CPU.
    """
    b, v = images.shape[:2]

    def drawn(spread: float, *shape: int) -> Tensor:
        return torch.from_numpy(np.exp(rng.normal(0, spread, shape)).astype(np.float32)).to(images.device)

    x = images[:, :, torch.from_numpy(rng.permutation(3)).to(images.device)]
    x = x * drawn(0.1, b, v, 1, 1, 1) * drawn(0.05, b, v, 3, 1, 1) * drawn(0.2, b, 1, 1, 1, 1)
    grey = x.mean(2, keepdim=True)
    x = grey + drawn(0.3, b, 1, 1, 1, 1).clamp_max(1.3) * (x - grey)
    x = x.clamp(1e-4, 1) ** drawn(0.15, b, 1, 1, 1, 1)
    noise = float(rng.choice([0.0, 0.006, 0.015]))
    if noise:
        generator = torch.Generator(images.device).manual_seed(int(rng.integers(2**31)))
        x = x + noise * torch.randn(x.shape, generator=generator, device=x.device)
    return x.clamp(0, 1)
