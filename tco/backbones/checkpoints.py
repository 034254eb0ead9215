"""Read checkpoints of published networks: strict in names and shapes, clear about what a file is instead."""

from __future__ import annotations

import dataclasses
import json
import logging
import pickle
import struct
import typing
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from tco.backbones.weights import WeightsError, read_file

logger = logging.getLogger(__name__)

_Config = TypeVar("_Config")
_Network = TypeVar("_Network", bound=nn.Module)

CONFIG = "config"
"""Key of the sizes, as JSON, in the metadata of files that :func:`save` wrote."""

ZIP = b"PK\x03\x04"
"""Beginning of the files that ``torch.save`` writes."""
NETWORK = "network"
"""Key of the network's name in that metadata, where the names of the tensors do not tell."""

MOST_HEADER = 100_000_000
"""Bytes of the longest header that the format of safetensors allows."""

FOREIGN = {
    b"version https://git-lfs": "a pointer of Git LFS",
    b"\x80": "a Python pickle, which could run code when it is read",
    b"GGUF": "a GGUF file of a language model",
    b"\x93NUMPY": "an array of numpy",
    b"\x89HDF": "an HDF5 file",
    b"\x1f\x8b": "a file compressed by gzip",
    b"%PDF": "a PDF document",
}
"""Beginning → what is often found in place of weights, and is none."""


def load_network(
    path: Path,
    build: Callable[[_Config], _Network],
    published: _Config | Callable[[Mapping[str, Tensor]], _Config],
    skipped: tuple[str, ...] = (),
    products: tuple[Callable[[_Network], Sequence[nn.Module]], torch.dtype] | None = None,
) -> _Network:
    """A network on the CPU with the tensors of a file.

    Tensors that keep their type are not copied but read when they are first used. If some change theirs, all
    are copied, a few at a time, so that the memory never holds much more than the network. A file in half or
    double precision is taken as float32, in which the networks are published.

    Args:
        path: a file that :func:`read` reads.
        build: the network's class; called with sizes, on the meta device, so that nothing is initialised.
        published: the sizes, unless the file's metadata has others; where checkpoints of several sizes are
            published, a function that tells them from the tensors.
        skipped: prefixes of names that the file may hold and that the network has no use for.
        products: modules of the network whose linear layers are kept in a type, and the type; float32 is that
            of the files.

    Raises:
        WeightsError: see :func:`read`; names or shapes differ from those of the network.
    """
    tensors, info = read(path)
    config: _Config = published(tensors) if callable(published) else published
    if CONFIG in info:
        config = _sizes(info[CONFIG], type(config), path)
    with torch.device("meta"):
        network = build(config)
    used = {name: tensor for name, tensor in tensors.items() if not name.startswith(skipped or ("\0",))}
    check(network, _with_tied(network, used), path)
    change = _other_types(network, used, path)
    if products is not None and products[1] is not torch.float32:
        modules, dtype = products
        change.update(dict.fromkeys(linear_names(network, modules(network)), dtype))
    if change:
        del tensors
        used = dict(_copies(path, list(used), change))
    network.load_state_dict(_with_tied(network, used), assign=True)
    return network


def linear_names(network: nn.Module, modules: Iterable[nn.Module]) -> set[str]:
    """Names in a network of the parameters of the linear layers in some of its modules."""
    linear = {id(part) for module in modules for part in module.modules() if isinstance(part, nn.Linear)}
    return {
        f"{name}.{parameter}"
        for name, module in network.named_modules()
        if id(module) in linear
        for parameter, _ in module.named_parameters(recurse=False)
    }


def _other_types(network: nn.Module, tensors: Mapping[str, Tensor], path: Path) -> dict[str, torch.dtype]:
    """Name → type in the network, of the tensors that have another one in the file."""
    want = {name: t.dtype for name, t in network.state_dict().items()}
    other = {name: want[name] for name, t in tensors.items() if t.dtype is not want[name]}
    if other:
        kinds = sorted({str(tensors[name].dtype).removeprefix("torch.") for name in other})
        logger.info("%s: %d tensors in %s are taken as float32", path, len(other), " and ".join(kinds))
    return other


def _copies(
    path: Path, names: Sequence[str], change: Mapping[str, torch.dtype]
) -> Iterator[tuple[str, Tensor]]:
    """Copies of tensors of a file, some of them in another type.

    What is read of an open file stays in memory until it is closed, so it is opened again and again.
    """
    with path.open("rb") as file:
        every = len(names) if file.read(4) == ZIP else 16
    for k in range(0, len(names), every):
        tensors, _ = read(path)
        for name in names[k : k + every]:
            tensor = tensors[name]
            yield name, tensor.to(change.get(name, tensor.dtype), copy=True)


