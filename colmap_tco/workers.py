"""Compiled loops over ranges of pixels, on a few threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import TypeVar

S = TypeVar("S")
T = TypeVar("T")


class Workers:
    """Threads that take ranges of an array.

    The loops are compiled by numba as serial functions that release the interpreter's lock. Its own
    parallel loops take several times as long to compile, wait actively on a busy machine, and, in
    0.68, lose what is written to arrays reached through a tuple.
    """

    def __init__(self, num_threads: int = -1) -> None:
        self.count = num_threads if num_threads > 0 else os.cpu_count() or 1
        self._pool = ThreadPoolExecutor(self.count) if self.count > 1 else None

    def run(self, length: int, step: int, function: Callable[[slice], T]) -> list[T]:
        """Call ``function`` on slices of at most ``step`` that cover ``length``; results in their order."""
        return self.map(
            function, [slice(first, min(first + step, length)) for first in range(0, length, step)]
        )

    def map(self, function: Callable[[S], T], items: Sequence[S]) -> list[T]:
        """Call ``function`` on each item; results in their order."""
        if self._pool is None or len(items) < 2:
            return [function(item) for item in items]
        return list(self._pool.map(function, items))

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown()
