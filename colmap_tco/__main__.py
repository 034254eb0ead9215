"""The program: ``colmap-tco``, and ``python -m colmap_tco``."""

from __future__ import annotations

import atexit
import os
import sys
import threading
from typing import NoReturn

from colmap_tco.cli import main


def run() -> NoReturn:
    """Run the command line and end with its exit code, without taking apart what the system frees at once.

    Of torch's and numba's modules and of their memory that takes Python a second. What is registered for the
    end (:mod:`atexit`) is done, and what was printed is written. Where another thread still works, or a
    stream cannot be written, Python ends in its own way. What watches a program from around it, such as
    ``python -m cProfile``, should call :func:`colmap_tco.cli.main` instead.
    """
    code = main()
    working = [t for t in threading.enumerate() if t is not threading.current_thread() and not t.daemon]
    if working or not _flushed():
        sys.exit(code)
    atexit._run_exitfuncs()
    if not _flushed():
        sys.exit(code)
    os._exit(code)


def _flushed() -> bool:
    """Write what is buffered; whether that worked."""
    try:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:  # as in a process that was given none
                stream.flush()
    except (OSError, ValueError):
        return False
    return True


if __name__ == "__main__":
    run()
