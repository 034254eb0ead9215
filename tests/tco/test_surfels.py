"""Surfels of a depth map: a plane has one frame and known radii, and the published numbers come out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.geometry import matrix_from_quat, pixel_grid, project, rays, rigid, so3_exp
from tco.surfels import Adjustment, SurfelConfig, from_depth

PARITY = Path(__file__).parents[3] / "shared" / "parity" / "tco_losses.npz"
K = torch.tensor([[20.0, 0, 6], [0, 24.0, 5], [0, 0, 1]], dtype=torch.float64)
SIZE = (10, 12)


def plane(normal: list[float], distance: float = 2.0) -> tuple[Tensor, Tensor]:
    """Depth of the plane n·x = −distance, and the unit n, which faces the camera."""
    n = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    ray = rays(pixel_grid(*SIZE, K).reshape(-1, 2), K)
    return (-distance / (ray @ n)).reshape(SIZE), n


def inputs(depth: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    torch.manual_seed(0)
    pose = rigid(so3_exp(torch.tensor([0.3, -0.2, 0.5]).double()), torch.tensor([1.0, -2, 3]).double())
    return depth, K, pose, torch.rand(3, *SIZE).double(), 1 + 4 * torch.rand(SIZE).double()


@pytest.mark.parametrize("normal", [[0.0, 0, -1], [0.4, 0.1, -1], [-0.3, 0.8, -1]])
def test_surfels_of_a_plane_lie_in_it(normal: list[float]) -> None:
    depth, n = plane(normal)
    _, _, pose, image, confidence = args = inputs(depth)
    surfels = from_depth(*args)
    R = matrix_from_quat(surfels.quats)
    torch.testing.assert_close(R[..., 2], (pose[:3, :3] @ n).expand(len(surfels), 3))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(surfels)).double())
    xy, z = project((surfels.means - pose[:3, 3]) @ pose[:3, :3], K)
    torch.testing.assert_close(xy, pixel_grid(*SIZE, K).reshape(-1, 2))
    torch.testing.assert_close(z, depth.reshape(-1))
    torch.testing.assert_close(surfels.colors, image.reshape(3, -1).T)
    torch.testing.assert_close(surfels.opacities, (1 - 1 / confidence).reshape(-1))


@pytest.mark.parametrize("factor", [0.05, 0.5, 5.0])
def test_radii_of_a_frontal_plane_are_its_pixel_steps(factor: float) -> None:
    depth, _ = plane([0.0, 0, -1])
    surfels = from_depth(*inputs(depth), config=SurfelConfig(radius_factor=factor))
    expected = factor * 2.0 / torch.tensor([20.0, 24.0]).double()
    torch.testing.assert_close(surfels.scales, expected.expand(len(surfels), 2))


def test_foreshortening_multiplies_radii_by_the_normal() -> None:
    depth, n = plane([0.4, 0.1, -1])
    short = from_depth(*inputs(depth)).scales
    full = from_depth(*inputs(depth), config=SurfelConfig(foreshorten=False)).scales
    torch.testing.assert_close(short, full * float(n[2].abs()))


def test_opacity_can_ignore_confidence() -> None:
    depth, _ = plane([0.0, 0, -1])
    surfels = from_depth(*inputs(depth), config=SurfelConfig(confident_opacity=False))
    assert bool((surfels.opacities == 1).all())


def test_adjustments_scale_and_turn_surfels_in_their_own_frames() -> None:
    args = inputs(plane([0.4, 0.1, -1])[0])
    zero = Adjustment(torch.zeros(*SIZE, 2).double(), torch.zeros(*SIZE, 3).double())
    plain, same = from_depth(*args), from_depth(*args, adjust=zero)
    torch.testing.assert_close(same.scales, plain.scales)
    torch.testing.assert_close(same.quats, plain.quats)
    angle = 0.3
    zero.radii[..., 1] = np.log(2)
    zero.turn[..., 2] = angle  # about the normal
    other = from_depth(*args, adjust=zero)
    torch.testing.assert_close(other.scales, plain.scales * torch.tensor([1.0, 2.0]).double())
    before, after = matrix_from_quat(plain.quats), matrix_from_quat(other.quats)
    torch.testing.assert_close(after[..., 2], before[..., 2])
    torch.testing.assert_close(after[..., 0], np.cos(angle) * before[..., 0] + np.sin(angle) * before[..., 1])
    torch.testing.assert_close(other.means, plain.means)


def test_scaling_the_scene_scales_the_surfels() -> None:
    depth, K, pose, image, confidence = inputs(plane([0.4, 0.1, -1])[0] + 0.05 * torch.rand(SIZE))
    larger = pose.clone()
    larger[:3, 3] *= 7
    a = from_depth(depth, K, pose, image, confidence)
    b = from_depth(7 * depth, K, larger, image, confidence)
    torch.testing.assert_close(b.means, 7 * a.means)
    torch.testing.assert_close(b.scales, 7 * a.scales)
    torch.testing.assert_close(b.quats, a.quats)


def test_derivatives_match_finite_differences() -> None:
    depth, K, pose, image, confidence = inputs(plane([0.4, 0.1, -1])[0] + 0.05 * torch.rand(SIZE))
    image, cut = image[:, :4, :3], confidence[:4, :3]
    leaves = [t.clone().requires_grad_(True) for t in (depth[:4, :3], K, torch.zeros(3).double(), cut)]

    def f(depth: Tensor, K: Tensor, turn: Tensor, confidence: Tensor) -> tuple[Tensor, ...]:
        turned = rigid(so3_exp(turn) @ pose[:3, :3], pose[:3, 3])
        s = from_depth(depth, K, turned, image, confidence)
        return s.means, matrix_from_quat(s.quats), s.scales, s.opacities

    assert torch.autograd.gradcheck(f, leaves)


def test_holes_and_masks_drop_the_surfels_that_would_touch_them() -> None:
    depth, K, pose, image, confidence = inputs(plane([0.0, 0, -1])[0])
    depth = depth.clone()
    depth[4, 5] = 0
    valid = torch.ones(SIZE, dtype=torch.bool)
    valid[0, 0] = False
    surfels = from_depth(depth, K, pose, image, confidence, valid=valid)
    assert len(surfels) == 10 * 12 - 5 - 3
    assert float(surfels.scales.max()) < 0.06


def test_a_constant_point_map_has_finite_derivatives() -> None:
    """All points coincide where the depth is 0: lengths are zero, and nothing may be NaN."""
    depth, K, pose, image, confidence = inputs(torch.zeros(SIZE).double())
    depth.requires_grad_(True)
    surfels = from_depth(depth, K, pose, image, confidence, config=SurfelConfig(min_depth=-1.0))
    (surfels.means.sum() + surfels.scales.sum() + surfels.quats.sum()).backward()
    assert depth.grad is not None and bool(depth.grad.isfinite().all())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": torch.ones(1, 5)}, "at least 2×2"),
        ({"image": torch.ones(3, 5, 5)}, "do not fit"),
        ({"confidence": torch.full(SIZE, 0.7)}, "at least 1"),
        ({"valid": torch.ones(SIZE)}, "bool"),
    ],
)
def test_inputs_that_cannot_be_right_are_errors(change: dict[str, Tensor], message: str) -> None:
    depth, K, pose, image, confidence = inputs(plane([0.0, 0, -1])[0])
    given = {"depth": depth, "image": image, "confidence": confidence, "valid": None, **change}
    with pytest.raises(ValueError, match=message):
        from_depth(K=K, world_from_cam=pose, **given)  # type: ignore[arg-type]


@pytest.mark.skipif(not PARITY.exists(), reason="the published numbers are not beside this checkout")
def test_parity_with_the_published_code() -> None:
    data = {k: torch.from_numpy(v) for k, v in np.load(PARITY).items()}
    v = int(data["photo_source_view"][0])
    surfels = from_depth(
        data["depth"][v], data["K"][v], data["cam_to_world"][v], data["images"][v], data["conf"][v],
        config=SurfelConfig(pixel_centre=0.0),
    )  # fmt: skip
    sign = torch.sign((surfels.quats * data["surfel_quats"]).sum(-1, keepdim=True))
    for ours, theirs in (
        (surfels.means, data["surfel_means"]),
        (surfels.quats * sign, data["surfel_quats"]),
        (surfels.scales, data["surfel_scales"][:, :2]),
        (surfels.opacities, data["surfel_opacities"]),
    ):
        torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-4)
