"""What a survey of many pictures costs: seconds of every stage and memory, for a growing number of views.

    python -m benchmarks.many runs/many [--views 15 60 200] [--steps 0] [--output docs/many.md]

The pictures are of a flight over the ``hills`` of ``benchmarks/rendered.py``, in lines as a drone flies them,
with the same distance between pictures whatever their number. The model has the true cameras; its points are
corners of the pictures, seen by some of the views that could see them, with keypoints off by half a pixel.
Each run is a process of its own. Seconds are of the processor, over all threads, so that other work on the
machine does not count; ``a view`` divides their sum by the number of views.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.rendered import hills, traced
from benchmarks.tables import paragraph, publish, to_file
from colmap_tco import _pycolmap
from colmap_tco.progress import Progress
from training.paths import look_at
from training.scenes import Sample

Floats = NDArray[np.float64]
SHAPE = (360, 480)
SPACING, HEIGHT, AHEAD = 0.5, 4.6, 1.2
"""Between pictures, above the lowest ground, and how far ahead of it the camera looks, in its units."""
CORNERS = 250
"""Corners of each picture that become points, where three views or more see them."""
REACH = 2.2
"""Distance of camera centres at which the chance that both find the same corner has fallen to 1 / e."""
KEYPOINT_NOISE = 0.5
STAGES = ("workspace", "optimisation", "fusion", "report")


def flight(views: int) -> list[Floats]:
    """Poses world_from_cam (4, 4) in lines to and fro over the middle of the ground, in order of time."""
    columns = int(np.ceil(np.sqrt(views)))
    rows = int(np.ceil(views / columns))
    poses = []
    for i in range(views):
        row, column = divmod(i, columns)
        forth = 1 if row % 2 == 0 else -1
        x = SPACING * forth * (column - (columns - 1) / 2)
        y = SPACING * (row - (rows - 1) / 2)
        eye = np.array([x, y, HEIGHT + 0.1 * np.sin(1.7 * i)])
        poses.append(look_at(eye, np.array([x + 0.2 * np.sin(2.3 * i), y + AHEAD, 0.6])))
    return poses


def triangulated(sample: Sample, rng: np.random.Generator) -> tuple[Floats, NDArray[np.bool_]]:
    """World points (N, 3) at corners of the pictures, and which views have a keypoint of them (V, N)."""
    world_from_cam = np.linalg.inv(sample.cam_from_world.astype(float))
    points, source = [], []
    for i, image in enumerate(sample.images):
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        found = cv2.goodFeaturesToTrack(grey, CORNERS, 0.005, 6)
        x, y = np.zeros((2, 0), int) if found is None else found.reshape(-1, 2).round().astype(int).T
        z = sample.depth[i, y, x].astype(float)
        rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))]).astype(float)
        local = np.linalg.inv(sample.K[i].astype(float)) @ rays * z
        pose = world_from_cam[i]
        points.append((pose[:3, :3] @ local + pose[:3, 3:]).T[z > 0])
        source += [i] * len(points[-1])
    xyz, owner = np.concatenate(points), np.array(source)
    eyes = world_from_cam[:, :3, 3]
    chance = np.exp(-np.linalg.norm(eyes[:, None] - eyes[owner][None], axis=2) / REACH)
    seen = rng.random(chance.shape) < chance
    for i in range(len(eyes)):
        seen[i] &= _visible(sample, i, xyz)
    kept = seen.sum(0) >= 3
    return xyz[kept], seen[:, kept]


def _projected(sample: Sample, view: int, xyz: Floats) -> tuple[Floats, Floats]:
    """Pixels (N, 2) and camera z (N,) of world points (N, 3)."""
    local = xyz @ sample.cam_from_world[view, :3, :3].T.astype(float) + sample.cam_from_world[view, :3, 3]
    z = np.maximum(local[:, 2], 1e-6)
    return (local @ sample.K[view].T.astype(float))[:, :2] / z[:, None], local[:, 2]


def _visible(sample: Sample, view: int, xyz: Floats) -> NDArray[np.bool_]:
    """Which world points are, within a per cent, on the surface that a view shows."""
    pixels, z = _projected(sample, view, xyz)
    height, width = sample.depth.shape[1:]
    inside = (z > 0) & (pixels >= 1).all(1) & (pixels <= (width - 1, height - 1)).all(1)
    column, row = np.where(inside[:, None], pixels, 0).astype(int).T
    there = sample.depth[view, row, column]
    return inside & (there > 0) & (np.abs(z - there) < 0.01 * there)


def write_model(sample: Sample, names: Sequence[str], folder: Path, rng: np.random.Generator) -> None:
    """COLMAP's model of the pictures: true cameras, true points, keypoints with noise."""
    xyz, seen = triangulated(sample, rng)
    height, width = sample.depth.shape[1:]
    images = []
    for i, name in enumerate(names):
        mine = np.flatnonzero(seen[i])
        pixels, _ = _projected(sample, i, xyz[mine])
        pixels += KEYPOINT_NOISE * rng.normal(size=pixels.shape)
        pose = sample.cam_from_world[i, :3].astype(float)
        u, _, vt = np.linalg.svd(pose[:, :3])
        pose[:, :3] = u @ vt  # orthogonal in float64
        fx, fy, cx, cy = sample.K[i][(0, 1, 0, 1), (0, 1, 2, 2)].tolist()
        entry = _pycolmap.Registered(i + 1, name, None, pose)
        images.append(_pycolmap.PinholeImage(entry, (width, height, fx, fy, cx, cy), pixels, mine + 1))
    colors = np.full(xyz.shape, 128, np.uint8)
    folder.mkdir(parents=True, exist_ok=True)
    _pycolmap.pinhole_model(images, (np.arange(1, len(xyz) + 1), xyz, colors)).write(str(folder))


