"""The training loop: losses of known value, a loss that falls, and a state that resumes exactly."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tco.backbones.decoder import SweepConfig
from tco.backbones.sweep import Encoded, Stage, Sweep
from tco.backbones.sweeping import BACKGROUND
from tco.backbones.weights import EMBEDDED, load_sweep
from training import train
from training.dataset import load, write
from training.train import (
    CONTRAST,
    TrainConfig,
    Trainer,
    coarse_loss,
    fine_loss,
    losses,
    pooled,
    slope_loss,
    with_agreed,
    with_sky,
)

NOWHERE = torch.zeros(1, 1, 1)
"""A background that nothing belongs to."""

TINY = SweepConfig(
    planes=16, groups=(4, 2), coarse=16, fine=8, context=8, volume=6, tokens=32, heads=2, blocks=1, hidden=16
)
CONFIG = TrainConfig(steps=40, warmup=2, sizes=((0.0, 96, 128),), refined=1, held_out=1)


def tiny(told: SweepConfig = TINY) -> Sweep:
    """A small network, with what the trainer wants of the pictures."""
    return Sweep(replace(TINY, equalise=told.equalise))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write(folder, 0, 3, (96, 128), 4)
    return folder


@pytest.fixture
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train, "Sweep", tiny)


def test_pooled_depth_is_a_mean_on_surfaces_and_one_pixel_at_edges() -> None:
    """Inverse depth is averaged, for it is what is linear on a plane."""
    inverse = 0.5 + 0.01 * torch.arange(8.0).expand(8, 8)
    got = pooled((1 / inverse)[None], 4)
    torch.testing.assert_close(got, torch.tensor([[[0.515, 0.555]] * 2]))

    edge = torch.full((1, 4, 4), 1.0)
    edge[..., 3:] = 4.0
    torch.testing.assert_close(pooled(edge, 4), torch.ones(1, 1, 1))  # not the mean of both sides
    hole = torch.full((1, 4, 4), 2.0)
    hole[0, 2, 2] = 0
    assert pooled(hole, 4) == 0


def planes_stage(scores: Tensor, inverse: Tensor) -> tuple[Stage, Encoded]:
    zero = torch.zeros(1)
    encoded = Encoded(zero, zero, (), torch.tensor([0.2]), torch.tensor([0.1]), zero, None, None)  # type: ignore[arg-type]
    return Stage(inverse, torch.zeros_like(inverse), scores), encoded


def test_the_coarse_loss_is_the_cross_entropy_between_the_two_nearest_planes() -> None:
    """Truth at plane 2.25: the best scores put ¾ and ¼ there, and leave the entropy of that choice."""
    truth = torch.full((1, 1, 1), 0.2 + 0.225)
    best = torch.full((1, 6, 1, 1), -30.0)
    best[0, 2], best[0, 3] = math.log(0.75), math.log(0.25)
    entropy = -(0.75 * math.log(0.75) + 0.25 * math.log(0.25))
    stage, encoded = planes_stage(best, truth)
    assert float(coarse_loss(stage, encoded, truth)) == pytest.approx(entropy, abs=1e-4)

    off, _ = planes_stage(best, truth + 0.05)  # half a plane
    assert float(coarse_loss(off, encoded, truth)) == pytest.approx(entropy + 0.15, abs=1e-4)
    flat, _ = planes_stage(torch.zeros(1, 6, 1, 1), truth)
    assert float(coarse_loss(flat, encoded, truth)) == pytest.approx(math.log(6), abs=1e-4)


def test_pixels_without_truth_do_not_count() -> None:
    truth = torch.tensor([[[0.4, 0.0]]])
    scores = torch.randn(1, 6, 1, 2, generator=torch.Generator().manual_seed(0))
    stage, encoded = planes_stage(scores, torch.tensor([[[0.41, 0.3]]]))
    alone, _ = planes_stage(scores[..., :1], torch.tensor([[[0.41]]]))
    torch.testing.assert_close(
        coarse_loss(stage, encoded, truth), coarse_loss(alone, encoded, truth[..., :1])
    )
    both = [
        fine_loss(Stage(s.inverse, s.log_error), t, NOWHERE)
        for s, t in ((stage, truth), (alone, truth[..., :1]))
    ]
    torch.testing.assert_close(both[0], both[1])


@pytest.mark.parametrize(("truth", "end"), [(0.05, 0), (5.0, 5)])
def test_what_lies_outside_the_sweep_belongs_to_its_end(truth: float, end: int) -> None:
    sure = torch.full((1, 6, 1, 1), -30.0)
    sure[0, end] = 0.0
    stage, encoded = planes_stage(sure, torch.tensor([[[0.2 + 0.1 * end]]]))
    assert float(coarse_loss(stage, encoded, torch.full((1, 1, 1), truth))) < 0.05
    wrong, _ = planes_stage(sure.flip(1), torch.tensor([[[0.2 + 0.1 * end]]]))
    assert float(coarse_loss(wrong, encoded, torch.full((1, 1, 1), truth))) > 20


def test_a_common_offset_has_no_slope_and_a_tilt_has_its_own() -> None:
    truth = 0.3 + 0.2 * torch.rand(1, 12, 16, generator=torch.Generator().manual_seed(2))
    zero = torch.zeros_like(truth)
    assert float(slope_loss(Stage(truth * 1.03, zero), truth, NOWHERE)) == pytest.approx(0, abs=1e-5)
    tilted = truth * torch.exp(0.01 * torch.arange(16.0))
    assert float(slope_loss(Stage(tilted, zero), truth, NOWHERE)) == pytest.approx(
        0.01 + 0.02 + 0.04, rel=1e-3
    )
    holes = truth.clone()
    holes[:, ::2] = 0
    holes[:, :, ::2] = 0  # no two neighbours at spacing 1; those at 2 and 4 remain
    assert float(slope_loss(Stage(tilted, zero), holes, NOWHERE)) == pytest.approx(0.02 + 0.04, rel=1e-3)


def test_the_fine_loss_is_lowest_where_the_expected_error_is_the_true_one() -> None:
    """Laplace: for an error e the best scale is e, where its part of the loss is 1 + log e."""
    truth = torch.full((1, 1, 1), 0.5)
    inverse = truth * 1.04
    scales = torch.tensor([0.01, 0.02, 0.04, 0.08, 0.16])
    values = [
        float(fine_loss(Stage(inverse, scale.log().expand(1, 1, 1)), truth, NOWHERE)) for scale in scales
    ]
    assert min(values) == values[2] == pytest.approx(1 + math.log(0.04) + 8 * 0.04, abs=1e-4)
    exact = float(fine_loss(Stage(truth, torch.full((1, 1, 1), math.log(3e-3))), truth, NOWHERE))
    assert exact == pytest.approx(math.log(3e-3), abs=1e-5)


def test_the_sky_is_at_the_end_of_the_sweep() -> None:
    """0.2 is the sweep's smallest inverse depth: what is farther, and the sky, is there."""
    _, encoded = planes_stage(torch.zeros(1, 6, 1, 3), torch.zeros(1, 1, 3))
    depth, floor = with_sky(torch.tensor([[[2.5, 0.0, 9.0]]]), encoded)
    torch.testing.assert_close(depth, torch.tensor([[[2.5, 5.0, 5.0]]]))
    assert float(floor) == pytest.approx(0.2 * BACKGROUND)


