"""Of refined depths and those of before, the views together have those on which they agree."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tco.conclusion import AROUND, concluded, grown
from tco.optimize import Outcome
from tco.options import ConsensusConfig, PolishConfig, TCOConfig
from tco.planar.run import together
from tco.planar.view import SIDE
from tco.toy import Wall, wall
from tco.types import Cameras, Prediction

CONFIG = TCOConfig(consensus=ConsensusConfig(planes=0))


@pytest.fixture(scope="module")
def scene() -> Wall:
    return wall(7, (96, 128))


def cameras(scene: Wall) -> Cameras:
    assert scene.priors.cameras is not None
    return scene.priors.cameras


def said(scene: Wall, depth: Tensor, confidence: float = 5.0) -> Prediction:
    return Prediction(depth, torch.full_like(depth, confidence), cameras(scene), tuple(range(len(depth))))


def outcome(scene: Wall, depth: Tensor, before: Tensor | None) -> Outcome:
    old = None if before is None else said(scene, before)
    return Outcome(said(scene, depth), cameras(scene), before=old)


def noise(scene: Wall, share: float, seed: int = 0) -> Tensor:
    """Factors of depth with errors of a few pixels' length."""
    coarse = torch.randn(len(scene.depth), 1, 24, 32, generator=torch.Generator().manual_seed(seed))
    return 1 + share * torch.nn.functional.interpolate(coarse, scene.depth.shape[1:], mode="bilinear")[:, 0]


def test_growth_of_maps_that_are_alike_is_the_factor() -> None:
    error = torch.full((2, 40, 50), 0.004)
    assert torch.allclose(grown(error, error), torch.ones(2, 40, 50))
    assert torch.allclose(grown(error, 3 * error), torch.tensor(3.0))
    assert torch.allclose(grown(error, error / 5), torch.tensor(0.2))


def test_growth_is_a_geometric_mean_around_a_pixel() -> None:
    """Within the window, one of its pixels that grows by e^k moves the mean of logarithms by k / pixels."""
    before = torch.full((1, 96, 128), 0.01)
    after = before.clone()
    after[0, 48, 64] *= math.e**2
    r = max(1, round(AROUND * math.sqrt(96 * 128) / SIDE))
    growth = grown(before, after)[0].log()
    inside = growth[48 - r : 49 + r, 64 - r : 65 + r]
    assert torch.allclose(inside, torch.full_like(inside, 2 / (2 * r + 1) ** 2), atol=1e-6)
    assert int((growth.abs() > 1e-7).sum()) == (2 * r + 1) ** 2


def test_where_nobody_spoke_nothing_has_grown() -> None:
    nobody = torch.full((1, 20, 20), math.inf)
    assert torch.equal(grown(nobody, nobody), torch.ones(1, 20, 20))
    assert float(grown(torch.full_like(nobody, 0.01), nobody).min()) > 10


def test_harm_is_taken_back_and_good_is_kept(scene: Wall) -> None:
    """Refinement mends the left half and ruins the right one; what comes of it is the better of both."""
    old, bad = noise(scene, 0.02), noise(scene, 0.15, 1)
    before = scene.depth * old
    after = torch.where(torch.arange(128) < 64, scene.depth * (1 + 0.1 * (old - 1)), scene.depth * bad)
    end = concluded(outcome(scene, after, before), scene.views, scene.priors, CONFIG)
    left, right = slice(0, 48), slice(80, 128)
    of_old, of_new = (
        together(said(scene, d), cameras(scene), scene.views, scene.priors, CONFIG.consensus).agreement
        for d in (before, after)
    )
    found = end.flat.agreement
    kept = found.prediction.depth == of_new.prediction.depth
    back = found.prediction.depth == of_old.prediction.depth
    assert float(kept[..., left].float().mean()) > 0.95 and float(back[..., right].float().mean()) > 0.95
    assert torch.equal(found.error[kept & ~back], of_new.error[kept & ~back])
    doubt = torch.maximum(of_old.error, of_new.error)
    assert torch.equal(found.error[back & ~kept], doubt[back & ~kept])
    error = (found.prediction.depth / scene.depth - 1).abs()
    ruined = (of_new.prediction.depth / scene.depth - 1).abs()
    assert float(error[..., right].mean()) < 0.5 * float(ruined[..., right].mean())
    assert torch.equal(end.flat.before.prediction.depth, found.prediction.depth)


def test_without_a_bound_all_refined_depths_are_kept(scene: Wall) -> None:
    config = replace(CONFIG, polish=PolishConfig(polish_growth=0.0))
    after = scene.depth * noise(scene, 0.15)
    end = concluded(outcome(scene, after, scene.depth), scene.views, scene.priors, config)
    expected = together(said(scene, after), cameras(scene), scene.views, scene.priors, config.consensus)
    assert torch.equal(end.flat.agreement.prediction.depth, expected.agreement.prediction.depth)


@pytest.mark.parametrize("planes", [0, 20])
def test_what_was_not_refined_is_the_consensus_of_what_it_is(scene: Wall, planes: int) -> None:
    config = replace(CONFIG, consensus=ConsensusConfig(planes=planes))
    depth = scene.depth * noise(scene, 0.03)
    end = concluded(outcome(scene, depth, None), scene.views, scene.priors, config, 4)
    expected = together(said(scene, depth), cameras(scene), scene.views, scene.priors, config.consensus, 4)
    assert len(end.flat.planes) == len(expected.planes)
    assert torch.equal(end.flat.agreement.prediction.depth, expected.agreement.prediction.depth)
    assert torch.equal(end.flat.agreement.error, expected.agreement.error)


def test_where_nobody_is_asked_refined_depths_stay(scene: Wall) -> None:
    config = replace(CONFIG, consensus=ConsensusConfig(consensus_rounds=0))
    after = scene.depth * noise(scene, 0.15)
    end = concluded(outcome(scene, after, scene.depth), scene.views, scene.priors, config)
    assert torch.equal(end.flat.agreement.prediction.depth, after)
    assert end.flat.planes == () and bool(end.flat.agreement.error.isinf().all())
    assert torch.equal(end.agreement.prediction.depth, after) and not end.taken.any()


def test_a_depth_that_is_another_views_is_as_unsure_as_the_two_differ() -> None:
    """Five of eleven views are wrong alike, enough to tell how sure they are of it."""
    scene = wall(11)
    depth = scene.depth.clone()
    depth[1::2] *= 1.3
    end = concluded(outcome(scene, depth, None), scene.views, scene.priors, CONFIG)
    before, after = end.flat.agreement, end.agreement
    apart = (after.prediction.depth / before.prediction.depth).log().abs()
    assert float(end.taken[1::2].float().mean()) > 0.5 > 10 * float(end.taken[::2].float().mean())
    assert torch.equal(after.error[end.taken], torch.maximum(before.error, apart)[end.taken])
    told = after.error[end.taken & before.error.isfinite()]
    assert len(told) > 1000 and float(told.median()) == pytest.approx(math.log(1.3), abs=0.01)
    assert torch.equal(after.error[~end.taken], before.error[~end.taken])
    assert torch.equal(after.prediction.depth[~end.taken], before.prediction.depth[~end.taken])
    assert torch.equal(after.prediction.confidence, before.prediction.confidence)
