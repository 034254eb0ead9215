"""Measure what predicting a chunk takes in memory, and fit the footprints that plan the chunks.

``python -m benchmarks.memory`` prints a table of measured and fitted peaks; ``--write`` puts the fits into
``colmap_tco/_footprints.py``. ``--networks sweep`` measures that one alone and keeps the others' fits.
``--check`` fits nothing: it measures at sizes that no fit has seen, and prints the ratio of what ``colmap-tco
check`` predicts to what was measured. ``--sizes 3x140x98`` measures at those (views, width, height) instead.

Every measurement is a process of its own that runs densify's own stage on a made-up workspace, without
reading weights: memory does not depend on their values. On the CPU the peak is that of the resident memory
once the network is there, on CUDA that of PyTorch's allocator.

Published networks are too large to be measured at many sizes. Their own tensors are counted
(:mod:`benchmarks.counting`) for the kind of device that ``--device`` names, which need not be there, and
added to what everything else takes, which is measured with a network of three numbers, ``pipeline``;
``--check`` measures the sum. Products are in the type that ``--dtype`` names; bfloat16 is to be measured on a
device that has it, since another computes it by way of float32. The mode ``recomputed`` is ``optimised`` with
activations computed again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "colmap_tco" / "_footprints.py"
Size = tuple[int, int, int]
"""Views, width and height of the canvas."""

PIPELINE = "pipeline"
COUNTED = ("vggt", "pi3", "mini", "da3", "da3-small")
FITTED: dict[str, tuple[Size, ...]] = {
    "sweep": (
        (4, 128, 96),
        (4, 256, 192),
        (15, 256, 192),
        (60, 256, 192),
        (15, 320, 240),
        (4, 512, 384),
        (15, 512, 384),
    ),
    PIPELINE: ((4, 128, 96), (12, 256, 192), (4, 512, 384)),
    **dict.fromkeys(("vggt", "pi3"), ((2, 280, 210), (4, 518, 392), (12, 518, 392))),
    "mini": ((2, 256, 192), (4, 256, 192), (4, 512, 384)),
    **dict.fromkeys(("da3", "da3-small"), ((2, 84, 56), (5, 84, 56), (2, 168, 126), (4, 168, 126))),
}
"""What the fits are made of."""
CHECKED: dict[str, tuple[Size, ...]] = {
    "sweep": ((7, 256, 192), (9, 384, 288), (15, 384, 288), (7, 512, 384), (40, 256, 192), (128, 256, 192)),
    PIPELINE: ((9, 384, 288),),
    **dict.fromkeys(COUNTED, ((3, 140, 98), (2, 280, 210))),
    "mini": ((3, 136, 96), (2, 280, 208)),
}
"""What they are checked with."""
MODES = {"forward": 0, "optimised": 1, "recomputed": 1}
"""Steps; one passes every place that allocates."""
POLISH_LOOKS = 1
"""On the depths after them; the first already holds all that the later ones do."""
COPIES = {"cpu": 1.2, "cuda": 1.0}
"""Measured over counted bytes of an optimised network's tensors. On a CPU for VGGT-1B and π³ at the sizes
that are checked: kernels copy operands, and freed memory is not always used again. PyTorch's allocator on
CUDA counts what tensors take, which is what is counted here; that was not measured yet."""


@dataclass(frozen=True)
class Peak:
    """One measurement: views, pixels of the canvas, bytes."""

    views: int
    pixels: int
    bytes: int


def main() -> None:
    """Measure; fit, print and write, or print what the estimates say."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--networks", nargs="+", default=["sweep"], choices=list(FITTED))
    parser.add_argument("--modes", nargs="+", default=list(MODES), choices=list(MODES))
    parser.add_argument("--sizes", nargs="+", type=size, help="VIEWSxWIDTHxHEIGHT, in place of the usual")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--dtype", default="bfloat16", choices=["bfloat16", "float32"])
    task = parser.add_mutually_exclusive_group()
    task.add_argument("--write", action="store_true", help="put the fits into colmap_tco/_footprints.py")
    task.add_argument("--check", action="store_true", help="compare predictions with measurements")
    task.add_argument("--one", nargs=5, metavar=("NETWORK", "VIEWS", "WIDTH", "HEIGHT", "MODE"))
    options = parser.parse_args()
    place = (options.device, options.dtype)
    if options.one:
        network, *numbers, mode = options.one
        views, width, height = map(int, numbers)
        print(json.dumps(measured_here(network, place, (views, width, height), mode)))
        return
    column = "predicted MB | predicted / measured" if options.check else "fitted MB | fitted / measured"
    print(f"| network | device | mode | views | canvas | measured MB | {column} |\n" + "|---" * 8 + "|")
    fit_or_check = compare if options.check else refit
    fit_or_check(options, place)


