"""Weights made by a rule from the names of the parameters: a network of any size, the same everywhere.

Each tensor is drawn from numpy's Philox generator with the key ``crc32(name) xor salt``. Matrices and
convolutions have the variance 1 / fan in, tokens 1 / 4; the weights of norms are near 1, layer scales near
0.2, everything else near 0. The reference numbers of the published networks are those of these weights.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable

import numpy as np
import torch
from torch import nn

from tco.backbones.dinov2 import COLOR_MEAN, COLOR_STD

TOKENS = (
    "cls_token", "pos_embed", "register_tokens", "mask_token", "camera_token", "register_token",
    "empty_pose_tokens",
)  # fmt: skip
CONSTANTS = {"image_mean": COLOR_MEAN, "image_std": COLOR_STD}
"""Entries of state dicts that are no weights."""


def array(name: str, shape: tuple[int, ...], salt: int = 0) -> np.ndarray:
    """The float32 values of a tensor of a state dict."""
    if name in CONSTANTS:
        return np.array(CONSTANTS[name], np.float32).reshape(shape)
    key = zlib.crc32(name.encode()) ^ salt
    noise = np.random.Generator(np.random.Philox(key=key)).standard_normal(shape, dtype=np.float32)
    if name.rsplit(".", 1)[-1] in TOKENS:
        return np.float32(0.5) * noise
    if len(shape) >= 2:
        return noise / np.float32(math.sqrt(math.prod(shape[1:])))
    if name.endswith(".weight"):
        return np.float32(1) + np.float32(0.1) * noise
    if name.endswith(".gamma"):
        return np.float32(0.2) + np.float32(0.05) * noise
    return np.float32(0.02) * noise


def by_rule(build: Callable[[], nn.Module], device: torch.device | str = "cpu", salt: int = 0) -> nn.Module:
    """A network whose whole state dict follows the rule; no more than one tensor is held twice."""
    with torch.device("meta"):
        network = build()
    network.to_empty(device=device)
    with torch.no_grad():
        for name, tensor in network.state_dict(keep_vars=True).items():
            tensor.copy_(torch.from_numpy(np.ascontiguousarray(array(name, tuple(tensor.shape), salt))))
    return network
