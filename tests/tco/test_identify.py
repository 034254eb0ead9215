"""Files of weights tell whose they are, and what is not weights is called by its name."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from tco.backbones.identify import SIGNATURES, identify
from tco.backbones.weights import EMBEDDED, WeightsError


def names_of(shared: Path, reference: str) -> list[str]:
    return list(json.loads((shared / "parity" / f"{reference}.json").read_text())["state_dict"])


@pytest.mark.parametrize(
    ("reference", "network"), [("vggt_small", "vggt"), ("vggt_1b", "vggt"), ("pi3_large", "pi3")]
)
@pytest.mark.parametrize("suffix", ["safetensors", "pt"])
def test_published_names_tell_the_network(
    shared: Path, tmp_path: Path, reference: str, network: str, suffix: str
) -> None:
    tensors = {name: torch.zeros(1) for name in names_of(shared, reference)}
    path = tmp_path / f"weights.{suffix}"
    if suffix == "pt":
        torch.save(tensors, path)
    else:
        save_file(tensors, path)
    found = identify(path)
    assert found.network == network
    assert sorted(found.names) == sorted(tensors) and found.size == path.stat().st_size
    assert str(found) == f"weights of {network}"


def test_the_embedded_network_is_known_by_its_configuration() -> None:
    assert identify(EMBEDDED).network == "sweep"


@pytest.mark.parametrize("network", SIGNATURES)
@pytest.mark.parametrize("part", range(3))
def test_a_part_of_a_network_is_not_the_network(tmp_path: Path, network: str, part: int) -> None:
    parts = [p for i, p in enumerate(SIGNATURES[network]) if i != part]
    save_file({f"{p}a": torch.zeros(1) for p in parts}, tmp_path / "part")
    found = identify(tmp_path / "part")
    assert found.network == "" and f"not known here ({len(parts)} tensors: " in str(found)


def test_every_cut_is_seen(tmp_path: Path) -> None:
    """At any length, in the header or after it, and too long as well."""
    path = tmp_path / "w.safetensors"
    save_file({"a": torch.arange(40.0), "b": torch.zeros(3)}, path)
    whole = path.read_bytes()
    identify(path)
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(WeightsError, match=r"w\.safetensors: "):
            identify(path)
        if length > 8:
            with pytest.raises(WeightsError, match="cut off"):
                identify(path)
    path.write_bytes(whole + b"\0")
    with pytest.raises(WeightsError, match=f"{len(whole) + 1} bytes of a safetensors file of {len(whole)}"):
        identify(path)


def headed(table: str) -> bytes:
    """A safetensors file of a header alone."""
    return len(table).to_bytes(8, "little") + table.encode()


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "an empty file"),
        (b"<!DOCTYPE html><html>", "a web page"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0", "a pointer of Git LFS"),
        (b"\x80\x04\x95whatever", "a Python pickle, which could run code"),
        (b"\x20\0\0\0\0\0\0\0{not json}" + b" " * 40, "damaged header"),
        (headed('{"a": {"dtype": "F32", "shape": [1]}}'), "damaged header"),
        (headed('{"a": {"data_offsets": null}}'), "damaged header"),
        (headed('{"a": {"data_offsets": [0]}}'), "damaged header"),
        (headed('{"a": 3}'), "damaged header"),
        (headed('{"__metadata__": [1]}'), "damaged header"),
        (b'{"model_type": "vggt"}', "a JSON text"),
        (b"weights will be published soon\n", "a text"),
        (b"GGUF\x03\0\0\0", "a GGUF file"),
        (b"PK\x03\x04 and then nothing", r"not a complete file of torch\.save"),
    ],
)
def test_what_is_not_weights_is_called_by_its_name(tmp_path: Path, content: bytes, told: str) -> None:
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(WeightsError, match=f"file: .*{told}"):
        identify(tmp_path / "file")


def test_a_header_without_metadata_is_whole(tmp_path: Path) -> None:
    (tmp_path / "w").write_bytes(headed('{"__metadata__": null}'))
    assert identify(tmp_path / "w").network == ""


def test_files_that_are_not_there_and_folders_and_foreign_archives(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="none: no such file"):
        identify(tmp_path / "none")
    with pytest.raises(WeightsError, match="this is a folder"):
        identify(tmp_path)
    with zipfile.ZipFile(tmp_path / "pictures.zip", "w") as archive:
        archive.writestr("a.txt", "a")
    with pytest.raises(WeightsError, match=r"pictures\.zip: this is an archive of other files \(a\.txt\)"):
        identify(tmp_path / "pictures.zip")
    np.savez(tmp_path / "arrays.npz", a=np.zeros(3))
    with pytest.raises(WeightsError, match=r"arrays\.npz: this is a set of numpy's arrays"):
        identify(tmp_path / "arrays.npz")
    torch.save({"model": {"a": torch.zeros(1)}, "epoch": 3}, tmp_path / "training.pt")
    with pytest.raises(
        WeightsError, match="expected a plain table of tensors by name, found entries model, epoch"
    ):
        identify(tmp_path / "training.pt")
