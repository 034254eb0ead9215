"""The programs that users go on with take our dense workspace: COLMAP's and those that read clouds."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import plyfile
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_tco import _pycolmap
from colmap_tco.export.command import ExportConfig, export
from colmap_tco.maps import read_map
from colmap_tco.ply import read_ply, read_vis, write_ply
from colmap_tco.progress import Progress
from colmap_tco.workspace import DensePaths
from tests.colmap_tco.test_outputs import NORMAL, PIXEL, densify, make_workspace
from tests.programs import imported_open3d

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> DensePaths:
    root = tmp_path_factory.mktemp("plane")
    make_workspace(root)
    return densify(root).paths


def colmap(*words: str) -> str:
    """Run COLMAP's command; what it says. Skips where it is not installed."""
    program = shutil.which("colmap")
    if program is None:
        pytest.skip("the program colmap is not installed (on Debian: apt install colmap)")
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    done = subprocess.run([program, *words], capture_output=True, text=True, check=False, env=environment)
    said = done.stdout + done.stderr
    if "requires CGAL" in said:
        pytest.skip("this build of COLMAP has no CGAL, without which it makes no Delaunay meshes")
    assert done.returncode == 0, said
    return said


def mesh_vertices(path: Path) -> Floats:
    o3d = imported_open3d()
    surface = o3d.io.read_triangle_mesh(str(path))
    assert len(surface.triangles) > 100
    return np.asarray(surface.vertices).copy()


def distances(points: Floats, path: Path) -> Floats:
    """Of points from the surface of a mesh."""
    o3d = imported_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(o3d.io.read_triangle_mesh(str(path))))
    away: Floats = scene.compute_distance(points.astype(np.float32)).numpy()
    return away


def assert_plane(vertices: Floats, points: Floats) -> None:
    """Most vertices are on the plane, and they cover the cloud."""
    near = cKDTree(points).query(vertices)[0] < 4 * PIXEL
    assert near.mean() > 0.5
    assert np.median(np.abs(vertices[near] @ NORMAL)) < 0.5 * PIXEL
    assert np.quantile(cKDTree(vertices).query(points)[0], 0.9) < 6 * PIXEL


def test_pycolmap_meshes_the_cloud(paths: DensePaths, tmp_path: Path) -> None:
    pycolmap = _pycolmap.load()
    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.trim, options.num_threads = 7, 4, 1
    pycolmap.poisson_meshing(str(paths.ply), str(tmp_path / "m.ply"), options)
    assert_plane(mesh_vertices(tmp_path / "m.ply"), read_ply(paths.ply)[0])


def test_the_colmap_command_meshes_the_cloud(paths: DensePaths, tmp_path: Path) -> None:
    out = tmp_path / "m.ply"
    colmap("poisson_mesher", "--input_path", str(paths.ply), "--output_path", str(out),
           "--PoissonMeshing.depth", "7", "--PoissonMeshing.trim", "4",
           "--PoissonMeshing.num_threads", "1")  # fmt: skip
    assert_plane(mesh_vertices(out), read_ply(paths.ply)[0])


def test_the_colmap_command_makes_a_delaunay_mesh_of_cloud_and_visibility(
    paths: DensePaths, tmp_path: Path
) -> None:
    """With a little noise: COLMAP 3.8 ends at a capacity of −1e-8 in a cloud that is exactly flat."""
    rough, out = DensePaths(tmp_path / "rough"), tmp_path / "m.ply"
    shutil.copytree(paths.root, rough.root)
    points, normals, colors = read_ply(paths.ply)
    noise = np.random.default_rng(0).normal(0, 0.1 * PIXEL, (len(points), 1))
    write_ply(rough.ply, points + noise * NORMAL, normals, colors)
    colmap("delaunay_mesher", "--input_path", str(rough.root), "--input_type", "dense",
           "--output_path", str(out), "--DelaunayMeshing.num_threads", "1",
           "--DelaunayMeshing.max_proj_dist", "2")  # fmt: skip
    assert np.abs(mesh_vertices(out) @ NORMAL).max() < 0.5 * PIXEL
    assert np.quantile(distances(points, out), 0.95) < 0.5 * PIXEL, "the mesh covers the cloud"


def test_the_colmap_command_converts_the_sparse_model(paths: DensePaths, tmp_path: Path) -> None:
    colmap("model_converter", "--input_path", str(paths.sparse), "--output_path", str(tmp_path),
           "--output_type", "BIN")  # fmt: skip
    ours = _pycolmap.read_model(paths.sparse)
    theirs = _pycolmap.load().Reconstruction(str(tmp_path))
    assert {i: image.name for i, image in ours.images.items()} == {
        i: image.name for i, image in theirs.images.items()
    }
    assert set(ours.points3D) == set(theirs.points3D)
    for mine, yours in zip(_pycolmap.registered(ours), _pycolmap.registered(theirs), strict=True):
        np.testing.assert_allclose(mine.cam_from_world, yours.cam_from_world, atol=1e-9)
    observed = [sum(p.track.length() for p in model.points3D.values()) for model in (ours, theirs)]
    assert observed[0] == observed[1] > 300


