"""Measure what predicting a chunk takes in memory, and fit the footprints that plan the chunks.

``python -m benchmarks.memory`` prints a table of measured and fitted peaks; ``--write`` puts the fits into
``colmap_tco/_footprints.py``. ``--networks sweep`` measures that one alone and keeps the others' fits.

Every measurement is a process of its own that runs densify's own stage on a made-up workspace, without
reading weights: memory does not depend on their values. On the CPU the peak is that of the resident memory
once the network is there, on CUDA that of PyTorch's allocator. Published networks are measured with the
matrix products in the type that ``--dtype`` names, which a CPU without bfloat16 would run in float32.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "colmap_tco" / "_footprints.py"
SIZES = {
    "sweep": ((4, 128, 96), (10, 128, 96), (4, 256, 192), (12, 256, 192), (4, 512, 384), (9, 512, 384)),
    "vggt": ((2, 84, 56), (5, 84, 56), (2, 168, 126), (4, 168, 126)),
    "pi3": ((2, 84, 56), (5, 84, 56), (2, 168, 126), (4, 168, 126)),
    "da3": ((2, 84, 56), (5, 84, 56), (2, 168, 126), (4, 168, 126)),
    "da3-small": ((2, 84, 56), (5, 84, 56), (2, 168, 126), (4, 168, 126)),
}
"""(views, width, height) that are measured by default."""
MODES = {"forward": 0, "optimised": 1}
"""Steps; one passes every place that allocates, where the views are tied to each other from the first."""


@dataclass(frozen=True)
class Peak:
    """One measurement: views, pixels of the canvas, bytes."""

    views: int
    pixels: int
    bytes: int


def main() -> None:
    """Measure, fit, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--networks", nargs="+", default=["sweep"], choices=list(SIZES))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--dtype", default="bfloat16", choices=["bfloat16", "float32"])
    parser.add_argument("--write", action="store_true", help="put the fits into colmap_tco/_footprints.py")
    parser.add_argument("--one", nargs=5, metavar=("NETWORK", "VIEWS", "WIDTH", "HEIGHT", "STEPS"))
    options = parser.parse_args()
    if options.one:
        network, *numbers = options.one
        views, width, height, steps = map(int, numbers)
        place = (options.device, options.dtype)
        print(json.dumps(measured_here(network, place, (views, width, height), steps)))
        return
    from colmap_tco import _footprints

    fits, process = dict(_footprints.FITS), _footprints.PROCESS
    print(
        "| network | device | mode | views | canvas | measured MB | fitted MB | error |\n" + "|---" * 8 + "|"
    )
    for network in options.networks:
        for mode, steps in MODES.items():
            peaks, process = series(network, (options.device, options.dtype), steps)
            fit = fitted(peaks)
            where = options.device if network == "sweep" else f"{options.device}:{options.dtype}"
            fits[network, where, mode] = fit
            for peak, size in zip(peaks, SIZES[network], strict=True):
                row = (network, where, mode, str(peak.views), f"{size[1]}×{size[2]}")
                guess = predicted(fit, peak)
                cells = (f"{peak.bytes / 1e6:.0f}", f"{guess / 1e6:.0f}", f"{guess / peak.bytes - 1:+.1%}")
                print("| " + " | ".join(row + cells) + " |", flush=True)
    if options.write:
        TABLE.write_text(source(process, fits))


def series(network: str, place: tuple[str, str], steps: int) -> tuple[list[Peak], float]:
    """Peaks at all sizes, each of a process of its own, and the bytes of a process without a network."""
    peaks, process = [], 0.0
    for views, width, height in SIZES[network]:
        words = [network, *map(str, (views, width, height, steps))]
        options = ["--device", place[0], "--dtype", place[1], "--one", *words]
        command = [sys.executable, "-m", "benchmarks.memory", *options]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            sys.exit(f"{' '.join(command)} failed:\n{done.stderr}")
        figures = json.loads(done.stdout.splitlines()[-1])
        peaks.append(Peak(figures["views"], figures["pixels"], figures["bytes"]))
        process = figures["process"]
    return peaks, process


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


