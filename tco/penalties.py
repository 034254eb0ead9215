"""What is known beside the images, as penalties: one function a prior, each a scalar to be weighted.

Poses are ``world_from_cam`` of V views; predicted and prior poses may have different worlds, because
both are expressed in their first view before they are compared. A prior without data is an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from tco.config import knob
from tco.geometry import invert, sample, scale_shift
from tco.types import Cameras, HeldCameras, SparseDepth


def in_first_view(world_from_cam: Tensor) -> Tensor:
    """Poses (V, 4, 4) with the first view as the world: the first of them is the identity."""
    return invert(world_from_cam[:1]) @ world_from_cam


def rotation_angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle (…) in radians, in [0, π], between rotations (…, 3, 3).

    With M = Aᵗ B, v = vee(M − Mᵗ) / 2 = sin θ · axis and c = (tr M − 1) / 2 = cos θ, the angle is
    atan2(|v|, c). The arc cosine of c would have an infinite derivative at 0 and π; here the derivative
    is the axis, of length 1, up to θ = 0 and θ = π themselves, where no axis is defined: there v = 0 and
    its derivative is taken as 0.
    """
    M = a.transpose(-1, -2) @ b
    v = (
        torch.stack(
            [M[..., 2, 1] - M[..., 1, 2], M[..., 0, 2] - M[..., 2, 0], M[..., 1, 0] - M[..., 0, 1]], -1
        )
        / 2
    )
    square = (v * v).sum(-1)
    none = square == 0
    sine = torch.where(none, torch.ones_like(square), square).sqrt()
    sine = torch.where(none, torch.zeros_like(sine), sine)
    cosine = (M.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.atan2(sine, cosine)


def rotation(predicted: Tensor, prior: Tensor) -> Tensor:
    """Mean angle (radians) between predicted and prior rotations, each relative to its first view.

    The mean is over all V views, the first with its angle of zero included, as in the paper.

    Args:
        predicted: (V, 4, 4) world_from_cam.
        prior: (V, 4, 4) world_from_cam, of any world.

    Raises:
        ValueError: fewer than two views, which have no relative pose.
    """
    ours, theirs = _relative(predicted, prior)
    return rotation_angle(ours[:, :3, :3], theirs[:, :3, :3]).mean()


def translation(predicted: Tensor, prior: Tensor) -> Tensor:
    """Mean L1 between camera centres relative to the first view, each set divided by its mean distance.

    The division makes the term independent of either scale. The mean is over V views and three axes.

    Args:
        predicted: (V, 4, 4) world_from_cam.
        prior: (V, 4, 4) world_from_cam, of any world and scale.

    Raises:
        ValueError: fewer than two views, or all centres of a set in one point, which have no scale.
    """
    ours, theirs = (pose[:, :3, 3] for pose in _relative(predicted, prior))
    scales = [_mean_distance(centres, name) for centres, name in ((ours, "predicted"), (theirs, "prior"))]
    return (ours / scales[0] - theirs / scales[1]).abs().mean()


def _relative(predicted: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    if predicted.shape != prior.shape:
        raise ValueError(
            f"predicted poses {tuple(predicted.shape)} and priors {tuple(prior.shape)} differ in shape"
        )
    if len(predicted) < 2:
        raise ValueError("a pose penalty compares relative poses and needs at least two views")
    return in_first_view(predicted), in_first_view(prior)


def _mean_distance(centres: Tensor, name: str) -> Tensor:
    # A distance of zero has no direction: the first centre is left out of the norm and counts as 0.
    mean = centres[1:].norm(dim=-1).sum() / len(centres)
    if float(mean.detach()) <= 1e-9:
        raise ValueError(f"the {name} camera centres all coincide: their translation cannot be normalised")
    return mean


def rotation_uncertain(predicted: Tensor, prior: Tensor, sigma: Tensor, kernel: str = "huber") -> Tensor:
    """Mean robust penalty on the rotations relative to the first view, in standard deviations.

    The angle of view v is divided by √(σ_v² + σ_1²), since the first view's error is in all of them. The
    mean is over the views but the first, and the kernel that of :func:`robust` with :data:`THRESHOLD`.

    Args:
        predicted, prior: (V, 4, 4) world_from_cam, of any worlds.
        sigma: (V,) radians.
        kernel: quadratic, huber or cauchy.

    Raises:
        ValueError: fewer than two views.
    """
    ours, theirs = _relative(predicted, prior)
    angle = rotation_angle(ours[1:, :3, :3], theirs[1:, :3, :3])
    return robust(angle / (sigma[1:] ** 2 + sigma[0] ** 2).sqrt(), kernel, THRESHOLD).mean()


def translation_uncertain(predicted: Tensor, prior: Tensor, sigma: Tensor, kernel: str = "huber") -> Tensor:
    """Mean robust penalty on the centres relative to the first view, in standard deviations.

    The predicted centres are scaled to the prior's by least squares, weighted by 1 / (σ_v² + σ_1²); the
    distance that remains is divided by √(σ_v² + σ_1²). The mean is over the views but the first.

    Args:
        predicted, prior: (V, 4, 4) world_from_cam, of any worlds and scales.
        sigma: (V,) in the prior's unit of length.
        kernel: quadratic, huber or cauchy.

    Raises:
        ValueError: fewer than two views, or all predicted centres in one point, which have no scale.
    """
    ours, theirs = (pose[1:, :3, 3] for pose in _relative(predicted, prior))
    variance = sigma[1:] ** 2 + sigma[0] ** 2
    square = (ours.square().sum(-1) / variance).sum()
    if float(square.detach()) * float(variance.min()) <= 1e-18:
        raise ValueError("the predicted camera centres all coincide: they have no scale")
    scale = ((ours * theirs).sum(-1) / variance).sum() / square
    return robust_norm((scale * ours - theirs) / variance.sqrt().unsqueeze(-1), kernel).mean()


def focal_uncertain(predicted: Tensor, prior: Tensor, sigma: Tensor, kernel: str = "huber") -> Tensor:
    """Mean robust penalty on log(f / f_prior) / σ, over the two focal lengths of V views.

    Intrinsics are (V, 3, 3), and sigma (V,) is the standard deviation of the relative focal length.
    """
    error = (_focals(predicted) / _focals(prior)).log() / sigma.unsqueeze(-1)
    return robust(error, kernel, THRESHOLD).mean()


def focal(predicted: Tensor, prior: Tensor) -> Tensor:
    """|Δfx| + |Δfy| in pixels, mean over V views, of intrinsics (V, 3, 3): the paper's term."""
    difference = (_focals(predicted) - _focals(prior)).abs()
    return difference.sum(-1).mean()


def intrinsics_reference(predicted: Tensor, prior: Tensor) -> Tensor:
    """(2 fx + 2 fy + cx + cy) / 6 of smooth L1 in pixels, intrinsics (V, 3, 3): the published code's term."""
    error = F.smooth_l1_loss(predicted, prior, reduction="none").mean(0)
    return (2 * (error[0, 0] + error[1, 1]) + error[0, 2] + error[1, 2]) / 6


def _focals(K: Tensor) -> Tensor:
    return torch.stack([K[..., 0, 0], K[..., 1, 1]], -1)


def held(name: str, ours: Cameras, known: HeldCameras, published: bool = False) -> Tensor:
    """Penalty (scalar) on a part of the cameras that a network predicts: rotation, translation or focal.

    In standard deviations where ``known`` has them, else the paper's, or, ``published``, of the focal lengths
    that of the published code. Errors are those of the parts' functions.
    """
    sigma, kernel = known.sigma(name), known.kernel
    if name == "focal":
        K = ours.K, known.cameras.K
        if sigma is not None:
            return focal_uncertain(*K, sigma, kernel)
        return intrinsics_reference(*K) if published else focal(*K)
    poses = ours.world_from_cam, known.cameras.world_from_cam
    if sigma is not None:
        uncertain = rotation_uncertain if name == "rotation" else translation_uncertain
        return uncertain(*poses, sigma, kernel)
    return rotation(*poses) if name == "rotation" else translation(*poses)


def depth(
    predicted: Tensor, prior: Tensor, mask: Tensor, counted: Sequence[int] | slice = slice(None)
) -> Tensor:
    """Mean L1 over the mask after one least-squares scale and shift for all views: the paper's term.

    Differentiable also through the alignment.

    Args:
        predicted: (V, H, W).
        prior: (V, H, W), in any unit.
        mask: (V, H, W) bool, where the prior is known.
        counted: the views whose pixels the mean is over; the alignment is of all.

    Raises:
        ValueError: fewer than two masked pixels, or a constant predicted depth.
    """
    scale, shift = scale_shift(predicted, prior, mask)
    return (scale * predicted + shift - prior)[counted][mask[counted]].abs().mean()


def depth_uncertain(
    predicted: Tensor, prior: Tensor, mask: Tensor, sigma: Tensor, kernel: str = "huber"
) -> Tensor:
    """Mean robust penalty on the relative inverse depth, z / d − 1, in standard deviations, over the mask.

    The dense twin of :func:`sparse_depth`: the prior is in the unit of the cameras, as a sensor's depth is
    once its scale to COLMAP is known, and nothing is aligned.

    Args:
        predicted: d (V, H, W), positive.
        prior: z (V, H, W), in the same unit.
        mask: (V, H, W) bool, where the prior is known.
        sigma: (V, H, W) standard deviation of the prior's relative error, positive where the mask is set.
        kernel: quadratic, huber or cauchy.

    Raises:
        ValueError: the mask is empty, or a standard deviation in it is not positive.
    """
    if not bool(mask.any()):
        raise ValueError("the depth prior is empty: no pixel of its mask is set")
    if not bool((sigma[mask] > 0).all()):
        raise ValueError("the standard deviation of a dense depth must be positive where there is a depth")
    error = prior[mask] / predicted[mask].clamp_min(1e-6) - 1
    return robust(error / sigma[mask], kernel, THRESHOLD).mean()


def depth_reference(
    predicted: Tensor, prior: Tensor, mask: Tensor, confidence: Tensor, quantile: float = 0.0
) -> Tensor:
    """Mean over the mask of confidence · L1 − log confidence: the published code's depth term.

    The alignment uses the masked pixels whose confidence is at least this quantile of theirs (the
    published code has 0.5 in its runs). The other arguments and errors are those of :func:`depth`;
    ``confidence`` is (V, H, W), at least 1.
    """
    if not bool(mask.any()):
        raise ValueError("the depth prior is empty: no pixel of its mask is set")
    sure = mask & (confidence >= torch.quantile(confidence[mask].detach(), quantile))
    scale, shift = scale_shift(predicted, prior, sure)
    error = (scale * predicted + shift - prior)[mask].abs()
    return (confidence[mask] * error - confidence[mask].log()).mean()


@dataclass(frozen=True)
class SparseDepthConfig:
    """The robust penalty on triangulated points."""

    kernel: str = knob(
        "huber",
        "Growth with large errors: huber is linear, cauchy logarithmic (for many wrong points).",
        choices=("huber", "cauchy"),
    )
    threshold: float = knob(
        1.5, "Residual in standard deviations at which the penalty stops being quadratic."
    )
    sigma_floor: float = knob(
        0.005,
        "Relative depth error that no point is below, added to its own in squares: what the predicted map "
        "cannot resolve between pixels.",
    )


THRESHOLD = 2.0
"""Standard deviations at which the robust penalty of a camera stops being quadratic."""


def robust(residual: Tensor, kernel: str, threshold: float) -> Tensor:
    """½ r² near zero, with a slower growth beyond ``threshold`` k; any shape.

    quadratic: ½ r² everywhere. huber: k (|r| − k / 2) for |r| > k. cauchy: k² / 2 · log(1 + (r / k)²).

    Raises:
        ValueError: a kernel that does not exist.
    """
    if kernel == "huber":
        return F.huber_loss(residual, torch.zeros_like(residual), reduction="none", delta=threshold)
    if kernel == "cauchy":
        return 0.5 * threshold**2 * torch.log1p((residual / threshold) ** 2)
    if kernel == "quadratic":
        return 0.5 * residual.square()
    raise ValueError(f"there is no robust kernel {kernel!r}; choose quadratic, huber or cauchy")


def robust_norm(vectors: Tensor, kernel: str, threshold: float = THRESHOLD) -> Tensor:
    """:func:`robust` of the lengths (…) of vectors (…, N), with the derivative 0 at the zero vector."""
    square = vectors.square().sum(-1)
    none = square == 0
    # The square root has no derivative at 0, where the penalty has: there the length is the constant 0.
    length = torch.where(none, torch.ones_like(square), square).sqrt()
    return robust(torch.where(none, torch.zeros_like(length), length), kernel, threshold)


def inverse_depth_error(depth: Tensor, sparse: SparseDepth) -> tuple[Tensor, Tensor]:
    """Relative error (N,) of the inverse depth at N points, z / d(x, y) − 1, and which lie in the map (N,).

    1 / d is sampled bilinearly between pixel centres from the map (H, W), and is constant in the outer
    half pixel. Inverse depth is linear in the image on a plane, so that this is exact there.
    """
    h, w = depth.shape
    size = sparse.xy.new_tensor([w, h])
    inside = ((sparse.xy >= 0) & (sparse.xy <= size)).all(-1)
    xy = torch.minimum(sparse.xy.clamp_min(0.5), size - 0.5)
    inverse = sample(1 / depth.clamp_min(1e-6)[None, None], xy.unsqueeze(0))[0, 0]
    return inverse * sparse.depth - 1, inside


def sparse_depth(depth: Tensor, points: SparseDepth, config: SparseDepthConfig | None = None) -> Tensor:
    """Mean robust penalty on the relative inverse depth at triangulated points, in standard deviations.

    With e = z / d − 1 at a point and its σ (with the floor), the penalty is ρ(e / σ): quadratic errors
    have the weight 1 / σ². The mean (scalar) is over the points that lie in the map.

    Args:
        depth: (H, W) positive depth of one view, in the unit of the points.
        points: N triangulated points as this view sees them.
        config: kernel, threshold and floor.

    Raises:
        ValueError: no point lies in the map.
    """
    config = config or SparseDepthConfig()
    error, inside = inverse_depth_error(depth, points)
    if not bool(inside.any()):
        raise ValueError(
            f"the sparse depth prior is empty: none of {len(points)} triangulated points is in the view"
        )
    sigma = (points.sigma**2 + config.sigma_floor**2).sqrt()
    return robust(error / sigma, config.kernel, config.threshold)[inside].mean()
