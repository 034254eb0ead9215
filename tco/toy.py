"""A scene in closed form and a network of one layer: for examples, tests and first experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from tco.geometry import invert, pixel_grid, project, rays, rigid, so3_exp, transform
from tco.types import Cameras, Prediction, Priors, SparseDepth, Views


@dataclass(frozen=True)
class Wall:
    """Views of a textured wall that fills them, z = 2 + slope · x in the world.

    Attributes:
        views: V pictures.
        priors: exact cameras, their uncertainties, exact points and how many of them views share.
        depth: (V, H, W) the truth.
    """

    views: Views
    priors: Priors
    depth: Tensor


def wall(views: int = 4, size: tuple[int, int] = (48, 64), slope: float = 0.3, points: int = 60) -> Wall:
    """The wall as cameras on a small arc see it; the same every time.

    Colours are sums of waves along the wall, of lengths down to eight pixels, and are computed at the
    centres of pixels. The standard deviations of the cameras are 0.1° and, in units of length, 0.002;
    those of focal lengths 0.2 %, those of relative depths 1 %.
    """
    h, w = size
    K = torch.tensor([[0.9 * w, 0, w / 2], [0, 0.9 * w, h / 2], [0, 0, 1]]).repeat(views, 1, 1)
    step = torch.linspace(-1, 1, views).unsqueeze(-1)
    pose = rigid(so3_exp(step * torch.tensor([0.03, -0.12, 0.02])), step * torch.tensor([0.25, 0.06, 0.05]))
    normal = torch.tensor([-slope, 0.0, 1.0])
    ray = rays(pixel_grid(h, w, K).reshape(1, -1, 2), K) @ pose[:, :3, :3].transpose(1, 2)
    depth = (2 - pose[:, :3, 3] @ normal).unsqueeze(-1) / (ray @ normal)
    images = _texture(pose[:, None, :3, 3] + depth.unsqueeze(-1) * ray)
    generator = torch.Generator().manual_seed(0)
    at = 0.8 * (torch.rand(points, 2, generator=generator) - 0.5) * torch.tensor([2.2, 1.6])
    seen = _sparse(torch.cat([at, 2 + slope * at[:, :1]], 1), Cameras(pose, K), size)
    common = torch.tensor([[len(set(a.track.tolist()) & set(b.track.tolist())) for b in seen] for a in seen])
    priors = Priors(
        Cameras(pose, K),
        seen,
        overlap=common.float().fill_diagonal_(0),
        rotation_sigma=torch.full((views,), 0.00175),
        centre_sigma=torch.full((views,), 0.002),
        focal_sigma=torch.full((views,), 0.002),
    )
    names = tuple(f"wall {i}" for i in range(views))
    pictures = Views(images.transpose(1, 2).reshape(views, 3, h, w), torch.ones(views, h, w).bool(), names)
    return Wall(pictures, priors, depth.reshape(views, h, w))


def _texture(points: Tensor) -> Tensor:
    """Colours (…, 3) of world points (…, 3), in [0.1, 0.9]."""
    count = torch.arange(1, 13)
    waves = 12 * torch.randn(3, 12, 2, generator=torch.Generator().manual_seed(1)) / count.unsqueeze(-1)
    phase = torch.einsum("cki,...i->...ck", waves, points[..., :2]) + 0.7 * count
    return 0.5 + 0.4 * torch.tanh(2 * torch.sin(phase).mean(-1))


def _sparse(points: Tensor, cameras: Cameras, size: tuple[int, int]) -> tuple[SparseDepth, ...]:
    """World points (N, 3) as each view sees them."""
    xy, z = project(transform(invert(cameras.world_from_cam), points.unsqueeze(0)), cameras.K)
    inside = ((xy > 0) & (xy < xy.new_tensor([size[1], size[0]]))).all(-1)
    return tuple(
        SparseDepth(p[keep], d[keep], torch.full((int(keep.sum()),), 0.01), keep.nonzero()[:, 0])
        for p, d, keep in zip(xy, z, inside, strict=True)
    )


class Toy(nn.Module):
    """A backbone that says the world is one plane n · X = 1; the n of its only layer is what it knows.

    It satisfies :class:`tco.backbones.base.Backbone`, takes cameras as given, and points not at all.
    """

    name, stride, uses_cameras = "toy", 1, True

    def __init__(self, normal: Sequence[float] = (0.0, 0.0, 0.45)) -> None:
        """Start with a plane; :func:`wall` is (−slope / 2, 0, 1 / 2)."""
        super().__init__()
        self.plane = nn.Linear(3, 1, bias=False)
        self.plane.weight = nn.Parameter(torch.tensor([normal]))

    def encode(self, views: Views, priors: Priors) -> tuple[Tensor, Tensor, Cameras]:
        """Rays of all pixels (V, H, W, 3) and centres (V, 3) in the world, and the cameras."""
        assert priors.cameras is not None
        c, (h, w) = priors.cameras, views.size
        local = rays(pixel_grid(h, w, c.K).reshape(1, -1, 2), c.K)
        ray = local @ c.world_from_cam[:, :3, :3].transpose(1, 2)
        return ray.reshape(-1, h, w, 3), c.world_from_cam[:, :3, 3], c

    def with_points(self, encoded: Any, points: Mapping[int, SparseDepth]) -> Any:
        """The same, as points are not used."""
        return encoded

    def decode(
        self, encoded: Any, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        """Depth (V, H, W) where the rays meet the plane, with a confidence of 10 everywhere."""
        rays, centres, cameras = encoded
        chosen = tuple(range(len(centres))) if views is None else tuple(views)
        ray, centre = rays[list(chosen)], centres[list(chosen)]
        inverse = self.plane(ray)[..., 0] / (1 - self.plane(centre)).unsqueeze(-1)
        depth = 1 / inverse.clamp_min(1e-3)
        return Prediction(depth, torch.full_like(depth, 10.0), cameras, chosen)

    def decoder(self) -> nn.Module:
        """The network itself."""
        return self