def _with_tied(network: nn.Module, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors by name, those that the network has under several names under all of them."""
    every = dict(tensors)
    for names in tied(network):
        stored = [name for name in names if name in every]
        every.update({name: every[stored[0]] for name in names if len(stored) == 1})
    return every


def tied(network: nn.Module) -> list[list[str]]:
    """Names of parameters that are one and the same; safetensors files hold them once, under one name."""
    names: dict[int, list[str]] = {}
    for name, parameter in network.named_parameters(remove_duplicate=False):
        names.setdefault(id(parameter), []).append(name)
    return [same for same in names.values() if len(same) > 1]


def save(path: Path, network: nn.Module, config: Any, info: Mapping[str, str] | None = None) -> None:
    """Write a network as safetensors, with its sizes (a dataclass) in the metadata; tied names once.

    ``info`` is further metadata, such as :data:`NETWORK`.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    for names in tied(network):
        for name in names[1:]:
            del tensors[name]
    sizes = json.dumps(dataclasses.asdict(config))
    save_file(tensors, path, {**(info or {}), "format": "pt", CONFIG: sizes})


def read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors on the CPU and metadata of a safetensors file or one of ``torch.save``, told by its content.

    Raises:
        WeightsError: the file is missing, damaged, of another format, or not a plain table of tensors.
    """
    if not path.is_file():
        raise WeightsError(f"{path}: no such file of weights")
    with path.open("rb") as file:
        head = file.read(512)
    if header_length(head) is not None:
        return read_file(path)
    foreign = _archive(path) if head.startswith(ZIP) else _kind(head)
    if foreign:
        raise WeightsError(
            f"{path}: this is {foreign}, not weights in the format of safetensors or torch.save; "
            "fetch the file itself"
        )
    return _read_torch(path), {}


def header_length(head: bytes) -> int | None:
    """Bytes of the table that a safetensors file which begins so has in front; None if it is no such file."""
    if len(head) < 9 or head[8:9] != b"{":
        return None
    length = int(struct.unpack("<Q", head[:8])[0])
    return length if length <= MOST_HEADER else None


def _kind(head: bytes) -> str:
    """What a file is that begins so, and neither as safetensors nor as an archive."""
    if not head:
        return "an empty file"
    for beginning, kind in FOREIGN.items():
        if head.startswith(beginning):
            return kind
    text = head.lstrip()
    if text[:1] == b"<":
        return "a web page"
    if any(byte < 32 and byte not in b"\t\n\r\f" for byte in head):
        return f"a file of another format, which begins with {head[:4]!r}"
    return "a JSON text" if text[:1] in (b"{", b"[") else "a text"


def _archive(path: Path) -> str:
    """What an archive is that is not of ``torch.save``; empty if it is, or is not whole."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except zipfile.BadZipFile:
        return ""
    if any(name.endswith("data.pkl") for name in names):
        return ""
    if any(name.endswith(".npy") for name in names):
        return "a set of numpy's arrays (.npz)"
    return f"an archive of other files ({', '.join(names[:3]) or 'empty'})"


def _read_torch(path: Path) -> dict[str, Tensor]:
    """Tensors of a zip archive as ``torch.save`` writes it; only tensors are accepted, no other objects."""
    try:
        content: Any = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except pickle.UnpicklingError as error:
        raise WeightsError(f"{path}: it holds more than tensors, which could run code when read") from error
    except (RuntimeError, EOFError, ValueError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise WeightsError(
            f"{path}: not a complete file of torch.save ({reason}); fetch or copy it again"
        ) from error
    if not isinstance(content, dict) or not all(isinstance(t, Tensor) for t in content.values()):
        inside = type(content).__name__
        if isinstance(content, dict):
            inside = "entries " + ", ".join(map(str, list(content)[:4]))
        raise WeightsError(f"{path}: expected a plain table of tensors by name, found {inside}")
    return content


def check(network: nn.Module, tensors: Mapping[str, Tensor], path: Path) -> None:
    """See that names and shapes are exactly those of the network's state dict.

    Raises:
        WeightsError: they are not; the message counts and names what differs.
    """
    want = {name: tuple(t.shape) for name, t in network.state_dict().items()}
    have = {name: tuple(t.shape) for name, t in tensors.items()}
    if want == have:
        return
    shapes = [
        f"{name} is {have[name]} instead of {want[name]}"
        for name in want
        if name in have and have[name] != want[name]
    ]
    kinds = {
        "missing": [name for name in want if name not in have],
        "unknown": [name for name in have if name not in want],
        "of another shape": shapes,
    }
    parts = [f"{len(v)} {k} ({', '.join(v[:3])}{', …' * (len(v) > 3)})" for k, v in kinds.items() if v]
    raise WeightsError(
        f"{path}: these {len(have)} tensors are not the {len(want)} of {type(network).__name__}: "
        f"{'; '.join(parts)}"
    )


def _sizes(text: str, kind: type[_Config], path: Path) -> _Config:
    """Sizes of a network from the JSON that :func:`save` wrote."""
    try:
        return _from_table(json.loads(text), kind)
    except (json.JSONDecodeError, TypeError, AttributeError) as error:
        raise WeightsError(f"{path}: its metadata does not hold a {kind.__name__} ({error})") from error


def _from_table(table: Mapping[str, Any], kind: Any) -> Any:
    """A dataclass, with dataclasses and tuples in it, from what ``asdict`` and JSON made of it."""
    hints = typing.get_type_hints(kind)
    values = {}
    for name, value in dict(table).items():
        if dataclasses.is_dataclass(hints.get(name)):
            values[name] = _from_table(value, hints[name])
        else:
            values[name] = tuple(value) if isinstance(value, list) else value
    return kind(**values)
