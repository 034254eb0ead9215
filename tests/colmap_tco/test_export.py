"""A dense workspace in other programs' formats: read back by those programs, or by their rules."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_tco import _pycolmap
from colmap_tco.cli import main
from colmap_tco.errors import InputError
from colmap_tco.export.command import ExportConfig, export
from colmap_tco.export.dense import Dense, flat_names, open_dense, thinned
from colmap_tco.export.las import scale_and_offset, spacing
from colmap_tco.maps import read_map
from colmap_tco.outputs import write_model
from colmap_tco.ply import read_ply, read_vis
from colmap_tco.progress import Progress
from colmap_tco.sparse_format import quaternion
from colmap_tco.workspace import DensePaths
from tests.colmap_tco.test_outputs import densify, make_workspace, names, pose

Floats = NDArray[np.float64]
ORIGIN = np.array([452_000.25, 5_411_000.5, 310.125])


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished result of five views of a plane, of names with folders and blanks."""
    folder = tmp_path_factory.mktemp("plane")
    make_workspace(folder)
    densify(folder)
    return folder


@pytest.fixture(scope="module")
def dense(root: Path) -> Dense:
    return open_dense(root)


def exported(format: str, root: Path, out: Path, **settings: object) -> Path:
    return export(format, root, ExportConfig(output_path=out, **settings), Progress()).path  # type: ignore[arg-type]


