"""Ranges of planes and sparse points as hypotheses: known positions, known depths."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tco.backbones.sweeping import Hints, interpolate_points, inverse_range, nearest_points
from tco.types import SparseDepth

F64 = torch.float64
H, W = 20, 28


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def points(xy: Tensor, depth: Tensor, sigma: float = 0.01) -> SparseDepth:
    return SparseDepth(xy, depth, torch.full_like(depth, sigma), torch.arange(len(depth)))


def test_the_range_of_planes_comes_from_the_percentiles_of_the_points() -> None:
    depth = torch.linspace(1.0, 5.0, 101)
    outlier = depth.clone()
    outlier[0] = 1e-3
    xy = torch.zeros(101, 2)
    lo, hi = inverse_range([points(xy, depth), points(xy, outlier)], torch.zeros(()))
    torch.testing.assert_close(lo, torch.full((2,), 1 / (20 * 4.96)))
    torch.testing.assert_close(hi[0], torch.tensor(1 / (0.7 * 1.04)))
    torch.testing.assert_close(hi[1], hi[0])
    with pytest.raises(ValueError, match="view 1 has no sparse point"):
        inverse_range([points(xy, depth), points(xy[:0], depth[:0])], torch.zeros(()))


@pytest.mark.parametrize("factor", [2, 4])
def test_interpolation_gives_a_points_own_depth_where_it_is(factor: int) -> None:
    """Points on pixel centres of the smaller map: there the nearest is exact and its distance is 0.

    Ways are counted in 160ths of the longer side: 10 of them a cell here.
    """
    at = torch.tensor([[1, 1], [6, 3], [2, 8], [9, 7]])
    depth = torch.tensor([1.0, 2.0, 4.0, 5.0], dtype=F64)
    xy = (at.double() + 0.5) * factor
    hints = interpolate_points([points(xy, depth)], (12 * factor, 16 * factor), factor, depth)
    assert hints.nearest.shape == (1, 12, 16)
    x, y = at.unbind(-1)
    torch.testing.assert_close(hints.nearest[0, y, x], 1 / depth)
    torch.testing.assert_close(hints.distance[0, y, x], torch.zeros(4, dtype=F64))
    torch.testing.assert_close(
        hints.distance[0, 1, 2], torch.log1p(torch.tensor(10.0, dtype=F64)), rtol=1e-6, atol=0
    )
    # The smooth map: weights 1 / (1 + d²) / σ over all four points, sharp where a point is.
    centre = xy.new_tensor([4.5, 5.5]) * factor
    weight = 1 / (1 + ((xy - centre) ** 2).sum(1) * (10 / factor) ** 2)
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
    near, far = (1 / (1 + ((xy - xy.new_tensor([9.0, 9.0])) ** 2).sum(1) * 10**2)).tolist()
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
    assert volume.shape == (1, planes, 4, 5, 4)
    assert torch.equal(volume[..., 0].argmax(1), index)
    assert torch.equal(volume[..., 1].argmax(1), index.flip(1))
    torch.testing.assert_close(volume[..., :2].amax(1), torch.ones(1, 4, 5, 2, dtype=F64))
    torch.testing.assert_close(volume[0, :, 0, 0, 3], torch.linspace(0, 1, planes, dtype=F64))

    hypotheses = inverse.unsqueeze(1) + step * torch.arange(-3, 4, dtype=F64).view(1, -1, 1, 1)
    bump, offset = hints.at(hypotheses, step)
    assert bool((bump.argmax(1) == 3).all())
    shift = ((inverse.flip(1) - inverse) / step).clamp(-12, 12) / 4
    torch.testing.assert_close(offset, shift.unsqueeze(1))


def test_far_from_any_point_the_bumps_are_wide() -> None:
    near, far = torch.zeros(1, 1, 1, dtype=F64), torch.full((1, 1, 1), 4.0, dtype=F64)
    lo, step = near + 0.1, near + 0.1
    heights = [
        Hints(near + 0.5, near + 0.5, d).as_volume(lo, step, 10)[0, :, 0, 0, 0].sum() for d in (near, far)
    ]
    assert heights[1] > 2 * heights[0]


@pytest.mark.parametrize("count", [1, 6])
def test_the_nearest_points_are_those_of_all_distances(count: int) -> None:
    """On the CPU a tree finds them; distances are exact where a point is at the place itself, too."""
    xy = 28 * torch.rand(60, 2, generator=generator(1))
    places = torch.cat([28 * torch.rand(200, 2, generator=generator(2)), xy[:5]])
    distance, index = nearest_points(places, xy, count)
    each = (places[:, None].double() - xy[None].double()).norm(dim=-1)
    expected, order = each.sort(1)
    assert index.shape == distance.shape == (205, count)
    assert torch.equal(index, order[:, :count])
    torch.testing.assert_close(distance.double(), expected[:, :count], rtol=1e-6, atol=1e-6)
    assert distance[-5:, 0].tolist() == [0.0] * 5
