"""Measure the fusion: depth pixels a second, memory, and how both grow with the number of views.

``python -m benchmarks.fusion [--views 20 40 80 160] [--output docs/fusion.md]`` fuses views of a rippled
sphere, 640×480 pixels each, along an arc; a row of the table is a process of its own, so that its peak of the
resident memory is its own.

What counts as depth pixels: all pixels of all depth maps, each once, however often it is read or compared;
those that a filter drops and those that an earlier view's points cover are among them. The time is that of
the whole fusion in memory, after a small one that loads the compiled loops; with ``--files`` it also holds
the reading of the maps and the decoding of the images. Writing the cloud is not in it.

The CPU's seconds hold on a busy machine too. From them: pixels a second of one core, and, where the threads
would each have a core, pixels by the seconds of the calling thread, which alone does what is not parallel,
and the others' share. ``--profile`` adds, for the smallest number of views, where the time goes on one
thread.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import pstats
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.tables import paragraph, publish, to_file
from colmap_tco.fusion import FusionConfig, FusionMaps, FusionView, fuse
from colmap_tco.normals import normals_from_depth
from colmap_tco.outputs import ViewMaps, read_view, write_image, write_maps
from colmap_tco.pinhole import Pinhole
from colmap_tco.workspace import DensePaths, dense_paths

ROOT = Path(__file__).resolve().parents[1]
Floats = NDArray[np.float64]
DISTANCE, STEP = 4.0, 0.06
"""Distance of the cameras from the middle of the sphere, and radians between two of them."""


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--views", type=int, nargs="+", default=[20, 40, 80, 160])
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--neighbours", type=int, default=10)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--cache_size", type=float, default=4.0, help="gigabytes")
    parser.add_argument("--files", action="store_true", help="read maps and images from files")
    parser.add_argument("--gaps", action="store_true", help="look for gaps, too, of which there are none")
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--one", action="store_true", help="print the figures of the first number of views")
    to_file(parser)
    return parser


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    options = parser().parse_args(argv)
    if options.one:
        print(json.dumps(measured(options)))
        return
    width, height = options.size
    text = "# The fusion\n\n" + paragraph(
        f"`python -m benchmarks.fusion`: views of {width}×{height} pixels, {options.neighbours} neighbours "
        f"each, {options.threads} threads, a cache of {options.cache_size:g} GB. Pixels are those of all "
        "depth maps, each once, however often it is compared. Per second of the clock; of one core's time; "
        "and of all cores, were they free, by the seconds of the calling thread and of the others. held: "
        "maps and images in memory at most."
    )
    text += (
        "\n| views | million depth pixels | points | seconds | CPU seconds | million pixels/s | a core "
        "| all cores | maps read | held MB | peak MB |\n" + "|---" * 11 + "|\n"
    )
    for views in options.views:
        text += line(in_process(options, views), views, options.threads) + "\n"
    publish(text, options.output, options.part)
    if options.profile:
        profile(options)


def line(r: dict[str, float], views: int, threads: int) -> str:
    """A row of the table."""
    free = r["serial"] + (r["busy"] - r["serial"]) / threads
    pace = " | ".join(f"{r['pixels'] / seconds / 1e6:.2f}" for seconds in (r["seconds"], r["busy"], free))
    return (
        f"| {views} | {r['pixels'] / 1e6:.2f} | {r['points']:.0f} | {r['seconds']:.2f} | {r['busy']:.2f} "
        f"| {pace} | {r['loads']:.0f} | {r['held'] / 1e6:.0f} | {r['peak'] / 1e6:.0f} |"
    )


def in_process(options: argparse.Namespace, views: int) -> dict[str, float]:
    """:func:`measured` in a process of its own."""
    words = [sys.executable, "-m", "benchmarks.fusion", "--one", "--views", str(views), "--size"]
    words += [str(side) for side in options.size]
    for name in ("neighbours", "threads", "cache_size"):
        words += [f"--{name}", str(getattr(options, name))]
    words += ["--files"] * options.files + ["--gaps"] * options.gaps
    figures: dict[str, float] = json.loads(subprocess.check_output(words, cwd=ROOT, text=True))
    return figures


def measured(options: argparse.Namespace) -> dict[str, float]:
    """Seconds, bytes and counts of one fusion, after a small one that loads the compiled loops."""
    fuse(scene(3, (96, 72), 2), config(options))
    views = scene(options.views[0], tuple(options.size), options.neighbours)
    with tempfile.TemporaryDirectory() as folder:
        if options.files:
            views = [in_files(view, dense_paths(Path(folder))) for view in views]
        agreed = [sure(view) for view in views] if options.gaps else []
        start, busy, serial = time.perf_counter(), time.process_time(), time.thread_time()
        cloud, report = fuse(views, config(options), agreed=agreed)
        spent = time.perf_counter() - start, time.process_time() - busy, time.thread_time() - serial
    return {
        "seconds": spent[0],
        "busy": spent[1],
        "serial": spent[2],
        "pixels": report.pixels["all"],
        "points": len(cloud),
        "loads": report.loads,
        "held": report.peak_bytes,
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def config(options: argparse.Namespace) -> FusionConfig:
    """The defaults with the threads and the cache that were asked for."""
    return FusionConfig(num_threads=options.threads, cache_size=options.cache_size)


def profile(options: argparse.Namespace) -> None:
    """Print the functions that take the time on one thread, by their own time."""
    fuse(scene(3, (96, 72), 2), config(options))
    views = scene(options.views[0], tuple(options.size), options.neighbours)
    profiler = cProfile.Profile(time.process_time)
    profiler.runcall(fuse, views, FusionConfig(num_threads=1, cache_size=options.cache_size))
    pstats.Stats(profiler).sort_stats("tottime").print_stats(25)


def scene(count: int, size: tuple[int, int], neighbours: int) -> list[FusionView]:
    """Views of the sphere along an arc, each made when it is read; the nearest are neighbours."""
    camera = Pinhole(*size, float(size[0]), float(size[0]), size[0] / 2, size[1] / 2)
    views = []
    for i in range(count):
        others = sorted((j for j in range(count) if j != i), key=lambda j: (abs(i - j), j))[:neighbours]
        pose = pose_of(i)
        maps = maps_of(camera, pose)
        views.append(FusionView(f"{i:04d}.jpg", i, camera, pose, tuple(others), lambda maps=maps: maps))  # type: ignore[misc]
    return views


def sure(view: FusionView) -> FusionView:
    """The view as one that all agreed on."""

    def load() -> FusionMaps:
        maps = view.load()
        return replace(maps, error=np.full_like(maps.depth, 0.001))

    return replace(view, load=load)


def in_files(view: FusionView, paths: DensePaths) -> FusionView:
    """The view with its maps and its image, a JPEG, in files, read as those of a dense workspace."""
    maps = view.load()
    assert maps.confidence is not None
    write_maps(paths, view.name, ViewMaps(maps.depth, maps.normal, maps.confidence))
    write_image(paths.image(view.name), maps.image)
    return replace(view, load=lambda: read_view(paths, view.name))


def pose_of(i: int) -> Floats:
    """cam_from_world (3, 4) on a spiral around the sphere."""
    angle, height = STEP * i, 0.6 * np.sin(0.3 * i)
    eye = np.array([DISTANCE * np.sin(angle), height, -DISTANCE * np.cos(angle)])
    z = -eye / np.linalg.norm(eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return np.concatenate([rotation, -(rotation @ eye)[:, None]], 1)


def maps_of(camera: Pinhole, pose: Floats) -> FusionMaps:
    """Exact depths of a sphere of radius 1.5 before a larger one of radius 9 around both, from inside."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    rays = rays @ pose[:, :3]
    centre = -pose[:, :3].T @ pose[:, 3]
    a, b, c = (rays**2).sum(-1), rays @ centre, centre @ centre
    near = b * b - a * (c - 1.5**2)
    far = (-b + np.sqrt(b * b - a * (c - 9.0**2))) / a
    depth = np.where(near > 0, (-b - np.sqrt(np.maximum(near, 0))) / a, far).astype(np.float32)
    image = np.rint(127 + 80 * np.sin(3 * (centre + rays * depth[..., None]))).astype(np.uint8)
    return FusionMaps(depth, normals_from_depth(depth, camera), image, np.full_like(depth, 5.0))


if __name__ == "__main__":
    main()
