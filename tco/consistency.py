"""Agreement of one view's depth with the depths that other views predict."""

from __future__ import annotations

import torch
from torch import Tensor

from tco.geometry import invert, project, sample, transform, unproject
from tco.types import Cameras, Prediction


def depth_consistency(
    depth: Tensor, source: int, targets: list[int], cameras: Cameras, context: Prediction, tolerance: float
) -> Tensor:
    """Mean robust disagreement (scalar) of a source depth with the predicted depths of T target views.

    A source pixel lifted by its depth has the depth z in a target and falls where the target predicts
    the inverse depth q; their disagreement is r = log(z q). The penalty |r| is cut off at ``tolerance``
    and weighted by the target's confidence as opacity, 1 − 1 / c. Pixels that the target does not see,
    and those further behind its surface than the tolerance (occluded), do not count. Differentiable in
    the source depth and the cameras; the targets' depths are constants.

    Args:
        depth: (H, W) of the source.
        source: index of the source view.
        targets: indices of the target views.
        cameras: of all views.
        context: depth and confidence of all views.
        tolerance: relative depth difference beyond which two surfaces are taken for different ones.

    Raises:
        ValueError: no target is given.
    """
    if not targets:
        raise ValueError("depth consistency needs at least one target view")
    h, w = depth.shape
    points = transform(cameras.world_from_cam[source], unproject(depth, cameras.K[source]).reshape(-1, 3))
    local = transform(invert(cameras.world_from_cam[targets]), points)
    xy, z = project(local, cameras.K[targets])
    maps = torch.stack([1 / context.depth[targets], 1 - 1 / context.confidence[targets]], 1).detach()
    inverse, trust = sample(maps, xy).unbind(1)
    inside = (xy >= 0.5).all(-1) & (xy[..., 0] <= w - 0.5) & (xy[..., 1] <= h - 0.5) & (z > 1e-3)
    residual = torch.log((z * inverse).clamp_min(1e-4))
    weight = trust * inside * (residual.detach() < tolerance)
    return (weight * residual.abs().clamp_max(tolerance)).sum() / weight.sum().clamp_min(1.0)
