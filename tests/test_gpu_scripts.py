"""The scripts that wait for a GPU run on a CPU at small size, so that no minute of one is lost to them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import backbone, wall
from benchmarks import rule as by_rule
from benchmarks.backbone import Timed
from benchmarks.gpu import network_steps, render_parity, train_mini, train_sweep
from benchmarks.gpu.rendering import rendering, wait_for
from tco.backbones.mini import load as load_mini
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.optimize import Outcome
from tests.tco.published import reference, rule
from training.dataset import read, write


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def told(out: str, name: str) -> list[list[str]]:
    """The rows of a printed table that begin with a name."""
    return [cells(line) for line in out.splitlines() if line.startswith(f"| {name}")]


SMALL = ("--device", "cpu", "--small", "--dtype", "float32", "--size", "42", "56")


@pytest.mark.parametrize("network", ["vggt", "pi3"])
def test_network_steps(network: str, capsys: pytest.CaptureFixture[str]) -> None:
    network_steps.main([*SMALL, "--networks", network, "--views", "3", "4", "--steps", "3", "--timed", "2"])
    rows = told(capsys.readouterr().out, network)
    assert [r[:3] for r in rows] == [
        [f"{network}, published schedule", "3", "0"],
        [f"{network}, ours", "3", "0"],
        [f"{network}, ours", "4", "0"],
    ]
    assert [r[3].partition(" ")[2] for r in rows] == ["", "", "extrapolated from 2 steps"]
    for r in rows:
        # The colours were compared in the first and in the last step, and nothing was rolled back.
        first, last = (float(x) for x in r[7].split("→"))
        assert 0 < first < 1 and 0 < last < 1 and r[8] == "0"


def test_many_views_compute_their_activations_again() -> None:
    options = network_steps.parsed([])
    assert [options.recomputed(count) > 0 for count in options.views] == [False, True, True]
    assert [network_steps.parsed(["--recompute", "7"]).recomputed(count) for count in (2, 100)] == [7, 7]


def test_a_network_that_does_not_fit_says_so_and_the_next_one_follows(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Pictures of petabytes: their allocation fails in earnest."""
    far = ["--networks", "vggt", "pi3", "--size", "14000000", "14000000"]
    network_steps.main([*SMALL, *far, "--views", "2", "--steps", "1"])
    out = capsys.readouterr().out
    rows = told(out, "vggt") + told(out, "pi3")
    assert [r[0] for r in rows] == [
        f"{name}, {schedule}" for name in ("vggt", "pi3") for schedule in ("published schedule", "ours")
    ]
    assert all(r[3] == "out of memory" for r in rows)
    backbone.main([*far, "--device", "cpu", "--small", "--views", "2"])
    out = capsys.readouterr().out
    rows = told(out, "vggt") + told(out, "pi3")
    assert [r[:4] for r in rows] == [
        [name, "2", kind, "out of memory"] for name in ("vggt", "pi3") for kind in ("forward", "step")
    ]


def test_seconds_of_all_steps_are_extrapolated_with_the_predictions_between_them() -> None:
    """First step 5 s with what comes before it, 2 s each, 3 s a prediction of all views."""
    found = Timed((5.0, 7.0, 9.0), 3.0, Outcome(*2 * (None,)))  # type: ignore[arg-type]
    assert found.each == 2 and found.whole(3, 10) == 12
    assert found.whole(40, 10) == 5 + 39 * 2 + 3 * 3 + 3


def test_weights_by_the_rule_are_those_of_the_reference_numbers() -> None:
    theirs = rule().rule_array
    table = {**reference("vggt_small").shapes, "x.gamma": (3,), "x.weight": (4,), "x.register_token": (2, 5)}
    for name, shape in table.items():
        for salt in (0, 7):
            ours = by_rule.array(name, shape, salt)
            assert ours.dtype == np.float32 and np.array_equal(ours, theirs(name, shape, salt))


def test_points_of_the_made_scene_lie_on_its_wall() -> None:
    views, priors = wall.scene(3, (42, 56), points=20)
    assert priors.cameras is not None and priors.sparse is not None and len(views) == 3
    for k, sparse in enumerate(priors.sparse):
        K, pose = priors.cameras.K[k], priors.cameras.world_from_cam[k]
        rays = torch.cat([sparse.xy, torch.ones(20, 1)], -1) @ K.inverse().T
        world = (rays * sparse.depth.unsqueeze(-1)) @ pose[:3, :3].T + pose[:3, 3]
        torch.testing.assert_close(world[:, 2], torch.full((20,), wall.DEPTH))


