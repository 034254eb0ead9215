"""Transformer blocks with the parameter names of the published multi-view networks.

One block serves DINOv2 (Oquab et al. 2023), VGGT (Wang et al. 2025) and π³ (Wang et al. 2025): pre-norm
self-attention and MLP, with layer scale, normalised queries and keys, and 2-D rotary positions (Su et al.
2021; Heo et al. 2024), each by choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

ROTARY_BASE = 100.0
"""Frequencies of the rotary positions are 1 … 1 / ROTARY_BASE, in VGGT and in π³."""


@dataclass(frozen=True)
class Rotary:
    """Rotation of queries and keys by the place of their patch.

    A head's channels are four quarters: the pair (0, 1) turns with the row, the pair (2, 3) with the column.

    Attributes:
        cos: (N, 1, C) cosines for a head of C channels.
        sin: (N, 1, C) sines, negative in the first quarter of each pair.
    """

    cos: Tensor
    sin: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        """Queries or keys (B, N, heads, C) → the same, turned."""
        partner = x.unflatten(-1, (2, 2, x.shape[-1] // 4)).flip(-2).flatten(-3)
        return torch.addcmul(x * self.cos, partner, self.sin)

    def repeated(self, views: int) -> Rotary:
        """The same for the tokens of ``views`` views in one sequence."""
        return Rotary(self.cos.repeat(views, 1, 1), self.sin.repeat(views, 1, 1))


def rotary(grid: tuple[int, int], special: int, channels: int, device: torch.device) -> Rotary:
    """Rotary positions of ``special`` tokens at place (0, 0) and then a grid of patches from (1, 1) on.

    Args:
        grid: rows and columns of patches.
        special: tokens before the patches, which are not turned.
        channels: of one head.
        device: of the result, which is float32.
    """
    quarter = channels // 4
    rows, columns = grid
    frequency = ROTARY_BASE ** -(torch.arange(quarter, device=device, dtype=torch.float32) / quarter)
    y = torch.arange(1, rows + 1, device=device).repeat_interleave(columns)
    x = torch.arange(1, columns + 1, device=device).repeat(rows)
    place = F.pad(torch.stack([y, x], -1), (0, 0, special, 0))
    angle = (place.unsqueeze(-1) * frequency).repeat_interleave(2, 1)
    sign = torch.tensor([-1.0, 1.0, -1.0, 1.0], device=device).unsqueeze(-1)
    return Rotary(angle.cos().flatten(1).unsqueeze(1), (angle.sin() * sign).flatten(1).unsqueeze(1))


class Attention(nn.Module):
    """Multi-head self-attention."""

    def __init__(self, channels: int, heads: int, qk_norm: bool) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels)
        self.q_norm = nn.LayerNorm(channels // heads) if qk_norm else None
        self.k_norm = nn.LayerNorm(channels // heads) if qk_norm else None
        self.proj = nn.Linear(channels, channels)

    def forward(self, x: Tensor, turn: Rotary | None) -> Tensor:
        """Tokens (B, N, C) → (B, N, C)."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).unbind(2)
        if self.q_norm is not None and self.k_norm is not None:
            q, k = self.q_norm(q), self.k_norm(k)
        if turn is not None:
            q, k = turn(q), turn(k)
        dtype = attention_dtype(x.device, v.dtype)
        with _no_autocast(x.device):
            y = F.scaled_dot_product_attention(*(t.transpose(1, 2).to(dtype) for t in (q, k, v)))
        return self.proj(y.transpose(1, 2).flatten(2))


def attention_dtype(device: torch.device, products: torch.dtype) -> torch.dtype:
    """The type in which attention is computed where the linear layers' is ``products``.

    PyTorch's attention on a CPU is twice as fast in float32 as in bfloat16 (181 against 85 GFLOP/s on a Zen 5
    core pair that multiplies matrices at 196 and 860).
    """
    return torch.float32 if device.type == "cpu" and products is torch.bfloat16 else products


class Mlp(nn.Module):
    """Two linear layers with an exact GELU between them."""

    def __init__(self, channels: int, hidden: int, out: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(channels, hidden), nn.Linear(hidden, out)

    def forward(self, x: Tensor) -> Tensor:
        """(…, channels) → (…, out)."""
        return self.fc2(F.gelu(self.fc1(x)))


class LayerScale(nn.Module):
    """A learned factor per channel on a residual branch (Touvron et al. 2021)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.full((channels,), 0.01))

    def forward(self, x: Tensor, branch: Tensor) -> Tensor:
        """``x + gamma · branch``, all (…, C)."""
        return torch.addcmul(x, branch.to(x.dtype), self.gamma)


class Block(nn.Module):
    """Pre-norm transformer block; the residual stream keeps the dtype of its input."""

    def __init__(
        self, channels: int, heads: int, qk_norm: bool = False, scaled: bool = True, eps: float = 1e-5
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels, eps)
        self.attn = Attention(channels, heads, qk_norm)
        self.ls1 = LayerScale(channels) if scaled else None
        self.norm2 = nn.LayerNorm(channels, eps)
        self.mlp = Mlp(channels, 4 * channels, channels)
        self.ls2 = LayerScale(channels) if scaled else None

    def forward(self, x: Tensor, turn: Rotary | None = None) -> Tensor:
        """Tokens (B, N, C) → (B, N, C)."""
        x = _added(x, self.attn(self.norm1(x), turn), self.ls1)
        return _added(x, self.mlp(self.norm2(x)), self.ls2)


def _added(x: Tensor, branch: Tensor, scale: nn.Module | None) -> Tensor:
    return x + branch if scale is None else scale(x, branch)


def run_block(block: nn.Module, x: Tensor, turn: Rotary | None, recompute: bool) -> Tensor:
    """``block(x, turn)``; with ``recompute``, what its backward pass needs is computed again there."""
    if recompute and torch.is_grad_enabled():
        return checkpoint(block, x, turn, use_reentrant=False)
    return block(x, turn)


def compute_dtype(device: torch.device) -> torch.dtype:
    """bfloat16 where the device multiplies it faster than float32, else float32.

    That is on CUDA from Ampere on, and on CPUs with AVX-512 BF16 or AMX instructions.
    """
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.get_device_capability(device) >= (8, 0) else torch.float32
    if device.type != "cpu":
        return torch.float32
    flags = (getattr(torch.cpu, f"_is_{name}_supported", None) for name in ("avx512_bf16", "amx_tile"))
    return torch.bfloat16 if any(flag is not None and flag() for flag in flags) else torch.float32


def computing(device: torch.device, dtype: torch.dtype) -> AbstractContextManager[object]:
    """Matrix products in ``dtype`` inside the block; norms and residuals stay as they are.

    In float32 convolutions on CUDA are those of cuDNN, which by PyTorch's default rounds their factors to
    TF32 (a relative 5e-4), as in the authors' code; ``torch.backends.cudnn.allow_tf32 = False`` forbids it.
    """
    if dtype is torch.float32:
        return _no_autocast(device)
    return torch.autocast(device.type, dtype)


def _no_autocast(device: torch.device) -> AbstractContextManager[object]:
    known = torch.amp.is_autocast_available(device.type)
    return torch.autocast(device.type, enabled=False) if known else nullcontext()


def store_products(modules: Sequence[nn.Module], dtype: torch.dtype) -> None:
    """Keep the linear layers of transformer blocks in ``dtype``, as autocast would convert them each time."""
    for module in modules:
        for layer in module.modules():
            if isinstance(layer, nn.Linear):
                layer.to(dtype)
