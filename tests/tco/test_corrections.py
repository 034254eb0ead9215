"""Camera corrections: the identity at zero, known motions, the penalty in units of sigma, derivatives."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tco.corrections import CameraCorrections
from tco.geometry import invert, rigid, so3_exp
from tco.types import Cameras, Priors

F64 = torch.float64
V = 3


def priors(dtype: torch.dtype = F64) -> Priors:
    g = torch.Generator().manual_seed(0)
    R = so3_exp(torch.randn(V, 3, generator=g, dtype=F64))
    t = torch.randn(V, 3, generator=g, dtype=F64)
    K = torch.tensor([[50.0, 0, 32], [0, 55.0, 24], [0, 0, 1]], dtype=F64).repeat(V, 1, 1)
    known = Priors(
        Cameras(rigid(R, t), K),
        rotation_sigma=torch.tensor([0.01, 0.02, 0.005], dtype=F64),
        centre_sigma=torch.tensor([0.1, 0.3, 0.2], dtype=F64),
        focal_sigma=torch.tensor([0.005, 0.01, 0.02], dtype=F64),
    )
    return known.to(dtype=dtype)


def moved(seed: int = 1, size: float = 1.0) -> CameraCorrections:
    """Corrections of about ``size`` standard deviations."""
    corrections, g = CameraCorrections(priors()), torch.Generator().manual_seed(seed)
    for parameter in corrections.parameters():
        parameter.data = size * torch.randn(parameter.shape, generator=g, dtype=F64)
    return corrections


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_no_correction_is_the_identity_to_the_last_bit(dtype: torch.dtype) -> None:
    known = priors(dtype)
    corrections = CameraCorrections(known)
    cameras = corrections()
    assert known.cameras is not None
    assert torch.equal(cameras.world_from_cam, known.cameras.world_from_cam)
    assert torch.equal(cameras.K, known.cameras.K)
    assert corrections.penalty().item() == 0
    assert corrections.sizes() == dict.fromkeys(("rotation_degrees", "centre", "focal"), [0.0] * V)


def test_each_parameter_moves_its_camera_by_its_sigma() -> None:
    known = priors()
    assert known.cameras is not None
    corrections = CameraCorrections(known)
    corrections.turn.data[0, 2] = 2.0
    corrections.shift.data[1] = torch.tensor([1.0, -2.0, 0.5], dtype=F64)
    corrections.zoom.data[2] = 3.0
    got, before = corrections(), known.cameras

    # A rotation of 2 σ = 0.02 about the camera's own z axis, the centre staying where it is.
    turn = (invert(before.world_from_cam) @ got.world_from_cam)[0]
    c, s = math.cos(0.02), math.sin(0.02)
    expected = torch.tensor([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=F64)
    torch.testing.assert_close(turn, expected)

    shift = got.world_from_cam[1] - before.world_from_cam[1]
    torch.testing.assert_close(shift[:3, 3], 0.3 * torch.tensor([1.0, -2.0, 0.5], dtype=F64))
    torch.testing.assert_close(shift[:3, :3], torch.zeros(3, 3, dtype=F64))

    ratio = got.K[2] / before.K[2]
    torch.testing.assert_close(ratio[0, 0], torch.tensor(math.exp(0.06), dtype=F64))
    torch.testing.assert_close(ratio[1, 1], ratio[0, 0])
    assert torch.equal(got.K[2, :, 2], before.K[2, :, 2])

    for i, kept in ((0, "K"), (1, "K"), (2, "world_from_cam")):
        assert torch.equal(getattr(got, kept)[i], getattr(before, kept)[i])
    sizes = corrections.sizes()
    assert sizes["rotation_degrees"] == pytest.approx([math.degrees(0.02), 0, 0])
    assert sizes["centre"] == pytest.approx([0, 0.3 * math.sqrt(5.25), 0])
    assert sizes["focal"] == pytest.approx([0, 0, math.exp(0.06) - 1])


def test_the_penalty_is_half_the_squared_distance_in_sigmas() -> None:
    """It is measured on the cameras, not on the parameters: the logarithm of the normal prior."""
    known, corrections = priors(), moved(size=0.5)
    assert known.cameras is not None
    assert known.rotation_sigma is not None and known.centre_sigma is not None
    assert known.focal_sigma is not None
    got, before = corrections(), known.cameras
    turn = (invert(before.world_from_cam) @ got.world_from_cam)[:, :3, :3]
    angle = torch.arccos((turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2) / known.rotation_sigma
    way = (got.world_from_cam - before.world_from_cam)[:, :3, 3].norm(dim=1) / known.centre_sigma
    zoom = (got.K[:, 0, 0] / before.K[:, 0, 0]).log() / known.focal_sigma
    torch.testing.assert_close(
        corrections.penalty().detach(), 0.5 * (angle**2 + way**2 + zoom**2).mean().detach()
    )


@pytest.mark.parametrize(("kernel", "growth"), [("quadratic", 37.5), ("huber", 10.0), ("cauchy", 2.554)])
def test_a_prior_that_is_far_wrong_is_let_go_by_a_robust_kernel(kernel: str, growth: float) -> None:
    """What five standard deviations more cost a view that is five away already, each part of it alone."""
    for name in ("turn", "shift", "zoom"):
        costs = []
        for size in (0.5, 5.0, 10.0):
            corrections = CameraCorrections(priors())
            getattr(corrections, name).data.reshape(V, -1)[1, 0] = size
            costs.append(V * float(corrections.penalty(kernel)))
        assert costs[0] == pytest.approx(0.125, rel=0.05)
        assert costs[2] - costs[1] == pytest.approx(growth, rel=0.01)


def test_how_far_images_of_points_went_in_pixels() -> None:
    """2 σ of turn, 1 σ of centre and of focal length, compared with projections of points at the border."""
    known, corrections = priors(), CameraCorrections(priors())
    assert known.cameras is not None
    assert corrections.pixels(known.cameras, 2.0) == 0
    corrections.turn.data[1, 1] = 2.0
    assert corrections.pixels(known.cameras, 2.0) == pytest.approx(50 * 0.04, rel=1e-6)
    corrections = CameraCorrections(priors())
    corrections.shift.data[2, 0] = 1.0
    assert corrections.pixels(known.cameras, 2.0) == pytest.approx(50 * 0.2 / 2, rel=1e-6)
    corrections = CameraCorrections(priors())
    corrections.zoom.data[0] = 1.0
    assert corrections.pixels(known.cameras, 2.0) == pytest.approx(32 * math.expm1(0.005), rel=1e-6)


def test_corrected_poses_are_rigid() -> None:
    pose = moved(size=5.0)().world_from_cam.detach()
    eye = torch.eye(3, dtype=F64).expand(V, 3, 3)
    torch.testing.assert_close(pose[:, :3, :3] @ pose[:, :3, :3].transpose(1, 2), eye)
    torch.testing.assert_close(torch.linalg.det(pose), torch.ones(V, dtype=F64))
    assert torch.equal(pose[:, 3], torch.tensor([0.0, 0, 0, 1], dtype=F64).expand(V, 4))


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_derivatives_match_finite_differences(size: float) -> None:
    corrections = moved(size=size)
    weight = torch.randn(2, V, 4, 4, generator=torch.Generator().manual_seed(2), dtype=F64)

    def f(turn: Tensor, shift: Tensor, zoom: Tensor) -> Tensor:
        given = {"turn": turn, "shift": shift, "zoom": zoom}
        cameras = torch.func.functional_call(corrections, given, ())
        return (weight[0] * cameras.world_from_cam).sum() + (weight[1, :, :3, :3] * cameras.K).sum()

    inputs = tuple(p.detach().clone().requires_grad_(True) for p in corrections.parameters())
    assert torch.autograd.gradcheck(f, inputs)
    corrections.penalty().backward()
    for parameter, start in zip(corrections.parameters(), inputs, strict=True):
        torch.testing.assert_close(parameter.grad, start.detach() / V)


@pytest.mark.parametrize("name", ["cameras", "rotation_sigma", "centre_sigma", "focal_sigma"])
def test_a_missing_prior_is_an_error(name: str) -> None:
    with pytest.raises(ValueError, match="uncertainty of rotation, centre and focal length"):
        CameraCorrections(replace(priors(), **{name: None}))


def test_the_priors_are_not_changed() -> None:
    known = priors()
    assert known.cameras is not None
    K, pose = known.cameras.K.clone(), known.cameras.world_from_cam.clone()
    corrections = CameraCorrections(known)
    corrections.zoom.data += 1
    corrections().K.sum().backward()
    assert torch.equal(known.cameras.K, K) and torch.equal(known.cameras.world_from_cam, pose)
