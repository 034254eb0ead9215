"""The part of the embedded network that test-time adapters change: volume, refinement, upsampling."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tco.backbones.layers import Block, Conv, Pointwise, Residual, ScoreConv3d, rotary


@dataclass(frozen=True)
class SweepConfig:
    """Sizes of the network; stored beside its weights.

    Attributes:
        planes: hypotheses of the coarse sweep, uniform in inverse depth; a multiple of 8.
        groups: correlation groups of the coarse and of the fine sweep.
        coarse, fine, context: channels of the features.
        volume: channels of the fused correlation volume.
        tokens, heads, blocks: transformer on the columns of the volume at 1/16.
        hypotheses: of each refinement pass.
        spacing: step of each refinement pass, in coarse planes.
        hidden: channels of the refinement.
        equalise: factor that local equalisation may raise contrast by before all else
            (:mod:`tco.backbones.contrast`); 0: none.
    """

    planes: int = 56
    groups: tuple[int, int] = (8, 4)
    coarse: int = 32
    fine: int = 16
    context: int = 24
    volume: int = 16
    tokens: int = 192
    heads: int = 4
    blocks: int = 4
    hypotheses: int = 8
    spacing: tuple[float, ...] = (0.3, 0.08)
    hidden: int = 48
    equalise: float = 0.0

    def __post_init__(self) -> None:
        if self.planes % 8:
            raise ValueError(f"the planes are halved three times, so {self.planes} is not a multiple of 8")


class Gate(nn.Module):
    """Lets the image decide which channels of a volume pass at each pixel."""

    def __init__(self, context: int, channels: int) -> None:
        super().__init__()
        self.mix = Pointwise(context, channels)

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        """Volume (B, C, D, h, w) and context (B, ·, h, w) → (B, C, D, h, w)."""
        return x * (2 * torch.sigmoid(self.mix(context))).unsqueeze(2)


class Volume(nn.Module):
    """Four levels of 3-D convolutions led by the image; at 1/16 each column of the volume is a token."""

    CONTEXT = (48, 64, 96)

    def __init__(self, c: SweepConfig) -> None:
        super().__init__()
        self.stem = Conv(3, c.volume + 4, 16)
        self.down1 = nn.Sequential(Conv(3, 16, 32, stride=2), Conv(3, 32, 32))
        self.down2 = nn.Sequential(Conv(3, 32, 48, stride=2), Conv(3, 48, 48))
        self.down3 = nn.Sequential(Conv(3, 48, 64, stride=2), Conv(3, 64, 64))
        self.gates = nn.ModuleList(Gate(a, b) for a, b in zip(self.CONTEXT, (16, 32, 48), strict=True))
        column = 48 * c.planes // 4
        self.embed = nn.Linear(column + self.CONTEXT[2], c.tokens)
        self.blocks = nn.ModuleList(Block(c.tokens, c.heads) for _ in range(c.blocks))
        self.norm = nn.LayerNorm(c.tokens)
        self.unembed = nn.Linear(c.tokens, column)
        self.up2, self.up1, self.up0 = Pointwise(64, 48), Pointwise(48, 32), Pointwise(32, 16)
        self.out2, self.out1, self.out0 = Conv(3, 48, 48), Conv(3, 32, 32), Conv(3, 16, 16)
        self.last = Gate(self.CONTEXT[0], 16)
        self.head = ScoreConv3d(16)

    def forward(self, volume: Tensor, context: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Scores (B, D, h, w) of the planes.

        Args:
            volume: (B, C, D, h, w) correlations and points, channels last in memory.
            context: at the resolution of the volume, its half and its quarter.
        """
        x0 = self.gates[0](self.stem(volume), context[0])
        x1 = self.gates[1](self.down1(x0), context[1])
        x2 = self.gates[2](self.down2(x1), context[2])
        x2 = x2 + self._columns(x2, context[2])
        # oneDNN's gradient of a bfloat16 convolution over so few cells is not always finite (torch 2.13).
        with torch.autocast(x2.device.type, enabled=False):
            x3 = self.down3(x2.float() if x2.dtype == torch.bfloat16 else x2)
        x2 = self.out2(x2 + _resized(self.up2(x3), x2))
        x1 = self.out1(x1 + _resized(self.up1(x2), x1))
        x0 = self.last(self.out0(x0 + _resized(self.up0(x1), x0)), context[0])
        return self.head(x0).squeeze(1).float()

    def _columns(self, x: Tensor, context: Tensor) -> Tensor:
        """Attention among the columns of (B, C, D, h, w)."""
        b, c, d, h, w = x.shape
        tokens = torch.cat([x.permute(0, 3, 4, 2, 1).flatten(3), context.permute(0, 2, 3, 1)], -1)
        tokens = self.embed(tokens.flatten(1, 2))
        cos, sin = rotary(h, w, tokens.shape[-1] // self.blocks[0].heads, x.float())
        for block in self.blocks:
            tokens = block(tokens, cos, sin)
        columns = self.unembed(self.norm(tokens))
        return columns.reshape(b, h, w, d, c).permute(0, 4, 3, 1, 2)


class Refine(nn.Module):
    """Chooses among hypotheses around the present depth, at half resolution; a small U-Net."""

    def __init__(self, c: SweepConfig, upsample: bool) -> None:
        super().__init__()
        per = c.groups[1] + 3
        n = c.hidden
        self.stem = nn.Sequential(Conv(2, per * c.hypotheses + c.context + 4, n), Residual(2, n))
        self.down1 = Conv(2, n, 64, stride=2)
        self.mix1 = nn.Sequential(Conv(2, 64 + 48, 64), Residual(2, 64))
        self.down2 = Conv(2, 64, 96, stride=2)
        self.mix2 = nn.Sequential(Conv(2, 96 + 64, 96), Residual(2, 96))
        self.up1, self.up0 = Pointwise(96, 64), Pointwise(64, n)
        self.out1, self.out0 = Conv(2, 64, 64), Residual(2, n)
        self.head = nn.Conv2d(n, c.hypotheses + 2, 3, padding=1)
        self.mask = nn.Sequential(Conv(2, n + c.context, 32), Pointwise(32, 36)) if upsample else None

    def forward(
        self, x: Tensor, context: tuple[Tensor, Tensor, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Features (B, ·, h, w) → scores (B, D, h, w), offset and log-error (B, 2, h, w), mask (B, 36, h, w).

        Context is at the resolution of the features, its half and its quarter. The mask is for the last
        pass, which upsamples; None in the others.
        """
        y0 = self.stem(torch.cat([x, context[0]], 1))
        y1 = self.mix1(torch.cat([self.down1(y0), context[1]], 1))
        y2 = self.mix2(torch.cat([self.down2(y1), context[2]], 1))
        y1 = self.out1(y1 + _resized(self.up1(y2), y1))
        y0 = self.out0(y0 + _resized(self.up0(y1), y0))
        out = self.head(y0).float()
        mask = None if self.mask is None else self.mask(torch.cat([y0, context[0]], 1)).float()
        return out[:, :-2], out[:, -2:], mask


class Decoder(nn.Module):
    """Everything that test-time adapters may change."""

    def __init__(self, c: SweepConfig) -> None:
        super().__init__()
        self.coarse = Volume(c)
        self.weigh = nn.Sequential(nn.Linear(c.groups[1] * c.hypotheses, 16), nn.ReLU(), nn.Linear(16, 1))
        self.refine = nn.ModuleList(Refine(c, k + 1 == len(c.spacing)) for k in range(len(c.spacing)))


def _resized(x: Tensor, like: Tensor) -> Tensor:
    """Linear interpolation to the size of another map or volume."""
    mode = "bilinear" if x.dim() == 4 else "trilinear"
    return F.interpolate(x, size=like.shape[2:], mode=mode, align_corners=False)


DOUBT = 1 / 3
"""Probability from which on there is nothing but background. Chosen by ``benchmarks.quality`` on office and
hills: higher, what is beyond the horizon becomes points; lower, plain walls at the rim become sky."""


def soft_argmax(scores: Tensor, background: Tensor | None = None, radius: int = 2) -> tuple[Tensor, Tensor]:
    """Expected plane index around the likeliest place and the probability of that neighbourhood, (B, h, w).

    The likeliest place is the middle of the three neighbouring planes that are most probable together: a
    surface lies between planes, which share its probability. All that is far is on the few planes of the
    background, so that whatever is in doubt would be put there: the place is on them only where they are more
    probable than ``DOUBT`` together, and on the others elsewhere. The mean is over all planes around it.

    Args:
        scores: (B, D, h, w) of the planes, logarithms of probabilities up to a constant.
        background: (B, D) which planes those are; none by default.
        radius: planes on either side of the likeliest place that are its neighbourhood.
    """
    p = scores.softmax(1)
    index = torch.arange(scores.shape[1], device=scores.device, dtype=scores.dtype).view(1, -1, 1, 1)
    together = F.avg_pool3d(p.detach().unsqueeze(1), (3, 1, 1), 1, (1, 0, 0)).squeeze(1)
    if background is not None:
        behind = background[..., None, None]
        allowed = behind == ((p.detach() * behind).sum(1, keepdim=True) > DOUBT)
        together = together.where(allowed, torch.full_like(together, -1.0))
    near = (index - together.argmax(1, keepdim=True)).abs() <= radius
    p = p * near
    mass = p.sum(1)
    return (p * index).sum(1) / mass, mass


def convex_upsample(x: Tensor, mask: Tensor) -> Tensor:
    """(B, 1, h, w) → (B, 2h, 2w), each pixel a convex combination of the 3×3 around it."""
    b, _, h, w = x.shape
    weight = mask.reshape(b, 9, 2, 2, h, w).softmax(1)
    patch = F.unfold(F.pad(x, (1, 1, 1, 1), mode="replicate"), 3).reshape(b, 9, 1, 1, h, w)
    return (weight * patch).sum(1).permute(0, 3, 1, 4, 2).reshape(b, 2 * h, 2 * w)
