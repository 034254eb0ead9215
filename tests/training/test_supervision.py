"""What mini is taught by: losses of known value, invariances, and a network that learns two scenes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.gpu.train_mini import SMALL, TINY
from tco.backbones.mini import fresh, load
from tco.backbones.vggt_heads import encoded
from tco.geometry import rigid, so3_exp, transform, unproject
from tco.types import Cameras
from training.dataset import read, write
from training.pool import Held, Pool, gathered, hold, mirrored, photographed
from training.supervision import (
    ALPHA,
    LOGARITHM,
    Answer,
    Scenes,
    camera_loss,
    depth_loss,
    figures,
    losses,
    normalised,
)
from training.train_mini import MiniConfig, MiniTrainer

CPU = torch.device("cpu")
CONFIG = replace(SMALL, steps=40, warmup=2, held_out=1, pixels=6 * 32 * 48)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write(folder, 0, 4, (32, 48), 3)
    return folder


def scenes(seed: int = 0, b: int = 2, v: int = 3, size: tuple[int, int] = (12, 16)) -> Scenes:
    g = torch.Generator().manual_seed(seed)
    turn, way = (0.2 * torch.randn(b, v, 3, generator=g) for _ in range(2))
    depth = 1 + torch.rand(b, v, *size, generator=g)
    depth[:, :, :2] = 0
    h, w = size
    K = torch.tensor([[0.9 * w, 0, w / 2], [0, w, h / 2], [0, 0, 1.0]]).expand(b, v, 3, 3)
    return Scenes(torch.rand(b, v, 3, *size, generator=g), depth, rigid(so3_exp(turn), way), K)


def moved(s: Scenes, scale: float) -> Scenes:
    """The same scenes in another world and unit."""
    world = rigid(so3_exp(torch.tensor([0.3, -1.0, 0.7])), torch.tensor([4.0, -2, 1]))
    pose = world @ s.world_from_cam
    pose[..., :3, 3] *= scale
    return replace(s, depth=scale * s.depth, world_from_cam=pose)


def test_normalised_scenes_are_in_the_first_view_and_one_away_from_it() -> None:
    s = normalised(scenes())
    torch.testing.assert_close(s.world_from_cam[:, 0], torch.eye(4).expand(2, 4, 4), rtol=0, atol=1e-6)
    points = transform(s.world_from_cam, unproject(s.depth, s.K).flatten(2, 3))
    known = (s.depth > 0).flatten(2)
    for scene in range(2):
        assert float(points[scene][known[scene]].norm(dim=-1).mean()) == pytest.approx(1, abs=1e-5)


def test_world_and_unit_of_the_truth_do_not_matter() -> None:
    a, b = normalised(scenes()), normalised(moved(scenes(), 7.0))
    torch.testing.assert_close(a.depth, b.depth, rtol=1e-4, atol=0)
    torch.testing.assert_close(a.world_from_cam, b.world_from_cam, rtol=0, atol=1e-5)


def test_the_camera_loss_weighs_parts_and_iterations() -> None:
    """Errors 0.1, 0.2 and 0.3 of the three parts, in the last of two iterations, and twice that before."""
    truth = torch.zeros(1, 2, 9)
    off = torch.tensor([0.1] * 3 + [0.2] * 4 + [0.3] * 2).expand(1, 2, 9)
    one = 0.1 + 0.2 + 0.5 * 0.3
    assert float(camera_loss([off], truth)) == pytest.approx(one)
    assert float(camera_loss([-2 * off, off], truth)) == pytest.approx((one + 0.6 * 2 * one) / 2)
    assert float(camera_loss([truth, truth], truth)) == 0


def test_the_depth_loss_of_a_constant_error() -> None:
    """c · e − α log c + λ log ratio; an offset has no slope."""
    truth = torch.full((1, 8, 8), 2.0)
    c = torch.full_like(truth, 3.0)
    value, slope = depth_loss(truth + 0.5, c, truth)
    expected = 3 * 0.5 - ALPHA * math.log(3) + LOGARITHM * math.log(1.25)
    assert float(value) == pytest.approx(expected, rel=1e-5) and float(slope) == 0


def test_the_best_confidence_is_alpha_over_the_error() -> None:
    truth = torch.ones(1, 4, 4)
    error = 0.05
    values = {
        c: float(depth_loss(truth + error, torch.full_like(truth, c), truth)[0])
        for c in (1.0, 2.0, ALPHA / error, 8.0, 16.0)
    }
    assert min(values, key=values.__getitem__) == ALPHA / error


def test_the_slope_of_a_tilt() -> None:
    """A tilt of t a pixel: neighbours on every s-th pixel differ by s·t, whatever is unknown between them."""
    truth = torch.full((1, 16, 16), 2.0)
    tilted = truth + 0.01 * torch.arange(16.0)
    one = torch.ones_like(truth)
    expected = 0.01 * (1 + 2 + 4 + 8) / 4
    assert float(depth_loss(tilted, one, truth)[1]) == pytest.approx(expected, rel=1e-4)
    assert float(depth_loss(tilted, 2 * one, truth)[1]) == pytest.approx(2 * expected, rel=1e-4)


def test_unknown_pixels_do_not_count_and_have_no_gradient() -> None:
    truth = torch.full((1, 8, 8), 2.0)
    truth[..., 3:] = 0
    depth = torch.full_like(truth, 2.5).requires_grad_()
    value, slope = depth_loss(depth, torch.ones_like(truth), truth)
    whole = depth_loss(depth[..., :3], torch.ones(1, 8, 3), truth[..., :3])
    torch.testing.assert_close(torch.stack([value, slope]), torch.stack(whole))
    (value + slope).backward()
    assert depth.grad is not None and not bool(depth.grad[..., 3:].any()) and bool(depth.grad[..., :3].any())


def test_a_depth_next_to_nothing_has_a_way_back() -> None:
    """In the head's logarithm x, d = exp x, the gradient stays: −λ at a depth that is far too small."""
    x = torch.full((1, 4, 4), -20.0, requires_grad=True)
    depth_loss(x.exp(), torch.ones(1, 4, 4), torch.ones(1, 4, 4))[0].backward()
    assert x.grad is not None
    assert float(x.grad.sum()) == pytest.approx(-LOGARITHM, rel=1e-3)


