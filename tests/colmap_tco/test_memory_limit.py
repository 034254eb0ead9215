"""A process that may not have more memory goes on with smaller chunks, also with the network adapted."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from colmap_tco.errors import is_out_of_memory

if TYPE_CHECKING:
    from tests.conftest import Room

ROOT = Path(__file__).resolve().parents[2]
FLAGS = (
    "--max_image_size", "256", "--chunk_size", "8", "--device", "cpu", "--steps", "1", "--polish_looks", "1",
    "--num_threads", "1", "--no-report_page",
)  # fmt: skip

LIMITED = """
import resource, sys
import torch
from colmap_tco.cli import main
from tco import optimize

polish = optimize.polish

def starved(prediction, *others):
    if len(prediction.depth) <= 4:
        return polish(prediction, *others)
    before = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(open("/proc/self/statm").read().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize(), before[1]))
    held = []
    try:
        while True:
            try:
                held.append(torch.empty(1 << 20, dtype=torch.uint8))
            except RuntimeError:
                break
        return polish(prediction, *others)
    finally:
        held.clear()
        resource.setrlimit(resource.RLIMIT_AS, before)

optimize.polish = starved
sys.exit(main(sys.argv[1:]))
"""
"""More than four views find the address space of the process full when their depths are to be refined."""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux limits the address space so")
def test_an_allocation_that_fails_on_the_depths_leads_to_smaller_chunks(fresh_room: Room) -> None:
    words = ["densify", str(fresh_room.root), *FLAGS]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *words],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "out of memory with 7 views" in done.stderr and "on with 3" in done.stderr
    report = json.loads((fresh_room.root / "dense-tco" / "report.json").read_text("utf-8"))
    assert report["images"]["used"] == len(fresh_room.names)
    assert all(chunk["reduced"] and len(chunk["views"]) <= 3 for chunk in report["chunks"])
    count = len(report["chunks"])
    assert (
        f"the memory was too little for the planned groups of views: {count} smaller ones"
        in done.stdout + done.stderr
    )
    # The views were not only decoded but went through both kinds of steps.
    assert all({"photometric", "warped"} <= set().union(*map(set, loss)) for loss in report["loss"])


@pytest.mark.parametrize(
    "text",
    [
        "[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: you tried",
        "CUDA out of memory. Tried to allocate 2.00 GiB",
        "CUDA error: out of memory",
        "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`",
        "cuDNN error: CUDNN_STATUS_ALLOC_FAILED",
        "std::bad_alloc",
        "MPS backend out of memory (MPS allocated: 9.0 GB)",
        "OpenCV(5.0.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 7 bytes",
    ],
)
def test_want_of_memory_is_known_by_what_libraries_say(text: str) -> None:
    assert is_out_of_memory(RuntimeError(text))
    assert not is_out_of_memory(RuntimeError("shapes do not match"))
