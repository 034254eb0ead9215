"""Depths that steps compare with: when they are renewed, and that only those are replaced."""

from __future__ import annotations

import torch

from tco.context import detached, due, merged
from tco.types import Cameras, Prediction


def test_depths_are_due_every_few_steps_and_not_at_first() -> None:
    assert [step for step in range(13) if due(step, 4)] == [4, 8, 12]


def prediction(depth: float, views: tuple[int, ...]) -> Prediction:
    cameras = Cameras(torch.eye(4).repeat(3, 1, 1), torch.eye(3).repeat(3, 1, 1))
    maps = (
        torch.full((len(views), 2, 2), depth, requires_grad=True)
        * torch.arange(1.0, len(views) + 1)[:, None, None]
    )
    return Prediction(maps, maps + 1, cameras, views, rays=torch.stack([maps, -maps], -1))


def test_merging_replaces_the_views_of_the_part_alone() -> None:
    every, part = detached(prediction(1.0, (0, 1, 2))), detached(prediction(10.0, (2, 0)))
    both = merged(every, part)
    assert both.depth[:, 0, 0].tolist() == [20.0, 2.0, 10.0]
    assert both.confidence[:, 0, 0].tolist() == [21.0, 3.0, 11.0]
    assert both.rays is not None and both.rays[:, 0, 0, 1].tolist() == [-20.0, -2.0, -10.0]
    assert both.views == (0, 1, 2) and every.depth[:, 0, 0].tolist() == [1.0, 2.0, 3.0]


def test_what_is_detached_has_the_values_and_no_history() -> None:
    before = prediction(1.0, (0, 1, 2))
    after = detached(before)
    assert before.depth.requires_grad and not after.depth.requires_grad and not after.confidence.requires_grad
    assert torch.equal(before.depth, after.depth)
    assert before.rays is not None and after.rays is not None and not after.rays.requires_grad
    assert torch.equal(before.rays, after.rays)
