"""Heads of VGGT (Wang et al. 2025): iterative camera head, and DPT (Ranftl et al. 2021) for dense maps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tco.backbones.dinov2 import PATCH
from tco.backbones.transformer import Block, Mlp
from tco.geometry import invert, matrix_from_quat, quat_from_matrix, rigid
from tco.types import Cameras

POSE_CHANNELS = 9
"""Translation (3), quaternion x, y, z, w (4), vertical and horizontal field of view (2)."""

FIELD_OF_VIEW = (0.02, 3.1)
"""Radians between which a predicted field of view is held: at 0 the focal length is infinite, and the
head's ReLU gives exactly 0 for views that it cannot place; at π the focal length is 0."""


VIEWS_AT_ONCE = 4
"""Views of which the dense heads hold activations, 0.3 GB a view of 518×392, when there are no gradients."""


class CameraHead(nn.Module):
    """Refines all cameras together, from the camera tokens alone."""

    def __init__(self, channels: int, heads: int, depth: int) -> None:
        super().__init__()
        self.trunk = nn.ModuleList(Block(channels, heads) for _ in range(depth))
        self.token_norm, self.trunk_norm = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.empty_pose_tokens = nn.Parameter(torch.zeros(1, 1, POSE_CHANNELS))
        self.embed_pose = nn.Linear(POSE_CHANNELS, channels)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(channels, 3 * channels))
        self.pose_branch = Mlp(channels, channels // 2, POSE_CHANNELS)

    def forward(self, tokens: Tensor, iterations: int = 4) -> list[Tensor]:
        """Camera tokens (…, V, C) → encoded poses (…, V, 9) after every iteration, the best last."""
        shape = (*tokens.shape[:-1], POSE_CHANNELS)
        tokens = self.token_norm(tokens).reshape(-1, *tokens.shape[-2:])
        plain = F.layer_norm(tokens, tokens.shape[-1:], eps=1e-6)
        poses: list[Tensor] = []
        pose = self.empty_pose_tokens.expand(*tokens.shape[:2], -1)
        for k in range(iterations):
            if k:
                # As published: each iteration answers for its own change alone.
                pose = pose.detach()
            shift, scale, gate = self.poseLN_modulation(self.embed_pose(pose)).chunk(3, -1)
            x = tokens + gate * (plain * (1 + scale) + shift)
            for block in self.trunk:
                x = block(x)
            change = self.pose_branch(self.trunk_norm(x))
            pose = change if k == 0 else pose + change
            poses.append(torch.cat([pose[..., :7], F.relu(pose[..., 7:])], -1).view(shape))
        return poses


def cam_from_world(pose: Tensor) -> Tensor:
    """Extrinsics (…, 4, 4) of encoded poses (…, 9)."""
    x, y, z, w = pose[..., 3:7].unbind(-1)
    return rigid(matrix_from_quat(torch.stack([w, x, y, z], -1)), pose[..., :3])


def cameras(pose: Tensor, size: tuple[int, int]) -> Cameras:
    """Cameras of encoded poses (V, 9) for a canvas (H, W), the principal point in its middle."""
    height, width = size
    angle = pose[:, 7:].clamp(*FIELD_OF_VIEW)
    fy, fx = (0.5 * angle.new_tensor([height, width]) / (0.5 * angle).tan()).unbind(-1)
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    rows = [fx, zero, 0.5 * width * one, zero, fy, 0.5 * height * one, zero, zero, one]
    return Cameras(invert(cam_from_world(pose)), torch.stack(rows, -1).reshape(-1, 3, 3))


def encoded(made: Cameras, size: tuple[int, int]) -> Tensor:
    """Encoded poses (…, 9) of cameras (…, 4, 4) and (…, 3, 3), the inverse of :func:`cameras`.

    The quaternion is the one of positive real part: of the two that mean a rotation, the one which a network
    is trained to give. Only the focal lengths of the intrinsics count.

    Args:
        made: cameras whose principal points are in the middle of the canvas.
        size: (H, W) of the canvas.
    """
    height, width = size
    pose = invert(made.world_from_cam)
    w, x, y, z = quat_from_matrix(pose[..., :3, :3]).unbind(-1)
    turn = torch.stack([x, y, z, w], -1) * torch.where(w < 0, -1.0, 1.0).unsqueeze(-1)
    focal = torch.stack([made.K[..., 1, 1], made.K[..., 0, 0]], -1)
    angle = 2 * (0.5 * focal.new_tensor([height, width]) / focal).atan()
    return torch.cat([pose[..., :3, 3], turn, angle], -1)


def ramp(count: int, extent: float, channels: int, device: torch.device) -> Tensor:
    """Sines and cosines (channels, count) of ``count`` cell centres in [−extent, extent]."""
    half = channels // 2
    last = extent * (count - 1) / count
    place = torch.linspace(-last, last, count, device=device)
    frequency = 100.0 ** -(torch.arange(half, device=device, dtype=torch.float32) / half)
    angle = frequency.unsqueeze(-1) * place
    return torch.cat([angle.sin(), angle.cos()])


def with_places(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Add a tenth of a sinusoidal embedding of the place in the image to maps (V, C, h, w).

    The first half of the channels is of x, the other of y, in units of half the diagonal of the image.

    Args:
        x: maps.
        size: (H, W) of the image, for its shape alone.
    """
    channels, h, w = x.shape[1:]
    height, width = size
    diagonal = (height**2 + width**2) ** 0.5
    across = 0.1 * ramp(w, width / diagonal, channels // 2, x.device)
    down = 0.1 * ramp(h, height / diagonal, channels // 2, x.device)
    parts = [across.unsqueeze(1).expand(-1, h, -1), down.unsqueeze(2).expand(-1, -1, w)]
    return x + torch.cat(parts)


class ResidualUnit(nn.Module):
    """Two convolutions added to the rectified input.

    The published network rectifies in place, so that its residual is the rectified input too.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Shape is kept."""
        x = F.relu(x)
        return x + self.conv2(F.relu(self.conv1(x)))


class Fusion(nn.Module):
    """Adds a finer level to a coarser one and enlarges the sum."""

    def __init__(self, channels: int, first: bool) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(channels, channels, 1)
        self.resConfUnit1 = None if first else ResidualUnit(channels)
        self.resConfUnit2 = ResidualUnit(channels)

    def forward(self, x: Tensor, skip: Tensor | None, size: tuple[int, int]) -> Tensor:
        """Coarse (V, C, h, w) and finer (V, C, h, w) or None → (V, C, *size).

        The 1×1 convolution goes before the interpolation, of which the published network has it after:
        both are linear, the weights of the interpolation sum to one, and this way it costs a quarter.
        """
        if self.resConfUnit1 is not None and skip is not None:
            x = x + self.resConfUnit1(skip)
        return resized(self.out_conv(self.resConfUnit2(x)), size)


def resized(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Bilinear interpolation of (V, C, h, w) that maps corner pixels to corner pixels."""
    return F.interpolate(x, size, mode="bilinear", align_corners=True)


class Scratch(nn.Module):
    """The convolutional part of DPT, from four levels to one map."""

    def __init__(self, features: int, levels: Sequence[int], out: int) -> None:
        super().__init__()
        for i, c in enumerate(levels, 1):
            self.add_module(f"layer{i}_rn", nn.Conv2d(c, features, 3, padding=1, bias=False))
        for i in range(1, len(levels) + 1):
            self.add_module(f"refinenet{i}", Fusion(features, first=i == len(levels)))
        self.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, out, 1)
        )

    def fused(self, levels: Sequence[Tensor]) -> Tensor:
        """Levels (V, ·, h, w), the finest first → features (V, C, 2 h, 2 w) of twice the finest."""
        finest = levels[0].shape[-2:]
        sizes = [(2 * finest[0], 2 * finest[1]), *(tuple(x.shape[-2:]) for x in levels[:-1])]
        same = [self.get_submodule(f"layer{i}_rn")(x) for i, x in enumerate(levels, 1)]
        x = self.get_submodule(f"refinenet{len(levels)}")(same[-1], None, sizes[-1])
        for i in range(len(levels) - 1, 0, -1):
            x = self.get_submodule(f"refinenet{i}")(x, same[i - 1], sizes[i - 1])
        return x


