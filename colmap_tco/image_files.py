"""Files of pictures: which there are, whether they are whole, and their pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_tco.errors import InputError

PICTURES = frozenset([".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".jp2", ".pgm", ".ppm"])
"""Endings of files that COLMAP and OpenCV read."""

OTHERS = frozenset(
    [".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef"]
)
"""Endings of pictures that they do not read: those of phones, and raw ones."""


def list_images(folder: Path, recursive: bool = True) -> list[str]:
    """Names of the pictures below a folder, relative to it, with forward slashes, sorted."""
    return _names(folder, recursive, PICTURES)


def other_formats(folder: Path, recursive: bool = True) -> dict[str, str]:
    """Name → why it is not used, of the pictures below a folder that are of :data:`OTHERS`.

    Those beside a picture of the same name are left out: cameras write both, and who converts keeps both.
    """
    usable = {name.rpartition(".")[0].lower() for name in list_images(folder, recursive)}
    return {
        name: f"COLMAP reads no {name.rpartition('.')[2].upper()}; convert it to JPEG"
        for name in _names(folder, recursive, OTHERS)
        if name.rpartition(".")[0].lower() not in usable
    }


def _names(folder: Path, recursive: bool, endings: frozenset[str]) -> list[str]:
    files = folder.rglob("*") if recursive else folder.iterdir()
    names = (path.relative_to(folder) for path in files if path.suffix.lower() in endings and path.is_file())
    return sorted(name.as_posix() for name in names if not any(part.startswith(".") for part in name.parts))


def decoded_size(path: Path) -> tuple[int, int]:
    """(width, height) as stored, after reading the file to its end.

    Raises:
        InputError: truncated, or no picture that can be read.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            size = image.size
            image.draft("RGB", (image.width // 8, image.height // 8))
            image.load()
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path}: cannot be decoded ({error}); copy it again or convert it") from error
    return size


def read_image(path: Path) -> NDArray[np.uint8]:
    """RGB (H, W, 3), pixels as stored: EXIF orientation ignored, as COLMAP does.

    Raises:
        InputError: the file is missing or cannot be decoded.
    """
    import cv2

    bgr = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if bgr is None:
        raise InputError(f"{path}: missing or not a picture that can be decoded; convert it to JPEG or PNG")
    return np.ascontiguousarray(bgr[..., ::-1])
