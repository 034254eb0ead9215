"""Warping, correlation and agreement against explicit projection, known surfaces, and each other."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from tco._elementary import exp, log
from tco.backbones.sweeping import relative_cameras, scaled
from tco.backbones.warp import agree, agree_plainly, correlate, correlate_plainly, project
from tco.geometry import invert, pixel_grid, rays, rigid, so3_exp, transform, unproject
from tco.geometry import project as project_points
from tco.types import Cameras

F64 = torch.float64
H, W = 20, 28


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def cameras(count: int, seed: int = 0, turn: float = 0.15, shift: float = 0.3) -> Cameras:
    """Cameras near the origin, each turned and shifted at random, with a focal length of their own."""
    g = generator(seed)
    R = so3_exp(turn * torch.randn(count, 3, generator=g, dtype=F64))
    t = shift * torch.randn(count, 3, generator=g, dtype=F64)
    K = torch.zeros(count, 3, 3, dtype=F64)
    K[:, 0, 0] = 30 + 4 * torch.rand(count, generator=g, dtype=F64)
    K[:, 1, 1] = 31 + 4 * torch.rand(count, generator=g, dtype=F64)
    K[:, 0, 2], K[:, 1, 2], K[:, 2, 2] = W / 2 + 1.3, H / 2 - 0.8, 1
    return Cameras(rigid(R, t), K)


def sideways(count: int, step: float, scale: float = 1.0) -> Cameras:
    """Cameras of one orientation in a row along x; intrinsics of maps of H × W are these by ``scale``."""
    pose = torch.eye(4, dtype=F64).repeat(count, 1, 1)
    pose[:, 0, 3] = step * torch.arange(count)
    K = torch.tensor([[30.0, 0, W / 2], [0, 30.0, H / 2], [0, 0, 1 / scale]], dtype=F64) * scale
    return Cameras(pose, K.repeat(count, 1, 1))


def to_one(cams: Cameras, source: int, factor: int = 1) -> Tensor:
    """(1, 3, 4) matrix from view 0 to a source."""
    return relative_cameras(cams, [0], torch.tensor([[source]]), factor)[:, 0]


def pair(source: int = 1) -> Tensor:
    return torch.tensor([[0, source]])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("factor", [1, 2, 4])
def test_the_warp_is_unprojection_then_projection(seed: int, factor: int) -> None:
    cams = cameras(3, seed)
    inverse = 0.2 + torch.rand(1, 5, H, W, generator=generator(seed), dtype=F64)
    K = scaled(cams.K, factor)
    for source in (2, 1):
        grid, z, _ = project(to_one(cams, source, factor), inverse, H, W)
        source_from_view = invert(cams.world_from_cam[source]) @ cams.world_from_cam[0]
        for plane in range(5):
            depth = 1 / inverse[0, plane]
            points = transform(source_from_view, unproject(depth, K[0]).reshape(-1, 3))
            xy, theirs = project_points(points, K[source])
            xy, theirs = xy.reshape(H, W, 2), theirs.reshape(H, W)
            torch.testing.assert_close(z[0, plane] * depth, theirs)
            inside = (theirs > 0.1) & ((xy > -W) & (xy < 2 * W)).all(-1)
            assert inside.float().mean() > 0.5
            pixels = (grid[0, plane] + 1) / 2 * torch.tensor([W, H], dtype=F64)
            torch.testing.assert_close(pixels[inside], xy[inside], rtol=0, atol=1e-9)


def test_relative_cameras_of_several_views_are_those_of_each() -> None:
    cams = cameras(4)
    sources = torch.tensor([[1, 3], [0, 2]])
    both = relative_cameras(cams, [2, 1], sources, 2)
    assert both.shape == (2, 2, 3, 4)
    for i, view in enumerate((2, 1)):
        for j in range(2):
            one = relative_cameras(cams, [view], sources[i : i + 1, j : j + 1], 2)
            torch.testing.assert_close(both[i, j], one[0, 0])


def features_and_geometry(seed: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, ...]:
    """Features (3, 6, H, W), pairs (4, 2), matrices (4, 3, 4) and hypotheses (4, 5, H, W)."""
    cams = cameras(3, seed)
    pairs = torch.tensor([[0, 1], [0, 2], [2, 1], [1, 0]])
    matrices = torch.cat([relative_cameras(cams, [int(a)], b.view(1, 1), 1)[:, 0] for a, b in pairs])
    planes = 0.1 + torch.rand(4, 5, H, W, generator=generator(seed), dtype=F64)
    features = torch.randn(3, 6, H, W, generator=generator(seed + 9), dtype=F64)
    return features.to(dtype), pairs, matrices.to(dtype), planes.to(dtype)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("uniform", [False, True])
@pytest.mark.parametrize("threads", [1, 3])
def test_the_compiled_loops_are_the_plain_operators(
    seed: int, last: bool, uniform: bool, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    features, pairs, matrices, planes = features_and_geometry(seed)
    planes = planes[:, :, :1, :1] if uniform else planes
    features.requires_grad_(True)
    ours, seen = correlate(features, pairs, matrices, planes, 3, last)
    plain, visible = correlate_plainly(features.permute(0, 2, 3, 1), pairs, matrices, planes, 3, last)
    assert ours.shape == ((4, H, W, 5, 3) if last else (4, 5, H, W, 3))
    assert 0.3 < visible.mean() < 0.95
    assert (seen != visible).float().mean() < 1e-3  # rounding at the border
    same = (seen == visible).unsqueeze(-1)
    torch.testing.assert_close(ours * same, plain * same, rtol=1e-4, atol=1e-4)

    upstream = torch.randn(ours.shape, generator=generator(1)) * same
    a, b = (torch.autograd.grad((x * upstream).sum(), features)[0] for x in (ours, plain))
    torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3)


def test_the_gradient_of_a_correlation_is_that_of_finite_differences() -> None:
    features, pairs, matrices, planes = features_and_geometry(0, F64)
    small = features[:, :2, :6, :7].clone().requires_grad_(True)
    assert torch.autograd.gradcheck(
        lambda f: correlate(f, pairs[:2], matrices[:2], planes[:2, :2, :6, :7], 1)[0], small, fast_mode=True
    )


def test_what_is_behind_a_source_is_not_seen() -> None:
    cams = sideways(2, 0.0)
    cams.world_from_cam[1, 2, 3] = 2.0
    planes = torch.tensor([1 / 1.9, 1 / 2.5], dtype=F64).view(1, -1, 1, 1)
    for dtype in (torch.float32, F64):
        features = torch.ones(2, 4, H, W, dtype=dtype)
        corr, seen = correlate(features, pair(), to_one(cams, 1).to(dtype), planes.to(dtype), 2)
        assert not bool(seen[0, 0].any()) and not bool(corr[0, 0].any())
        assert bool(seen[0, 1, H // 2, W // 2])


def wall(cams: Cameras, depth: float, channels: int = 8) -> Tensor:
    """Features (V, channels, H, W) of a random pattern on the plane z = ``depth`` of the world."""
    g = generator(7)
    frequency = 4 * torch.randn(channels, 6, 2, generator=g, dtype=F64)
    phase = 6 * torch.rand(channels, 6, generator=g, dtype=F64)
    maps = []
    for pose, K in zip(cams.world_from_cam, cams.K, strict=True):
        ray = rays(pixel_grid(H, W, K).reshape(-1, 2), K) @ pose[:3, :3].T
        point = pose[:3, 3] + (depth - pose[2, 3]) / ray[:, 2:] * ray
        waves = torch.sin(torch.einsum("cki,pi->ckp", frequency, point[:, :2]) + phase.unsqueeze(-1))
        maps.append(waves.sum(1).reshape(channels, H, W) / 2)
    features = torch.stack(maps)
    return features / features.norm(dim=1, keepdim=True)


@pytest.mark.parametrize("right", [1, 4, 6])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_correlations_of_a_wall_peak_at_its_plane(right: int, dtype: torch.dtype) -> None:
    """Planes one pixel of parallax apart, for interpolation between pixels lowers a correlation."""
    cams = sideways(3, 0.2)
    planes = (torch.arange(1, 9, dtype=F64) / (30.0 * 0.2)).view(1, -1, 1, 1)
    features = wall(cams, 1 / float(planes[0, right, 0, 0]))
    for source in (1, 2):
        corr, seen = correlate(
            features.to(dtype), pair(source), to_one(cams, source).to(dtype), planes.to(dtype), 4
        )
        everywhere = seen[0].all(0)
        assert everywhere.float().mean() > 0.3
        best, where = corr.mean(-1)[0, :, everywhere].max(0)
        assert bool((where == right).all())
        torch.testing.assert_close(best, torch.full_like(best, 1 / features.shape[1]), rtol=1e-4, atol=1e-6)


def test_correlations_are_means_of_products_within_groups() -> None:
    """With the source in the place of the reference each hypothesis falls on its own pixel."""
    cams = sideways(2, 0.0)
    features = torch.randn(2, 6, H, W, generator=generator(), dtype=F64)
    planes = torch.tensor([0.3, 0.7], dtype=F64).view(1, -1, 1, 1)
    corr, seen = correlate(features, pair(), to_one(cams, 1), planes, 3)
    product = features[0] * features[1]
    for group in range(3):
        expected = (product[group] + product[group + 3]) / 2
        torch.testing.assert_close(corr[0, ..., group], expected.expand(2, H, W))
    assert bool(seen.all())


def slanted_depths(cams: Cameras, slope: float) -> Tensor:
    """Exact depths (V, H, W), on maps of half the cameras' resolution, of the plane z = 3 + slope · x."""
    K, maps = scaled(cams.K, 2), []
    for i in range(len(cams)):
        ray = rays(pixel_grid(H, W, K).reshape(-1, 2), K[i]) @ cams.world_from_cam[i, :3, :3].T
        eye = cams.world_from_cam[i, :3, 3]
        maps.append(((3 + slope * eye[0] - eye[2]) / (ray[:, 2] - slope * ray[:, 0])).reshape(H, W))
    return torch.stack(maps)


