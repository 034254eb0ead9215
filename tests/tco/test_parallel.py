"""Tasks of tensor operations side by side: their results, gradients, threads and errors."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from tco.parallel import WORKERS, side_by_side

CPU = torch.device("cpu")


def of_a_new_thread() -> int:
    """How many threads torch gives to one that has called nothing yet."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(torch.get_num_threads).result()


@pytest.fixture(params=[1, 2, 5])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_results_are_in_the_order_of_the_items(threads: int) -> None:
    items = [torch.full((3,), float(i)) for i in range(7)]
    found = side_by_side(lambda x: x * 2, items, CPU)
    assert [float(x[0]) for x in found] == [2.0 * i for i in range(7)]
    assert torch.get_num_threads() == threads == of_a_new_thread()


def test_threads_are_shared_among_those_at_work(threads: int) -> None:
    """Both items wait for each other where there are threads for two; together they have no more than all."""
    barrier = threading.Barrier(min(threads, 2))

    def task(_: int) -> tuple[int, int]:
        barrier.wait(timeout=60)
        return threading.get_ident(), torch.get_num_threads()

    found = side_by_side(task, [0, 1], CPU)
    if threads == 1:
        assert {who for who, _ in found} == {threading.get_ident()}
    else:
        assert len({who for who, _ in found}) == WORKERS == 2
        assert [count for _, count in found] == [threads // 2] * 2
    assert torch.get_num_threads() == threads


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("recorded", [True, False])
def test_gradients_are_recorded_where_they_are_outside(recorded: bool) -> None:
    x = torch.arange(4.0, requires_grad=True)
    with torch.set_grad_enabled(recorded):
        parts = side_by_side(lambda i: x[i] ** 2, [0, 1, 2, 3], CPU)
    assert all(part.requires_grad is recorded for part in parts)
    if recorded:
        torch.stack(parts).sum().backward()
        assert x.grad is not None and x.grad.tolist() == [0.0, 2.0, 4.0, 6.0]


def test_errors_reach_the_caller_and_threads_are_given_back(threads: int) -> None:
    def task(i: int) -> int:
        if i == 2:
            raise ValueError("the third")
        return i

    with pytest.raises(ValueError, match="the third"):
        side_by_side(task, [0, 1, 2, 3], CPU)
    assert torch.get_num_threads() == threads


@pytest.mark.usefixtures("threads")
def test_other_devices_work_one_after_the_other() -> None:
    found = side_by_side(lambda _: threading.get_ident(), [0, 1, 2], torch.device("meta"))
    assert set(found) == {threading.get_ident()}
