"""What the neighbours of a reference view say of its pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Votes(NamedTuple):
    """Votes on M pixels of a reference view.

    Attributes:
        seen: (M,) views whose image contains the point.
        support: (M,) views that agree, the reference included.
        conflicts: (M,) views that look through the point.
        weight: (M,) sum of the weights of the neighbours that agree.
        shift: (M, 3) weighted sum of the ways from the point to their surfaces, in the reference frame.
        normal: (M, 3) weighted sum of their normals, in the reference frame.
        who: (M, words) one bit for each neighbour that agrees.
        cosine: (M,) of the largest angle between the rays of the reference and of a view that agrees.
    """

    seen: NDArray[np.uint16]
    support: NDArray[np.uint16]
    conflicts: NDArray[np.uint16]
    weight: NDArray[np.float32]
    shift: NDArray[np.float32]
    normal: NDArray[np.float32]
    who: NDArray[np.uint64]
    cosine: NDArray[np.float32]

    @classmethod
    def none(cls, pixels: int, neighbours: int) -> Votes:
        """No votes yet on so many pixels, by so many neighbours."""
        words = max(1, (neighbours + 63) // 64)
        return cls(
            seen=np.zeros(pixels, np.uint16),
            support=np.ones(pixels, np.uint16),
            conflicts=np.zeros(pixels, np.uint16),
            weight=np.zeros(pixels, np.float32),
            shift=np.zeros((pixels, 3), np.float32),
            normal=np.zeros((pixels, 3), np.float32),
            who=np.zeros((pixels, words), np.uint64),
            cosine=np.ones(pixels, np.float32),
        )

    def select(self, keep: NDArray[np.bool_] | slice) -> Votes:
        """The votes on some of the pixels; views for a slice."""
        return Votes(
            self.seen[keep],
            self.support[keep],
            self.conflicts[keep],
            self.weight[keep],
            self.shift[keep],
            self.normal[keep],
            self.who[keep],
            self.cosine[keep],
        )

    def agrees(self, neighbour: int) -> NDArray[np.bool_]:
        """(M,) whether the neighbour of this number agrees."""
        bits = self.who[:, neighbour >> 6] >> np.uint64(neighbour & 63)
        return (bits & np.uint64(1)).astype(bool)
