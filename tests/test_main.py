"""How the program ends: at once, but not before what others wait for."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

BEFORE = """
import atexit, os, sys, threading
from colmap_tco.__main__ import run

class Told:
    def __del__(self, write=os.write):
        write(1, b"taken apart")

held = Told()
atexit.register(print, "registered")
"""


def ended(*lines: str) -> subprocess.CompletedProcess[str]:
    """A program that prepares the end and then checks a workspace that is not there."""
    command = [sys.executable, "-c", program(*lines)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)


def program(*lines: str) -> str:
    """Its text."""
    return "\n".join([BEFORE, *lines, "sys.argv[1:] = ['check', 'no such folder']", "run()"])


def test_what_is_registered_for_the_end_is_done_and_nothing_is_taken_apart() -> None:
    done = ended("print('printed', end='')")
    assert done.returncode == 3
    assert done.stdout == "printedregistered\n"
    assert "no such folder" in done.stderr


def test_a_thread_that_still_works_is_waited_for() -> None:
    done = ended("threading.Thread(target=lambda: (threading.main_thread().join(), print('worked'))).start()")
    assert done.returncode == 3
    assert done.stdout.splitlines() == ["worked", "registered", "taken apart"], "in Python's own way"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_what_cannot_be_written_is_an_error() -> None:
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-c", program("print('printed')")]
        buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
        done = subprocess.run(
            command, cwd=ROOT, env=buffered, stdout=full, stderr=subprocess.DEVNULL, check=False, timeout=120
        )
    assert done.returncode == 120, "as Python has it"


def test_without_an_output_it_ends_as_with_one() -> None:
    done = ended("sys.stdout = None")
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
