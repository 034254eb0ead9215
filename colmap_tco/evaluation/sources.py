"""What ``colmap-tco evaluate`` compares: results and truths, found out from what lies at a path."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco._open3d import open3d
from colmap_tco._pycolmap import Registered
from colmap_tco.errors import InputError
from colmap_tco.evaluation.checks import as_poses
from colmap_tco.evaluation.eth3d import Scan
from colmap_tco.export.dense import Dense, open_dense
from colmap_tco.workspace import DensePaths, dense_paths, find_models

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

CLOUDS = (".ply", ".pcd", ".xyz", ".xyzn", ".pts")
MESHES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")
TRAJECTORIES = (".txt", ".tum")
SCANS = ".mlp"
MAPS = (".png", ".npy", ".bin")
MESH_POINTS = 1_000_000
"""Points spread over a mesh where no other number is asked for."""
_LISTED = 5


@dataclass(frozen=True)
class Outcome:
    """A reconstruction to be evaluated; at least one of its parts is there.

    Attributes:
        path: what the user named.
        dense: the dense workspace, or None.
        cloud: file of the cloud, or None.
        cameras: name → image of the sparse model that the truth's pixels and poses belong to.
        figures: where the figures go unless the user says otherwise.
    """

    path: Path
    dense: Dense | None
    cloud: Path | None
    cameras: Mapping[str, Registered]
    figures: Path


@dataclass(frozen=True)
class CloudTruth:
    """A cloud, a mesh, or laser scans.

    Attributes:
        path: of the file.
        scans: with the positions of the scanner, where these are known.
    """

    path: Path
    scans: tuple[Scan, ...] = ()

    def points(self, samples: int, seed: int) -> Floats:
        """All points (N, 3); of a mesh, see :func:`read_points`."""
        if self.scans:
            return np.concatenate([scan.world for scan in self.scans])
        return read_points(self.path, samples, seed)


@dataclass(frozen=True)
class DepthTruth:
    """A folder of depth maps."""

    path: Path


@dataclass(frozen=True)
class PoseTruth:
    """True cameras.

    Attributes:
        path: where they are from.
        poses: (N, 4, 4) world_from_cam.
        names: of their images, or empty.
        times: (N,) timestamps, or empty.
    """

    path: Path
    poses: Floats
    names: tuple[str, ...] = ()
    times: Floats = field(default_factory=lambda: np.zeros(0))


Truth = CloudTruth | DepthTruth | PoseTruth


def open_outcome(path: Path, model_path: Path | None = None) -> Outcome:
    """Find out what a result is: a workspace with ``dense-tco/``, a dense workspace, a model, or a cloud.

    Args:
        path: of the result.
        model_path: folder of the model whose cameras the truth belongs to. None: for our own results the one
            that they were made from, for others their own.

    Raises:
        InputError: there is nothing of these, or a file is damaged.
    """
    path = path.expanduser().absolute()
    if path.is_file():
        if path.suffix.lower() not in CLOUDS + MESHES:
            raise InputError(f"{path}: not a cloud that can be read ({', '.join(CLOUDS)})")
        cameras = read_cameras(model_path) if model_path else {}
        return Outcome(path, None, path, cameras, path.with_name(f"{path.stem}-evaluation.json"))
    if not path.is_dir():
        raise InputError(f"{path}: there is no such result")
    beside = path.with_name(f"{path.name}-evaluation.json")
    if any(p.sparse.is_dir() and p.stereo.is_dir() for p in (dense_paths(path), DensePaths(path))):
        dense = open_dense(path)
        ours = dense.paths.root.name == dense_paths(path).root.name
        cameras = read_cameras(model_path or _original_model(dense.paths))
        cloud = dense.paths.ply if dense.paths.ply.is_file() else None
        figures = dense.paths.root / "evaluation.json" if ours else beside
        return Outcome(path, dense, cloud, cameras, figures)
    if not model_path and not _models(path):
        raise InputError(
            f"{path}: no dense workspace (dense-tco/, or sparse/ and stereo/), no COLMAP model, and no cloud"
        )
    return Outcome(path, None, None, read_cameras(model_path or path), beside)


def _original_model(paths: DensePaths) -> Path:
    """The model that a dense workspace was made from, as far as it is known; else its own."""
    if paths.report.is_file():
        try:
            noted = json.loads(paths.report.read_text(encoding="utf-8")).get("workspace", {}).get("model", "")
        except (ValueError, AttributeError) as error:
            raise InputError(f"{paths.report}: not a report of colmap-tco ({error})") from error
        if noted and _models(Path(noted)):
            return Path(noted)
    if paths.root.name == dense_paths(paths.root).root.name and _models(paths.root.parent):
        return paths.root.parent
    return paths.sparse


def _models(folder: Path) -> list[Path]:
    """Models in a folder, which may be the one that COLMAP's mapper wrote them into."""
    if not folder.is_dir():
        return []
    inside = [sub for sub in sorted(folder.iterdir()) if sub.is_dir() and sub in find_models(sub)]
    return find_models(folder) or inside


