"""The dense workspace: COLMAP reads it and fuses it to the same surface; kills and repeats do no harm."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_tco import _pycolmap, scene
from colmap_tco.errors import InputError
from colmap_tco.fusion import FusionConfig, fuse
from colmap_tco.maps import read_map
from colmap_tco.normals import normals_from_depth
from colmap_tco.origin import hashes
from colmap_tco.outputs import (
    ViewMaps,
    fusion_views,
    no_finer,
    plain,
    reaches,
    read_view,
    undistorted_model,
    write_cloud,
    write_image,
    write_lists,
    write_model,
    write_report,
    write_view,
)
from colmap_tco.ply import read_ply, read_vis
from colmap_tco.resume import Origin, Result, fingerprint, open_result
from colmap_tco.tracks import Observations, Tracks, read_tracks
from colmap_tco.views import View, ViewConfig, make_views
from colmap_tco.workspace import DensePaths, Workspace, dense_paths, open_workspace, partial_paths
from tests.programs import imported_open3d

Floats = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[2]
WIDTH, HEIGHT, FOCAL, RADIAL = 120, 90, 110.0, -0.08
COUNT = 5
NORMAL = np.array([0.3, 0.15, -1.0]) / np.linalg.norm([0.3, 0.15, -1.0])
PIXEL = 4.0 / FOCAL


def pose(i: int) -> Floats:
    angle = 0.15 * (i - (COUNT - 1) / 2)
    eye = np.array([4 * np.sin(angle), 0.4 * np.sin(2.1 * i), -4 * np.cos(angle)])
    z = -eye / np.linalg.norm(eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return np.concatenate([rotation, -(rotation @ eye)[:, None]], 1)


def depth_along(cam_from_world: Floats, rays: Floats) -> Floats:
    """Depth of the plane NORMAL·X = 0 along camera rays (…, 3) of unit z."""
    centre = -cam_from_world[:, :3].T @ cam_from_world[:, 3]
    return -(centre @ NORMAL) / (rays @ cam_from_world[:, :3] @ NORMAL)


def pattern(points: Floats) -> NDArray[np.uint8]:
    waves = np.sin(points @ np.array([[9.0, 2, 1], [1, 11, 3], [5, 4, 2]]))
    return np.rint(127 + 90 * waves).astype(np.uint8)


def names() -> list[str]:
    return ["left/a.jpg", "left/b.png", "c.jpg", "right/d e.png", "right/f.jpg"]


def make_workspace(root: Path) -> None:
    """Pictures of a slanted plane through a SIMPLE_RADIAL lens, with a model in COLMAP's binary format."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(-1.2, 1.2, (150, 2))
    points = np.c_[xy, -(xy @ NORMAL[:2]) / NORMAL[2]]
    sparse = root / "sparse" / "0"
    sparse.mkdir(parents=True)
    (sparse / "cameras.txt").write_text(
        f"7 SIMPLE_RADIAL {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2 + 2} {HEIGHT / 2 - 1} {RADIAL}\n"
    )
    lens = _pycolmap.load().Camera(
        model="SIMPLE_RADIAL",
        width=WIDTH,
        height=HEIGHT,
        params=[FOCAL, WIDTH / 2 + 2, HEIGHT / 2 - 1, RADIAL],
    )
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.c_[_pycolmap.cam_from_img(lens, np.c_[u.ravel(), v.ravel()]), np.ones(u.size)]
    lines, tracks = [], [[] for _ in points]  # type: ignore[var-annotated]
    for i, name in enumerate(names()):
        move = pose(i)
        seen = rays * depth_along(move, rays)[:, None]
        image = pattern((seen - move[:, 3]) @ move[:, :3]).reshape(HEIGHT, WIDTH, 3)
        write_image(root / "images" / name, image)
        local = points @ move[:, :3].T + move[:, 3]
        pixels = _pycolmap.img_from_cam(lens, local[:, :2] / local[:, 2:])
        w, x, y, z = np.roll(_pycolmap.load().Rotation3d(move[:, :3].copy()).quat, 1)
        inside = ((pixels > 0) & (pixels < (WIDTH, HEIGHT))).all(1)
        row = []
        for point in np.flatnonzero(inside):
            tracks[point].append((10 * i + 3, len(row)))
            row.append(f"{pixels[point, 0]} {pixels[point, 1]} {point + 1}")
        lines += [f"{10 * i + 3} {w} {x} {y} {z} {' '.join(map(str, move[:, 3]))} 7 {i}", " ".join(row)]
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    rows = (
        f"{i + 1} {' '.join(map(str, xyz))} 9 8 7 0.1 " + " ".join(f"{a} {b}" for a, b in track)
        for i, (xyz, track) in enumerate(zip(points, tracks, strict=True))
    )
    (sparse / "points3D.txt").write_text("\n".join(rows) + "\n")
    model = _pycolmap.load().Reconstruction(str(sparse))
    for i, name in enumerate(names()):
        model.images[10 * i + 3].name = name  # the text format would end a name at its first space
    for file in sparse.iterdir():
        file.unlink()
    model.write(str(sparse))


