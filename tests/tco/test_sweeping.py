"""Plane sweeps against explicit projection, known surfaces, and the plain forms of what they accumulate."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from tco.backbones.sweeping import (
    Hints,
    aggregate,
    correlations,
    depth_agreement,
    interpolate_points,
    inverse_range,
    relative_cameras,
    scaled,
    warp_grid,
)
from tco.geometry import invert, pixel_grid, project, rays, rigid, so3_exp, transform, unproject
from tco.types import Cameras, SparseDepth

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


def pixels(grid: Tensor) -> Tensor:
    """Pixels of the normalised coordinates of ``grid_sample``."""
    return (grid + 1) / 2 * torch.tensor([W, H], dtype=grid.dtype)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("factor", [1, 2, 4])
def test_the_warp_is_unprojection_then_projection(seed: int, factor: int) -> None:
    cams = cameras(3, seed)
    inverse = 0.2 + torch.rand(1, 5, H, W, generator=generator(seed), dtype=F64)
    sources = torch.tensor([2, 1])
    for source, matrix in zip(sources.tolist(), relative_cameras(cams, 0, sources, factor), strict=True):
        grid, z = warp_grid(matrix, inverse, H, W)
        K = scaled(cams.K, factor)
        source_from_view = invert(cams.world_from_cam[source]) @ cams.world_from_cam[0]
        for plane in range(5):
            depth = 1 / inverse[0, plane]
            points = transform(source_from_view, unproject(depth, K[0]).reshape(-1, 3))
            xy, theirs = project(points, K[source])
            xy, theirs = xy.reshape(H, W, 2), theirs.reshape(H, W)
            torch.testing.assert_close(z[0, plane] * depth, theirs)
            inside = (theirs > 0.1) & ((xy > -W) & (xy < 2 * W)).all(-1)
            assert inside.float().mean() > 0.5
            torch.testing.assert_close(pixels(grid[0, plane])[inside], xy[inside], rtol=0, atol=1e-9)


def test_one_depth_a_plane_is_the_same_as_that_depth_in_every_pixel() -> None:
    matrix = relative_cameras(cameras(2), 0, torch.tensor([1]), 1)[0]
    planes = torch.linspace(0.2, 1.5, 6, dtype=F64).view(1, -1, 1, 1)
    for a, b in zip(
        warp_grid(matrix, planes, H, W), warp_grid(matrix, planes.expand(1, 6, H, W), H, W), strict=True
    ):
        torch.testing.assert_close(a.expand_as(b), b)


def test_what_is_behind_a_source_is_not_seen() -> None:
    cams = sideways(2, 0.0)
    cams.world_from_cam[1, 2, 3] = 2.0
    planes = torch.tensor([1 / 1.9, 1 / 2.5], dtype=F64).view(1, -1, 1, 1)
    features = torch.ones(1, 4, H, W, dtype=F64)
    matrix = relative_cameras(cams, 0, torch.tensor([1]), 1)[0]
    _, seen = correlations(features, features, matrix, planes, 2)
    assert not bool(seen[0, 0, 0].any())
    assert bool(seen[0, 0, 1, H // 2, W // 2])


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
def test_correlations_of_a_wall_peak_at_its_plane(right: int) -> None:
    """Planes one pixel of parallax apart, for interpolation between pixels lowers a correlation."""
    cams = sideways(3, 0.2)
    planes = (torch.arange(1, 9, dtype=F64) / (30.0 * 0.2)).view(1, -1, 1, 1)
    features = wall(cams, 1 / float(planes[0, right, 0, 0]))
    sources = torch.tensor([1, 2])
    for source, matrix in zip(sources.tolist(), relative_cameras(cams, 0, sources, 1), strict=True):
        corr, seen = correlations(features[:1], features[source : source + 1], matrix, planes, 4)
        assert corr.shape == (1, 4, 8, H, W)
        everywhere = seen[0, 0].all(0)
        assert everywhere.float().mean() > 0.3
        best, where = corr.mean(1)[0, :, everywhere].max(0)
        assert bool((where == right).all())
        torch.testing.assert_close(best, torch.full_like(best, 1 / features.shape[1]))


def test_correlations_are_means_of_products_within_groups() -> None:
    """With the source in the place of the reference each hypothesis falls on its own pixel."""
    cams = sideways(2, 0.0)
    ref, source = torch.randn(2, 1, 6, H, W, generator=generator(), dtype=F64)
    matrix = relative_cameras(cams, 0, torch.tensor([1]), 1)[0]
    planes = torch.tensor([0.3, 0.7], dtype=F64).view(1, -1, 1, 1)
    corr, seen = correlations(ref, source, matrix, planes, 3)
    expected = (ref * source).reshape(1, 3, 2, H, W).mean(2).unsqueeze(2).expand(1, 3, 2, H, W)
    torch.testing.assert_close(corr, expected)
    assert bool(seen.all())


def test_aggregation_is_a_softmax_over_the_sources_that_see() -> None:
    g = generator(3)
    parts = [
        (
            torch.randn(1, 4, 3, 5, 6, generator=g, dtype=F64),
            (torch.rand(1, 1, 3, 5, 6, generator=g, dtype=F64) > 0.4).double(),
        )
        for _ in range(5)
    ]
    torch.manual_seed(0)
    fuse = nn.Conv3d(6, 8, 1).double()
    got = aggregate(parts, fuse)

    values = torch.stack([fuse(torch.cat([c, s, c.mean(1, keepdim=True) * s], 1)) for c, s in parts])
    seen = torch.stack([s for _, s in parts])
    scores = values[:, :, -1:].masked_fill(seen == 0, -torch.inf)
    expected = (scores.softmax(0).nan_to_num() * values[:, :, :-1]).sum(0)
    assert bool((seen.sum(0) == 0).any())
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)

    for order in ([4, 3, 2, 1, 0], [2, 0, 4, 1, 3]):
        torch.testing.assert_close(aggregate((parts[i] for i in order), fuse), got)
    with pytest.raises(ValueError, match="at least one source"):
        aggregate([], fuse)


def test_aggregation_takes_one_source_at_a_time() -> None:
    """A source is asked for after the one before it was used up: their volumes never coexist."""
    alive: list[int] = []

    class Watched(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            alive.append(produced)
            return x[:, :3]

    produced = 0

    def sources() -> object:
        nonlocal produced
        for _ in range(4):
            produced += 1
            yield torch.ones(1, 2, 2, 2, 2), torch.ones(1, 1, 2, 2, 2)

    aggregate(sources(), Watched())  # type: ignore[arg-type]
    assert alive == [1, 2, 3, 4]


def slanted_depths(cams: Cameras, slope: float) -> Tensor:
    """Exact depths (V, H, W), on maps of half the cameras' resolution, of the plane z = 3 + slope · x."""
    K, maps = scaled(cams.K, 2), []
    for i in range(len(cams)):
        ray = rays(pixel_grid(H, W, K).reshape(-1, 2), K[i]) @ cams.world_from_cam[i, :3, :3].T
        eye = cams.world_from_cam[i, :3, 3]
        maps.append(((3 + slope * eye[0] - eye[2]) / (ray[:, 2] - slope * ray[:, 0])).reshape(H, W))
    return torch.stack(maps)