def test_render_parity(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The tensor renderer agrees with the compiled one; gsplat says why it cannot run."""
    words = ["--device", "cpu", "--size", "30", "40", "--views", "3"]
    assert render_parity.main(words) == 0
    header, _, gsplat, pairs = (cells(line) for line in capsys.readouterr().out.splitlines()[-4:])
    assert len(header) == len(gsplat) == len(pairs)
    assert gsplat[:2] == ["gsplat", "cpu"] and ("gsplat" in gsplat[2] or "CUDA" in gsplat[2])
    assert pairs[:2] == ["surface_pairs", "surface"] and pairs[-1] == "yes"
    assert all(float(cell) < 1e-4 for cell in pairs[2:9])
    # An engine that averages where the other composites is far beyond the bounds, and the exit code says so.
    monkeypatch.setattr(render_parity, "PAIRS", (("surface_pairs", "cpu"),))
    assert render_parity.main(words) == 1
    assert cells(capsys.readouterr().out.splitlines()[-1])[-1] == "NO"


def test_train_mini_resumes_and_tells_its_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two runs, one training; samples are there, so that none are rendered."""
    write(tmp_path / "work" / "data", 0, 4, (32, 48), 4)
    words = ["--small", "--device", "cpu", "--cores", "0", "--first", "3", "--minutes", "0.02", "--schedule",
             "9", "--work", str(tmp_path / "work"), "--out", str(tmp_path / "out")]  # fmt: skip
    steps = []
    for _ in range(2):
        train_mini.main(words)
        told = capsys.readouterr().out
        steps.append(int(told.split()[0]))
        rows = [cells(line) for line in told.splitlines() if line.startswith(("| 2", "| 4"))]
        assert [r[0] for r in rows] == ["2", "4"]
        for r in rows:
            near, far, rotation, direction, *rest = map(float, r[1:])
            assert 0 <= near <= far <= 1 and 0 < rotation < 180 and 0 <= direction <= 90
            assert all(0 <= x < 10 for x in rest)
    assert 0 < steps[0] < steps[1]
    assert load_mini(tmp_path / "out" / "weights.safetensors").network.config == train_mini.TINY
    assert (tmp_path / "out" / "table.md").read_text() == told
    with pytest.raises(SystemExit, match="0 samples in"):
        train_mini.main([*words[:-4], "--work", str(tmp_path / "none"), "--out", str(tmp_path / "out")])


@pytest.mark.slow
def test_train_sweep_tells_errors_before_and_after(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One sample many times over, which takes seconds; what was trained has other weights."""
    data = tmp_path / "work" / "data"
    words = ["--device", "cpu", "--sizes", "small", "--workers", "1", "--render-minutes", "0",
             "--minutes", "0.2", "--work", str(data.parent), "--out", str(tmp_path / "out")]  # fmt: skip
    with pytest.raises(SystemExit, match="0 samples, and 16 are held out"):
        train_sweep.main(words)
    write(data, 0, 1, (48, 64), 6)
    for k in range(1, 20):
        (data / f"{k:06d}.npz").hardlink_to(data / "000000.npz")
    train_sweep.main(words)
    out = capsys.readouterr().out
    before, after = ([float(x) for x in cells(line)[1:]] for line in out.splitlines()[-2:])
    assert [cells(line)[0] for line in out.splitlines()[-2:]] == ["before", "after"]
    assert before != after and all(0 <= share <= 1 for share in (*before[1:], *after[1:]))
    assert (tmp_path / "out" / "table.md").read_text() == out
    held_out = sorted(data.glob("*.npz"))[:2]
    assert train_sweep.scored(EMBEDDED, held_out, (48, 64), "cpu") == pytest.approx(before, abs=1e-3)
    assert load_sweep(tmp_path / "out" / "weights.safetensors").config == load_sweep().config


def test_rendering_keeps_what_is_there_and_leaves_no_parts(tmp_path: Path) -> None:
    """The one sample that is wanted is there: the process ends, and nothing is rendered again."""
    (tmp_path / "1000000.npz").write_bytes(b"kept")
    (tmp_path / "1000000.7.part").write_bytes(b"cut off")
    with rendering(tmp_path, (48, 64), cores=1, views=2, most=1):
        assert wait_for(tmp_path, 1, minutes=1) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["1000000.npz"]
    assert (tmp_path / "1000000.npz").read_bytes() == b"kept"


@pytest.mark.slow
def test_rendering_renders(tmp_path: Path) -> None:
    with rendering(tmp_path, (48, 64), cores=1, views=2, most=2):
        assert wait_for(tmp_path, 1, minutes=10) >= 1
    assert read(tmp_path / "1000000.npz").images.shape == (2, 48, 64, 3)
