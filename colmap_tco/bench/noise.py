"""Cameras that are wrong by a known amount."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tco.types import Cameras, Priors


@dataclass(frozen=True)
class Noise:
    """Standard deviations: degrees of rotation, shares of the distance of centres and of the focal length."""

    rotation: float = 0.0
    translation: float = 0.0
    focal: float = 0.0

    def __str__(self) -> str:
        parts = []
        if self.rotation:
            parts.append(f"rotation {self.rotation:g}°")
        if self.translation:
            parts.append(f"translation {100 * self.translation:g} %")
        if self.focal:
            parts.append(f"focal {100 * self.focal:g} %")
        return ", ".join(parts) or "none"

    def __call__(self, priors: Priors, seed: int, stated: float = 1.0) -> Priors:
        """Priors with cameras that are wrong by this much, and know it; points and overlap stay as they are.

        Args:
            priors: with cameras and their standard deviations, to which those of the noise are added.
            seed: of the noise; see :meth:`cameras`.
            stated: standard deviations that are told over those that are drawn from.
        """
        import torch

        cameras = priors.cameras
        assert cameras is not None and priors.rotation_sigma is not None
        assert priors.centre_sigma is not None and priors.focal_sigma is not None
        unit = _unit(cameras)
        # A normal length in a random direction has a third of its variance along each axis.
        third = stated * math.sqrt(1 / 3)
        return replace(
            priors,
            cameras=self.cameras(cameras, seed),
            rotation_sigma=priors.rotation_sigma.hypot(torch.tensor(third * math.radians(self.rotation))),
            centre_sigma=priors.centre_sigma.hypot(torch.tensor(third * self.translation * unit)),
            focal_sigma=priors.focal_sigma.hypot(torch.tensor(stated * self.focal)),
        )

    def cameras(self, cameras: Cameras, seed: int) -> Cameras:
        """Every camera of V turned about a random axis by a normal angle, its centre moved in a random
        direction by a normal length, in parts of the mean distance of the centres from their middle, and its
        focal length multiplied by the exponential of a normal number. Noises of one seed differ in their
        sizes alone: axes, directions and normal numbers are the same."""
        import torch

        from tco.geometry import rigid, so3_exp
        from tco.types import Cameras

        v, g = len(cameras), torch.Generator().manual_seed(seed)
        axis, way = torch.nn.functional.normalize(torch.randn(2, v, 3, generator=g), dim=-1)
        angle, shift, zoom = torch.randn(3, v, 1, generator=g)
        centre = cameras.world_from_cam[:, :3, 3]
        R = cameras.world_from_cam[:, :3, :3] @ so3_exp(math.radians(self.rotation) * angle * axis)
        K = cameras.K.clone()
        K[:, [0, 1], [0, 1]] *= torch.exp(self.focal * zoom)
        return Cameras(rigid(R, centre + self.translation * _unit(cameras) * shift * way), K)


def _unit(cameras: Cameras) -> float:
    """Mean distance of the centres from their middle."""
    centre = cameras.world_from_cam[:, :3, 3]
    return float((centre - centre.mean(0)).norm(dim=-1).mean())