@pytest.mark.parametrize("slope", [0.0, 0.4])
def test_other_views_support_the_surface_and_contradict_what_is_before_it(slope: float) -> None:
    cams = cameras(4, seed=1, turn=0.03, shift=0.15)
    full = Cameras(cams.world_from_cam, cams.K * torch.tensor([[2.0], [2.0], [1.0]], dtype=F64))
    depth = slanted_depths(full, slope)
    ratios = torch.tensor([0.8, 0.9, 1.0, 1.1, 1.25], dtype=F64).view(1, -1, 1, 1)
    planes = 1 / (depth[:1].unsqueeze(1) * ratios)
    sure = torch.full_like(depth, -6.0)
    got = depth_agreement(planes, full, 0, torch.tensor([1, 2, 3]), 1 / depth, sure)
    support, conflict = (x[0, :, 4:-4, 4:-4] for x in got.chunk(2, 1))
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
    sources = torch.tensor([1, 2])
    both = depth_agreement(planes, cams, 0, sources, 1 / depth, log_error)[0, :, 8:-8, 8:-8]
    torch.testing.assert_close(both, torch.full_like(both, 0.5), rtol=0, atol=0.02)
    log_error[2] = 0.0
    one = depth_agreement(planes, cams, 0, sources, 1 / depth, log_error)[0, :, 8:-8, 8:-8]
    assert one[0].min() > 0.95 and one[1].max() < 0.05


