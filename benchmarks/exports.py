"""Round trips through the programs that users go on with: points in, points out, distance between them.

    python -m benchmarks.exports [--set kitchen] [--work runs/exports] [--output docs/exports.md]

A set is densified, once, and its result is exported, meshed and read as a user would: by the commands, and by
COLMAP (pycolmap), laspy, Open3D, trimesh, plyfile, MeshLab's library, and OpenMVS where it is on the PATH.
Distances are in units of the median distance between neighbouring points of the cloud.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.quality import copied, run
from benchmarks.tables import paragraph, publish, to_file
from colmap_tco import _pycolmap
from colmap_tco._open3d import open3d
from colmap_tco.export.dense import Dense, open_dense
from colmap_tco.export.las import spacing
from colmap_tco.export.tracks import project
from colmap_tco.maps import read_map
from colmap_tco.ply import read_ply

Floats = NDArray[np.float64]
AGREES = 0.02
"""Relative difference of depths below which an observation counts as that of its depth map."""


@dataclass(frozen=True)
class Made:
    """The result whose round trips are measured.

    Attributes:
        workspace: its folder.
        dense: it, opened.
        points: (N, 3) of its cloud.
        unit: distance between these.
        folder: for what is written.
    """

    workspace: Path
    dense: Dense
    points: Floats
    unit: float
    folder: Path

    def apart(self, points: Floats, quantile: float = 0.5) -> str:
        """A quantile of the distances of points to the cloud's nearest."""
        away = cKDTree(self.points).query(points)[0]
        return f"{np.quantile(away, quantile) / self.unit:.2g}"

    def largest(self, points: Floats) -> str:
        """Points that came back, in their order: the largest distance to what they were."""
        if points.shape != self.points.shape:
            return "not the same points"
        return f"at most {np.linalg.norm(points - self.points, axis=1).max() / self.unit:.1g}"


def command(*words: object) -> None:
    """Run ``colmap-tco``."""
    run([sys.executable, "-m", "colmap_tco", *map(str, words)])


def splats(made: Made) -> tuple[int, str]:
    """The export for trainers of splats, read by pycolmap; its observations, compared with depth maps."""
    out = made.folder / "splats"
    command("export", "3dgs", made.workspace, "-o", out, "--max_points", 0)
    model = _pycolmap.load().Reconstruction(str(out / "sparse" / "0"))
    ids = sorted(model.points3D)
    tracks = [[e.image_id for e in model.points3D[i].track.elements] for i in ids]
    points = np.array([model.points3D[i].xyz for i in ids])
    good = every = 0
    for view in made.dense.views:
        seen = np.flatnonzero([view.image_id in track for track in tracks])
        depth = read_map(made.dense.paths.depth_map(view.name))
        xy = project(view, points[seen]) * (depth.shape[1] / view.camera.width)
        z = points[seen] @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3]
        column, row = xy.astype(int).T
        there = depth[row.clip(0, depth.shape[0] - 1), column.clip(0, depth.shape[1] - 1)]
        good, every = good + int((np.abs(z - there) < AGREES * there).sum()), every + len(seen)
    length = every / len(points)
    return len(points), (
        f"{made.largest(points)}; {length:.1f} images a track; of {every} observations {good / every:.2%} "
        f"have the depth of the image's map within {AGREES:.0%}"
    )


def laz(made: Made) -> tuple[int, str]:
    """LAZ, read by laspy."""
    out = made.folder / "cloud.laz"
    command("export", "las", made.workspace, "-o", out)
    cloud = import_module("laspy").read(out)
    points = np.stack([cloud.x, cloud.y, cloud.z], 1)
    return len(points), made.largest(np.asarray(points))


def ply_of_open3d(made: Made) -> tuple[int, str]:
    """The cloud, read by Open3D."""
    points = np.asarray(open3d().io.read_point_cloud(str(made.dense.paths.ply)).points)
    return len(points), made.largest(points)


def ply_of_trimesh(made: Made) -> tuple[int, str]:
    """The cloud, read by trimesh."""
    points = np.asarray(import_module("trimesh").load(str(made.dense.paths.ply)).vertices)
    return len(points), made.largest(points)


def ply_of_plyfile(made: Made) -> tuple[int, str]:
    """The cloud, read by plyfile."""
    vertices = import_module("plyfile").PlyData.read(str(made.dense.paths.ply))["vertex"]
    points = np.stack([vertices[axis] for axis in "xyz"], 1).astype(float)
    return len(points), made.largest(points)


def ply_of_meshlab(made: Made) -> tuple[int, str]:
    """The cloud, read by MeshLab's library."""
    meshes = import_module("pymeshlab").MeshSet()
    meshes.load_new_mesh(str(made.dense.paths.ply))
    points = np.asarray(meshes.current_mesh().vertex_matrix())
    return len(points), made.largest(points)


