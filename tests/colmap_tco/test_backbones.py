"""Which network runs, on which device, with which weights, and what is said when it cannot."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from colmap_tco import flags
from colmap_tco.backbones import NetworkConfig, Selected, _best, choose_device, load, needed, select, suited
from colmap_tco.densify import DensifyConfig
from colmap_tco.errors import MissingError
from colmap_tco.published import NETWORKS, PUBLISHED
from colmap_tco.weights import _note_accepted, cached
from tco.backbones.base import Backbone
from tco.backbones.checkpoints import NETWORK, save
from tco.backbones.da3 import INSTALL, DA3Config, DA3Network
from tco.backbones.dinov2 import ViTConfig
from tco.backbones.pi3 import Pi3Config, Pi3Network
from tco.backbones.transformer import compute_dtype
from tco.backbones.vggt import VGGTConfig, VGGTNetwork
from tco.backbones.weights import EMBEDDED
from tco.options import TCOConfig
from tests.tco.published import TINY_DA3
from tests.tco.test_mini import TINY as TINY_MINI

VIT = ViTConfig(channels=48, depth=1, heads=2)
CLASSES: dict[type, type[torch.nn.Module]] = {
    VGGTConfig: VGGTNetwork,
    Pi3Config: Pi3Network,
    DA3Config: DA3Network,
}
TINY = {
    "vggt": VGGTConfig(VIT, 48, 4, 2, 4, 1, 2, 8, (8, 8, 8, 8), (0, 1, 2, 3)),
    "pi3": Pi3Config(ViTConfig(48, 1, 2, mask_token=False), 48, 4, 2, 5, 48, 1, 2, 32),
    "da3": TINY_DA3,
    "mini": TINY_MINI,
}


@pytest.fixture(autouse=True)
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No weights were fetched, whatever this machine has."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def written(path: Path, kind: str) -> Path:
    """A small network of a kind, as a checkpoint; skips where a package that it needs is missing."""
    if missing := NETWORKS[kind].missing():
        pytest.skip(f"not installed: {', '.join(missing)}")
    torch.manual_seed(0)
    config = TINY[kind]
    save(path, CLASSES[type(config)](config), config, {NETWORK: kind} if kind == "mini" else None)
    return path


@pytest.mark.parametrize("name", ["cuda:99", "tpu", "gpu please", "cpu:x"])
def test_a_device_that_is_not_there_is_an_error_with_the_remedy(name: str) -> None:
    with pytest.raises(MissingError, match=f"--device {name}: not usable here.*--device cpu"):
        choose_device(name)


def test_devices_are_found() -> None:
    assert choose_device("cpu") == torch.device("cpu")
    assert choose_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize("backbone", ["auto", "sweep"])
def test_weights_that_are_missing_or_foreign_are_an_error(tmp_path: Path, backbone: str) -> None:
    def chosen(path: Path) -> Selected:
        return select(NetworkConfig(backbone=backbone, weights=str(path), device="cpu"))

    with pytest.raises(MissingError, match=r"none\.safetensors: no such file"):
        chosen(tmp_path / "none.safetensors")
    (tmp_path / "page.safetensors").write_text("<html>")
    with pytest.raises(MissingError, match=r"page\.safetensors: this is a web page"):
        chosen(tmp_path / "page.safetensors")
    (tmp_path / "cut.safetensors").write_bytes(EMBEDDED.read_bytes()[:-100])
    with pytest.raises(MissingError, match=r"cut\.safetensors: .* was cut off"):
        chosen(tmp_path / "cut.safetensors")


def test_the_network_in_the_package_needs_nothing_and_is_frozen() -> None:
    chosen = select(NetworkConfig(device="cpu"))
    assert chosen.network.name == "sweep" and chosen.weights == EMBEDDED
    assert "no weights of a larger network were fetched" in chosen.reason
    network = load(chosen)
    assert isinstance(network, torch.nn.Module) and not network.training
    assert not any(p.requires_grad for p in network.parameters())
    assert chosen.describe()["licence"] is None


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_network_that_was_not_fetched_says_how_to(name: str) -> None:
    with pytest.raises(MissingError, match=f"'colmap-tco weights fetch {name}' .* --weights"):
        select(NetworkConfig(backbone=name, device="cpu"))


def test_a_network_without_weights_says_how_to_make_them() -> None:
    told = "no weights of mini are in the package .* benchmarks.gpu.train_mini, .*--weights"
    with pytest.raises(MissingError, match=told):
        select(NetworkConfig(backbone="mini", device="cpu"))


def fetched(folder: Path, name: str) -> Path:
    """A file of the published size, empty but for its length, where the hub's cache would have it."""
    c = PUBLISHED[name][1]
    path = folder / "hub" / f"models--{c.repository.replace('/', '--')}" / "snapshots" / c.revision / c.file
    path.parent.mkdir(parents=True)
    path.touch()
    os.truncate(path, c.size)
    return path