def test_agreement_does_not_depend_on_the_unit_of_length() -> None:
    cams = cameras(3, seed=5, turn=0.02, shift=0.1)
    inverse = 0.3 + 0.2 * torch.rand(3, H, W, generator=generator(1), dtype=F64)
    planes = inverse[:1].unsqueeze(1) * torch.tensor([0.95, 1.0, 1.05], dtype=F64).view(1, -1, 1, 1)
    error = torch.full_like(inverse, -3.0)
    pose = cams.world_from_cam.clone()
    pose[:, :3, 3] *= 50
    a = depth_agreement(planes, cams, 0, torch.tensor([1, 2]), inverse, error)
    b = depth_agreement(planes / 50, Cameras(pose, cams.K), 0, torch.tensor([1, 2]), inverse / 50, error)
    assert a.max() > 0.1
    torch.testing.assert_close(a, b)


def points(xy: Tensor, depth: Tensor, sigma: float = 0.01) -> SparseDepth:
    return SparseDepth(xy, depth, torch.full_like(depth, sigma), torch.arange(len(depth)))


def test_the_range_of_planes_comes_from_the_percentiles_of_the_points() -> None:
    depth = torch.linspace(1.0, 5.0, 101)
    outlier = depth.clone()
    outlier[0] = 1e-3
    xy = torch.zeros(101, 2)
    lo, hi = inverse_range([points(xy, depth), points(xy, outlier)], torch.zeros(()))
    torch.testing.assert_close(lo, torch.full((2,), 1 / (1.4 * 4.96)))
    torch.testing.assert_close(hi[0], torch.tensor(1 / (0.75 * 1.04)))
    torch.testing.assert_close(hi[1], hi[0])
    with pytest.raises(ValueError, match="view 1 has no sparse point"):
        inverse_range([points(xy, depth), points(xy[:0], depth[:0])], torch.zeros(()))


@pytest.mark.parametrize("factor", [2, 4])
def test_interpolation_gives_a_points_own_depth_where_it_is(factor: int) -> None:
    """Points on pixel centres of the smaller map: there the nearest is exact and its distance is 0."""
    at = torch.tensor([[1, 1], [6, 3], [2, 8], [9, 7]])
    depth = torch.tensor([1.0, 2.0, 4.0, 5.0], dtype=F64)
    xy = (at.double() + 0.5) * factor
    hints = interpolate_points([points(xy, depth)], (12 * factor, 16 * factor), factor, depth)
    assert hints.nearest.shape == (1, 12, 16)
    x, y = at.unbind(-1)
    torch.testing.assert_close(hints.nearest[0, y, x], 1 / depth)
    torch.testing.assert_close(hints.distance[0, y, x], torch.zeros(4, dtype=F64))
    torch.testing.assert_close(
        hints.distance[0, 1, 2], torch.log1p(torch.tensor(float(factor), dtype=F64)), rtol=1e-6, atol=0
    )
    # The smooth map: weights 1 / (1 + d²) / σ over all four points, sharp where a point is.
    centre = xy.new_tensor([4.5, 5.5]) * factor
    weight = 1 / (1 + ((xy - centre) ** 2).sum(1))
    torch.testing.assert_close(hints.smooth[0, 5, 4], (weight / weight.sum() / depth).sum())


