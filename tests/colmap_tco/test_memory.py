"""How many views fit: arithmetic of footprints, what the system says is free, and chunks that did not fit."""

from __future__ import annotations

import gc
import os
import weakref
from pathlib import Path

import numpy as np
import pytest

from colmap_tco._footprints import COUNTS, FITS, PROCESS
from colmap_tco.attempts import within_memory
from colmap_tco.chunks import Chunk, plan_chunks
from colmap_tco.memory import (
    SHARE,
    Footprint,
    _left_in_container,
    chunk_limit,
    cycles_left,
    footprint,
    free_memory,
    recomputed,
)
from colmap_tco.published import NETWORKS


def test_free_memory_counts_what_the_file_cache_would_give_back() -> None:
    page = os.sysconf("SC_PAGE_SIZE")
    assert 0 < free_memory() <= 1.05 * os.sysconf("SC_PHYS_PAGES") * page
    meminfo = Path("/proc/meminfo")
    if not meminfo.exists():
        pytest.skip("only Linux says how much memory is available")
    lines = dict(line.split(":") for line in meminfo.read_text().splitlines())
    own = int(Path("/proc/self/statm").read_text().split()[1]) * page
    if _left_in_container() > 1024 * int(lines["MemTotal"].split()[0]):
        assert free_memory() == pytest.approx(own + 1024 * int(lines["MemAvailable"].split()[0]), rel=0.2)


def test_the_limit_of_a_container_counts(tmp_path: Path) -> None:
    assert _left_in_container(tmp_path) > 1e18
    (tmp_path / "memory.max").write_text("max\n")
    assert _left_in_container(tmp_path) > 1e18
    (tmp_path / "memory.max").write_text("5000\n")
    (tmp_path / "memory.current").write_text("4000\n")
    (tmp_path / "memory.stat").write_text("anon 3000\ninactive_file 700\nactive_file 300\n")
    assert _left_in_container(tmp_path) == 1700
    old = tmp_path / "old" / "memory"
    old.mkdir(parents=True)
    (old / "memory.limit_in_bytes").write_text("5000\n")
    (old / "memory.usage_in_bytes").write_text("1500\n")
    (old / "memory.stat").write_text("cache 0\n")
    assert _left_in_container(tmp_path / "old") == 3500


def test_views_and_bytes_are_inverse() -> None:
    needs = Footprint(1e9, 300.0, 5000.0, "cpu")
    for pixels in (10_000, 300_000):
        for views in (2, 7, 40):
            assert needs.views(pixels, needs.bytes(views, pixels)) == pytest.approx(views, rel=1e-6)
            assert chunk_limit(needs, pixels, round(needs.bytes(views, pixels) / SHARE) + 1000, 40) == views


def test_what_comes_before_the_steps_can_need_most() -> None:
    """Of few views a step needs more, of many the prediction of all: 100 a view against 40 and 1200."""
    needs = Footprint(0.0, 40.0, 1200.0, "cpu", Footprint(0.0, 100.0, 0.0, "cpu"))
    assert [needs.bytes(views, 10) for views in (2, 20, 40)] == [12_800, 20_000, 40_000]
    for views in (2, 20, 40):
        assert needs.views(10, needs.bytes(views, 10)) == pytest.approx(views)


def test_chunks_grow_with_the_memory_and_shrink_with_the_images() -> None:
    needs = footprint("sweep", "cpu", steps=40)
    memories = np.logspace(6, 13, 40).astype(int).tolist()
    limits = [chunk_limit(needs, 50_000, memory, 128) for memory in memories]
    assert limits == sorted(limits)
    assert (limits[0], limits[-1]) == (2, 128)
    some = round(needs.bytes(20, 50_000) / SHARE) + 1000
    assert chunk_limit(needs, 50_000, some, 128) == 20 > chunk_limit(needs, 100_000, some, 128)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("steps", [0, 40])
def test_every_network_has_a_footprint(name: str, steps: int) -> None:
    """Optimising takes more than predicting; a device's memory does not hold the process."""
    cpu, cuda = footprint(name, "cpu", steps), footprint(name, "cuda", steps)
    assert cpu.fixed > PROCESS and cpu.per_view > 0 and cuda.per_view > 0
    assert cuda.fixed < cpu.fixed or cuda.measured
    for views in (2, 8, 40, 128):
        assert footprint(name, "cpu", 0).bytes(views, 50_000) <= cpu.bytes(views, 50_000)