def maps_of(view: View) -> ViewMaps:
    camera = view.camera
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    depth = depth_along(view.cam_from_world, rays).astype(np.float32)
    return ViewMaps(depth, normals_from_depth(depth, camera), np.full_like(depth, 2.0))


def opened(root: Path) -> tuple[Workspace, list[View]]:
    workspace = open_workspace(root)
    views, skipped = make_views(workspace, ViewConfig(), 8)
    assert not skipped
    return workspace, views


def densify(root: Path, seed: int = 0, overwrite: bool = False, stop_after: int | None = None) -> Result:
    """Every step from workspace to published result; with ``stop_after`` it hangs after so many views."""
    workspace, views = opened(root)
    result = open_result(root, Origin({"seed": seed}, hashes({v.name: v.path for v in views})), overwrite)
    if result.finished:
        return result
    neighbours = {v.name: [o.name for o in views if o is not v] for v in views}
    for count, view in enumerate(views):
        if not result.is_done(view.name):
            write_view(result.paths, view, maps_of(view))
            result.mark_done({view.name: {"seed": seed, "written": time.time_ns()}})
        if stop_after == count + 1:
            print("stopped", flush=True)
            time.sleep(60)
    indices = write_model(result.paths, undistorted_model(workspace.model, views))
    write_lists(result.paths, neighbours)
    fusable = fusion_views(result.paths, views, neighbours, indices)
    cloud, report = fuse(fusable, FusionConfig(min_num_pixels=3, num_threads=1))
    write_cloud(result.paths, cloud)
    write_report(result.paths.report, {"fusion": report.as_dict()})
    result.publish()
    return result


@dataclass
class Made:
    root: Path
    paths: DensePaths
    workspace: Workspace
    views: list[View]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    root = tmp_path_factory.mktemp("workspace")
    make_workspace(root)
    paths = densify(root).paths
    return Made(root, paths, *opened(root))


def tree(root: Path) -> dict[str, str]:
    files = (path for path in sorted(root.rglob("*")) if path.is_file() and "dense-tco" not in str(path))
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_the_files_are_where_colmap_looks(made: Made) -> None:
    for name in names():
        assert made.paths.image(name).is_file()
        assert (made.paths.root / "stereo" / "depth_maps" / f"{name}.geometric.bin").is_file()
        assert (made.paths.root / "stereo" / "normal_maps" / f"{name}.geometric.bin").is_file()
    assert (made.paths.stereo / "consistency_graphs").is_dir()
    assert made.paths.fusion_cfg.read_text().splitlines() == sorted(names())
    lines = made.paths.patch_match_cfg.read_text().splitlines()
    assert lines[::2] == sorted(names())
    assert all(set(line.split(", ")) < set(names()) for line in lines[1::2])
    assert not [path for path in made.paths.root.rglob("*") if "unfinished" in path.name]


