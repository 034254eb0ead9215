"""Open3D, which needs system libraries that a bare machine lacks."""

from __future__ import annotations

from typing import Any

from colmap_tco.errors import MissingError


def open3d() -> Any:
    """The module, with its own messages silenced below errors.

    Raises:
        MissingError: it cannot be imported; the message says what is missing.
    """
    try:
        import open3d as module
    except (ImportError, OSError) as error:
        raise MissingError(
            f"Open3D cannot be imported ({error}). If it is a system library that is not there: on Debian "
            "apt install libx11-6 libgl1 libusb-1.0-0 libgomp1; else: pip install open3d"
        ) from error
    module.utility.set_verbosity_level(module.utility.VerbosityLevel.Error)
    return module
