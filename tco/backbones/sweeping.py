"""Plane sweeps: warping, group-wise correlation, fusion over sources, and sparse points as hypotheses.

All functions are differentiable in features; geometry enters as constants.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tco.geometry import invert, pixel_grid
from tco.types import Cameras, SparseDepth


def scaled(K: Tensor, factor: int) -> Tensor:
    """Intrinsics (…, 3, 3) of maps that are ``factor`` times smaller."""
    return K / K.new_tensor([[factor], [factor], [1.0]])


def relative_cameras(cameras: Cameras, view: int, sources: Tensor, factor: int) -> Tensor:
    """(S, 3, 4) matrices [A | b]: a pixel p of ``view`` at inverse depth w is at A p + b w in a source."""
    K = scaled(cameras.K, factor)
    source_from_view = invert(cameras.world_from_cam[sources]) @ cameras.world_from_cam[view]
    A = K[sources] @ source_from_view[:, :3, :3] @ torch.linalg.inv(K[view])
    b = K[sources] @ source_from_view[:, :3, 3:]
    return torch.cat([A, b], -1)


def warp_grid(matrix: Tensor, planes: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Where hypotheses fall in a source view.

    Args:
        matrix: (3, 4) of :func:`relative_cameras`.
        planes: inverse depths (1, D, h, w) or (1, D, 1, 1).
        height, width: size of both maps.

    Returns:
        Normalised grid (1, D, h, w, 2) for ``grid_sample`` and depth times inverse depth
        (1, D, h, w), positive in front of the source.
    """
    p = pixel_grid(height, width, matrix)
    ones = torch.ones_like(p[..., :1])
    base = torch.cat([p, ones], -1) @ matrix[:, :3].T
    q = base.permute(2, 0, 1)[:, None, None] + matrix[:, 3].view(3, 1, 1, 1, 1) * planes
    z = q[2]
    safe = z.clamp_min(1e-4)
    x, y = q[0] / safe * (2 / width) - 1, q[1] / safe * (2 / height) - 1
    return torch.stack([x, y], -1).clamp(-4, 4), z


