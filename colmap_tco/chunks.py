"""Views → overlapping groups that fit the memory, and the sources of every view.

Images are not assumed to be in any order: groups follow the 3D points that views share. All poses are
in COLMAP's frame, so chunks need no alignment to each other; context views are there to confirm depth
at the rim of a group, and each view's result is taken from the one chunk that owns it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from colmap_tco._pycolmap import Floats, Ints, Mask
from colmap_tco.tracks import Covisibility

CONTEXT_SHARE, SHARE_MEASURED_AT = 0.3, 40
"""Share of a chunk's views that are context, when a scene needs more than one chunk, and the size up to which
it holds. What lies around a group is as long as its rim: beyond, the share falls with the square root."""


@dataclass(frozen=True)
class Chunk:
    """Views that are optimised together.

    Attributes:
        owned: indices of the views whose results this chunk gives, ascending.
        context: views of other chunks that help, ascending.
    """

    owned: tuple[int, ...]
    context: tuple[int, ...] = ()

    @property
    def views(self) -> tuple[int, ...]:
        """Owned, then context."""
        return self.owned + self.context


@dataclass(frozen=True)
class ChunkPlan:
    """Every view in exactly one chunk's ``owned``, or in ``skipped``.

    Attributes:
        chunks: ordered by their first view.
        skipped: view → why it cannot be reconstructed.
    """

    chunks: tuple[Chunk, ...]
    skipped: dict[int, str]


def plan_chunks(common: Ints, max_views: int) -> ChunkPlan:
    """Split views into chunks of at most ``max_views``, context included.

    A connected component that fits is one chunk. A larger one is cut into groups of nearly equal size,
    each grown from the view with the weakest ties by adding the view that shares most points with the
    group; then each group receives context. The result depends on the counts alone.

    Args:
        common: (V, V) number of points that two views share, symmetric, zero diagonal.
        max_views: at least 2; as many as fit the memory.

    Raises:
        ValueError: ``common`` is not square and symmetric, or ``max_views`` below 2.
    """
    if common.ndim != 2 or not np.array_equal(common, common.T):
        raise ValueError(f"common must be a symmetric matrix, its shape is {common.shape}")
    if max_views < 2:
        raise ValueError(f"a chunk needs at least two views, max_views is {max_views}")
    chunks, skipped = [], {}
    for members in _components(common > 0):
        if len(members) == 1:
            skipped[members[0]] = "shares no 3D point with another view"
        elif len(members) <= max_views:
            chunks.append(Chunk(tuple(members)))
        else:
            chunks += _cut(common, members, max_views)
    return ChunkPlan(tuple(sorted(chunks, key=lambda chunk: chunk.owned)), skipped)


def smaller(chunk: Chunk, common: Ints, max_views: int) -> list[Chunk]:
    """The views that a chunk owns in chunks of at most ``max_views``, context included.

    Args:
        chunk: one that does not fit the memory.
        common: (V, V) as for :func:`plan_chunks`.
        max_views: at least 2.
    """
    return _cut(common, list(chunk.owned), max_views)


def _cut(common: Ints, members: list[int], max_views: int) -> list[Chunk]:
    """Chunks of at most ``max_views``, context included, that own these views."""
    share = CONTEXT_SHARE * min(1.0, math.sqrt(SHARE_MEASURED_AT / max_views))
    room = max_views - max(1, round(max_views * share))
    groups = _merge(_grow(common, members, room), common, (room + max_views) // 2)
    return [Chunk(tuple(sorted(group)), _context(common, group, max_views)) for group in groups]


def _components(linked: Mask) -> list[list[int]]:
    """Connected components, each ascending, ordered by their first member."""
    left = np.ones(len(linked), bool)
    components = []
    for start in range(len(linked)):
        if not left[start]:
            continue
        inside = np.zeros(len(linked), bool)
        inside[start] = True
        front = inside
        while front.any():
            front = linked[front].any(0) & ~inside
            inside = inside | front
        left &= ~inside
        components.append(np.flatnonzero(inside).tolist())
    return components


def _grow(common: Ints, members: list[int], room: int) -> list[list[int]]:
    """Cut a component into connected groups of at most ``room`` views."""
    left = np.zeros(len(common), bool)
    left[members] = True
    groups = []
    while left.any():
        count = int(left.sum())
        target = math.ceil(count / math.ceil(count / room))
        ties = np.where(left, common[:, left].sum(1), np.iinfo(np.int64).max)
        group = [int(np.argmin(ties))]
        left[group[0]] = False
        links = common[group[0]].copy()
        while len(group) < target:
            best = int(np.argmax(np.where(left, links, -1)))
            if not left[best] or links[best] <= 0:
                break
            group.append(best)
            left[best] = False
            links += common[best]
        groups.append(group)
    return groups


def _merge(groups: list[list[int]], common: Ints, room: int) -> list[list[int]]:
    """Join fragments that growing left behind to the group with which they share most, where they fit.

    Args:
        groups: disjoint sets of views.
        common: (V, V) number of points that two views share.
        room: largest size of a joined group. It may take some of the context's place: a chunk of one
            view and its context costs as much as a full one.
    """
    groups = sorted(groups, key=len)
    merged: list[list[int]] = []
    for i, group in enumerate(groups):
        later = [g for g in groups[i + 1 :] if len(g) + len(group) <= room]
        ties = [int(common[np.ix_(group, g)].sum()) for g in later]
        if later and max(ties) > 0:
            later[int(np.argmax(ties))].extend(group)
        else:
            merged.append(group)
    return merged


def _context(common: Ints, group: list[int], max_views: int) -> tuple[int, ...]:
    """Views outside a group that support it best, until the chunk is full.

    Each is the one that most increases Σ log(1 + shared points) over the owned views, so that a view at
    the rim gets its neighbours before one in the middle gets more.
    """
    inside = np.zeros(len(common), bool)
    inside[group] = True
    support = common[group][:, group].sum(1).astype(float)
    context: list[int] = []
    while len(group) + len(context) < max_views:
        gain = np.log1p(common[group] / (1 + support)[:, None]).sum(0)
        gain[inside] = 0
        best = int(np.argmax(gain))
        if gain[best] <= 0:
            break
        context.append(best)
        inside[best] = True
        support += common[group, best]
    return tuple(sorted(context))


def source_views(pairs: Covisibility, count: int) -> list[tuple[int, ...]]:
    """For every view the ``count`` best sources, best first: highest angle-weighted score, of equals
    most common points. Views that share no point are never sources, so the list can be shorter."""
    return [_best(pairs.score[v], pairs.common[v], count) for v in range(len(pairs.common))]


def _best(score: Floats, common: Ints, count: int) -> tuple[int, ...]:
    order = np.lexsort((np.arange(len(score)), -common, -score))
    return tuple(order[common[order] > 0][:count].tolist())
