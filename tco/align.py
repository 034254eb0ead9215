"""Networks that predict their cameras, made to answer in the frame, at the scale and with the cameras given.

The photometric term of :mod:`tco.optimize` renders between the given cameras, so the depth of such a network
is brought to their scale, view by view, by the triangulated points; what its own cameras lack in agreement
with the given ones enters the optimisation as the paper's penalties (arXiv 2604.03878, section 3).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from tco.backbones.base import Backbone, RunsAhead
from tco.config import knob
from tco.options import TCOConfig
from tco.penalties import held, in_first_view, inverse_depth_error, rotation_angle
from tco.types import Cameras, HeldCameras, Prediction, Priors, SparseDepth, Views

logger = logging.getLogger(__name__)

FEWEST = 4
"""Points that a view must have to tell its scale; with fewer it gets that of the others."""

OUTLIER = 0.05
"""Difference of log depths at which a point counts half in the scale of its view."""


@dataclass(frozen=True)
class CameraPenalties:
    """What holds the network's own cameras to the given ones; the weights are those of the published code."""

    rotation: float = knob(1.0, "weight of the mean angle to the given rotations, radians")
    translation: float = knob(2.0, "weight of the L1 of normalised centres")
    focal: float = knob(0.01, "weight of the L1 of focal lengths, pixels")
    by_uncertainty: bool = knob(
        False,
        "hold these cameras in standard deviations of COLMAP's, under a robust kernel, all with the weight "
        "of rotations; for cameras that are not exact",
    )
    kernel: str = knob(
        "huber",
        "growth of these penalties beyond 2 standard deviations",
        choices=("quadratic", "huber", "cauchy"),
    )

    @classmethod
    def of(cls, config: TCOConfig) -> CameraPenalties:
        """As ``own_cameras`` of the optimisation's settings wants them."""
        if config.own_cameras == "published":
            return cls()
        return cls(config.camera_weight, by_uncertainty=True, kernel=config.camera_kernel)

    def known(self, priors: Priors) -> HeldCameras:
        """The cameras among the priors as what a network's own are held to.

        Raises:
            ValueError: standard deviations are wanted, and one is not among the priors.
        """
        assert priors.cameras is not None
        if not self.by_uncertainty:
            return HeldCameras(priors.cameras, self.rotation, self.translation, self.focal)
        sigmas = priors.rotation_sigma, priors.centre_sigma, priors.focal_sigma
        if any(sigma is None for sigma in sigmas):
            raise ValueError("by_uncertainty is set, and the cameras have no standard deviations")
        weights = self.rotation, self.rotation, self.rotation
        return HeldCameras(priors.cameras, *weights, *sigmas, kernel=self.kernel)


@dataclass(frozen=True)
class Similarity:
    """x ↦ scale · R x + t.

    Attributes:
        scale: positive scalar.
        R: (3, 3) rotation.
        t: (3,).
    """

    scale: Tensor
    R: Tensor
    t: Tensor

    def points(self, x: Tensor) -> Tensor:
        """Points (…, 3) after the map."""
        return self.scale * x @ self.R.T + self.t

    def poses(self, world_from_cam: Tensor) -> Tensor:
        """Poses (…, 4, 4) of cameras that were moved with the world; their depths grow by ``scale``."""
        moved = world_from_cam.clone()
        moved[..., :3, :3] = self.R @ world_from_cam[..., :3, :3]
        moved[..., :3, 3] = self.points(world_from_cam[..., :3, 3])
        return moved


def align_cameras(source: Tensor, target: Tensor) -> Similarity:
    """The similarity that brings poses (V, 4, 4) nearest to others, world_from_cam.

    The rotation maximises Σ tr(Rᵀ T_v S_vᵀ) + Σ t_vᵀ R s_v / (σ_s σ_t), over camera rotations S, T and
    centres s, t relative to their means, with σ their root mean square (Umeyama 1991, with the rotations as
    further observations, so that two views or views on a line are enough). The scale is σ_t / σ_s, which
    favours neither set.

    Raises:
        ValueError: fewer than two views, or all centres of a set in one point, which leaves no scale.
    """
    if len(source) < 2 or source.shape != target.shape:
        raise ValueError(f"alignment takes two sets of at least two poses, not {len(source)}, {len(target)}")
    (S, s), (T, t) = ((poses[:, :3, :3], poses[:, :3, 3]) for poses in (source, target))
    s_mean, t_mean = s.mean(0), t.mean(0)
    s, t = s - s_mean, t - t_mean
    s_size, t_size = s.norm() / math.sqrt(len(s)), t.norm() / math.sqrt(len(t))
    if not float(s_size) > 1e-9 * float(1 + s_mean.norm()) or not float(t_size) > 0:
        raise ValueError("the camera centres all coincide: they have no scale")
    u, _, vt = torch.linalg.svd(torch.einsum("vij,vkj->ik", T, S) + t.T @ s / (s_size * t_size))
    last = torch.ones_like(s_mean)
    last[2] = torch.linalg.det(u @ vt).sign()
    R = u @ torch.diag(last) @ vt
    scale = t_size / s_size
    return Similarity(scale, R, t_mean - scale * (R @ s_mean))


