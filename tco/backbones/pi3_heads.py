"""Decoders and heads of π³ (Wang et al. 2025), and the focal length that its point maps imply."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tco.backbones.dinov2 import PATCH
from tco.backbones.transformer import Block, Rotary
from tco.geometry import pixel_grid, rigid

FOCAL = (0.1, 20.0)
"""Focal lengths, in units of half the diagonal of the image, between which a recovered one is held.

They are fields of view of 169° and 5.7° across the diagonal. Point maps of a network that has not
understood a view can imply an infinite or a negative focal length.
"""


class ViewDecoder(nn.Module):
    """Five blocks of attention within each view, between linear maps."""

    def __init__(self, channels: int, hidden: int, out: int, heads: int, depth: int) -> None:
        super().__init__()
        self.projects = nn.Linear(channels, hidden)
        self.blocks = nn.ModuleList(Block(hidden, heads, scaled=False, eps=1e-6) for _ in range(depth))
        self.linear_out = nn.Linear(hidden, out)

    def forward(self, tokens: Tensor, turn: Rotary) -> Tensor:
        """(V, N, channels) → (V, N, out), of the same dtype."""
        x = self.projects(tokens).to(tokens.dtype)
        for block in self.blocks:
            x = block(x, turn)
        return self.linear_out(x).to(tokens.dtype)


class PixelHead(nn.Module):
    """A linear map of each patch's token to the values of its pixels."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.proj = nn.Linear(channels, out * PATCH**2)

    def forward(self, tokens: Tensor, grid: tuple[int, int]) -> Tensor:
        """Patch tokens (V, rows · columns, C) → maps (V, out, H, W)."""
        return F.pixel_shuffle(self.proj(tokens).transpose(1, 2).unflatten(2, grid), PATCH)


class ResidualMlp(nn.Module):
    """Three rectified linear layers added to their input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        for i in (1, 2, 3):
            self.add_module(f"res_conv{i}", nn.Linear(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        """(…, C) → (…, C)."""
        y = x
        for layer in self.children():
            y = F.relu(layer(y))
        return x + y


class PoseHead(nn.Module):
    """Pose of a view from the mean of its patch tokens."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.res_conv = nn.ModuleList(ResidualMlp(channels) for _ in range(2))
        self.more_mlps = nn.Sequential(
            nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels), nn.ReLU()
        )
        self.fc_t, self.fc_rot = nn.Linear(channels, 3), nn.Linear(channels, 9)

    def forward(self, tokens: Tensor) -> Tensor:
        """Patch tokens (V, P, C) → world_from_cam (V, 4, 4)."""
        for block in self.res_conv:
            tokens = block(tokens)
        x = self.more_mlps(tokens.mean(1))
        rows = F.normalize(self.fc_rot(x).unflatten(-1, (3, 3)), dim=-1)
        return rigid(nearest_rotation(rows), self.fc_t(x))


class _NearestRotation(torch.autograd.Function):
    """See :func:`nearest_rotation`."""

    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, M: Tensor) -> Tensor:
        """(…, 3, 3) → (…, 3, 3)."""
        U, S, Vt = torch.linalg.svd(M)
        sign = torch.ones_like(S)
        sign[..., 2] = torch.linalg.det(U @ Vt).sign()
        Vt = sign.unsqueeze(-1) * Vt
        ctx.save_for_backward(U, S * sign, Vt)
        return U @ Vt

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, *gradients: Tensor) -> Tensor:
        """With Ω = Uᵀ dM V, dR = U [(Ω − Ωᵀ)ᵢⱼ / (sᵢ + sⱼ)] Vᵀ."""
        U, S, Vt = ctx.saved_tensors  # type: ignore[attr-defined]
        total = S.unsqueeze(-1) + S.unsqueeze(-2)
        # sᵢ + sⱼ is zero where several rotations are equally near: no direction is right, none is taken.
        factor = torch.where(total.abs() > 1e-6, 1 / total, torch.zeros_like(total))
        G = factor * (U.transpose(-1, -2) @ gradients[0] @ Vt.transpose(-1, -2))
        return U @ (G - G.transpose(-1, -2)) @ Vt


def nearest_rotation(M: Tensor) -> Tensor:
    """Rotations (…, 3, 3) nearest to matrices (…, 3, 3) in the Frobenius norm.

    The derivative of the singular vectors themselves, which automatic differentiation would go through, is
    infinite at equal singular values, and a rotation has three of them; that of the product is not.
    """
    return _NearestRotation.apply(M)


def fitted_intrinsics(ray: Tensor) -> Tensor:
    """Intrinsics (V, 3, 3) by regression of pixels on rays (V, H, W, 2), one for each axis of each view.

    What the code of TCO takes for the cameras of π³ (``estimate_intrinsics_from_local_points``): focal
    lengths cov(u, x / z) / var(x / z) along either axis, and a principal point that need not be in the
    middle. Rays that are not exact lessen the focal lengths, unlike in :func:`recovered_focal`. All pixels
    count alike.
    """
    height, width = ray.shape[1:3]
    u, x = pixel_grid(height, width, ray).reshape(1, -1, 2), ray.flatten(1, 2)
    middle_u, middle_x = u.mean(1, keepdim=True), x.mean(1, keepdim=True)
    focal = ((x - middle_x) * (u - middle_u)).mean(1) / (((x - middle_x) ** 2).mean(1) + 1e-8)
    centre = middle_u[:, 0] - focal * middle_x[:, 0]
    K = torch.diag_embed(torch.cat([focal, torch.ones_like(focal[:, :1])], -1))
    return torch.cat([K[..., :2], torch.cat([centre, torch.ones_like(focal[:, :1])], -1)[..., None]], -1)


def recovered_focal(ray: Tensor, weight: Tensor) -> Tensor:
    """Focal lengths (V,) in pixels of centred pinhole cameras, from the rays of their pixels.

    A pixel u off the centre sees the direction (x / z, y / z) = u / f. The sum over pixels of
    weight · |ray − u / f|² is quadratic in 1 / f and least at Σ w u·ray / Σ w |u|². The pixels are exact
    and the rays are not, so it is this regression, and not that of pixels on rays, that has no bias.

    Args:
        ray: (V, H, W, 2) predicted x / z and y / z.
        weight: (V, H, W) not negative.
    """
    height, width = ray.shape[1:3]
    u = pixel_grid(height, width, ray) - 0.5 * ray.new_tensor([width, height])
    unit = 0.5 * (height**2 + width**2) ** 0.5
    u = u / unit
    spread = (weight * (u * u).sum(-1)).sum((1, 2)).clamp_min(torch.finfo(ray.dtype).tiny)
    inverse = (weight * (u * ray).sum(-1)).sum((1, 2)) / spread
    return unit / inverse.clamp(1 / FOCAL[1], 1 / FOCAL[0])
