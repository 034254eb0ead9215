"""The files of a COLMAP model as bytes: what is missing, what was cut off.

COLMAP's reader does not look whether a file is complete: on a cut points3D.bin it allocates until the
memory is full, which takes minutes and ends in an error that names nothing.
"""

from __future__ import annotations

from pathlib import Path

NAMES = ("cameras", "images", "points3D")
KINDS = (".bin", ".txt")


def kind_of(folder: Path) -> str:
    """Suffix of the files that COLMAP's reader takes: binary if there are any."""
    return ".bin" if (folder / "cameras.bin").is_file() else ".txt"


def missing(folder: Path) -> list[str]:
    """Names of the files that a model needs and the folder lacks."""
    suffix = kind_of(folder)
    return [name + suffix for name in NAMES if not (folder / (name + suffix)).is_file()]


def cut_off(folder: Path) -> str:
    """The binary file that ends before its last entry; empty if none does."""
    if kind_of(folder) == ".bin":
        for name, ends_early in (("images", _images_end_early), ("points3D", _points_end_early)):
            if ends_early((folder / f"{name}.bin").read_bytes()):
                return f"{name}.bin"
    return ""


def sizes(folder: Path) -> str:
    """The files and their sizes, for a message."""
    files = [folder / (name + kind_of(folder)) for name in NAMES]
    return ", ".join(f"{file.name} {file.stat().st_size} bytes" for file in files)


def _images_end_early(data: bytes) -> bool:
    """Whether images.bin is shorter than its counts say (``scene/reconstruction_io_binary.cc``)."""
    at = 8
    for _ in range(int.from_bytes(data[:8], "little") if len(data) >= 8 else 1):
        at = data.find(b"\0", at + 64) + 1  # id, quaternion, translation and camera, then the name
        if not 0 < at <= len(data) - 8:
            return True
        at += 8 + 24 * int.from_bytes(data[at : at + 8], "little")
    return at > len(data)


def _points_end_early(data: bytes) -> bool:
    """Whether points3D.bin is shorter than its counts say."""
    at = 8
    for _ in range(int.from_bytes(data[:8], "little") if len(data) >= 8 else 1):
        at += 51  # id, position, colour, error and track length, then the track
        if at > len(data):
            return True
        at += 8 * int.from_bytes(data[at - 8 : at], "little")
    return at > len(data)