def made(folder: Path, views: int) -> Path:
    """The workspace with this number of views; made if it is not there yet."""
    root = folder / f"views-{views}"
    if (root / "sparse" / "0" / "points3D.bin").exists():
        return root
    bodies, _ = hills()
    sample = traced(bodies, flight(views), 2.0, SHAPE, fine=1)
    names = [f"DJI_{i + 1:04d}.jpg" for i in range(views)]
    (root / "images").mkdir(parents=True, exist_ok=True)
    for name, image in zip(names, sample.images, strict=True):
        cv2.imwrite(str(root / "images" / name), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    write_model(sample, names, root / "sparse" / "0", np.random.default_rng(0))
    return root


class Stopwatch(Progress):
    """Progress that notes the seconds of processor time when each stage begins."""

    def __init__(self) -> None:
        super().__init__()
        self.begins: list[tuple[str, float]] = []

    def stage(self, name: str, total: int) -> None:
        """Begin a stage, see :class:`Progress`."""
        self.begins.append((name, time.process_time()))
        super().stage(name, total)

    def seconds(self) -> dict[str, float]:
        """Name → seconds of each stage, the last one's until now."""
        ends = [at for _, at in self.begins[1:]] + [time.process_time()]
        return {name: end - at for (name, at), end in zip(self.begins, ends, strict=True)}


def run_here(root: Path, steps: int | None, size: int) -> dict[str, Any]:
    """Densify in this process, which must do nothing else; what it took."""
    from colmap_tco.densify import DensifyConfig, densify
    from colmap_tco.views import ViewConfig
    from tco.options import TCOConfig

    tco = TCOConfig() if steps is None else TCOConfig(steps=steps)
    given = () if steps is None else ("steps",)
    config = DensifyConfig(overwrite=True, tco=tco, views=ViewConfig(max_image_size=size), given=given)
    watch = Stopwatch()
    done = densify(root, config, watch)
    if not done.fresh:
        raise SystemExit(f"{done.folder} is complete already: remove it to measure anew")
    return {
        "seconds": watch.seconds(),
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "chunks": len(done.report["chunks"]),
        "used": done.report["images"]["used"],
        "points": done.report["points"],
    }


def row(views: int, figures: Mapping[str, Any]) -> str:
    """A line of the table."""
    seconds = figures["seconds"]
    cells = [str(views), str(figures["used"]), str(figures["chunks"])]
    cells += [f"{seconds.get(stage, 0.0):.1f}" for stage in STAGES]
    total = sum(seconds.values())
    cells += [f"{total:.0f}", f"{total / views:.2f}", f"{figures['peak'] / 1e9:.2f}", f"{figures['points']}"]
    return "| " + " | ".join(cells) + " |"


def header() -> str:
    """The head of the table."""
    cells = ["views", "used", "chunks", *(f"{s} s" for s in STAGES), "sum s", "a view s", "peak GB", "points"]
    return "| " + " | ".join(cells) + " |\n" + "|---" * len(cells) + "|"


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--views", type=int, nargs="+", default=[15, 60, 200])
    parser.add_argument("--steps", type=int, help="of the optimisation; default: densify's own")
    parser.add_argument("--max_image_size", type=int, default=0, help="as of densify")
    parser.add_argument("--one", type=Path, help="measure this workspace in this process, and print JSON")
    to_file(parser)
    return parser


def main() -> None:
    """Command line."""
    args = parser().parse_args()
    if args.one:
        sys.stdout.write(json.dumps(run_here(args.one, args.steps, args.max_image_size)) + "\n")
        return
    text = "# Many views\n\n" + paragraph(
        "`python -m benchmarks.many FOLDER` renders a flight over hills, "
        f"{SHAPE[1]}×{SHAPE[0]} pixels a picture, and densifies it, with the defaults where no option says "
        "otherwise. Seconds are of the processor, over all threads; two cores take little more than half of "
        "them. The compiled loops were there already."
    )
    text += "\n" + header() + "\n"
    options = [] if args.steps is None else ["--steps", str(args.steps)]
    for views in args.views:
        root = made(args.folder.resolve(), views)
        command = [sys.executable, "-m", "benchmarks.many", str(args.folder), "--one", str(root), *options]
        command += ["--max_image_size", str(args.max_image_size)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)} failed:\n{done.stderr}")
        text += row(views, json.loads(done.stdout.splitlines()[-1])) + "\n"
    publish(text, args.output, args.part)


if __name__ == "__main__":
    main()
