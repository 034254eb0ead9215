"""Warping and correlation of feature maps, and agreement with other views' depths.

On a CPU compiled loops do both in one pass; elsewhere torch's own operators. The two agree to rounding.
Nothing here is differentiable in the cameras or the hypotheses, only in the features.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tco.geometry import pixel_grid
from tco.parallel import in_ranges


def correlate(
    features: Tensor, pairs: Tensor, matrices: Tensor, planes: Tensor, groups: int, last: bool = False
) -> tuple[Tensor, Tensor]:
    """Group-wise correlation of reference views with source views warped by hypotheses.

    Args:
        features: (V, C, h, w); channel c is of group c % groups.
        pairs: (B, 2) indices of reference and source.
        matrices: (B, 3, 4) of :func:`tco.backbones.sweeping.relative_cameras`.
        planes: (B, D, h, w) or (B, D, 1, 1) inverse depths.
        groups: G.
        last: put the hypotheses behind the pixels.

    Returns:
        Means of products over each group, (B, D, h, w, G), or (B, h, w, D, G) if ``last``; 0 where
        the source does not see the hypothesis; and whether it does, the same without G, float.
    """
    f = features.permute(0, 2, 3, 1).contiguous()
    if f.device.type == "cpu" and f.dtype == torch.float32:
        return _Correlation.apply(f, pairs, matrices, planes, groups, last)
    return correlate_plainly(f, pairs, matrices, planes, groups, last)


def project(matrices: Tensor, planes: Tensor, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Where hypotheses fall in the sources.

    Args:
        matrices: (B, 3, 4). planes: (B, D, h, w) or (B, D, 1, 1).

    Returns:
        Grid (B, D, h, w, 2) for ``grid_sample``, depth times inverse depth and visibility (B, D, h, w).
    """
    p = pixel_grid(height, width, matrices)
    base = torch.cat([p, torch.ones_like(p[..., :1])], -1) @ matrices[:, None, :, :3].transpose(-1, -2)
    q = base.unsqueeze(1) + matrices[:, None, None, None, :, 3] * planes.unsqueeze(-1)
    z = q[..., 2]
    xy = q[..., :2] / z.clamp_min(1e-4).unsqueeze(-1)
    grid = xy * (2 / xy.new_tensor([width, height])) - 1
    return grid.clamp(-4, 4), z, (grid.abs() <= 1).all(-1) & (z > 1e-3)


