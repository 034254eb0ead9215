"""Python's handlers of signals, kept where a library would put its own in their place."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def sigterm_kept() -> Iterator[None]:
    """Leave SIGTERM as it is, whatever is imported inside the block.

    glog's handler, which pycolmap installs, prints a stack trace before the process ends. If the signal comes
    while memory is being allocated that waits for ever, and nothing is tidied up in any case. In another
    thread than the main one handlers cannot be set, and nothing is done.
    """
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if before is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)
