"""Building blocks of the embedded network: convolutions, residuals, a transformer with rotary positions."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Conv3d(nn.Conv3d):
    """PyTorch's, and as fast for one small volume in float32 on a CPU as for several.

    PyTorch computes that by a loop of its own, several times as slow as oneDNN, which it asks for all else
    (2.13). Here oneDNN is asked for it, too.
    """

    def _conv_forward(self, input: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        if len(input) > 1 or not (_in_float32(input) and torch.backends.mkldnn.is_available()):
            return super()._conv_forward(input, weight, bias)
        padding = [int(p) for p in self.padding]
        return torch.mkldnn_convolution(input, weight, bias, padding, self.stride, self.dilation, self.groups)


class ScoreConv3d(Conv3d):
    """A 3×3×3 convolution with one output channel, in float32 on a CPU in a third of the time.

    A CPU computes eight output channels at once, so that most of the work for one is lost. The kernel's three
    slices along the first axis are three channels of a convolution within planes, which are then added, each
    shifted by a plane.
    """

    def __init__(self, cin: int) -> None:
        super().__init__(cin, 1, 3, padding=1)

    def _conv_forward(self, input: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        if not _in_float32(input):
            return super()._conv_forward(input, weight, bias)
        within = F.conv3d(input, weight.permute(2, 1, 0, 3, 4), padding=(0, 1, 1))
        before, here, after = F.pad(within, (0, 0, 0, 0, 1, 1)).split(1, 1)
        planes = input.shape[2]
        total = before[:, :, :planes] + here[:, :, 1:-1] + after[:, :, 2:]
        return total if bias is None else total + bias


def _in_float32(x: Tensor) -> bool:
    """Whether products with it are computed in float32 on a CPU."""
    return x.device.type == "cpu" and x.dtype == torch.float32 and not torch.is_autocast_enabled("cpu")


class Conv(nn.Module):
    """Convolution in two or three dimensions, group normalisation, ReLU."""

    def __init__(
        self, dims: int, cin: int, cout: int, kernel: int = 3, stride: int = 1, dilation: int = 1
    ) -> None:
        super().__init__()
        kind = nn.Conv2d if dims == 2 else Conv3d
        self.conv = kind(cin, cout, kernel, stride, dilation * (kernel // 2), dilation, bias=False)
        self.norm = nn.GroupNorm(max(1, cout // 8), cout)

    def forward(self, x: Tensor) -> Tensor:
        """(B, cin, …) → (B, cout, … / stride)."""
        return F.relu(self.norm(self.conv(x)), inplace=True)


class Pointwise(nn.Module):
    """A 1×1 convolution over maps or volumes with channels last, as one matrix product."""

    def __init__(self, cin: int, cout: int) -> None:
        super().__init__()
        like = nn.Linear(cin, cout)
        self.weight, self.bias = like.weight, like.bias

    def forward(self, x: Tensor) -> Tensor:
        """(B, cin, …) → (B, cout, …)."""
        return F.linear(x.movedim(1, -1), self.weight, self.bias).movedim(-1, 1)


class Residual(nn.Module):
    """Two convolutions added to their input."""

    def __init__(self, dims: int, channels: int, dilation: int = 1) -> None:
        super().__init__()
        self.a = Conv(dims, channels, channels, dilation=dilation)
        kind = nn.Conv2d if dims == 2 else Conv3d
        self.b = kind(channels, channels, 3, padding=1)
        for parameter in self.b.parameters():
            nn.init.zeros_(parameter)

    def forward(self, x: Tensor) -> Tensor:
        """Shape is kept."""
        return x + self.b(self.a(x))


def rotary(
    height: int, width: int, channels: int, like: Tensor, base: float = 100.0
) -> tuple[Tensor, Tensor]:
    """Cosines and sines (H·W, channels) of 2-D rotary positions: half of the channels for y, half for x."""
    quarter = channels // 4
    freq = base ** -(torch.arange(quarter, device=like.device, dtype=like.dtype) / quarter)
    y, x = torch.meshgrid(
        torch.arange(height, device=like.device, dtype=like.dtype),
        torch.arange(width, device=like.device, dtype=like.dtype),
        indexing="ij",
    )
    angle = torch.cat([y.reshape(-1, 1) * freq, x.reshape(-1, 1) * freq], -1)
    angle = torch.cat([angle, angle], -1)
    return angle.cos(), angle.sin()


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Turn (…, N, C) by the angles of :func:`rotary`."""
    a, b = x.chunk(2, -1)
    return x * cos + torch.cat([-b, a], -1) * sin