def test_in_the_background_errors_are_relative_to_where_it_begins() -> None:
    """At half of the background's inverse depth, the same difference is half of what it is relatively."""
    truth, log_b = torch.full((1, 1, 1), 0.1), torch.zeros(1, 1, 1)
    stage = Stage(truth + 0.01, log_b)
    assert float(fine_loss(stage, truth, NOWHERE)) == pytest.approx(0.1 + 8 * 0.1, rel=1e-4)
    assert float(fine_loss(stage, truth, NOWHERE + 0.2)) == pytest.approx(0.05 + 8 * 0.05, rel=1e-4)
    tilted = Stage(truth.expand(1, 8, 8) * torch.exp(0.01 * torch.arange(8.0)), log_b.expand(1, 8, 8))
    assert float(slope_loss(tilted, truth.expand(1, 8, 8), NOWHERE)) > 0.05
    assert float(slope_loss(tilted, truth.expand(1, 8, 8), NOWHERE + 0.2)) == 0


def test_a_few_steps_lower_the_loss_of_a_sample(data: Path) -> None:
    sample = load(data / "000001.npz", 4, (96, 128))
    assert sample is not None
    torch.manual_seed(0)
    net = tiny()
    optimiser = torch.optim.AdamW(net.parameters(), 3e-3)
    seen = []
    for _ in range(9):
        optimiser.zero_grad(set_to_none=True)
        loss, figures = losses(net, sample, [0, 2], 3)
        loss.backward()
        optimiser.step()
        seen.append(float(loss.detach()))
    assert seen[-1] < 0.9 * seen[0]
    assert figures.keys() == {"coarse", "fine", "d2", "d5", "sky"}
    assert all(p.grad is not None and bool(torch.isfinite(p.grad).all()) for p in net.parameters())


