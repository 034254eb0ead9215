"""Compatibility of views: what one view's surfels look like in the others, against what is there.

Both terms are means over the target pixels with the weight alpha · [visible] · [valid], where alpha is
that of the rendering. A pixel is visible where the rendered depth is not behind the target's own
predicted depth by more than a tolerance; where it is, the target sees something nearer, and the
comparison would punish a correct occlusion.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tco.config import knob
from tco.render import Rendered, render
from tco.ssim import ssim
from tco.surfels import Surfels
from tco.types import Cameras

SSIM_WINDOW = 7
"""Side of the window of the structural term, pixels."""


class NothingVisibleError(ValueError):
    """No valid target pixel sees the surfels: the views do not overlap, or the depths contradict."""


@dataclass(frozen=True)
class ObjectiveConfig:
    """How a rendering is compared with a target; :meth:`reference` is the published code's way."""

    occlusion_tolerance: float = knob(
        0.02,
        "A pixel counts where rendered depth ≤ (1 + this) · predicted depth + occlusion_of_mean · mean "
        "predicted depth. Raise it where depths are coarse: errors above it are taken for occlusions.",
    )
    occlusion_of_mean: float = knob(
        0.0, "Tolerance as a part of the mean depth of all targets; the published code has 1e-4 of this kind."
    )
    unpremultiply: bool = knob(
        True, "Divide rendered colours by alpha, so that transparency is not taken for darkness."
    )
    exposure: bool = knob(
        False,
        "Match mean and contrast of each colour channel for each pair of views before the comparison; the "
        "gain and bias are constants of the step.",
    )
    structure: float = knob(
        0.0, "Share s of the structural term: (1 − s) · L1 + s · (1 − SSIM) / 2. 0.85 is common with SSIM."
    )
    renderer: str = knob(
        "surface",
        "Engine that renders the surfels. surface puts the lowest loss at the true depth; cpu and gsplat "
        "composite as published, which moves it by up to half a pixel of parallax.",
        choices=("surface", "cpu", "gsplat"),
    )

    @classmethod
    def reference(cls) -> ObjectiveConfig:
        """The settings that reproduce the published code, which also has the source among its targets."""
        return cls(occlusion_tolerance=0.0, occlusion_of_mean=1e-4, unpremultiply=False, renderer="cpu")


def photometric(
    surfels: Surfels, images: Tensor, cameras: Cameras, depth: Tensor,
    valid: Tensor | None = None, config: ObjectiveConfig | None = None,
) -> Tensor:  # fmt: skip
    """Weighted mean (scalar) of the colour difference between rendered surfels and T target views.

    Differentiable in the surfels, the cameras and the images.

    Args:
        surfels: of the source view.
        images: (T, 3, H, W) RGB in [0, 1].
        cameras: T target cameras.
        depth: (T, H, W) predicted depth of the targets, which decides on visibility alone.
        valid: (T, H, W) bool, or None if all pixels are.
        config: weights and options.

    Raises:
        NothingVisibleError: no pixel counts.
    """
    config = config or ObjectiveConfig()
    rendered = render(surfels, cameras, _size(depth), config.renderer)
    return color_difference(rendered, images, weights(rendered, depth, valid, config), config)


def geometric(
    surfels: Surfels, cameras: Cameras, depth: Tensor,
    valid: Tensor | None = None, config: ObjectiveConfig | None = None,
) -> Tensor:  # fmt: skip
    """Weighted mean (scalar) of the depth difference between rendered surfels and T target views.

    Differentiable in the surfels, the cameras and the target depth. Arguments and errors as in
    :func:`photometric`.
    """
    config = config or ObjectiveConfig()
    rendered = render(surfels, cameras, _size(depth), config.renderer)
    return depth_difference(rendered, depth, weights(rendered, depth, valid, config))