def size(text: str) -> Size:
    """Views, width and height from ``3x140x98``."""
    views, width, height = map(int, text.split("x"))
    return views, width, height


def compare(options: argparse.Namespace, place: tuple[str, str]) -> None:
    """Print what the estimates that ``colmap-tco check`` uses say of sizes that they were not fitted to."""
    from colmap_tco.memory import footprint

    for network in options.networks:
        for mode in modes(network, options):
            needs = footprint(network, place[0], MODES[mode], place[1], recompute=mode == "recomputed")
            for asked in options.sizes or CHECKED[network]:
                peak, _ = measured(network, place, asked, mode)
                key = (network, where(network, place), mode)
                show(key, asked, peak, needs.bytes(peak.views, peak.pixels))


def modes(network: str, options: argparse.Namespace) -> list[str]:
    """Those that were asked for and that the network has."""
    return [mode for mode in options.modes if mode != "recomputed" or network in COUNTED]


def refit(options: argparse.Namespace, place: tuple[str, str]) -> None:
    """Fit, print, and write if that is wanted."""
    from colmap_tco import _footprints

    fits, counts, process = dict(_footprints.FITS), dict(_footprints.COUNTS), _footprints.PROCESS
    for network in options.networks:
        sizes = options.sizes or FITTED[network]
        found_by_size = [counted(network, place, asked) for asked in sizes] if network in COUNTED else []
        for mode in modes(network, options):
            key = (network, where(network, place), mode)
            if network in COUNTED:
                pairs = [(found[mode], weights) for found, weights in found_by_size]
                fit = with_weights(fitted([peak for peak, _ in pairs]), pairs[0][1])
                counts[network, key[1], mode] = fit
                peaks = [Peak(peak.views, peak.pixels, peak.bytes + weights) for peak, weights in pairs]
            else:
                runs = [measured(network, place, asked, mode) for asked in sizes]
                peaks, process = [peak for peak, _ in runs], runs[-1][1]
                fit = fits[key] = fitted(peaks)
            for asked, peak in zip(sizes, peaks, strict=True):
                show(key, asked, peak, predicted(fit, peak))
            if options.write:
                TABLE.write_text(source(process, fits, counts))


def counted(network: str, place: tuple[str, str], asked: Size) -> tuple[dict[str, Peak], int]:
    """Bytes of the network's tensors beside its weights, in each mode, and of these."""
    import torch

    from benchmarks.counting import count

    device, dtype = place
    found = count(network, getattr(torch, dtype), asked, device)
    views, width, height = asked
    bytes_of = {"forward": found.forward, "optimised": found.optimised, "recomputed": found.recomputed}
    return {
        mode: Peak(views, width * height, round(alive * (COPIES[device] if MODES[mode] else 1)))
        for mode, alive in bytes_of.items()
    }, found.weights


def with_weights(fit: tuple[float, float, float], weights: float) -> tuple[float, float, float]:
    """A fit to what comes beside weights, which are known exactly, and the weights."""
    return fit[0] + weights, *fit[1:]


def where(network: str, place: tuple[str, str]) -> str:
    """Device, and the type of the products for the networks that can be told it."""
    return ":".join(place) if network in ("sweep", *COUNTED) else place[0]


