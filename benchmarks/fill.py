"""``densify --fill_only`` on a real PatchMatch result: the two alone and together, scored against the sensor.

    python -m benchmarks.fill kitchen --work runs/fill [--output docs/outputs.md]

COLMAP's PatchMatch needs CUDA. Here its place is taken by the one of pyarchinit-photogrammetry-core (PyPI;
``--no-deps`` is enough), at half resolution, on the images and cameras that COLMAP's ``image_undistorter``
writes; its maps are filtered as ``patch_match_stereo`` does with ``geom_consistency`` (a depth stays if at
least two other views lead back to its pixel within one pixel) and written in COLMAP's formats. What follows
is the command that a user would give.
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.quality import COLUMNS, copied, run, scored
from benchmarks.sets import SETS, workspace
from benchmarks.tables import paragraph, publish, to_file
from colmap_tco import _pycolmap
from colmap_tco.export.dense import DenseView, open_dense
from colmap_tco.maps import map_intrinsics, write_map
from colmap_tco.tracks import covisibility, read_tracks
from colmap_tco.workspace import DensePaths, open_workspace

SOURCES = 4
CONSISTENT_VIEWS, CONSISTENT_PIXELS = 2, 1.0
"""COLMAP's ``filter_min_num_consistent`` and ``filter_geom_consistency_max_cost``."""

Floats = NDArray[np.floating]


class Maps(NamedTuple):
    """Depth (H, W) and normals (H, W, 3) of a view, in its camera frame; 0 where there are none."""

    depth: Floats
    normal: Floats


def undistorted(root: Path, dense: Path) -> None:
    """COLMAP's dense workspace of the best model of ``root``, without maps."""
    workspace = open_workspace(root)
    pycolmap = _pycolmap.load()
    pycolmap.undistort_images(dense, workspace.model_path, root / "images", output_type="COLMAP")


def patchmatch(paths: DensePaths, views: Sequence[DenseView], near: Sequence[int], i: int, z: Floats) -> Maps:
    """Unfiltered maps of view ``i`` from its neighbours, at half resolution; z: depths of its points."""
    import ppg_core

    def half(view: DenseView) -> tuple[Floats, tuple[float, ...]]:
        picture = cv2.imread(str(paths.image(view.name)), cv2.IMREAD_GRAYSCALE)
        picture = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        fx, fy, cx, cy = map_intrinsics(view.camera, picture.shape)
        # The package counts pixels from the centre of the first.
        return (picture / 255.0).astype(np.float32), (fx, fy, cx - 0.5, cy - 0.5)

    ref, sources = views[i], []
    for j in near:
        turn = views[j].cam_from_world[:, :3] @ ref.cam_from_world[:, :3].T
        shift = views[j].cam_from_world[:, 3] - turn @ ref.cam_from_world[:, 3]
        sources.append((*half(views[j]), turn, shift))
    low, high = np.percentile(z, [1, 99])
    depth, normal, _ = ppg_core.patchmatch_depth(*half(ref), sources, (0.7 * low, 1.5 * high))
    return Maps(np.asarray(depth, np.float32), np.asarray(normal, np.float32))


def back_and_forth(views: Sequence[DenseView], maps: Sequence[Maps], i: int, j: int) -> Floats:
    """Distance (H, W) in pixels from each pixel of view i to where view j's depth there leads back to."""
    h, w = maps[i].depth.shape
    K = [intrinsics(views[k], maps[k].depth.shape) for k in (i, j)]
    u, v = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    pixels = np.stack([u, v, np.ones_like(u)], -1)
    pose = [view.cam_from_world for view in (views[i], views[j])]
    turn = pose[1][:, :3] @ pose[0][:, :3].T
    shift = pose[1][:, 3] - turn @ pose[0][:, 3]
    there = (pixels @ np.linalg.inv(K[0]).T * maps[i].depth[..., None]) @ turn.T + shift
    at = there @ K[1].T / np.maximum(there[..., 2:], 1e-9)
    x, y = np.floor(at[..., 0]).astype(int), np.floor(at[..., 1]).astype(int)
    hj, wj = maps[j].depth.shape
    seen = (maps[i].depth > 0) & (there[..., 2] > 0) & (x >= 0) & (x < wj) & (y >= 0) & (y < hj)
    depth = np.where(seen, maps[j].depth[np.where(seen, y, 0), np.where(seen, x, 0)], 0)
    back = (at @ np.linalg.inv(K[1]).T * depth[..., None] - shift) @ turn @ K[0].T
    distance = np.linalg.norm(back[..., :2] / np.maximum(back[..., 2:], 1e-9) - pixels[..., :2], axis=-1)
    return np.where(seen & (depth > 0), distance, np.inf)


