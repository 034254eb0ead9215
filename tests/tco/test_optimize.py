"""The optimisation loop: what it leaves untouched, what it lowers, and how it gets over a bad step."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tco.backbones.base import Backbone
from tco.backbones.sweep import Sweep
from tco.backbones.sweeping import Hints, interpolate_points
from tco.backbones.weights import load_sweep
from tco.optimize import Outcome, optimize
from tco.options import PolishConfig, TCOConfig
from tco.penalties import sparse_depth
from tco.terms import errors_at_points
from tco.toy import Toy, wall
from tco.types import Cameras, Prediction, Priors, SparseDepth, Views

Scene = tuple[Views, Priors, Tensor]
V = 4


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Four 96×64 views of a room with uncertain cameras, and their true depth."""
    from training.dataset import assemble, triangulated
    from training.scenes import walk

    sample = walk(4, V, (64, 96))
    tracks = triangulated(sample, np.random.default_rng(0))
    views, priors, truth = assemble(sample, sample.images.astype(np.float32) / 255, tracks)
    return views, uncertain(priors, 0.002, 0.005), truth


def uncertain(priors: Priors, rotation: float, centre: float, focal: float = 0.005) -> Priors:
    return replace(
        priors,
        rotation_sigma=torch.full((V,), rotation),
        centre_sigma=torch.full((V,), centre),
        focal_sigma=torch.full((V,), focal),
    )


@pytest.fixture(scope="module")
def network() -> Sweep:
    return load_sweep()