def test_auto_needs_an_accepted_licence_and_a_fast_device(tmp_path: Path) -> None:
    """What another program fetched is not used unasked; and without CUDA the package's network is better."""
    cpu = torch.device("cpu")
    path = fetched(tmp_path, "pi3")
    assert cached(PUBLISHED["pi3"][1]) == path
    network, reason = _best(cpu)
    assert network.name == "sweep" and "the licence of pi3's weights was not accepted" in reason
    _note_accepted(*PUBLISHED["pi3"])
    network, reason = _best(cpu)
    assert network.name == "sweep"
    assert "pi3 could run, but take long without a CUDA device; --backbone pi3 runs it" in reason
    os.truncate(path, 1000)
    assert cached(PUBLISHED["pi3"][1]) is None and "were fetched" in _best(cpu)[1]


@pytest.mark.parametrize("kind", TINY)
@pytest.mark.parametrize("backbone", ["auto", "named"])
def test_a_file_of_weights_runs_the_network_that_it_is_of(tmp_path: Path, kind: str, backbone: str) -> None:
    path = written(tmp_path / "mine.safetensors", kind)
    asked = kind if backbone == "named" else "auto"
    chosen = select(NetworkConfig(backbone=asked, weights=str(path), device="cpu"))
    assert chosen.network.kind == kind and chosen.weights == path
    assert chosen.reason == (
        f"--backbone {kind}" if backbone == "named" else f"{path} holds weights of {kind}"
    )
    network = load(chosen)
    assert isinstance(network, Backbone)
    assert (network.stride, network.uses_cameras) == (chosen.network.stride, False)
    licences = {"da3": "Apache-2.0: commercial use allowed", "mini": "None"}
    assert str(chosen.describe()["licence"]).startswith(licences.get(kind, "CC BY-NC 4.0: no commercial use"))


@pytest.mark.parametrize("kind", TINY)
def test_networks_compute_activations_again_where_that_is_asked_for(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path / "mine.safetensors", kind)
    for choice, blocks in (("always", 1000), ("auto", 0), ("never", 0)):
        chosen = select(NetworkConfig(backbone=kind, weights=str(path), device="cpu", recompute=choice))
        assert len(load(chosen).recompute) == blocks  # type: ignore[attr-defined]
    load(select(NetworkConfig(device="cpu", recompute="always")))  # the one in the package has none


@pytest.mark.parametrize("gigabytes", [2, 80])
def test_auto_takes_a_published_network_where_cuda_has_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gigabytes: int
) -> None:
    """The device is asked for its free memory and nothing else, so none is needed here."""
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (gigabytes * 10**9, 10**11))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda _: 0)
    cuda = torch.device("cuda")
    for name in ("pi3", "vggt"):
        fetched(tmp_path, name)
        assert _best(cuda)[0].name == ("sweep" if name == "pi3" or gigabytes < 80 else "pi3")
        _note_accepted(*PUBLISHED[name])
    network, reason = _best(cuda)
    if gigabytes < 80:
        assert network.name == "sweep"
        assert reason == "auto: 2.0 GB free on cuda are too little for vggt or pi3"
    else:
        assert network.name == "vggt"
        assert reason == "auto: fetched, and 80.0 GB of cuda are enough for it"


