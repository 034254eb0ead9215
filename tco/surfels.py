"""A depth map as 2D Gaussian surfels: one oriented, coloured disc a pixel (TCO, arXiv 2604.03878)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tco.config import knob
from tco.geometry import pixel_grid, quat_from_matrix, rays, so3_exp, transform
from tco.types import _Movable


@dataclass(frozen=True)
class Surfels(_Movable):
    """N flat Gaussians in the world frame.

    Attributes:
        means: (N, 3) centres.
        quats: (N, 4) unit quaternions w, x, y, z of the frames (first tangent, second tangent, normal).
        scales: (N, 2) standard deviations along the two tangents, in units of length.
        opacities: (N,) in [0, 1].
        colors: (N, 3) RGB in [0, 1].
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor

    def __len__(self) -> int:
        return int(self.means.shape[0])


@dataclass(frozen=True)
class SurfelConfig:
    """How a surfel is derived from a pixel."""

    radius_factor: float = knob(
        0.5,
        "Standard deviation of a surfel in steps between neighbouring points: larger closes gaps and blurs.",
    )
    pixel_centre: float = knob(
        0.5,
        "Where the centre of the top-left pixel is unprojected, in pixels; the authors' code has 0.",
    )
    foreshorten: bool = knob(
        True, "Multiply the radii by |n_z|, so that slanted and torn parts of the surface cover less."
    )
    confident_opacity: bool = knob(
        True, "Opacity 1 − 1 / confidence; without it every surfel is opaque (ablation)."
    )
    min_depth: float = knob(1e-3, "Pixels with less depth, in units of length, give no surfel.")
    min_radius: float = knob(1e-6, "Lower bound on the radii, in units of length.")


@dataclass(frozen=True)
class Adjustment(_Movable):
    """Learned changes of the surfels of a view, none at zero.

    Attributes:
        radii: (H, W, 2) logarithms of factors of the two radii.
        turn: (H, W, 3) rotation vectors in the frame of the surfel.
    """

    radii: Tensor
    turn: Tensor


def from_depth(
    depth: Tensor,
    K: Tensor,
    world_from_cam: Tensor,
    image: Tensor,
    confidence: Tensor,
    *,
    valid: Tensor | None = None,
    config: SurfelConfig | None = None,
    adjust: Adjustment | None = None,
) -> Surfels:
    """Surfels of one view, differentiable in depth, camera, image and confidence.

    The tangents and radii come from the gradients g_u, g_v of the point map (central differences,
    one-sided at the border): t_u = g_u / |g_u|, n ∝ −t_u × g_v, t_v = n × t_u, radii r · |n_z| · |g_u|
    and r · |n_z| · |g_v · t_v|. The image's v axis points down, so that −g_v makes n face the camera; the
    frame is right-handed, as in the authors' code.

    Args:
        depth: (H, W) camera z.
        K: (3, 3) intrinsics in pixels.
        world_from_cam: (4, 4).
        image: (3, H, W) RGB.
        confidence: (H, W), at least 1.
        valid: (H, W) bool. A surfel is dropped where it is False, where the depth is below
            ``config.min_depth``, and where either holds for a neighbour that its gradients use.
        config: radii, opacities and pixel convention.
        adjust: changes of radii and orientation, by pixel (ablation).

    Returns:
        Surfels in the row-major order of the remaining pixels.

    Raises:
        ValueError: shapes that do not agree, a map smaller than 2×2, or a confidence below 1.
    """
    config = config or SurfelConfig()
    _check(depth, image, confidence, valid)
    h, w = depth.shape
    xy = pixel_grid(h, w, depth) + (config.pixel_centre - 0.5)
    points = rays(xy.reshape(-1, 2), K).reshape(h, w, 3) * depth.unsqueeze(-1)
    frame, radii = _frames(points, config)
    if adjust is not None:
        frame, radii = frame @ so3_exp(adjust.turn), radii * torch.exp(adjust.radii)
    means = transform(world_from_cam, points.reshape(-1, 3))
    quats = quat_from_matrix(world_from_cam[:3, :3] @ frame.reshape(-1, 3, 3))
    if config.confident_opacity:
        opacity = 1 - 1 / confidence.clamp_min(1 + 1e-6)
    else:
        opacity = torch.ones_like(depth)
    surfels = Surfels(means, quats, radii.reshape(-1, 2), opacity.reshape(-1), image.flatten(1).T)
    keep = supported(depth > config.min_depth if valid is None else valid & (depth > config.min_depth))
    if bool(keep.all()):
        return surfels
    return _select(surfels, keep.reshape(-1))


def _check(depth: Tensor, image: Tensor, confidence: Tensor, valid: Tensor | None) -> None:
    if depth.dim() != 2 or min(depth.shape) < 2:
        raise ValueError(f"a depth map of at least 2×2 pixels is needed, not {tuple(depth.shape)}")
    if image.shape != (3, *depth.shape) or confidence.shape != depth.shape:
        raise ValueError(
            f"image {tuple(image.shape)} and confidence {tuple(confidence.shape)} do not fit the depth map "
            f"{tuple(depth.shape)}"
        )
    if valid is not None and (valid.shape != depth.shape or valid.dtype != torch.bool):
        raise ValueError(
            f"the valid mask is {tuple(valid.shape)} {valid.dtype}, not {tuple(depth.shape)} bool"
        )
    if bool((confidence < 1).any()):
        raise ValueError("confidence is at least 1 (1 + exp(x)); map a probability p to 1 / (1 − p) first")


def _frames(points: Tensor, config: SurfelConfig) -> tuple[Tensor, Tensor]:
    """Frames (H, W, 3, 3), columns t_u, t_v, n, and radii (H, W, 2) of a point map (H, W, 3).

    Gradients shorter than 1e-6 (coinciding points) would divide by zero; their length is taken as 1e-6.
    """
    down, right = torch.gradient(points, dim=(0, 1))
    up = -down
    length_u = right.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    t_u = right / length_u
    normal = torch.linalg.cross(t_u, up / up.norm(dim=-1, keepdim=True).clamp_min(1e-6))
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    t_v = torch.linalg.cross(normal, t_u)
    length_v = (up * t_v).sum(-1, keepdim=True).abs().clamp_min(1e-6)
    radii = config.radius_factor * torch.cat([length_u, length_v], -1)
    if config.foreshorten:
        radii = radii * normal[..., 2:].abs()
    return torch.stack([t_u, t_v, normal], -1), radii.clamp_min(config.min_radius)


def supported(valid: Tensor) -> Tensor:
    """Pixels (H, W) that are valid together with their four neighbours inside the map."""
    keep = valid.clone()
    keep[1:] &= valid[:-1]
    keep[:-1] &= valid[1:]
    keep[:, 1:] &= valid[:, :-1]
    keep[:, :-1] &= valid[:, 1:]
    return keep


def _select(surfels: Surfels, keep: Tensor) -> Surfels:
    s = surfels
    return Surfels(s.means[keep], s.quats[keep], s.scales[keep], s.opacities[keep], s.colors[keep])