def write_double_ply(
    path: Path, points: Floats, normals: NDArray[np.float32], colors: NDArray[np.uint8]
) -> None:
    kinds = [(n, "<f8") for n in "xyz"] + [(f"n{n}", "<f4") for n in "xyz"]
    records = np.zeros(len(points), [*kinds, ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    for axis, name in enumerate("xyz"):
        records[name], records[f"n{name}"] = points[:, axis], normals[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        records[name] = colors[:, channel]
    head = [f"property double {n}" for n in "xyz"] + [f"property float n{n}" for n in "xyz"]
    head += [f"property uchar {n}" for n in ("red", "green", "blue")]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *head, "end_header"]
    path.write_bytes(("\n".join(lines) + "\n").encode() + records.tobytes())


@pytest.fixture(scope="module")
def mapped(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same result in map coordinates of millions, its cloud in double precision."""
    folder = tmp_path_factory.mktemp("mapped") / "dense"
    shutil.copytree(root / "dense-tco", folder)
    paths = DensePaths(folder)
    model = _pycolmap.read_model(paths.sparse)
    pycolmap = _pycolmap.load()
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), ORIGIN))
    write_model(paths, model)
    points, normals, colors = read_ply(paths.ply)
    write_double_ply(paths.ply, points + ORIGIN, normals, colors)
    return folder


@dataclass(frozen=True)
class Splats:
    folder: Path
    model: _pycolmap.Model


@pytest.fixture(scope="module")
def splats(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Splats:
    folder = exported("3dgs", root, tmp_path_factory.mktemp("3dgs") / "out")
    return Splats(folder, _pycolmap.load().Reconstruction(str(folder / "sparse" / "0")))


def test_3dgs_holds_every_point_with_a_track_of_real_keypoints(splats: Splats, dense: Dense) -> None:
    points, _, colors = read_ply(dense.paths.ply)
    visibility = read_vis(dense.paths.vis)
    assert len(splats.model.points3D) == len(points)
    ids = [view.image_id for view in dense.views]
    for i in range(0, len(points), 5):
        point = splats.model.points3D[i + 1]
        np.testing.assert_array_equal(point.xyz, points[i])
        np.testing.assert_array_equal(point.color, colors[i])
        tracked = [(e.image_id, e.point2D_idx) for e in point.track.elements]
        assert [image for image, _ in tracked] == [ids[k] for k in visibility[i]]
        for image, index in tracked:
            assert splats.model.images[image].points2D[index].point3D_id == i + 1
    tracked_total = sum(p.track.length() for p in splats.model.points3D.values())
    assert sum(len(image.points2D) for image in splats.model.images.values()) == tracked_total


def test_3dgs_tracks_reproject_and_see_the_surface_there(splats: Splats, dense: Dense) -> None:
    """By pycolmap's own projection, and by the depth maps: the image of a track sees the point's surface."""
    splats.model.update_point_3d_errors()
    assert max(point.error for point in splats.model.points3D.values()) < 1e-6
    for entry in _pycolmap.registered(splats.model):
        old = {view.image_id: view.name for view in dense.views}[entry.image_id]
        depth = read_map(dense.paths.depth_map(old))
        xy, points = _pycolmap.observations(splats.model, entry.image_id)
        assert len(xy) > 500
        xyz = np.array([splats.model.points3D[p].xyz for p in points])
        z = xyz @ entry.cam_from_world[2, :3] + entry.cam_from_world[2, 3]
        row, col = (np.minimum(xy[:, k].astype(int), depth.shape[1 - k] - 1) for k in (1, 0))
        assert np.quantile(np.abs(depth[row, col] / z - 1), 0.99) < 0.01


def test_3dgs_has_pinhole_cameras_flat_images_and_the_poses(splats: Splats, dense: Dense) -> None:
    assert {c.model.name for c in splats.model.cameras.values()} == {"PINHOLE"}
    views = {view.image_id: view for view in dense.views}
    for entry in _pycolmap.registered(splats.model):
        view = views[entry.image_id]
        assert "/" not in entry.name and " " not in entry.name
        np.testing.assert_allclose(entry.cam_from_world, view.cam_from_world, atol=1e-12)
        ours = cv2.imread(str(splats.folder / "images" / entry.name))
        np.testing.assert_array_equal(ours, cv2.imread(str(dense.paths.image(view.name))))
        assert ours.shape[1::-1] == _pycolmap.camera_size(entry.camera)
    points, normals, _ = read_ply(splats.folder / "sparse" / "0" / "points3D.ply")
    assert len(points) == len(splats.model.points3D)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)


def test_max_points_is_kept_and_the_choice_is_even(root: Path, dense: Dense, tmp_path: Path) -> None:
    """No point of the cloud is far from one that stays; a choice at random leaves larger gaps."""
    folder = exported("3dgs", root, tmp_path / "few", max_points=100)
    model = _pycolmap.load().Reconstruction(str(folder / "sparse" / "0"))
    assert 90 <= len(model.points3D) <= 100
    cloud = dense.cloud()
    few = thinned(cloud, 100)
    assert np.array_equal(few.points, thinned(cloud, 100).points)
    where = {tuple(p): i for i, p in enumerate(cloud.points.tolist())}
    for i in range(len(few)):
        assert np.array_equal(few.visibility[i], cloud.visibility[where[tuple(few.points[i].tolist())]])
    assert thinned(cloud, 0) is cloud
    chance = np.random.default_rng(0).choice(len(cloud), len(few), replace=False)
    gap, wider = (cKDTree(p).query(cloud.points)[0].max() for p in (few.points, cloud.points[chance]))
    assert gap < 0.8 * wider


@pytest.fixture(scope="module")
def plainly_named(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result with names that the text format can hold."""
    folder = tmp_path_factory.mktemp("plain") / "dense"
    shutil.copytree(root / "dense-tco", folder)
    model = _pycolmap.read_model(folder / "sparse")
    for image in model.images.values():
        old, image.name = image.name, image.name.replace(" ", "-")
        (folder / "images" / old).rename(folder / "images" / image.name)
    write_model(DensePaths(folder), model)
    return folder


def test_text_and_binary_hold_the_same(plainly_named: Path, tmp_path: Path) -> None:
    text = exported("text", plainly_named, tmp_path / "text")
    binary = exported("3dgs", plainly_named, tmp_path / "binary")
    assert sorted(p.suffix for p in text.iterdir()) == [".json", ".txt", ".txt", ".txt"]
    a, b = (_pycolmap.load().Reconstruction(str(p)) for p in (text, binary / "sparse" / "0"))
    assert len(a.points3D) == len(b.points3D) > 1000
    for key, point in a.points3D.items():
        other = b.points3D[key]
        np.testing.assert_array_equal(point.xyz, other.xyz)
        assert [(e.image_id, e.point2D_idx) for e in point.track.elements] == [
            (e.image_id, e.point2D_idx) for e in other.track.elements
        ]
    ours, theirs = (_pycolmap.registered(m) for m in (a, b))
    assert {e.name for e in ours} == {name.replace(" ", "-") for name in names()}
    by_id = {e.image_id: e for e in theirs}
    for entry in ours:
        np.testing.assert_array_equal(entry.cam_from_world, by_id[entry.image_id].cam_from_world)
        np.testing.assert_array_equal(entry.camera.params, by_id[entry.image_id].camera.params)


def test_text_refuses_a_name_that_it_would_cut(root: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"d e\.png.*blank"):
        exported("text", root, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def text_entries(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def test_openmvs_finds_maps_neighbours_and_visibility_by_its_rules(
    root: Path, dense: Dense, tmp_path: Path
) -> None:
    """Images by position in images.txt, ids one more; maps by file name; neighbours by name."""
    paths = DensePaths(exported("openmvs", root, tmp_path / "mvs"))
    cameras, images = (text_entries(paths.sparse / f"{kind}.txt") for kind in ("cameras", "images"))
    assert {camera[1] for camera in cameras} == {"PINHOLE"}
    heads = images[::2]
    assert [int(head[0]) for head in heads] == list(range(1, len(heads) + 1))
    listed = [head[9] for head in heads]
    assert all(len(head) == 10 for head in heads) and len(set(listed)) == len(names())
    old = dict(zip(listed, sorted(names()), strict=True))
    views = {view.name: view for view in dense.views}
    for name in listed:
        assert (paths.images / name).is_file()
        assert paths.depth_map(name).read_bytes() == dense.paths.depth_map(old[name]).read_bytes()
        assert paths.normal_map(name).read_bytes() == dense.paths.normal_map(old[name]).read_bytes()
    lines = paths.patch_match_cfg.read_text().splitlines()
    assert "" not in lines and lines[::2] == listed
    for name, line in zip(lines[::2], lines[1::2], strict=True):
        others = [other.strip(" ") for other in line.split(",")]
        assert others and set(others) <= set(listed) - {name}
    points = read_ply(paths.ply)[0]
    visibility = read_vis(paths.vis)
    assert len(visibility) == len(points) == len(read_ply(dense.paths.ply)[0])
    theirs = dense.cloud().visibility
    for i in range(0, len(points), 17):
        seen = {old[listed[k]] for k in visibility[i].tolist()}
        assert seen == {dense.views[k].name for k in theirs[i].tolist()}
    quaternions = np.array([[float(v) for v in head[1:8]] for head in heads])
    for name, row in zip(listed, quaternions, strict=True):
        view = views[old[name]]
        np.testing.assert_allclose(row[:4], quaternion(view.cam_from_world[:, :3]))
        np.testing.assert_allclose(row[4:], view.cam_from_world[:, 3])


def test_openmvs_gets_the_triangulated_points_with_their_tracks(
    root: Path, dense: Dense, tmp_path: Path
) -> None:
    paths = DensePaths(exported("openmvs", root, tmp_path / "mvs"))
    model = _pycolmap.load().Reconstruction(str(paths.sparse))
    assert len(model.points3D) == len(dense.model.points3D) > 100
    assert sum(p.track.length() for p in model.points3D.values()) == sum(
        p.track.length() for p in dense.model.points3D.values()
    )
    model.update_point_3d_errors()
    assert max(point.error for point in model.points3D.values()) < 0.01
    assert sorted(model.points3D) == list(range(1, len(model.points3D) + 1))


@pytest.mark.parametrize("lists", ["__auto__, 20", "__all__"])
def test_openmvs_gets_explicit_neighbours_where_colmap_chose(root: Path, tmp_path: Path, lists: str) -> None:
    shutil.copytree(root / "dense-tco", tmp_path / "dense")
    config = tmp_path / "dense" / "stereo" / "patch-match.cfg"
    config.write_text("".join(f"{name}\n{lists}\n" for name in names()))
    paths = DensePaths(exported("openmvs", tmp_path / "dense", tmp_path / "mvs"))
    text = paths.patch_match_cfg.read_text()
    assert "__" not in text
    assert [len(line.split(", ")) for line in text.splitlines()[1::2]] == [len(names()) - 1] * len(names())


def test_the_model_on_disk_counts_images_in_one_order_for_all_readers(root: Path, dense: Dense) -> None:
    """Old readers count in the order of the file, COLMAP now in the order of ids: the two are the same."""
    data = (dense.paths.sparse / "images.bin").read_bytes()
    at, order = 8, []
    for _ in range(int.from_bytes(data[:8], "little")):
        order.append(int.from_bytes(data[at : at + 4], "little"))
        at = data.index(b"\0", at + 64) + 1
        at += 8 + 24 * int.from_bytes(data[at : at + 8], "little")
    assert at == len(data)
    assert order == [int(key) for key in dense.model.reg_image_ids()] == [v.image_id for v in dense.views]


def test_writing_a_model_sorts_what_a_hash_table_does_not(tmp_path: Path, workspace_folder: Path) -> None:
    pycolmap = _pycolmap.load()
    model = pycolmap.Reconstruction(str(workspace_folder / "sparse" / "0"))
    text = tmp_path / "text"
    text.mkdir()
    model.write_text(str(text))
    lines = (text / "images.txt").read_text().splitlines()
    body = [line for line in lines if not line.startswith("#")]
    assert len(body) == 10
    positions = write_model(DensePaths(tmp_path), model)
    back = _pycolmap.read_model(tmp_path / "sparse")
    assert [back.images[k].name for k in back.reg_image_ids()] == sorted(positions, key=positions.__getitem__)
    assert {i.name: len(i.points2D) for i in back.images.values()} == {
        i.name: len(i.points2D) for i in model.images.values()
    }


@pytest.mark.parametrize("extension", ["las", "laz"])
def test_las_keeps_map_coordinates_colours_and_normals(mapped: Path, tmp_path: Path, extension: str) -> None:
    laspy = pytest.importorskip("laspy", reason="laspy is not installed")
    if extension == "laz":
        pytest.importorskip("lazrs", reason="lazrs is not installed")
    points, normals, colors = read_ply(mapped / "fused.ply")
    las = laspy.read(exported("las", mapped, tmp_path / f"cloud.{extension}"))
    assert len(las.points) == len(points)
    error = np.abs(np.asarray(las.xyz) - points).max()
    nearest = np.median(cKDTree(points - ORIGIN).query(points - ORIGIN, k=2)[0][:, 1])
    assert error <= 1e-4 * nearest
    assert las.header.version == "1.4" and las.header.global_encoding.wkt
    found = np.stack([np.asarray(las[c]) for c in ("red", "green", "blue")], 1)
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, colors.astype(np.uint16) * 257)
    for axis, name in enumerate("XYZ"):
        np.testing.assert_array_equal(np.asarray(las[f"Normal{name}"]), normals[:, axis])


def test_las_without_its_package_says_how_to_get_it(root: Path, tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    import importlib.util

    from colmap_tco.errors import MissingError

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingError, match=r"pip install 'colmap-tco\[las\]'"):
        exported("las", root, tmp_path / "c.laz")


def test_scale_is_a_power_of_ten_below_the_precision() -> None:
    points = np.array([[0.0, 0, 0], [1000.0, 10, 1]]) + ORIGIN
    for distance in (0.0123, 1.0, 7.7):
        scale, offset = scale_and_offset(points, distance)
        assert 1e-5 * distance < scale <= 1e-4 * distance
        assert np.log10(scale) == pytest.approx(round(np.log10(scale)))
        assert (np.abs((points - offset) / scale) < 2**31).all()
    with pytest.raises(InputError, match="far background"):
        scale_and_offset(points, 1e-6)
    assert spacing(np.zeros((3, 3))) == 1.0


def test_map_coordinates_cost_no_pixels(mapped: Path, tmp_path: Path) -> None:
    """Keypoints are those of the same cloud at the origin, though coordinates have seven digits more."""
    folder = exported("3dgs", mapped, tmp_path / "out")
    model = _pycolmap.load().Reconstruction(str(folder / "sparse" / "0"))
    points = read_ply(mapped / "fused.ply")[0] - ORIGIN
    for entry in _pycolmap.registered(model):
        i = [n.replace("/", "_").replace(" ", "_") for n in names()].index(entry.name)
        xy, ids = _pycolmap.observations(model, entry.image_id)
        local = points[ids - 1] @ pose(i)[:, :3].T + pose(i)[:, 3]
        fx, fy, cx, cy = entry.camera.params
        expected = local[:, :2] / local[:, 2:] * (fx, fy) + (cx, cy)
        assert np.abs(xy - expected).max() < 1e-4


def in_float32(entry: _pycolmap.Registered, points: Floats) -> Floats:
    """Pixels (N, 2) of world points (N, 3), all computed in single precision as trainers of splats do."""
    pose, xyz = entry.cam_from_world.astype(np.float32), points.astype(np.float32)
    local = xyz @ pose[:, :3].T + pose[:, 3]
    fx, fy, cx, cy = np.float32(entry.camera.params)
    return np.asarray(local[:, :2] / local[:, 2:] * (fx, fy) + (cx, cy), np.float64)


@pytest.mark.parametrize(("format", "sparse"), [("3dgs", "sparse/0"), ("openmvs", "sparse")])
def test_programs_in_single_precision_get_the_model_at_the_origin(
    mapped: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, format: str, sparse: str
) -> None:
    """In map coordinates float32 has steps of half a unit, where neighbouring points are 0.05 apart."""
    with caplog.at_level("INFO"):
        folder = exported(format, mapped, tmp_path / "out")
    ply = folder / {"3dgs": "sparse/0/points3D.ply", "openmvs": "fused.ply"}[format]
    text = (folder / "offset.txt").read_text()
    offset = np.array([float(word) for word in text.split()])
    assert text.strip() in caplog.text
    np.testing.assert_array_equal(offset, np.round(offset))
    assert np.abs(offset - ORIGIN).max() < 5
    truth, _, _ = read_ply(mapped / "fused.ply")
    points, _, _ = read_ply(ply)
    assert b"property float x" in ply.read_bytes()[:200]
    assert np.abs(points + offset - truth).max() < 1e-6
    assert len(np.unique(points[:, 1])) > 0.9 * len(np.unique(truth[:, 1])) > 100
    model = _pycolmap.load().Reconstruction(str(folder / sparse))
    xyz = {key: point.xyz for key, point in model.points3D.items()}
    for entry in _pycolmap.registered(model):
        assert np.abs(entry.cam_from_world[:, 3]).max() < 20
        xy, ids = _pycolmap.observations(model, entry.image_id)
        assert len(ids) > 30
        assert np.abs(in_float32(entry, np.array([xyz[i] for i in ids])) - xy).max() < 0.01


@pytest.mark.parametrize("format", ["3dgs", "openmvs"])
def test_a_model_at_the_origin_stays_where_it_is(root: Path, tmp_path: Path, format: str) -> None:
    assert not (exported(format, root, tmp_path / "out") / "offset.txt").exists()


def test_flat_names_are_flat_and_unique() -> None:
    given = ["a/b.png", "a_b.png", "a b.png", "c.png", "x,y/z.JPG"]
    flat = flat_names(given)
    assert flat["a_b.png"] == "a_b.png" and flat["c.png"] == "c.png"
    assert len(set(flat.values())) == len(given)
    assert all(not set(name) & set("/ ,") for name in flat.values())
    assert [Path(name).suffix for name in flat.values()] == [Path(name).suffix for name in given]


def test_the_command_writes_beside_the_result(
    root: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    shutil.copytree(root / "dense-tco", tmp_path / "dense-tco")
    assert main(["export", "3dgs", str(tmp_path), "-q", "--max-points", "50"]) == 0
    assert "50 points" in capsys.readouterr().out
    assert (tmp_path / "dense-tco-3dgs" / "sparse" / "0" / "points3D.bin").is_file()
    assert main(["export", "3dgs", str(tmp_path), "-q"]) == 3
    assert "--overwrite" in capsys.readouterr().err
    assert main(["export", "3dgs", str(tmp_path), "-q", "--overwrite", "-o", str(tmp_path / "o")]) == 0
    assert main(["export", "3dgs", str(tmp_path), "-q", "--overwrite"]) == 0
    model = _pycolmap.load().Reconstruction(str(tmp_path / "dense-tco-3dgs" / "sparse" / "0"))
    assert len(model.points3D) > 1000
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dense-tco", "dense-tco-3dgs", "o"]


def test_folders_of_others_are_not_replaced(root: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious").write_text("1")
    with pytest.raises(InputError, match="no export of colmap-tco"):
        exported("3dgs", root, tmp_path / "mine", overwrite=True)
    assert (tmp_path / "mine" / "precious").read_text() == "1"


@pytest.mark.parametrize(
    ("lost", "told"),
    [
        ("fused.ply", "no such cloud"),
        ("fused.ply.vis", "no such visibility"),
        ("images/c.jpg", "no such image"),
        ("sparse", "colmap-tco densify"),
    ],
)
def test_what_is_missing_is_named_and_nothing_is_left(
    root: Path, tmp_path: Path, lost: str, told: str
) -> None:
    dense = tmp_path / "w" / "dense-tco"
    shutil.copytree(root / "dense-tco", dense)
    (shutil.rmtree if (dense / lost).is_dir() else Path.unlink)(dense / lost)
    with pytest.raises(InputError, match=told):
        exported("3dgs", tmp_path / "w", tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["w"]


def test_visibility_of_another_run_is_refused(root: Path, tmp_path: Path) -> None:
    dense = tmp_path / "dense"
    shutil.copytree(root / "dense-tco", dense)
    cloud = open_dense(dense).cloud()
    write = replace(cloud.visibility, images=cloud.visibility.images + 1)
    from colmap_tco.ply import write_vis

    write_vis(dense / "fused.ply.vis", write)
    with pytest.raises(InputError, match="different runs"):
        open_dense(dense).cloud()
    write_vis(dense / "fused.ply.vis", thinned(cloud, 10).visibility)
    with pytest.raises(InputError, match="different runs"):
        open_dense(dense).cloud()
