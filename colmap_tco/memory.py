"""How much memory there is, how much a chunk takes, and so how many views fit.

The footprints are fits to peaks, measured and counted (``python -m benchmarks.memory``); nothing here
imports torch before it is asked about a device.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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

PIPELINE = "pipeline"
"""Everything but the network, in the table of what was measured."""


@dataclass(frozen=True)
class Footprint:
    """Peak bytes of predicting a chunk: fixed + pixels · (views · per_view + per_step).

    Attributes:
        fixed: the process with the network loaded.
        per_view: what stays for each view, bytes a pixel of the canvas.
        per_step: what one step or one decoding takes beside that, bytes a pixel of the canvas.
        measured: on what kind of device it was measured, for a published network all but its own tensors,
            which are counted; empty if it is derived from another device's.
        before: of an optimisation, the prediction of all views that comes before its steps: of many views it
            can take more than a step.
    """

    fixed: float
    per_view: float
    per_step: float
    measured: str
    before: Footprint | None = None

    def bytes(self, views: int, pixels: int) -> int:
        """Peak of a chunk of so many views on a canvas of so many pixels."""
        own = round(self.fixed + pixels * (views * self.per_view + self.per_step))
        return own if self.before is None else max(own, self.before.bytes(views, pixels))

    def views(self, pixels: int, room: float) -> float:
        """How many views fit into so many bytes, not rounded and not limited."""
        own = (room - self.fixed - pixels * self.per_step) / (pixels * self.per_view)
        return own if self.before is None else min(own, self.before.views(pixels, room))


def footprint(
    network: str, device: str, steps: int, dtype: str | None = None, recompute: bool = False
) -> Footprint:
    """Of a network (a key of :data:`colmap_tco.published.NETWORKS`) on a kind of device.

    Args:
        network: its name.
        device: ``cpu``, ``cuda``, …. Where a network was not measured on it, it is taken to need there what
            it needs on the CPU, less the process, which is not in the device's memory. The tensors of
            published networks are counted as they are on a CPU and on CUDA.
            The type in which a device multiplies matrices counts: bfloat16 takes half of float32.
        steps: of optimisation; 0 takes less.
        dtype: of the products, if it is not that in which the device takes them.
        recompute: whether activations are computed again in the backward pass, by networks that can.

    Where adapters change the last blocks alone, less is needed than this says: it is of adapters on all.
    """
    kind, mode = network.removesuffix("-commercial"), "optimised" if steps else "forward"
    products = dtype or _products(device)
    where = f"{'cuda' if device == 'cuda' else 'cpu'}:{products}"
    counts = _footprints.COUNTS.get((kind, where, "recomputed" if steps and recompute else mode))
    measured = kind if counts is None else PIPELINE
    places = (f"{device}:{products}", device, f"cpu:{products}", "cpu")
    place = next(p for p in places if (measured, p, mode) in _footprints.FITS)
    fixed, per_view, per_step = _footprints.FITS[measured, place, mode]
    here = place.partition(":")[0] == device
    if not here:
        fixed = max(0.0, fixed - _footprints.PROCESS)
    more = counts or (0.0, 0.0, 0.0)
    return Footprint(
        fixed + more[0], per_view + more[1], per_step + more[2], device if here else "",
        footprint(network, device, 0, dtype) if steps else None,
    )  # fmt: skip


def recomputed(
    network: str, device: str, steps: int, room: tuple[int, int, int], choice: str, dtype: str | None = None
) -> bool:
    """Whether activations are to be computed again in the backward pass, which takes a third more time.

    Args:
        network: a key of :data:`colmap_tco.published.NETWORKS`; some have nothing to compute again.
        device: its kind.
        steps: of optimisation; without any there is no backward pass.
        room: views wanted in a chunk, pixels of the canvas, and bytes that are free.
        choice: ``always``, ``never``, or ``auto``: if else fewer views than wanted would fit.
        dtype: see :func:`footprint`.
    """
    views, pixels, free = room
    plain, less = (footprint(network, device, steps, dtype, again) for again in (False, True))
    if choice == "never" or plain == less:
        return False
    return choice == "always" or plain.views(pixels, SHARE * free) < views


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


@contextmanager
def cycles_left() -> Iterator[None]:
    """Search for no cycles of garbage inside the block, but where that is asked for.

    That is between chunks, and by :func:`release`. Python looks for them whenever many objects have been
    made, as by every import, and then at all that there are: of torch's and numba's modules that takes half a
    second of a run that takes twenty. Nothing large is in a cycle here, which a test holds true.
    """
    searching = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if searching:
            gc.enable()


def release(device: torch.device | str) -> None:
    """Give back what Python and PyTorch hold without need, after an allocation failed."""
    gc.collect()
    if str(device).startswith("cuda"):
        import torch

        torch.cuda.empty_cache()
