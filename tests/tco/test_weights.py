"""Files of weights: what comes back is what was written, and what is wrong with a file is said."""

from __future__ import annotations

import json
import struct
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from tco.backbones.decoder import SweepConfig
from tco.backbones.sweep import Sweep
from tco.backbones.weights import EMBEDDED, WeightsError, fill, load_sweep, read_file

TINY = SweepConfig(
    planes=16,
    groups=(4, 2),
    coarse=16,
    fine=8,
    context=8,
    volume=6,
    tokens=32,
    heads=2,
    blocks=1,
    hidden=16,
    spacing=(0.4, 0.2, 0.05),
)


def tensors_of(network: nn.Module) -> dict[str, Tensor]:
    return {k: v.contiguous() for k, v in network.state_dict().items()}


def written(path: Path, tensors: dict[str, Tensor], **info: str) -> Path:
    save_file(tensors, path, info)
    return path


@pytest.fixture(scope="module")
def network() -> Sweep:
    torch.manual_seed(3)
    return Sweep(TINY)


@pytest.fixture
def good(network: Sweep, tmp_path: Path) -> Path:
    return written(tmp_path / "good.safetensors", tensors_of(network), config=json.dumps(asdict(TINY)))


def test_a_network_comes_back_as_it_was_written(network: Sweep, good: Path) -> None:
    back = load_sweep(good)
    assert back.config == TINY  # sizes come from the file, not from the defaults
    ours, theirs = network.state_dict(), back.state_dict()
    assert list(ours) == list(theirs)
    assert all(torch.equal(ours[k], theirs[k]) for k in ours)
    assert not back.training
    assert not any(p.requires_grad for p in back.parameters())


def test_read_file_gives_tensors_and_metadata(tmp_path: Path) -> None:
    tensors = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1, 2])}
    back, info = read_file(written(tmp_path / "x.safetensors", tensors, author="me"))
    assert info == {"author": "me"}
    assert back.keys() == tensors.keys()
    assert all(torch.equal(back[k], tensors[k]) and back[k].dtype == tensors[k].dtype for k in tensors)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / "nothing.safetensors", tmp_path):
        with pytest.raises(WeightsError, match=f"{path}: no such file"):
            load_sweep(path)


@pytest.mark.parametrize("keep", [0, 4, 100, 0.5, 0.999])
def test_a_truncated_file_is_refused(good: Path, keep: float) -> None:
    whole = good.read_bytes()
    good.write_bytes(whole[: int(keep if keep >= 1 or not keep else keep * len(whole))])
    with pytest.raises(WeightsError, match=r"good\.safetensors: not a complete safetensors file.*again"):
        load_sweep(good)


@pytest.mark.parametrize(
    "content",
    [b"PK\x03\x04" + 500 * b"\0", b"<html>404 not found</html>" * 20, struct.pack("<Q", 10) + 30 * b"{"],
    ids=["a zip, as torch.save writes", "a web page", "a damaged header"],
)
def test_a_file_of_another_format_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(content)
    with pytest.raises(WeightsError, match=r"model\.safetensors: not a complete safetensors file"):
        load_sweep(path)


@pytest.mark.parametrize(
    ("info", "told"),
    [
        ({}, "no 'config' in its metadata"),
        ({"config": "vggt-1b"}, "configuration"),
        ({"config": "[1, 2]"}, "configuration"),
        ({"config": json.dumps({"hidden_size": 768, "layers": 12})}, "another version.*hidden_size"),
        ({"config": json.dumps({**asdict(TINY), "wavelets": 3})}, "another version.*wavelets"),
    ],
)
def test_weights_of_another_network_or_version_are_refused(
    network: Sweep, tmp_path: Path, info: dict[str, str], told: str
) -> None:
    path = written(tmp_path / "other.safetensors", tensors_of(network), **info)
    with pytest.raises(WeightsError, match=rf"other\.safetensors: .*{told}"):
        load_sweep(path)


def test_names_that_are_missing_or_unknown_are_listed(network: Sweep, tmp_path: Path) -> None:
    tensors = tensors_of(network)
    del tensors["head.coarse.norm.weight"]
    tensors["head.extra.weight"] = torch.zeros(3)
    path = written(tmp_path / "x.safetensors", tensors, config=json.dumps(asdict(TINY)))
    with pytest.raises(WeightsError) as caught:
        load_sweep(path)
    assert "1 missing (head.coarse.norm.weight" in str(caught.value)
    assert "1 unknown (head.extra.weight" in str(caught.value)
    assert "not weights of Sweep" in str(caught.value)
    assert "another shape" not in str(caught.value)


def test_another_shape_is_refused(network: Sweep, tmp_path: Path) -> None:
    larger = json.dumps(asdict(replace(TINY, hidden=24)))
    path = written(tmp_path / "x.safetensors", tensors_of(network), config=larger)
    with pytest.raises(WeightsError, match=r"of another shape \(head\.refine\.0\.down1") as caught:
        load_sweep(path)
    assert "missing" not in str(caught.value)


def test_nothing_is_loaded_when_something_is_wrong() -> None:
    layer = nn.Linear(3, 2)
    before = {k: v.clone() for k, v in layer.state_dict().items()}
    for tensors in ({"weight": torch.ones(2, 3)}, {"weight": torch.ones(2, 3), "bias": torch.ones(3)}):
        with pytest.raises(WeightsError):
            fill(layer, tensors, Path("x"))
        assert all(torch.equal(v, before[k]) for k, v in layer.state_dict().items())
    fill(layer, {"weight": torch.ones(2, 3), "bias": torch.zeros(2)}, Path("x"))
    assert bool((layer.weight == 1).all())


def test_the_embedded_file_fits_the_network_of_this_version() -> None:
    network = load_sweep()
    tensors, info = read_file(EMBEDDED)
    assert json.loads(info["config"]) == json.loads(json.dumps(network.metadata()))
    assert all(torch.equal(v, tensors[k]) for k, v in network.state_dict().items())
    assert all(bool(torch.isfinite(v).all()) for v in tensors.values())