def test_the_smooth_map_trusts_certain_points_more() -> None:
    xy = torch.tensor([[4.0, 8.0], [12.0, 8.0]], dtype=F64)
    sparse = SparseDepth(
        xy,
        torch.tensor([1.0, 2.0], dtype=F64),
        torch.tensor([0.01, 0.04], dtype=F64),
        torch.arange(2),
    )
    smooth = interpolate_points([sparse], (16, 16), 2, xy).smooth[0]
    near, far = (1 / (1 + ((xy - xy.new_tensor([9.0, 9.0])) ** 2).sum(1))).tolist()
    near, far = near / 0.01, far / 0.04
    torch.testing.assert_close(float(smooth[4, 4]), (near * 1.0 + far * 0.5) / (near + far))


def test_constant_points_make_constant_maps() -> None:
    xy = 32 * torch.rand(40, 2, generator=generator(), dtype=F64)
    hints = interpolate_points([points(xy, torch.full((40,), 2.5, dtype=F64))], (32, 32), 4, xy)
    for maps in (hints.nearest, hints.smooth):
        torch.testing.assert_close(maps, torch.full_like(maps, 0.4))


def random_hints(views: int, seed: int) -> Hints:
    return Hints(*torch.rand(3, views, 4, 5, generator=generator(seed), dtype=F64))


def test_replaced_hints_change_only_the_named_views() -> None:
    old, new = random_hints(4, 0), random_hints(2, 1)
    kept = Hints(old.nearest.clone(), old.smooth.clone(), old.distance.clone())
    mixed = old.replaced(torch.tensor([3, 1]), new)
    for name in ("nearest", "smooth", "distance"):
        a, b, c = (getattr(hints, name) for hints in (old, new, mixed))
        assert torch.equal(c[[0, 2]], a[[0, 2]])
        assert torch.equal(c[[3, 1]], b)
        assert torch.equal(a, getattr(kept, name))  # the original is untouched
        assert torch.equal(getattr(mixed[torch.tensor([1])], name)[0], c[1])


def test_bumps_are_highest_at_the_points_own_plane() -> None:
    lo, step, planes = torch.full((1, 1, 1), 0.2, dtype=F64), torch.full((1, 1, 1), 0.05, dtype=F64), 20
    index = torch.randint(0, planes, (1, 4, 5), generator=generator())
    inverse = lo + step * index
    hints = Hints(inverse, inverse.flip(1), torch.zeros_like(inverse))
    volume = hints.as_volume(lo, step, planes)
    assert volume.shape == (1, 4, planes, 4, 5)
    assert torch.equal(volume[:, 0].argmax(1), index)
    assert torch.equal(volume[:, 1].argmax(1), index.flip(1))
    torch.testing.assert_close(volume[:, :2].max(2)[0], torch.ones(1, 2, 4, 5, dtype=F64))
    torch.testing.assert_close(volume[0, 3, :, 0, 0], torch.linspace(0, 1, planes, dtype=F64))

    hypotheses = inverse.unsqueeze(1) + step * torch.arange(-3, 4, dtype=F64).view(1, -1, 1, 1)
    bump, offset = hints.at(hypotheses, step)
    assert bool((bump.argmax(1) == 3).all())
    shift = ((inverse.flip(1) - inverse) / step).clamp(-12, 12) / 4
    torch.testing.assert_close(offset, shift.unsqueeze(1))


def test_far_from_any_point_the_bumps_are_wide() -> None:
    near, far = torch.zeros(1, 1, 1, dtype=F64), torch.full((1, 1, 1), 4.0, dtype=F64)
    lo, step = near + 0.1, near + 0.1
    heights = [
        Hints(near + 0.5, near + 0.5, d).as_volume(lo, step, 10)[0, 0, :, 0, 0].sum() for d in (near, far)
    ]
    assert heights[1] > 2 * heights[0]
