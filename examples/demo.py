"""Render a room, reconstruct it with COLMAP, densify it, and compare the result with the rendered truth.

Run by ``make demo``. Everything is made in the folder ``demo/``; nothing is downloaded. A second run keeps
the pictures and COLMAP's model, and makes the rest anew.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_tco.cli import main as colmap_tco
from colmap_tco.errors import PartlyDoneError
from colmap_tco.maps import read_map
from examples.picture import cloud_picture
from training.scenes import Sample, walk


def write_images(sample: Sample, folder: Path) -> list[str]:
    """Save the views as JPEG files, but for those that are there already, and return their names."""
    folder.mkdir(parents=True, exist_ok=True)
    files = pictures(sample)
    for name, content in files.items():
        if not holds(folder / name, content):
            (folder / name).write_bytes(content)
    return list(files)


def pictures(sample: Sample) -> dict[str, bytes]:
    """Name → JPEG file of each view."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, 95]
    encoded = [cv2.imencode(".jpg", image[..., ::-1], quality)[1] for image in sample.images]
    return {f"view_{i:02d}.jpg": content.tobytes() for i, content in enumerate(encoded)}


def holds(file: Path, content: bytes) -> bool:
    """Whether a file is there and holds these bytes."""
    return file.is_file() and file.read_bytes() == content


def drop_other_scene(sample: Sample, root: Path) -> None:
    """Remove the pictures and the model of another scene, which an earlier demo made here.

    Raises:
        SystemExit: pictures are there that no demo made.
    """
    ours, there = pictures(sample), sorted((root / "images").glob("*"))
    if all(holds(path, ours.get(path.name, b"")) for path in there):
        return
    if not all(path.match("view_??.jpg") for path in there):
        sys.exit(f"{root / 'images'} holds pictures that are not the demo's; name another --folder")
    shutil.rmtree(root / "images")
    shutil.rmtree(root / "sparse", ignore_errors=True)
    (root / "database.db").unlink(missing_ok=True)


def accuracy(sample: Sample, names: list[str], dense: Path) -> dict[str, float]:
    """Share of the depth pixels within 2 and 5 % of the truth, holes counted as wrong, and median error.

    COLMAP's unit is free; its ratio to the truth's is that of the distances between camera centres.
    """
    from colmap_tco import _pycolmap

    entries = {e.name: e for e in _pycolmap.registered(_pycolmap.read_model(dense / "sparse"))}
    used = [i for i, name in enumerate(names) if name in entries]
    ours = spread([entries[names[i]].cam_from_world for i in used])
    unit = spread([m[:3] for m in sample.cam_from_world[used]]) / ours
    errors, total = [], 0
    for i in used:
        depth = read_map(dense / "stereo" / "depth_maps" / f"{names[i]}.geometric.bin") * unit
        depth = cv2.resize(depth, sample.depth.shape[:0:-1], interpolation=cv2.INTER_NEAREST)
        seen = (sample.depth[i] > 0) & (depth > 0)
        errors.append(np.abs(depth[seen] / sample.depth[i][seen] - 1))
        total += int((sample.depth[i] > 0).sum())
    error = np.concatenate(errors)
    return {
        "within_2_percent": float((error < 0.02).sum() / total),
        "within_5_percent": float((error < 0.05).sum() / total),
        "median_error": float(np.median(error)),
    }


def spread(poses: list[NDArray[np.floating]]) -> float:
    """Root mean square distance of camera centres from their mean."""
    centres = np.array([-m[:, :3].T @ m[:, 3] for m in poses])
    return float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the demo, where other flags are those of densify, whose exit code this is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path("demo"))
    parser.add_argument("--views", type=int, default=10)
    args, rest = parser.parse_known_args(argv)
    sample = walk(seed=4, views=args.views, shape=(480, 640))
    drop_other_scene(sample, args.folder)
    names = write_images(sample, args.folder / "images")
    code = colmap_tco(["densify", str(args.folder), "--overwrite", *rest])
    dense = args.folder / "dense-tco"
    if code not in (0, PartlyDoneError.exit_code):  # what is there, if anything, is of an earlier run
        return code
    figures = accuracy(sample, names, dense)
    cv2.imwrite(str(args.folder / "cloud.png"), cloud_picture(dense)[..., ::-1])
    percent = {name: f"{100 * value:.2f} %" for name, value in figures.items()}
    sys.stdout.write(
        f"cloud   {dense / 'fused.ply'}\n"
        f"report  {dense / 'report.json'}\n"
        f"picture {args.folder / 'cloud.png'}\n"
        f"against the rendered truth: {percent['within_5_percent']} of all pixels within 5 %, "
        f"{percent['within_2_percent']} within 2 %, median error {percent['median_error']}\n"
    )
    return code


if __name__ == "__main__":
    sys.exit(main())
