"""A small command for the tests of the command line: it fails in the way that it is asked to."""

from __future__ import annotations

import errno
import os
import signal
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

from colmap_tco import _pycolmap
from colmap_tco.errors import InputError, MissingError, OutOfMemoryError, PartlyDoneError
from colmap_tco.progress import Progress
from tco.config import knob


@dataclass(frozen=True)
class OptimiseConfig:
    """Optimisation."""

    steps: int = knob(40, "number of steps; 0 is feed-forward")
    rate: float = knob(5e-4, "learning rate")


@dataclass(frozen=True)
class ExampleConfig:
    """What the example does."""

    failure: str = knob(
        "none",
        "how to fail",
        choices=("none", "interrupt", "terminate", "terminate with COLMAP", "environment", *"abcdefgh"),
    )
    mask_path: Path | None = knob(None, "folder of masks")
    overwrite: bool = knob(False, "replace earlier results")
    optimise: OptimiseConfig = OptimiseConfig(steps=7)

    def __post_init__(self) -> None:
        if self.optimise.steps < 0:
            raise ValueError(f"--steps must not be negative, it is {self.optimise.steps}")


@dataclass(frozen=True)
class Result:
    """What was asked for."""

    workspace: Path
    config: ExampleConfig

    def summary(self) -> str:
        """One line."""
        return f"{self.workspace} {self.config.optimise.steps} {self.config.overwrite}"


class Environment:
    """What OpenMP is told, and whether torch is there already."""

    def summary(self) -> str:
        """One line."""
        policy, spins = map(os.environ.get, ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"))
        return f"{policy} {spins} {'torch' in sys.modules}"


ERRORS: dict[str, Exception] = {
    "a": InputError("images/0.jpg is truncated: copy it again"),
    "b": OutOfMemoryError("a chunk of one view does not fit"),
    "c": MissingError("weights vggt.safetensors are not there: download them"),
    "d": PartlyDoneError("1 of 3 views failed"),
    "e": ZeroDivisionError("division by zero"),
    "f": MemoryError(),
    "g": RuntimeError("DefaultCPUAllocator: can't allocate memory"),
    "h": OSError(errno.EROFS, "Read-only file system", "scene/mesh.ply"),
}


def run(workspace: Path, config: ExampleConfig, progress: Progress) -> Result | Environment:
    """Report progress, warn, then succeed or fail as the configuration says."""
    progress.stage("work", 2)
    progress.advance(1, loss=0.5)
    warnings.warn("the sky is falling", stacklevel=1)
    if config.failure == "environment":
        return Environment()
    if config.failure == "interrupt":
        os.kill(os.getpid(), signal.SIGINT)
    if config.failure == "terminate with COLMAP":
        _pycolmap.load()
    if config.failure.startswith("terminate"):
        os.kill(os.getpid(), signal.SIGTERM)
    if config.failure in ERRORS:
        raise ERRORS[config.failure]
    return Result(workspace, config)