def source(process: float, fits: dict[tuple[str, str, str], tuple[float, float, float]]) -> str:
    """The module that holds the fits."""
    lines = [
        '"""Measured memory of each network, written by ``python -m benchmarks.memory``; do not edit."""\n',
        f"PROCESS = {process:.3g}",
        '"""Bytes of a process that has imported everything and loaded no network."""\n',
        "FITS: dict[tuple[str, str, str], tuple[float, float, float]] = {",
    ]
    for (network, device, mode), fit in sorted(fits.items()):
        numbers = ", ".join(f"{x:.4g}" if "e" in f"{x:.4g}" else f"{x:.1f}" for x in fit)
        lines.append(f'    ("{network}", "{device}", "{mode}"): ({numbers}),')
    lines.append("}")
    lines.append(
        '"""(network, device, forward or optimised) → bytes fixed, bytes a pixel and view, bytes a pixel."""'
    )
    return "\n".join(lines) + "\n"


def measured_here(
    network: str, place: tuple[str, str], size: tuple[int, int, int], steps: int
) -> dict[str, Any]:
    """Peak of this process, which must do nothing else."""
    import torch

    from colmap_tco.memory import canvas_pixels

    device = torch.device(place[0])
    with tempfile.TemporaryDirectory() as folder:
        tracks, views = chunk(Path(folder), size)
        process = resident("VmRSS")
        backbone = made(network, device, getattr(torch, place[1]))
        forget_peak()
        run(backbone, tracks, views, device, steps)
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
    """A network of the published size, with weights that do no harm."""
    import torch

    from tco.backbones import da3, pi3, vggt
    from tco.backbones.weights import load_sweep

    if network == "sweep":
        return load_sweep(device=device)
    build, config, wrap = {
        "vggt": (vggt.VGGTNetwork, vggt.VGGTConfig.vggt_1b(), vggt.VGGT),
        "pi3": (pi3.Pi3Network, pi3.Pi3Config.large(), pi3.Pi3),
        "da3": (da3.DA3Network, da3.DA3Config.base(), da3.DA3),
        "da3-small": (da3.DA3Network, da3.DA3Config.small(), da3.DA3),
    }[network]
    with torch.device("meta"):
        empty = build(config)
    inner = empty.to_empty(device="cpu")
    with torch.no_grad():
        for name, tensor in inner.state_dict(keep_vars=True).items():
            tensor.fill_(1e-3 if name.endswith("weight") else 0.0)
    return wrap(inner, dtype).eval().requires_grad_(False).to(device)


def chunk(folder: Path, size: tuple[int, int, int]) -> tuple[Any, list[Any]]:
    """Tracks and views of a made-up workspace whose images have the size of the canvas."""
    from colmap_tco.tracks import read_tracks
    from colmap_tco.views import ViewConfig, make_views
    from colmap_tco.workspace import open_workspace

    views, width, height = size
    write_workspace(folder, views, width, height)
    workspace = open_workspace(folder, num_threads=1)
    made_views, _ = make_views(workspace, ViewConfig(max_image_size=max(width, height)), 2)
    return read_tracks(workspace.model), made_views


def run(backbone: Any, tracks: Any, views: list[Any], device: Any, steps: int) -> None:
    """The stage of densify that is measured, on all views as one chunk."""
    from colmap_tco.backbones import suited
    from colmap_tco.chunks import Chunk
    from colmap_tco.predict import predict_chunk
    from colmap_tco.priors import PriorConfig
    from colmap_tco.published import NETWORKS
    from tco.options import TCOConfig

    tco = suited(TCOConfig(steps=steps, consistency_start=0.0), NETWORKS[backbone.name])
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