def test_footprints_are_those_of_the_tables() -> None:
    """Measured where the network could be; else its own tensors beside what all the rest takes."""
    for mode, steps in (("forward", 0), ("optimised", 40)):
        for dtype in ("bfloat16", "float32"):
            found = footprint("sweep", "cpu", steps, dtype)
            assert (found.fixed, found.per_view, found.per_step) == FITS["sweep", f"cpu:{dtype}", mode]
            assert found.measured == "cpu"
            there = footprint("sweep", "cuda", steps, dtype)
            assert (there.fixed + PROCESS, there.per_view) == (found.fixed, found.per_view)
            assert not there.measured
        for (name, where, of), counts in COUNTS.items():
            if (of != "forward") != bool(steps):
                continue
            device, dtype = where.split(":")
            found = footprint(name, device, steps, dtype, recompute=of == "recomputed")
            rest, process = FITS["pipeline", "cpu", mode], PROCESS if device == "cuda" else 0
            sums = [c + r for c, r in zip(counts, (rest[0] - process, *rest[1:]), strict=True)]
            assert [found.fixed, found.per_view, found.per_step] == pytest.approx(sums)
            assert found.fixed > counts[0] > 0
    assert not footprint("vggt", "cuda", 40).measured
    assert footprint("vggt-commercial", "cpu", 40) == footprint("vggt", "cpu", 40)


def test_bfloat16_takes_less_than_float32() -> None:
    """What the embedded network keeps of a view is mostly float32 in both; steps hold products, too."""
    for name in ("vggt", "pi3", "da3", "da3-small", "sweep"):
        for steps in (40,) if name == "sweep" else (0, 40):
            half, whole = (footprint(name, "cpu", steps, dtype) for dtype in ("bfloat16", "float32"))
            assert half.bytes(10, 200_000) < whole.bytes(10, 200_000) < 2 * half.bytes(10, 200_000)


def test_tensors_on_cuda_are_counted_as_on_cuda() -> None:
    """On a CPU attention is computed in float32, and kernels copy operands."""
    for name in ("vggt", "pi3"):
        cpu, cuda = (footprint(name, device, 40, "bfloat16") for device in ("cpu", "cuda"))
        assert 1.2 < cpu.per_view / cuda.per_view < 1.5
        cpu, cuda = (footprint(name, device, 0, "float32") for device in ("cpu", "cuda"))
        assert cpu.per_view == cuda.per_view


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_computing_activations_again_takes_a_fraction_of_the_memory(device: str) -> None:
    for name in ("vggt", "pi3"):
        for dtype in ("bfloat16", "float32"):
            kept, again = (footprint(name, device, 40, dtype, recompute=r) for r in (False, True))
            assert 5 < kept.per_view / again.per_view < 20
            assert footprint(name, device, 0, dtype, recompute=True) == footprint(name, device, 0, dtype)
    assert footprint("sweep", device, 40, recompute=True) == footprint("sweep", device, 40)