def same(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


@pytest.mark.usefixtures("_small")
def test_training_resumes_where_it_stopped(data: Path, tmp_path: Path) -> None:
    """Four steps at once, and two, a restart, and two: the same weights to the last bit."""
    whole = Trainer(CONFIG, [data], tmp_path / "whole")
    first = Trainer(CONFIG, [data], tmp_path / "parts")
    assert same(whole.net.state_dict(), first.net.state_dict())
    for trainer, steps in ((whole, 4), (first, 2)):
        for _ in range(steps):
            assert trainer.one() is not None
            trainer.step += 1
    assert not same(whole.net.state_dict(), first.net.state_dict())
    first.save()

    second = Trainer(CONFIG, [data], tmp_path / "parts")
    assert second.step == 2
    assert same(second.net.state_dict(), first.net.state_dict())
    assert same(second.mean.state_dict(), first.mean.state_dict())
    for _ in range(2):
        second.one()
        second.step += 1
    assert same(second.net.state_dict(), whole.net.state_dict())
    assert same(second.mean.state_dict(), whole.mean.state_dict())


@pytest.mark.usefixtures("_small")
def test_the_average_follows_closely_at_first_and_slowly_later(data: Path, tmp_path: Path) -> None:
    """mean ← d · mean + (1 − d) · weights, with d = (step + 1) / (step + 10) up to ``average``."""
    trainer = Trainer(replace(CONFIG, average=0.6), [data], tmp_path)
    for step, decay in ((0, 0.1), (4, 5 / 14), (30, 0.6)):
        trainer.step = step
        before = {k: v.clone() for k, v in trainer.mean.state_dict().items()}
        assert trainer.one() is not None
        for name, value in trainer.mean.state_dict().items():
            expected = decay * before[name] + (1 - decay) * trainer.net.state_dict()[name]
            torch.testing.assert_close(value, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.usefixtures("_small")
def test_a_run_ends_with_weights_that_the_package_loads(data: Path, tmp_path: Path) -> None:
    trainer = Trainer(replace(CONFIG, steps=4), [data], tmp_path)
    trainer.run(every=2, validation=4)
    loaded = load_sweep(tmp_path / "weights.safetensors")
    assert loaded.config == replace(TINY, equalise=CONTRAST)
    assert same(loaded.state_dict(), trainer.mean.state_dict())
    lines = (tmp_path / "log.csv").read_text().splitlines()
    assert lines[0].split(",")[:2] == ["step", "kind"]
    assert [line.split(",")[:2] for line in lines[1:]] == [["2", "train"], ["4", "train"], ["4", "valid"]]
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.usefixtures("_small")
def test_the_rate_warms_up_and_falls_to_a_fiftieth(data: Path, tmp_path: Path) -> None:
    trainer = Trainer(TrainConfig(steps=100, rate=2.0, warmup=10, held_out=1), [data], tmp_path)
    rates = []
    for trainer.step in range(101):
        rates.append(trainer.rate())
    assert rates[0] == pytest.approx(0.2) and rates[4] == pytest.approx(1.0, rel=0.01)
    assert rates.index(max(rates)) == 9
    assert all(a > b for a, b in itertools.pairwise(rates[9:]))
    assert rates[100] == pytest.approx(0.04)


@pytest.mark.usefixtures("_small")
def test_validation_is_of_the_held_out_samples_alone(data: Path, tmp_path: Path) -> None:
    trainer = Trainer(CONFIG, [data], tmp_path)
    sample = load(data / "000000.npz", 7, (96, 128))
    assert sample is not None
    with torch.no_grad():
        expected = losses(trainer.mean, sample, [0, 3], 5)[1]
    assert trainer.validate() == pytest.approx(expected)


def test_what_views_agree_on_is_told_as_further_points(tmp_path: Path) -> None:
    """Points come nearer, nothing else changes, and the encoder still learns."""
    write(tmp_path, 4, 1, (96, 128), 8)
    sample = load(tmp_path / "000004.npz", 5, (96, 128))
    assert sample is not None
    views, priors, _ = sample
    net = load_sweep(EMBEDDED)
    for p in net.parameters():
        p.requires_grad_(True)
    encoded = net.encode(views, priors, 5)
    more = with_agreed(net, encoded, views, priors, 3)
    assert more.volume is encoded.volume and more.volume.requires_grad
    nearer = encoded.hints[1].distance - more.hints[1].distance
    assert float(nearer.min()) >= 0 and float((nearer > 0.1).float().mean()) > 0.02
    assert not any(part.requires_grad for part in (more.hints[0].nearest, more.hints[1].smooth))
    again, other = (with_agreed(net, encoded, views, priors, seed).hints[0].nearest for seed in (3, 4))
    assert torch.equal(again, more.hints[0].nearest) and not torch.equal(other, again)
    told, plain = (losses(net, sample, [0, 3], 5, seed)[0] for seed in (3, None))
    told.backward()
    assert told.isfinite() and not torch.equal(told, plain)
    assert float(net.features.stem[0].conv.weight.grad.abs().max()) > 0
