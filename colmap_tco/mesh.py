"""``colmap-tco mesh``: a coloured triangle mesh of a finished dense workspace, in COLMAP's frame.

Two ways. ``poisson`` solves for the surface whose normals are those of the fused cloud (screened Poisson
reconstruction, Kazhdan and Hoppe 2013, Open3D's implementation): smooth, closes small holes. ``tsdf``
averages the depth maps in a grid (Curless and Levoy 1996): keeps holes, follows the maps. Poisson closes
every surface, and depth maps have flying pixels, so both are cut back to what the cloud supports.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from colmap_tco._open3d import open3d
from colmap_tco.atomic import atomic_path
from colmap_tco.errors import InputError
from colmap_tco.export.dense import Dense, DenseView, open_dense
from colmap_tco.export.las import spacing
from colmap_tco.image_files import read_image
from colmap_tco.maps import map_intrinsics, read_map
from colmap_tco.ply import Cloud
from colmap_tco.progress import Progress
from tco.config import knob

if TYPE_CHECKING:
    from open3d.geometry import PointCloud, TriangleMesh

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SHALLOWEST, _DEEPEST = 5, 12
_POISSON_SCALE = 1.1
_TRUNCATION = 4.0
"""Voxels on either side of a surface that a depth map fills."""


@dataclass(frozen=True)
class MeshConfig:
    """How the surface is made and where it is cut off."""

    output_path: Path | None = knob(
        None, "PLY file; none: meshed-poisson.ply or meshed-tsdf.ply beside the cloud.", alias="-o"
    )
    method: str = knob(
        "poisson",
        "poisson: from the fused cloud, smooth and closed over small holes. tsdf: from the depth maps, with "
        "the holes that they have.",
        choices=("poisson", "tsdf"),
    )
    cell_size: float = knob(
        0.0,
        "Side of the finest cell or voxel, in units of the model; 0: twice the distance between points of "
        "the cloud. Smaller shows more detail and more noise.",
    )
    trim: float = knob(
        1.5,
        "poisson: vertices are dropped where the points are sparser than usual by so many levels of the "
        "octree (the median less this). Smaller cuts more; inf: off.",
    )
    max_distance: float = knob(
        4.0,
        "Vertices further from the cloud than so many cells are dropped: bubbles, flying pixels. inf: off.",
    )
    min_part: float = knob(
        0.001, "Connected parts of less than this share of all triangles are dropped. 0: off."
    )
    overwrite: bool = knob(False, "Replace an earlier mesh.")

    def __post_init__(self) -> None:
        for name in ("cell_size", "trim", "max_distance", "min_part"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"--{name} must not be negative, it is {getattr(self, name)}")
        if not self.min_part < 1:
            raise ValueError(f"--min_part is a share of all triangles, below 1, not {self.min_part}")
        if math.isinf(self.cell_size):
            raise ValueError("--cell_size must be finite")


@dataclass(frozen=True)
class Meshed:
    """What was written.

    Attributes:
        path: the PLY file.
        vertices: their number.
        triangles: their number.
        dropped: reason → vertices that it removed.
    """

    path: Path
    vertices: int
    triangles: int
    dropped: dict[str, int]

    def summary(self) -> str:
        """Where it is and how large."""
        cut = ", ".join(f"{count} by {reason}" for reason, count in self.dropped.items() if count)
        return f"{self.path}: {self.vertices} vertices, {self.triangles} triangles" + (
            f" (vertices dropped: {cut})" if cut else ""
        )


def mesh(root: Path, config: MeshConfig, progress: Progress) -> Meshed:
    """Make a mesh of the dense workspace of ``root``.

    Raises:
        InputError: there is no dense workspace, it is damaged, the output exists, or no triangle is left.
        MissingError: Open3D cannot be imported.
    """
    dense = open_dense(root)
    path = config.output_path or dense.paths.root / f"meshed-{config.method}.ply"
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: meshes are written as PLY; let the name end in .ply")
    if path.exists() and not config.overwrite:
        raise InputError(f"{path} exists; replace it with --overwrite or name another with -o")
    o3d = open3d()
    cloud = dense.cloud()
    centre = cloud.points.mean(0)  # Open3D computes in float32 in places
    local = cloud.points - centre
    cell = config.cell_size or 2 * spacing(local)
    of = "as --cell_size says" if config.cell_size else "twice the distance between points"
    log.info("cells of %.4g COLMAP units, %s", cell, of)
    dropped: dict[str, int] = {}
    progress.plan({"surface": 0.8, "cleaning": 0.2})
    if config.method == "poisson":
        progress.stage("surface", 1)
        surface, levels = _poisson(o3d, local, cloud, cell)
        _drop(surface, levels < np.median(levels) - config.trim, "trim", dropped)
    else:
        progress.stage("surface", len(dense.views))
        surface = _tsdf(o3d, dense, centre, cell, progress)
    progress.stage("cleaning", 1)
    if math.isfinite(config.max_distance):
        far = _distances(np.asarray(surface.vertices), local) > config.max_distance * cell
        _drop(surface, far, "max_distance", dropped)
    _drop_small_parts(surface, config.min_part, dropped)
    if not len(surface.triangles):
        raise InputError(
            f"{dense.paths.root}: no triangle is left ({dropped}); raise --max_distance, --trim or "
            "--cell_size"
        )
    surface.translate(centre)
    surface.compute_vertex_normals()
    with atomic_path(path) as unfinished:
        if not o3d.io.write_triangle_mesh(str(unfinished), surface):
            raise InputError(
                f"{path}: Open3D could not write it; is there space, and may the folder be written to?"
            )
    return Meshed(path, len(surface.vertices), len(surface.triangles), dropped)


def _poisson(o3d: Any, local: Floats, cloud: Cloud, cell: float) -> tuple[TriangleMesh, Floats]:
    """The closed surface, and the octree level (V,) that the points' density gives each vertex."""
    points: PointCloud = o3d.geometry.PointCloud()
    points.points = o3d.utility.Vector3dVector(local)
    points.normals = o3d.utility.Vector3dVector(cloud.normals.astype(np.float64))
    points.colors = o3d.utility.Vector3dVector(cloud.colors / 255.0)
    extent = float(np.ptp(local, 0).max()) * _POISSON_SCALE
    depth = min(max(math.ceil(math.log2(max(extent / cell, 1.0))), _SHALLOWEST), _DEEPEST)
    surface, levels = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        points, depth=depth, scale=_POISSON_SCALE, linear_fit=False
    )
    return surface, np.asarray(levels)


