"""What a user sees while a run goes on: how far it is, the loss, and the time that is left."""

from __future__ import annotations

import logging
import re
import time

import pytest

from colmap_tco.progress import Progress, clock, remaining


def test_the_bar_shows_stage_steps_loss_and_time_left(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(bar=True) as progress:
        progress.plan({"read": 1, "optimise": 4})
        progress.stage("read", 1)
        progress.advance(1)
        progress.stage("optimise", 4)
        for loss in (0.5, 0.25):
            time.sleep(0.15)  # a bar is drawn at most ten times a second
            progress.advance(1, loss=loss, held_out=0.01)
    frames = [frame for frame in capsys.readouterr().err.split("\r") if "optimise" in frame]
    drawn = re.search(r"optimise 2/4 +60%\|.*\| (\S+), about (\S+) s left(.*)", frames[-1])
    assert drawn is not None, frames
    assert "loss=0.25" in drawn[3]
    assert "held_out=0.01" in drawn[3]


def test_lines_hold_the_same_for_a_log(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "colmap_tco.progress"), Progress(interval=0) as progress:
        progress.stage("optimise", 4)
        time.sleep(0.01)
        progress.advance(1, loss=0.5)
    record = caplog.records[-1]
    assert re.fullmatch(r"optimise 1/4, loss 0\.5, about \d+ s left", record.getMessage())
    assert record.__dict__["data"]["values"] == {"loss": 0.5}
    assert record.__dict__["data"]["fraction"] == 0.25


def test_a_slow_start_does_not_frighten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is foretold from imports, nor from a first step that compiles; then the pace decides."""
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    progress = Progress()
    progress.plan({"read": 2, "optimise": 80, "fuse": 18})
    progress.stage("read", 1)
    now = 20.0
    progress.stage("optimise", 50)
    assert progress.seconds_left is None
    now = 50.0
    progress.advance(1)
    assert progress.seconds_left is None
    now = 53.0
    progress.advance(3)
    assert progress.seconds_left == pytest.approx(46 + 50 * 18 / 80)
    now = 99.0
    progress.advance(46)
    progress.stage("fuse", 1)
    assert progress.seconds_left == pytest.approx(99 * 18 / 82)


def test_time_left_is_in_proportion() -> None:
    assert remaining(30, 0.25) == 90
    assert remaining(30, 0) is None
    assert [clock(s) for s in (45, 180, 3900)] == ["45 s", "3 min", "1 h 05 min"]
