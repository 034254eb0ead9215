"""Surfels to splats: everything that is computed once a surfel and target, by autograd.

A point (a, b) of a surfel's tangent plane, in units of its radii, is seen at the homogeneous pixel
``a · T[0] + b · T[1] + T[2]``; the rows of the ray transform T are the images of the two scaled
tangents and of the centre (2D Gaussian splatting, Huang et al. 2024, eq. 8; the notation M = T).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from tco.geometry import invert, matrix_from_quat
from tco.render.kernels import MIN_ALPHA
from tco.surfels import Surfels
from tco.types import Cameras


@dataclass(frozen=True)
class Splats:
    """N surfels as T targets see them.

    Attributes:
        transforms: (T, N, 3, 3) ray transforms; row k is the image of tangent 1, tangent 2, centre.
        centres: (T, N, 2) pixel centres of the projected ellipses.
        depths: (T, N) camera z of the surfels' centres.
        opacities: (N,).
        colors: (N, 3).
        boxes: (T, N, 4) int32 pixels x0, x1, y0, y1, half-open, outside of which a splat's alpha is
            below ``MIN_ALPHA``; x0 = x1 for one that is not seen.
    """

    transforms: Tensor
    centres: Tensor
    depths: Tensor
    opacities: Tensor
    colors: Tensor
    boxes: Tensor


def project(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01,
    exact: torch.dtype | None = None,
) -> Splats:  # fmt: skip
    """Splats of N surfels in T target cameras for images of ``size`` (H, W).

    Differentiable in the surfels, the poses and the intrinsics. Ray transforms are computed in the type
    ``exact``, by default that of the surfels. A surfel is not seen by a target if its centre is nearer than
    ``near`` (units of length), or if its 1σ ellipse reaches behind the camera.

    Raises:
        ValueError: intrinsics whose last row is not 0, 0, 1.
    """
    last = cameras.K[:, 2].detach()
    if not torch.equal(last, last.new_tensor([0.0, 0.0, 1.0]).expand_as(last)):
        raise ValueError("the last row of K must be 0, 0, 1")
    exact = exact or surfels.means.dtype
    pixels_from_world = cameras.K.to(exact) @ invert(cameras.world_from_cam.to(exact))[:, :3]
    axes = matrix_from_quat(surfels.quats.to(exact))[..., :2] * surfels.scales.to(exact).unsqueeze(-2)
    frame = torch.cat([axes, surfels.means.to(exact).unsqueeze(-1)], -1).transpose(-1, -2)
    origin = frame.new_tensor([0.0, 0.0, 1.0]).expand(len(surfels), 3).unsqueeze(-1)
    local = torch.cat([frame, origin], -1).reshape(-1, 4)
    transforms = (local @ pixels_from_world.transpose(-1, -2)).reshape(len(cameras), len(surfels), 3, 3)
    rounded = transforms.to(surfels.means.dtype)
    columns = rounded.unbind(-1)
    depths = columns[2][..., 2]
    centres, ellipse = _centres(*columns)
    seen = ellipse & (depths > near) & (surfels.opacities > MIN_ALPHA)
    with torch.no_grad():
        boxes = _boxes(rounded, centres, surfels.opacities, seen, size)
    return Splats(transforms, centres, depths, surfels.opacities, surfels.colors, boxes)


def _centres(x: Tensor, y: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Centres (T, N, 2) of the images of the unit discs, and which of these are ellipses (T, N).

    The dual of the unit disc is D = diag(1, 1, −1). With the columns x, y, w of the ray transform, its
    image has its centre at the pole of the line at infinity, (xᵗ D w, yᵗ D w) / wᵗ D w. A denominator
    of zero or more means that the disc touches the plane through the camera, and that its image is not
    an ellipse; the centre is then 0 / −1.
    """
    dual = w * w.new_tensor([1.0, 1.0, -1.0])
    norm = (dual * w).sum(-1)
    ellipse = norm < 0
    dual = torch.where(ellipse.unsqueeze(-1), dual, 0.0)
    norm = torch.where(ellipse, norm, -1.0).unsqueeze(-1)
    return torch.stack([(x * dual).sum(-1), (y * dual).sum(-1)], -1) / norm, ellipse


def _boxes(
    transforms: Tensor, centres: Tensor, opacities: Tensor, seen: Tensor, size: tuple[int, int]
) -> Tensor:
    """Pixel boxes (T, N, 4) that hold the disc of radius r = √(2 ln(opacity / MIN_ALPHA)) around each surfel.

    At that radius alpha falls below ``MIN_ALPHA``. The box also holds the circle of r / √2 pixels around
    the centre, where the low-pass filter is above it. A disc of which a part lies behind the camera
    plane (which its 1σ core does not) is bounded by the whole image.
    """
    r2 = 2 * torch.log((opacities / MIN_ALPHA).clamp_min(1.0))
    sign = torch.stack([r2, r2, -torch.ones_like(r2)], -1)
    w = transforms[..., 2] * sign
    norm = (w * transforms[..., 2]).sum(-1)
    bounded = norm < 0
    safe = torch.where(bounded, norm, -torch.ones_like(norm)).unsqueeze(-1)
    middle = (transforms[..., :2] * w.unsqueeze(-1)).sum(-2) / safe
    spread = (transforms[..., :2] ** 2 * sign.unsqueeze(-1)).sum(-2) / safe
    extent = (middle**2 - spread).clamp_min(0).sqrt()
    filtered = (r2 / 2).sqrt().unsqueeze(-1)
    # The pixel with index i has its centre at i + 0.5. A margin of 0.01 px absorbs rounding.
    low = torch.minimum(middle - extent, centres - filtered) - 0.51
    high = torch.maximum(middle + extent, centres + filtered) + 0.51
    low = torch.where(bounded.unsqueeze(-1), low, -math.inf)
    high = torch.where(bounded.unsqueeze(-1), high, math.inf)
    limit = low.new_tensor([size[1], size[0]])
    low = torch.minimum(low.ceil().clamp_min(0), limit)
    high = torch.minimum(high.floor().clamp_min(0), limit)
    high = torch.where(seen.unsqueeze(-1), torch.maximum(low, high), low)
    empty = (high <= low).any(-1, keepdim=True)
    box = torch.stack([low[..., 0], high[..., 0], low[..., 1], high[..., 1]], -1)
    return torch.where(empty, torch.zeros_like(box), box).to(torch.int32)


def finished(color: Tensor, depth: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sums over the surfels of a surface, (T, H, W, 3) and two (T, H, W), scaled so that they end at alpha.

    Alpha is 1 − exp(−Σ w), and the weights are divided by their sum and multiplied by it.
    """
    alpha = 1 - torch.exp(-weight)
    # Alpha / Σ w tends to 1; where nothing is, the sums that it multiplies are 0.
    share = alpha / weight.clamp_min(1e-10)
    return color * share.unsqueeze(-1), depth * share, alpha
