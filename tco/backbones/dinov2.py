"""DINOv2 with registers (Oquab et al. 2023; Darcet et al. 2023): the frozen patch encoder of VGGT and π³."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tco.backbones.prefix import Passed
from tco.backbones.transformer import Block
from tco.types import Views

PATCH = 14
"""Side of a patch of the published networks in pixels."""

COLOR_MEAN, COLOR_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Statistics of ImageNet that images in [0, 1] are normalised by."""


@dataclass(frozen=True)
class ViTConfig:
    """Sizes of a vision transformer.

    Attributes:
        channels, depth, heads: of its blocks.
        registers: tokens beside the class token and the patches.
        side: patches along a side of the square images that it was trained on.
        mask_token: whether the checkpoint holds the token of masked training, which is never used here.
        patch: side of a patch in pixels.
    """

    channels: int = 1024
    depth: int = 24
    heads: int = 16
    registers: int = 4
    side: int = 37
    mask_token: bool = True
    patch: int = PATCH

    @classmethod
    def vits14(cls) -> ViTConfig:
        """ViT-S/14 with four registers."""
        return cls(384, 12, 6)

    @classmethod
    def vitl14(cls, mask_token: bool = True) -> ViTConfig:
        """ViT-L/14 with four registers."""
        return cls(1024, 24, 16, mask_token=mask_token)


@dataclass(frozen=True)
class Patches:
    """What an encoder of patches keeps of V views.

    Attributes:
        tokens: (V, rows · columns, C).
        grid: rows and columns of patches.
        valid: (V, H, W) bool, of the canvas.
        patch: side of a patch in pixels.
        passed: the tokens behind the first blocks of the decoder, where those are computed once.
    """

    tokens: Tensor
    grid: tuple[int, int]
    valid: Tensor
    patch: int = PATCH
    passed: Passed | None = None

    def __len__(self) -> int:
        return int(self.tokens.shape[0])

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the canvas in pixels."""
        return self.patch * self.grid[0], self.patch * self.grid[1]


def patch_grid(views: Views, patch: int = PATCH) -> tuple[int, int]:
    """Rows and columns of patches with sides of ``patch`` pixels.

    Raises:
        ValueError: the canvas is not divisible into patches.
    """
    height, width = views.size
    if height % patch or width % patch or not len(views):
        raise ValueError(
            f"{len(views)} views of {width}×{height}: at least one is needed, with sides divisible by {patch}"
        )
    return height // patch, width // patch


def normalized(images: Tensor) -> Tensor:
    """RGB (V, 3, H, W) in [0, 1] → zero mean and unit variance over ImageNet."""
    mean, std = (images.new_tensor(v).view(3, 1, 1) for v in (COLOR_MEAN, COLOR_STD))
    return (images - mean) / std


class PatchEmbed(nn.Module):
    """One linear map of each patch of the image."""

    def __init__(self, channels: int, patch: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, channels, patch, patch)

    def forward(self, images: Tensor) -> Tensor:
        """(V, 3, H, W) → (V, rows · columns, C)."""
        return self.proj(images).flatten(2).transpose(1, 2)


class DINOv2(nn.Module):
    """The encoder; its state dict has the published names."""

    def __init__(self, config: ViTConfig) -> None:
        super().__init__()
        c = config.channels
        self.side = config.side
        self.cls_token = nn.Parameter(torch.zeros(1, 1, c))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config.side**2, c))
        self.register_tokens = nn.Parameter(torch.zeros(1, config.registers, c))
        if config.mask_token:
            self.mask_token = nn.Parameter(torch.zeros(1, c))
        self.patch_embed = PatchEmbed(c, config.patch)
        self.blocks = nn.ModuleList(Block(c, config.heads, eps=1e-6) for _ in range(config.depth))
        self.norm = nn.LayerNorm(c, 1e-6)

    def positions(self, grid: tuple[int, int]) -> Tensor:
        """Positional embedding (1, rows · columns, C) of a grid, resized from that of the training."""
        places = self.pos_embed[:, 1:]
        if grid == (self.side, self.side):
            return places
        square = places.unflatten(1, (self.side, self.side)).permute(0, 3, 1, 2)
        resized = F.interpolate(square, grid, mode="bicubic", antialias=True)
        return resized.flatten(2).transpose(1, 2)

    def forward(self, images: Tensor, grid: tuple[int, int]) -> Tensor:
        """Normalised images (V, 3, H, W) → patch tokens (V, rows · columns, C)."""
        patches = self.patch_embed(images).to(images.dtype) + self.positions(grid)
        first = self.cls_token + self.pos_embed[:, :1]
        special = torch.cat([first, self.register_tokens], 1).expand(len(images), -1, -1)
        x = torch.cat([special, patches], 1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)[:, special.shape[1] :]