def test_figures_of_known_errors() -> None:
    """Poses turned by 3° and depths off by one factor and 10 % in half of the pixels."""
    true = normalised(scenes())
    turn = rigid(so3_exp(torch.tensor([0.0, math.radians(3), 0])), torch.zeros(3)).repeat(2, 3, 1, 1)
    turn[:, 0] = torch.eye(4)
    code = encoded(Cameras(true.world_from_cam @ turn, true.K), true.size)
    depth = 5 * true.depth.clamp_min(0.1)
    depth[..., 9:] *= 1.1
    got = {k: float(v) for k, v in figures(Answer([code], depth, depth + 1), true).items()}
    assert got["turn"] == pytest.approx(3, abs=1e-2) and got["way"] == pytest.approx(0, abs=0.05)
    share = 1 - 5 / 8  # columns 0, 2, 4, 6, 8 of eight are right; the median ratio is theirs
    assert got["absrel"] == pytest.approx(0.1 * share, rel=1e-3) and got["d5"] == pytest.approx(1 - share)


def test_a_held_sample_is_the_one_on_disk(data: Path) -> None:
    path = data / "000001.npz"
    s, held = read(path), hold(path, (32, 48), CPU)
    batch = gathered([held], [[2, 0]], (32, 48))
    unit = float(np.median(s.depth[s.depth > 0]))
    assert np.array_equal(np.rint(255 * batch.images[0, 1].numpy().transpose(1, 2, 0)), s.images[0])
    np.testing.assert_allclose(batch.depth[0, 0] * unit, s.depth[2], rtol=1e-3)
    pose = np.linalg.inv(batch.world_from_cam[0, 0].numpy())
    pose[:3, 3] *= unit
    np.testing.assert_allclose(pose, s.cam_from_world[2], atol=1e-4)


def reprojected(s: Scenes) -> float:
    """Mean distance of the second view's pixels seen again through the first, were all depths constant 1."""
    from tco.geometry import invert, project

    points = transform(
        s.world_from_cam[:, 1], unproject(torch.ones_like(s.depth[:, 1]), s.K[:, 1]).flatten(1, 2)
    )
    xy, _ = project(transform(invert(s.world_from_cam[:, 0]), points), s.K[:, 0])
    return float(xy[..., 1].mean())


def test_half_the_size_and_the_mirror_image_are_of_the_same_cameras(data: Path) -> None:
    held = hold(data / "000001.npz", (32, 48), CPU)
    whole = gathered([held], [[0, 1]], (32, 48))
    half = gathered([held], [[0, 1]], (16, 24))
    assert reprojected(half) == pytest.approx(reprojected(whole) / 2, rel=1e-4)
    mirror = mirrored(whole)
    assert reprojected(mirror) == pytest.approx(reprojected(whole), rel=1e-4)
    again = mirrored(mirror)
    torch.testing.assert_close(again.world_from_cam, whole.world_from_cam)
    assert torch.equal(again.images, whole.images) and torch.equal(again.K, whole.K)


def test_pictures_are_changed_within_bounds_and_by_the_generator_alone() -> None:
    images = scenes().images
    a, b = (photographed(images, np.random.default_rng(3)) for _ in range(2))
    assert torch.equal(a, b) and a.shape == images.shape
    assert float(a.min()) >= 0 and float(a.max()) <= 1 and not torch.equal(a, images)


