"""Real scenes on which nothing was chosen: other stretches of the sequences that the shared sets are from.

    git clone https://github.com/andyzeng/tsdf-fusion-python runs/sources/tsdf-fusion-python
    git clone https://github.com/ardaduz/deep-video-mvs runs/sources/deep-video-mvs
    git clone https://github.com/isl-org/open3d_downloads runs/sources/open3d_downloads
    python -m benchmarks.unseen redkitchen-200 hololens-060 icl-120
    python -m benchmarks.quality --sets redkitchen-200 hololens-060 icl-120 --baselines interp patchmatch

A stretch is named after its sequence and first frame. It becomes a workspace with ``images/``, ``sparse/``
made by COLMAP, and ``gt/`` as ``../shared/tools/score.py`` reads it. Nothing of the sequences is part of this
repository; their own terms hold (7-Scenes, Hololens frames of deep-video-mvs, ICL-NUIM). The first command
tells how many of COLMAP's own points agree with the sensor: where few do, the model is bent, and no depth can
be right.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.tables import paragraph, publish, to_file
from colmap_tco import _pycolmap
from colmap_tco.lens import pincushion
from colmap_tco.mapping import ensure_model
from colmap_tco.tracks import read_tracks

Floats = NDArray[np.float64]
SOURCES = Path("runs/sources")
"""Where the repositories with the sequences are."""
VIEWS, FEWEST = 15, 12
"""Frames of a stretch; those of them that COLMAP has to register, or it is of no use."""
FARTHEST = 10_000
"""Millimetres beyond which a depth is the sensor's word for none."""
DEPTH_CAMERA = (585.0, 320.0, 240.0)
COLOUR_CAMERA = (525.5, 314.5, 235.2)
COLOUR_BESIDE = (-22.0, 2.0)
"""Focal length and principal point of the Kinect's two cameras, pixels, and where a point of the one is in
the other, millimetres: those with which the sensor's depths fall on the registered ones of the shared
``kitchen``, to 3 mm in the median of three frames."""


def registered(depth: NDArray) -> NDArray:
    """Depths (H, W) of the Kinect's depth camera, millimetres, as its colour camera sees them; 0 if unknown.

    Each depth falls on one pixel, and the nearest of those that fall on the same one is kept.
    """
    h, w = depth.shape
    (focal, cx, cy), (to, tx, ty) = DEPTH_CAMERA, COLOUR_CAMERA
    y, x = np.nonzero(depth)
    z = depth[y, x].astype(np.float64)
    u = to * ((x - cx) / focal + COLOUR_BESIDE[0] / z) + tx
    v = to * ((y - cy) / focal + COLOUR_BESIDE[1] / z) + ty
    u, v = np.rint(u).astype(int), np.rint(v).astype(int)
    inside = (u >= 0) & (u < w) & (v >= 0) & (v < h)
    seen = np.full((h, w), np.inf)
    np.minimum.at(seen, (v[inside], u[inside]), z[inside])
    return np.where(np.isfinite(seen), seen, 0).astype(np.uint16)


@dataclass(frozen=True)
class Sequence:
    """Frames of a repository: folder, names of picture and depth by number, and, if it is not one camera,
    how the depth is brought into the picture."""

    repository: str
    image: str
    depth: str
    step: int
    to_picture: Callable[[NDArray], NDArray] | None = None


SEQUENCES = {
    "redkitchen": Sequence(
        "tsdf-fusion-python/data", "frame-{:06d}.color.jpg", "frame-{:06d}.depth.png", 5, registered
    ),
    "hololens": Sequence(
        "deep-video-mvs/sample-data/hololens-dataset/000", "images/{:05d}.png", "depth/{:05d}.png", 1
    ),
    "icl": Sequence(
        "open3d_downloads/tests/reconstruction_system/livingroom1_clean_micro",
        "image/{:05d}.jpg",
        "depth/{:05d}.png",
        5,
    ),
}


UNTUNED = (
    "redkitchen-075", "redkitchen-200", "redkitchen-380", "redkitchen-530", "redkitchen-560",
    "redkitchen-920", "hololens-045", "hololens-060", "icl-060", "icl-120",
)  # fmt: skip
"""By which no setting was chosen."""
LOOKED_AT = (
    "redkitchen-000", "redkitchen-450", "redkitchen-600", "redkitchen-900", "hololens-200", "hololens-300",
    "icl-075", "icl-100", "icl-140",
)  # fmt: skip
"""That were in view when ``plane_colour`` was chosen."""
MAPPED = (
    *UNTUNED, *LOOKED_AT, "redkitchen-280", "redkitchen-680", "redkitchen-750", "redkitchen-830",
    "hololens-030", "hololens-078", "hololens-100", "hololens-130", "hololens-280",
)  # fmt: skip
"""All that were tried and of which COLMAP registers enough; ``redkitchen-280`` is ``kitchen`` once more."""


