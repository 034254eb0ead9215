"""Checkpoints of published networks: what comes back is what was written, and what is wrong is said."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from tco.backbones import pi3, vggt
from tco.backbones.checkpoints import linear_names, load_network, read, save, tied
from tco.backbones.weights import WeightsError
from tests.tco.published import TINY_PI3, TINY_VGGT, some_views, tiny_pi3, tiny_vggt


@dataclass(frozen=True)
class Pair:
    width: int


@pytest.fixture(scope="module")
def network() -> vggt.VGGTNetwork:
    return tiny_vggt().network


def tensors_of(network: nn.Module) -> dict[str, Tensor]:
    return {k: t.clone() for k, t in network.state_dict().items()}


def loaded(path: Path) -> vggt.VGGTNetwork:
    """A tiny VGGT, from a file in the authors' form, which does not tell its sizes."""
    return load_network(path, vggt.VGGTNetwork, TINY_VGGT, vggt.SKIPPED)


def written(path: Path, tensors: dict[str, Any]) -> Path:
    """As the suffix says: safetensors or PyTorch's format."""
    if path.suffix == ".safetensors":
        save_file(tensors, path)
    else:
        torch.save(tensors, path)
    return path


@pytest.mark.parametrize("name", ["model.safetensors", "model.pt"])
def test_a_checkpoint_comes_back_as_it_was_written(
    network: vggt.VGGTNetwork, tmp_path: Path, name: str
) -> None:
    back = loaded(written(tmp_path / name, tensors_of(network)))
    ours, theirs = network.state_dict(), back.state_dict()
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[k], theirs[k]) for k in ours)


@pytest.mark.parametrize("name", ["model.safetensors", "model.pt"])
def test_a_network_read_in_another_type_is_the_one_converted_afterwards(
    network: vggt.VGGTNetwork, tmp_path: Path, name: str
) -> None:
    """Only the linear layers of the blocks are in it, and nothing refers to the file any more."""
    path = written(tmp_path / name, tensors_of(network))
    read = load_network(path, vggt.VGGTNetwork, TINY_VGGT, (), (vggt.products, torch.bfloat16))
    path.unlink()
    ours, plain = read.state_dict(), network.state_dict()
    linear = linear_names(read, vggt.products(read))
    blocks = sum(len(list(part.modules())) for part in vggt.products(read))
    assert 0 < len(linear) < blocks * 2 and all("blocks." in name for name in linear)
    assert "depth_head.norm.weight" not in linear and "camera_head.trunk.0.attn.qkv.weight" not in linear
    for key, tensor in plain.items():
        expected = tensor.bfloat16() if key in linear else tensor
        assert ours[key].dtype == expected.dtype and torch.equal(ours[key], expected)
    afterwards = vggt.VGGT(loaded(written(path, tensors_of(network))), torch.bfloat16).network.state_dict()
    assert all(torch.equal(afterwards[key], ours[key]) for key in ours)


def test_a_header_of_any_length_is_read(tmp_path: Path) -> None:
    """A file of safetensors begins with a length, whose bytes may be those that other formats begin with."""
    first = set()
    for longer in range(0, 0x300, 8):
        save_file({"a": torch.arange(3.0)}, tmp_path / "w", {"note": "x" * longer})
        first.add((tmp_path / "w").read_bytes()[0])
        assert read(tmp_path / "w")[0]["a"].tolist() == [0, 1, 2]
    assert 0x80 in first


def test_tied_parameters_are_written_once_and_read_back_under_each_name(tmp_path: Path) -> None:
    class Tied(nn.Module):
        def __init__(self, config: Pair) -> None:
            super().__init__()
            self.first = nn.Linear(config.width, config.width)
            self.second = self.first

    network = Tied(Pair(3))
    assert tied(network) == [["first.weight", "second.weight"], ["first.bias", "second.bias"]]
    save(tmp_path / "w", network, Pair(3))
    assert set(read(tmp_path / "w")[0]) == {"first.weight", "first.bias"}
    for name, content in {"one": read(tmp_path / "w")[0], "all": tensors_of(network)}.items():
        save_file(content, tmp_path / name)
        back = load_network(tmp_path / name, Tied, lambda tensors: Pair(len(tensors["first.bias"])))
        assert back.second is back.first and torch.equal(back.second.weight, network.first.weight)
    save_file({"second.weight": torch.zeros(3, 3)}, tmp_path / "half")
    with pytest.raises(WeightsError, match=r"2 missing \(first\.bias, second\.bias\)"):
        load_network(tmp_path / "half", Tied, Pair(3))


