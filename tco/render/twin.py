"""The definition of the renderer, plain and slow: every surfel on every pixel in float64.

Tests compare the fast engines with it. It shares thresholds and helpers of geometry with them, and not the
computation: a surfel is intersected with the ray of each pixel in camera coordinates, and the weights of a
pixel are computed for all surfels at once.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from tco.geometry import invert, matrix_from_quat, pixel_grid, rays, transform
from tco.render.kernels import CORE, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from tco.surfels import Surfels
from tco.types import Cameras

Images = tuple[Tensor, Tensor, Tensor]


def render_twin(surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01) -> Images:
    """Colour (T, H, W, 3), sum of weighted depths (T, H, W) and alpha (T, H, W), in float64.

    Memory and time grow with surfels × pixels; a few hundred of the one and a few thousand of the other
    are fine.
    """
    return _render(_composited, surfels, cameras, size, near)


def render_surface_twin(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01
) -> Images:
    """As :func:`render_twin`, for the engine that averages over the nearest surface."""
    return _render(_averaged, surfels, cameras, size, near)


def _composited(sigma: Tensor, opacities: Tensor, depths: Tensor, focal: Tensor) -> Tensor:
    """Weights (P, N) of sorted surfels: alpha times the transmittance before, until the pixel is finished."""
    alpha = (opacities * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
    alpha = torch.where(alpha < MIN_ALPHA, torch.zeros_like(alpha), alpha)
    after = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], -1)
    return torch.where(after > MIN_TRANSMITTANCE, alpha * before, torch.zeros_like(alpha))


def _averaged(sigma: Tensor, opacities: Tensor, depths: Tensor, focal: Tensor) -> Tensor:
    """Weights (P, N) of the surfels of the nearest surface, with the sum 1 − exp(−Σ o · exp(−sigma))."""
    weight = opacities * torch.exp(-sigma)
    core = torch.where(sigma <= CORE, depths.expand_as(sigma), torch.inf)
    surface = torch.cat([core, core.new_full((len(core), 1), torch.inf)], -1).amin(-1, keepdim=True).detach()
    same = (depths - surface).abs() < (0.01 + 4 / focal.detach()) * surface
    weight = torch.where((weight < MIN_ALPHA) | ~same, torch.zeros_like(weight), weight)
    total = weight.sum(-1, keepdim=True)
    return weight * ((1 - torch.exp(-total)) / total.clamp_min(1e-10))


def _render(
    weigh: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float,
) -> Images:  # fmt: skip
    surfels, cameras = surfels.to(dtype=torch.float64), cameras.to(dtype=torch.float64)
    pixels = pixel_grid(*size, surfels.means).reshape(-1, 2)
    views = []
    for pose, K in zip(cameras.world_from_cam, cameras.K, strict=True):
        seen, centres, frame = _in_front(surfels, pose, near)
        sigma = _sigmas(centres, frame, surfels.scales[seen], pixels, K)
        weight = weigh(sigma, surfels.opacities[seen], centres[:, 2], (K[0, 0] * K[1, 1]).sqrt())
        parts = weight @ surfels.colors[seen], weight @ centres[:, 2], weight.sum(-1)
        views.append([part.reshape(*size, *part.shape[1:]) for part in parts])
    color, depth, alpha = (torch.stack(parts) for parts in zip(*views, strict=True))
    return color, depth, alpha


def _in_front(surfels: Surfels, world_from_cam: Tensor, near: float) -> tuple[Tensor, Tensor, Tensor]:
    """Indices of the surfels that a camera sees by depth, their centres (N, 3) and frames (N, 3, 3) in it."""
    cam_from_world = invert(world_from_cam)
    centres = transform(cam_from_world, surfels.means)
    frame = cam_from_world[:3, :3] @ matrix_from_quat(surfels.quats)
    # The deepest and nearest point of the 1σ ellipse: z ± |(s_u t_u, s_v t_v)_z|.
    reach = (frame[:, 2, :2] * surfels.scales).norm(dim=-1)
    seen = (centres[:, 2] > near) & (centres[:, 2] > reach)
    order = torch.argsort(centres[:, 2], stable=True)
    order = order[seen[order]]
    return order, centres[order], frame[order]


def _sigmas(centres: Tensor, frame: Tensor, scales: Tensor, pixels: Tensor, K: Tensor) -> Tensor:
    """Sigma (P, N) of N surfels (camera frame) at P pixels."""
    ray = rays(pixels, K)
    normal = frame[..., 2]
    slope = ray @ normal.T
    slope = torch.where(slope == 0, torch.full_like(slope, 1e-300), slope)
    hit = ray.unsqueeze(1) * ((centres * normal).sum(-1) / slope).unsqueeze(-1)
    uv = torch.einsum("pnc,nck->pnk", hit - centres, frame[..., :2]) / scales
    offset = pixels.unsqueeze(1) - _ellipse_centres(centres, frame[..., :2] * scales.unsqueeze(-2), K)
    return 0.5 * torch.minimum((uv**2).sum(-1), 2 * (offset**2).sum(-1))


def _ellipse_centres(centres: Tensor, axes: Tensor, K: Tensor) -> Tensor:
    """Pixel centres (N, 2) of the images of the ellipses ``c + A (cos φ, sin φ)``.

    With Q = c cᵗ − A Aᵗ in camera coordinates, whose image is K Q Kᵗ, the pole of the line at infinity.
    """
    quadric = centres.unsqueeze(-1) * centres.unsqueeze(-2) - axes @ axes.transpose(-1, -2)
    image = K @ quadric @ K.T
    return image[:, :2, 2] / image[:, 2:, 2]
