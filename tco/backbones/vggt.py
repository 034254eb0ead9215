"""VGGT, Visual Geometry Grounded Transformer (Wang et al. 2025), as a backbone that predicts its cameras.

:class:`VGGTNetwork` is the published network with the published names; :class:`VGGT` makes it a
:class:`tco.backbones.base.Backbone`. Depth is camera z, the world is the first view's camera (up to the
network's error), and the scale is the network's own. Its intrinsics are fields of view of a centred camera,
so they hold for any convention of pixel centres; only its published unprojection assumes integer centres,
and that is not used here.

:func:`tco.backbones.compiling.compiled` applies ``torch.compile`` to the blocks.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from tco.backbones.checkpoints import load_network
from tco.backbones.dinov2 import PATCH, DINOv2, Patches, ViTConfig, normalized, patch_grid
from tco.backbones.prefix import Passed, first_block
from tco.backbones.transformer import (
    Block,
    Rotary,
    compute_dtype,
    computing,
    rotary,
    run_block,
    store_products,
)
from tco.backbones.vggt_heads import CameraHead, DPTHead, cameras, depth_of, points_of
from tco.types import Prediction, Priors, SparseDepth, Views

SKIPPED = ("track_head.",)
"""Prefixes of published weights that are not used: the head that tracks points."""


@dataclass(frozen=True)
class VGGTConfig:
    """Sizes of the network.

    Attributes:
        encoder: of the patch encoder.
        channels, depth, heads: of the aggregator; each depth is a block per view and a block over all views.
        registers: tokens of each view beside its camera token.
        camera_depth, camera_heads: of the trunk of the camera head.
        features, levels: channels of the dense heads, after and before the fusion.
        layers: depths whose tokens the dense heads read; the camera head reads the last depth.
        points: whether there is a head for points in the world, which nothing here is made of.
    """

    encoder: ViTConfig = field(default_factory=ViTConfig.vitl14)
    channels: int = 1024
    depth: int = 24
    heads: int = 16
    registers: int = 4
    camera_depth: int = 4
    camera_heads: int = 16
    features: int = 256
    levels: tuple[int, int, int, int] = (256, 512, 1024, 1024)
    layers: tuple[int, int, int, int] = (4, 11, 17, 23)
    points: bool = True

    @classmethod
    def vggt_1b(cls) -> VGGTConfig:
        """The published VGGT-1B."""
        return cls()


@dataclass(frozen=True)
class Features:
    """What the heads read.

    Attributes:
        camera: (V, 2 C) camera tokens of all views.
        dense: patch tokens (V', P, 2 C) of the chosen views, at four depths.
        last: (V', 1 + registers + P, 2 C) all tokens of the chosen views at the last depth.
    """

    camera: Tensor
    dense: tuple[Tensor, ...]
    last: Tensor


class Aggregator(nn.Module):
    """Patch encoder, then attention within each view and over all views in turn."""

    def __init__(self, config: VGGTConfig) -> None:
        super().__init__()
        self.config = c = config
        self.camera_token = nn.Parameter(torch.zeros(1, 2, 1, c.channels))
        self.register_token = nn.Parameter(torch.zeros(1, 2, c.registers, c.channels))
        self.patch_embed = DINOv2(c.encoder)
        self.frame_blocks = nn.ModuleList(Block(c.channels, c.heads, qk_norm=True) for _ in range(c.depth))
        self.global_blocks = nn.ModuleList(Block(c.channels, c.heads, qk_norm=True) for _ in range(c.depth))

    def blocks(self) -> nn.ModuleDict:
        """The blocks after the patch encoder."""
        return nn.ModuleDict({"frame_blocks": self.frame_blocks, "global_blocks": self.global_blocks})

    def special(self, views: int) -> Tensor:
        """Camera and register tokens (V, 1 + registers, C): the first view has its own, which makes it
        the reference."""
        both = torch.cat([self.camera_token, self.register_token], 2)[0]
        return torch.cat([both[:1], both[1:].expand(views - 1, -1, -1)])

    def forward(
        self,
        patches: Tensor,
        grid: tuple[int, int],
        chosen: Sequence[int],
        recompute: range = range(0),
        scenes: int = 1,
        passed: Passed | None = None,
    ) -> Features:
        """Aggregate patch tokens.

        Args:
            patches: (V, P, C).
            grid: rows and columns of patches.
            chosen: V' views that the dense heads need.
            recompute: depths whose activations are computed again in the backward pass.
            scenes: as many scenes of equally many views, one after the other in V; views attend to those
                of their own scene alone.
            passed: what :meth:`ahead` made of these tokens.
        """
        c, views = self.config, len(patches) // scenes
        passed = passed or self._begun(patches, scenes)
        x = frame = passed.tokens
        own = rotary(grid, 1 + c.registers, c.channels // c.heads, x.device)
        common = own.repeated(views)
        index = torch.tensor(list(chosen), device=x.device)
        both = {i: kept[index] for i, kept in passed.kept.items()}
        for i in range(passed.depth, c.depth):
            frame = run_block(self.frame_blocks[i], x, own, i in recompute)
            x = self._over_all(i, frame.unflatten(0, (scenes, views)), common, i in recompute)
            if i in c.layers or i == c.depth - 1:
                both[i] = torch.cat([frame[index], x[index]], -1)
        dense = tuple(both[i][:, 1 + c.registers :] for i in c.layers)
        return Features(torch.cat([frame[:, 0], x[:, 0]], -1), dense, both[c.depth - 1])

    def ahead(self, patches: Tensor, grid: tuple[int, int], depth: int) -> Passed:
        """Pass the first depths, fewer than all, with the patch tokens (V, P, C) of one scene."""
        c, start = self.config, self._begun(patches, 1)
        x, kept = start.tokens, {}
        own = rotary(grid, 1 + c.registers, c.channels // c.heads, x.device)
        common = own.repeated(len(patches))
        for i in range(depth):
            frame = self.frame_blocks[i](x, own)
            x = self._over_all(i, frame.unsqueeze(0), common, False)
            if i in c.layers:
                kept[i] = torch.cat([frame, x], -1)
        return Passed(depth, x, kept)

    def _begun(self, patches: Tensor, scenes: int) -> Passed:
        """Camera, register and patch tokens, before the first block."""
        special = self.special(len(patches) // scenes).repeat(scenes, 1, 1)
        return Passed(0, torch.cat([special, patches], 1))

    def _over_all(self, i: int, x: Tensor, common: Rotary, recompute: bool) -> Tensor:
        every = run_block(self.global_blocks[i], x.flatten(1, 2), common, recompute)
        return every.view(-1, *x.shape[2:])


class VGGTNetwork(nn.Module):
    """The published network without its track head; names and shapes of the state dict are the published.

    Other sizes, other patches and no head for points are for networks of one's own.
    """

    def __init__(self, config: VGGTConfig) -> None:
        super().__init__()
        self.config = c = config
        self.aggregator = Aggregator(c)
        self.camera_head = CameraHead(2 * c.channels, c.camera_heads, c.camera_depth)
        patch = c.encoder.patch
        self.point_head = DPTHead(2 * c.channels, c.features, c.levels, 4, patch) if c.points else None
        self.depth_head = DPTHead(2 * c.channels, c.features, c.levels, 2, patch)


def products(network: VGGTNetwork) -> list[nn.Module]:
    """The blocks, whose matrix products are taken in the type of the device."""
    a = network.aggregator
    return [a.patch_embed.blocks, a.frame_blocks, a.global_blocks]


class VGGT(nn.Module):
    """The backbone; satisfies :class:`tco.backbones.base.Backbone`."""

    name = "vggt"
    stride = PATCH
    uses_cameras = False

    def __init__(
        self, network: VGGTNetwork, dtype: torch.dtype = torch.float32, recompute: range = range(0)
    ) -> None:
        """Wrap a network.

        Args:
            network: with its weights; its blocks are converted to ``dtype``.
            dtype: float32 or bfloat16, of the matrix products of all blocks; the heads are float32.
            recompute: depths of the aggregator whose activations are computed again in the backward
                pass, for a third more time: with adapters, a view of 518×392 keeps 73 MB a block in
                float32 without it, 4 MB with it. The attribute can be set at any time.
        """
        super().__init__()
        self.network, self.dtype, self.recompute = network, dtype, recompute
        store_products(products(network), dtype)
        self.stride = network.config.encoder.patch

    def decoder(self) -> nn.Module:
        """The frame and global blocks."""
        return self.network.aggregator.blocks()

    @torch.no_grad()
    def encode(self, views: Views, priors: Priors) -> Patches:
        """Patch tokens of all views; no prior is used.

        Raises:
            ValueError: no views, or a canvas that is not divisible into patches.
        """
        grid = patch_grid(views, self.stride)
        with computing(views.images.device, self.dtype):
            tokens = self.network.aggregator.patch_embed(normalized(views.images), grid)
        return Patches(tokens, grid, views.valid, self.stride)

    def with_points(self, encoded: Patches, points: Mapping[int, SparseDepth]) -> Patches:
        """The same features: this network takes no points."""
        return encoded

    @torch.no_grad()
    def ahead(self, encoded: Patches, changed: Collection[str]) -> Patches:
        """The same, with the depths before the first that changes behind it; the last is always ahead."""
        count = self.network.config.depth
        depth = min(first_block(changed, count), count - 1)
        with computing(encoded.tokens.device, self.dtype):
            passed = self.network.aggregator.ahead(encoded.tokens, encoded.grid, depth)
        return replace(encoded, passed=passed)

    def features(self, encoded: Patches, views: Sequence[int]) -> Features:
        """What the heads read, for the chosen views."""
        with computing(encoded.tokens.device, self.dtype):
            return self.network.aggregator(
                encoded.tokens, encoded.grid, views, self.recompute, passed=encoded.passed
            )

    def decode(
        self, encoded: Patches, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        """Depth and confidence of some views, cameras of all; the context is not used."""
        chosen = tuple(range(len(encoded))) if views is None else tuple(views)
        features = self.features(encoded, chosen)
        with computing(encoded.tokens.device, torch.float32):
            pose = self.network.camera_head(features.camera)[-1]
            depth, confidence = depth_of(self.network.depth_head(features.dense, encoded.grid))
        return Prediction(depth, confidence, cameras(pose, encoded.size), chosen)

    def points(self, encoded: Patches, views: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Points (V', H, W, 3) in the world of the first view, and their confidence (V', H, W).

        Raises:
            ValueError: the network has no head for points.
        """
        if self.network.point_head is None:
            raise ValueError(f"{self.name} has no head for points")
        features = self.features(encoded, views)
        with computing(encoded.tokens.device, torch.float32):
            return points_of(self.network.point_head(features.dense, encoded.grid))


def load(
    path: Path,
    device: torch.device | str = "cpu",
    dtype: torch.dtype | None = None,
    recompute: range = range(0),
) -> VGGT:
    """VGGT with the weights of a file, frozen and in evaluation mode.

    The sizes are those in the file's metadata where it has any (:func:`tco.backbones.checkpoints.save`),
    else those of VGGT-1B.

    Args:
        path: the authors' checkpoint, safetensors or PyTorch's format.
        device: where it runs.
        dtype: of the matrix products; None: what the device multiplies fastest.
        recompute: see :class:`VGGT`.

    Raises:
        WeightsError: the file is missing, damaged, or of another network.
    """
    place = torch.device(device)
    dtype = dtype or compute_dtype(place)
    network = load_network(path, VGGTNetwork, VGGTConfig.vggt_1b(), SKIPPED, (products, dtype))
    return VGGT(network, dtype, recompute).eval().requires_grad_(False).to(place)
