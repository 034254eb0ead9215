"""The compiled colour term: the same as the tensor operations, and its derivative the true one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tco._warping_kernels import TAPS, blur, spread
from tco.objective import SSIM_WINDOW, NothingVisibleError, ObjectiveConfig
from tco.ssim import smooth
from tco.types import Cameras, Prediction, Views
from tco.warped import warped_difference
from tco.warping import warp, warped_photometric

Scene = tuple[Tensor, Tensor, Views, Cameras, Prediction]
CONFIGS = [
    ObjectiveConfig(exposure=exposure, structure=structure)
    for exposure in (False, True)
    for structure in (0.0, 0.4, 1.0)
]


def scene(seed: int = 0, size: tuple[int, int] = (20, 27)) -> Scene:
    """A bumpy source, its opacity, and four views that show parts of it, with holes, some hidden."""
    g = torch.Generator().manual_seed(seed)
    h, w = size
    count = 4
    angles = 0.04 * torch.randn(count, 3, generator=g, dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    x, y, z = angles.unbind(1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(count, 3, 3)
    pose[:, :3, :3] = torch.linalg.matrix_exp(skew)
    pose[:, :3, 3] = 0.1 * torch.randn(count, 3, generator=g, dtype=torch.float64)
    K = torch.tensor([[24.0, 0, w / 2 + 0.3], [0, 25.0, h / 2 - 0.7], [0, 0, 1]], dtype=torch.float64)
    cameras = Cameras(pose.float(), K.expand(count, 3, 3).float())
    grain = torch.rand(count, 3, h + 4, w + 4, generator=g)
    images = torch.nn.functional.avg_pool2d(grain, 5, 1)
    valid = torch.rand(count, h, w, generator=g) > 0.03
    views = Views(images, valid, tuple("abcd"))
    depth = 1.5 + 0.3 * torch.rand(count, h, w, generator=g)
    depth[2, :, 15:] = 0.9
    context = Prediction(depth, 2 * torch.ones_like(depth), cameras, (0, 1, 2, 3))
    opacity = torch.rand(h, w, generator=g) * valid[0]
    return 1.5 + 0.3 * torch.rand(h, w, generator=g), opacity, views, cameras, context


def by_tensors(depth: Tensor, parts: Scene, targets: list[int], config: ObjectiveConfig) -> Tensor:
    """The tensor operations, in the type of the depth."""
    _, opacity, views, cameras, context = parts
    views, cameras, context = (x.to(dtype=depth.dtype) for x in (views, cameras, context))
    found = warp(depth, views, cameras, 0, targets, context)
    return warped_photometric(found, views.images[0], opacity.to(depth), config)


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{c.exposure}-{c.structure}")
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("channels", [1, 3])
def test_value_and_derivative_are_those_of_the_tensor_operations(
    channels: int, seed: int, config: ObjectiveConfig
) -> None:
    depth, opacity, views, cameras, context = scene(seed)
    views = replace(views, images=views.images[:, :channels])
    parts = depth, opacity, views, cameras, context
    for targets in ([1], [3, 1, 2]):
        exact = depth.double().requires_grad_()
        expected = by_tensors(exact, parts, targets, config)
        (slope,) = torch.autograd.grad(expected, exact)
        single = depth.clone().requires_grad_()
        found = warped_difference(single, opacity, views, cameras, (0, targets), context, config)
        (ours,) = torch.autograd.grad(3 * found, single)
        assert float(found) == pytest.approx(float(expected), rel=2e-5)
        torch.testing.assert_close(ours.double() / 3, slope, rtol=2e-3, atol=2e-4 * float(slope.abs().max()))
        assert 0.1 < float((slope != 0).double().mean()) < 0.95


def test_other_types_and_moving_cameras_take_the_tensor_operations() -> None:
    parts = scene()
    depth, opacity, views, cameras, context = parts
    config = CONFIGS[4]
    exact = warped_difference(
        depth.double(), opacity.double(), views.to(dtype=torch.float64), cameras.to(dtype=torch.float64),
        (0, [1, 2]), context.to(dtype=torch.float64), config,
    )  # fmt: skip
    assert exact.dtype == torch.float64 and torch.equal(
        exact, by_tensors(depth.double(), parts, [1, 2], config)
    )
    moving = Cameras(cameras.world_from_cam, cameras.K.clone().requires_grad_())
    warped_difference(depth, opacity, views, moving, (0, [1, 2]), context, config).backward()
    assert moving.K.grad is not None and float(moving.K.grad.abs().max()) > 0


def test_what_nobody_sees_is_an_error() -> None:
    depth, opacity, views, cameras, context = scene()
    away = cameras.world_from_cam.clone()
    away[1:, :3, 3] = torch.tensor([100.0, 0, 0])
    gone = Cameras(away, cameras.K)
    with pytest.raises(NothingVisibleError, match=r"view 0 falls into one of the views \[1, 2\]"):
        warped_difference(depth, opacity, views, gone, (0, [1, 2]), context, CONFIGS[0])
    with pytest.raises(NothingVisibleError, match="no valid pixel"):
        warped_difference(depth, 0 * opacity, views, cameras, (0, [1, 2]), context, CONFIGS[0])
    near = replace(context, depth=torch.full_like(context.depth, 0.2))
    with pytest.raises(NothingVisibleError, match="no valid pixel"):
        warped_difference(depth, opacity, views, cameras, (0, [1, 2]), near, CONFIGS[0])


@pytest.mark.parametrize("size", [(20, 27), (4, 9), (7, 7)])
def test_the_window_is_that_of_the_tensor_operations_and_its_transpose(size: tuple[int, int]) -> None:
    """⟨B a, g⟩ = ⟨a, Bᵀ g⟩, and B is the blur of :func:`tco.ssim.smooth`."""
    rng = np.random.default_rng(0)
    a, g = (rng.normal(size=size).astype(np.float32) for _ in range(2))
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / 1.5) ** 2).astype(np.float32)
    kernel /= kernel.sum()
    means, back = np.empty_like(a), np.empty_like(a)
    blur(a, kernel, means)
    spread(g, kernel, back)
    assert len(kernel) == TAPS == SSIM_WINDOW
    torch.testing.assert_close(
        torch.from_numpy(means), smooth(torch.from_numpy(a), TAPS), rtol=1e-4, atol=1e-5
    )
    assert float((means.astype(float) * g).sum()) == pytest.approx(
        float((a.astype(float) * back).sum()), abs=1e-4
    )