def test_activations_are_computed_again_where_more_views_fit_so() -> None:
    pixels = 518 * 392
    kept = footprint("vggt", "cuda", 40)
    enough = round(kept.bytes(40, pixels) / SHARE) + 1000
    for free, auto in ((enough, False), (enough // 2, True)):
        room = (40, pixels, free)
        assert recomputed("vggt", "cuda", 40, room, "auto") is auto
        assert recomputed("vggt", "cuda", 40, room, "always") and not recomputed(
            "vggt", "cuda", 0, room, "always"
        )
        assert not recomputed("vggt", "cuda", 40, room, "never")
        assert not recomputed("sweep", "cuda", 40, room, "always")
    less = footprint("vggt", "cuda", 40, recompute=True)
    card = 24 * 10**9
    assert chunk_limit(kept, pixels, card, 40) < 10 and chunk_limit(less, pixels, card, 40) == 40


def ring(count: int) -> np.ndarray:
    """Shared points of views on a circle: each with the next two on either side."""
    away = np.abs(np.arange(count)[:, None] - np.arange(count)[None])
    away = np.minimum(away, count - away)
    return np.where((away > 0) & (away < 3), 30 - 10 * away, 0).astype(np.int64)


class Memory:
    """Work that fits up to some views, and what was asked of it."""

    def __init__(self, fits: int, error: type[Exception] = MemoryError, text: str = "") -> None:
        self.fits, self.error, self.text = fits, error, text
        self.tried: list[int] = []
        self.released = 0

    def work(self, chunk: Chunk) -> tuple[int, ...]:
        self.tried.append(len(chunk.views))
        if len(chunk.views) > self.fits:
            raise self.error(self.text)
        return chunk.owned

    def release(self) -> None:
        self.released += 1


@pytest.mark.parametrize("size", [24, 10, 5])
@pytest.mark.parametrize("fits", [2, 3, 5, 100])
def test_every_view_is_done_once_whatever_fits(fits: int, size: int) -> None:
    common, memory = ring(24), Memory(fits)
    done = list(
        within_memory(plan_chunks(common, size).chunks, common, memory.work, lambda: 1000, memory.release)
    )
    assert sorted(view for attempt in done for view in attempt.chunk.owned) == list(range(24))
    assert all(attempt.result == attempt.chunk.owned and not attempt.why for attempt in done)
    assert all(len(attempt.chunk.views) >= 2 for attempt in done)
    failures = sum(count > fits for count in memory.tried)
    assert memory.released == failures <= 4  # once for each halving, not for each chunk


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (MemoryError, ""),
        (
            RuntimeError,
            "[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory: 12 bytes",
        ),
    ],
)
def test_views_that_cannot_be_done_at_all_are_given_up_with_the_reason(
    error: type[Exception], text: str
) -> None:
    common, memory = ring(6), Memory(1, error, text)
    done = list(within_memory(plan_chunks(common, 6).chunks, common, memory.work, lambda: 6, memory.release))
    assert sorted(view for attempt in done for view in attempt.chunk.owned) == list(range(6))
    assert all(
        attempt.result is None and "out of memory even with one other view" in attempt.why for attempt in done
    )
    assert all((text or error.__name__)[:100] in attempt.why for attempt in done)


def test_chunks_follow_the_memory_that_is_free_when_their_turn_comes() -> None:
    common, memory = ring(24), Memory(100)
    free = iter([24, 4])
    plan = plan_chunks(common, 12).chunks
    assert len(plan) > 1
    latest = [24]

    def most() -> int:
        latest[0] = next(free, latest[0])
        return latest[0]

    done = list(within_memory(plan, common, memory.work, most, memory.release))
    assert memory.tried[0] == 12 and set(memory.tried[1:]) <= {2, 3, 4} and not memory.released
    assert sorted(view for attempt in done for view in attempt.chunk.owned) == list(range(24))


def test_other_errors_are_not_taken_for_want_of_memory() -> None:
    common = ring(6)
    memory = Memory(1, RuntimeError, "shapes do not match")
    with pytest.raises(RuntimeError, match="shapes"):
        list(within_memory(plan_chunks(common, 6).chunks, common, memory.work, lambda: 6, memory.release))


def test_a_real_allocation_that_fails_is_survived() -> None:
    """The allocator's own error, with what was held before it freed again."""
    import torch

    common, held = ring(8), []

    def work(chunk: Chunk) -> int:
        if len(chunk.views) > 4:
            held.append(torch.zeros(10))
            torch.empty(1 << 60, dtype=torch.uint8)
        return len(chunk.views)

    done = list(within_memory(plan_chunks(common, 8).chunks, common, work, lambda: 8, held.clear))
    assert not held and all(attempt.result for attempt in done)


class Ring:
    """An object that holds itself, so that only a search for cycles frees it."""

    def __init__(self) -> None:
        self.me = self


def test_cycles_are_searched_for_after_the_block_and_not_in_it() -> None:
    assert gc.isenabled()
    with pytest.raises(ValueError, match="any"), cycles_left():
        ring = weakref.ref(Ring())
        many = [[] for _ in range(200_000)]  # enough to begin a search of all generations
        assert ring() is not None and len(many) == 200_000 and not gc.isenabled()
        raise ValueError("any")
    assert gc.isenabled()
    gc.disable()
    try:
        with cycles_left():
            pass
        assert not gc.isenabled()  # as whoever called had it
    finally:
        gc.enable()
