"""One run at a time on a workspace.

The lock is the kernel's (``flock``) on ``<workspace>/.dense-tco.lock``, so that it ends with the process
that holds it, however that ends; the file that a killed run leaves behind stops nobody. The file holds
the process id for the message alone.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from colmap_tco.errors import InputError

log = logging.getLogger(__name__)


def lock_file(root: Path) -> Path:
    """Where the lock of a workspace is while a run works on it."""
    return root / ".dense-tco.lock"


@contextmanager
def locked(root: Path) -> Iterator[None]:
    """Hold the workspace for the time of the block; the lock file is removed at its end.

    Raises:
        InputError: another process holds it, or nothing can be written to the folder.
    """
    path = lock_file(root)
    descriptor = _acquire(path)
    try:
        yield
    finally:
        # Removed before it is released: whoever opens the path from now on gets a file of their own,
        # and whoever had it open sees in _acquire that it is no longer the one at the path.
        path.unlink(missing_ok=True)
        os.close(descriptor)


def _acquire(path: Path) -> int:
    """An open descriptor of the file at ``path`` that holds its lock."""
    while True:
        try:
            descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        except OSError as error:
            raise InputError(
                f"{path.parent} cannot be written to ({error.strerror}), and the result goes there; "
                "copy the workspace to a folder of yours"
            ) from error
        if not _lock(descriptor):
            holder = os.read(descriptor, 200).decode("utf-8", "replace").strip()
            os.close(descriptor)
            raise InputError(
                f"another run is working on {path.parent} ({holder or 'it has just begun'}); wait until it "
                "ends, or stop it"
            )
        if _is_at(descriptor, path):
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
            return descriptor
        os.close(descriptor)  # its holder removed it between our two calls


def _lock(descriptor: int) -> bool:
    """Take the lock without waiting; False if another process has it.

    Some network file systems have no locks, and Windows has no flock; the run goes on without, and says so.
    """
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError) as error:
        log.warning("this file system has no locks (%s): start no second run on this workspace", error)
    return True


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether the open file is still the one that the path names."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False
