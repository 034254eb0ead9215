"""The CUDA engine: ``rasterization_2dgs`` of gsplat, where that is installed.

Up to gsplat 1.5.1 its backward pass writes no derivative by the view matrices (its pull request 645), so
that poses would silently stay where they are. So surfels are moved into each target's frame by autograd and
rendered through an identity, which holds for every version. Releases up to 1.5.3 bound alpha by 0.999, later
ones and the engines here by 0.99: a difference where surfels are more opaque than that, of confidence above
100.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from tco.geometry import invert, quat_from_matrix, transform
from tco.surfels import Surfels
from tco.types import Cameras

Rasterizer = Callable[..., Any]


def render_gsplat(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (T, H, W, 3), sum of weighted depths (T, H, W) and alpha (T, H, W), in float32.

    Differentiable in the surfels and the poses. gsplat takes no derivative by the intrinsics, so
    intrinsics that require one are an error.

    Raises:
        RuntimeError: gsplat is not installed or could not compile its kernels, or the surfels are not on a
            CUDA device.
        ValueError: intrinsics that require a gradient.
    """
    rasterize = _rasterizer(surfels.means.device)
    if cameras.K.requires_grad and torch.is_grad_enabled():
        raise ValueError('gsplat has no derivative by the intrinsics: detach them, or use engine="cpu"')
    return through_identity(rasterize, surfels, cameras, size, near)


def through_identity(
    rasterize: Rasterizer, surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float
) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`render_gsplat`, target by target, by a function that is called as gsplat's is."""
    height, width = size
    identity = torch.eye(4, device=surfels.means.device).unsqueeze(0)
    images, alphas = [], []
    for pose, K in zip(cameras.world_from_cam, cameras.K, strict=True):
        seen = in_camera(surfels, pose)
        image, alpha, *_ = rasterize(
            means=seen.means.float(),
            quats=seen.quats.float(),
            scales=torch.cat([seen.scales, torch.full_like(seen.scales[:, :1], 1e-6)], -1).float(),
            opacities=seen.opacities.float(),
            colors=seen.colors.float(),
            viewmats=identity,
            Ks=K.unsqueeze(0).float(),
            width=width,
            height=height,
            near_plane=near,
            render_mode="RGB+D",
        )
        images.append(image[0])
        alphas.append(alpha[0, ..., 0])
    every = torch.stack(images)
    return every[..., :3], every[..., 3], torch.stack(alphas)


def in_camera(surfels: Surfels, world_from_cam: Tensor) -> Surfels:
    """The surfels in the frame of a camera (4, 4), differentiable in both."""
    cam_from_world = invert(world_from_cam)
    w, v = quat_from_matrix(cam_from_world[:3, :3]).split([1, 3])
    scalar, vector = surfels.quats.split([1, 3], -1)
    v = v.expand_as(vector)
    quats = torch.cat(
        [
            w * scalar - (v * vector).sum(-1, keepdim=True),
            w * vector + scalar * v + torch.linalg.cross(v, vector),
        ],
        -1,
    )
    means = transform(cam_from_world, surfels.means)
    return Surfels(means, quats, surfels.scales, surfels.opacities, surfels.colors)


def _rasterizer(device: torch.device) -> Rasterizer:
    """gsplat's function, where it can run.

    Raises:
        RuntimeError: it cannot; the message says why.
    """
    otherwise = 'engine="cpu" renders on the CPU whatever the device of the network'
    try:
        from gsplat import rasterization_2dgs
        from gsplat.cuda import _backend
    except ImportError as error:
        raise RuntimeError(
            "the gsplat renderer needs the package gsplat and a CUDA compiler: pip install gsplat; "
            f"{otherwise}"
        ) from error
    if device.type != "cuda":
        raise RuntimeError(f"gsplat renders on CUDA alone, the surfels are on {device}; {otherwise}")
    if _backend._C is None:
        raise RuntimeError(
            "gsplat is installed without its kernels: it compiles them when it is first used, and found no "
            f"CUDA compiler; put NVIDIA's nvcc on the PATH, or set CUDA_HOME; {otherwise}"
        )
    found: Rasterizer = rasterization_2dgs
    return found