class Block(nn.Module):
    """Pre-norm transformer block with rotary self-attention; names as in the published MVTs."""

    def __init__(self, channels: int, heads: int, ratio: int = 2) -> None:
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.qkv, self.proj = nn.Linear(channels, 3 * channels), nn.Linear(channels, channels)
        self.fc1, self.fc2 = nn.Linear(channels, ratio * channels), nn.Linear(ratio * channels, channels)

    def forward(self, x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
        """Tokens (B, N, C) → (B, N, C)."""
        b, n, c = x.shape
        q, k, v = self.qkv(self.norm1(x)).reshape(b, n, 3, self.heads, c // self.heads).permute(2, 0, 3, 1, 4)
        y = F.scaled_dot_product_attention(rotate(q, cos, sin), rotate(k, cos, sin), v)
        x = x + self.proj(y.transpose(1, 2).reshape(b, n, c))
        return x + self.fc2(F.gelu(self.fc1(self.norm2(x))))


class FeatureNet(nn.Module):
    """Image pyramid: matching features at 1/4 and 1/2, context at 1/2, 1/4, 1/8 and 1/16.

    Colours are whitened per view first, so that exposure and white balance change nothing; two more
    channels show brightness after local normalisation, which makes faint texture visible.
    """

    def __init__(self, coarse: int, fine: int, context: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(Conv(2, 5, 32, 5, stride=2), Conv(2, 32, 32))
        self.down4 = nn.Sequential(Conv(2, 32, 48, stride=2), Residual(2, 48), Residual(2, 48))
        self.down8 = nn.Sequential(Conv(2, 48, 64, stride=2), Residual(2, 64), Residual(2, 64))
        self.down16 = nn.Sequential(Conv(2, 64, 96, stride=2), Residual(2, 96), Residual(2, 96))
        self.up8, self.up4, self.up2 = (nn.Conv2d(a, b, 1) for a, b in ((96, 64), (64, 48), (48, 32)))
        self.out8, self.out4, self.out2 = Conv(2, 64, 64), Conv(2, 48, 48), Conv(2, 32, 32)
        self.coarse, self.fine = nn.Conv2d(48, coarse, 1), nn.Conv2d(32, fine, 1)
        self.context = nn.Conv2d(32, context, 1)

    def forward(self, images: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Features of V views.

        Args:
            images: (V, 3, H, W). valid: (V, H, W).

        Returns:
            coarse (V, ·, H/4, W/4), fine (V, ·, H/2, W/2), context at 1/2, 1/4, 1/8 and 1/16.
        """
        x = normalised(images, valid).contiguous(memory_format=torch.channels_last)
        x2 = self.stem(x)
        x4 = self.down4(x2)
        x8 = self.down8(x4)
        x16 = self.down16(x8)
        y8 = self.out8(x8 + F.interpolate(self.up8(x16), scale_factor=2.0, mode="bilinear"))
        y4 = self.out4(x4 + F.interpolate(self.up4(y8), scale_factor=2.0, mode="bilinear"))
        y2 = self.out2(x2 + F.interpolate(self.up2(y4), scale_factor=2.0, mode="bilinear"))
        return self.coarse(y4).float(), self.fine(y2).float(), (self.context(y2), y4, y8, x16)


def normalised(images: Tensor, valid: Tensor) -> Tensor:
    """Whitened colours and two locally normalised brightnesses (V, 5, H, W), 0 outside ``valid``.

    Locally normalised: (g − mean) / √(variance + ε²) over 9×9 pixels, with g in units of the view's own
    deviation and ε of 0.03, which shows the texture of a white wall, and of 0.2, which leaves noise small.
    """
    weight = valid.unsqueeze(1).to(images.dtype)
    total = weight.sum((2, 3), keepdim=True).clamp_min(1)
    mean = (images * weight).sum((2, 3), keepdim=True) / total
    var = ((images - mean) ** 2 * weight).sum((2, 3), keepdim=True) / total
    x = (images - mean) / (var + 1e-3).sqrt() * weight
    grey = x.mean(1, keepdim=True)
    near = F.avg_pool2d(torch.cat([grey, grey**2, weight], 1), 9, 1, 4, count_include_pad=False)
    middle = near[:, :1] / near[:, 2:].clamp_min(1e-3)
    spread = (near[:, 1:2] / near[:, 2:].clamp_min(1e-3) - middle**2).clamp_min(0)
    local = [(grey - middle) / (spread + e**2).sqrt() * weight for e in (0.03, 0.2)]
    return torch.cat([x, *local], 1)