def correlate_plainly(
    f: Tensor, pairs: Tensor, matrices: Tensor, planes: Tensor, groups: int, last: bool
) -> tuple[Tensor, Tensor]:
    """:func:`correlate` by ``grid_sample``, for any device; features (V, h, w, C)."""
    _, h, w, c = f.shape
    grid, _, seen = project(matrices, planes, h, w)
    b, d = grid.shape[:2]
    source = f[pairs[:, 1]].permute(0, 3, 1, 2)
    warped = F.grid_sample(
        source, grid.reshape(b, d * h, w, 2), align_corners=False, padding_mode="border"
    ).reshape(b, c // groups, groups, d, h, w)
    ref = f[pairs[:, 0]].permute(0, 3, 1, 2).reshape(b, c // groups, groups, 1, h, w)
    out = ((warped * ref).mean(1) * seen.unsqueeze(1)).permute(0, 2, 3, 4, 1)
    mask = seen.to(f.dtype)
    return (out.permute(0, 2, 3, 1, 4), mask.permute(0, 2, 3, 1)) if last else (out, mask)


def agree(planes: Tensor, matrices: Tensor, sources: Tensor, inverse: Tensor, log_error: Tensor) -> Tensor:
    """What other views' depths say of each hypothesis.

    Args:
        planes: (B, D, h, w) inverse depths of the reference views.
        matrices: (B, S, 3, 4) to the sources. sources: (B, S) indices into the maps.
        inverse, log_error: (V, h, w) predictions of all views at the same resolution.

    Returns:
        (B, 2·D, h, w): support (the source's surface is here) and conflict (the source looks
        through here), each the mean over the sources that see the hypothesis, weighted by confidence.
    """
    if planes.device.type != "cpu" or planes.dtype != torch.float32:
        return agree_plainly(planes, matrices, sources, inverse, log_error)
    from tco.backbones._warp_kernels import Maps, agreement

    b, d, h, w = planes.shape
    out = torch.empty(b, 2 * d, h, w)
    maps = Maps(_flat(matrices), _ints(sources), _flat(inverse), _flat(log_error))
    shape, flat, result = (h, w, d, sources.shape[1]), _flat(planes), out.numpy().reshape(-1)
    in_ranges(lambda *rows: agreement(flat, maps, shape, result, rows), b * h)
    return out


def agree_plainly(
    planes: Tensor, matrices: Tensor, sources: Tensor, inverse: Tensor, log_error: Tensor
) -> Tensor:
    """:func:`agree` by ``grid_sample``, for any device."""
    b, d, h, w = planes.shape
    support = conflict = torch.zeros_like(planes)
    weights = torch.full_like(planes, 1e-3)
    for s in range(sources.shape[1]):
        grid, z, seen = project(matrices[:, s], planes, h, w)
        maps = torch.stack([inverse[sources[:, s]], log_error[sources[:, s]]], 1)
        values = F.grid_sample(maps, grid.reshape(b, d * h, w, 2), align_corners=False, padding_mode="border")
        theirs, error = values.reshape(b, 2, d, h, w).unbind(1)
        gap = (z / planes * theirs).clamp_min(1e-4).log()
        error = error.exp()
        weight = seen * (0.02 / (0.02 + error))
        sigma = 0.01 + error.clamp_max(0.1)
        support = support + weight * torch.exp(-0.5 * (gap / sigma) ** 2)
        conflict = conflict + weight * torch.sigmoid((-gap - 2 * sigma) / (0.5 * sigma))
        weights = weights + weight
    return torch.cat([support / weights, conflict / weights], 1)


class _Correlation(torch.autograd.Function):
    """Compiled :func:`correlate` with its gradient for the features."""

    @staticmethod
    def forward(
        ctx: Any, f: Tensor, pairs: Tensor, matrices: Tensor, planes: Tensor, groups: int, last: bool
    ) -> tuple[Tensor, Tensor]:
        from tco.backbones._warp_kernels import forward_kernel

        _, h, w, c = f.shape
        b, d = planes.shape[:2]
        layout = _layout(planes.shape, (h, w, groups), last)
        out = f.new_empty((b, h, w, d, groups) if last else (b, d, h, w, groups))
        seen = f.new_empty(out.shape[:-1])
        run, flat, geometry = forward_kernel(c, groups), _flat(f), _geometry(pairs, matrices, planes)
        o, s = out.numpy().reshape(-1), seen.numpy().reshape(-1)
        in_ranges(lambda *rows: run(flat, geometry, layout, o, s, rows), b * h)
        ctx.save_for_backward(f, pairs, matrices, planes)
        ctx.groups, ctx.layout = groups, layout
        ctx.mark_non_differentiable(seen)
        return out, seen

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        from tco.backbones._warp_kernels import backward_kernel

        f, pairs, matrices, planes = ctx.saved_tensors
        h, w, c = f.shape[1:]
        grads = f.new_zeros((len(pairs), 2, h, w, c))
        run, flat, geometry = backward_kernel(c, ctx.groups), _flat(f), _geometry(pairs, matrices, planes)
        up, into = _flat(upstream[0]), grads.numpy().reshape(-1)
        in_ranges(lambda *rows: run(flat, geometry, ctx.layout, up, into, rows), len(pairs))
        total = torch.zeros_like(f)
        total.index_add_(0, pairs.reshape(-1), grads.flatten(0, 1))
        return total, None, None, None, None, None


def _layout(planes: torch.Size, size: tuple[int, int, int], last: bool) -> Any:
    """Sizes and distances between neighbours, as the compiled loops want them."""
    from tco.backbones._warp_kernels import Layout

    h, w, g = size
    d = planes[1]
    before = (d * h * w, h * w, w, 1) if planes[2] > 1 else (d, 1, 0, 0)
    after = (h * w * d * g, g, w * d * g, d * g) if last else (d * h * w * g, h * w * g, w * g, g)
    return Layout(h, w, d, *before, *after)


def _geometry(pairs: Tensor, matrices: Tensor, planes: Tensor) -> Any:
    from tco.backbones._warp_kernels import Geometry

    return Geometry(_ints(pairs), _flat(matrices), _flat(planes))


def _flat(x: Tensor) -> Any:
    return x.detach().contiguous().numpy().reshape(-1)


def _ints(x: Tensor) -> Any:
    return np.ascontiguousarray(x.numpy().reshape(-1).astype(np.int64))
