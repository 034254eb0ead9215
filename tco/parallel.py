"""Compiled loops on as many threads as torch may use."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch


def in_ranges(task: Callable[[int, int], None], count: int) -> None:
    """Run a task over ranges, of first and end, that together are 0 … ``count`` − 1, a range a thread."""
    threads = min(torch.get_num_threads(), count)
    if threads <= 1:
        task(0, count)
        return
    edges = [count * i // threads for i in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(task, edges[:-1], edges[1:]))
