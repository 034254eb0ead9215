"""The definition of the renderer, plain and slow: every surfel on every pixel in float64.

Tests compare the fast engines with it. It shares no code with them: a surfel is intersected with the
ray of each pixel in camera coordinates, and weights are products over the sorted surfels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tco.geometry import invert, matrix_from_quat, pixel_grid, rays, transform
from tco.render.project import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from tco.surfels import Surfels
from tco.types import Cameras


def render_twin(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (T, H, W, 3), sum of weighted depths (T, H, W) and alpha (T, H, W), in float64.

    Memory and time grow with surfels × pixels; a few hundred of the one and a few thousand of the other
    are fine.
    """
    surfels, cameras = surfels.to(dtype=torch.float64), cameras.to(dtype=torch.float64)
    views = [
        _view(surfels, pose, K, size, near) for pose, K in zip(cameras.world_from_cam, cameras.K, strict=True)
    ]
    color, depth, alpha = (torch.stack(parts) for parts in zip(*views, strict=True))
    return color, depth, alpha


def _view(
    surfels: Surfels, world_from_cam: Tensor, K: Tensor, size: tuple[int, int], near: float
) -> tuple[Tensor, Tensor, Tensor]:
    cam_from_world = invert(world_from_cam)
    centres = transform(cam_from_world, surfels.means)
    frame = cam_from_world[:3, :3] @ matrix_from_quat(surfels.quats)
    # The deepest and nearest point of the 1σ ellipse: z ± |(s_u t_u, s_v t_v)_z|.
    reach = (frame[:, 2, :2] * surfels.scales).norm(dim=-1)
    seen = (centres[:, 2] > near) & (centres[:, 2] > reach)
    order = torch.argsort(centres[:, 2], stable=True)
    order = order[seen[order]]
    pixels = pixel_grid(*size, centres).reshape(-1, 2)
    alpha = _alphas(centres[order], frame[order], surfels.scales[order], surfels.opacities[order], pixels, K)
    weight = _weights(alpha)
    color = (weight @ surfels.colors[order]).reshape(*size, 3)
    depth = (weight @ centres[order, 2]).reshape(size)
    return color, depth, weight.sum(-1).reshape(size)


def _alphas(
    centres: Tensor, frame: Tensor, scales: Tensor, opacities: Tensor, pixels: Tensor, K: Tensor
) -> Tensor:
    """Alpha (P, N) of N sorted surfels (camera frame) at P pixels."""
    ray = rays(pixels, K)
    normal = frame[..., 2]
    slope = ray @ normal.T
    slope = torch.where(slope == 0, torch.full_like(slope, 1e-300), slope)
    hit = ray.unsqueeze(1) * ((centres * normal).sum(-1) / slope).unsqueeze(-1)
    uv = torch.einsum("pnc,nck->pnk", hit - centres, frame[..., :2]) / scales
    offset = pixels.unsqueeze(1) - _ellipse_centres(centres, frame[..., :2] * scales.unsqueeze(-2), K)
    sigma = 0.5 * torch.minimum((uv**2).sum(-1), 2 * (offset**2).sum(-1))
    alpha = (opacities * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
    return torch.where(alpha < MIN_ALPHA, torch.zeros_like(alpha), alpha)


def _ellipse_centres(centres: Tensor, axes: Tensor, K: Tensor) -> Tensor:
    """Pixel centres (N, 2) of the images of the ellipses ``c + A (cos φ, sin φ)``.

    With Q = c cᵗ − A Aᵗ in camera coordinates, whose image is K Q Kᵗ, the pole of the line at infinity.
    """
    quadric = centres.unsqueeze(-1) * centres.unsqueeze(-2) - axes @ axes.transpose(-1, -2)
    image = K @ quadric @ K.T
    return image[:, :2, 2] / image[:, 2:, 2]


def _weights(alpha: Tensor) -> Tensor:
    """Weights (P, N) of sorted alphas: alpha times the transmittance before, until the pixel is finished."""
    after = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], -1)
    return torch.where(after > MIN_TRANSMITTANCE, alpha * before, torch.zeros_like(alpha))
