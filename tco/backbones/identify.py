"""Which network a file of weights belongs to, from the names in it; no tensor is read."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tco.backbones.checkpoints import CONFIG, NETWORK, header_length, read
from tco.backbones.weights import WeightsError

SIGNATURES: dict[str, tuple[str, ...]] = {
    "vggt": ("aggregator.frame_blocks.", "aggregator.global_blocks.", "depth_head."),
    "pi3": ("encoder.", "decoder.", "point_decoder.", "camera_decoder."),
    "da3": ("model.backbone.pretrained.", "model.head.", "model.cam_enc.", "model.cam_dec."),
}
"""Network → beginnings of names that all its checkpoints have, and no other network's have together."""

OWN = ("mini",)
"""Networks that have the names of a published one and tell themselves apart in the file's metadata."""


@dataclass(frozen=True)
class Contents:
    """What a file of weights says of itself.

    Attributes:
        network: a key of :data:`SIGNATURES`, one of :data:`OWN`, ``sweep`` for the embedded network, or
            empty: unknown.
        names: of the tensors.
        size: bytes of the file.
    """

    network: str
    names: tuple[str, ...]
    size: int

    def __str__(self) -> str:
        if self.network:
            return f"weights of {self.network}"
        shown = ", ".join(self.names[:3]) + (", …" if len(self.names) > 3 else "")
        return f"weights of a network that is not known here ({len(self.names)} tensors: {shown})"


def identify(path: Path) -> Contents:
    """What a file of weights holds.

    Raises:
        WeightsError: missing, cut off, or neither safetensors nor a plain table of ``torch.save``; the
            message says what it is instead.
    """
    if not path.exists():
        raise WeightsError(f"{path}: no such file of weights")
    if path.is_dir():
        raise WeightsError(f"{path}: this is a folder; name the file of weights in it")
    size = path.stat().st_size
    header = _header(path, size)
    if header is None:
        tensors, info = read(path)
        return Contents(_network(tensors, info), tuple(tensors), size)
    length, table = header
    info = table.pop("__metadata__", None)
    try:
        end = max((int(entry["data_offsets"][1]) for entry in table.values()), default=0)
        tags = {str(key): str(value) for key, value in (info or {}).items()}
    except (TypeError, KeyError, IndexError, ValueError, AttributeError) as error:
        raise WeightsError(f"{path}: {_DAMAGED}") from error
    whole = end + 8 + length
    if size != whole:
        raise WeightsError(
            f"{path}: {size} bytes of a safetensors file of {whole}, so its copy or download was cut off "
            "or mixed up; fetch or copy it again"
        )
    return Contents(_network(table, tags), tuple(table), size)


_DAMAGED = "a safetensors file with a damaged header; fetch or copy it again"


def _header(path: Path, size: int) -> tuple[int, dict[str, Any]] | None:
    """Length and content of the table in front of a safetensors file, or None if there is none.

    Raises:
        WeightsError: it begins as a table that is not whole.
    """
    with path.open("rb") as file:
        length = header_length(file.read(9))
        if length is None:
            return None
        text = b"{" + file.read(length - 1)
    if len(text) < length:
        raise WeightsError(
            f"{path}: a safetensors file that was cut off in its first {length} bytes, of which {size} are "
            "there; fetch or copy it again"
        )
    try:
        table: dict[str, Any] = json.loads(text)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise WeightsError(f"{path}: {_DAMAGED}") from error
    return length, table


def _network(names: Iterable[str], info: dict[str, str]) -> str:
    if info.get(NETWORK) in OWN:
        return info[NETWORK]
    every = list(names)
    for network, parts in SIGNATURES.items():
        if all(any(name.startswith(part) for name in every) for part in parts):
            return network
    return "sweep" if CONFIG in info else ""
