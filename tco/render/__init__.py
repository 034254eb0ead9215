"""Rendering of surfels into cameras: one interface, two engines and the twin that defines them.

The semantics are those of gsplat's ``rasterization_2dgs``. At the centre of a pixel, a surfel has
sigma = ½ min(a² + b², 2 |Δ|²) with (a, b) the hit of the ray in units of the radii and Δ the offset in
pixels from the centre of the projected 1σ ellipse; alpha = min(0.99, opacity · exp(−sigma)), skipped
below 1/255. Surfels are composited by the depth of their centres, and a pixel is finished before its
transmittance would fall to 1e-4.

Compositing is biased where surfels overlap, as those of neighbouring pixels do: the nearer one hides its
neighbour, so that a slanted surface is seen moved by up to half a pixel, the more so the more opaque
the surfels are. The engine ``surface`` averages the surfels of the nearest surface instead, which does
not move them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from tco.surfels import Surfels
from tco.types import Cameras, _Movable

__all__ = ["ENGINES", "Engine", "Rendered", "render"]


@dataclass(frozen=True)
class Rendered(_Movable):
    """Images of surfels in T cameras.

    Attributes:
        color: (T, H, W, 3), premultiplied by alpha: black where nothing is.
        depth: (T, H, W) expected depth of the centres, Σ w z / Σ w; 0 where nothing is.
        alpha: (T, H, W) in [0, 1].
    """

    color: Tensor
    depth: Tensor
    alpha: Tensor


class Engine(Protocol):
    """Colour (T, H, W, 3), sum of weighted depths (T, H, W) and alpha (T, H, W) of surfels in T cameras."""

    def __call__(
        self, surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01
    ) -> tuple[Tensor, Tensor, Tensor]: ...


def _cpu(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01
) -> tuple[Tensor, Tensor, Tensor]:
    from tco.render.cpu import rasterize
    from tco.render.project import project

    return rasterize(project(surfels, cameras, size, near, torch.float64), size)


def _surface(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01
) -> tuple[Tensor, Tensor, Tensor]:
    from tco.render.cpu import rasterize_surface
    from tco.render.project import project

    if surfels.means.device.type != "cpu":
        return _surface_pairs(surfels, cameras, size, near)
    return rasterize_surface(project(surfels, cameras, size, near, torch.float64), _focal(cameras), size)


def _surface_pairs(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01
) -> tuple[Tensor, Tensor, Tensor]:
    from tco.render.pairs import rasterize_pairs
    from tco.render.project import project

    return rasterize_pairs(project(surfels, cameras, size, near), _focal(cameras), size)


def _focal(cameras: Cameras) -> Tensor:
    return (cameras.K[:, 0, 0] * cameras.K[:, 1, 1]).sqrt()


def _gsplat(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01
) -> tuple[Tensor, Tensor, Tensor]:
    from tco.render.gsplat import render_gsplat

    return render_gsplat(surfels, cameras, size, near)


def _twin(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01
) -> tuple[Tensor, Tensor, Tensor]:
    from tco.render.twin import render_twin

    return render_twin(surfels, cameras, size, near)


def _surface_twin(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], near: float = 0.01
) -> tuple[Tensor, Tensor, Tensor]:
    from tco.render.twin import render_surface_twin

    return render_surface_twin(surfels, cameras, size, near)


ENGINES: dict[str, Engine] = {
    "cpu": _cpu,
    "surface": _surface,
    "surface_pairs": _surface_pairs,
    "gsplat": _gsplat,
    "twin": _twin,
    "surface_twin": _surface_twin,
}
"""``cpu``: CPU threads, any device. ``surface``: CPU threads, or ``surface_pairs`` where the surfels are on
another device; that is tensor operations, on any. ``gsplat``: CUDA. The twins: brute force, for tests."""


def render(
    surfels: Surfels, cameras: Cameras, size: tuple[int, int], engine: str = "cpu", near: float = 0.01
) -> Rendered:
    """Render N surfels into T target cameras, as images of ``size`` (H, W).

    Differentiable in the surfels, the target poses and (engines ``cpu`` and ``twin``) the target
    intrinsics. Surfels nearer to a target than ``near`` (units of length) are not seen by it.

    Raises:
        ValueError: an engine that does not exist.
        RuntimeError: an engine that cannot run here, with the remedy.
    """
    if engine not in ENGINES:
        raise ValueError(f"there is no renderer {engine!r}; choose from {', '.join(ENGINES)}")
    color, depth, alpha = ENGINES[engine](surfels, cameras, size, near)
    # Where alpha is 0 so is the sum of depths, and the quotient is 0 with a finite derivative.
    return Rendered(color, depth / alpha.clamp_min(1e-10), alpha)
