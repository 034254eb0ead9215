"""Projective geometry on tensors: project, unproject, invert, exponentials, alignment.

Every function broadcasts over leading dimensions, is differentiable, and follows the conventions
of :mod:`tco.types`.
"""

from __future__ import annotations

import torch
from torch import Tensor


def pixel_grid(height: int, width: int, like: Tensor) -> Tensor:
    """Pixel centres (H, W, 2) as (x + 0.5, y + 0.5), with the dtype and device of ``like``."""
    y, x = torch.meshgrid(
        torch.arange(height, dtype=like.dtype, device=like.device) + 0.5,
        torch.arange(width, dtype=like.dtype, device=like.device) + 0.5,
        indexing="ij",
    )
    return torch.stack([x, y], -1)


def rays(xy: Tensor, K: Tensor) -> Tensor:
    """Rays of unit depth (…, N, 3) in the camera frame through pixels (…, N, 2) of cameras (…, 3, 3)."""
    f = torch.stack([K[..., 0, 0], K[..., 1, 1]], -1).unsqueeze(-2)
    centre = K[..., :2, 2].unsqueeze(-2)
    ray = (xy - centre) / f
    return torch.cat([ray, torch.ones_like(ray[..., :1])], -1)


def unproject(depth: Tensor, K: Tensor) -> Tensor:
    """Camera-frame points (…, H, W, 3) of depth maps (…, H, W), at pixel centres."""
    h, w = depth.shape[-2:]
    xy = pixel_grid(h, w, depth).reshape(-1, 2)
    return rays(xy, K).reshape(*K.shape[:-2], h, w, 3) * depth.unsqueeze(-1)


def project(points: Tensor, K: Tensor, min_depth: float = 1e-6) -> tuple[Tensor, Tensor]:
    """Pixels (…, N, 2) and depths (…, N) of camera-frame points (…, N, 3).

    The division uses ``max(z, min_depth)``: a point at or behind the camera gets a finite pixel
    far off the image, and its depth tells the caller to reject it.
    """
    z = points[..., 2]
    xy = points[..., :2] / z.clamp_min(min_depth).unsqueeze(-1)
    f = torch.stack([K[..., 0, 0], K[..., 1, 1]], -1).unsqueeze(-2)
    return xy * f + K[..., :2, 2].unsqueeze(-2), z


def transform(target_from_source: Tensor, points: Tensor) -> Tensor:
    """Apply (…, 4, 4) transforms to points (…, N, 3)."""
    R, t = target_from_source[..., :3, :3], target_from_source[..., :3, 3]
    return points @ R.transpose(-1, -2) + t.unsqueeze(-2)


def invert(target_from_source: Tensor) -> Tensor:
    """Inverse of rigid transforms (…, 4, 4)."""
    R, t = target_from_source[..., :3, :3], target_from_source[..., :3, 3:]
    Rt = R.transpose(-1, -2)
    top = torch.cat([Rt, -Rt @ t], -1)
    bottom = target_from_source.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)


def skew(v: Tensor) -> Tensor:
    """Cross-product matrices (…, 3, 3) of vectors (…, 3)."""
    zero = torch.zeros_like(v[..., 0])
    x, y, z = v.unbind(-1)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)


def so3_exp(omega: Tensor) -> Tensor:
    """Rotation matrices (…, 3, 3) of rotation vectors (…, 3), Rodrigues' formula.

    Below an angle of 1e-4 the factors sin θ / θ and (1 − cos θ) / θ² are 0 / 0 in their derivative;
    their Taylor series to θ² replace them there (error below 1e-17).
    """
    theta2 = (omega * omega).sum(-1)
    small = theta2 < 1e-8
    theta = torch.where(small, torch.ones_like(theta2), theta2).sqrt()
    a = torch.where(small, 1 - theta2 / 6, torch.sin(theta) / theta)[..., None, None]
    b = torch.where(small, 0.5 - theta2 / 24, (1 - torch.cos(theta)) / theta**2)[..., None, None]
    W = skew(omega)
    return torch.eye(3, dtype=omega.dtype, device=omega.device) + a * W + b * (W @ W)


def rigid(R: Tensor, t: Tensor) -> Tensor:
    """Transforms (…, 4, 4) from rotations (…, 3, 3) and translations (…, 3)."""
    top = torch.cat([R, t.unsqueeze(-1)], -1)
    bottom = R.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*R.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)


def scale_shift(source: Tensor, target: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Least-squares s, t (scalars) that minimise Σ_mask (s · source + t − target)².

    Raises:
        ValueError: fewer than two masked values, or a constant source, which leave s undefined.
    """
    x, y = source[mask], target[mask]
    if x.numel() < 2:
        raise ValueError(f"scale and shift need two depths, the mask holds {x.numel()}")
    mx, my = x.mean(), y.mean()
    variance = ((x - mx) ** 2).sum()
    if float(variance.detach()) <= 1e-12 * float((x * x).sum().detach()):
        raise ValueError("scale and shift are undefined: the source depth is constant")
    s = ((x - mx) * (y - my)).sum() / variance
    return s, my - s * mx


def sample(maps: Tensor, xy: Tensor, mode: str = "bilinear") -> Tensor:
    """Values (V, C, N) of maps (V, C, H, W) at pixels (V, N, 2); zero outside the image."""
    h, w = maps.shape[-2:]
    grid = xy / xy.new_tensor([w, h]) * 2 - 1
    values = torch.nn.functional.grid_sample(
        maps, grid.unsqueeze(2), mode=mode, padding_mode="zeros", align_corners=False
    )
    return values.squeeze(-1)


def matrix_from_quat(q: Tensor) -> Tensor:
    """Rotation matrices (…, 3, 3) of quaternions (…, 4) in the order w, x, y, z, of any length but zero."""
    w, x, y, z = torch.nn.functional.normalize(q, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*q.shape[:-1], 3, 3)


def quat_from_matrix(R: Tensor) -> Tensor:
    """Unit quaternions (…, 4) in the order w, x, y, z of rotation matrices (…, 3, 3).

    The entries of R give each product 4 qᵢ qⱼ; row i of that matrix is q up to its length. The row
    with the largest diagonal (at least 1) is normalised, so no square root comes near zero and the
    derivative is finite for every rotation. The sign is the one that makes that row's entry positive.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in R.unbind(-2))
    products = [
        1 + a + e + i, h - f, c - g, d - b,
        h - f, 1 + a - e - i, b + d, c + g,
        c - g, b + d, 1 - a + e - i, f + h,
        d - b, c + g, f + h, 1 - a - e + i,
    ]  # fmt: skip
    table = torch.stack(products, -1).reshape(*R.shape[:-2], 4, 4)
    best = table.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = table.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    return torch.nn.functional.normalize(row, dim=-1)
