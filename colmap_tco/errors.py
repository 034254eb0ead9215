"""What can go wrong, each with the exit code of the command line.

A message names the file or option, the cause, and what to do about it.
"""

from __future__ import annotations


class DensifyError(Exception):
    """Any failure that the user can act on."""

    exit_code = 1


class UsageError(DensifyError):
    """A command line or a setting that cannot be understood."""

    exit_code = 2


class InputError(DensifyError):
    """Images, model or masks that cannot be used as they are."""

    exit_code = 3


class OutOfMemoryError(DensifyError):
    """Not enough memory, even for the smallest chunk."""

    exit_code = 4


class MissingError(DensifyError):
    """Weights or a device that were asked for and are not there."""

    exit_code = 5


class PartlyDoneError(DensifyError):
    """Some views failed; the others were written."""

    exit_code = 6


def is_out_of_memory(error: BaseException) -> bool:
    """Whether ``error`` is one of the ways in which Python, numpy, torch and OpenCV run out of memory.

    Torch is not imported to find out: its CUDA error is known by its name, and its CPU allocator, its
    libraries and OpenCV raise general errors that only their texts tell apart.
    """
    if isinstance(error, MemoryError):
        return True
    if any(cls.__name__ == "OutOfMemoryError" for cls in type(error).__mro__):
        return True
    text = str(error).lower()
    return any(words in text for words in NO_MEMORY)


NO_MEMORY = ("can't allocate memory", "insufficient memory", "out of memory", "bad_alloc", "alloc_failed")
"""Of PyTorch's CPU allocator, OpenCV, the drivers of devices, C++, cuBLAS and cuDNN, in small letters."""
