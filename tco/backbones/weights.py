"""Load networks from safetensors files: strict in names and shapes, clear about what is wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from tco.backbones.decoder import SweepConfig
from tco.backbones.sweep import Sweep

EMBEDDED = Path(__file__).parent / "data" / "sweep.safetensors"


class WeightsError(Exception):
    """A file of weights that is missing, damaged, or belongs to another network."""


def read_file(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file.

    Raises:
        WeightsError: the file is missing, truncated or of another format.
    """
    if not path.is_file():
        raise WeightsError(f"{path}: no such file of weights")
    try:
        with safe_open(str(path), framework="pt") as f:
            return {name: f.get_tensor(name) for name in f.keys()}, f.metadata() or {}  # noqa: SIM118
    except SafetensorError as error:
        raise WeightsError(
            f"{path}: not a complete safetensors file ({error}); fetch or copy it again"
        ) from error


def fill(module: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load tensors into a module whose names and shapes must match exactly.

    Raises:
        WeightsError: names or shapes differ; the message lists some of them.
    """
    have, want = (
        {k: tuple(v.shape) for k, v in tensors.items()},
        {k: tuple(v.shape) for k, v in module.state_dict().items()},
    )
    if have != want:
        missing, foreign = sorted(want.keys() - have.keys()), sorted(have.keys() - want.keys())
        shapes = [k for k in have.keys() & want.keys() if have[k] != want[k]]
        parts = [
            f"{len(names)} {what} ({', '.join(names[:3])}…)"
            for what, names in (
                ("missing", missing),
                ("unknown", foreign),
                ("of another shape", sorted(shapes)),
            )
            if names
        ]
        raise WeightsError(f"{path}: these are not weights of {type(module).__name__}: {'; '.join(parts)}")
    module.load_state_dict(tensors)


def load_sweep(
    path: Path = EMBEDDED, device: torch.device | str = "cpu", dtype: torch.dtype | None = None
) -> Sweep:
    """The embedded network in evaluation mode; its sizes are in the file's metadata.

    Args:
        path: a file of its weights.
        device: where it runs.
        dtype: of products and convolutions, float32 or bfloat16; None: what the device is faster in.

    Raises:
        WeightsError: see :func:`read_file` and :func:`fill`.
    """
    tensors, info = read_file(path)
    if "config" not in info:
        raise WeightsError(
            f"{path}: no 'config' in its metadata, so these are not weights of the embedded network"
        )
    network = Sweep(_sizes(info["config"], path), dtype)
    fill(network, tensors, path)
    return network.eval().requires_grad_(False).to(device)


def _sizes(text: str, path: Path) -> SweepConfig:
    """The configuration that a file of weights holds as JSON."""
    try:
        sizes: Any = json.loads(text)
    except json.JSONDecodeError as error:
        raise WeightsError(f"{path}: its configuration is not JSON, so it is of another program") from error
    if not isinstance(sizes, dict):
        raise WeightsError(f"{path}: its configuration is not that of the embedded network")
    known: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in sizes.items()}
    try:
        return SweepConfig(**known)
    except TypeError as error:
        raise WeightsError(
            f"{path}: its configuration is of another version of the network ({error})"
        ) from error