def read_cameras(folder: Path) -> dict[str, Registered]:
    """Name → image of the model in a folder; of several models, of the one with most images.

    Raises:
        InputError: no model, or none that can be read and has poses.
    """
    folders = _models(folder.expanduser().absolute())
    if not folders:
        raise InputError(f"{folder}: no COLMAP model, neither in it nor in its sparse/")
    models = [_pycolmap.registered(_pycolmap.read_model(one)) for one in folders]
    best = max(range(len(models)), key=lambda i: len(models[i]))
    if not models[best]:
        raise InputError(f"{folder}: its model has no image with a pose")
    if len(folders) > 1:
        log.info("cameras of %s, of %d models the one with most images", folders[best], len(folders))
    return {entry.name: entry for entry in models[best]}


def world_from_cam(entries: list[Registered]) -> Floats:
    """Poses (N, 4, 4) of images."""
    out = np.tile(np.eye(4), (len(entries), 1, 1))
    for pose, entry in zip(out, entries, strict=True):
        R, t = entry.cam_from_world[:, :3], entry.cam_from_world[:, 3]
        pose[:3, :3], pose[:3, 3] = R.T, -R.T @ t
    return out


def open_truth(path: Path) -> Truth:
    """Find out what a truth is: a cloud or mesh, a folder of depth maps, a model, or a TUM trajectory.

    Raises:
        InputError: it is none of these.
    """
    path = path.expanduser().absolute()
    if path.is_file():
        if path.suffix.lower() in CLOUDS + MESHES:
            return CloudTruth(path)
        if path.suffix.lower() in TRAJECTORIES:
            return read_tum(path)
        if path.suffix.lower() == SCANS:
            return read_scans(path)
        raise InputError(
            f"{path}: not a truth that can be read: clouds ({', '.join(CLOUDS)}), meshes "
            f"({', '.join(MESHES)}), laser scans (a MeshLab project, {SCANS}), TUM trajectories "
            f"({', '.join(TRAJECTORIES)}), and folders with depth maps or a COLMAP model"
        )
    if not path.is_dir():
        raise InputError(f"--truth {path}: there is no such file or folder")
    if _models(path):
        entries = list(read_cameras(path).values())
        return PoseTruth(path, world_from_cam(entries), tuple(entry.name for entry in entries))
    if any(file.suffix.lower() in MAPS for file in path.rglob("*") if file.is_file()):
        return DepthTruth(path)
    raise InputError(f"{path}: a folder without depth maps ({', '.join(MAPS)}) and without a COLMAP model")


def read_scans(path: Path) -> CloudTruth:
    """The laser scans of a MeshLab project, in which each ``MLMesh`` has a file and ``MLMatrix44``, its pose.

    Raises:
        InputError: it is no such project, a pose is not rigid, or a scan is missing or empty.
        MissingError: Open3D cannot be imported.
    """
    try:
        meshes = list(ElementTree.parse(path).getroot().iterfind("MeshGroup/MLMesh"))
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: not a MeshLab project ({error})") from error
    if not meshes:
        raise InputError(f"{path}: a MeshLab project without meshes")
    scans = []
    for mesh in meshes:
        name, text = mesh.get("filename", ""), mesh.findtext("MLMatrix44", "")
        try:
            (pose,) = as_poses(np.array(text.split(), np.float64).reshape(1, 4, 4), "a scan's")
        except ValueError as error:
            raise InputError(f"{path}: {name or 'a mesh'} has no rigid pose ({error})") from error
        scans.append(Scan(read_points(path.parent / name, 0, 0), pose))
    return CloudTruth(path, tuple(scans))


