"""Work on as many threads as torch may use: compiled loops in ranges, tensor operations side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

WORKERS = 2
"""Tasks of tensor operations at once, at most: each has intermediate results of its own in memory."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def in_ranges(task: Callable[[int, int], None], count: int) -> None:
    """Run a task over ranges, of first and end, that together are 0 … ``count`` − 1, a range a thread."""
    threads = min(torch.get_num_threads(), count)
    if threads <= 1:
        task(0, count)
        return
    edges = [count * i // threads for i in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(task, edges[:-1], edges[1:]))


def side_by_side(
    task: Callable[[_Item], _Result], items: Sequence[_Item], device: torch.device
) -> list[_Result]:
    """Results of a task of each item, in their order.

    On a CPU several run at once, and share the threads that torch may use: an operation on a small tensor
    gains little by a second thread, and two of them on a thread each take half the time. On other devices one
    runs after the other.

    Args:
        task: of tensor operations; what it changes must be its item's alone. Gradients are recorded in it if
            they are where this is called.
        items: of the task.
        device: that its tensors are on.
    """
    whole, recorded = torch.get_num_threads(), torch.is_grad_enabled()
    workers = min(whole, len(items), WORKERS)
    if workers <= 1 or device.type != "cpu":
        return [task(item) for item in items]

    def run(item: _Item) -> _Result:
        with torch.set_grad_enabled(recorded):
            return task(item)

    try:
        # The number of threads is that of the calling thread, and of those that have called nothing yet.
        with ThreadPoolExecutor(workers, "beside", torch.set_num_threads, (whole // workers,)) as pool:
            return list(pool.map(run, items))
    finally:
        torch.set_num_threads(whole)