def intrinsics(view: DenseView, shape: tuple[int, ...]) -> Floats:
    """(3, 3) of a map of this shape."""
    fx, fy, cx, cy = map_intrinsics(view.camera, shape)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def consistent(views: Sequence[DenseView], maps: Sequence[Maps], near: Sequence[Sequence[int]]) -> list[Maps]:
    """The maps without the depths that too few neighbours confirm."""
    out = []
    for i, own in enumerate(maps):
        agreeing = sum((back_and_forth(views, maps, i, j) <= CONSISTENT_PIXELS).astype(int) for j in near[i])
        keep = agreeing >= CONSISTENT_VIEWS
        out.append(Maps(np.where(keep, own.depth, 0), np.where(keep[..., None], own.normal, 0)))
    return out


def write_maps(paths: DensePaths, maps: Mapping[str, Maps]) -> None:
    """Maps by name of the image, where COLMAP has its geometric ones."""
    for name, (depth, normal) in maps.items():
        for file, array in ((paths.depth_map(name), depth), (paths.normal_map(name), normal)):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_map(file, array.astype(np.float32))


def neighbours(views: Sequence[DenseView], common: NDArray[Any], depth: float) -> list[list[int]]:
    """For each view those whose distance is nearest to an eighth of the depth, among those that overlap."""
    centres = np.stack([-v.cam_from_world[:, :3].T @ v.cam_from_world[:, 3] for v in views])
    found = []
    for i in range(len(views)):
        away = np.abs(np.linalg.norm(centres - centres[i], axis=1) / depth - 0.125)
        away[(common[i] == 0) | (np.arange(len(views)) == i)] = np.inf
        found.append([j for j in np.argsort(away, kind="stable")[:SOURCES].tolist() if np.isfinite(away[j])])
    return found


def make_patchmatch(root: Path, dense: Path) -> None:
    """The dense workspace that COLMAP would have made of ``root``, with filtered maps."""
    undistorted(root, dense)
    opened = open_dense(dense)
    views, paths = opened.views, opened.paths
    tracks = read_tracks(opened.model)
    xyz = {view.name: _points_of(opened.model, view) for view in views}
    z = {v.name: xyz[v.name] @ v.cam_from_world[2, :3] + v.cam_from_world[2, 3] for v in views}
    common = covisibility(tracks, [view.image_id for view in views]).common
    near = neighbours(views, common, float(np.median(np.concatenate(list(z.values())))))
    raw = [patchmatch(paths, views, near[i], i, z[views[i].name]) for i in range(len(views))]
    kept = consistent(views, raw, near)
    write_maps(paths, {view.name: m for view, m in zip(views, kept, strict=True)})


def _points_of(model: Any, view: DenseView) -> Floats:
    """World points (N, 3) that a view observes."""
    ids, xyz, _ = _pycolmap.points(model)
    place = {point: at for at, point in enumerate(ids.tolist())}
    return xyz[[place[p] for p in _pycolmap.observations(model, view.image_id)[1].tolist()]]


def line(what: str, figures: Mapping[str, float]) -> str:
    """A row of the table."""
    cells = " | ".join(f"{figures[c]:.4g}" if figures.get(c) is not None else "" for c in COLUMNS)
    return f"| {what} | {cells} |\n"


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", choices=SETS)
    parser.add_argument("--work", type=Path, default=Path("runs/fill"))
    to_file(parser)
    return parser


def main() -> None:
    """Command line; other options are handed to densify."""
    args, rest = parser().parse_known_args()
    if importlib.util.find_spec("ppg_core") is None:
        sys.exit("this needs a PatchMatch: pip install --no-deps pyarchinit-photogrammetry-core==0.5.0")
    args.work.mkdir(parents=True, exist_ok=True)
    root, dense = copied(args.set, args.work), args.work / f"{args.set}-patchmatch"
    if not dense.exists():
        making = dense.with_name(dense.name + ".part")
        shutil.rmtree(making, ignore_errors=True)
        make_patchmatch(root, making)
        making.rename(dense)
    truth, count = workspace(args.set, args.work.parent), len(list((root / "images").iterdir()))
    figures, _ = scored(truth, "--dense", str(dense))
    text = paragraph(
        f"`{args.set}`, {count} views (`python -m benchmarks.fill {args.set}`): PatchMatch of "
        "pyarchinit-photogrammetry-core at half resolution on COLMAP's undistorted images, filtered as "
        "COLMAP does (two views within a pixel), against the sensor; columns as in `docs/quality.md`. f5 and "
        "points are of the cloud, for PatchMatch of the pixels of all maps where the sensor measured."
    )
    text += f"\n| | {' | '.join(COLUMNS)} |\n" + "|---" * (len(COLUMNS) + 1) + "|\n"
    text += line("PatchMatch", figures)
    for what, more in (("network and optimisation", []), ("--fill_only", ["--fill_only", str(dense)])):
        command = [sys.executable, "-m", "colmap_tco", "densify", str(root), "--overwrite", *more, *rest]
        run(command)
        kept = args.work / f"{args.set}{'-filled' if more else '-alone'}"
        shutil.rmtree(kept, ignore_errors=True)
        shutil.copytree(root / "dense-tco", kept)
        text += line(what, scored(truth, "--dense", str(kept))[0])
    publish(text, args.output, args.part)


if __name__ == "__main__":
    main()