def test_the_model_keeps_ids_names_poses_and_tracks(made: Made) -> None:
    before, after = made.workspace.model, _pycolmap.read_model(made.paths.sparse)
    assert {c.model.name for c in after.cameras.values()} == {"PINHOLE"}
    assert {i: image.name for i, image in after.images.items()} == {
        i: image.name for i, image in before.images.items()
    }
    old = {entry.image_id: entry.cam_from_world for entry in _pycolmap.registered(before)}
    for entry in _pycolmap.registered(after):
        assert np.abs(entry.cam_from_world - old[entry.image_id]).max() < 1e-12
    lost = set(before.points3D) - set(after.points3D)
    assert len(lost) < 0.1 * len(before.points3D)
    for key, point in after.points3D.items():
        assert np.abs(point.xyz - before.points3D[key].xyz).max() < 1e-12
        assert point.track.length() >= 2
    errors = [point.error for point in after.points3D.values()]
    assert max(errors) < 0.01, "the observations moved with the undistortion"


def test_corrected_cameras_are_written_and_the_observations_stay_in_the_picture(made: Made) -> None:
    moved = np.array([[1.0, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0]])
    corrected = [
        replace(
            v, camera=replace(v.camera, fx=1.1 * v.camera.fx), cam_from_world=v.cam_from_world + moved * 0.01
        )
        for v in made.views
    ]
    for view in corrected:
        rotation = np.linalg.svd(view.cam_from_world[:, :3])
        view.cam_from_world[:, :3] = rotation[0] @ rotation[2]
    plainly = undistorted_model(made.workspace.model, made.views)
    model = undistorted_model(made.workspace.model, corrected, {view.name: view for view in made.views})
    for view, entry in zip(corrected, _pycolmap.registered(model), strict=True):
        assert np.abs(entry.cam_from_world - view.cam_from_world).max() < 1e-9
        assert entry.camera.params[0] == view.camera.fx
        ours, theirs = (_pycolmap.observations(m, view.image_id)[0] for m in (model, plainly))
        assert np.array_equal(ours, theirs)


def test_images_show_what_their_cameras_see(made: Made) -> None:
    """The picture at the projection of a point has the colour of the point."""
    for view in made.views:
        image = cv2.imread(str(made.paths.image(view.name)))[..., ::-1]
        assert image.shape == (view.camera.height, view.camera.width, 3)
        maps = maps_of(view)
        u, v = np.meshgrid(np.arange(view.camera.width) + 0.5, np.arange(view.camera.height) + 0.5)
        rays = np.c_[view.camera.normalised(np.c_[u.ravel(), v.ravel()]), np.ones(u.size)]
        points = (rays * maps.depth.reshape(-1, 1) - view.cam_from_world[:, 3]) @ view.cam_from_world[:, :3]
        error = np.abs(pattern(points).reshape(image.shape).astype(int) - image)[12:-12, 12:-12]
        assert np.median(error) < (3 if view.name.endswith("png") else 8)


def test_maps_come_back_bit_for_bit(made: Made) -> None:
    for view in made.views:
        maps, back = maps_of(view), read_view(made.paths, view.name)
        assert np.array_equal(maps.depth, back.depth)
        assert np.array_equal(maps.normal, back.normal)
        assert back.confidence is not None
        assert np.array_equal(maps.confidence, back.confidence)


def test_pycolmap_reads_the_depth_maps(made: Made) -> None:
    for view in made.views:
        theirs = _pycolmap.load().DepthMap()
        theirs.read(str(made.paths.depth_map(view.name)))
        assert np.array_equal(theirs.to_array(), read_map(made.paths.depth_map(view.name)))


