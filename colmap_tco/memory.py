"""How much memory there is, how much a chunk takes, and so how many views fit.

The footprints are fits to measured peaks (``python -m benchmarks.memory``); nothing here imports torch
before it is asked about a device.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_tco import _footprints
from colmap_tco.views import View, canvas_size

if TYPE_CHECKING:
    import torch

SHARE = 0.7
"""Part of the free memory that a chunk may fill: other programs want some, and peaks vary."""
FEWEST_VIEWS = 2
"""Views of a chunk: one alone has nothing to be compared with."""


ESTIMATES: dict[tuple[str, str, str], tuple[float, float, float]] = {
    ("vggt", "float32", "forward"): (5.1e9, 2000.0, 5000.0),
    ("vggt", "float32", "optimised"): (5.1e9, 17300.0, 10000.0),
    ("vggt", "bfloat16", "forward"): (3.3e9, 2000.0, 5000.0),
    ("vggt", "bfloat16", "optimised"): (3.3e9, 10400.0, 10000.0),
    ("pi3", "float32", "forward"): (4.2e9, 2000.0, 5000.0),
    ("pi3", "float32", "optimised"): (4.2e9, 13000.0, 10000.0),
    ("pi3", "bfloat16", "forward"): (2.3e9, 2000.0, 5000.0),
    ("pi3", "bfloat16", "optimised"): (2.3e9, 7800.0, 10000.0),
    ("da3", "float32", "forward"): (1.1e9, 2000.0, 5000.0),
    ("da3", "float32", "optimised"): (1.1e9, 2900.0, 10000.0),
    ("da3", "bfloat16", "forward"): (0.95e9, 2000.0, 5000.0),
    ("da3", "bfloat16", "optimised"): (0.95e9, 2000.0, 10000.0),
    ("da3-small", "float32", "forward"): (0.7e9, 1000.0, 5000.0),
    ("da3-small", "float32", "optimised"): (0.7e9, 1450.0, 10000.0),
    ("da3-small", "bfloat16", "forward"): (0.65e9, 1000.0, 5000.0),
    ("da3-small", "bfloat16", "optimised"): (0.65e9, 1000.0, 10000.0),
}
"""Until ``benchmarks/memory.py`` was run for a network: its parameters, of those of the blocks half in
bfloat16, and the process; 360 bytes a pixel that each adapted block keeps in float32 (48 blocks for vggt, 36
for pi3), six tenths of it in bfloat16; the rest are guesses on the safe side. For da3 (8 adapted blocks, 768
channels; da3-small 384) they lie 1 to 18 % above the peaks of three views of 168×126 in float32 on a CPU."""


@dataclass(frozen=True)
class Footprint:
    """Peak bytes of predicting a chunk: fixed + pixels · (views · per_view + per_step).

    Attributes:
        fixed: the process with the network loaded.
        per_view: what stays for each view, bytes a pixel of the canvas.
        per_step: what one step or one decoding takes beside that, bytes a pixel of the canvas.
        measured: on what kind of device it was measured; empty if it is derived from another's or estimated.
    """

    fixed: float
    per_view: float
    per_step: float
    measured: str

    def bytes(self, views: int, pixels: int) -> int:
        """Peak of a chunk of so many views on a canvas of so many pixels."""
        return round(self.fixed + pixels * (views * self.per_view + self.per_step))

    def views(self, pixels: int, room: float) -> float:
        """How many views fit into so many bytes, not rounded and not limited."""
        return (room - self.fixed - pixels * self.per_step) / (pixels * self.per_view)


def footprint(network: str, device: str, steps: int) -> Footprint:
    """Of a network (a key of :data:`colmap_tco.published.NETWORKS`) on a kind of device.

    Args:
        network: its name.
        device: ``cpu``, ``cuda``, …. Where a network was not measured on it, it is taken to need there what
            it needs on the CPU, less the process, which is not in the device's memory.
            The type in which a device multiplies matrices counts: bfloat16 takes half of float32.
        steps: of optimisation; 0 takes less.
    """
    kind = network.removesuffix("-commercial")
    mode, dtype, fits = "optimised" if steps else "forward", _products(device), _footprints.FITS
    for place in (f"{device}:{dtype}", device):
        if (kind, place, mode) in fits:
            return Footprint(*fits[kind, place, mode], measured=place)
    elsewhere = [fits[kind, p, mode] for p in (f"cpu:{dtype}", "cpu") if (kind, p, mode) in fits]
    fixed, per_view, per_step = elsewhere[0] if elsewhere else ESTIMATES[kind, dtype, mode]
    process = 0.0 if device == "cpu" else _footprints.PROCESS
    return Footprint(max(0.0, fixed - process), per_view, per_step, measured="")


def _products(device: str) -> str:
    """The type in which published networks multiply matrices on a kind of device."""
    import torch

    from tco.backbones.transformer import compute_dtype

    if device == "cuda" and not torch.cuda.is_available():
        return "bfloat16"  # as on all cards since 2020
    return str(compute_dtype(torch.device(device))).removeprefix("torch.")


def chunk_limit(needs: Footprint, pixels: int, free: int, most: int) -> int:
    """Views a chunk on a canvas of so many pixels where so many bytes are free, from 2 to ``most``."""
    fitting = needs.views(pixels, SHARE * free)
    return int(min(max(fitting, FEWEST_VIEWS), most))


def canvas_pixels(views: Sequence[View]) -> int:
    """Pixels of the smallest canvas that holds all views."""
    height, width = canvas_size(views)
    return height * width


def free_memory(device: torch.device | str = "cpu") -> int:
    """Bytes that a chunk can have on a device, what this process holds for its networks included.

    CPU: what can be had without swapping, on Linux ``MemAvailable``, which, unlike the free pages, counts
    what the file cache would give back, or what the limit of a container leaves, if that is less; elsewhere
    half of what is installed. CUDA: what the driver says is free, and what PyTorch keeps in reserve.
    """
    kind = str(device).partition(":")[0]
    if kind == "cuda":
        import torch

        free, _ = torch.cuda.mem_get_info(device)
        return free + torch.cuda.memory_reserved(device)
    own = _resident()
    return own + min(_available(), _left_in_container())


def _available() -> int:
    meminfo = Path("/proc/meminfo")
    for line in meminfo.read_text().splitlines() if meminfo.is_file() else ():
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2


def _resident() -> int:
    """Bytes of this process that are in memory; 0 where the system does not say."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.is_file() else 0


def _left_in_container(root: Path = Path("/sys/fs/cgroup")) -> int:
    """Bytes that a control group (version 2, or 1) leaves to its processes; a huge number without limit."""
    for limit, used in (
        (root / "memory.max", root / "memory.current"),
        (root / "memory/memory.limit_in_bytes", root / "memory/memory.usage_in_bytes"),
    ):
        try:
            text = limit.read_text().strip()
            if text == "max":
                return sys.maxsize
            return max(0, int(text) - int(used.read_text()) + _file_cache(limit.with_name("memory.stat")))
        except (OSError, ValueError):
            continue
    return sys.maxsize


def _file_cache(stat: Path) -> int:
    """Bytes of files that a control group would give back when its processes want more."""
    rows = dict(line.split(maxsplit=1) for line in stat.read_text().splitlines() if " " in line)
    return int(rows.get("inactive_file", 0))


def release(device: torch.device | str) -> None:
    """Give back what Python and PyTorch hold without need, after an allocation failed."""
    gc.collect()
    if str(device).startswith("cuda"):
        import torch

        torch.cuda.empty_cache()