def scale_to_points(depth: Tensor, points: SparseDepth) -> Tensor | None:
    """Factor (scalar) that brings a depth map (H, W) to triangulated points; None with fewer than four in it.

    The weighted mean of log(z / d) at the points, with the weights 1 / σ² and less for those far off the
    weighted median. It is differentiable, and exactly inverse to the depth, so that depth times factor does
    not depend on the network's unit.
    """
    error, inside = inverse_depth_error(depth, points)
    if int(inside.sum()) < FEWEST:
        return None
    log = (1 + error[inside]).clamp_min(1e-12).log()
    with torch.no_grad():
        trust = 1 / points.sigma[inside].clamp_min(1e-3) ** 2
        order = log.argsort()
        half = (trust[order].cumsum(0) >= trust.sum() / 2).nonzero()[0, 0]
        away = (log - log[order[half]]) / OUTLIER
        weight = trust / (1 + away**2)
        weight = weight / weight.sum()
    return (weight * log).sum().exp()


@dataclass(frozen=True)
class Aligned:
    """Features of the wrapped network, and what aligns its answer.

    Attributes:
        inner: the network's own features.
        priors: cameras of V views.
        points: V views' points that tell their scale.
    """

    inner: Any
    priors: Priors
    points: tuple[SparseDepth, ...]


class _Carry(torch.autograd.Function):
    """The first argument; its gradient too, and for the second, a scalar, the gradient 1.

    So a term reaches the parameters beside whatever loss is made of the tensor that carries it.
    """

    @staticmethod
    def forward(ctx: Any, carrier: Tensor, term: Tensor) -> Tensor:
        """The carrier as it is."""
        return carrier.view_as(carrier)

    @staticmethod
    def backward(ctx: Any, *gradient: Tensor) -> tuple[Tensor, Tensor]:
        """The carrier's gradient, and 1."""
        (g,) = gradient
        return g, torch.ones((), dtype=g.dtype, device=g.device)


