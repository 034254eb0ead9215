"""How what one view shows of another changes with the cameras: residuals and their derivatives.

The surfels of a source view are rendered into a target. Where the render has depth D at a target pixel, it
shows the point X = D K⁻¹ (u, v, 1). Moving a camera moves that point by δX in the target's frame, its image
by π = J δX, so that the rendered depth at the pixel becomes D + δX_z − ∇D · π, and a rendered colour
C − ∇C · π (the derivative of an image that is carried along). With the pose of a view [R exp(ω), c + δ] and
its focal lengths f exp(ζ), as in :mod:`tco.corrections`,

    δX = R_ts (ω_s × x_s − ζ (x_s, y_s, 0)) + R_tᵀ (δ_s − δ_t) − ω_t × X + λ R_tᵀ (c_s − c_t)

where x_s is the point in the source's frame, R_ts = R_tᵀ R_s, and λ the logarithm of a scale of all centres.
The target's own focal length moves the image by ζ (u − c_x, v − c_y) more.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tco.geometry import invert, pixel_grid
from tco.types import Cameras

COLUMNS = {"source_turn": slice(0, 3), "source_shift": slice(3, 6), "target_turn": slice(6, 9),
           "target_shift": slice(9, 12), "focal": slice(12, 13), "scale": slice(13, 14)}  # fmt: skip
"""What the 14 columns of a Jacobian belong to."""

_STEEPEST = 0.2
"""Relative difference of depth between neighbouring pixels above which they lie on different surfaces."""


@dataclass(frozen=True)
class Linear:
    """P residuals of one pair of views, to first order.

    Attributes:
        residual: (P,) float64.
        jacobian: (P, 14) float64, columns as in :data:`COLUMNS`.
        weight: (P,) in [0, 1], how much of the pixel the surfels cover.
    """

    residual: Tensor
    jacobian: Tensor
    weight: Tensor


class Pair:
    """One source rendered into one target.

    Attributes:
        depth: (H, W) rendered; color: (H, W, 3), not premultiplied; alpha: (H, W).
    """

    def __init__(self, rendered: tuple[Tensor, Tensor, Tensor], cameras: Cameras) -> None:
        """Take depth, colour and alpha of a render, and the cameras of source and target, in this order."""
        self.depth, self.color, self.alpha = rendered
        self.cameras = cameras
        self.drawn = self.alpha > _COVERED

    def geometric(self, measured: Tensor, counted: Tensor) -> Linear:
        """log D − log of the measured depth (H, W), at the pixels ``counted`` (H, W)."""
        slope, smooth = _slopes(self.depth, self.drawn, _STEEPEST * self.depth)
        keep = counted & smooth & (measured > 0)
        depth = self.depth[keep].double()
        residual = depth.log() - measured[keep].double().log()
        jacobian = self._carried(slope[keep].double(), keep, own=1.0) / depth.unsqueeze(-1)
        return Linear(residual, jacobian, self.alpha[keep].double())

    def photometric(self, image: Tensor, counted: Tensor) -> Linear:
        """Rendered less measured brightness, image (3, H, W), at the pixels ``counted``.

        Brightness is the mean of the channels; mean and contrast of the pair are matched first. The slope
        is the mean of both pictures', which makes the step of second order (Malis 2004).
        """
        ours, theirs = self.color.mean(-1), image.mean(0)
        slope, smooth = _slopes(ours, self.drawn, torch.full_like(ours, torch.inf))
        keep = counted & smooth
        if int(keep.sum()) < _FEWEST:
            keep = torch.zeros_like(keep)
        a, b = ours[keep].double(), theirs[keep].double()
        gain, bias = _exposure(a, b)
        also, _ = _slopes(theirs, torch.ones_like(self.drawn), torch.full_like(ours, torch.inf))
        slope = (gain * slope[keep].double() + also[keep].double()) / 2
        return Linear(gain * a + bias - b, self._carried(slope, keep, own=0.0), self.alpha[keep].double())

    def _carried(self, slope: Tensor, keep: Tensor, own: float) -> Tensor:
        """Jacobian (P, 14) of own · X_z − slope · π, with the slope (P, 2) of an image in u and v."""
        # Rows of P numbers each: columns of three would take ten times as long to go through.
        pose, K = self.cameras.world_from_cam.double(), self.cameras.K.double()
        h, w = self.depth.shape
        pixel = (pixel_grid(h, w, K)[keep] - K[1, :2, 2]).T.contiguous()
        slope, focal = slope.T.contiguous(), K[1, [0, 1], [0, 1]].unsqueeze(-1)
        z = self.depth[keep].double()
        X = torch.cat([pixel * (z / focal), z.unsqueeze(0)])
        over_z = slope * (focal / z)
        by_point = torch.cat([-over_z, (own + (slope * pixel).sum(0) / z).unsqueeze(0)])
        source_from_target = invert(pose[:1])[0] @ pose[1]
        x = torch.addmm(source_from_target[:3, 3:], source_from_target[:3, :3], X)
        in_source = source_from_target[:3, :3] @ by_point
        in_world = pose[1, :3, :3] @ by_point
        offset = pose[0, :3, 3] - pose[1, :3, 3]
        zoom = -(in_source[:2] * x[:2]).sum(0) - (slope * pixel).sum(0)
        rows = [
            _cross(x, in_source), in_world, _cross(by_point, X), -in_world,
            zoom.unsqueeze(0), (offset @ in_world).unsqueeze(0),
        ]  # fmt: skip
        return torch.cat(rows).T


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product of (3, P) and (3, P), row by row."""
    return torch.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


_COVERED, _FEWEST = 0.3, 16
"""Alpha above which a pixel is drawn; pixels below which a pair has no exposure of its own."""


def _slopes(values: Tensor, drawn: Tensor, steepest: Tensor) -> tuple[Tensor, Tensor]:
    """Central differences (H, W, 2) in u and v, and where all four neighbours are drawn and near in value."""
    slope = torch.zeros(*values.shape, 2, dtype=values.dtype, device=values.device)
    slope[:, 1:-1, 0] = (values[:, 2:] - values[:, :-2]) / 2
    slope[1:-1, :, 1] = (values[2:] - values[:-2]) / 2
    smooth = torch.zeros_like(drawn)
    smooth[1:-1, 1:-1] = (
        drawn[1:-1, 1:-1] & drawn[1:-1, 2:] & drawn[1:-1, :-2] & drawn[2:, 1:-1] & drawn[:-2, 1:-1]
    )
    return slope, smooth & (slope.abs().amax(-1) <= steepest)


def _exposure(ours: Tensor, theirs: Tensor) -> tuple[Tensor, Tensor]:
    """Gain and bias that give brightnesses (P,) the mean and deviation of others; gain within [1/2, 2]."""
    if not len(ours):
        return ours.new_ones(()), ours.new_zeros(())
    gain = ((theirs.var(correction=0) + 1e-4) / (ours.var(correction=0) + 1e-4)).sqrt().clamp(0.5, 2.0)
    return gain, theirs.mean() - gain * ours.mean()
