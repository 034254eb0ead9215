"""What a machine may lack: tests that need it are skipped, with the reason."""

from __future__ import annotations

from typing import Any

import pytest

from colmap_tco._open3d import open3d
from colmap_tco.errors import MissingError


def imported_open3d() -> Any:
    """Open3D, or the test or module is skipped."""
    try:
        return open3d()
    except MissingError as error:
        pytest.skip(str(error), allow_module_level=True)