class KnownCameras(nn.Module):
    """A :class:`tco.backbones.base.Backbone` around one that predicts cameras, for views whose are known.

    Predictions have the given cameras, and depths at their scale. In a differentiable prediction the depths
    carry the gradient of the camera penalties.

    Attributes:
        history: unweighted penalties of each differentiable prediction.
        agreement: between the network's cameras and the given ones after alignment, medians over views, of
            the last prediction: ``rotation_degrees``; ``centre``, the distance of the centres over their mean
            distance from their middle; ``centre_over_depth``, over the median depth of the points. Empty
            where the given cameras tell no scale.
    """

    uses_cameras = False

    def __init__(self, network: Backbone, penalties: CameraPenalties | None = None) -> None:
        """Wrap a network whose ``uses_cameras`` is False.

        Raises:
            ValueError: it takes cameras as input.
        """
        super().__init__()
        if network.uses_cameras:
            raise ValueError(f"{network.name} takes cameras as input and needs no alignment to them")
        self.network: Any = network
        self.name, self.stride = network.name, network.stride
        self.penalties = penalties or CameraPenalties()
        self.history: list[dict[str, float]] = []
        self.agreement: dict[str, float] = {}

    def decoder(self) -> nn.Module:
        """The network's."""
        module: nn.Module = self.network.decoder()
        return module

    def encode(self, views: Views, priors: Priors) -> Aligned:
        """The network's features.

        Raises:
            ValueError: there are no cameras or no sparse points among the priors.
        """
        if priors.cameras is None or priors.sparse is None:
            raise ValueError(f"{self.name} can only be aligned to cameras and sparse points that are given")
        return Aligned(self.network.encode(views, priors), priors, priors.sparse)

    def with_points(self, encoded: Aligned, points: Mapping[int, SparseDepth]) -> Aligned:
        """Other points to tell the scale of some views."""
        kept = tuple(points.get(view, old) for view, old in enumerate(encoded.points))
        return replace(encoded, inner=self.network.with_points(encoded.inner, points), points=kept)

    def ahead(self, encoded: Aligned, changed: Collection[str]) -> Aligned:
        """The same, with what the network can compute ahead."""
        if not isinstance(self.network, RunsAhead):
            return encoded
        return replace(encoded, inner=self.network.ahead(encoded.inner, changed))

    def decode(
        self, encoded: Aligned, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        """Depths of some views at the given scale, with the given cameras."""
        predicted: Prediction = self.network.decode(encoded.inner, views, context)
        given = encoded.priors.cameras
        assert given is not None
        depth = predicted.depth * self._scales(predicted, encoded)[:, None, None]
        if torch.is_grad_enabled() and depth.requires_grad:
            depth = _Carry.apply(depth, self._penalty(predicted.cameras, encoded.priors))
        else:
            self._compare(predicted.cameras, given, encoded.points)
        return Prediction(depth, predicted.confidence, given, predicted.views)

    def _scales(self, predicted: Prediction, encoded: Aligned) -> Tensor:
        """Factor (V',) of each predicted view: from its points, else the others', else the cameras."""
        scales = [
            scale_to_points(depth, encoded.points[view])
            for depth, view in zip(predicted.depth, predicted.views, strict=True)
        ]
        known = [scale for scale in scales if scale is not None]
        if known:
            other = torch.stack(known).detach().median()
        elif None in scales:
            other = self._scale_of_cameras(predicted, encoded.priors.cameras)
        return torch.stack([other if scale is None else scale for scale in scales])

    def _scale_of_cameras(self, predicted: Prediction, given: Cameras | None) -> Tensor:
        assert given is not None
        poses = predicted.cameras.world_from_cam.detach()
        return align_cameras(poses, given.world_from_cam).scale.to(predicted.depth)

    def _penalty(self, predicted: Cameras, priors: Priors) -> Tensor:
        """Weighted sum of the penalties, whose values go into the history.

        Of one view there is no relative pose, and of centres in one place no scale: these parts are left out.
        """
        known = self.penalties.known(priors)
        ours, theirs = predicted.world_from_cam, known.cameras.world_from_cam
        names = ["focal"]
        if len(ours) > 1:
            names += ["rotation", "translation"] if _spread(ours) and _spread(theirs) else ["rotation"]
        terms = {name: (getattr(known, name), held(name, predicted, known)) for name in names}
        self.history.append({name: float(value.detach()) for name, (_, value) in terms.items()})
        return torch.stack([weight * value for weight, value in terms.values()]).sum()

    @torch.no_grad()
    def _compare(self, predicted: Cameras, given: Cameras, points: Sequence[SparseDepth]) -> None:
        """Set ``agreement``; centres that are all in one place are put into the middle of the given ones."""
        ours, theirs = predicted.world_from_cam, given.world_from_cam
        self.agreement = {}
        if len(ours) < 2 or not _spread(theirs):
            return
        if _spread(ours):
            moved = align_cameras(ours, theirs).poses(ours)
        else:
            moved = theirs[:1] @ in_first_view(ours)
            moved[:, :3, 3] = theirs[:, :3, 3].mean(0)
        angle = rotation_angle(moved[:, :3, :3], theirs[:, :3, :3])
        away = (moved[:, :3, 3] - theirs[:, :3, 3]).norm(dim=-1).median()
        size = (theirs[:, :3, 3] - theirs[:, :3, 3].mean(0)).norm(dim=-1).mean()
        depth = torch.cat([part.depth for part in points]).median()
        self.agreement = {
            "rotation_degrees": float(torch.rad2deg(angle).median()),
            "centre": float(away / size),
            "centre_over_depth": float(away / depth),
        }


def _spread(poses: Tensor) -> bool:
    """Whether camera centres differ enough to have a scale."""
    centres = poses[:, :3, 3].detach()
    return float((centres - centres[0]).norm(dim=-1).max()) > 1e-6
