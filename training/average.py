"""Average the weights of several points of a training.

    python -m training.average OUT WEIGHTS [WEIGHTS …]

Where settings change late in a training, what is averaged is often better at both than either: the network of
before and the one of after differ by little, and the mean of their weights is a network of the same kind
(Wortsman et al., Model soups, ICML 2022).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from safetensors.torch import save_file

from tco.backbones.weights import read_file


def averaged(files: Sequence[Path], out: Path) -> None:
    """Write the mean of networks of one kind, with the steps of all of them in its metadata.

    Raises:
        WeightsError: a file cannot be read.
        ValueError: they are not of one kind.
    """
    read = [read_file(path) for path in files]
    first, info = read[0]
    for path, (weights, other) in zip(files, read, strict=True):
        if other.get("config") != info.get("config") or weights.keys() != first.keys():
            raise ValueError(f"{path} is of another network than {files[0]}")
    mean = {
        name: torch.stack([weights[name].double() for weights, _ in read]).mean(0).to(first[name].dtype)
        for name in first
    }
    steps = "+".join(str(other.get("steps", "?")) for _, other in read)
    save_file({name: value.contiguous() for name, value in mean.items()}, out, {**info, "steps": steps})


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("weights", type=Path, nargs="+")
    args = parser.parse_args()
    averaged(args.weights, args.out)


if __name__ == "__main__":
    main()
