"""The CUDA engine: ``rasterization_2dgs`` of gsplat, where that is installed."""

from __future__ import annotations

import torch
from torch import Tensor

from tco.geometry import invert
from tco.surfels import Surfels
from tco.types import Cameras


def render_gsplat(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (T, H, W, 3), sum of weighted depths (T, H, W) and alpha (T, H, W), in float32.

    Differentiable in the surfels and the poses. gsplat takes no derivative by the intrinsics, so
    intrinsics that require one are an error.

    Raises:
        RuntimeError: gsplat is not installed, or the surfels are not on a CUDA device.
        ValueError: intrinsics that require a gradient.
    """
    try:
        from gsplat import rasterization_2dgs
    except ImportError as error:
        raise RuntimeError(
            "the gsplat renderer needs the package gsplat and a CUDA compiler: pip install gsplat, or use "
            'engine="cpu", which renders on the CPU whatever the device of the network'
        ) from error
    if surfels.means.device.type != "cuda":
        raise RuntimeError(f"gsplat renders on CUDA alone, the surfels are on {surfels.means.device}")
    if cameras.K.requires_grad and torch.is_grad_enabled():
        raise ValueError('gsplat has no derivative by the intrinsics: detach them, or use engine="cpu"')
    flat = torch.full_like(surfels.scales[:, :1], 1e-6)
    image, alpha, *_ = rasterization_2dgs(
        means=surfels.means.float(),
        quats=surfels.quats.float(),
        scales=torch.cat([surfels.scales, flat], -1).float(),
        opacities=surfels.opacities.float(),
        colors=surfels.colors.float(),
        viewmats=invert(cameras.world_from_cam).float(),
        Ks=cameras.K.float(),
        width=size[1],
        height=size[0],
        near_plane=near,
        render_mode="RGB+D",
    )
    return image[..., :3], image[..., 3], alpha[..., 0]
