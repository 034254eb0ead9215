"""The mean of networks is one of their kind, and what is of another kind is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from tco.backbones.weights import read_file
from training.average import averaged


def test_weights_are_means_and_steps_are_told(tmp_path: Path) -> None:
    files = [tmp_path / "a", tmp_path / "b", tmp_path / "other"]
    for file, value, config in zip(files, (1.0, 4.0, 0.0), ("x", "x", "y"), strict=True):
        tensors = {"w": torch.full((2, 3), value), "n": torch.arange(2.0) * value}
        save_file(tensors, file, {"config": config, "steps": str(int(100 * value))})
    averaged(files[:2], tmp_path / "out")
    weights, info = read_file(tmp_path / "out")
    assert torch.equal(weights["w"], torch.full((2, 3), 2.5)) and torch.equal(
        weights["n"], torch.tensor([0, 2.5])
    )
    assert info == {"config": "x", "steps": "100+400"}
    with pytest.raises(ValueError, match="other is of another network"):
        averaged(files[1:], tmp_path / "out")
