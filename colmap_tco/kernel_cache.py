"""Where compiled loops are kept between runs."""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import sys
import tempfile
from pathlib import Path

log = logging.getLogger(__name__)

VARIABLE = "NUMBA_CACHE_DIR"


def ensure_kernel_cache(packages: Path = Path(__file__).resolve().parent) -> None:
    """Give numba a folder for compiled code where it has none, which it would end the run for.

    It keeps the code beside the package or, where that is read-only, in the user's cache folder. Where
    neither can be written (a container with a read-only file system and no home), the code goes into a
    temporary folder that is removed at the end: a shared one could be filled by others. To be called
    before a module with compiled loops is imported.

    Args:
        packages: a folder of the package.
    """
    if os.environ.get(VARIABLE) or any(map(_writable, (packages / "__pycache__", _user_cache()))):
        return
    folder = tempfile.mkdtemp(prefix="colmap-tco-kernels-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ[VARIABLE] = folder
    log.warning(
        "neither %s nor %s can be written, so that loops are compiled anew in every run: set %s to a "
        "folder of your own to keep them", packages, _user_cache(), VARIABLE,
    )  # fmt: skip


def _user_cache() -> Path:
    """Where numba keeps compiled code of packages that are read-only."""
    if sys.platform == "darwin":
        return Path("~/Library/Caches/numba").expanduser()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or "~/AppData/Local").expanduser() / "numba"
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "numba"


def _writable(folder: Path) -> bool:
    """Whether files can be made in a folder, or it can be made."""
    there = next(place for place in (folder, *folder.parents) if place.exists())
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)
