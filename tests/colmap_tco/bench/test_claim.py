"""The claim's table: intervals and gains of known size, a perfect reconstruction, rows of a tiny network."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.claim import BOTH, ROWS, figures, line, prepared, settings, table
from benchmarks.real import RealSet
from benchmarks.tables import cell, interval
from benchmarks.wall import DEPTH, scene
from colmap_tco.backbones import Selected
from colmap_tco.bench.methods import Reconstruction, check_row
from colmap_tco.bench.rows import parse_rows
from colmap_tco.errors import InputError
from colmap_tco.priors import PriorSet
from colmap_tco.published import NETWORKS
from tco.backbones.mini import Mini
from tco.backbones.vggt import VGGTNetwork
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.geometry import so3_exp
from tco.options import TCOConfig
from tests.tco.published import randomized
from tests.tco.test_mini import TINY


@pytest.fixture(scope="module")
def real() -> RealSet:
    """Waves on a wall two units away, a unit being half a metre, as a set with a measured depth."""
    views, priors = scene(3, (40, 56), points=40)
    assert priors.cameras is not None
    truth = []
    for K, pose in zip(priors.cameras.K, priors.cameras.world_from_cam, strict=True):
        y, x = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(56) + 0.5, indexing="ij")
        rays = torch.stack([x, y, torch.ones_like(x)], -1) @ K.inverse().T @ pose[:3, :3].T
        truth.append((DEPTH - pose[2, 3]) / rays[..., 2])
    assert priors.sparse is not None
    return RealSet("wall", views, PriorSet(priors, priors.sparse, {}), torch.stack(truth), 0.5)


def perfect(real: RealSet, turned: float = 0.0) -> Reconstruction:
    """The truth in another frame and unit; the last camera turned about its centre by so many degrees."""
    scene = prepared(real)
    R, shift = so3_exp(torch.tensor([0.2, -0.5, 1.0])).double().numpy(), np.array([3.0, 1, -2])
    pose = scene.world_from_cam.copy()
    pose[:, :3, :3] = R @ pose[:, :3, :3]
    pose[:, :3, 3] = 4 * pose[:, :3, 3] @ R.T + shift
    off = so3_exp(torch.tensor([0.0, math.radians(turned), 0.0])).double().numpy()
    pose[-1, :3, :3] = pose[-1, :3, :3] @ off
    return Reconstruction(4 * scene.points @ R.T + shift, pose, None)


def test_the_interval_is_students() -> None:
    """Of 1, 2, 3: deviation 1, t of two degrees of freedom 4.3027."""
    mean, half = interval([1.0, 2.0, 3.0])
    assert mean == 2 and half == pytest.approx(4.3027 / math.sqrt(3), rel=1e-4)
    assert interval([5.0, 5.0]) == (5, 0) and math.isnan(interval([5.0])[1])
    assert cell([1.0, 2.0, 3.0], 2) == "2.00 ± 2.48" and cell([0.1234], 3) == "0.123"


def test_gains_are_paired_by_seed() -> None:
    """Two sets, two seeds: gains of 0.2 and 0.1, and of 0.4 and 0.3, so 0.3 and 0.2 a seed."""
    base = [[{"d5": 0.1}, {"d5": 0.2}], [{"d5": 0.3}, {"d5": 0.3}]]
    runs = [[{"d5": 0.3}, {"d5": 0.3}], [{"d5": 0.7}, {"d5": 0.6}]]
    expected = cell([0.3, 0.2], 3)
    assert line("x", runs, base).endswith(f"| {expected} |") and expected.startswith("0.250 ± ")
    assert line("x", base, base).endswith("| 0.000 ± 0.000 |")


def test_the_truth_in_another_frame_is_perfect(real: RealSet) -> None:
    found = figures(perfect(real), prepared(real), own_cameras=True)
    assert found["d5"] == 1 and found["AUC"] == pytest.approx(1)
    assert found["acc"] < 1e-3 and found["comp"] < 1e-3
    assert "AUC" not in figures(perfect(real), prepared(real), own_cameras=False)


def test_a_camera_that_is_turned_costs_its_pairs(real: RealSet) -> None:
    """By more than 30°: two of three pairs are lost."""
    found = figures(perfect(real, turned=40), prepared(real), own_cameras=True)
    assert found["AUC"] == pytest.approx(1 / 3)


def test_the_truth_is_in_metres(real: RealSet) -> None:
    scene = prepared(real)
    wall = scene.points[scene.known]
    np.testing.assert_allclose(wall[:, 2], 0.5 * DEPTH, rtol=1e-5)


def test_rows_of_a_network_that_finds_its_cameras(real: RealSet) -> None:
    network = Mini(randomized(VGGTNetwork(TINY))).eval().requires_grad_(False)
    names = ("base", "pose", "no-compatibility", "steps=1")
    config = replace(settings(Selected(NETWORKS["mini"], EMBEDDED, torch.device("cpu"), "")), steps=2)
    assert (config.photometric_weight, config.rate) == (0.2, 1e-3)  # those of the paper for 7-Scenes
    lines = table(network, [real], parse_rows(names, BOTH), config, seeds=2)
    assert [text.split(" | ")[0] for text in lines[2:]] == [f"| {name}" for name in names]
    numbers = [[float(x) for x in re.findall(r"-?\d+\.\d+", text)] for text in lines[2:]]
    assert all(len(row) == 10 for row in numbers) and all(np.isfinite(numbers[0]))
    assert numbers[0][-2:] == [0, 0] and numbers[0][1::2] == [0] * 5  # the network alone draws nothing


def test_rows_suit_the_network(real: RealSet) -> None:
    """One that takes cameras cannot run the rows of priors alone, and all of its own."""
    sweep = load_sweep()
    for name in ROWS[True]:
        check_row(sweep, parse_rows([name], BOTH)[0])
    with pytest.raises(InputError, match="takes poses and intrinsics as input"):
        check_row(sweep, parse_rows(["pose"], BOTH)[0])
    ours = settings(Selected(NETWORKS["sweep"], EMBEDDED, torch.device("cpu"), ""))
    assert ours == TCOConfig(uncertain_steps=12)
