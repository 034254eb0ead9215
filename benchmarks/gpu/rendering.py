"""Render training samples on many processor cores, alone or beside something that runs on the GPU."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def rendering(
    folder: Path, shape: tuple[int, int], cores: int, views: int = 6, most: int = 1_000_000
) -> Iterator[None]:
    """Processes that render into a folder while the block runs.

    Args:
        folder: of the samples; those that are there are skipped, half-written ones removed at the end.
        shape: (H, W).
        cores: processes; number k makes samples from number 1,000,000 · (1 + k) on. 0: none.
        views: of each sample.
        most: samples of all processes together.
    """
    folder.mkdir(parents=True, exist_ok=True)
    one = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "training.dataset", "--out", str(folder)]
    command += ["--count", str(-(-most // max(1, cores))), "--views", str(views), "--shape", *map(str, shape)]
    running = [
        subprocess.Popen([*command, "--start", str(1_000_000 * (1 + k))], env=one) for k in range(cores)
    ]
    try:
        yield
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait()
        for part in folder.glob("*.part"):
            part.unlink()


def wait_for(folder: Path, samples: int, minutes: float) -> int:
    """Wait until a folder has so many samples, or for so many minutes; how many there are."""
    end = time.monotonic() + 60 * minutes
    while (have := len(list(folder.glob("*.npz")))) < samples and time.monotonic() < end:
        time.sleep(0.5)
    return have