def agreement(cams: Cameras, planes: Tensor, sources: list[int], inverse: Tensor, error: Tensor) -> Tensor:
    """Support and conflict (2·D, H, W) of the hypotheses of view 0."""
    index = torch.tensor([sources])
    return agree(planes, relative_cameras(cams, [0], index, 2), index, inverse, error)[0]


@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_other_views_support_the_surface_and_contradict_what_is_before_it(slope: float) -> None:
    cams = cameras(4, seed=1, turn=0.03, shift=0.15)
    full = Cameras(cams.world_from_cam, cams.K * torch.tensor([[2.0], [2.0], [1.0]], dtype=F64))
    depth = slanted_depths(full, slope)
    ratios = torch.tensor([0.8, 0.9, 1.0, 1.1, 1.25], dtype=F64).view(1, -1, 1, 1)
    planes = 1 / (depth[:1].unsqueeze(1) * ratios)
    got = agreement(full, planes, [1, 2, 3], 1 / depth, torch.full_like(depth, -6.0))
    support, conflict = got[:, 4:-4, 4:-4].chunk(2)
    assert support[2].min() > 0.97
    assert support[[0, 1, 3, 4]].max() < 0.01
    assert conflict[2].max() < 0.03
    assert conflict[:2].min() > 0.95
    # Behind the surface nothing can be said: it is hidden, not contradicted.
    assert conflict[3:].max() < 0.01


