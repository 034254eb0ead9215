"""For OpenMVS: a dense workspace that its ``InterfaceCOLMAP`` reads whole.

The importer wants more than COLMAP does (observed in ``apps/InterfaceCOLMAP/InterfaceCOLMAP.cpp``):

- The model in ``sparse/`` itself, text before binary, older versions text alone; PINHOLE cameras alone.
- ``fused.ply.vis`` counts images in the order of the file, the depth maps count by id less one; ids 1, 2, …
  in that order make the two the same.
- Depth and normal maps are looked up by the last part of the image's name, in one folder.
- Neighbours by name, separated by commas, in ``stereo/patch-match.cfg``; ``__auto__`` and ``__all__`` give
  none. An empty line ends the list of all.
- A name in a text file ends at a blank.
- Points are held in float32, so that a model in map coordinates is moved to the origin
  (:mod:`colmap_tco.export.centred`).
"""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import numpy as np

from colmap_tco import _pycolmap
from colmap_tco.atomic import write_text
from colmap_tco.errors import InputError
from colmap_tco.export.centred import moved, offset_for, tell_offset
from colmap_tco.export.command import copy_images
from colmap_tco.export.dense import Dense, DenseView, flat_names
from colmap_tco.ply import Visibility, write_ply, write_vis
from colmap_tco.sparse_format import SparseImage, SparseModel, SparsePoints, write_model_text
from colmap_tco.tracks import covisibility, read_tracks
from colmap_tco.workspace import DensePaths

log = logging.getLogger(__name__)

MOST_NEIGHBOURS = 20
"""Neighbours where COLMAP chose them itself, its own default."""


def write_openmvs(dense: Dense, folder: Path) -> str:
    """Fill ``folder``; returns a sentence on what is in it.

    Raises:
        InputError: a file is missing or damaged.
    """
    target = DensePaths(folder)
    views = sorted(dense.views, key=lambda view: view.name)
    names = flat_names([view.name for view in views])
    copy_images(dense, names, target.images)
    cloud = dense.cloud()
    offset = offset_for(cloud.points)
    write_model_text(target.sparse, moved(_sparse(dense, views, names), offset))
    _write_maps(dense, views, names, target)
    neighbours = _neighbours(dense, views)
    listed = {name: [names[n] for n in others] for name, others in neighbours.items() if others}
    lines = [f"{names[name]}\n{', '.join(others)}\n" for name, others in listed.items()]
    write_text(target.patch_match_cfg, "".join(lines))
    write_text(target.fusion_cfg, "".join(f"{names[view.name]}\n" for view in views))
    if len(listed) < len(views):
        log.warning(
            "%d images have no neighbours: no other sees a point that they see", len(views) - len(listed)
        )
    order = {view.name: i for i, view in enumerate(views)}
    place = np.array([order[view.name] for view in dense.views], np.uint32)
    write_ply(target.ply, cloud.points - offset, cloud.normals, cloud.colors)
    write_vis(target.vis, Visibility(cloud.visibility.start, place[cloud.visibility.images]))
    tell_offset(folder, offset)
    return (
        f"{len(views)} images with depth maps, {len(cloud)} points; "
        "to read it: InterfaceCOLMAP -w (this folder) -i . -o scene.mvs"
    )


def _sparse(dense: Dense, views: list[DenseView], names: dict[str, str]) -> SparseModel:
    """The triangulated points with their tracks, ids counted from 1."""
    ids, xyz, rgb = _pycolmap.points(dense.model)
    renumbered = {old: new for new, old in enumerate(ids.tolist(), 1)}
    cameras = {old: new for new, old in enumerate(sorted({view.camera_id for view in views}), 1)}
    images, seen = [], []
    for image_id, view in enumerate(views, 1):
        xy, points = _pycolmap.observations(dense.model, view.image_id)
        own = np.array([renumbered[p] for p in points.tolist()], np.int64)
        seen.append(np.stack([own, np.full(len(own), image_id), np.arange(len(own))], 1))
        images.append(
            SparseImage(image_id, names[view.name], cameras[view.camera_id], view.cam_from_world, xy, own)
        )
    flat = np.concatenate(seen)
    flat = flat[np.lexsort((flat[:, 1], flat[:, 0]))]
    start = np.concatenate([[0], np.bincount(flat[:, 0] - 1, minlength=len(ids)).cumsum()])
    points3d = SparsePoints(
        np.arange(1, len(ids) + 1),
        xyz,
        rgb,
        _pycolmap.point_errors(dense.model),
        start,
        flat[:, 1],
        flat[:, 2],
    )
    return SparseModel({cameras[v.camera_id]: v.camera for v in views}, images, points3d)


def _write_maps(dense: Dense, views: list[DenseView], names: dict[str, str], target: DensePaths) -> None:
    (target.stereo / "consistency_graphs").mkdir(parents=True)
    for view in views:
        for old, new in (
            (dense.paths.depth_map(view.name), target.depth_map(names[view.name])),
            (dense.paths.normal_map(view.name), target.normal_map(names[view.name])),
        ):
            if not old.is_file():
                raise InputError(f"{old}: there is no such map; make the depth maps first")
            new.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(old, new)


def _neighbours(dense: Dense, views: list[DenseView]) -> dict[str, list[str]]:
    """Name → names of its neighbours: those listed, else those with which it shares most points."""
    found = _listed_neighbours(dense.paths.patch_match_cfg, {view.name for view in views})
    if len(found) == len(views):
        return found
    common = covisibility(read_tracks(dense.model), [view.image_id for view in views]).common
    for i, view in enumerate(views):
        if view.name not in found:
            best = np.argsort(-common[i], kind="stable")[:MOST_NEIGHBOURS].tolist()
            found[view.name] = [views[j].name for j in best if common[i, j] > 0]
    return {view.name: found[view.name] for view in views}


def _listed_neighbours(path: Path, known: set[str]) -> dict[str, list[str]]:
    """Name → names of the neighbours in an explicit list of patch-match.cfg, where there is one."""
    text = path.read_text("utf-8") if path.is_file() else ""
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    found = {}
    for name, listed in zip(lines[::2], lines[1::2], strict=False):
        others = [n for n in map(str.strip, listed.split(",")) if n in known and n != name]
        if name in known and others:
            found[name] = others
    return found
