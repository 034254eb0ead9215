"""Compiled loops need a folder, also where nothing beside the package can be written."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from colmap_tco.kernel_cache import VARIABLE, ensure_kernel_cache

ROOT = Path(__file__).resolve().parents[2]

RUN = """
import os, pathlib, sys
import numba, numba.core.caching
from colmap_tco.kernel_cache import ensure_kernel_cache
numba.njit(lambda x: x + 1)(1)  # imports what the user below may not be allowed to read
package = pathlib.Path(sys.argv[1])
os.setgid(65534)
os.setuid(65534)
if sys.argv[2] == "help":
    ensure_kernel_cache(package)
    numba.config.reload_config()
sys.path.insert(0, str(package))
import loop
print(loop.twice(4))
"""


def test_a_folder_that_can_be_written_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    ensure_kernel_cache(tmp_path)
    assert VARIABLE not in os.environ
    monkeypatch.setenv(VARIABLE, "mine")
    ensure_kernel_cache(tmp_path / "absent")
    assert os.environ[VARIABLE] == "mine"


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can give up its rights")
@pytest.mark.parametrize("help", ["help", "none"])
def test_loops_compile_where_nothing_can_be_written(help: str) -> None:
    """As in a container with a read-only file system and no home; without help, numba gives up."""
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder)
        (package / "loop.py").write_text(
            "from numba import njit\n@njit(cache=True)\ndef twice(x):\n    return 2 * x\n", "utf-8"
        )
        package.chmod(0o555)
        keep = {k: v for k, v in os.environ.items() if k not in (VARIABLE, "XDG_CACHE_HOME")}
        done = subprocess.run(
            [sys.executable, "-B", "-c", RUN, folder, help],
            env=keep | {"HOME": "/nonexistent"},
            cwd=ROOT, capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
    if help == "help":
        assert done.stdout.strip() == "8", done.stderr
    else:
        assert "no locator available" in done.stderr
