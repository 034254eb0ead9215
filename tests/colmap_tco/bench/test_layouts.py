"""From the folder of each dataset, in its published layout, to the table: tiny networks of random weights."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from colmap_tco.backbones import NetworkConfig
from colmap_tco.bench.command import BenchConfig, bench
from colmap_tco.bench.methods import reconstruct
from colmap_tco.bench.prepare import resized
from colmap_tco.bench.rows import parse_rows
from colmap_tco.cli import main
from colmap_tco.datasets import CHOICES, Choice, open_dataset
from colmap_tco.progress import Progress
from tco.backbones.checkpoints import save
from tco.geometry import transform
from tco.options import TCOConfig
from tco.types import Priors
from tests.colmap_tco.datasets import layouts
from tests.tco.published import TINY_PI3, TINY_VGGT, tiny_pi3, tiny_vggt

Writer = Callable[[Path], object]

LAYOUTS: dict[str, tuple[str, Writer, int]] = {
    "eth3d": ("eth3d", lambda root: layouts.eth3d(root, 6), 2),
    "eth3d, prepared": ("eth3d", lambda root: layouts.eth3d_prepared(root, 11), 3),
    "dtu": ("dtu", lambda root: layouts.dtu(root, 11), 3),
    "7scenes": ("7scenes", lambda root: layouts.seven_scenes(root, 3), 3),
    "7scenes, projected": ("7scenes", lambda root: layouts.seven_scenes(root, 3, projected=True), 3),
    "nrgbd": ("nrgbd", lambda root: layouts.nrgbd(root, 3), 3),
}
"""Layout → dataset, writer, and how many frames the setting takes; 7-Scenes and NRGBD have too few frames for
theirs, and every one is taken."""


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Network → file of weights."""
    folder = tmp_path_factory.mktemp("weights")
    save(folder / "vggt.safetensors", tiny_vggt().network, TINY_VGGT)
    save(folder / "pi3.safetensors", tiny_pi3().network, TINY_PI3)
    return {name: str(folder / f"{name}.safetensors") for name in ("vggt", "pi3")}


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("7scenes", "nrgbd"):
        monkeypatch.setitem(CHOICES, name, {"sparse": Choice(1)})


def config(dataset: str, root: Path, network: str, weights: dict[str, str]) -> BenchConfig:
    return BenchConfig(
        dataset=dataset, root=root, output=root.parent / "out", image_width=56, tco=TCOConfig(steps=1),
        network=NetworkConfig(backbone=network, weights=weights[network], device="cpu"),
    )  # fmt: skip


def scenes(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "scenes.csv").read_text().splitlines()))


@pytest.mark.parametrize("name", LAYOUTS)
def test_from_the_published_layout_to_the_table(name: str, weights: dict[str, str], tmp_path: Path) -> None:
    """The network knows nothing, but its points are laid onto the wall: errors are those of a room."""
    dataset, write, views = LAYOUTS[name]
    write(tmp_path / "data")
    done = bench(
        replace(config(dataset, tmp_path / "data", "vggt", weights), rows=("base", "tco")), Progress()
    )
    lines, metre = scenes(done.table.parent), 1000 if dataset == "dtu" else 1
    assert [(line["row"], int(line["views"])) for line in lines] == [("base", views), ("tco", views)]
    for line in lines:
        for column in ("acc_mean", "acc_med", "comp_mean", "comp_med"):
            assert 0.001 * metre < float(line[column]) < 2 * metre, column
        assert 0 < float(line["nc_mean"]) <= 1
    assert ("millimetres" in done.text) == (dataset == "dtu")
    assert "| *VGGT, published* |" in done.text and "Without figures" not in done.text


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_truth_that_points_are_compared_with_is_the_wall(name: str, tmp_path: Path) -> None:
    """In metres and in the frame of the dataset, at the pixels that the network sees."""
    dataset, write, _ = LAYOUTS[name]
    write(tmp_path)
    reader = open_dataset(dataset, tmp_path)
    (scene,) = reader.scenes()
    prepared = resized(reader.read(scene, range(3)), 56, 14)
    off = np.abs(prepared.points[prepared.known] @ layouts.NORMAL - layouts.OFFSET)
    assert prepared.known.mean() > 0.4
    # Depths are looked up in the nearest pixel: half a pixel's slope of the wall.
    assert np.quantile(off, 0.98) < 0.02


def test_pi3_runs_every_row_of_the_paper(weights: dict[str, str], tmp_path: Path) -> None:
    layouts.nrgbd(tmp_path / "n")
    rows = ("base", "raw-depth", "tco", "pose", "intrinsics", "heads", "surfels", "noise=3/0.05/0.05")
    fast = replace(
        config("nrgbd", tmp_path / "n", "pi3", weights), rows=rows, tco=TCOConfig(steps=1, rate=0.01)
    )
    done = bench(fast, Progress())
    lines = scenes(done.table.parent)
    assert [line["row"] for line in lines] == list(rows) and not any(line["failed"] for line in lines)
    assert len({line["acc_mean"] for line in lines}) > 2


def test_the_command_ends_with_6_where_scenes_have_no_figures(
    weights: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layouts.nrgbd(tmp_path / "n")
    layouts.nrgbd(tmp_path / "n", 3, "staircase")
    (tmp_path / "n" / "staircase" / "depth" / "depth1.png").unlink()
    words = ["bench", "--dataset", "nrgbd", "--root", str(tmp_path / "n"), "--output", str(tmp_path / "out"),
             "--rows", "base", "--image_width", "56", "--backbone", "vggt", "--weights", weights["vggt"],
             "--device", "cpu"]  # fmt: skip
    assert main(words) == 6
    told = capsys.readouterr().err
    assert "1 scenes without figures" in told and "depth1.png" in told
    assert main([*words, "--scenes", "kitchen"]) == 0
    assert "| base |" in capsys.readouterr().out
    assert main([*words, "--scenes", "attic"]) == 3


def test_points_of_pi3_are_its_own_point_map(tmp_path: Path) -> None:
    """Whatever camera would fit it; in the prior cameras, its depths are along their rays."""
    layouts.nrgbd(tmp_path)
    reader = open_dataset("nrgbd", tmp_path)
    (scene,) = reader.scenes()
    prepared, network = resized(reader.read(scene, range(3)), 56, 14), tiny_pi3()
    made = {
        row.name: reconstruct(network, prepared, row, TCOConfig(), torch.device("cpu"))
        for row in parse_rows(["base", "raw-depth"], ("pose", "intrinsics"))
    }
    with torch.no_grad():
        encoded = network.encode(prepared.views, Priors())
        tokens = network.tokens(encoded)
        ray, depth, _ = network.maps(tokens, encoded, range(3))
        pose = network.poses(tokens, encoded)
    local = torch.cat([ray, torch.ones_like(ray[..., :1])], -1) * depth[..., None]
    world = transform(pose, local.flatten(1, 2)).view_as(local)
    np.testing.assert_allclose(made["base"].points, world.numpy(), rtol=1e-4, atol=1e-4)
    poses = made["raw-depth"].world_from_cam
    centres = made["raw-depth"].points - poses[:, None, None, :3, 3]
    seen = np.einsum("vhwc,vcd->vhwd", centres, poses[:, :3, :3])
    np.testing.assert_allclose(seen[..., 2], depth.numpy(), rtol=1e-4)
    u = (np.arange(56) + 0.5 - prepared.K[0, 0, 2]) / prepared.K[0, 0, 0]
    np.testing.assert_allclose(seen[0, 0, :, 0] / seen[0, 0, :, 2], u, rtol=1e-4, atol=1e-5)