def read_tum(path: Path) -> PoseTruth:
    """A trajectory in the format of the TUM RGB-D benchmark: ``timestamp tx ty tz qx qy qz qw`` a line.

    The pose is that of the camera in the world; lines that begin with # are comments.

    Raises:
        InputError: a line of another form, a quaternion without direction, or no line.
    """
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != 8 or not np.isfinite(row).all() or not np.linalg.norm(row[4:]) > 1e-6:
            raise InputError(
                f"{path}, line {number}: not a pose of a TUM trajectory, which is eight numbers: "
                "timestamp tx ty tz qx qy qz qw"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: no poses")
    values = np.array(rows)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = _rotations(values[:, 4:])
    poses[:, :3, 3] = values[:, 1:4]
    return PoseTruth(path, poses, times=values[:, 0])


def _rotations(xyzw: Floats) -> Floats:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4), scalar last, of any length."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(xyzw).as_matrix(), np.float64)


def read_points(path: Path, samples: int, seed: int) -> Floats:
    """Points (N, 3) of a cloud, or so many spread evenly over the triangles of a mesh; 0: its vertices.

    Raises:
        InputError: the file is missing, cannot be read, or has neither points nor triangles.
        MissingError: Open3D cannot be imported.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such cloud")
    o3d = open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        if path.suffix.lower() in MESHES:
            mesh = o3d.io.read_triangle_mesh(str(path))
            if samples and len(mesh.triangles):
                log.info("%s: a mesh of %d triangles, %d points on it", path, len(mesh.triangles), samples)
                o3d.utility.random.seed(seed)
                return np.array(mesh.sample_points_uniformly(samples).points, np.float64)
        cloud = o3d.io.read_point_cloud(str(path)) if path.suffix.lower() in CLOUDS else None
    points = np.zeros((0, 3)) if cloud is None else np.array(cloud.points, np.float64)
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        raise InputError(f"{path}: neither points nor triangles can be read from it")
    return points


def matched(outcome: Outcome, truth: PoseTruth, by: str, tolerance: float) -> dict[str, Floats]:
    """Name → true world_from_cam (4, 4) of the images of a result.

    Args:
        outcome: the result.
        truth: the true cameras.
        by: how a trajectory's lines belong to images: ``time``, the number that is the file's name without
            its ending is the timestamp; ``order``, line k is the k-th image by name.
        tolerance: greatest difference of timestamps, seconds.

    Raises:
        InputError: nothing matches, or the numbers differ where the order decides.
    """
    names = sorted(outcome.cameras)
    if truth.names:
        of_name = dict(zip(truth.names, truth.poses, strict=True))
        found = {name: of_name[name] for name in names if name in of_name} or _by_stem(names, of_name)
        remedy = "images are matched by their names, with or without folder and ending"
    elif by == "order":
        if len(names) != len(truth.poses):
            raise InputError(
                f"{truth.path} has {len(truth.poses)} poses, {outcome.path} has {len(names)} images: by "
                "order they only match where the numbers are equal"
            )
        found = dict(zip(names, truth.poses, strict=True))
        remedy = ""
    else:
        found = _by_time(names, truth, tolerance)
        remedy = (
            "timestamps are matched with the numbers that are the images' names, within "
            f"{tolerance:g}; --match order takes the lines in the order of the names"
        )
    if not found:
        some = ", ".join(names[:_LISTED])
        raise InputError(f"{truth.path}: no pose for any image of {outcome.path} ({some}, …); {remedy}")
    if len(found) < len(names):
        log.warning("%s has no pose for %d of %d images", truth.path, len(names) - len(found), len(names))
    return found


def _by_stem(names: list[str], of_name: Mapping[str, Floats]) -> dict[str, Floats]:
    """Matches of names without folder and ending, where these are unique on both sides."""
    ours, theirs = ([Path(name).stem for name in some] for some in (names, of_name))
    poses = dict(zip(theirs, of_name.values(), strict=True))
    unique = {s for s in poses if ours.count(s) == 1 == theirs.count(s)}
    return {name: poses[Path(name).stem] for name in names if Path(name).stem in unique}


def _by_time(names: list[str], truth: PoseTruth, tolerance: float) -> dict[str, Floats]:
    found = {}
    for name in names:
        try:
            time = float(Path(name).stem)
        except ValueError:
            continue
        nearest = int(np.abs(truth.times - time).argmin())
        if abs(truth.times[nearest] - time) <= tolerance:
            found[name] = truth.poses[nearest]
    return found
