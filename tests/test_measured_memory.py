"""Memory that is measured is that of densify's own stage, which runs through on the made-up workspace."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.memory import MODES, measured

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells the peak")


@pytest.mark.parametrize("mode", ["forward", "optimised"])
@pytest.mark.parametrize("network", ["pipeline", "sweep"])
def test_the_stage_runs_and_its_peak_is_above_the_process(network: str, mode: str) -> None:
    """In a process of its own: one with much freed memory in hand may end with less than it began with."""
    peak, process = measured(network, ("cpu", "float32"), (3, 64, 48), mode)
    assert (peak.views, peak.pixels) == (3, 64 * 48) and MODES[mode] in (0, 1)
    assert peak.bytes >= process > 1e8