def stereo_fusion(made: Made) -> tuple[int, str]:
    """COLMAP's fusion of the depth and normal maps."""
    with tempfile.TemporaryDirectory() as out:
        model = _pycolmap.load().stereo_fusion(out, str(made.dense.paths.root), input_type="geometric")
    points = np.array([point.xyz for point in model.points3D.values()])
    return len(points), f"theirs to ours {made.apart(points)} (median), {made.apart(points, 0.95)} (95 %)"


def openmvs(made: Made) -> tuple[int, str]:
    """OpenMVS' fusion of the depth and normal maps, after its importer has read the export."""
    if which("InterfaceCOLMAP") is None:
        raise ImportError("OpenMVS is not installed")
    out = made.folder / "openmvs"
    command("export", "openmvs", made.workspace, "-o", out)
    side = max(read_map(made.dense.paths.depth_map(made.dense.views[0].name)).shape)
    run(["InterfaceCOLMAP", "-w", str(out), "-i", ".", "-o", "scene.mvs"])
    run(["DensifyPointCloud", "-w", str(out), "scene.mvs", "-o", "dense.mvs", "--resolution-level", "0",
         "--max-resolution", str(side), "--min-resolution", "1", "--geometric-iters", "0",
         "--postprocess-dmaps", "0"])  # fmt: skip
    vertices = import_module("plyfile").PlyData.read(str(out / "dense.ply"))["vertex"]
    points = np.stack([vertices[axis] for axis in "xyz"], 1).astype(float)
    return len(points), f"theirs to ours {made.apart(points)} (median), {made.apart(points, 0.95)} (95 %)"


def our_mesh(method: str) -> Callable[[Made], tuple[int, str]]:
    """``colmap-tco mesh`` by a method."""

    def measure(made: Made) -> tuple[int, str]:
        out = made.folder / f"{method}.ply"
        command("mesh", made.workspace, "-o", out, "--method", method)
        return surface(made, out)

    return measure


def colmap_mesh(made: Made) -> tuple[int, str]:
    """COLMAP's Poisson mesher on the cloud."""
    pycolmap, out = _pycolmap.load(), made.folder / "colmap.ply"
    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.trim = 8, 6
    pycolmap.poisson_meshing(str(made.dense.paths.ply), str(out), options)
    return surface(made, out)


def surface(made: Made, path: Path) -> tuple[int, str]:
    """Vertices of a mesh, and how far the cloud is from it."""
    o3d: Any = open3d()
    mesh = o3d.io.read_triangle_mesh(str(path))
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    away = scene.compute_distance(made.points.astype(np.float32)).numpy() / made.unit
    middle, far = np.quantile(away, [0.5, 0.95])
    return len(mesh.vertices), f"cloud to mesh {middle:.2g} (median), {far:.2g} (95 %)"


TRIPS: dict[str, Callable[[Made], tuple[int, str]]] = {
    "`fused.ply`, read by Open3D": ply_of_open3d,
    "`fused.ply`, read by trimesh": ply_of_trimesh,
    "`fused.ply`, read by plyfile": ply_of_plyfile,
    "`fused.ply`, read by pymeshlab": ply_of_meshlab,
    "3dgs, read by pycolmap": splats,
    "LAZ, read by laspy": laz,
    "COLMAP's `stereo_fusion` of our maps": stereo_fusion,
    "OpenMVS' `DensifyPointCloud` of our maps": openmvs,
    "our Poisson mesh": our_mesh("poisson"),
    "our TSDF mesh": our_mesh("tsdf"),
    "COLMAP's Poisson mesh (depth 8, trim 6)": colmap_mesh,
}


def lines(made: Made) -> Iterator[str]:
    """Rows of the table; what is not installed says so."""
    for name, trip in TRIPS.items():
        try:
            count, said = trip(made)
        except ImportError as error:
            yield f"| {name} | | not measured: {error} |"
            continue
        yield f"| {name} | {len(made.points)} → {count} | {said} |"


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--set", default="kitchen")
    parser.add_argument("--work", type=Path, default=Path("runs/exports"))
    to_file(parser)
    return parser


def main() -> None:
    """Measure and publish."""
    args = parser().parse_args()
    workspace = copied(args.set, args.work)
    command("densify", workspace, "--overwrite")
    dense = open_dense(workspace)
    points = read_ply(dense.paths.ply)[0].astype(float)
    with tempfile.TemporaryDirectory(dir=args.work) as folder:
        made = Made(workspace, dense, points, spacing(points), Path(folder))
        rows = "\n".join(lines(made))
    text = paragraph(
        f"`python -m benchmarks.exports`: {args.set}, {len(dense.views)} views, {len(points)} points, "
        f"{made.unit:.3g} between neighbouring ones, which is the unit of the distances."
    )
    publish(f"{text}\n| | points in → out | distance |\n|---|---|---|\n{rows}\n", args.output, args.part)


if __name__ == "__main__":
    main()