@pytest.mark.parametrize(
    ("module", "backbone", "sizes"), [(vggt, tiny_vggt(), TINY_VGGT), (pi3, tiny_pi3(), TINY_PI3)]
)
@torch.no_grad()
def test_a_saved_network_brings_its_sizes_and_predicts_the_same(
    module: Any, backbone: Any, sizes: Any, tmp_path: Path
) -> None:
    path = tmp_path / "small.safetensors"
    save(path, backbone.network, sizes)
    back = module.load(path, "cpu", torch.float32)
    assert back.network.config == sizes
    assert not back.training and not any(p.requires_grad for p in back.parameters())
    a, b = (x.decode(x.encode(some_views(), module.Priors()), [0]) for x in (backbone, back))
    assert torch.equal(a.depth, b.depth) and torch.equal(a.cameras.world_from_cam, b.cameras.world_from_cam)


def test_weights_of_the_track_head_are_passed_over(network: vggt.VGGTNetwork, tmp_path: Path) -> None:
    tensors = {**tensors_of(network), "track_head.tracker.corr_mlp.fc1.weight": torch.zeros(2, 2)}
    back = loaded(written(tmp_path / "model.pt", tensors))
    assert back.state_dict().keys() == network.state_dict().keys()


def test_nothing_is_drawn_to_be_overwritten(network: vggt.VGGTNetwork, tmp_path: Path) -> None:
    path = written(tmp_path / "model.safetensors", tensors_of(network))
    before = torch.get_rng_state()
    back = loaded(path)
    assert torch.equal(torch.get_rng_state(), before)
    assert all(t.device.type == "cpu" for t in back.state_dict().values())


def test_products_in_bfloat16_take_half_of_the_memory(tmp_path: Path) -> None:
    path = tmp_path / "small.safetensors"
    save(path, tiny_vggt().network, TINY_VGGT)
    back = vggt.load(path, "cpu", torch.bfloat16).network
    assert back.aggregator.frame_blocks[0].attn.qkv.weight.dtype is torch.bfloat16
    assert back.aggregator.frame_blocks[0].norm1.weight.dtype is torch.float32
    assert back.camera_head.trunk[0].attn.qkv.weight.dtype is torch.float32


def test_names_that_are_missing_or_unknown_are_listed(network: vggt.VGGTNetwork, tmp_path: Path) -> None:
    tensors = tensors_of(network)
    del tensors["camera_head.token_norm.weight"]
    tensors["segmentation_head.weight"] = torch.zeros(3)
    with pytest.raises(WeightsError) as caught:
        loaded(written(tmp_path / "x.safetensors", tensors))
    told = str(caught.value)
    assert "x.safetensors" in told and "VGGTNetwork" in told
    assert "1 missing (camera_head.token_norm.weight)" in told
    assert "1 unknown (segmentation_head.weight)" in told
    assert "shape" not in told


def test_another_size_is_refused(network: vggt.VGGTNetwork, tmp_path: Path) -> None:
    path = written(tmp_path / "x.pt", tensors_of(network))
    with pytest.raises(WeightsError, match=r"of another shape \(\S+ is \(\d+.*instead of"):
        load_network(path, vggt.VGGTNetwork, replace(TINY_VGGT, features=12), vggt.SKIPPED)