def _tsdf(o3d: Any, dense: Dense, centre: Floats, cell: float, progress: Progress) -> TriangleMesh:
    """The surface where the mean signed distance of the depth maps is zero; ``centre`` is the origin."""
    volume = o3d.pipelines.integration.ScalableTSDFVolume(
        voxel_length=cell,
        sdf_trunc=_TRUNCATION * cell,
        color_type=o3d.pipelines.integration.TSDFVolumeColorType.RGB8,
    )
    for view in dense.views:
        depth = read_map(dense.paths.depth_map(view.name))
        volume.integrate(*_rgbd(o3d, dense, view, depth), _local_pose(view, centre))
        progress.advance(1)
    return volume.extract_triangle_mesh()


def _rgbd(o3d: Any, dense: Dense, view: DenseView, depth: NDArray[np.float32]) -> tuple[Any, Any]:
    """Depth and colour in pixels of the depth map, and Open3D's camera (pixel centres are integers)."""
    import cv2

    height, width = depth.shape
    image = cv2.resize(
        read_image(dense.paths.image(view.name)), (width, height), interpolation=cv2.INTER_AREA
    )
    fx, fy, cx, cy = map_intrinsics(view.camera, depth.shape)
    rgbd = o3d.geometry.RGBDImage.create_from_color_and_depth(
        o3d.geometry.Image(np.ascontiguousarray(image)),
        o3d.geometry.Image(depth),
        depth_scale=1.0,
        depth_trunc=float(np.finfo(np.float32).max),
        convert_rgb_to_intensity=False,
    )
    return rgbd, o3d.camera.PinholeCameraIntrinsic(width, height, fx, fy, cx - 0.5, cy - 0.5)


def _local_pose(view: DenseView, centre: Floats) -> Floats:
    """cam_from_local (4, 4), where the local origin is ``centre`` in the world."""
    pose = np.eye(4)
    pose[:3, :3] = view.cam_from_world[:, :3]
    pose[:3, 3] = view.cam_from_world[:, :3] @ centre + view.cam_from_world[:, 3]
    return pose


def _distances(vertices: Floats, points: Floats) -> Floats:
    """Distance (V,) of each vertex to the nearest point."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(points).query(vertices)[0]) if len(vertices) else np.zeros(0)


def _drop(surface: TriangleMesh, which: Mask, reason: str, dropped: dict[str, int]) -> None:
    dropped[reason] = int(which.sum())
    surface.remove_vertices_by_mask(which)


def _drop_small_parts(surface: TriangleMesh, share: float, dropped: dict[str, int]) -> None:
    """Remove the connected parts that have less than a share of all triangles."""
    before = len(surface.vertices)
    if share > 0 and len(surface.triangles):
        part, size, _ = surface.cluster_connected_triangles()
        small = np.asarray(size)[np.asarray(part)] < share * len(surface.triangles)
        surface.remove_triangles_by_mask(small)
    surface.remove_unreferenced_vertices()
    dropped["min_part"] = before - len(surface.vertices)