def test_stereo_fusion_gives_our_surface_half_a_pixel_aside(made: Made, tmp_path: Path) -> None:
    """COLMAP's fusion takes the corner of a pixel for its centre; corrected by that, the clouds agree."""
    pycolmap = _pycolmap.load()
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels, options.num_threads = 3, 1
    pycolmap.stereo_fusion(
        str(tmp_path / "colmap.ply"), str(made.paths.root), options=options, output_type="PLY"
    )
    theirs, their_normals, their_colours = read_ply(tmp_path / "colmap.ply")
    ours, our_normals, our_colours = read_ply(made.paths.ply)
    assert len(theirs) > 1000
    assert 1 < len(ours) / len(theirs) < 4, "COLMAP also merges neighbouring pixels of one view"
    assert np.abs(ours @ NORMAL).max() / PIXEL < 1e-3
    # Half a pixel up and left in the camera moves a point by (z / 2 f, z / 2 f): off a slanted plane.
    turned = pose(2)[:, :3] @ NORMAL
    expected = -(turned[0] + turned[1]) * 0.5 * PIXEL
    assert np.median(theirs @ NORMAL) == pytest.approx(expected, rel=0.4)
    header = (tmp_path / "colmap.ply").read_bytes().split(b"end_header")[0]
    assert made.paths.ply.read_bytes().startswith(header.replace(b"%d" % len(theirs), b"%d" % len(ours)))
    assert len(read_vis(tmp_path / "colmap.ply.vis")) == len(theirs)
    distance, nearest = cKDTree(ours).query(theirs)
    assert np.quantile(distance, 0.95) < 1.2 * PIXEL
    assert (their_normals * our_normals[nearest]).sum(1).min() > np.cos(np.radians(2))
    assert np.median(np.abs(their_colours.astype(int) - our_colours[nearest])) < 30


def test_views_reach_as_far_as_nearly_all_of_their_points(made: Made) -> None:
    """Of depths 1, 2, … 101 the 98th percentile is 99; other images' points do not count, nor do a few."""
    some, few, none = (replace(view, cam_from_world=look_along_x()) for view in made.views[:3])
    x = np.concatenate([np.arange(1.0, 102.0), np.full(50, 1e6)])
    xyz = np.stack([x, 3 * x, -x], 1) + (10.0, 0.0, 0.0)
    seen = {some.image_id: np.arange(101), few.image_id: np.arange(9), none.image_id: np.arange(0)}
    images = {key: Observations(np.zeros((len(p), 2)), p, np.zeros(len(p))) for key, p in seen.items()}
    tracks = Tracks(np.arange(len(x)), xyz, np.zeros((len(x), 3, 3)), np.full(len(x), 2), images, {}, {})
    assert reaches(tracks, [some, few, none]) == {some.name: pytest.approx(99.0)}


def look_along_x() -> Floats:
    """cam_from_world of a camera at x = 10."""
    return np.array([[0.0, 0, -1, 0], [0, -1, 0, 0], [1, 0, 0, -10]])


def test_views_for_the_fusion_know_how_far_they_reach(made: Made) -> None:
    """From files and in memory; and the fusion drops what lies farther than that many times."""
    tracks = read_tracks(made.workspace.model)
    reach = reaches(tracks, made.views)
    assert set(reach) == set(names())
    neighbours = {view.name: [o.name for o in made.views if o is not view] for view in made.views}
    indices = {view.name: i for i, view in enumerate(made.views)}
    from_files = fusion_views(made.paths, made.views, neighbours, indices, reach)
    sources = [[j for j in range(COUNT) if j != i] for i in range(COUNT)]
    in_memory = scene.fusion_views(made.views, [maps_of(view) for view in made.views], sources, tracks)
    config = FusionConfig(min_num_pixels=3, num_threads=1, max_depth_ratio=0.9)
    for views in (from_files, in_memory):
        assert {view.name: view.reach for view in views} == reach
        far = sum(int((view.load().depth > 0.9 * view.reach).sum()) for view in views)
        assert fuse(views, config)[1].pixels["max_depth_ratio"] == far > 1000
    unbound = fusion_views(made.paths, made.views, neighbours, indices)
    assert all(view.reach == np.inf for view in unbound)


def test_visibility_counts_in_the_order_of_the_written_model(made: Made) -> None:
    model = _pycolmap.read_model(made.paths.sparse)
    order = [model.images[key].name for key in model.reg_image_ids()]
    points = read_ply(made.paths.ply)[0]
    visibility = read_vis(made.paths.vis)
    by_name = {view.name: view for view in made.views}
    assert len(visibility) == len(points)
    seen = set()
    for i in range(0, len(points), 53):
        for image in visibility[i].tolist():
            view = by_name[order[image]]
            seen.add(image)
            local = view.cam_from_world[:, :3] @ points[i] + view.cam_from_world[:, 3]
            xy = view.camera.pixels((local[:2] / local[2])[None])[0]
            assert (xy > -1).all()
            assert (xy < np.array([view.camera.width, view.camera.height]) + 1).all()
    assert seen == set(range(COUNT))