def show(key: tuple[str, str, str], asked: Size, peak: Peak, guess: float) -> None:
    """Print a row."""
    cells = (str(peak.views), f"{asked[1]}×{asked[2]}", f"{peak.bytes / 1e6:.0f}", f"{guess / 1e6:.0f}")
    print("| " + " | ".join([*key, *cells, f"{guess / peak.bytes:.2f}"]) + " |", flush=True)


def measured(network: str, place: tuple[str, str], asked: Size, mode: str) -> tuple[Peak, float]:
    """Peak of a process of its own, and the bytes of a process without a network."""
    words = [network, *map(str, asked), mode]
    options = ["--device", place[0], "--dtype", place[1], "--one", *words]
    command = [sys.executable, "-m", "benchmarks.memory", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)} failed:\n{done.stderr}")
    figures = json.loads(done.stdout.splitlines()[-1])
    return Peak(figures["views"], figures["pixels"], figures["bytes"]), figures["process"]


def fitted(peaks: Sequence[Peak]) -> tuple[float, float, float]:
    """Bytes fixed, a pixel and view, and a pixel, by the least squares of relative errors, none negative."""
    from scipy.optimize import nnls

    rows = np.array([[1.0, p.views * p.pixels, p.pixels] for p in peaks])
    size = np.array([p.bytes for p in peaks], float)
    unit = rows.max(0)
    solution, _ = nnls(rows / unit / size[:, None], np.ones(len(peaks)))
    fixed, per_view, per_step = (float(x) for x in solution / unit)
    return fixed, per_view, per_step


def predicted(fit: tuple[float, float, float], peak: Peak) -> float:
    """What a fit says of a measurement."""
    fixed, per_view, per_step = fit
    return fixed + peak.pixels * (peak.views * per_view + per_step)


Fits = Mapping[tuple[str, str, str], tuple[float, float, float]]


def source(process: float, fits: Fits, counts: Fits) -> str:
    """The module that holds the fits."""
    rows = "bytes fixed, bytes a pixel and view, bytes a pixel."
    return "\n".join(
        [
            '"""Memory of each network, written by ``python -m benchmarks.memory``; do not edit."""\n',
            f"PROCESS = {number(process)}",
            '"""Bytes of a process that has imported everything and loaded no network."""\n',
            *table("FITS", fits),
            f'"""Measured: (network, device[:products], mode) → {rows}"""\n',
            *table("COUNTS", counts),
            f'"""Counted: (network, device:products, mode) → the same, beside that of {PIPELINE}."""\n',
        ]
    )


def table(name: str, fits: Fits) -> list[str]:
    """Lines of a dictionary."""
    lines = [f"{name}: dict[tuple[str, str, str], tuple[float, float, float]] = {{"]
    for (network, where, mode), fit in sorted(fits.items()):
        numbers = ", ".join(map(number, fit))
        lines.append(f'    ("{network}", "{where}", "{mode}"): ({numbers}),')
    return [*lines, "}"]


def number(x: float) -> str:
    """A number as the formatter writes it."""
    return f"{x:.1f}" if x < 1e4 else f"{x:.3e}".replace("e+", "e")


def measured_here(network: str, place: tuple[str, str], asked: Size, mode: str) -> dict[str, Any]:
    """Peak of this process, which must do nothing else."""
    import torch

    from benchmarks.counting import EVERY_BLOCK
    from colmap_tco.memory import canvas_pixels

    device = torch.device(place[0])
    with tempfile.TemporaryDirectory() as folder:
        tracks, views = chunk(Path(folder), asked)
        process = resident("VmRSS")
        backbone = made(network, device, getattr(torch, place[1]))
        if mode == "recomputed":
            backbone.recompute = EVERY_BLOCK
        forget_peak()
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats()
        run(backbone, tracks, views, device, MODES[mode])
    peak = torch.cuda.max_memory_allocated() if device.type == "cuda" else resident("VmHWM")
    return {"views": len(views), "pixels": canvas_pixels(views), "bytes": peak, "process": process}