def is_stretch(name: str) -> bool:
    """Whether a set's name is that of a stretch, as ``icl-140``."""
    sequence, _, first = name.partition("-")
    return sequence in SEQUENCES and first.isdigit()


def made(name: str, root: Path) -> Path:
    """The workspace of a stretch; taken out of its sequence, and mapped, if it is not there yet.

    Raises:
        SystemExit: the sequence is not there, or COLMAP does not register enough of the frames.
    """
    folder = (root / name).resolve()
    if (folder / "gt" / "gt.json").exists():
        return folder
    word, _, first = name.partition("-")
    sequence = SEQUENCES[word]
    base = SOURCES / sequence.repository
    frames = [int(first) + sequence.step * i for i in range(VIEWS)]
    for part in ("images", "gt"):
        shutil.rmtree(folder / part, ignore_errors=True)
    for part in ("images", "gt/depth"):
        (folder / part).mkdir(parents=True)
    for frame in frames:
        image, depth = base / sequence.image.format(frame), base / sequence.depth.format(frame)
        measured = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
        if measured is None or not image.is_file():
            sys.exit(f"{image} or {depth} is not there; {__file__} says how to get the sequences")
        measured[measured > FARTHEST] = 0
        os.symlink(image.resolve(), folder / "images" / image.name)
        truth = measured if sequence.to_picture is None else sequence.to_picture(measured)
        cv2.imwrite(str(folder / "gt" / "depth" / f"{image.stem}.png"), truth)
    model = max(ensure_model(folder, num_threads=1), key=_views)
    if _views(model) < FEWEST:
        sys.exit(f"{model}: COLMAP registered {_views(model)} of {VIEWS} frames, fewer than {FEWEST}")
    told = {
        "model": str(model.relative_to(folder)),
        "metres_per_colmap_unit": float(np.median(measured_by_triangulated(folder, model))),
        "images": _views(model),
    }
    (folder / "gt" / "gt.json").write_text(json.dumps(told), encoding="utf-8")
    return folder


def _views(model: Path) -> int:
    return len(_pycolmap.registered(_pycolmap.read_model(model)))


def measured_by_triangulated(folder: Path, path: Path) -> Floats:
    """Measured depth, metres, by triangulated depth in the model's unit, of each observation with both."""
    model = _pycolmap.read_model(path)
    tracks, ratios = read_tracks(model), []
    for entry in _pycolmap.registered(model):
        file = folder / "gt" / "depth" / f"{Path(entry.name).stem}.png"
        depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.float64) / 1000
        seen = tracks.images[entry.image_id]
        pose = entry.cam_from_world
        z = tracks.xyz[seen.point] @ pose[2, :3] + pose[2, 3]
        x, y = np.floor(seen.xy).astype(int).T
        measured = depth[y.clip(0, depth.shape[0] - 1), x.clip(0, depth.shape[1] - 1)]
        ratios.append(measured[measured > 0] / z[measured > 0])
    return np.concatenate(ratios)


def agreeing(folder: Path) -> float:
    """Share of the observations of COLMAP's points whose depth is within 5 % of the sensor's."""
    told = json.loads((folder / "gt" / "gt.json").read_text("utf-8"))
    ratios = measured_by_triangulated(folder, folder / told["model"])
    return float((np.abs(told["metres_per_colmap_unit"] / ratios - 1) < 0.05).mean())


def row(name: str, folder: Path) -> str:
    """A line of the table: how good COLMAP's model of a stretch is."""
    told = json.loads((folder / "gt" / "gt.json").read_text("utf-8"))
    cameras = [entry.camera for entry in _pycolmap.registered(_pycolmap.read_model(folder / told["model"]))]
    bent = max(map(pincushion, cameras))
    return f"| {name} | {told['images']} | {agreeing(folder):.3f} | {100 * bent:.1f} |"


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", type=stretch, default=list(MAPPED), metavar="SEQUENCE-FRAME")
    parser.add_argument("--work", type=Path, default=Path("runs/unseen"), help="folder of the workspaces")
    to_file(parser)
    return parser


def stretch(name: str) -> str:
    """The name of a stretch, if it is one.

    Raises:
        ArgumentTypeError: it is none.
    """
    if is_stretch(name):
        return name
    raise argparse.ArgumentTypeError(f"{name} is no stretch of {', '.join(SEQUENCES)}")


def main() -> None:
    """Make stretches and tell of each how good COLMAP's model of it is."""
    args = parser().parse_args()
    names = "" if args.names == list(MAPPED) else " " + " ".join(args.names)
    told = (
        f"`python -m benchmarks.unseen{names}`: frames that COLMAP registered, share of its points, each in "
        "every view that sees it, within 5 % of the sensor, pincushion distortion at the corners in per cent."
    )
    text = "# COLMAP's models\n\n" + paragraph(told)
    text += "\n| stretch | frames | points agree | pincushion |\n|---|---|---|---|\n"
    text += "".join(row(name, made(name, args.work)) + "\n" for name in args.names)
    publish(text, args.output, args.part)


if __name__ == "__main__":
    main()
