"""Small learned corrections of given cameras, held by their priors."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tco.geometry import rigid, so3_exp
from tco.penalties import robust_norm, rotation_angle
from tco.types import Cameras, Priors


class CameraCorrections(nn.Module):
    """One rotation, one shift of the centre and one log focal factor a view, all zero at first.

    The parameters are in units of the prior's standard deviations, so that the penalty is ½ |x|², with
    a robust kernel beyond two of them if wanted, and one learning rate fits all of them. With [R, c] the
    prior world_from_cam of a view, its corrected pose is [R exp(σ_R ω), c + σ_c δ], and its focal lengths
    are multiplied by exp(σ_f ζ).
    """

    def __init__(self, priors: Priors) -> None:
        """Take cameras and uncertainties of V views from the priors.

        Raises:
            ValueError: a part of them is missing.
        """
        super().__init__()
        p = priors
        if p.cameras is None or p.rotation_sigma is None or p.centre_sigma is None or p.focal_sigma is None:
            raise ValueError(
                "cameras may only move if they and the uncertainty of rotation, centre and focal length "
                "are given"
            )
        self.cameras = p.cameras
        self.sigmas = (p.rotation_sigma, p.centre_sigma, p.focal_sigma)
        zeros = p.cameras.K.new_zeros
        self.turn, self.shift = nn.Parameter(zeros(len(p.cameras), 3)), nn.Parameter(zeros(len(p.cameras), 3))
        self.zoom = nn.Parameter(zeros(len(p.cameras)))

    def forward(self) -> Cameras:
        """The corrected cameras of all V views."""
        rotation, centre, focal = self.sigmas
        pose = self.cameras.world_from_cam
        R = pose[:, :3, :3] @ so3_exp(self.turn * rotation.unsqueeze(-1))
        t = pose[:, :3, 3] + self.shift * centre.unsqueeze(-1)
        factor = torch.exp(self.zoom * focal)
        scale = torch.stack([factor, factor, torch.ones_like(factor)], -1)
        K = self.cameras.K.clone()
        K[:, [0, 1, 2], [0, 1, 2]] = K[:, [0, 1, 2], [0, 1, 2]] * scale
        return Cameras(rigid(R, t), K)

    def penalty(self, kernel: str = "quadratic") -> Tensor:
        """ρ(|ω|) + ρ(|δ|) + ρ(ζ), mean over views; with ρ(x) = ½ x², minus the logarithm of the normal prior.

        The kernels are those of :func:`tco.penalties.robust`: with huber or cauchy a view whose prior is
        wrong by many standard deviations is held less than one that is as uncertain as it was said to be.
        """
        parts = (robust_norm(x, kernel) for x in (self.turn, self.shift, self.zoom.unsqueeze(-1)))
        return torch.stack(list(parts)).sum(0).mean()

    @torch.no_grad()
    def pixels(self, since: Cameras, depth: float) -> float:
        """Largest way, over views, of a point's image since the cameras were others: an upper estimate.

        f · (angle + |shift| / depth) + |Δf| / f · half the width, in pixels, for points at ``depth``.
        """
        now = self.forward()
        turn = rotation_angle(now.world_from_cam[:, :3, :3], since.world_from_cam[:, :3, :3])
        shift = (now.world_from_cam[:, :3, 3] - since.world_from_cam[:, :3, 3]).norm(dim=-1)
        focal, half = since.K[:, 0, 0], since.K[:, 0, 2]
        zoom = (now.K[:, 0, 0] / focal - 1).abs()
        return float((focal * (turn + shift / depth) + zoom * half).max())

    def sizes(self) -> dict[str, list[float]]:
        """How far each view went: degrees of rotation, centre in units of length, relative focal length."""
        rotation, centre, focal = self.sigmas
        with torch.no_grad():
            turn = torch.rad2deg(self.turn.norm(dim=-1) * rotation)
            shift, zoom = self.shift.norm(dim=-1) * centre, torch.expm1(self.zoom * focal)
        return {"rotation_degrees": turn.tolist(), "centre": shift.tolist(), "focal": zoom.tolist()}