def resident(what: str) -> int:
    """Resident memory of this process, bytes: VmRSS now, VmHWM its peak. Linux alone tells it."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{what}:"):
            return 1024 * int(line.split()[1])
    raise ValueError(f"/proc/self/status has no {what}")


def forget_peak() -> None:
    """Let the peak start from what is resident now: building a network takes more than it then holds."""
    import gc

    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")


def made(network: str, device: Any, dtype: Any) -> Any:
    """A network of the published size with random weights, or the embedded one, or nearly none."""
    from benchmarks.counting import random
    from tco.backbones.weights import load_sweep
    from tco.toy import Toy

    if network == "sweep":
        return load_sweep(device=device, dtype=dtype)
    if network == PIPELINE:
        return Toy().to(device)
    return random(network, dtype).to(device)


def chunk(folder: Path, asked: Size) -> tuple[Any, list[Any]]:
    """Tracks and views of a made-up workspace whose images have the size of the canvas."""
    from colmap_tco.tracks import read_tracks
    from colmap_tco.views import ViewConfig, make_views
    from colmap_tco.workspace import open_workspace

    views, width, height = asked
    write_workspace(folder, views, width, height)
    workspace = open_workspace(folder, num_threads=1)
    made_views, _ = make_views(workspace, ViewConfig(max_image_size=max(width, height)), 2)
    return read_tracks(workspace.model), made_views


def run(backbone: Any, tracks: Any, views: list[Any], device: Any, steps: int) -> None:
    """The stage of densify that is measured, on all views as one chunk."""
    from dataclasses import replace

    from colmap_tco.backbones import suited
    from colmap_tco.chunks import Chunk
    from colmap_tco.predict import predict_chunk
    from colmap_tco.priors import PriorConfig
    from colmap_tco.published import NETWORKS
    from tco.options import PolishConfig, TCOConfig

    plain = TCOConfig(steps=steps, polish=PolishConfig(polish_looks=POLISH_LOOKS))
    toy = backbone.name not in NETWORKS
    tco = replace(plain, lora_targets=("plane",)) if toy else suited(plain, NETWORKS[backbone.name])
    settings = (PriorConfig(), tco, 0)
    predict_chunk(
        (backbone, device), tracks, views, Chunk(tuple(range(len(views)))), settings, lambda _: None
    )


def write_workspace(root: Path, views: int, width: int, height: int, points: int = 300) -> None:
    """Cameras in a row before a wavy, textured wall, in COLMAP's text format, with their images."""
    import cv2

    rng, focal = np.random.default_rng(0), 0.9 * width
    texture = rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
    xy = rng.uniform(-1.5, 1.5, (points, 2))
    xyz = np.concatenate([xy, 3 + 0.3 * np.sin(2 * xy[:, :1])], 1)
    (root / "images").mkdir(parents=True)
    (root / "sparse" / "0").mkdir(parents=True)
    lines, tracks = [], [[] for _ in xyz]  # type: list[str], list[list[str]]
    for i, x in enumerate(np.linspace(-0.5, 0.5, views), 1):
        uv = (xyz[:, :2] - [x, 0]) / xyz[:, 2:] * focal + [width / 2, height / 2]
        seen = np.flatnonzero(((uv > 0) & (uv < [width, height])).all(1))
        for index, p in enumerate(seen):
            tracks[p].append(f"{i} {index}")
        keypoints = " ".join(f"{u} {v} {p + 1}" for p, (u, v) in zip(seen, uv[seen].tolist(), strict=True))
        lines.append(f"{i} 1 0 0 0 {-x} 0 0 1 {i:03d}.png\n{keypoints}")
        shifted: NDArray[Any] = np.roll(texture, round(-10 * x), 1)
        cv2.imwrite(str(root / "images" / f"{i:03d}.png"), cv2.resize(shifted, (width, height)))
    entries = [
        f"{p + 1} {' '.join(map(str, xyz[p].tolist()))} 128 128 128 0.5 {' '.join(track)}"
        for p, track in enumerate(tracks)
        if track
    ]
    files = {
        "cameras": [f"1 PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}"],
        "images": lines,
        "points3D": entries,
    }
    for name, content in files.items():
        (root / "sparse" / "0" / f"{name}.txt").write_text("\n".join(content) + "\n")


if __name__ == "__main__":
    main()