def test_views_that_are_unsure_say_less_than_those_that_are_sure() -> None:
    cams = sideways(3, 0.1, scale=2.0)
    depth = torch.full((3, H, W), 2.0, dtype=F64)
    depth[2] = 4.0
    log_error = torch.full_like(depth, -6.0)
    planes = torch.full((1, 1, H, W), 0.5, dtype=F64)
    both = agreement(cams, planes, [1, 2], 1 / depth, log_error)[:, 8:-8, 8:-8]
    torch.testing.assert_close(both, torch.full_like(both, 0.5), rtol=0, atol=0.02)
    log_error[2] = 0.0
    one = agreement(cams, planes, [1, 2], 1 / depth, log_error)[:, 8:-8, 8:-8]
    assert one[0].min() > 0.95 and one[1].max() < 0.05


def test_agreement_does_not_depend_on_the_unit_of_length() -> None:
    cams = cameras(3, seed=5, turn=0.02, shift=0.1)
    inverse = 0.3 + 0.2 * torch.rand(3, H, W, generator=generator(1), dtype=F64)
    planes = inverse[:1].unsqueeze(1) * torch.tensor([0.95, 1.0, 1.05], dtype=F64).view(1, -1, 1, 1)
    error = torch.full_like(inverse, -3.0)
    pose = cams.world_from_cam.clone()
    pose[:, :3, 3] *= 50
    a = agreement(cams, planes, [1, 2], inverse, error)
    b = agreement(Cameras(pose, cams.K), planes / 50, [1, 2], inverse / 50, error)
    assert a.max() > 0.1
    torch.testing.assert_close(a, b)


@pytest.mark.parametrize("seed", range(3))
def test_compiled_agreement_is_the_plain_one(seed: int) -> None:
    cams = cameras(4, seed, turn=0.05)
    inverse = 0.3 + torch.rand(4, H, W, generator=generator(seed))
    error = torch.randn(4, H, W, generator=generator(seed)) - 3
    planes = inverse[:2].unsqueeze(1) * torch.linspace(0.9, 1.1, 5).view(1, -1, 1, 1)
    sources = torch.tensor([[1, 2, 3], [3, 0, 2]])
    matrices = relative_cameras(cams, [0, 1], sources, 2).float()
    ours = agree(planes, matrices, sources, inverse, error)
    plain = agree_plainly(planes, matrices, sources, inverse, error)
    assert ((ours - plain).abs() > 1e-4).float().mean() < 1e-3
    assert plain.max() > 0.5


def test_logarithms_that_are_written_out_are_those_of_numpy() -> None:
    """Around one, where it vanishes, absolutely; over all sizes relatively."""
    for x in np.concatenate([np.exp(np.linspace(-30, 30, 61)), np.linspace(0.7, 1.5, 41)]).astype(np.float32):
        assert float(log(x)) == pytest.approx(float(np.log(np.float64(x))), rel=3e-7, abs=1e-7)


def test_exponentials_that_are_written_out_are_those_of_numpy() -> None:
    for most, digits in ((20, 1.5e-7), (80, 4e-7)):
        for x in np.linspace(-most, most, 801, dtype=np.float32):
            assert float(exp(x)) == pytest.approx(float(np.exp(np.float64(x))), rel=digits)
    assert 0 < float(exp(np.float32(-1000))) < 1e-37 and float(exp(np.float32(1000))) > 1e38
