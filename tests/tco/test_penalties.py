"""Penalties: closed forms, invariances, derivatives down to singular points, and the published numbers."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tco import penalties
from tco.geometry import invert, pixel_grid, rays, rigid, so3_exp
from tco.penalties import SparseDepthConfig, robust, rotation_angle
from tco.types import SparseDepth

PARITY = Path(__file__).parents[3] / "shared" / "parity"
F64 = torch.float64
AXIS = torch.tensor([2 / 3, -2 / 3, 1 / 3], dtype=F64)


def poses(n: int, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    omega = torch.randn(n, 3, generator=g, dtype=F64)
    return rigid(so3_exp(omega), torch.randn(n, 3, generator=g, dtype=F64))


def similarity(pose: Tensor, scale: float, seed: int) -> Tensor:
    """The same cameras in another world of another scale."""
    scaled = pose.clone()
    scaled[:, :3, 3] *= scale
    return poses(1, seed) @ scaled


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 0.3, 1.5, 3.0, math.pi - 1e-7, math.pi])
def test_rotation_angle_is_exact_everywhere(angle: float) -> None:
    a = poses(1)[0, :3, :3]
    assert float(rotation_angle(a, a @ so3_exp(angle * AXIS))) == pytest.approx(angle, abs=1e-15, rel=1e-9)


@pytest.mark.parametrize("angle", [1e-6, 0.3, 3.0, math.pi - 1e-6])
def test_derivative_of_the_angle_is_its_axis(angle: float) -> None:
    w = torch.zeros(3, dtype=F64, requires_grad=True)
    R = so3_exp(angle * AXIS)
    (g,) = torch.autograd.grad(rotation_angle(torch.eye(3, dtype=F64), R @ so3_exp(w)), w)
    torch.testing.assert_close(g, AXIS, atol=1e-6, rtol=0)


@pytest.mark.parametrize("diagonal", [[1.0, 1, 1], [1.0, -1, -1]])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_derivative_at_zero_and_pi_is_finite(diagonal: list[float], dtype: torch.dtype) -> None:
    turned = torch.diag(torch.tensor(diagonal, dtype=dtype)).requires_grad_(True)
    rotation_angle(torch.eye(3, dtype=dtype), turned).backward()
    assert turned.grad is not None and bool(turned.grad.isfinite().all())


def test_rotation_is_the_mean_relative_angle() -> None:
    prior = poses(4)
    turns = torch.tensor([0.0, 0.1, 0.2, 0.6], dtype=F64).unsqueeze(-1) * AXIS
    predicted = prior @ rigid(so3_exp(turns), torch.zeros(4, 3, dtype=F64))
    assert float(penalties.rotation(predicted, prior)) == pytest.approx(0.9 / 4)


def test_translation_in_closed_form() -> None:
    """Centres 0, (1,0,0), (2,0,0) against 0, (0,1,0), (0,2,0), both of mean distance 1."""
    prior = torch.eye(4, dtype=F64).repeat(3, 1, 1)
    predicted = prior.clone()
    predicted[1:, 0, 3] = torch.tensor([1.0, 2], dtype=F64)
    prior[1:, 1, 3] = torch.tensor([1.0, 2], dtype=F64)
    assert float(penalties.translation(predicted, prior)) == pytest.approx((1 + 1 + 2 + 2) / 9)


def test_pose_terms_do_not_depend_on_the_world() -> None:
    predicted, prior = poses(5), poses(5, 1)
    for term in (penalties.rotation, penalties.translation):
        reference = term(predicted, prior)
        torch.testing.assert_close(term(similarity(predicted, 3.0, 7), similarity(prior, 0.2, 8)), reference)
        assert float(term(similarity(predicted, 3.0, 7), predicted)) == pytest.approx(0, abs=1e-7)
        assert float(reference) > 0.1


def test_pose_terms_without_data_are_errors() -> None:
    one, same = poses(1), torch.eye(4, dtype=F64).repeat(3, 1, 1)
    for term in (penalties.rotation, penalties.translation):
        with pytest.raises(ValueError, match="at least two views"):
            term(one, one)
        with pytest.raises(ValueError, match="differ in shape"):
            term(poses(2), poses(3))
    with pytest.raises(ValueError, match="predicted camera centres all coincide"):
        penalties.translation(same, poses(3))
    with pytest.raises(ValueError, match="prior camera centres all coincide"):
        penalties.translation(poses(3), same)


def test_collinear_centres_are_fine() -> None:
    pose = torch.eye(4, dtype=F64).repeat(3, 1, 1)
    pose[:, 0, 3] = torch.tensor([0.0, 1, 2])
    pose.requires_grad_(True)
    prior = pose.detach().clone()
    prior[2, 0, 3] = 3
    loss = penalties.translation(pose, prior) + penalties.rotation(pose, prior)
    loss.backward()
    assert pose.grad is not None and bool(pose.grad.isfinite().all()) and loss.item() > 0


def test_focal_terms_in_closed_form() -> None:
    a = torch.tensor([[[100.0, 0, 50], [0, 110, 40], [0, 0, 1]]], dtype=F64).repeat(2, 1, 1)
    b = a.clone()
    b[0, 0, 0] += 3
    b[1, 1, 1] -= 0.5
    b[1, 0, 2] += 2
    assert float(penalties.focal(a, b)) == pytest.approx((3 + 0.5) / 2)
    # smooth L1: |d| − 1/2 beyond 1, d² / 2 below; means over two views.
    assert float(penalties.intrinsics_reference(a, b)) == pytest.approx((2 * 2.5 + 2 * 0.125 + 1.5) / 2 / 6)


def test_uncertain_terms_in_closed_form() -> None:
    """Errors of known sizes over √(σ² + σ₁²): quadratic within two of them, linear beyond."""
    prior = poses(3)
    turns = torch.tensor([0.0, 0.05, 0.5], dtype=F64).unsqueeze(-1) * AXIS
    predicted = prior @ rigid(so3_exp(turns), torch.zeros(3, 3, dtype=F64))
    sigma = torch.tensor([0.03, 0.04, 0.04], dtype=F64)  # 0.05 together
    got = penalties.rotation_uncertain(predicted, prior, sigma)
    assert float(got) == pytest.approx((0.5 * 1 + 2 * (10 - 1)) / 2)
    assert float(penalties.rotation_uncertain(predicted, prior, sigma, "quadratic")) == pytest.approx(
        (0.5 + 50) / 2
    )

    prior = torch.eye(4, dtype=F64).repeat(3, 1, 1)
    prior[1:, 0, 3] = torch.tensor([1.0, -1])
    predicted = prior.clone()
    predicted[1:, 1, 3] = 0.05  # across both centres: the best scale is 1 / (1 + 0.05²)
    scale = 1 / (1 + 0.05**2)
    residual = math.hypot(1 - scale, 0.05 * scale) / 0.05
    got = penalties.translation_uncertain(4 * predicted, prior, sigma)
    assert float(got) == pytest.approx(0.5 * residual**2, rel=1e-9)

    K = torch.tensor([[100.0, 0, 50], [0, 110, 40], [0, 0, 1]], dtype=F64).repeat(2, 1, 1)
    zoomed = K.clone()
    zoomed[1, 0, 0] *= math.exp(0.02)
    spread = torch.tensor([0.01, 0.02], dtype=F64)
    assert float(penalties.focal_uncertain(zoomed, K, spread)) == pytest.approx(0.5 / 4)


def test_uncertain_pose_terms_do_not_depend_on_the_world() -> None:
    predicted, prior, sigma = poses(5), poses(5, 1), torch.full((5,), 0.4, dtype=F64)
    for term in (penalties.rotation_uncertain, penalties.translation_uncertain):
        reference = float(term(predicted, prior, sigma))
        assert float(term(similarity(predicted, 3.0, 7), prior, sigma)) == pytest.approx(reference)
        assert float(term(similarity(predicted, 3.0, 7), predicted, sigma)) == pytest.approx(0, abs=1e-12)
        assert reference > 0.1
        with pytest.raises(ValueError, match="at least two views"):
            term(poses(1), poses(1), sigma[:1])
    # A prior in other units has its σ in other units.
    scaled = penalties.translation_uncertain(predicted, similarity(prior, 5.0, 2), 5 * sigma)
    torch.testing.assert_close(scaled, penalties.translation_uncertain(predicted, prior, sigma))
    with pytest.raises(ValueError, match="coincide"):
        penalties.translation_uncertain(torch.eye(4, dtype=F64).repeat(5, 1, 1), prior, sigma)


def test_a_prior_counts_by_its_uncertainty() -> None:
    """The view whose prior is wrong has ten times the σ of the others: a hundredth of the force."""
    prior, sigma = poses(4), torch.full((4,), 1.0, dtype=F64)
    forces = []
    for spread in (1.0, 10.0):
        sigma[2] = spread
        pose = prior.clone()
        pose[2, 0, 3] += 0.1
        pose.requires_grad_(True)
        penalties.translation_uncertain(pose, prior, sigma).backward()
        assert pose.grad is not None
        forces.append(float(pose.grad[2, :3, 3].norm()))
    assert forces[1] / forces[0] == pytest.approx(2 / 101, rel=0.1)


def depths() -> tuple[Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(3)
    predicted = 1 + torch.rand(2, 5, 6, generator=g, dtype=F64)
    return predicted, 2 * predicted + 0.3, torch.rand(2, 5, 6, generator=g) > 0.3


def test_depth_terms_ignore_scale_and_shift_and_see_the_rest() -> None:
    predicted, prior, mask = depths()
    confidence = 1 + torch.rand_like(predicted)
    assert float(penalties.depth(predicted, prior, mask)) == pytest.approx(0, abs=1e-12)
    exact = penalties.depth_reference(predicted, prior, mask, confidence)
    torch.testing.assert_close(exact, -confidence[mask].log().mean())
    prior = torch.where(mask, prior + 0.1 * torch.randn_like(prior), 1e9)
    assert float(penalties.depth(predicted, prior, mask)) > 0.01
    torch.testing.assert_close(
        penalties.depth(5 * predicted + 7, prior, mask), penalties.depth(predicted, prior, mask)
    )


def test_dense_depth_in_standard_deviations_is_the_mean_of_the_kernel() -> None:
    predicted, _, mask = depths()
    sigma = 0.01 + 0.02 * torch.rand_like(predicted)
    off = torch.randn_like(predicted)
    prior = torch.where(mask, predicted * (1 + off * sigma), 1e9)
    for kernel in ("quadratic", "huber", "cauchy"):
        value = penalties.depth_uncertain(predicted, prior, mask, sigma, kernel)
        torch.testing.assert_close(value, robust(off[mask], kernel, 2.0).mean())
    leaf = predicted.clone().requires_grad_(True)
    assert torch.autograd.gradcheck(lambda d: penalties.depth_uncertain(d, prior, mask, sigma), (leaf,))
    with pytest.raises(ValueError, match="must be positive"):
        penalties.depth_uncertain(predicted, prior, mask, 0 * sigma)
    with pytest.raises(ValueError, match="empty"):
        penalties.depth_uncertain(predicted, prior, mask & False, sigma)


def test_empty_depth_masks_are_errors() -> None:
    predicted, prior, mask = depths()
    with pytest.raises(ValueError, match="two depths"):
        penalties.depth(predicted, prior, mask & False)
    with pytest.raises(ValueError, match="empty"):
        penalties.depth_reference(predicted, prior, mask & False, predicted)
    with pytest.raises(ValueError, match="constant"):
        penalties.depth(torch.ones_like(predicted), prior, mask)


@pytest.mark.parametrize("kernel", ["quadratic", "huber", "cauchy"])
def test_robust_kernels_are_quadratic_then_slow(kernel: str) -> None:
    r = torch.tensor([1e-3, -1e-3, 100.0, 200.0], dtype=F64)
    value = robust(r, kernel, 1.5)
    torch.testing.assert_close(value[:2], 0.5 * r[:2] ** 2, rtol=1e-6, atol=0)
    growth = float(value[3] - value[2])
    expected = {"quadratic": 15000, "huber": 1.5 * 100, "cauchy": 1.5**2 * math.log(2)}[kernel]
    assert growth == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("kernel", ["quadratic", "huber", "cauchy"])
def test_the_penalty_of_a_vector_is_that_of_its_length(kernel: str) -> None:
    x = torch.tensor([[0.0, 0, 0], [0.3, -0.4, 0], [6.0, 0, 8]], dtype=F64, requires_grad=True)
    value = penalties.robust_norm(x, kernel)
    torch.testing.assert_close(value, robust(torch.tensor([0, 0.5, 10], dtype=F64), kernel, 2.0))
    (g,) = torch.autograd.grad(value.sum(), x)
    torch.testing.assert_close(g[:2], x[:2].detach(), rtol=0.1 if kernel == "cauchy" else 1e-9, atol=0)
    assert bool((g[0] == 0).all()) and float(torch.linalg.cross(g[2], x[2]).detach().norm()) < 1e-12


def test_an_unknown_kernel_is_an_error() -> None:
    with pytest.raises(ValueError, match="quadratic, huber or cauchy"):
        robust(torch.ones(1), "l2", 1.0)


def points(xy: list[list[float]], z: list[float], sigma: float = 0.01) -> SparseDepth:
    n = len(z)
    return SparseDepth(
        torch.tensor(xy, dtype=F64).reshape(n, 2), torch.tensor(z, dtype=F64),
        torch.full((n,), sigma, dtype=F64), torch.arange(n),
    )  # fmt: skip


def test_inverse_depth_of_a_plane_is_exact_between_pixels() -> None:
    K = torch.tensor([[20.0, 0, 6], [0, 24.0, 5], [0, 0, 1]], dtype=F64)
    n = torch.tensor([0.3, -0.2, 1.0], dtype=F64)

    def z(xy: Tensor) -> Tensor:
        return 2 / (rays(xy.reshape(-1, 2), K) @ n)

    depth = z(pixel_grid(10, 12, K)).reshape(10, 12)
    xy = torch.tensor([[0.5, 0.5], [3.3, 7.8], [11.5, 9.5], [5.0, 5.0]], dtype=F64)
    error, inside = penalties.inverse_depth_error(depth, points(xy.tolist(), z(xy).tolist()))
    torch.testing.assert_close(error, torch.zeros(4, dtype=F64), atol=1e-12, rtol=0)
    assert bool(inside.all())


def test_sparse_depth_in_closed_form() -> None:
    """Depth 2 everywhere; points at 2.02 (e = 0.01) and 2.2 (e = 0.1) with σ = √(0.012² + 0.005²) = 0.013."""
    depth = torch.full((8, 9), 2.0, dtype=F64)
    seen = points([[0.1, 7.9], [4.2, 3.3], [-1, 4], [9.5, 4]], [2.02, 2.2, 9, 9], 0.012)
    error, inside = penalties.inverse_depth_error(depth, seen)
    torch.testing.assert_close(error[:2], torch.tensor([0.01, 0.1], dtype=F64))
    assert inside.tolist() == [True, True, False, False]
    k, e = 1.5, torch.tensor([0.01, 0.1], dtype=F64) / 0.013
    expected = float(0.5 * e[0] ** 2 + k * (e[1] - k / 2)) / 2
    assert float(penalties.sparse_depth(depth, seen)) == pytest.approx(expected)


def test_a_point_counts_by_its_uncertainty() -> None:
    depth = torch.full((8, 9), 2.0, dtype=F64, requires_grad=True)
    config = SparseDepthConfig(sigma_floor=0.0, threshold=1e9)
    gradients = []
    for sigma in (0.01, 0.02):
        loss = penalties.sparse_depth(depth, points([[4.5, 4.5]], [2.1], sigma), config)
        gradients.append(torch.autograd.grad(loss, depth)[0][4, 4])
    assert float(gradients[0] / gradients[1]) == pytest.approx(4)


def test_sparse_depth_without_points_is_an_error() -> None:
    depth = torch.ones(8, 9, dtype=F64)
    for nothing in (points([[-5, -5]], [1.0]), points([], [])):
        with pytest.raises(ValueError, match="triangulated points is in the view"):
            penalties.sparse_depth(depth, nothing)


def test_derivatives_match_finite_differences() -> None:
    prior, (predicted, other, mask) = poses(3, 1), depths()
    base = poses(3)
    other = other + 0.3 * torch.randn_like(other)
    twist = torch.zeros(3, 6, dtype=F64, requires_grad=True)

    def pose(twist: Tensor) -> Tensor:
        return base @ rigid(so3_exp(twist[:, :3]), twist[:, 3:])

    check = torch.autograd.gradcheck
    assert check(lambda t: penalties.rotation(pose(t), prior), (twist,))
    assert check(lambda t: penalties.translation(pose(t), prior), (twist,))
    sigma = torch.tensor([0.3, 0.5, 4.0], dtype=F64)
    for kernel in ("quadratic", "huber", "cauchy"):
        assert check(lambda t, k=kernel: penalties.rotation_uncertain(pose(t), prior, sigma, k), (twist,))
        assert check(lambda t, k=kernel: penalties.translation_uncertain(pose(t), prior, sigma, k), (twist,))
    leaf = predicted.clone().requires_grad_(True)
    confidence = (1 + torch.rand_like(predicted)).requires_grad_(True)
    assert check(lambda d: penalties.depth(d, other, mask), (leaf,))
    assert check(lambda d, c: penalties.depth_reference(d, other, mask, c), (leaf, confidence))
    K = torch.tensor([[20.0, 0, 6], [0, 24.0, 5], [0, 0, 1]], dtype=F64).repeat(3, 1, 1).requires_grad_(True)
    other_K = 1.1 * K.detach()
    assert check(lambda k: penalties.focal(k, other_K), (K,))
    assert check(lambda k: penalties.intrinsics_reference(k, other_K), (K,))
    assert check(lambda k: penalties.focal_uncertain(k, other_K, sigma), (K,))
    for kernel in ("huber", "cauchy"):
        config = SparseDepthConfig(kernel=kernel)
        seen = points([[1.3, 2.7], [4.9, 0.6], [3.3, 3.3]], [1.5, 1.51, 1.2])
        assert check(lambda d, c=config, p=seen: penalties.sparse_depth(d[0], p, c), (leaf,))


@pytest.mark.skipif(not PARITY.exists(), reason="the published numbers are not beside this checkout")
def test_parity_with_the_published_code() -> None:
    data = {k: torch.from_numpy(v) for k, v in np.load(PARITY / "tco_losses.npz").items()}
    expected = json.loads((PARITY / "tco_losses.json").read_text())
    prior = invert(data["prior_cam_from_world"])
    known = data["depth"], data["prior_depth"], data["prior_depth_mask"]
    # The published angle is an arc cosine clamped to 1 − 1e-7, which gives the first view an angle too.
    clamped = float(torch.acos(torch.tensor(1.0) - 1e-7)) / 4
    ours = {
        "rot_angle_mean": penalties.rotation(data["cam_to_world"], prior) + clamped,
        "trans_normed_l1_mean": penalties.translation(data["cam_to_world"], prior),
        "intrinsics_l1_focal_mean": penalties.focal(data["K"], data["prior_K"]),
        "intrinsics_reference": penalties.intrinsics_reference(data["K"], data["prior_K"]),
        "depth_l1_paper_mean": penalties.depth(*known),
        "depth_conf_weighted_reference": penalties.depth_reference(*known, data["conf"]),
    }
    for name, value in ours.items():
        assert float(value) == pytest.approx(expected[name], rel=2e-5), name
