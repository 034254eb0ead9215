"""Where the bar stands while a chunk is worked on, and what an interruption leaves and says."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from colmap_tco.chunks import Chunk
from colmap_tco.chunkwise import Pace, progress_told
from colmap_tco.progress import Progress
from colmap_tco.resume import Origin, open_result
from tco.options import PolishConfig, TCOConfig

KEY = Origin({"seed": 0}, {})


@pytest.mark.parametrize(("steps", "polish"), [(5, 8), (3, 0), (1, 1)])
def test_the_steps_of_a_chunk_lead_to_its_views(steps: int, polish: int) -> None:
    """From the views of the chunks before to those of this one, never backwards."""
    progress = Progress()
    progress.stage("optimisation", 60)
    progress.reach(20)
    config = TCOConfig(steps=steps, polish=PolishConfig(polish_looks=polish))
    pace = Pace(Chunk(tuple(range(12)), (12, 13, 14)), config, progress)
    seen = [progress.done]
    for _ in range(config.all_steps(12)):
        pace.step({"loss": 1.0})
        seen.append(progress.done)
    assert seen == sorted(seen) and len(set(seen)) == len(seen)
    assert seen[0] == 20 and 20 < seen[1] < 32
    if polish:
        assert seen[-1] == pytest.approx(32)


def test_an_interruption_says_what_is_finished(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    result = open_result(tmp_path, KEY)
    result.mark_done({"a": {}, "b": {}})
    with caplog.at_level(logging.WARNING), pytest.raises(KeyboardInterrupt), progress_told(result, 7):
        raise KeyboardInterrupt
    assert "2 of 7 views are finished" in caplog.text


def test_a_run_goes_on_with_the_chunks_that_were_planned(tmp_path: Path) -> None:
    """The memory that is free now does not decide what an earlier run has begun; another key forgets it."""
    result = open_result(tmp_path, KEY)
    assert result.chunk_size(40) == 40
    result.mark_done({"a": {}})
    assert open_result(tmp_path, KEY).chunk_size(25) == 40
    assert open_result(tmp_path, Origin({"seed": 1}, {})).chunk_size(25) == 25
