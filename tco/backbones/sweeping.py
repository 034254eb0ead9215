"""Geometry of plane sweeps: relative cameras, ranges of hypotheses, and sparse points as hints of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.spatial import KDTree
from torch import Tensor

from tco.geometry import invert, pixel_grid
from tco.parallel import side_by_side
from tco.types import Cameras, SparseDepth


def scaled(K: Tensor, factor: int) -> Tensor:
    """Intrinsics (…, 3, 3) of maps that are ``factor`` times smaller."""
    return K / K.new_tensor([[factor], [factor], [1.0]])


def relative_cameras(cameras: Cameras, views: Sequence[int], sources: Tensor, factor: int) -> Tensor:
    """(B, S, 3, 4) matrices [A | b]: pixel p of a view at inverse depth w is at A p + b w in a source.

    Args:
        cameras: of all views. views: B of them. sources: (B, S) source views of each.
        factor: maps are this many times smaller than the views.
    """
    K = scaled(cameras.K, factor)
    chosen = list(views)
    source_from_view = invert(cameras.world_from_cam[sources]) @ cameras.world_from_cam[chosen].unsqueeze(1)
    A = K[sources] @ source_from_view[..., :3, :3] @ torch.linalg.inv(K[chosen]).unsqueeze(1)
    b = K[sources] @ source_from_view[..., :3, 3:]
    return torch.cat([A, b], -1)


FAR = 20.0
"""Where the sweep ends, in units of the depth of the farthest points. To cameras as far apart as it takes to
triangulate those, what is there hardly differs from the sky."""

BACKGROUND = FAR / 2
"""Inverse depths below so many times the smallest are background: twice as far as the farthest points."""


def inverse_range(sparse: Sequence[SparseDepth], like: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest and largest inverse depth (V,) of a sweep: the points' 1st percentile × 0.7 to 99th × ``FAR``.

    Raises:
        ValueError: a view has no sparse point.
    """
    lo, hi = [], []
    for i, points in enumerate(sparse):
        if len(points) == 0:
            raise ValueError(f"view {i} has no sparse point, so its depth range is unknown")
        near, far = torch.quantile(points.depth.float(), points.depth.new_tensor([0.01, 0.99]).float())
        lo.append(1 / (FAR * far))
        hi.append(1 / (0.7 * near))
    return torch.stack(lo).to(like), torch.stack(hi).to(like)


@dataclass(frozen=True)
class Hints:
    """Sparse points spread over the pixels of a map.

    Attributes:
        nearest, smooth: (V, h, w) inverse depth of the nearest point and of the nearest few, averaged.
        distance: (V, h, w) log(1 + r), r the way to the nearest point, the longer side of the map being 160.
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
        off = (self.nearest.unsqueeze(1) - planes) / step.unsqueeze(1)
        bump = torch.exp(-0.5 * (off / width.unsqueeze(1)) ** 2)
        middle = planes.mean(1)
        return bump, (((self.smooth - middle) / step).clamp(-12, 12) / 4).unsqueeze(1)

    def as_volume(self, lo: Tensor, step: Tensor, planes: int) -> Tensor:
        """(B, D, h, w, 4): two bumps at the points' planes, the distance, and each plane's place."""
        index = torch.arange(planes, device=lo.device, dtype=lo.dtype).view(1, -1, 1, 1)
        width = (0.7 + 0.35 * self.distance).unsqueeze(1)
        bumps = [
            torch.exp(-0.5 * (((h - lo) / step).unsqueeze(1) - index) ** 2 / width**2)
            for h in (self.nearest, self.smooth)
        ]
        far = (self.distance / 4).unsqueeze(1).expand_as(bumps[0])
        place = (index / (planes - 1)).expand_as(bumps[0])
        return torch.stack([*bumps, far, place], -1)


def interpolate_points(
    sparse: Sequence[SparseDepth], size: tuple[int, int], factor: int, like: Tensor
) -> Hints:
    """Spread the points of each view over a map ``factor`` times smaller than the canvas (H, W).

    ``smooth`` is the mean of the six nearest points' inverse depths, weighted by 1 / (1 + d²) / σ.
    """
    h, w = size[0] // factor, size[1] // factor
    grid = pixel_grid(h, w, like).reshape(-1, 2) * factor
    unit = max(size) / 160

    def of_view(points: SparseDepth) -> tuple[Tensor, Tensor, Tensor]:
        pick = torch.linspace(0, len(points) - 1, min(len(points), 1500)).round().long()
        xy, inv, sigma = (
            points.xy[pick].to(like),
            1 / points.depth[pick].to(like),
            points.sigma[pick].to(like),
        )
        d, index = nearest_points(grid, xy, min(6, len(pick)))
        d = d / unit
        weight = 1 / (1 + d**2) / sigma[index].clamp_min(1e-3)
        mean = (weight * inv[index]).sum(1) / weight.sum(1)
        return inv[index[:, 0]], mean, torch.log1p(d[:, 0])

    parts = side_by_side(of_view, sparse, like.device)
    return Hints(*(torch.stack(x).reshape(len(sparse), h, w) for x in zip(*parts, strict=True)))


def nearest_points(places: Tensor, xy: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Distances, the least first, and indices (N, count) of the points (M, 2) nearest to places (N, 2)."""
    if places.device.type == "cpu":
        distance, index = KDTree(xy.numpy()).query(
            places.numpy(), list(range(1, count + 1)), workers=torch.get_num_threads()
        )
        return torch.from_numpy(distance).to(places), torch.from_numpy(index)
    exact = "donot_use_mm_for_euclid_dist"
    parts = [
        torch.cdist(block, xy, compute_mode=exact).topk(count, largest=False) for block in places.split(8192)
    ]
    return torch.cat([p[0] for p in parts]), torch.cat([p[1] for p in parts])
