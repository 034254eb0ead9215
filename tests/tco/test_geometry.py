"""Projective geometry: round trips, group laws, analytic cases and finite differences."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tco.geometry import (
    invert,
    matrix_from_quat,
    pixel_grid,
    project,
    quat_from_matrix,
    rays,
    rigid,
    sample,
    scale_shift,
    skew,
    so3_exp,
    transform,
    unproject,
)

K = torch.tensor([[100.0, 0, 40], [0, 90.0, 30], [0, 0, 1]], dtype=torch.float64)


def poses(n: int, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    omega = torch.randn(n, 3, generator=g, dtype=torch.float64)
    return rigid(so3_exp(omega), torch.randn(n, 3, generator=g, dtype=torch.float64))


def test_first_pixel_centre_is_a_half() -> None:
    grid = pixel_grid(3, 5, K)
    assert grid.shape == (3, 5, 2)
    assert grid[0, 0].tolist() == [0.5, 0.5] and grid[2, 4].tolist() == [4.5, 2.5]


def test_ray_through_the_principal_point_is_the_axis() -> None:
    assert rays(torch.tensor([[40.0, 30.0]]).double(), K).tolist() == [[0.0, 0.0, 1.0]]


def test_unproject_and_project_are_inverse() -> None:
    depth = 1 + torch.rand(2, 6, 8, dtype=torch.float64)
    cameras = torch.stack([K, 2 * K])
    cameras[:, 2, 2] = 1
    xy, z = project(unproject(depth, cameras).reshape(2, -1, 3), cameras)
    torch.testing.assert_close(xy, pixel_grid(6, 8, depth).reshape(1, -1, 2).expand(2, -1, -1))
    torch.testing.assert_close(z, depth.reshape(2, -1))


def test_points_behind_the_camera_project_to_something_finite() -> None:
    xy, z = project(torch.tensor([[1.0, 1, -1], [1, 1, 0]]).double(), K)
    assert bool(xy.isfinite().all()) and bool((z <= 0).all())


def test_rigid_transforms_are_a_group() -> None:
    a, b = poses(5), poses(5, 1)
    points = torch.randn(5, 7, 3, dtype=torch.float64)
    eye = torch.eye(4, dtype=torch.float64).expand(5, 4, 4)
    torch.testing.assert_close(a @ invert(a), eye)
    torch.testing.assert_close(invert(a @ b), invert(b) @ invert(a))
    torch.testing.assert_close(transform(a @ b, points), transform(a, transform(b, points)))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 5e-5, 2e-4, 0.5, 3.0, math.pi])
def test_so3_exp_is_the_matrix_exponential(angle: float) -> None:
    axis = torch.tensor([0.36, -0.48, 0.8], dtype=torch.float64)
    omega = (angle * axis).requires_grad_(True)
    R = so3_exp(omega)
    torch.testing.assert_close(R, torch.linalg.matrix_exp(skew(omega)), atol=1e-14, rtol=1e-12)
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64))
    assert torch.autograd.gradcheck(so3_exp, (omega,))


def test_skew_is_the_cross_product() -> None:
    a, b = torch.randn(2, 4, 3, dtype=torch.float64)
    torch.testing.assert_close((skew(a) @ b.unsqueeze(-1)).squeeze(-1), torch.linalg.cross(a, b))


@pytest.mark.parametrize(
    "q",
    [
        [1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0],
        [0.5, 0.5, 0.5, 0.5], [0.5, -0.5, 0.5, -0.5], [0.1, 0.7, -0.7, 0.1], [-0.2, 0.1, 0.3, 0.9],
    ],
)  # fmt: skip
def test_quaternion_round_trip_with_its_derivative(q: list[float]) -> None:
    unit = torch.nn.functional.normalize(torch.tensor(q, dtype=torch.float64), dim=0)
    back = quat_from_matrix(matrix_from_quat(unit))
    torch.testing.assert_close(back * torch.sign((back * unit).sum()), unit)
    omega = torch.zeros(3, dtype=torch.float64, requires_grad=True)

    def products(w: Tensor) -> Tensor:
        """q qᵗ, which does not depend on the sign that the step of a finite difference may flip."""
        q = quat_from_matrix(so3_exp(w) @ matrix_from_quat(unit))
        return q.outer(q)

    assert torch.autograd.gradcheck(products, (omega,))


def test_quaternion_matrix_is_the_exponential_of_its_axis() -> None:
    omega = torch.tensor([0.3, -0.5, 0.7], dtype=torch.float64)
    half = omega.norm() / 2
    q = torch.cat([half.cos().reshape(1), half.sin() * omega / omega.norm()])
    torch.testing.assert_close(matrix_from_quat(3 * q), so3_exp(omega))


def test_scale_and_shift_recover_what_was_applied() -> None:
    x = torch.rand(3, 4, 5, dtype=torch.float64)
    mask = torch.rand(3, 4, 5) > 0.3
    target = torch.where(mask, 1.7 * x - 0.3, 1e6)
    s, t = scale_shift(x, target, mask)
    assert float(s) == pytest.approx(1.7) and float(t) == pytest.approx(-0.3)


def test_scale_and_shift_without_data_are_errors() -> None:
    x = torch.rand(4, 5)
    with pytest.raises(ValueError, match="two depths"):
        scale_shift(x, x, torch.zeros(4, 5, dtype=torch.bool))
    with pytest.raises(ValueError, match="constant"):
        scale_shift(torch.ones(4, 5), x, torch.ones(4, 5, dtype=torch.bool))


def test_sampling_is_exact_at_centres_and_linear_between() -> None:
    maps = torch.rand(2, 3, 6, 8, dtype=torch.float64)
    grid = pixel_grid(6, 8, maps).reshape(1, -1, 2).expand(2, -1, -1)
    torch.testing.assert_close(sample(maps, grid), maps.flatten(2))
    plane = (2 * grid[..., 0] - 3 * grid[..., 1]).reshape(2, 1, 6, 8)
    xy = torch.tensor([[[1.2, 3.4], [6.9, 0.6]]], dtype=torch.float64).expand(2, -1, -1)
    torch.testing.assert_close(sample(plane, xy)[:, 0], 2 * xy[..., 0] - 3 * xy[..., 1])
    assert float(sample(maps, torch.full((2, 1, 2), -3.0).double()).abs().max()) == 0
