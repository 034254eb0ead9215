"""Depths that steps compare with: the first ones, when they are renewed, and that only those are replaced."""

from __future__ import annotations

from dataclasses import replace

import torch

from tco.context import detached, due, enlarged, merged
from tco.geometry import project
from tco.toy import wall
from tco.types import Cameras, Prediction


def test_depths_are_due_every_few_steps_and_not_at_first() -> None:
    assert [step for step in range(13) if due(step, 4)] == [4, 8, 12]


def test_a_plane_is_enlarged_to_what_is_seen_at_that_size() -> None:
    """Inverse depths of a plane are linear in the picture; up to the border, which has nothing beyond."""
    small, large = (wall(3, size) for size in ((24, 32), (48, 64)))
    assert small.priors.cameras is not None and large.priors.cameras is not None
    across = torch.arange(32.0).expand(3, 24, 32) + 1
    stage = torch.rand(3, 2, 24, 32)
    said = Prediction(small.depth, across, small.priors.cameras, (0, 1, 2), (stage,))
    found = enlarged(said, (48, 64))
    torch.testing.assert_close(found.depth[:, 1:-1, 1:-1], large.depth[:, 1:-1, 1:-1])
    torch.testing.assert_close(
        found.confidence[:, :, 1:-1], torch.arange(0.25, 31, 0.5).expand(3, 48, 62) + 1
    )
    points = torch.tensor([[0.3, -0.2, 2.0], [-0.4, 0.1, 1.5]]).expand(3, 2, 3)
    places, there = (project(points, cameras.K)[0] for cameras in (found.cameras, large.priors.cameras))
    torch.testing.assert_close(places, there)
    assert torch.equal(found.cameras.world_from_cam, small.priors.cameras.world_from_cam)
    assert found.stages[0] is stage and found.views == said.views
    assert enlarged(replace(found, stages=()), (48, 64)).depth is found.depth


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