class Small(nn.Module):
    """The smallest backbone: the points' interpolation, changed by one convolution of the image.

    Attributes:
        decoded: views of every decoding with gradients.
        shown: number of points of every ``with_points``.
    """

    name, stride, uses_cameras = "small", 1, True

    def __init__(self, gain: float = 1.0) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 1, 3, padding=1)
        self.gain = gain
        self.decoded: list[tuple[int, ...]] = []
        self.shown: list[dict[int, int]] = []
        with torch.no_grad():
            for parameter in self.parameters():
                parameter.copy_(0.05 * torch.sin(torch.arange(parameter.numel())).reshape(parameter.shape))

    def encode(self, views: Views, priors: Priors) -> tuple[Tensor, Hints, Cameras]:
        assert priors.cameras is not None
        points = priors.sparse or ()
        return views.images, interpolate_points(points, views.size, 1, views.images), priors.cameras

    def with_points(self, encoded: Any, points: Mapping[int, SparseDepth]) -> Any:
        images, hints, cameras = encoded
        self.shown.append({view: len(p) for view, p in points.items()})
        size = (images.shape[2], images.shape[3])
        other = interpolate_points(list(points.values()), size, 1, images)
        return images, hints.replaced(torch.tensor(list(points)), other), cameras

    def decode(
        self, encoded: Any, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        images, hints, cameras = encoded
        chosen = tuple(range(len(images))) if views is None else tuple(views)
        if torch.is_grad_enabled():
            self.decoded.append(chosen)
        factor = torch.exp(self.gain * self.conv(images[list(chosen)])[:, 0])
        depth = factor / hints.smooth[list(chosen)]
        return Prediction(depth, torch.full_like(depth, 3.0), cameras, chosen)

    def decoder(self) -> nn.Module:
        return self


ALONE = PolishConfig(polish_looks=0)
SMALL = TCOConfig(steps=6, lora_targets=("conv",), rate=0.01, polish=ALONE)
QUICK = TCOConfig(steps=3, polish=ALONE)


def depth_of(outcome: Outcome) -> Tensor:
    return outcome.prediction.depth


def state(module: nn.Module) -> dict[str, tuple[bytes, bool]]:
    """Every byte of a module's tensors, and whether they get gradients."""
    tensors = dict(module.named_parameters()) | dict(module.named_buffers())
    return {k: (t.detach().contiguous().numpy().tobytes(), t.requires_grad) for k, t in tensors.items()}


def test_the_small_network_is_a_backbone() -> None:
    assert isinstance(Small(), Backbone)


def test_no_steps_is_the_plain_prediction(network: Sweep, scene: Scene) -> None:
    views, priors, _ = scene
    outcome = optimize(network, views, priors, TCOConfig(steps=0))
    with torch.no_grad():
        plain = network.decode(network.encode(views, priors))
    assert torch.equal(depth_of(outcome), plain.depth)
    assert torch.equal(outcome.prediction.confidence, plain.confidence)
    assert priors.cameras is not None
    assert torch.equal(outcome.cameras.world_from_cam, priors.cameras.world_from_cam)
    assert (outcome.history, outcome.corrections, outcome.rolled_back) == ([], {}, ())


def test_the_network_is_left_bit_identical(network: Sweep, scene: Scene) -> None:
    views, priors, _ = scene
    before, modes = state(network), [m.training for m in network.modules()]
    first = optimize(network, views, priors, TCOConfig(steps=0))
    outcome = optimize(network, views, priors, replace(QUICK, rate=0.05))
    assert state(network) == before
    assert [m.training for m in network.modules()] == modes
    assert not torch.equal(depth_of(outcome), depth_of(first))  # it did change while it was adapted
    assert torch.equal(depth_of(optimize(network, views, priors, TCOConfig(steps=0))), depth_of(first))


def test_the_network_is_left_bit_identical_by_an_interruption(network: Sweep, scene: Scene) -> None:
    views, priors, _ = scene
    before = state(network)

    def interrupt(step: int, terms: Mapping[str, float]) -> None:
        if step == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        optimize(network, views, priors, replace(QUICK, rate=0.05), report=interrupt)
    assert state(network) == before


def test_equal_seeds_give_equal_results_and_others_do_not(network: Sweep, scene: Scene) -> None:
    views, priors, _ = scene
    torch.manual_seed(123)
    a = optimize(network, views, priors, QUICK, seed=5)
    torch.manual_seed(321)  # the global generator has no part in it
    b = optimize(network, views, priors, QUICK, seed=5)
    c = optimize(network, views, priors, QUICK, seed=6)
    assert torch.equal(depth_of(a), depth_of(b))
    assert a.history == b.history and a.corrections == b.corrections
    assert torch.equal(a.cameras.world_from_cam, b.cameras.world_from_cam)
    assert a.history != c.history and not torch.equal(depth_of(a), depth_of(c))


def misfit(depth: Tensor, points: Sequence[SparseDepth]) -> float:
    return float(sum(sparse_depth(d, p) for d, p in zip(depth, points, strict=True)))


@pytest.mark.slow
def test_optimisation_lowers_the_loss(network: Sweep, scene: Scene) -> None:
    """The misfit to the points that it is given falls, and so does that of the whole loss by the epoch."""
    views, priors, _ = scene
    config = TCOConfig(steps=4 * V, rate=3e-3, camera_rate=0, point_dropout=0, polish=ALONE)
    outcome = optimize(network, views, priors, config)
    plain = optimize(network, views, priors, TCOConfig(steps=0))
    assert priors.sparse is not None
    assert misfit(depth_of(outcome), priors.sparse) < 0.93 * misfit(depth_of(plain), priors.sparse)
    losses = torch.tensor([terms["loss"] for terms in outcome.history]).reshape(-1, V)
    assert losses[-2:].mean() < 0.95 * losses[0].mean()


def test_certain_cameras_stay_where_they_are(scene: Scene) -> None:
    views, priors, _ = scene
    certain = uncertain(priors, 1e-7, 1e-7, 1e-7)
    assert priors.cameras is not None
    outcome = optimize(Small(), views, certain, SMALL)
    torch.testing.assert_close(
        outcome.cameras.world_from_cam, priors.cameras.world_from_cam, rtol=0, atol=1e-6
    )
    assert max(outcome.corrections["rotation_degrees"]) < 1e-5


def test_every_step_is_reported_with_its_terms(scene: Scene) -> None:
    """The loss is their weighted sum."""
    views, priors, _ = scene
    seen: list[tuple[int, dict[str, float]]] = []
    config = replace(SMALL, photometric_weight=3.0, sparse_weight=0.25, camera_weight=2.0)
    outcome = optimize(Small(), views, priors, config, report=lambda step, terms: seen.append((step, terms)))
    assert [step for step, _ in seen] == list(range(config.steps))
    assert [terms for _, terms in seen] == outcome.history
    for _, terms in seen:
        assert terms.keys() == {"photometric", "sparse", "cameras", "loss"}
        total = 3 * terms["photometric"] + 0.25 * terms["sparse"] + 2 * terms["cameras"]
        assert terms["loss"] == pytest.approx(total, rel=1e-5)
    assert outcome.history[0]["cameras"] == 0


@pytest.mark.parametrize("term", ["photometric", "sparse"])
def test_a_weight_of_zero_switches_its_term_off(scene: Scene, term: str) -> None:
    views, priors, _ = scene
    off = replace(SMALL, **{f"{term}_weight": 0.0})
    history = optimize(Small(), views, priors, off).history
    assert all(term not in terms and len(terms) == 3 for terms in history)


def test_cameras_that_may_not_move_have_no_term_and_need_no_uncertainty(scene: Scene) -> None:
    views, priors, _ = scene
    unknown = replace(priors, rotation_sigma=None, centre_sigma=None, focal_sigma=None)
    outcome = optimize(Small(), views, unknown, replace(SMALL, camera_rate=0))
    assert outcome.corrections == {}
    assert all("cameras" not in terms for terms in outcome.history)
    assert priors.cameras is not None
    assert torch.equal(outcome.cameras.world_from_cam, priors.cameras.world_from_cam)
    with pytest.raises(ValueError, match="uncertainty"):
        optimize(Small(), views, unknown, SMALL)


def test_with_every_term_off_nothing_changes(scene: Scene) -> None:
    views, priors, _ = scene
    config = replace(SMALL, photometric_weight=0, sparse_weight=0, camera_weight=0, camera_rate=0)
    small = Small()
    outcome = optimize(small, views, priors, config)
    assert len(outcome.history) == SMALL.steps and small.decoded == []
    assert torch.equal(depth_of(outcome), depth_of(optimize(Small(), views, priors, TCOConfig(steps=0))))


def test_with_nothing_to_optimise_there_is_an_error(scene: Scene) -> None:
    views, priors, _ = scene
    with pytest.raises(ValueError, match="nothing to optimise"):
        optimize(Small(), views, priors, replace(SMALL, lora_targets=(), camera_rate=0))


def test_a_step_whose_terms_cannot_change_is_no_failure(scene: Scene) -> None:
    """Cameras alone may move, no view shares anything, and priors have no weight: nothing depends on them."""
    views, priors, _ = scene
    assert priors.overlap is not None
    alone = replace(priors, overlap=torch.zeros_like(priors.overlap))
    outcome = optimize(Small(), views, alone, replace(SMALL, lora_targets=(), camera_weight=0.0))
    assert len(outcome.history) == SMALL.steps and outcome.rolled_back == ()


def test_what_has_no_weight_is_not_computed(scene: Scene) -> None:
    """Depths of the other views that would end the optimisation are never looked at."""
    views, priors, _ = scene
    unlucky = replace(views, images=views.images.clone())
    unlucky.images[:] = math.nan
    only_points = replace(SMALL, photometric_weight=0)

    class Blind(Small):
        """Interpolates the points, changed by a convolution of what is not the image."""

        def encode(self, views: Views, priors: Priors) -> Any:
            return super().encode(replace(views, images=torch.ones_like(views.images)), priors)

    outcome = optimize(Blind(), unlucky, priors, only_points)
    assert outcome.rolled_back == ()
    assert optimize(Blind(), unlucky, priors, SMALL).rolled_back != ()


@pytest.mark.parametrize("name", ["cameras", "overlap", "sparse"])
def test_a_missing_prior_is_an_error(network: Sweep, scene: Scene, name: str) -> None:
    views, priors, _ = scene
    with pytest.raises(ValueError, match="needs cameras,"):
        optimize(network, views, replace(priors, **{name: None}), QUICK)


def test_without_an_overlap_all_views_are_compared(scene: Scene) -> None:
    views, priors, _ = scene
    everything = torch.ones(len(views), len(views)).fill_diagonal_(0)
    results = [optimize(Small(), views, replace(priors, overlap=o), SMALL) for o in (None, everything)]
    assert results[0].history == results[1].history


def test_the_steps_end_when_held_out_points_improve_no_more(scene: Scene) -> None:
    """With a rate of next to nothing nothing improves: each view is measured once, then the patience ends."""
    views, priors, _ = scene
    assert priors.sparse is not None
    still = replace(SMALL, steps=40, rate=1e-12, camera_rate=0, stop_after=3, point_dropout=0.0)
    outcome = optimize(Small(), views, priors, still, watched=priors.sparse)
    assert len(outcome.history) == len(views) + 3
    assert all("hidden" not in step for step in outcome.history)
    some = (priors.sparse[0][torch.zeros(len(priors.sparse[0]), dtype=torch.bool)], *priors.sparse[1:])
    blind = optimize(Small(), views, priors, still, watched=some)  # a view that has none does not hold it up
    assert len(blind.history) < 2 * len(views) + 6


def test_every_view_is_a_source_once_before_any_is_again(scene: Scene) -> None:
    views, priors, _ = scene
    small = Small()
    optimize(small, views, priors, replace(SMALL, steps=3 * V))
    epochs = [sorted(v for (v,) in small.decoded[i : i + V]) for i in range(0, 3 * V, V)]
    assert epochs == [list(range(V))] * 3
    assert small.decoded[:V] != small.decoded[V : 2 * V] or small.decoded[V : 2 * V] != small.decoded[-V:]


def test_a_share_of_the_points_is_hidden_from_the_network(scene: Scene) -> None:
    views, priors, _ = scene
    assert priors.sparse is not None
    small = Small()
    optimize(small, views, priors, replace(SMALL, steps=2 * V, point_dropout=0.75))
    assert [tuple(shown) for shown in small.shown] == small.decoded
    counts = [count / len(priors.sparse[view]) for shown in small.shown for view, count in shown.items()]
    assert np.mean(counts) == pytest.approx(0.25, abs=0.05)
    assert len(set(counts)) > V  # another draw each time

    small = Small()
    optimize(small, views, priors, replace(SMALL, point_dropout=0.0))
    assert small.shown == []


def test_a_view_with_hardly_any_points_keeps_them(scene: Scene) -> None:
    views, priors, _ = scene
    assert priors.sparse is not None
    few = tuple(points[torch.arange(3)] for points in priors.sparse)
    small = Small()
    outcome = optimize(small, views, replace(priors, sparse=few), SMALL)
    assert small.shown == []
    assert all("sparse" in terms for terms in outcome.history)


def test_views_that_share_no_point_are_never_compared(scene: Scene) -> None:
    """A view without overlap has no targets: its steps do not have the term that needs them."""
    views, priors, _ = scene
    assert priors.overlap is not None
    overlap = priors.overlap.clone()
    overlap[2], overlap[:, 2] = 0, 0
    small = Small()
    outcome = optimize(small, views, replace(priors, overlap=overlap), replace(SMALL, steps=V))
    for (source,), terms in zip(small.decoded, outcome.history, strict=True):
        assert ("photometric" in terms) == (source != 2)
        assert "sparse" in terms


class Breaking(Small):
    """Gives depths that are not finite at some of the decodings with gradients."""

    def __init__(self, broken: Sequence[int], value: float) -> None:
        super().__init__()
        self.broken, self.value = broken, value

    def decode(
        self, encoded: Any, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        number = len(self.decoded)
        prediction = super().decode(encoded, views, context)
        if torch.is_grad_enabled() and number in self.broken:
            return replace(prediction, depth=prediction.depth * self.value)
        return prediction


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_step_that_is_not_finite_is_rolled_back_and_recorded(
    scene: Scene, value: float, caplog: pytest.LogCaptureFixture
) -> None:
    views, priors, _ = scene
    with caplog.at_level(logging.WARNING, logger="tco.optimize"):
        outcome = optimize(Breaking((2, 3), value), views, priors, SMALL)
    assert outcome.rolled_back == (2, 3)
    assert len(outcome.history) == SMALL.steps
    assert all(math.isfinite(outcome.history[step]["loss"]) for step in (0, 1, 4, 5))
    assert sum("back to the best state" in record.getMessage() for record in caplog.records) == 2
    assert bool(torch.isfinite(depth_of(outcome)).all())
    assert bool(torch.isfinite(outcome.cameras.world_from_cam).all())


def test_a_view_that_is_masked_out_altogether_stops_nothing(scene: Scene) -> None:
    views, priors, _ = scene
    valid = views.valid.clone()
    valid[1] = False
    small = Small()
    outcome = optimize(small, replace(views, valid=valid), priors, replace(SMALL, steps=V))
    assert outcome.rolled_back == ()
    assert ["photometric" in terms for terms in outcome.history] == [v != (1,) for v in small.decoded]


def test_after_a_roll_back_the_best_state_is_what_is_left(scene: Scene) -> None:
    """All steps after the first fail: the best state is the one that the first was evaluated at."""
    views, priors, _ = scene
    outcome = optimize(Breaking(range(1, 6), math.nan), views, priors, SMALL)
    assert outcome.rolled_back == (1, 2, 3, 4, 5)
    assert torch.equal(depth_of(outcome), depth_of(optimize(Small(), views, priors, TCOConfig(steps=0))))
    assert outcome.corrections["centre"] == [0.0] * V


def test_the_best_state_is_the_one_of_the_lowest_loss(scene: Scene) -> None:
    """The last of twelve steps fails: what is left is as good as the best of the others, not the start."""
    views, priors, _ = scene
    outcome = optimize(Breaking((11,), math.nan), views, priors, replace(SMALL, steps=12))
    losses = [terms["loss"] for terms in outcome.history[:11]]
    best = int(np.argmin(losses))
    assert outcome.rolled_back == (11,) and 0 < best < 10
    until = optimize(Small(), views, priors, replace(SMALL, steps=best))
    assert torch.equal(depth_of(outcome), depth_of(until))


def test_a_rate_that_makes_the_network_explode_gives_a_finite_result(scene: Scene) -> None:
    """Even if the depths that the others are compared with were computed while it was far off."""
    views, priors, _ = scene
    config = replace(SMALL, steps=7, rate=1e3, refresh=1, clip=1e9)
    for steps in (6, 7):
        outcome = optimize(Small(gain=100.0), views, priors, replace(config, steps=steps))
        assert outcome.rolled_back
        assert bool(torch.isfinite(depth_of(outcome)).all()) and bool((depth_of(outcome) > 0).all())


def test_the_embedded_network_recovers_from_an_explosion(network: Sweep, scene: Scene) -> None:
    views, priors, _ = scene
    before = state(network)
    config = TCOConfig(steps=4, rate=1e20, refresh=1, polish=ALONE)
    outcome = optimize(network, views, priors, config)
    assert outcome.rolled_back
    assert bool(torch.isfinite(depth_of(outcome)).all())
    assert state(network) == before


def test_images_that_are_not_finite_stop_nothing(network: Sweep, scene: Scene) -> None:
    views, priors, _ = scene
    broken = replace(views, images=views.images.clone())
    broken.images[1] = math.nan
    before = state(network)
    outcome = optimize(network, broken, priors, QUICK)
    assert outcome.rolled_back
    assert state(network) == before


def test_errors_at_points_are_those_of_the_pixels_they_fall_into() -> None:
    depth = torch.tensor([[[1.0, 2.0, 4.0], [5.0, 8.0, 10.0]], [[2.0, 2.0, 2.0], [2.0, 2.0, 2.0]]])
    xy = torch.tensor([[0.01, 0.01], [1.99, 0.5], [2.01, 1.5], [3.0, 2.0], [0.5, 1.999]])
    truth = torch.tensor([1.0, 1.0, 20.0, 10.0, 4.0])
    points = SparseDepth(xy, truth, torch.full((5,), 0.01), torch.arange(5))
    cameras = Cameras(torch.eye(4).repeat(2, 1, 1), torch.eye(3).repeat(2, 1, 1))
    prediction = Prediction(depth, torch.ones_like(depth), cameras, (0, 1))
    first, second = errors_at_points(prediction, [points, points[torch.tensor([], dtype=torch.long)]])
    torch.testing.assert_close(first, torch.tensor([0.0, 1.0, -0.5, 0.0, 0.25]))
    assert second.shape == (0,)


@pytest.mark.parametrize(
    "wrong",
    [
        {"steps": -1},
        {"targets": 0},
        {"sources": 0},
        {"refresh": 0},
        {"point_dropout": 1.0},
        {"point_dropout": -0.1},
    ],
)
def test_settings_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"steps|point_dropout"):
        TCOConfig(**wrong)  # type: ignore[arg-type]


def test_watched_points_are_measured_in_every_step_and_steer_nothing(scene: Scene) -> None:
    """Where nothing learns and nothing is hidden, each step sees the error of the plain prediction."""
    views, priors, _ = scene
    assert priors.sparse is not None
    watched = [points[torch.arange(len(points)) % 3 == view % 2] for view, points in enumerate(priors.sparse)]
    watched[2] = watched[2][torch.zeros(len(watched[2]), dtype=torch.bool)]
    still = replace(SMALL, steps=2 * V, rate=0.0, camera_rate=0.0, point_dropout=0.0)
    small = Small()
    outcome = optimize(small, views, priors, still, watched=watched)
    errors = errors_at_points(outcome.prediction, watched)
    for (source,), terms in zip(small.decoded, outcome.history, strict=True):
        if source == 2:
            assert "held_out" not in terms
        else:
            assert terms["held_out"] == pytest.approx(float(errors[source].abs().median()), rel=1e-4)
    with_points = optimize(Small(), views, priors, SMALL, watched=watched)
    without = optimize(Small(), views, priors, SMALL)
    assert torch.equal(depth_of(with_points), depth_of(without))
    assert [t["loss"] for t in with_points.history] == [t["loss"] for t in without.history]


def test_views_that_only_help_are_predicted_by_the_adapted_network() -> None:
    """Like the others, they come nearer to the truth, though no step has one as its source."""
    scene, polish = wall(), PolishConfig(polish_looks=0)
    config = TCOConfig(steps=12, rate=0.01, lora_targets=("plane",), camera_rate=0, refresh=20, polish=polish)
    plain = optimize(Toy(), scene.views, scene.priors, replace(config, steps=0))
    done = optimize(Toy(), replace(scene.views, helpers=1), scene.priors, config)
    for part in (slice(3), slice(3, None)):
        error = [float((o.prediction.depth / scene.depth - 1).abs()[part].mean()) for o in (plain, done)]
        assert error[1] < error[0] / 3
