"""One run at a time on a workspace, whatever happened to the one before."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from colmap_tco.errors import InputError
from colmap_tco.lock import lock_file, locked

ROOT = Path(__file__).resolve().parents[2]
HOLD = """
import sys, time
from pathlib import Path
from colmap_tco.lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def holder(root: Path) -> subprocess.Popen[str]:
    """Another process that holds the lock until its input ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(root)],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


def test_a_second_process_is_refused_and_told_who_has_it(tmp_path: Path) -> None:
    with holder(tmp_path) as process:
        told = f"another run is working on {tmp_path}.*process {process.pid} on "
        with pytest.raises(InputError, match=told), locked(tmp_path):
            raise AssertionError("two hold the lock")
        assert lock_file(tmp_path).exists()  # the one who was refused removed nothing
        process.communicate("")
    with locked(tmp_path):
        assert lock_file(tmp_path).read_text().startswith(f"process {os.getpid()} on ")
    assert list(tmp_path.iterdir()) == []


def test_the_lock_of_a_killed_process_is_taken_over(tmp_path: Path) -> None:
    with holder(tmp_path) as process:
        process.send_signal(signal.SIGKILL)
    assert lock_file(tmp_path).exists()
    with locked(tmp_path):
        assert str(os.getpid()) in lock_file(tmp_path).read_text()
    assert not lock_file(tmp_path).exists()


def test_the_lock_ends_with_the_block_also_by_an_error(tmp_path: Path) -> None:
    for _ in range(2):
        with pytest.raises(KeyError), locked(tmp_path):
            raise KeyError
    assert not lock_file(tmp_path).exists()


def test_workspaces_do_not_hinder_each_other(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with locked(tmp_path / "a"), locked(tmp_path / "b"):
        assert lock_file(tmp_path / "a").exists() and lock_file(tmp_path / "b").exists()
        with pytest.raises(InputError), locked(tmp_path / "a"):
            pass


def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path: Path) -> None:
    told = r"nowhere cannot be written to .*copy the workspace"
    with pytest.raises(InputError, match=told), locked(tmp_path / "nowhere"):
        pass
