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


def first_block(changed: Collection[str], count: int, start: int = 0) -> int:
    """Index of the first block that changes, plus ``start``; ``start`` for a name that is of no block.

    Args:
        changed: dotted names of layers in lists of blocks; ``frame_blocks.3.attn.qkv`` is in block 3.
        start: index of the first block in the lists.
        count: of the blocks in them: the result where nothing changes.
    """
    of_names = (next((int(p) for p in name.split(".") if p.isdigit()), 0) for name in changed)
    return start + min(of_names, default=count)
