"""The first blocks of a decoder, computed once where adapters change later ones alone."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True)
class Passed:
    """Tokens of all V views between two blocks of a decoder, without gradients.

    Attributes:
        depth: blocks (in VGGT: pairs of them) that are behind.
        tokens: (V, N, C) that the next one is given.
        kept: block → tokens (V, N, 2 C) there, of those behind that the heads read.
    """

    depth: int
    tokens: Tensor
    kept: Mapping[int, Tensor] = field(default_factory=dict)


def first_block(changed: Collection[str], start: int = 0) -> int:
    """Index of the first block that changes, plus ``start``; ``start`` for a name that is of no block.

    Args:
        changed: dotted names of layers in lists of blocks; ``frame_blocks.3.attn.qkv`` is in block 3.
        start: index of the first block in the lists.

    Raises:
        ValueError: nothing changes.
    """
    if not changed:
        raise ValueError("no layer of the decoder changes, so that there is no first block that does")
    return start + min(next((int(p) for p in name.split(".") if p.isdigit()), 0) for name in changed)
