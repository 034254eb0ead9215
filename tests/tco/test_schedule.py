"""What steps look at: every source in turn or by odds, targets by overlap, and when to stop."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from tco.schedule import Sources, Stagnation, draw_targets

OVERLAP = torch.tensor([[9.0, 5, 0, 1], [5, 9, 4, 0], [0, 4, 9, 0], [1, 0, 0, 9]])


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def shares(draws: list[int]) -> Tensor:
    return torch.bincount(torch.tensor(draws), minlength=4) / len(draws)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_an_epoch_has_each_view_once_whatever_the_sources_a_step(count: int) -> None:
    sources = Sources("epoch", OVERLAP, generator())
    steps = [sources.draw(count) for _ in range(12)]
    assert all(len(set(step)) == count for step in steps)
    flat = [view for step in steps for view in step]
    assert all(sorted(flat[i : i + 4]) == [0, 1, 2, 3] for i in range(0, len(flat), 4))
    assert len({tuple(flat[i : i + 4]) for i in range(0, len(flat), 4)}) > 1


def test_more_sources_than_views_are_all_views() -> None:
    for order in ("epoch", "overlap", "uniform"):
        assert sorted(Sources(order, OVERLAP, generator()).draw(9)) == [0, 1, 2, 3]


def test_sources_by_overlap_come_as_often_as_they_share_points() -> None:
    sources = Sources("overlap", OVERLAP, generator())
    got = shares([sources.draw(1)[0] for _ in range(1500)])
    shared = torch.tensor([6.0, 9, 4, 1])  # without the diagonal
    torch.testing.assert_close(got, shared / shared.sum(), atol=0.05, rtol=0)


def test_a_view_that_shares_nothing_is_still_drawn() -> None:
    overlap = OVERLAP.clone()
    overlap[3], overlap[:, 3] = 0, 0
    sources = Sources("overlap", overlap, generator())
    assert 3 in [sources.draw(1)[0] for _ in range(2000)]
    assert len({Sources("overlap", torch.zeros(4, 4), generator(i)).draw(1)[0] for i in range(40)}) == 4


def test_uniform_sources_come_equally_often_and_repeat() -> None:
    sources = Sources("uniform", OVERLAP, generator())
    draws = [sources.draw(1)[0] for _ in range(1500)]
    torch.testing.assert_close(shares(draws), torch.full((4,), 0.25), atol=0.05, rtol=0)
    assert any(a == b for a, b in itertools.pairwise(draws))


def test_an_unknown_order_is_an_error() -> None:
    with pytest.raises(ValueError, match="epoch, overlap or uniform"):
        Sources("random", OVERLAP, generator())


def test_targets_share_points_with_the_source_are_different_and_follow_the_odds() -> None:
    g = generator()
    single = [draw_targets(OVERLAP, 0, 1, g)[0] for _ in range(1500)]
    torch.testing.assert_close(shares(single), torch.tensor([0, 5 / 6, 0, 1 / 6]), atol=0.05, rtol=0)
    assert sorted(draw_targets(OVERLAP, 0, 4, g)) == [1, 3]
    assert draw_targets(torch.eye(4), 0, 4, g) == []


def test_stagnation_waits_for_all_views_and_then_for_its_patience() -> None:
    watch = Stagnation(range(2), patience=3)
    assert not any(watch.add(0, error) for error in (5.0, 5.0, 5.0, 5.0, 5.0))  # the other view is not known
    falling = [watch.add(i % 2, 4.0 - 0.3 * i) for i in range(1, 9)]
    assert not any(falling)
    flat = [watch.add(i % 2, 2.0) for i in range(8)]
    assert flat.index(True) == 2


def test_every_gain_starts_the_wait_anew() -> None:
    """Two measurements without gain between any two with: never the three that it waits for."""
    watch = Stagnation(range(1), patience=3)
    errors = [5.0, 5.0, 5.0, 4.0, 4.0, 4.0, 3.0, 3.0, 3.0, 2.0]
    assert not any(watch.add(0, error) for error in errors)


def test_a_hard_view_after_an_easy_one_is_no_stagnation() -> None:
    """Errors of 1 and 9 that both fall: the later of two successive errors is often the larger one."""
    watch = Stagnation(range(2), patience=2)
    assert not any(watch.add(i % 2, (1.0, 9.0)[i % 2] * 0.95**i) for i in range(20))


@pytest.mark.parametrize("order", ["epoch", "overlap", "uniform"])
def test_views_that_only_help_are_never_sources(order: str) -> None:
    sources = Sources(order, OVERLAP, generator(), helpers=2)
    drawn = [view for _ in range(12) for view in sources.draw(1)]
    assert set(drawn) == {0, 1}
    assert sorted(sources.draw(4)) == [0, 1]