def test_the_colmap_command_converts_the_splatting_export(paths: DensePaths, tmp_path: Path) -> None:
    """Binary in, text out: as many points and observations, nothing lost."""
    out = tmp_path / "splats"
    export("3dgs", paths.root, ExportConfig(output_path=out), Progress())
    text = tmp_path / "text"
    text.mkdir()
    colmap("model_converter", "--input_path", str(out / "sparse" / "0"), "--output_path", str(text),
           "--output_type", "TXT")  # fmt: skip
    lines = [line.split() for line in (text / "points3D.txt").read_text().splitlines() if line[0] != "#"]
    points = read_ply(paths.ply)[0]
    assert len(lines) == len(points)
    lines.sort(key=lambda words: int(words[0]))
    xyz = np.array([[float(word) for word in words[1:4]] for words in lines])
    assert np.abs(xyz - points).max() < 1e-4
    model = _pycolmap.load().Reconstruction(str(out / "sparse" / "0"))
    assert sum(len(words) - 8 for words in lines) == 2 * sum(
        p.track.length() for p in model.points3D.values()
    )


def test_a_trainer_of_splats_reads_the_splatting_export(paths: DensePaths, tmp_path: Path) -> None:
    """By nerfstudio's own reader: points project, by its cameras and poses, onto the keypoints it finds."""
    reader = pytest.importorskip(
        "nerfstudio.data.utils.colmap_parsing_utils",
        reason="nerfstudio is not installed (pip install --no-deps nerfstudio)",
    )
    out = tmp_path / "splats"
    export("3dgs", paths.root, ExportConfig(output_path=out), Progress())
    cameras, images, points = reader.read_model(str(out / "sparse" / "0"), ext=".bin")
    cloud, _, colors = read_ply(paths.ply)
    order = sorted(points)
    np.testing.assert_array_equal(np.stack([points[i].xyz for i in order]), cloud)
    np.testing.assert_array_equal(np.stack([points[i].rgb for i in order]), colors)
    assert all((out / "images" / image.name).is_file() for image in images.values())
    for number in order[::7]:
        point = points[number]
        assert len(point.image_ids) >= 2
        for image_id, index in zip(point.image_ids, point.point2D_idxs, strict=True):
            image = images[image_id]
            camera = cameras[image.camera_id]
            assert camera.model == "PINHOLE" and image.point3D_ids[index] == number
            x, y, z = reader.qvec2rotmat(image.qvec) @ point.xyz + image.tvec
            fx, fy, cx, cy = camera.params
            np.testing.assert_allclose([fx * x / z + cx, fy * y / z + cy], image.xys[index], atol=1e-6)