class DPTHead(nn.Module):
    """Dense maps from the tokens of four layers of the aggregator, for patches of ``patch`` pixels."""

    def __init__(
        self, channels: int, features: int, levels: Sequence[int], out: int, patch: int = PATCH
    ) -> None:
        super().__init__()
        self.patch = patch
        a, b, _, d = levels
        self.norm = nn.LayerNorm(channels)
        self.projects = nn.ModuleList(nn.Conv2d(channels, c, 1) for c in levels)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(a, a, 4, 4),
                nn.ConvTranspose2d(b, b, 2, 2),
                nn.Identity(),
                nn.Conv2d(d, d, 3, 2, 1),
            ]
        )
        self.scratch = Scratch(features, levels, out)

    def forward(self, tokens: Sequence[Tensor], grid: tuple[int, int]) -> Tensor:
        """Patch tokens (V, rows · columns, C) of four layers → maps (V, out, H, W), without activation."""
        batches = zip(*(x.split(VIEWS_AT_ONCE) for x in tokens), strict=True)
        return torch.cat([self.some(batch, grid) for batch in batches])

    def some(self, tokens: Sequence[Tensor], grid: tuple[int, int]) -> Tensor:
        """As ``forward``, for a few views, all at once."""
        size = (self.patch * grid[0], self.patch * grid[1])
        levels = []
        for x, project, resize in zip(tokens, self.projects, self.resize_layers, strict=True):
            maps = self.norm(x).transpose(1, 2).unflatten(2, grid)
            levels.append(resize(with_places(project(maps), size)))
        x = resized(self.scratch.output_conv1(self.scratch.fused(levels)), size)
        return self.scratch.output_conv2(with_places(x, size))


def depth_of(maps: Tensor) -> tuple[Tensor, Tensor]:
    """Depth and confidence (V, H, W) of the depth head's maps (V, 2, H, W)."""
    return maps[:, 0].exp(), 1 + maps[:, 1].exp()


def points_of(maps: Tensor) -> tuple[Tensor, Tensor]:
    """World points (V, H, W, 3) and confidence (V, H, W) of the point head's maps (V, 4, H, W)."""
    xyz = maps[:, :3].permute(0, 2, 3, 1)
    return xyz.sign() * xyz.abs().expm1(), 1 + maps[:, 3].exp()
