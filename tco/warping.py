"""Compatibility of views without rendering: a source's pixels looked up in other views.

Each pixel of the source, at its depth, falls on a place of a target. What the target shows there is compared
with what the source shows: the source's depth map is what is moved, so that no surfels are needed and every
pixel of the source has a gradient of its own, at a third of a rendering's cost. What warping cannot do is to
let the nearer of two surfels win; a pixel that a target does not see is found by the target's own depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tco.geometry import invert, project, sample, transform, unproject
from tco.objective import NothingVisibleError, ObjectiveConfig, color_difference
from tco.render import Rendered
from tco.types import Cameras, Prediction, Views


@dataclass(frozen=True)
class Warped:
    """What T targets show at the places that the pixels (H, W) of a source fall on.

    Attributes:
        depth: (T, H, W) camera z of the source's pixels in the targets, differentiable.
        ratio: (T, H, W) that z over the target's own depth; 1 where the two agree.
        color: (T, H, W, C) of the targets.
        valid: (T, H, W) bool, in front of the target, on its image, and on valid pixels of it alone.
    """

    depth: Tensor
    ratio: Tensor
    color: Tensor
    valid: Tensor


def warp(
    depth: Tensor, views: Views, cameras: Cameras, source: int, targets: Sequence[int], context: Prediction
) -> Warped:
    """Look up the pixels of one view in others, bilinearly; depths of the targets in inverse depth.

    Args:
        depth: (H, W) of the source, differentiable.
        views: images, of any number of channels, and valid pixels of all V views.
        cameras: of all V views, differentiable.
        source: index of the source.
        targets: indices of T targets.
        context: prediction for all V views, held constant.

    Raises:
        NothingVisibleError: no pixel of the source falls into a target.
    """
    h, w = depth.shape
    chosen = list(targets)
    target_from_source = invert(cameras.world_from_cam[chosen]) @ cameras.world_from_cam[source]
    points = unproject(depth, cameras.K[source]).reshape(1, -1, 3)
    xy, z = project(transform(target_from_source, points), cameras.K[chosen])
    inside = (z > 1e-3) & ((xy >= 0.5) & (xy <= xy.new_tensor([w, h]) - 0.5)).all(-1)
    if not bool(inside.any()):
        raise NothingVisibleError(f"no pixel of view {source} falls into one of the views {chosen}")
    inverse = 1 / context.depth[chosen].clamp_min(1e-6)
    constant = torch.stack([inverse, views.valid[chosen].to(depth)], 1)
    maps = torch.cat([constant.detach(), views.images[chosen]], 1)
    found = sample(maps, xy).reshape(*maps.shape[:2], h, w)
    z = z.reshape(-1, h, w)
    return Warped(
        depth=z,
        ratio=z * found[:, 0],
        color=found[:, 2:].permute(0, 2, 3, 1),
        valid=inside.reshape(-1, h, w) & (found[:, 1].detach() > 1 - 1e-4),
    )


def warped_photometric(
    warped: Warped, image: Tensor, opacity: Tensor, config: ObjectiveConfig | None = None
) -> Tensor:
    """Weighted mean (scalar) of the colour difference between a source and what the targets show for it.

    The difference is that of :func:`tco.objective.photometric`, in the pixels of the source. A pixel counts,
    by its opacity, where the target is valid and does not see something nearer.

    Args:
        warped: the source in T targets.
        image: (C, H, W) of the source.
        opacity: (H, W) in [0, 1], 0 where the source is not valid.
        config: options; those of alpha and of the renderer have nothing to act on.

    Raises:
        NothingVisibleError: no pixel counts.
    """
    config = config or ObjectiveConfig()
    hidden = warped.ratio.detach() > 1 + config.occlusion_tolerance
    weight = opacity * (warped.valid & ~hidden)
    if not bool((weight > 0).any()):
        raise NothingVisibleError("no valid pixel of the target views shows what the source view sees")
    there = Rendered(warped.color, warped.depth, torch.ones_like(warped.depth))
    return color_difference(there, image.unsqueeze(0), weight, config)
