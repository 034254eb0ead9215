"""Points and maps compared at the same depths: shares that are known beforehand."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from benchmarks.marks import FIFTHS, at_points, compared, lines, looked_up, wrong
from benchmarks.real import RealSet
from colmap_tco.priors import PriorSet
from tco.toy import wall
from tco.types import Priors, SparseDepth, Views

H, W = 10, 20


def real(depth: torch.Tensor, points: SparseDepth) -> RealSet:
    """One view of this true depth, seen by these points; a unit is half a metre."""
    views = Views(torch.zeros(1, 3, H, W), torch.ones(1, H, W, dtype=torch.bool), ("a",))
    priors = PriorSet(Priors(sparse=(points,)), (points[:0],), {})
    return RealSet("made", views, priors, depth[None], 0.5)


@pytest.fixture
def scene() -> RealSet:
    """Rows deeper and deeper, from 1 to 10, and a hole; points in the two first rows and in the last."""
    depth = torch.arange(1.0, H + 1)[:, None].expand(H, W).clone()
    depth[5, 3] = 0.0
    xy = torch.tensor([[0.5, 0.5], [19.99, 0.2], [4.5, 1.5], [7.5, 9.9], [3.5, 5.5]])
    found = torch.tensor([1.02, 0.9, 2.2, 10.0, 3.0])
    return real(depth, SparseDepth(xy, found, torch.full((5,), 0.01), torch.arange(5)))


def test_points_are_compared_with_the_pixel_that_they_are_in(scene: RealSet) -> None:
    sparse = scene.given.sparse
    assert sparse is not None
    true, ratio = at_points(scene.truth, tuple(sparse))
    assert true.tolist() == [1.0, 1.0, 2.0, 10.0]  # the fifth is where nothing was measured
    torch.testing.assert_close(ratio, torch.tensor([1.02, 0.9, 1.1, 1.0]))


def test_each_range_has_its_own_shares(scene: RealSet) -> None:
    """The maps are right in the upper half of the rows and a tenth too near below."""
    maps = scene.truth.clone()
    maps[:, H // 2 :] *= 0.9
    ranges = compared(scene, maps)
    assert len(ranges) == FIFTHS
    assert (ranges[0].low, ranges[-1].high) == (pytest.approx(0.5), pytest.approx(5.0))
    assert [r.points for r in ranges] == [3, 0, 0, 0, 1]
    assert ranges[0].agree == (pytest.approx(1 / 3), 1.0) and ranges[0].nearer == (pytest.approx(1 / 3), 0.0)
    assert ranges[-1].agree == (1.0, 0.0) and ranges[-1].nearer == (0.0, 1.0)
    assert sum(r.agree[1] for r in ranges[:2]) == 2.0


def test_spread_as_pixels_counts_each_range_alike(scene: RealSet) -> None:
    """Three of four points are near, where a third agrees: 1 / 2 of all, 2 / 3 of two ranges alike."""
    first = lines(scene, scene.truth)[0].split("|")
    assert first[1].strip() == "made" and first[3].strip() == "4"
    assert float(first[4]) == 0.5
    assert float(first[5]) == pytest.approx(2 / 3, abs=1e-3)  # of the ranges that have points
    assert float(first[6]) == 1.0


@pytest.fixture(scope="module")
def textured() -> RealSet:
    """Four views of a slanted, textured wall."""
    made = wall(4, (48, 64), 0.3)
    return RealSet("wall", made.views, PriorSet(made.priors, (), {}), made.depth)


def test_true_depths_find_the_same_place_in_other_views(textured: RealSet) -> None:
    for other in (1, 2, 3):
        found, z = looked_up(textured, textured.truth[0], 0, other)
        seen = z > 0
        assert float(seen.float().mean()) > 0.5
        off = (found[:3] - textured.views.images[0]).abs().mean(0)[seen]
        assert float(off.mean()) < 0.25 * float(textured.views.images[0].std())
        assert float((found[3] / z - 1).abs()[seen].max()) < 0.02


def test_colours_tell_which_depths_are_wrong(textured: RealSet) -> None:
    """A third of each view is a fifth too near; colours there fit the truth, or both if there are none."""
    depth = textured.truth.clone()
    depth[:, 16:32] *= 0.8
    found = wrong(textured, depth)
    assert found.share == pytest.approx(1 / 3) and 0 < found.seen <= 4 * 16 * 64
    assert found.true < 0.6 * found.ours and found.better < 0.3
    plain = replace(textured.views, images=torch.full_like(textured.views.images, 0.5))
    found = wrong(replace(textured, views=plain), depth)
    assert max(found.ours, found.true) < 1e-6 and found.better == 0


def test_what_no_other_view_sees_is_not_asked(textured: RealSet) -> None:
    """In truth something else is at that place in all other views, so that it is hidden there."""
    depth, truth = textured.truth.clone(), textured.truth.clone()
    depth[0, :8] *= 0.5
    truth[1:] *= 0.5
    found = wrong(replace(textured, truth=truth), torch.cat([depth[:1], truth[1:]]))
    assert found.seen == 0 and found.share == pytest.approx(8 / 48 / 4)


def test_pixels_without_a_depth_are_off_and_have_no_colours(textured: RealSet) -> None:
    depth = textured.truth.clone()
    depth[:, :12] = 0.0
    found = wrong(textured, depth)
    assert found.share == pytest.approx(1 / 4) and found.seen == 0
    assert not looked_up(textured, depth[0], 0, 1)[1][:12].any()