def openmvs(program: str, folder: Path, *words: str) -> str:
    """Run a program of OpenMVS in the folder of the export; what it says. Skips where it is not installed."""
    found = shutil.which(program)
    if found is None:
        pytest.skip(f"OpenMVS' {program} is not installed, and Debian has no package of it")
    words = (found, "-w", str(folder), *words)
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def imported(paths: DensePaths, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The export for OpenMVS with ``scene.mvs``, as its importer wrote it; and what it said."""
    out = tmp_path_factory.mktemp("openmvs") / "export"
    export("openmvs", paths.root, ExportConfig(output_path=out), Progress())
    return out, openmvs("InterfaceCOLMAP", out, "-i", ".", "-o", "scene.mvs")


def test_the_openmvs_importer_takes_model_cloud_and_maps(
    paths: DensePaths, imported: tuple[Path, str]
) -> None:
    out, said = imported
    model, points = _pycolmap.read_model(paths.sparse), read_ply(paths.ply)[0]
    images, sparse = len(model.images), len(model.points3D)
    assert f"Exported data: {images} images, {sparse} points, {len(points)} dense points" in said
    assert len(list(out.glob("depth*.dmap"))) == images
    cloud = plyfile.PlyData.read(str(out / "scene.ply"))["vertex"]
    np.testing.assert_array_equal(np.stack([cloud[axis] for axis in "xyz"], 1), points)
    ours = read_vis(paths.vis)
    names = [model.images[i].name for i in sorted(model.images)]
    order = [sorted(names).index(name) for name in names]
    theirs = [sorted(views.tolist()) for views in cloud["view_indices"]]
    assert theirs == [sorted(order[i] for i in views) for views in np.split(ours.images, ours.start[1:-1])]


def test_openmvs_fuses_our_maps_to_our_surface(paths: DensePaths, imported: tuple[Path, str]) -> None:
    """With the cameras, neighbours, depths and normals of the export, no pixel matched again."""
    out, _ = imported
    shape = read_map(next(paths.stereo.glob("depth_maps/*.bin"))).shape
    openmvs("DensifyPointCloud", out, "scene.mvs", "-o", "dense.mvs", "--resolution-level", "0",
            "--max-resolution", str(max(shape)), "--min-resolution", "1", "--geometric-iters", "0",
            "--postprocess-dmaps", "0", "--max-threads", "1")  # fmt: skip
    cloud = plyfile.PlyData.read(str(out / "dense.ply"))["vertex"]
    theirs = np.stack([cloud[axis] for axis in "xyz"], 1)
    assert len(theirs) > 0.5 * len(read_ply(paths.ply)[0])
    assert np.median(np.abs(theirs @ NORMAL)) < 0.5 * PIXEL


def test_openmvs_meshes_our_cloud(paths: DensePaths, imported: tuple[Path, str]) -> None:
    out, _ = imported
    openmvs("ReconstructMesh", out, "scene.mvs", "-p", "scene.ply", "-o", "mesh.ply", "--max-threads", "1")
    assert_plane(mesh_vertices(out / "mesh.ply"), read_ply(paths.ply)[0])


def test_the_colmap_command_reads_the_text_export(paths: DensePaths, tmp_path: Path) -> None:
    model = _pycolmap.read_model(paths.sparse)
    shutil.copytree(paths.root, tmp_path / "dense")
    for image in model.images.values():
        image.name = image.name.replace(" ", "-")
    from colmap_tco.outputs import write_model

    write_model(DensePaths(tmp_path / "dense"), model)
    export("text", tmp_path / "dense", ExportConfig(output_path=tmp_path / "text"), Progress())
    said = colmap("model_analyzer", "--path", str(tmp_path / "text"))
    points = len(read_ply(paths.ply)[0])
    assert f"Points: {points}" in said
    error = float(said.split("Mean reprojection error: ")[1].split("px")[0])
    assert error < 1e-6


def test_trimesh_reads_points_and_colours(paths: DensePaths) -> None:
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
    cloud = trimesh.load(str(paths.ply))
    points, normals, colors = read_ply(paths.ply)
    np.testing.assert_array_equal(np.asarray(cloud.vertices), points)
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], colors)
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.stack([raw[n].ravel() for n in ("nx", "ny", "nz")], 1), normals)


def test_plyfile_reads_points_normals_and_colours(paths: DensePaths) -> None:
    vertices = plyfile.PlyData.read(str(paths.ply))["vertex"]
    for columns, expected in zip(
        ("xyz", ("nx", "ny", "nz"), ("red", "green", "blue")), read_ply(paths.ply), strict=True
    ):
        np.testing.assert_array_equal(np.stack([vertices[name] for name in columns], 1), expected)


def test_meshlab_reads_points_normals_and_colours(paths: DensePaths) -> None:
    """In its library; it needs some of the system's, so what keeps it from being imported is told."""
    try:
        import pymeshlab
    except ImportError as error:
        pytest.skip(f"pymeshlab cannot be imported: {error}")
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(paths.ply))
    cloud = meshes.current_mesh()
    points, normals, colors = read_ply(paths.ply)
    assert cloud.has_vertex_color()
    np.testing.assert_allclose(cloud.vertex_matrix(), points, atol=1e-6)
    np.testing.assert_allclose(cloud.vertex_normal_matrix(), normals, atol=1e-6)
    found = np.rint(cloud.vertex_color_matrix()[:, :3] * 255).astype(np.uint8)
    np.testing.assert_array_equal(found, colors)


@pytest.mark.parametrize("method", ["poisson", "tsdf"])
def test_meshlab_reads_our_meshes(paths: DensePaths, tmp_path: Path, method: str) -> None:
    try:
        import pymeshlab
    except ImportError as error:
        pytest.skip(f"pymeshlab cannot be imported: {error}")
    imported_open3d()
    from colmap_tco.mesh import MeshConfig, mesh

    done = mesh(paths.root, MeshConfig(output_path=tmp_path / "m.ply", method=method), Progress())
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(done.path))
    surface = meshes.current_mesh()
    assert (surface.vertex_number(), surface.face_number()) == (done.vertices, done.triangles)
    assert surface.has_vertex_color()
    assert_plane(surface.vertex_matrix(), read_ply(paths.ply)[0])
