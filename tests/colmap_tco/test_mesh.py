"""Meshes of a plane that is known exactly: on it, coloured as it is, and nowhere else."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_tco import _pycolmap
from colmap_tco.cli import main
from colmap_tco.errors import InputError
from colmap_tco.export.dense import open_dense
from colmap_tco.mesh import MeshConfig, Meshed, mesh
from colmap_tco.outputs import write_model
from colmap_tco.ply import read_ply, write_ply
from colmap_tco.progress import Progress
from colmap_tco.workspace import DensePaths
from tests.colmap_tco.test_outputs import NORMAL, PIXEL, densify, make_workspace, pattern
from tests.programs import imported_open3d

o3d = imported_open3d()
Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plane")
    make_workspace(folder)
    densify(folder)
    return folder


def made(root: Path, out: Path, **settings: object) -> Meshed:
    return mesh(root, MeshConfig(output_path=out, **settings), Progress())  # type: ignore[arg-type]


def read(path: Path) -> tuple[Floats, NDArray[np.int64], Floats]:
    """Vertices (V, 3), triangles (T, 3) and colours (V, 3), 0 to 255, as Open3D reads them."""
    surface = o3d.io.read_triangle_mesh(str(path))
    assert surface.has_vertex_normals() and surface.has_vertex_colors()
    vertices, triangles = np.asarray(surface.vertices).copy(), np.asarray(surface.triangles).copy()
    return vertices, triangles, np.asarray(surface.vertex_colors) * 255


def area(vertices: Floats, triangles: NDArray[np.int64]) -> float:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize("method", ["poisson", "tsdf"])
def test_the_mesh_is_the_plane_and_nothing_else(root: Path, tmp_path: Path, method: str) -> None:
    done = made(root, tmp_path / "m.ply", method=method)
    vertices, triangles, colors = read(done.path)
    assert (len(vertices), len(triangles)) == (done.vertices, done.triangles)
    points = open_dense(root).cloud().points
    off = np.abs(vertices @ NORMAL) / PIXEL
    assert np.quantile(off, 0.95) < 0.25 and off.max() < 4
    # A camera half a pixel aside would lift the surface by 0.2 pixels.
    assert abs(np.median(vertices @ NORMAL)) / PIXEL < 0.05
    assert cKDTree(points).query(vertices)[0].max() < 10 * PIXEL
    assert np.quantile(cKDTree(vertices).query(points)[0], 0.95) < 2 * PIXEL
    inner = np.abs(vertices[:, :2]).max(1) < 0.8
    assert np.median(np.abs(pattern(vertices[inner]).astype(float) - colors[inner])) < 15
    # Both sides of a closed surface, or a doubled one, would have twice the area.
    box = np.ptp(points[np.abs(points[:, :2]).max(1) < 0.8, :2], 0).prod()
    centre = (np.abs(vertices[triangles].mean(1)[:, :2]) < 0.8).all(1)
    assert area(vertices, triangles[centre]) == pytest.approx(box / -NORMAL[2], rel=0.1)


def test_poisson_without_trimming_closes_a_bubble_and_trimming_opens_it(root: Path, tmp_path: Path) -> None:
    points, normals, colors = read_ply(root / "dense-tco" / "fused.ply")
    shutil.copytree(root / "dense-tco", tmp_path / "dense")
    keep = np.linalg.norm(points[:, :2], axis=1) > 0.5  # a hole that Poisson spans
    write_ply(tmp_path / "dense" / "fused.ply", points[keep], normals[keep], colors[keep])
    from colmap_tco.ply import write_vis

    cloud = open_dense(root).cloud().select(np.flatnonzero(keep))
    write_vis(tmp_path / "dense" / "fused.ply.vis", cloud.visibility)
    nothing = {"trim": np.inf, "max_distance": np.inf, "min_part": 0.0}
    closed, _, _ = read(made(tmp_path / "dense", tmp_path / "closed.ply", **nothing).path)
    opened, _, _ = read(made(tmp_path / "dense", tmp_path / "opened.ply").path)
    within = [(np.linalg.norm(v[:, :2], axis=1) < 0.3).sum() for v in (closed, opened)]
    assert within[0] > 20 and within[1] == 0
    assert np.abs(opened @ NORMAL).max() < np.abs(closed @ NORMAL).max()


@pytest.mark.parametrize("method", ["poisson", "tsdf"])
def test_map_coordinates_make_the_same_mesh(root: Path, tmp_path: Path, method: str) -> None:
    """Compared at the origin: the shift by millions costs nothing but rounding of the cloud in the PLY."""
    from tests.colmap_tco.test_export import ORIGIN, write_double_ply

    folder = tmp_path / "dense"
    shutil.copytree(root / "dense-tco", folder)
    model = _pycolmap.read_model(folder / "sparse")
    pycolmap = _pycolmap.load()
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), ORIGIN))
    write_model(DensePaths(folder), model)
    points, normals, colors = read_ply(folder / "fused.ply")
    write_double_ply(folder / "fused.ply", points + ORIGIN, normals, colors)
    here, _, _ = read(made(root, tmp_path / "here.ply", method=method).path)
    there, _, _ = read(made(folder, tmp_path / "there.ply", method=method).path)
    assert abs(len(there) - len(here)) < 0.02 * len(here)
    assert np.abs((there - ORIGIN) @ NORMAL).max() / PIXEL < 4
    distance = cKDTree(here).query(there - ORIGIN)[0]
    assert np.quantile(distance, 0.98) < 0.1 * PIXEL


def test_small_parts_are_dropped_and_counted(root: Path, tmp_path: Path) -> None:
    done = made(root, tmp_path / "m.ply", method="tsdf", min_part=0.5)
    surface = o3d.io.read_triangle_mesh(str(done.path))
    assert len(surface.cluster_connected_triangles()[1]) == 1
    assert set(done.dropped) == {"max_distance", "min_part"}


def test_the_command_writes_beside_the_cloud_and_asks_before_it_replaces(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(root / "dense-tco", tmp_path / "dense-tco")
    words = ["mesh", str(tmp_path), "-q", "--cell_size", "0.2"]
    assert main(words) == 0
    assert "vertices" in capsys.readouterr().out
    path = tmp_path / "dense-tco" / "meshed-poisson.ply"
    before = path.read_bytes()
    assert main(words) == 3
    assert "--overwrite" in capsys.readouterr().err
    assert path.read_bytes() == before
    assert main([*words, "--overwrite", "--method", "tsdf"]) == 0
    assert (tmp_path / "dense-tco" / "meshed-tsdf.ply").is_file()
    assert not [p for p in (tmp_path / "dense-tco").iterdir() if "unfinished" in p.name]


def test_what_cannot_be_meshed_is_an_error(root: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="PLY"):
        made(root, tmp_path / "m.obj")
    with pytest.raises(InputError, match="no dense workspace"):
        made(tmp_path, tmp_path / "m.ply")
    with pytest.raises(ValueError, match="trim"):
        MeshConfig(trim=-1)
    with pytest.raises(InputError, match="no triangle is left"):
        made(root, tmp_path / "m.ply", method="tsdf", max_distance=0.0)
    assert list(tmp_path.iterdir()) == []
