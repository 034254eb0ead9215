"""A finished dense workspace, ours or COLMAP's own, as the exporters and the mesher read it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Floats, Model
from colmap_tco.errors import InputError
from colmap_tco.pinhole import Pinhole
from colmap_tco.ply import Cloud, read_ply, read_vis
from colmap_tco.thin import thin
from colmap_tco.workspace import DensePaths, dense_paths, existing_root

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DenseView:
    """An undistorted image.

    Attributes:
        image_id: COLMAP's.
        name: relative to ``images/``.
        camera_id: of its camera.
        camera: PINHOLE.
        cam_from_world: (3, 4) float64.
    """

    image_id: int
    name: str
    camera_id: int
    camera: Pinhole
    cam_from_world: Floats


@dataclass(frozen=True)
class Dense:
    """A dense workspace.

    Attributes:
        paths: of its files.
        model: the undistorted ``pycolmap.Reconstruction``.
        views: its images in the order in which ``fused.ply.vis`` counts them.
    """

    paths: DensePaths
    model: Model
    views: tuple[DenseView, ...]

    def cloud(self) -> Cloud:
        """The fused cloud with its visibility.

        Raises:
            InputError: a file is missing or damaged, the cloud is empty, or the two do not fit together.
        """
        points, normals, colors = read_ply(self.paths.ply)
        visibility = read_vis(self.paths.vis)
        if not len(points):
            raise InputError(f"{self.paths.ply} has no points; its report says which filter removed them")
        if len(visibility) != len(points):
            raise InputError(
                f"{self.paths.vis} is of {len(visibility)} points, {self.paths.ply.name} has {len(points)}: "
                "they are of different runs; fuse again"
            )
        if len(visibility.images) and int(visibility.images.max()) >= len(self.views):
            raise InputError(
                f"{self.paths.vis} names image {visibility.images.max()}, {self.paths.sparse} has "
                f"{len(self.views)}: they are of different runs; fuse again"
            )
        return Cloud(points.astype(np.float64), normals.astype(np.float32), colors, visibility)


def open_dense(root: Path) -> Dense:
    """The dense workspace of ``root``: its ``dense-tco/``, or ``root`` itself where that is one.

    Raises:
        InputError: neither is there, its model cannot be read, or a camera is not PINHOLE.
    """
    root = existing_root(root)
    found = [p for p in (dense_paths(root), DensePaths(root)) if p.sparse.is_dir() and p.stereo.is_dir()]
    if not found:
        raise InputError(
            f"{root}: no dense workspace, neither {dense_paths(root).root.name}/ in it nor sparse/ and "
            f"stereo/; make it with: colmap-tco densify {root}"
        )
    paths = found[0]
    model = _pycolmap.read_model(paths.sparse)
    entries = {entry.image_id: entry for entry in _pycolmap.registered(model)}
    views = []
    for key in model.reg_image_ids():
        entry = entries[int(key)]
        if entry.camera.model.name != "PINHOLE":
            raise InputError(
                f"{paths.sparse}: {entry.name} has a {entry.camera.model.name} camera, where a dense "
                "workspace has PINHOLE; undistort the images with colmap image_undistorter"
            )
        fx, fy, cx, cy = map(float, entry.camera.params)
        pinhole = Pinhole(*_pycolmap.camera_size(entry.camera), fx, fy, cx, cy)
        camera_id = int(entry.camera.camera_id)
        views.append(DenseView(entry.image_id, entry.name, camera_id, pinhole, entry.cam_from_world))
    return Dense(paths, model, tuple(views))


def thinned(cloud: Cloud, max_points: int) -> Cloud:
    """At most so many points, evenly spread (:mod:`colmap_tco.thin`), in their old order; 0 keeps all."""
    if not 0 < max_points < len(cloud):
        return cloud
    return cloud.select(thin(cloud.points, max_points=max_points))


def flat_names(names: list[str]) -> dict[str, str]:
    """Old name → name without folders, blanks and commas, each once; what is so already stays."""
    out: dict[str, str] = {}
    used = {name for name in names if _flat(name) == name}
    for name in names:
        new = _flat(name)
        if new != name:
            stem, count = Path(new), 2
            while new in used:
                new, count = f"{stem.stem}_{count}{stem.suffix}", count + 1
            used.add(new)
        out[name] = new
    return out


def _flat(name: str) -> str:
    return "_".join(name.replace("/", " ").replace("\\", " ").replace(",", " ").split())
