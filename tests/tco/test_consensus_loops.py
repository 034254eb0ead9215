"""The compiled loops of the consensus do what its tensor operations do."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tco.consensus import Agreement, agreed
from tco.options import ConsensusConfig
from tco.parallel import in_ranges
from tco.toy import Wall, wall
from tco.types import Cameras, Prediction

VIEWS = 9


def said(scene: Wall, generator: torch.Generator, dtype: torch.dtype) -> Prediction:
    """The wall with smooth noise, boxes before it that only some views see, and pixels that know nothing."""
    depth = scene.depth.double()
    coarse = torch.randn(VIEWS, 1, 8, 10, generator=generator, dtype=torch.float64)
    noise = torch.nn.functional.interpolate(coarse, depth.shape[1:], mode="bilinear")[:, 0]
    depth = depth * (0.02 * noise).exp()
    depth[::2, 3:12, 5:17] *= 0.93
    depth[1::3, 20:25, 8:30] *= 0.6
    depth[4, 2, 3], depth[5, 7, 9], depth[6, 30, 30] = 0.0, float("nan"), float("inf")
    confidence = 1 + 20 * torch.rand(depth.shape, generator=generator, dtype=torch.float64) ** 2
    cameras = scene.priors.cameras
    assert cameras is not None
    return Prediction(depth.to(dtype), confidence.to(dtype), moved(cameras, dtype), tuple(range(VIEWS)))


def moved(cameras: Cameras, dtype: torch.dtype) -> Cameras:
    """Off the centre, with pixels that are not square, and one camera that looks away."""
    K, pose = cameras.K.double().clone(), cameras.world_from_cam.double().clone()
    K[:, 0, 2] += 1.7
    K[:, 1, 1] *= 1.1
    pose[7, :3, :3] = pose[7, :3, :3] @ torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))
    return Cameras(pose.to(dtype), K.to(dtype))


def both(config: ConsensusConfig, seed: int = 0) -> tuple[Agreement, Agreement]:
    """In float32, which loops do, and in float64, which tensor operations do."""
    scene, results = wall(VIEWS), []
    for dtype in (torch.float32, torch.float64):
        prediction = said(scene, torch.Generator().manual_seed(seed), dtype)
        overlap = scene.priors.overlap
        assert overlap is not None
        priors = replace(scene.priors, cameras=prediction.cameras, overlap=overlap.to(dtype))
        results.append(agreed(prediction, prediction.cameras, scene.views, priors, config))
    return results[0], results[1]


def close(a: Tensor, b: Tensor, share: float) -> None:
    """The same but where a decision falls by a rounding: a share of the pixels."""
    same = torch.isclose(a.double(), b, rtol=2e-4, atol=1e-7, equal_nan=True)
    assert float(same.double().mean()) >= 1 - share, float(same.double().mean())


@pytest.mark.parametrize(
    "config",
    [
        ConsensusConfig(),
        ConsensusConfig(consensus_rounds=1, consensus_views=3),
        ConsensusConfig(consensus_rounds=4, consensus_reach=0.5, consensus_width=0.1),
        ConsensusConfig(consensus_reach=0.02),
    ],
    ids=["default", "one round of three views", "four rounds, far", "near"],
)
def test_loops_and_tensor_operations_agree(config: ConsensusConfig) -> None:
    loops, plain = both(config)
    assert loops.prediction.depth.dtype == torch.float32
    close(loops.prediction.depth, plain.prediction.depth, 2e-3)
    close(loops.error, plain.error, 5e-3)
    told = plain.prediction.depth != said(wall(VIEWS), torch.Generator().manual_seed(0), torch.float64).depth
    assert float(told.double().mean()) > 0.8  # so that agreeing means something
    assert float(plain.error.isfinite().double().mean()) > (0.5 if config.consensus_views > 4 else -1)


def of_one_place(factors: list[float], dtype: torch.dtype) -> tuple[Wall, Agreement]:
    """Views from one place, before a wall across, whose depths are off by these factors, alike sure."""
    scene = wall(len(factors), slope=0.0)
    cameras = scene.priors.cameras
    assert cameras is not None
    depth = scene.depth.to(dtype)[:1] * torch.tensor(factors, dtype=dtype)[:, None, None]
    same = Cameras(cameras.world_from_cam[:1].repeat(len(factors), 1, 1).to(dtype), cameras.K.to(dtype))
    prediction = Prediction(depth, torch.full_like(depth, 4.0), same, tuple(range(len(factors))))
    config = ConsensusConfig(consensus_rounds=1, consensus_width=1e-4)
    priors = replace(scene.priors, cameras=same)
    return scene, agreed(prediction, same, scene.views, priors, config)


def test_equal_weights_take_the_lower_of_the_middle_two() -> None:
    """Two views whose words are as heavy: whichever is nearer, in both ways of computing."""
    inner = (slice(None), slice(1, -1), slice(1, -1))
    for dtype in (torch.float32, torch.float64):
        scene, found = of_one_place([1.0, 1.05], dtype)
        expected = scene.depth[:1].repeat(2, 1, 1).double()
        torch.testing.assert_close(found.prediction.depth.double()[inner], expected[inner], rtol=1e-5, atol=0)


def test_the_spread_of_an_even_number_takes_the_upper_of_the_middle_two() -> None:
    """Logarithms 0, 1, 3, 7, 11, 14 %: the lower median is 3, distances from it 0, 2, 3, 4, 8, 11."""
    logs = torch.tensor([0.0, 0.01, 0.03, 0.07, 0.11, 0.14]).double()
    expected = 1.4826 * 0.04 * math.sqrt(math.pi / 2) * math.sqrt(6) / (6 - 0.8)
    for dtype in (torch.float32, torch.float64):
        error = of_one_place(logs.exp().tolist(), dtype)[1].error[2, 5, 5]
        assert float(error) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_do_not_change_what_is_agreed(threads: int) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        many = both(ConsensusConfig())[0]
    finally:
        torch.set_num_threads(before)
    once = both(ConsensusConfig())[0]
    assert torch.equal(many.error, once.error)
    assert torch.equal(many.prediction.depth.nan_to_num(), once.prediction.depth.nan_to_num())


@pytest.mark.parametrize("count", [0, 1, 7, 1000])
def test_ranges_are_everything_once(count: int) -> None:
    seen = torch.zeros(count, dtype=torch.int64)

    def task(first: int, end: int) -> None:
        seen[first:end] += 1

    in_ranges(task, count)
    assert bool((seen == 1).all())