def test_a_pool_draws_as_many_scenes_as_the_pixels_allow_and_grows(data: Path) -> None:
    files = sorted(data.glob("*.npz"))
    pool = Pool((32, 48), CPU)
    pool.extend(files[:2])
    assert pool.most == 3 and len(pool.samples) == 2
    batch = pool.draw(np.random.default_rng(0), 2, 8 * 32 * 48, (32, 48))
    assert batch.images.shape == (4, 2, 3, 32, 48) and batch.size == (32, 48)
    pool.extend(files)
    assert pool.coming is not None
    pool.coming.result()
    pool.extend(files)
    assert len(pool.samples) == 4
    two = Held(*(t[:2] for t in (pool.samples[0].images, pool.samples[0].depth)),
               *(t[:2] for t in (pool.samples[0].world_from_cam, pool.samples[0].K)))  # fmt: skip
    pool._add([two])
    # Samples with too few views are left out of batches that ask for more.
    for seed in range(3):
        assert pool.draw(np.random.default_rng(seed), 3, 9 * 32 * 48, (32, 48)).depth.shape[1] == 3


def test_a_network_learns_two_scenes(data: Path) -> None:
    """Over the last of 200 steps the camera loss is below half, the error of depth and the total below 0.6.

    Means of 20 steps: where each single one is depends on the processor.
    """
    batch = gathered([hold(data / f"00000{k}.npz", (32, 48), CPU) for k in (1, 2)], [range(3)] * 2, (32, 48))
    network = fresh(TINY)
    optimiser = torch.optim.AdamW(network.parameters(), 1e-3)
    seen = []
    for step in range(200):
        optimiser.param_groups[0]["lr"] = 1e-3 * min(1.0, (step + 1) / 10)
        optimiser.zero_grad(set_to_none=True)
        loss, found = losses(network, batch, torch.float32)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        seen.append({"loss": float(loss.detach()), **{k: float(v) for k, v in found.items()}})
    first = seen[0]
    last = {name: float(np.mean([figures[name] for figures in seen[-20:]])) for name in first}
    assert last["camera"] < 0.5 * first["camera"]
    assert last["absrel"] < 0.6 * first["absrel"]
    assert last["loss"] < 0.6 * first["loss"]


def test_training_resumes_where_it_stopped(data: Path, tmp_path: Path) -> None:
    """Two steps at once, and one, a restart, and one: the same weights to the last bit."""
    whole, first = (MiniTrainer(CONFIG, [data], tmp_path / name) for name in ("whole", "parts"))
    for trainer, steps in ((whole, 2), (first, 1)):
        for _ in range(steps):
            assert trainer.one() is not None
            trainer.step += 1
    first.save()
    second = MiniTrainer(CONFIG, [data], tmp_path / "parts")
    assert (second.step, second.shown) == (1, first.shown) and second.spent > 0
    second.one()
    for name, tensor in whole.net.state_dict().items():
        assert torch.equal(tensor, second.net.state_dict()[name]), name
    assert len(second.held_out) == 1 and len(second.pool.samples) == 3


def test_a_run_ends_with_weights_that_the_package_loads(data: Path, tmp_path: Path) -> None:
    trainer = MiniTrainer(replace(CONFIG, steps=2), [data], tmp_path)
    trainer.run(every=1, validation=2)
    network = load(tmp_path / "weights.safetensors", dtype=torch.float32).network
    assert network.config == TINY
    for name, tensor in trainer.mean.state_dict().items():
        torch.testing.assert_close(network.state_dict()[name], tensor, rtol=2**-11, atol=2**-24)
    lines = [line.split(",") for line in (tmp_path / "log.csv").read_text().splitlines()]
    assert [line[:2] for line in lines[1:]] == [["1", "train"], ["2", "train"], ["2", "valid"]]
    assert lines[0][2:-1] == ["camera", "depth", "slope", "turn", "way", "absrel", "d5"]
    onward = MiniTrainer(CONFIG, [data], tmp_path / "next")
    onward.start_from(tmp_path / "weights.safetensors")
    torch.testing.assert_close(onward.net.state_dict(), network.state_dict())


def test_the_clock_of_the_schedule_goes_on_and_a_run_stops_in_between(data: Path, tmp_path: Path) -> None:
    """A run that may take no time ends after one step, a resumed one knows what was spent."""
    config = replace(CONFIG, minutes=60.0, stop=1e-6)
    trainer = MiniTrainer(config, [data], tmp_path)
    trainer.run()
    assert trainer.step == 1 and trainer.progress(1) < 1
    second = MiniTrainer(config, [data], tmp_path)
    second.spent = 30 * 60.0
    assert second.progress(1) == pytest.approx(0.5, abs=0.05)
    second.spent = 61 * 60.0
    second.run()
    assert second.step == 1


def test_sizes_and_views_are_as_configured() -> None:
    """What is held is the largest that is trained on, and all sizes are made of patches."""
    c = MiniConfig()
    assert tuple(c.sizes[-1][1:]) == c.shape and c.views == (2, 8)
    assert all(side % c.network.encoder.patch == 0 for _, h, w in c.sizes for side in (h, w))