def test_open3d_reads_the_cloud(made: Made) -> None:
    o3d = imported_open3d()
    cloud = o3d.io.read_point_cloud(str(made.paths.ply))
    assert len(cloud.points) == len(read_ply(made.paths.ply)[0])
    assert cloud.has_normals()
    assert cloud.has_colors()


def test_a_second_run_finds_all_done_and_changes_nothing(made: Made) -> None:
    before = made.paths.manifest.stat().st_mtime_ns, tree(made.root)
    result = densify(made.root)
    assert result.finished
    assert result.paths.root == made.paths.root
    assert set(result.views) == set(names())
    assert (made.paths.manifest.stat().st_mtime_ns, tree(made.root)) == before
    assert not partial_paths(made.root).root.exists()


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    make_workspace(tmp_path)
    return tmp_path


def test_a_killed_run_is_continued(workspace: Path) -> None:
    before = tree(workspace)
    code = (
        f"import sys; sys.path[:0] = [{str(ROOT)!r}, {str(Path(__file__).parent)!r}]\n"
        f"from pathlib import Path; import test_outputs\n"
        f"test_outputs.densify(Path({str(workspace)!r}), stop_after=2)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == "stopped\n"
        run.kill()
    partial = partial_paths(workspace)
    assert not dense_paths(workspace).root.exists()
    first = json.loads(partial.manifest.read_text())["views"]
    assert len(first) == 2
    (partial.stereo / ".x.1.unfinished.bin").write_bytes(b"half a file")
    (partial.root / ".sparse.unfinished-1").mkdir()
    (partial.root / ".sparse.unfinished-1" / "images.bin").write_bytes(b"half a model")
    result = densify(workspace)
    assert {name: result.views[name] for name in first} == first, "finished views were made again"
    assert len(result.views) == COUNT
    assert not partial.root.exists()
    assert not list(result.paths.root.rglob("*unfinished*"))
    assert tree(workspace) == before


def test_a_finished_view_with_a_lost_file_is_made_again(workspace: Path) -> None:
    _, views = opened(workspace)
    result = open_result(workspace, origin())
    for view in views[:2]:
        write_view(result.paths, view, maps_of(view))
        result.mark_done({view.name: {}})
    result.paths.normal_map(views[0].name).unlink()
    again = open_result(workspace, origin())
    assert not again.is_done(views[0].name)
    assert again.is_done(views[1].name)


def origin(seed: int = 1, **others: object) -> Origin:
    """Of made-up settings, of which ``min_num_pixels`` decides only what follows the maps."""
    settings = {"seed": seed, "min_num_pixels": 5} | others
    return Origin(settings, {"picture a.jpg": "1f", "weights": "2e"}, frozenset({"min_num_pixels"}))


def test_an_error_says_what_is_different(workspace: Path) -> None:
    first = origin()
    open_result(workspace, first).publish()
    with pytest.raises(InputError, match=r"was made with other settings \(seed 1, now 2\); give --overwrite"):
        open_result(workspace, origin(seed=2))
    with pytest.raises(InputError, match=r"settings \(added unknown, now true\)"):
        open_result(workspace, origin(added=True))
    with pytest.raises(InputError, match=r"made from other inputs \(weights, picture b.jpg\); give"):
        open_result(
            workspace, first._replace(inputs={"picture a.jpg": "1f", "weights": "3d", "picture b.jpg": "4c"})
        )
    many = {f"picture {i}.jpg": "5b" for i in range(9)}
    with pytest.raises(InputError, match=r"\(seed 1, now 3\) and from other inputs \(.* and 6 more\)"):
        open_result(workspace, origin(seed=3)._replace(inputs=many))
    manifest = dense_paths(workspace).manifest
    manifest.write_text('{"made_by": "colmap-tco", "format": 1, "fingerprint": "0a"}')
    with pytest.raises(InputError, match="was made by an earlier version; give --overwrite"):
        open_result(workspace, first)


def one_view_finished(workspace: Path, made_from: Origin) -> Result:
    """An interrupted run."""
    view = opened(workspace)[1][0]
    result = open_result(workspace, made_from)
    write_view(result.paths, view, maps_of(view))
    result.mark_done({view.name: {"a": 1}})
    result.mark_chunk({"loss": [1.5], "seconds": 40.0})
    return result


def test_finished_views_of_an_interrupted_run_are_not_dropped_unasked(workspace: Path) -> None:
    result = one_view_finished(workspace, origin())
    manifest = result.paths.manifest.read_bytes()
    with pytest.raises(InputError, match=r"begun with other settings \(seed 1, now 2\): .*its 1 fin"):
        open_result(workspace, origin(seed=2))
    assert result.paths.manifest.read_bytes() == manifest
    assert open_result(workspace, origin()).views == result.views
    assert not open_result(workspace, origin(seed=2), overwrite=True).views
    assert not result.paths.depth_map(next(iter(result.views))).exists()


def test_an_interrupted_run_without_a_finished_view_stands_in_nobodys_way(workspace: Path) -> None:
    result = open_result(workspace, origin())
    result.mark_done({"a": {}})  # whose files are not there
    (result.paths.root / "left.bin").write_bytes(b"1")
    assert not open_result(workspace, origin(seed=2)).views
    assert not (result.paths.root / "left.bin").exists()


def test_work_on_maps_is_kept_where_only_what_follows_differs(workspace: Path) -> None:
    """In a partial folder and from a published result; not where the maps themselves would differ."""
    result = one_view_finished(workspace, origin())
    (name,) = result.views
    again = open_result(workspace, origin(min_num_pixels=2))
    assert again.views == {name: {"a": 1}} and again.chunks == [{"loss": [1.5], "seconds": 40.0}]
    again.publish()
    third = open_result(workspace, origin(min_num_pixels=3), overwrite=True)
    assert third.views == again.views and third.chunks == again.chunks and not third.finished
    final, partial = dense_paths(workspace), partial_paths(workspace)
    assert partial.depth_map(name).samefile(final.depth_map(name))
    assert not open_result(workspace, origin(seed=2, min_num_pixels=3), overwrite=True).views


def test_seconds_of_earlier_runs_are_counted(workspace: Path) -> None:
    """Those of the chunks and of the model, in every later run; of the other stages the last run's."""
    result = one_view_finished(workspace, origin())
    result.mark_mapping(7.5)
    again = open_result(workspace, origin())
    again.mark_chunk({"loss": [], "seconds": 2.0})
    told = {"mapping": 7.5, "workspace": 1.0, "optimisation": 42.0, "fusion": 3.0}
    assert again.seconds({"workspace": 1.0, "optimisation": 0.1, "fusion": 3.0}) == told
    again.publish()
    third = open_result(workspace, origin(min_num_pixels=3), overwrite=True)
    assert third.seconds({"workspace": 1.0, "optimisation": 0.1, "fusion": 3.0}) == told


def test_overwriting_must_be_asked_for_and_replaces_at_the_end(workspace: Path) -> None:
    densify(workspace, seed=1)
    old = dense_paths(workspace).manifest.read_bytes()
    with pytest.raises(InputError, match="--overwrite"):
        densify(workspace, seed=2)
    assert dense_paths(workspace).manifest.read_bytes() == old
    result = open_result(workspace, origin(), overwrite=True)
    assert dense_paths(workspace).manifest.read_bytes() == old, (
        "the old result stays until the new one is complete"
    )
    assert not result.finished
    result.publish()
    assert dense_paths(workspace).manifest.read_bytes() != old
    assert sorted(p.name for p in workspace.iterdir()) == ["dense-tco", "images", "sparse"]


@pytest.mark.parametrize("published", [True, False])
def test_a_kill_between_the_renames_loses_nothing(workspace: Path, published: bool) -> None:
    open_result(workspace, origin(1)).publish()
    open_result(workspace, origin(2), overwrite=True)
    final, partial = dense_paths(workspace).root, partial_paths(workspace).root
    final.rename(workspace / ".dense-tco.old")
    if published:
        partial.rename(final)
    assert open_result(workspace, origin(2 if published else 1)).finished
    assert not (workspace / ".dense-tco.old").exists()


@pytest.mark.parametrize("folder", ["dense-tco", ".dense-tco.partial"])
@pytest.mark.parametrize("manifest", [None, "{}", "not json", '{"made_by": "someone"}'])
def test_folders_of_others_are_not_touched(workspace: Path, folder: str, manifest: str | None) -> None:
    (workspace / folder).mkdir()
    (workspace / folder / "precious").write_text("mine")
    if manifest is not None:
        (workspace / folder / "manifest.json").write_text(manifest)
    with pytest.raises(InputError, match="not made by"):
        open_result(workspace, origin(), overwrite=True)
    assert (workspace / folder / "precious").read_text() == "mine"


def test_an_empty_partial_folder_is_taken(workspace: Path) -> None:
    partial_paths(workspace).root.mkdir()
    assert not open_result(workspace, origin()).finished


def test_the_fingerprint_follows_settings_and_inputs(workspace: Path) -> None:
    model = sorted((workspace / "sparse" / "0").iterdir())

    def key(**settings: object) -> str:
        return fingerprint({"steps": 40, **settings}, model)

    first = key()
    assert key() == first == fingerprint({"steps": 40}, model[::-1])
    assert key(steps=41) != first
    model[0].write_bytes(model[0].read_bytes() + b"x")
    assert key() != first


@pytest.mark.parametrize("name", ["a.jpg", "a.JPEG", "a.png", "a.tif", "a.bmp", "a.webp", "a.pgm", "b/a.ppm"])
def test_images_keep_their_format(tmp_path: Path, name: str) -> None:
    x, y = np.meshgrid(np.arange(40.0), np.arange(30.0))
    smooth = np.stack([4 * x, 6 * y, 255 - 3 * x], -1).astype(np.uint8)
    write_image(tmp_path / name, smooth)
    back = cv2.imread(str(tmp_path / name))[..., ::-1].astype(int)
    expected = smooth.mean(2, keepdims=True) if name.endswith("pgm") else smooth
    assert np.abs(back - expected).mean() < 3
    if name.endswith(("png", "tif", "bmp", "ppm")):
        assert np.array_equal(back, smooth)


def test_reports_are_plain_json(tmp_path: Path) -> None:
    """Figures rounded, settings, which are dataclasses, exact."""

    @dataclass
    class Part:
        where: Path
        numbers: NDArray[np.float64]

    part = Part(Path("x/y"), np.array([5400003.25, np.nan, np.inf]))
    write_report(
        tmp_path / "r.json", {"part": part, "n": np.int64(3), "yes": True, "none": None, 4: (1e-9 / 3,)}
    )
    assert json.loads((tmp_path / "r.json").read_text()) == {
        "part": {"where": "x/y", "numbers": [5400003.25, None, None]},
        "n": 3,
        "yes": True,
        "none": None,
        "4": [3.33333e-10],
    }
    with pytest.raises(TypeError, match="object"):
        plain({"a": object()})


@pytest.mark.parametrize(("size", "expected"), [((750, 1000), (375, 500)), ((399, 1600), (399, 1600))])
def test_large_images_are_fused_at_less_than_their_size(
    size: tuple[int, int], expected: tuple[int, int]
) -> None:
    """They keep their field of view: what lies at a share of the sides lies there still."""
    y, x = ((np.arange(n) + 0.5) / n for n in size)
    ramp = np.stack(np.broadcast_arrays(240 * y[:, None], 240 * x, 120.0), -1).round().astype(np.uint8)
    got = no_finer(ramp, (75, 100))
    assert got.shape == (*expected, 3)
    y, x = ((np.arange(n) + 0.5) / n for n in expected)
    assert np.abs(got[..., 0] - 240 * y[:, None]).max() < 1.1
    assert np.abs(got[..., 1] - 240 * x).max() < 1.1