def test_another_network_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "x.safetensors", tensors_of(tiny_pi3().network))
    with pytest.raises(WeightsError, match=r"not the \d+ of VGGTNetwork: .* missing .*unknown"):
        loaded(path)
    with pytest.raises(WeightsError, match="not the 1210 of Pi3Network"):
        pi3.load(path)


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float64])
@pytest.mark.parametrize("products", [torch.float32, torch.bfloat16])
@torch.no_grad()
def test_a_file_in_another_precision_is_taken_as_float32(
    tmp_path: Path, kind: torch.dtype, products: torch.dtype, caplog: pytest.LogCaptureFixture
) -> None:
    backbone = tiny_vggt()
    path = tmp_path / "half.safetensors"
    save(path, tiny_vggt().network.to(kind), TINY_VGGT)
    with caplog.at_level("INFO"):
        back = vggt.load(path, "cpu", products)
    name = str(kind).removeprefix("torch.")
    assert f"{path}: {len(back.network.state_dict())} tensors in {name} are taken as float32" in caplog.text
    head = back.network.depth_head.scratch.output_conv1.weight
    rounded = backbone.network.depth_head.scratch.output_conv1.weight.to(kind).float()
    assert head.dtype is torch.float32 and torch.equal(head, rounded)
    assert back.network.aggregator.frame_blocks[0].attn.qkv.weight.dtype is products
    a, b = (x.decode(x.encode(some_views(), vggt.Priors())).depth for x in (backbone, back))
    assert b.dtype is torch.float32
    assert float((a.log() - b.log()).norm() / a.log().norm()) < 0.05


def test_metadata_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    for text in ("{", "[1]", '{"wavelets": 3}', "7"):
        save_file({"a": torch.zeros(1)}, path, {"config": text})
        with pytest.raises(WeightsError, match=r"x\.safetensors: its metadata does not hold a VGGTConfig"):
            vggt.load(path)


@pytest.mark.parametrize("name", ["model.safetensors", "model.pt"])
@pytest.mark.parametrize("keep", [0.0, 0.01, 0.5, 0.999])
def test_a_truncated_file_is_refused(
    network: vggt.VGGTNetwork, tmp_path: Path, name: str, keep: float
) -> None:
    path = written(tmp_path / name, tensors_of(network))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(WeightsError, match=rf"{name}: .*(not a complete|an empty file).*(again|itself)"):
        loaded(path)


FOREIGN = {
    "a web page": b"<!DOCTYPE html><html>404</html>",
    "a pointer of Git LFS": b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 5\n",
    "a Python pickle": pickle.dumps({"weight": [1, 2, 3]}),
    "a text": b"a text of no format at all, but long enough to have a header",
    "a JSON text": b'{"abcd":{"a table": [1, 2, 3], "that": "looks like the header of safetensors"}}',
    "a GGUF file": b"GGUF\x03\0\0\0{" + 100 * b"\0",
    "an array of numpy": b"\x93NUMPY\x01\0v\0{'descr': '<f4'}" + 100 * b"\0",
    "another format, which begins with b'ab\\\\x00c'": b"ab\0cdefghijkl",
    "not a complete file of torch.save": b"PK\x03\x04" + 500 * b"\0",
}


@pytest.mark.parametrize(("told", "content"), FOREIGN.items(), ids=FOREIGN)
def test_a_file_that_is_no_weights_is_called_what_it_is(tmp_path: Path, told: str, content: bytes) -> None:
    path = tmp_path / "model.pt"
    path.write_bytes(content)
    with pytest.raises(WeightsError, match=rf"model\.pt: .*{told}"):
        read(path)


@dataclass(frozen=True)
class Evil:
    """An object whose unpickling would make a file."""

    path: Path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (
            {"model": {"a": torch.zeros(1)}, "optimizer": {}},
            "table of tensors by name, found entries model, opt",
        ),
        ([torch.zeros(1)], "plain table of tensors by name, found list"),
    ],
    ids=["a training state", "a list"],
)
def test_what_is_not_a_table_of_tensors_is_refused(tmp_path: Path, content: Any, told: str) -> None:
    with pytest.raises(WeightsError, match=told):
        read(written(tmp_path / "model.pt", content))


def test_code_in_a_file_is_refused_and_not_run(tmp_path: Path) -> None:
    made = tmp_path / "made"
    with pytest.raises(WeightsError, match="more than tensors"):
        read(written(tmp_path / "model.pt", {"a": Evil(made)}))
    assert not made.exists()
    torch.load(tmp_path / "model.pt", weights_only=False)
    assert made.exists()


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / "nothing.pt", tmp_path):
        with pytest.raises(WeightsError, match=f"{path}: no such file"):
            vggt.load(path)
