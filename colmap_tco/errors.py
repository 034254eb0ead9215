"""What can go wrong, each with the exit code of the command line.

A message names the file or option, the cause, and what to do about it.
"""

from __future__ import annotations


class DensifyError(Exception):
    """Any failure that the user can act on."""

    exit_code = 1


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
