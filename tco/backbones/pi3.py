"""π³, permutation-equivariant visual geometry learning (Wang et al. 2025), as a backbone.

:class:`Pi3Network` is the published network with the published names; :class:`Pi3` makes it a
:class:`tco.backbones.base.Backbone`. No view is the reference: world frame and scale are the network's
own, and only relative poses mean something. Depth is the z of the local point map. The network predicts no
intrinsics: they are a centred pinhole camera whose focal length is recovered from the local point map, or, as
in the published code of TCO, the camera that is fitted to it with a principal point and two focal lengths.

:func:`tco.backbones.compiling.compiled` applies ``torch.compile`` to the blocks.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from tco.backbones.checkpoints import load_network
from tco.backbones.dinov2 import COLOR_MEAN, COLOR_STD, PATCH, DINOv2, Patches, ViTConfig, patch_grid
from tco.backbones.pi3_heads import PixelHead, PoseHead, ViewDecoder, fitted_intrinsics, recovered_focal
from tco.backbones.prefix import Passed, first_block
from tco.backbones.transformer import (
    Block,
    compute_dtype,
    computing,
    rotary,
    run_block,
    store_products,
)
from tco.types import Cameras, Prediction, Priors, SparseDepth, Views


@dataclass(frozen=True)
class Pi3Config:
    """Sizes of the network.

    Attributes:
        encoder: of the patch encoder.
        channels, depth, heads: of the decoder, whose blocks see one view and all views in turn.
        registers: tokens of each view beside its patches.
        hidden, head_depth, head_heads: of the three decoders of single views.
        pose: channels of the pose head.
    """

    encoder: ViTConfig = field(default_factory=lambda: ViTConfig.vitl14(mask_token=False))
    channels: int = 1024
    depth: int = 36
    heads: int = 16
    registers: int = 5
    hidden: int = 1024
    head_depth: int = 5
    head_heads: int = 16
    pose: int = 512

    @classmethod
    def large(cls) -> Pi3Config:
        """The published π³."""
        return cls()


class Pi3Network(nn.Module):
    """The published network; names and shapes of the state dict are the published."""

    image_mean: Tensor
    image_std: Tensor

    def __init__(self, config: Pi3Config) -> None:
        super().__init__()
        self.config = c = config
        self.register_token = nn.Parameter(torch.zeros(1, 1, c.registers, c.channels))
        for name, value in (("image_mean", COLOR_MEAN), ("image_std", COLOR_STD)):
            self.register_buffer(name, torch.tensor(value).view(1, 3, 1, 1))
        self.encoder = DINOv2(c.encoder)
        self.decoder = nn.ModuleList(
            Block(c.channels, c.heads, qk_norm=True, eps=1e-6) for _ in range(c.depth)
        )

        def reader(out: int) -> ViewDecoder:
            return ViewDecoder(2 * c.channels, c.hidden, out, c.head_heads, c.head_depth)

        self.point_decoder, self.point_head = reader(c.hidden), PixelHead(c.hidden, 3)
        self.conf_decoder, self.conf_head = reader(c.hidden), PixelHead(c.hidden, 1)
        self.camera_decoder, self.camera_head = reader(c.pose), PoseHead(c.pose)

    def begun(self, patches: Tensor) -> Passed:
        """Register and patch tokens, before the first block, from patch tokens (V, P, C)."""
        registers = self.register_token[0].expand(len(patches), -1, -1)
        return Passed(0, torch.cat([registers, patches], 1))

    def decoded(self, passed: Passed, grid: tuple[int, int], recompute: range = range(0)) -> Tensor:
        """Tokens (V, registers + P, 2 C) of the last two blocks."""
        last = self.config.depth - 1
        before = self.passing(passed, grid, last, recompute)
        return torch.cat([before.tokens, self.passing(before, grid, last + 1, recompute).tokens], -1)

    def passing(
        self, passed: Passed, grid: tuple[int, int], depth: int, recompute: range = range(0)
    ) -> Passed:
        """Go on to ``depth`` blocks."""
        c, x = self.config, passed.tokens
        own = rotary(grid, c.registers, c.channels // c.heads, x.device)
        common = own.repeated(len(x))
        for i in range(passed.depth, depth):
            block = self.decoder[i]
            if i % 2 == 0:
                x = run_block(block, x, own, i in recompute)
            else:
                x = run_block(block, x.flatten(0, 1).unsqueeze(0), common, i in recompute).view_as(x)
        return Passed(depth, x)


def products(network: Pi3Network) -> list[nn.Module]:
    """The blocks, whose matrix products are taken in the type of the device."""
    readers = (network.point_decoder, network.conf_decoder, network.camera_decoder)
    return [network.encoder.blocks, network.decoder, *readers]


class Pi3(nn.Module):
    """The backbone; satisfies :class:`tco.backbones.base.Backbone`."""

    name = "pi3"
    stride = PATCH
    uses_cameras = False

    def __init__(
        self, network: Pi3Network, dtype: torch.dtype = torch.float32, recompute: range = range(0)
    ) -> None:
        """Wrap a network.

        Args:
            network: with its weights; its blocks are converted to ``dtype``.
            dtype: float32 or bfloat16, of the matrix products of all blocks; the heads are float32.
            recompute: blocks of the decoder whose activations are computed again in the backward
                pass, for a third more time: with adapters, a view of 518×392 keeps 73 MB a block in
                float32 without it, 4 MB with it. The attribute can be set at any time.

        The attribute ``as_published``, False at first, makes the cameras those of TCO's code
        (:func:`tco.backbones.pi3_heads.fitted_intrinsics`).
        """
        super().__init__()
        self.network, self.dtype, self.recompute = network, dtype, recompute
        self.as_published = False
        store_products(products(network), dtype)

    def decoder(self) -> nn.Module:
        """The blocks between the patch encoder and the three decoders of single views."""
        return self.network.decoder

    @torch.no_grad()
    def encode(self, views: Views, priors: Priors) -> Patches:
        """Patch tokens of all views; no prior is used.

        Raises:
            ValueError: no views, or a canvas that is not divisible by 14.
        """
        grid = patch_grid(views)
        n = self.network
        with computing(views.images.device, self.dtype):
            tokens = n.encoder((views.images - n.image_mean) / n.image_std, grid)
        return Patches(tokens, grid, views.valid)

    def with_points(self, encoded: Patches, points: Mapping[int, SparseDepth]) -> Patches:
        """The same features: this network takes no points."""
        return encoded

    @torch.no_grad()
    def ahead(self, encoded: Patches, changed: Collection[str]) -> Patches:
        """The same, with the blocks before the first that changes behind it; the last is always ahead."""
        n, count = self.network, self.network.config.depth
        depth = min(first_block(changed, count), count - 1)
        with computing(encoded.tokens.device, self.dtype):
            passed = n.passing(n.begun(encoded.tokens), encoded.grid, depth)
        return replace(encoded, passed=passed)

    def decode(
        self, encoded: Patches, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        """Depth, rays and confidence of some views, poses of all.

        The intrinsics of the other views are those of the context; without one they are computed
        here, without gradients.
        """
        chosen = tuple(range(len(encoded))) if views is None else tuple(views)
        tokens = self.tokens(encoded)
        poses = self.poses(tokens, encoded)
        ray, depth, logit = self.maps(tokens, encoded, chosen)
        K = {v: k for v, k in zip(chosen, self._intrinsics(ray, logit, encoded, chosen), strict=True)}
        rest = [v for v in range(len(encoded)) if v not in K]
        if rest and context is not None:
            K.update(zip(rest, context.cameras.K[rest].detach(), strict=True))
        elif rest:
            with torch.no_grad():
                for v in rest:
                    other, _, weight = self.maps(tokens, encoded, [v])
                    K[v] = self._intrinsics(other, weight, encoded, [v])[0]
        cameras = Cameras(poses, torch.stack([K[v] for v in range(len(encoded))]))
        return Prediction(depth, 1 + logit.exp(), cameras, chosen, rays=ray)

    def tokens(self, encoded: Patches) -> Tensor:
        """Tokens (V, registers + P, 2 C) that all heads read."""
        with computing(encoded.tokens.device, self.dtype):
            passed = encoded.passed or self.network.begun(encoded.tokens)
            return self.network.decoded(passed, encoded.grid, self.recompute)

    def poses(self, tokens: Tensor, encoded: Patches) -> Tensor:
        """world_from_cam (V, 4, 4) of all views, in the network's own world."""
        patches = self._read(self.network.camera_decoder, tokens, encoded)
        with computing(tokens.device, torch.float32):
            return self.network.camera_head(patches)

    def maps(self, tokens: Tensor, encoded: Patches, views: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Rays x / z, y / z (V', H, W, 2), depth (V', H, W) and logit of the confidence (V', H, W)."""
        n = self.network
        some = tokens[torch.tensor(list(views), device=tokens.device)]
        points, sure = (self._read(d, some, encoded) for d in (n.point_decoder, n.conf_decoder))
        with computing(tokens.device, torch.float32):
            xyz, logit = n.point_head(points, encoded.grid), n.conf_head(sure, encoded.grid)
        return xyz[:, :2].permute(0, 2, 3, 1), xyz[:, 2].exp(), logit[:, 0]

    def _read(self, decoder: nn.Module, tokens: Tensor, encoded: Patches) -> Tensor:
        """Patch tokens of a decoder of single views, float32."""
        c = self.network.config
        turn = rotary(encoded.grid, c.registers, c.hidden // c.head_heads, tokens.device)
        with computing(tokens.device, self.dtype):
            return decoder(tokens, turn)[:, c.registers :]

    def _intrinsics(self, ray: Tensor, logit: Tensor, encoded: Patches, views: Sequence[int]) -> Tensor:
        """Intrinsics (V', 3, 3), each pixel weighing as much as the network trusts it; or as published."""
        if self.as_published:
            return fitted_intrinsics(ray)
        focal = recovered_focal(ray, logit.detach().sigmoid() * encoded.valid[list(views)])
        return centred(focal, encoded.size)


def centred(focal: Tensor, size: tuple[int, int]) -> Tensor:
    """Intrinsics (V, 3, 3) of focal lengths (V,) with the principal point in the middle of (H, W)."""
    height, width = size
    zero, one = torch.zeros_like(focal), torch.ones_like(focal)
    rows = [focal, zero, 0.5 * width * one, zero, focal, 0.5 * height * one, zero, zero, one]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def load(
    path: Path,
    device: torch.device | str = "cpu",
    dtype: torch.dtype | None = None,
    recompute: range = range(0),
) -> Pi3:
    """π³ with the weights of a file, frozen and in evaluation mode.

    The sizes are those in the file's metadata where it has any (:func:`tco.backbones.checkpoints.save`),
    else the published.

    Args:
        path: the authors' checkpoint, safetensors or PyTorch's format.
        device: where it runs.
        dtype: of the matrix products; None: what the device multiplies fastest.
        recompute: see :class:`Pi3`.

    Raises:
        WeightsError: the file is missing, damaged, or of another network.
    """
    place = torch.device(device)
    dtype = dtype or compute_dtype(place)
    network = load_network(path, Pi3Network, Pi3Config.large(), products=(products, dtype))
    return Pi3(network, dtype, recompute).eval().requires_grad_(False).to(place)