def correlations(
    ref: Tensor, source: Tensor, matrix: Tensor, planes: Tensor, groups: int
) -> tuple[Tensor, Tensor]:
    """Group-wise correlation (1, G, D, h, w) of a source with a reference; where seen (1, 1, D, h, w)."""
    _, c, h, w = ref.shape
    with torch.no_grad():
        grid, z = warp_grid(matrix, planes, h, w)
        seen = ((grid.abs() <= 1).all(-1) & (z > 1e-3)).to(ref.dtype)
    d = grid.shape[1]
    warped = F.grid_sample(source, grid.reshape(1, d * h, w, 2), align_corners=False, padding_mode="zeros")
    product = warped.reshape(1, groups, c // groups, d, h, w) * ref.reshape(1, groups, c // groups, 1, h, w)
    return product.mean(2), seen.unsqueeze(1)


def aggregate(parts: Iterable[tuple[Tensor, Tensor]], fuse: nn.Module) -> Tensor:
    """Attention over sources per hypothesis: ``fuse`` gives each source's values and its score.

    A softmax accumulated source by source, so that memory does not grow with their number; where no
    source sees a hypothesis the result is 0.
    """
    total, weights = None, None
    for corr, seen in parts:
        extra = seen.expand(-1, 1, *corr.shape[2:])
        out = fuse(torch.cat([corr, extra, corr.mean(1, keepdim=True) * extra], 1))
        weight = out[:, -1:].clamp(-8, 8).exp() * seen
        total = weight * out[:, :-1] if total is None else total + weight * out[:, :-1]
        weights = weight if weights is None else weights + weight
    if total is None or weights is None:
        raise ValueError("a plane sweep needs at least one source view")
    return total / (weights + 1e-6)


def depth_agreement(
    planes: Tensor, cameras: Cameras, view: int, sources: Tensor, inverse: Tensor, log_error: Tensor
) -> Tensor:
    """What the other views' depths say of each hypothesis.

    Args:
        planes: (1, D, h, w) inverse depths.
        inverse, log_error: (V, h, w) predictions of all views at the same resolution.

    Returns:
        (1, 2·D, h, w): support (the source's surface is here) and conflict (the source looks
        through here), each the mean over the sources that see the hypothesis, weighted by confidence.
    """
    h, w = planes.shape[-2:]
    d = planes.shape[1]
    factor = 2
    support = conflict = weights = torch.zeros((), device=planes.device)
    for s, m in zip(sources.tolist(), relative_cameras(cameras, view, sources, factor), strict=True):
        grid, z = warp_grid(m, planes, h, w)
        maps = torch.stack([inverse[s], log_error[s]]).unsqueeze(0)
        values = F.grid_sample(maps, grid.reshape(1, d * h, w, 2), align_corners=False, padding_mode="border")
        theirs, error = values.reshape(1, 2, d, h, w).unbind(1)
        gap = (z.clamp_min(1e-4) / planes * theirs).clamp_min(1e-4).log()
        seen = ((grid.abs() <= 1).all(-1) & (z > 1e-3)).to(planes.dtype)
        weight = seen * (0.02 / (0.02 + error.exp()))
        sigma = 0.01 + error.exp().clamp_max(0.1)
        support = support + weight * torch.exp(-0.5 * (gap / sigma) ** 2)
        conflict = conflict + weight * torch.sigmoid((-gap - 2 * sigma) / (0.5 * sigma))
        weights = weights + weight
    return torch.cat([support, conflict], 1) / (torch.cat([weights, weights], 1) + 1e-3)


def inverse_range(sparse: Sequence[SparseDepth], like: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest and largest inverse depth (V,) to sweep: the points' 1st percentile × 0.75 to the 99th × 1.4.

    Raises:
        ValueError: a view has no sparse point.
    """
    lo, hi = [], []
    for i, points in enumerate(sparse):
        if len(points) == 0:
            raise ValueError(f"view {i} has no sparse point, so its depth range is unknown")
        near, far = torch.quantile(points.depth.float(), points.depth.new_tensor([0.01, 0.99]).float())
        lo.append(1 / (1.4 * far))
        hi.append(1 / (0.75 * near))
    return torch.stack(lo).to(like), torch.stack(hi).to(like)


@dataclass(frozen=True)
class Hints:
    """Sparse points spread over the pixels of a map.

    Attributes:
        nearest, smooth: (V, h, w) inverse depth of the nearest point and of the nearest few, averaged.
        distance: (V, h, w) log(1 + pixels of the full-size map to the nearest point).
    """

    nearest: Tensor
    smooth: Tensor
    distance: Tensor

    def __getitem__(self, views: Tensor | slice) -> Hints:
        return Hints(self.nearest[views], self.smooth[views], self.distance[views])

    def replaced(self, views: Tensor, other: Hints) -> Hints:
        """A copy in which some views have the hints of ``other``."""
        parts = (
            a.index_copy(0, views, b)
            for a, b in (
                (self.nearest, other.nearest),
                (self.smooth, other.smooth),
                (self.distance, other.distance),
            )
        )
        return Hints(*parts)

    def at(self, planes: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """How hypotheses (B, D, h, w) fit the points, same shape, and their offset in steps (B, 1, h, w)."""
        width = 0.7 + 0.5 * self.distance
        off = (self.nearest.unsqueeze(1) - planes) / step
        bump = torch.exp(-0.5 * (off / width.unsqueeze(1)) ** 2)
        middle = planes.mean(1)
        return bump, (((self.smooth - middle) / step).clamp(-12, 12) / 4).unsqueeze(1)

    def as_volume(self, lo: Tensor, step: Tensor, planes: int) -> Tensor:
        """(B, 4, D, h, w): two bumps at the points' planes, the distance, and each plane's place."""
        index = torch.arange(planes, device=lo.device, dtype=lo.dtype).view(1, -1, 1, 1)
        width = (0.7 + 0.35 * self.distance).unsqueeze(1)
        bumps = [
            torch.exp(-0.5 * (((h - lo) / step).unsqueeze(1) - index) ** 2 / width**2)
            for h in (self.nearest, self.smooth)
        ]
        far = (self.distance / 4).unsqueeze(1).expand_as(bumps[0])
        place = (index / (planes - 1)).expand_as(bumps[0])
        return torch.stack([*bumps, far, place], 1)


def interpolate_points(
    sparse: Sequence[SparseDepth], size: tuple[int, int], factor: int, like: Tensor
) -> Hints:
    """Spread the points of each view over a map ``factor`` times smaller than the canvas (H, W).

    ``smooth`` is the mean of the six nearest points' inverse depths, weighted by 1 / (1 + d²) / σ.
    """
    h, w = size[0] // factor, size[1] // factor
    grid = pixel_grid(h, w, like).reshape(-1, 2) * factor
    nearest, smooth, distance = [], [], []
    for points in sparse:
        pick = torch.linspace(0, len(points) - 1, min(len(points), 1500)).round().long()
        xy, inv, sigma = (
            points.xy[pick].to(like),
            1 / points.depth[pick].to(like),
            points.sigma[pick].to(like),
        )
        k = min(6, len(pick))
        parts = [torch.cdist(block, xy).topk(k, largest=False) for block in grid.split(8192)]
        d, index = torch.cat([p[0] for p in parts]), torch.cat([p[1] for p in parts])
        weight = 1 / (1 + d**2) / sigma[index].clamp_min(1e-3)
        nearest.append(inv[index[:, 0]])
        smooth.append((weight * inv[index]).sum(1) / weight.sum(1))
        distance.append(torch.log1p(d[:, 0]))
    stacked = (torch.stack(x).reshape(len(sparse), h, w) for x in (nearest, smooth, distance))
    return Hints(*stacked)
