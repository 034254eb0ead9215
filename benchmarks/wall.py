"""A made-up scene for timing: views of coloured waves on a wall, with exact cameras and points on it."""

from __future__ import annotations

import torch

from tco.geometry import rigid, so3_exp
from tco.types import Cameras, Priors, SparseDepth, Views

DEPTH = 2.0
"""Distance of the wall, in the unit in which the cameras stand 0.3 apart at most."""


def scene(count: int, size: tuple[int, int], points: int = 300) -> tuple[Views, Priors]:
    """So many views of (H, W) pixels from a small arc before the wall."""
    h, w = size
    f = 0.9 * w
    K = torch.tensor([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1.0]]).expand(count, 3, 3).contiguous()
    t = torch.linspace(-1, 1, count).unsqueeze(-1)
    pose = rigid(so3_exp(t * torch.tensor([0.0, -0.05, 0.0])), t * torch.tensor([0.15, 0.02, 0.0]))
    y, x = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], -1)
    images, sparse = [], []
    draw = torch.Generator().manual_seed(0)
    for k in range(count):
        rays = pixels @ K[k].inverse().T @ pose[k, :3, :3].T
        away = (DEPTH - pose[k, 2, 3]) / rays[..., 2]
        wall = pose[k, :3, 3] + away.unsqueeze(-1) * rays
        phase = torch.einsum(
            "hwc,cd->hwd", 25 * wall, torch.tensor([[1.0, 0.4, 0], [0.3, 1, 0.8], [0, 0, 0]])
        )
        images.append((0.5 + 0.4 * torch.sin(phase + phase.roll(1, -1).cos())).permute(2, 0, 1))
        u = torch.randint(w, (points,), generator=draw)
        v = torch.randint(h, (points,), generator=draw)
        xy = torch.stack([u + 0.5, v + 0.5], -1)
        sparse.append(SparseDepth(xy, away[v, u], torch.full((points,), 0.02), torch.arange(points)))
    ones = torch.ones(count, count).fill_diagonal_(0)
    sigma = torch.full((count,), 0.01)
    views = Views(
        torch.stack(images), torch.ones(count, h, w, dtype=torch.bool), tuple(map(str, range(count)))
    )
    return views, Priors(
        Cameras(pose, K), tuple(sparse), overlap=ones, rotation_sigma=sigma, centre_sigma=sigma,
        focal_sigma=sigma,
    )  # fmt: skip
