"""The warped colour term and its derivative by the source's depth, by compiled loops on a CPU.

What :func:`tco.warping.warp` and :func:`tco.warping.warped_photometric` say together, with which it agrees to
rounding. Those are some hundred operations on pictures, forwards and backwards; here each pixel is looked up,
compared and derived in a few passes. Cameras, pictures and the targets' depths are constants.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tco.geometry import invert
from tco.objective import SSIM_WINDOW, NothingVisibleError, ObjectiveConfig
from tco.ssim import C1, C2, SIGMA
from tco.types import Cameras, Prediction, Views
from tco.warping import warp, warped_photometric

Floats = NDArray[np.float32]


def warped_difference(
    depth: Tensor, opacity: Tensor, views: Views, cameras: Cameras, pair: tuple[int, Sequence[int]],
    context: Prediction, config: ObjectiveConfig,
) -> Tensor:  # fmt: skip
    """Weighted mean (scalar) of the colour difference between a source and what targets show for it.

    Args:
        depth: (H, W) of the source, differentiable.
        opacity: (H, W) in [0, 1], 0 where the source is not valid.
        views: images, of any number of channels, and valid pixels of all V views.
        cameras: of all V views, differentiable.
        pair: the source and its T targets.
        context: prediction for all V views, held constant.
        config: options; those of alpha and of the renderer have nothing to act on.

    Raises:
        NothingVisibleError: no pixel of the source falls into a target, or none counts.
    """
    source, targets = pair
    moving = cameras.world_from_cam.requires_grad or cameras.K.requires_grad or opacity.requires_grad
    if depth.device.type != "cpu" or depth.dtype != torch.float32 or moving:
        warped = warp(depth, views, cameras, source, targets, context)
        return warped_photometric(warped, views.images[source], opacity, config)
    result: Tensor = _Difference.apply(depth, opacity, views, cameras, pair, context, config)
    return result


class _Difference(torch.autograd.Function):
    """The loops; arguments as in :func:`warped_difference`."""

    @staticmethod
    def forward(
        ctx: Any, depth: Tensor, opacity: Tensor, views: Views, cameras: Cameras,
        pair: tuple[int, Sequence[int]], context: Prediction, config: ObjectiveConfig,
    ) -> Tensor:  # fmt: skip
        from tco._warping_kernels import Found, compare, exposure, look_up

        source, targets = pair[0], list(pair[1])
        image = views.images[source].contiguous().numpy()
        ours, weights = depth.detach().contiguous().numpy(), opacity.contiguous().numpy()
        terms, kernel, of_image = (config.structure, C1, C2), *_window(image, config.structure)
        found = Found(np.empty_like(image), np.empty_like(image), np.empty_like(ours))
        work = np.empty((7, *ours.shape), np.float32)
        inside, whole, total, slope = 0, 0.0, 0.0, np.zeros_like(ours)
        for target in _targets(views, cameras, (source, targets), context):
            inside += look_up(ours, weights, config.occlusion_tolerance, target, found)
            whole += exposure(found, image, config.exposure)
            total += compare(found, image, of_image, kernel, terms, work, slope)
        if not inside:
            raise NothingVisibleError(f"no pixel of view {source} falls into one of the views {targets}")
        if not whole > 0:
            raise NothingVisibleError("no valid pixel of the target views shows what the source view sees")
        ctx.save_for_backward(torch.from_numpy(slope / np.float32(whole)))
        return depth.new_tensor(total / whole)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (slope,) = ctx.saved_tensors
        return (grad * slope, *(None,) * 6)


def _targets(
    views: Views, cameras: Cameras, pair: tuple[int, Sequence[int]], context: Prediction
) -> Iterator[Any]:
    """The targets of a source, as the loops want them."""
    from tco._warping_kernels import Target

    source, targets = pair[0], list(pair[1])
    world_from_cam, K = cameras.world_from_cam.double(), cameras.K.double()
    relative = invert(world_from_cam[targets]) @ world_from_cam[source]
    lines = torch.cat([relative[:, :3, :3] @ K[source].inverse(), relative[:, :3, 3:]], -1)
    for target, pose in zip(targets, (K[targets] @ lines).float().numpy(), strict=True):
        inverse = 1 / context.depth[target].detach().clamp_min(1e-6)
        maps = views.images[target], inverse, views.valid[target].float()
        image, far, valid = (x.reshape(-1).numpy() for x in maps)
        yield Target(image, far, valid, pose)


def _window(image: Floats, structure: float) -> tuple[Floats, Floats]:
    """Weights of the structural term's window along an axis; means of a picture and of its square under it.

    Empty if there is no such term.
    """
    from tco._warping_kernels import blur

    if structure == 0:
        return np.empty(0, np.float32), np.empty((len(image), 2, *image.shape[1:]), np.float32)
    kernel = cv2.getGaussianKernel(SSIM_WINDOW, SIGMA)[:, 0].astype(np.float32)
    means = np.empty((len(image), 2, *image.shape[1:]), np.float32)
    for plane, (mean, square) in zip(image, means, strict=True):
        blur(plane, kernel, mean)
        blur(plane**2, kernel, square)
    return kernel, means