@pytest.mark.parametrize("name", ["da3", "da3-small"])
def test_a_package_that_is_not_installed_is_told_with_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    path = written(tmp_path / "mine.safetensors", "da3")
    lacking = replace(NETWORKS[name], modules=("depth_anything_3", "no_such_module"))
    monkeypatch.setitem(NETWORKS, name, lacking)
    with pytest.raises(MissingError, match=r"not installed \(no_such_module\): pip install") as told:
        select(NetworkConfig(backbone=name, weights=str(path), device="cpu"))
    assert str(told.value).endswith(INSTALL)
    fetched(tmp_path, name)
    _note_accepted(*PUBLISHED[name])
    assert _best(torch.device("cpu"))[1].startswith(f"auto: {name} needs no_such_module, not installed")


def test_weights_of_another_network_are_refused_before_they_are_read(tmp_path: Path) -> None:
    path = written(tmp_path / "mine.safetensors", "pi3")
    with pytest.raises(
        MissingError, match=r"mine\.safetensors: weights of pi3, but --backbone vggt takes model"
    ):
        select(NetworkConfig(backbone="vggt", weights=str(path), device="cpu"))
    with pytest.raises(MissingError, match="--backbone sweep takes those of the embedded network"):
        select(NetworkConfig(backbone="sweep", weights=str(path), device="cpu"))


def test_the_registry_agrees_with_the_networks(tmp_path: Path) -> None:
    """Strides, and layers with adapters, are those of the code."""
    from tco.lora import select as layers

    for name, network in NETWORKS.items():
        if network.missing():
            continue
        path = EMBEDDED if name == "sweep" else written(tmp_path / name, network.kind)
        backbone = load(Selected(network, path, torch.device("cpu"), ""))
        assert backbone.stride == network.stride and backbone.name == network.kind
        config = suited(TCOConfig(), network)
        assert layers(backbone.decoder(), config.lora_targets)


@pytest.mark.parametrize("kind", ["sweep", "vggt", "pi3", "da3", "mini"])
def test_the_precision_is_that_of_the_network(kind: str, tmp_path: Path) -> None:
    """What is asked for is what matrices are multiplied in, and what the memory is planned with."""
    path = EMBEDDED if kind == "sweep" else written(tmp_path / "mine.safetensors", kind)
    needs = {}
    for precision in ("float32", "bfloat16"):
        config = NetworkConfig(backbone=kind, weights=str(path), device="cpu", precision=precision)
        chosen = select(config)
        backbone: Any = load(chosen)
        assert backbone.dtype is getattr(torch, precision)
        needs[precision], _ = needed((chosen.network, chosen.device, 5), (4, 10_000), config)
    assert needs["float32"] != needs["bfloat16"]
    native = compute_dtype(torch.device("cpu"))
    assert select(NetworkConfig(backbone=kind, weights=str(path), device="cpu")).dtype is None
    unasked: Any = load(select(NetworkConfig(backbone=kind, weights=str(path), device="cpu")))
    assert (unasked.dtype or native) is native


def test_a_default_that_the_command_line_names_stands() -> None:
    parser = argparse.ArgumentParser()
    flags.add_flags(parser, DensifyConfig)
    config = flags.build(DensifyConfig, parser.parse_args(["--rate", str(TCOConfig().rate)]))
    assert config.given == ("rate",) and config.tco == TCOConfig()
    vggt = suited(config.tco, NETWORKS["vggt"], config.given)
    assert vggt.rate == TCOConfig().rate
    assert vggt.lora_targets == NETWORKS["vggt"].tco["lora_targets"] != TCOConfig().lora_targets


def test_the_networks_own_settings_hold_where_the_user_gave_none() -> None:
    vggt = NETWORKS["vggt"]
    assert suited(TCOConfig(), NETWORKS["sweep"]) == TCOConfig(uncertain_steps=12)
    for few in (
        suited(TCOConfig(steps=5), NETWORKS["sweep"]),
        suited(TCOConfig(), NETWORKS["sweep"], ("steps",)),
    ):
        assert few.uncertain_steps == 0
    assert (suited(TCOConfig(), vggt).rate, suited(TCOConfig(), vggt).steps) == (5e-4, 40)
    mine = suited(TCOConfig(rate=3e-3, steps=7), vggt)
    assert mine.rate == 3e-3 and mine.steps == 7
    assert mine.lora_targets == ("qkv", "proj", "fc1", "fc2")
    asked = suited(TCOConfig(), vggt, given=("rate", "steps"))
    assert asked.rate == TCOConfig().rate != 5e-4
    assert asked.lora_targets == mine.lora_targets