def weights(rendered: Rendered, depth: Tensor, valid: Tensor | None, config: ObjectiveConfig) -> Tensor:
    """Weight (T, H, W) of each target pixel: alpha where the surfels are visible and the pixel valid.

    Raises:
        NothingVisibleError: all weights are zero.
    """
    depth = depth.detach()
    limit = (1 + config.occlusion_tolerance) * depth + config.occlusion_of_mean * depth.mean()
    counted = rendered.depth.detach() <= limit
    if valid is not None:
        counted = counted & valid
    weight = rendered.alpha * counted
    if not bool((weight > 0).any()):
        raise NothingVisibleError("no valid pixel of the target views sees the surfels of the source view")
    return weight


def color_difference(rendered: Rendered, images: Tensor, weight: Tensor, config: ObjectiveConfig) -> Tensor:
    """Weighted mean (scalar) of L1 over the channels, mixed with the structural term by ``config.structure``.

    Args:
        rendered: T renderings.
        images: (T, 3, H, W), or (1, 3, H, W) where all are compared with the same.
        weight: (T, H, W), not all zero.
        config: exposure, structure and the treatment of alpha.
    """
    color = rendered.color
    if config.unpremultiply:
        # A pixel of no alpha has no colour and no weight; below 1/255 the renderer draws nothing.
        color = color / rendered.alpha.clamp_min(1 / 255).unsqueeze(-1)
    image = images.permute(0, 2, 3, 1)
    if config.exposure:
        gain, bias = match_exposure(color.detach(), image, weight)
        color = gain * color + bias
    error = (color - image).abs().mean(-1)
    if config.structure > 0:
        error = (1 - config.structure) * error + config.structure * _dissimilarity(color, image, weight)
    return _mean(error, weight)


def depth_difference(rendered: Rendered, depth: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean (scalar) of the L1 of depth (T, H, W) and of its central differences in the image."""
    error = (rendered.depth - depth).abs()
    slopes = (torch.gradient(d, dim=(1, 2)) for d in (rendered.depth, depth))
    for ours, theirs in zip(*slopes, strict=True):
        error = error + (ours - theirs).abs()
    return _mean(error, weight)


def match_exposure(color: Tensor, image: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Gain and bias (T, 1, 1, 3) that give ``color`` the weighted mean and deviation of ``image``.

    gain = √((var image + ε) / (var color + ε)), within [1/2, 2], and bias = mean image − gain · mean
    color. A least-squares gain would shrink towards 0 where the two are misaligned and so reward it;
    equal moments do not depend on the alignment. ε = 1e-4 keeps the gain of flat regions near 1.

    Args:
        color: (T, H, W, 3).
        image: (T, H, W, 3).
        weight: (T, H, W); the moments are over the pixels with weight, and 0 for a target without any.
    """
    w = weight.detach().unsqueeze(-1)
    w = w / w.sum((1, 2), keepdim=True).clamp_min(1e-12)
    mean_color, mean_image = ((w * x).sum((1, 2), keepdim=True) for x in (color, image))
    var_color = (w * (color - mean_color) ** 2).sum((1, 2), keepdim=True)
    var_image = (w * (image - mean_image) ** 2).sum((1, 2), keepdim=True)
    gain = ((var_image + 1e-4) / (var_color + 1e-4)).sqrt().clamp(0.5, 2.0)
    return gain, mean_image - gain * mean_color


def _dissimilarity(color: Tensor, image: Tensor, weight: Tensor) -> Tensor:
    """(1 − SSIM) / 2 of each pixel (T, H, W), averaged over the channels.

    Pixels without weight take the target's colour, so that they agree in the windows of the others.
    """
    filled = torch.where((weight > 0).unsqueeze(-1), color, image).permute(0, 3, 1, 2)
    similarity = ssim(filled, image.permute(0, 3, 1, 2), SSIM_WINDOW)
    return ((1 - similarity) / 2).clamp(0, 1).mean(1)


def _mean(error: Tensor, weight: Tensor) -> Tensor:
    return (weight * error).sum() / weight.sum()


def _size(depth: Tensor) -> tuple[int, int]:
    return int(depth.shape[-2]), int(depth.shape[-1])
