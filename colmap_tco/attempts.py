"""Chunks that turn out too large for the memory are done in halves: smaller chunks, never a crash."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from colmap_tco._pycolmap import Ints
from colmap_tco.chunks import Chunk, smaller
from colmap_tco.errors import is_out_of_memory

log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True)
class Attempt(Generic[T]):
    """One chunk that was done, or given up.

    Attributes:
        chunk: the views.
        result: of the work; None if it was given up.
        why: it was given up; empty if it was done.
    """

    chunk: Chunk
    result: T | None
    why: str = ""


def within_memory(
    chunks: Iterable[Chunk],
    common: Ints,
    work: Callable[[Chunk], T],
    most: Callable[[], int],
    release: Callable[[], None],
) -> Iterator[Attempt[T]]:
    """Do the work of every chunk; those that are too large, in halves, down to two views.

    A chunk that ran out of memory shows that others of its size will, so the limit holds for the rest.

    Args:
        chunks: what is to be done.
        common: (V, V) number of points that two views share, by which chunks are divided.
        work: raises one of the errors that :func:`colmap_tco.errors.is_out_of_memory` knows where the
            memory is not enough.
        most: views that fit now, asked before every chunk. Two are tried even if they may not fit.
        release: gives memory back after a failure.
    """
    queue = list(chunks)
    limit = max((len(chunk.views) for chunk in queue), default=2)
    while queue:
        chunk = queue.pop(0)
        fitting = max(2, min(limit, most()))
        if len(chunk.views) > fitting:
            parts = smaller(chunk, common, fitting)
            log.warning("%d views do not fit the free memory: done in %d parts", len(chunk.views), len(parts))
            queue[:0] = parts
            continue
        result, why = _tried(work, chunk)
        if not why:
            yield Attempt(chunk, result)
            continue
        release()
        if len(chunk.views) <= 2:
            log.error("two views do not fit the memory (%s)", why)
            yield Attempt(chunk, None, f"out of memory even with one other view ({why})")
            continue
        limit = max(2, len(chunk.views) // 2)
        log.warning("out of memory with %d views (%s): on with %d", len(chunk.views), why, limit)
        queue.insert(0, chunk)


def _tried(work: Callable[[Chunk], T], chunk: Chunk) -> tuple[T | None, str]:
    """Result, or why the memory was not enough.

    The error ends here: its traceback would keep what the work had allocated.
    """
    import cv2

    try:
        return work(chunk), ""
    except (MemoryError, RuntimeError, cv2.error) as error:
        if not is_out_of_memory(error):
            raise
        text = str(error).strip()
        return None, text.splitlines()[0][:120] if text else type(error).__name__
