"""``colmap-tco evaluate`` on a plane that is known exactly, with every kind of truth, and with faults."""

from __future__ import annotations

import importlib.util
import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from skimage.transform import SimilarityTransform

from colmap_tco import _pycolmap
from colmap_tco.cli import main
from colmap_tco.errors import InputError
from colmap_tco.evaluation.align import Similarity
from colmap_tco.evaluation.command import CloudConfig, EvaluateConfig, Evaluation, UnitConfig, evaluate
from colmap_tco.maps import read_map, write_map
from colmap_tco.ply import read_ply
from colmap_tco.progress import Progress
from tests.colmap_tco.test_outputs import (
    COUNT,
    FOCAL,
    HEIGHT,
    NORMAL,
    RADIAL,
    WIDTH,
    densify,
    depth_along,
    make_workspace,
    names,
    pose,
)
from tests.programs import imported_open3d

o3d = imported_open3d()
Floats = NDArray[np.float64]

METRES = 0.25
WORLD = Similarity(METRES, Rotation.from_rotvec([0.3, -2, 1]).as_matrix(), np.array([4.0, -7, 2]))
"""truth_from_model, where the truth has a frame of its own."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plane")
    make_workspace(folder)
    densify(folder)
    return folder


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    """A copy to write into, of which the report does not know where it was made."""
    copy = tmp_path / "scene"
    shutil.copytree(made, copy)
    return copy


@pytest.fixture(scope="module")
def depths(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The plane's depth at the pixels of the distorted images, in millimetres."""
    folder = tmp_path_factory.mktemp("depth")
    for name, depth in true_depth().items():
        write_png(folder / f"{name}.png", depth)
    return folder


def write_png(path: Path, depth: Floats) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.rint(1000 * depth).astype(np.uint16))


def true_lens() -> Any:
    """The camera of the distorted images."""
    return _pycolmap.load().Camera(
        model="SIMPLE_RADIAL",
        width=WIDTH,
        height=HEIGHT,
        params=[FOCAL, WIDTH / 2 + 2, HEIGHT / 2 - 1, RADIAL],
    )


def true_depth() -> dict[str, Floats]:
    """Name → depth (H, W) in metres."""
    lens = true_lens()
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.c_[_pycolmap.cam_from_img(lens, np.c_[u.ravel(), v.ravel()]), np.ones(u.size)]
    return {
        name: METRES * depth_along(pose(i), rays).reshape(HEIGHT, WIDTH) for i, name in enumerate(names())
    }


def config(*truth: Path, units: dict[str, Any] | None = None, **settings: Any) -> EvaluateConfig:
    """The settings, those of the cloud by their names too; without any of these the cloud is made small."""
    of_cloud = {k: settings.pop(k) for k in list(settings) if k in CloudConfig.__dataclass_fields__}
    of_cloud = of_cloud or {"max_points": 2000}
    unit = UnitConfig(**({"metres_per_unit": METRES} | (units or {})))
    return EvaluateConfig(truth=truth, units=unit, clouds=CloudConfig(**of_cloud), **settings)


def run(root: Path, settings: EvaluateConfig) -> Evaluation:
    done = evaluate(root, settings, Progress())
    assert json.loads(done.path.read_text(encoding="utf-8")) == json.loads(json.dumps(done.figures))
    return done


def true_poses() -> Floats:
    """world_from_cam (N, 4, 4) in the truth's own frame, ordered as ``names()``."""
    out = np.tile(np.eye(4), (COUNT, 1, 1))
    out[:, :3] = np.stack([pose(i) for i in range(COUNT)])
    return WORLD.poses(np.linalg.inv(out))


def write_true_model(folder: Path, poses: Floats) -> Path:
    """COLMAP's text format with cameras alone."""
    folder.mkdir(parents=True)
    lines = []
    for i, (name, world_from_cam) in enumerate(zip(names(), poses, strict=True), 1):
        move = np.linalg.inv(world_from_cam)
        q = Rotation.from_matrix(move[:3, :3]).as_quat()
        lines.append(
            f"{i} {q[3]} {q[0]} {q[1]} {q[2]} {' '.join(map(str, move[:3, 3]))} 1 {name.replace(' ', '_')}\n"
        )
    (folder / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} 60 45\n")
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("")
    model = _pycolmap.load().Reconstruction(str(folder))
    for i, name in enumerate(names(), 1):
        model.images[i].name = name
    for file in folder.iterdir():
        file.unlink()
    model.write(str(folder))
    return folder


def plane_cloud(count: int = 20000, seed: int = 0) -> Floats:
    """Points of the plane, as far as the views see it, in the model's frame."""
    xy = np.random.default_rng(seed).uniform(-2.5, 2.5, (count, 2))
    return np.c_[xy, -(xy @ NORMAL[:2]) / NORMAL[2]]


def write_cloud(path: Path, points: Floats) -> Path:
    assert o3d.io.write_point_cloud(str(path), o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
    return path


class TestDepth:
    """True depth maps."""

    def test_exact_maps_have_no_error_but_that_of_the_nearest_pixel(self, root: Path, depths: Path) -> None:
        done = run(root, config(depths, align="none"))
        depth = done.figures["depth"]
        assert depth["pixels"] == COUNT * WIDTH * HEIGHT
        assert depth["coverage"] > 0.999 and depth["d2"] > 0.999
        assert depth["median"] < 0.003
        assert set(depth["views"]) == set(names())
        cloud = done.figures["cloud"]
        assert cloud["accuracy_median"] < 0.5 * METRES * 4 / FOCAL
        assert cloud["normal_consistency_median"] > 0.99
        assert done.path == root / "dense-tco" / "evaluation.json"

    def test_a_relative_error_is_measured_and_taken_out_by_scaling(self, root: Path, tmp_path: Path) -> None:
        for name, depth in true_depth().items():
            write_png(tmp_path / "d" / f"{name}.png", 1.25 * depth)
        off = run(root, config(tmp_path / "d")).figures["depth"]
        assert off["abs_rel"] == pytest.approx(0.2, abs=0.003)
        assert (off["d5"], off["delta_1_25_2"]) == (0, 1)
        assert off["median_ratio"] == pytest.approx(1.25, rel=0.003)
        for scaling in ("median", "scale", "scale_shift"):
            found = run(root, config(tmp_path / "d", units={"scaling": scaling})).figures["depth"]
            assert found["d2"] > 0.999, scaling
            assert found["median"] < 0.003
            assert all(view["d2"] > 0.999 for view in found["views"].values())

    def test_a_wrong_unit_is_told_with_the_right_one(
        self, root: Path, depths: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        with caplog.at_level(logging.WARNING):
            done = run(root, config(depths, units={"metres_per_unit": 1.0}))
        assert "--metres_per_unit (0.25" in caplog.text
        assert done.figures["cloud"] is None
        assert "cloud: left out, for the true depths are 0.25 times" in done.summary()
        caplog.clear()
        run(root, config(depths))
        assert not caplog.records

    def test_holes_are_misses(self, root: Path, depths: Path) -> None:
        whole = run(root, config(depths)).figures["depth"]
        file = root / "dense-tco" / "stereo" / "depth_maps" / f"{names()[0]}.geometric.bin"
        write_map(file, 0 * read_map(file))
        (root / "dense-tco" / "stereo" / "depth_maps" / f"{names()[1]}.geometric.bin").unlink()
        found = run(root, config(depths)).figures["depth"]
        assert found["coverage"] == pytest.approx(3 / 5, abs=1e-3)
        assert found["d5"] == pytest.approx(3 / 5 * whole["d5"], abs=1e-3)
        assert found["views"][names()[0]] is None and found["views"][names()[1]] is None

    def test_every_format_and_naming_gives_the_same(self, root: Path, depths: Path, tmp_path: Path) -> None:
        expected = run(root, config(depths)).figures["depth"]
        for kind in ("npy", "bin", "stem"):
            for name, depth in true_depth().items():
                exact = np.rint(1000 * depth) / 1000
                path = tmp_path / kind / name
                if kind == "npy":
                    path.parent.mkdir(parents=True, exist_ok=True)
                    np.save(path.with_suffix(".npy"), np.where(exact > 0, exact, np.nan))
                elif kind == "bin":
                    write_map(path.with_name(path.name + ".geometric.bin"), exact)
                else:
                    write_png(path.with_name(path.stem + "_depth.png"), depth)
            found = run(root, config(tmp_path / kind)).figures["depth"]
            assert found["pixels"] == expected["pixels"]
            assert found["abs_rel"] == pytest.approx(expected["abs_rel"], rel=1e-4), kind
            assert found["d2"] == pytest.approx(expected["d2"], abs=1e-5), kind

    def test_maps_of_another_size_belong_to_the_same_image(self, root: Path, tmp_path: Path) -> None:
        for name, depth in true_depth().items():
            small = depth.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean((1, 3))
            write_png(tmp_path / "d" / f"{name}.png", small)
        found = run(root, config(tmp_path / "d")).figures["depth"]
        assert found["pixels"] == COUNT * WIDTH * HEIGHT / 4
        assert found["d2"] > 0.999

    def test_without_a_measurement_is_zero_or_the_greatest_number(self, root: Path, tmp_path: Path) -> None:
        for name, depth in true_depth().items():
            depth[:30], depth[30:60] = 0, 65.535
            write_png(tmp_path / "d" / f"{name}.png", depth)
        assert run(root, config(tmp_path / "d")).figures["depth"]["pixels"] == COUNT * WIDTH * (HEIGHT - 60)

    def test_the_dense_workspace_s_own_pixels_on_demand(self, root: Path, tmp_path: Path) -> None:
        """Its maps against themselves: no error at all, for the pixels are the same."""
        shutil.copytree(root / "dense-tco" / "stereo" / "depth_maps", tmp_path / "maps")
        own = root / "dense-tco" / "sparse"
        settings = config(tmp_path / "maps", model_path=own, units={"metres_per_unit": 1.0})
        depth = run(root, settings).figures["depth"]
        assert depth["abs_rel"] == pytest.approx(0, abs=1e-6)
        assert depth["d2"] == 1

    def test_only_so_many_pixels_count(self, root: Path, depths: Path) -> None:
        found = run(root, config(depths, max_pixels=1000)).figures["depth"]
        assert found["pixels"] == 1000
        assert found["d2"] > 0.99

    def test_colmap_s_own_workspace_is_not_written_into(self, root: Path, depths: Path) -> None:
        other = root / "dense"
        (root / "dense-tco").rename(other)
        before = sorted(other.rglob("*"))
        done = run(other, config(depths, model_path=root / "sparse" / "0"))
        assert done.path == root / "dense-evaluation.json"
        assert sorted(other.rglob("*")) == before
        assert done.figures["depth"]["d2"] > 0.999


class TestCloud:
    """True clouds, meshes, and the paper's protocol."""

    def test_a_cloud_in_the_same_frame(self, root: Path, tmp_path: Path) -> None:
        truth = write_cloud(tmp_path / "truth.ply", METRES * plane_cloud())
        cloud = run(root, config(truth, thresholds=(0.002, 0.05))).figures["cloud"]
        points = METRES * read_ply(root / "dense-tco" / "fused.ply")[0]
        d = cKDTree(METRES * plane_cloud()).query(points)[0]
        assert cloud["accuracy_mean"] == pytest.approx(d.mean())
        assert cloud["accuracy_median"] == pytest.approx(np.median(d))
        assert cloud["thresholds"][0]["precision"] == pytest.approx((d < 0.002).mean())
        assert cloud["thresholds"][1]["precision"] == pytest.approx((d < 0.05).mean())
        np.testing.assert_allclose(cloud["truth_from_result"], np.diag([METRES] * 3 + [1]))

    def test_a_mesh_is_sampled(self, root: Path, tmp_path: Path) -> None:
        corners = METRES * 3 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        vertices = np.c_[corners, -(corners @ NORMAL[:2]) / NORMAL[2]]
        mesh = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector([[0, 1, 2], [0, 2, 3]])
        )
        assert o3d.io.write_triangle_mesh(str(tmp_path / "truth.obj"), mesh)
        cloud = run(root, config(tmp_path / "truth.obj", max_points=40000)).figures["cloud"]
        assert cloud["truth_points"] == 40000
        assert cloud["accuracy_mean"] < 0.01 * METRES * 3
        assert cloud["normal_consistency_median"] > 0.99

    def test_a_lone_cloud_is_evaluated_beside_itself(self, root: Path, tmp_path: Path) -> None:
        truth = write_cloud(tmp_path / "truth.ply", METRES * plane_cloud(3000))
        lone = tmp_path / "mine.ply"
        shutil.copy(root / "dense-tco" / "fused.ply", lone)
        done = run(lone, config(truth))
        assert done.path == tmp_path / "mine-evaluation.json"
        assert done.figures["cloud"] == run(root, config(truth)).figures["cloud"]

    def test_another_frame_is_found_by_the_camera_centres(self, root: Path, tmp_path: Path) -> None:
        model = write_true_model(tmp_path / "cameras", true_poses())
        truth = write_cloud(tmp_path / "truth.ply", WORLD.apply(plane_cloud()))
        wrong = run(root, config(truth, align="none")).figures["cloud"]
        assert wrong["accuracy_median"] > 1
        done = run(
            root, config(truth, model, align="sim3", icp_threshold=0.0, units={"metres_per_unit": 1.0})
        )
        cloud = done.figures["cloud"]
        np.testing.assert_allclose(cloud["truth_from_result"], WORLD.matrix, atol=1e-6)
        assert cloud["scale"] == pytest.approx(METRES)
        assert cloud["accuracy_median"] < 0.02 * METRES
        assert done.figures["poses"]["ate_rmse"] < 1e-6

    def test_the_pixels_of_the_maps_against_a_cloud(self, root: Path, depths: Path, tmp_path: Path) -> None:
        """Two truths: the depths choose the pixels, the cloud is what they are compared with."""
        truth = write_cloud(tmp_path / "truth.ply", METRES * plane_cloud())
        done = run(root, config(truth, depths, cloud="pixels"))
        assert done.figures["depth"]["d2"] > 0.999
        cloud = done.figures["cloud"]
        assert cloud["of_points"] > 0.999 * COUNT * WIDTH * HEIGHT
        assert cloud["truth_points"] == 20000
        assert cloud["accuracy_median"] < 0.02 * METRES

    def test_icp_takes_a_small_rigid_error_out(self, root: Path, tmp_path: Path) -> None:
        """Along the plane nothing is fixed, so it is the distance across that must vanish."""
        moved = METRES * plane_cloud() + 0.03 * NORMAL
        truth = write_cloud(tmp_path / "truth.ply", moved)
        off = run(root, config(truth, align="none")).figures["cloud"]
        assert off["accuracy_median"] == pytest.approx(0.03, rel=0.1)
        near = run(root, config(truth, align="icp", icp_threshold=0.1)).figures["cloud"]
        assert near["accuracy_median"] < 0.01
        assert near["scale"] == pytest.approx(METRES)

    def test_the_paper_s_protocol_as_written_out(self, root: Path, depths: Path, tmp_path: Path) -> None:
        """Umeyama on pixels, ICP, normals and distances, each by another library and in one go."""
        model = write_true_model(tmp_path / "cameras", true_poses())
        settings = config(
            depths, model, align="sim3", cloud="pixels", units={"metres_per_unit": 1.0}, max_points=0
        )
        found = run(root, settings).figures["cloud"]
        seen, there = pixel_clouds(root)
        fit = SimilarityTransform.from_estimate(seen, there)
        assert fit
        clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (fit(seen), there)]
        registration = o3d.pipelines.registration
        step = registration.registration_icp(
            *clouds, 0.1, np.eye(4), registration.TransformationEstimationPointToPoint()
        )
        clouds[0].transform(step.transformation)
        for one in clouds:
            one.estimate_normals()
        (a, b), (na, nb) = ([np.asarray(getattr(c, k)) for c in clouds] for k in ("points", "normals"))
        accuracy, to = cKDTree(b).query(a)
        completion, back = cKDTree(a).query(b)
        nc1, nc2 = np.abs((na * nb[to]).sum(1)), np.abs((nb * na[back]).sum(1))
        assert found["points"] == len(seen)
        expected = {
            "accuracy_mean": accuracy.mean(), "accuracy_median": np.median(accuracy),
            "completion_mean": completion.mean(), "completion_median": np.median(completion),
        }  # fmt: skip
        for name, value in expected.items():
            assert found[name] == pytest.approx(value, rel=1e-3), name
        nc = (nc1.mean() + nc2.mean()) / 2
        assert found["normal_consistency_mean"] == pytest.approx(nc, abs=1e-3)

    @pytest.mark.parametrize("kind", ["plain", "tanks", "eth3d"])
    def test_each_f_score_is_one_on_the_truth_itself(self, root: Path, tmp_path: Path, kind: str) -> None:
        points = read_ply(root / "dense-tco" / "fused.ply")[0]
        truth = write_cloud(tmp_path / "truth.ply", METRES * points)
        cloud = run(root, config(truth, f_score=kind, thresholds=(0.01, 0.1))).figures["cloud"]
        assert [row["f"] for row in cloud["thresholds"]] == [1, 1]
        half = write_cloud(tmp_path / "half.ply", METRES * points[points[:, 0] > 0])
        cloud = run(root, config(half, f_score=kind, thresholds=(0.01,))).figures["cloud"]
        assert cloud["thresholds"][0]["recall"] == 1
        assert 0.3 < cloud["thresholds"][0]["precision"] < 0.7

    def test_tanks_is_the_curve_of_clouds_thinned_once(self, tmp_path: Path) -> None:
        """As the benchmark has it: voxels of half the scene's threshold, a histogram of the distances in
        steps of a hundredth of it up to five times it, and shares from its sums; all written out here."""
        rng, tau = np.random.default_rng(0), 0.2
        truth = np.c_[rng.uniform(0, 3, (900, 2)), np.zeros(900)]
        half = truth[truth[:, 0] < 1.5]
        points = half[rng.integers(0, len(half), 1600)] + rng.normal(0, 0.08, (1600, 3))

        def thinned(cloud: Floats) -> Floats:
            cells = np.floor((cloud - cloud.min(0) + tau / 4) / (tau / 2)).astype(int)
            _, which = np.unique(cells, axis=0, return_inverse=True)
            return np.stack([cloud[which.ravel() == k].mean(0) for k in range(which.max() + 1)])

        ours, theirs = thinned(points), thinned(truth)
        assert len(ours) < 0.9 * len(points)
        apart = np.linalg.norm(ours[:, None] - theirs[None], axis=2)
        bins = np.arange(0, 5 * tau, tau / 100)
        precision, recall = (
            np.cumsum(np.histogram(d, bins)[0]) / len(d) for d in (apart.min(1), apart.min(0))
        )
        files = [write_cloud(tmp_path / name, cloud) for name, cloud in (("o.ply", points), ("t.ply", truth))]
        settings = config(
            files[1], f_score="tanks", thresholds=(tau, 0.5 * tau, 3 * tau), units={"metres_per_unit": 1.0}
        )
        rows = run(files[0], settings).figures["cloud"]["thresholds"]
        for row, last in zip(rows, (99, 49, 299), strict=True):
            p, r = precision[last], recall[last]
            assert (row["precision"], row["recall"]) == pytest.approx((p, r))
            assert row["f"] == pytest.approx(2 * p * r / (p + r))
        assert 0.05 < recall[49] < recall[99] < recall[299] < 0.99 and precision[49] < precision[99]

    def test_eth3d_s_scans_know_free_space(self, root: Path, tmp_path: Path) -> None:
        """Scans from the cameras' places: what hides behind the plane is unobserved, what floats is wrong."""
        metric = np.array([METRES] * 3 + [1])
        eye = np.linalg.inv(np.r_[pose(2), [[0, 0, 0, 1]]])
        plane = plane_cloud()
        scan = Similarity(1.0, eye[:3, :3], eye[:3, 3]).inverse.apply(plane)
        write_cloud(tmp_path / "scan one.ply", METRES * scan)
        rows = "\n".join(" ".join(map(str, row)) for row in np.c_[eye[:, :3], eye[:, 3] * metric])
        project = tmp_path / "scan_alignment.mlp"
        project.write_text(
            "<!DOCTYPE MeshLabDocument>\n<MeshLabProject>\n <MeshGroup>\n  "
            f'<MLMesh filename="scan one.ply" label="one">\n   <MLMatrix44>\n{rows}\n</MLMatrix44>\n  '
            "</MLMesh>\n </MeshGroup>\n</MeshLabProject>\n"
        )
        behind, before = (eye[:3, 3] + s * (plane[:2000] - eye[:3, 3]) for s in (1.3, 0.7))
        scores = []
        for extra in (plane[:0], behind, before):
            lone = write_cloud(tmp_path / "mine.ply", np.r_[plane[:2000], extra])
            cloud = run(lone, config(project, f_score="eth3d", thresholds=(0.02,))).figures["cloud"]
            assert cloud["free_space"]
            scores.append(cloud["thresholds"][0]["precision"])
        assert scores[0] == scores[1] == 1
        assert scores[2] == pytest.approx(0.5, abs=0.02)

    def test_projects_that_are_none(self, root: Path, tmp_path: Path) -> None:
        project = tmp_path / "p.mlp"
        mesh = "<MeshLabProject><MeshGroup>{}</MeshGroup></MeshLabProject>"
        for text, told in (
            ("no xml", "not a MeshLab project"),
            (mesh.format(""), "without meshes"),
            (mesh.format('<MLMesh filename="a.ply"/>'), "no rigid pose"),
            (mesh.format(f'<MLMesh filename="a.ply"><MLMatrix44>{"2 " * 16}</MLMatrix44></MLMesh>'), "rigid"),
            (
                mesh.format(
                    '<MLMesh filename="a.ply"><MLMatrix44>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</MLMatrix44>'
                    "</MLMesh>"
                ),
                "a.ply: there is no such cloud",
            ),
        ):
            project.write_text(text)
            with pytest.raises(InputError, match=told):
                run(root, config(project))


def pixel_clouds(root: Path) -> tuple[Floats, Floats]:
    """The plane's depth as the maps have it and as it truly is, at the pixels of the distorted images."""
    lens = true_lens()
    dense = _pycolmap.load().Reconstruction(str(root / "dense-tco" / "sparse"))
    camera = {image.name: dense.cameras[image.camera_id] for image in dense.images.values()}
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.c_[np.asarray(lens.cam_from_img(np.c_[u.ravel(), v.ravel()])), np.ones(u.size)]
    seen, there = [], []
    depths, order = true_depth(), {name: i for i, name in enumerate(names())}
    for name in sorted(depths):
        depth = read_map(root / "dense-tco" / "stereo" / "depth_maps" / f"{name}.geometric.bin")
        f, _, cx, cy = camera[name].params
        x, y = np.floor(rays[:, 0] * f + cx).astype(int), np.floor(rays[:, 1] * f + cy).astype(int)
        inside = (x >= 0) & (x < depth.shape[1]) & (y >= 0) & (y < depth.shape[0])
        z = np.where(inside, depth[y.clip(0, depth.shape[0] - 1), x.clip(0, depth.shape[1] - 1)], 0)
        move = np.eye(4)
        move[:3] = pose(order[name])
        true = (np.rint(1000 * depths[name]) / 1000).ravel()
        for out, world_from_cam, d in (
            (seen, np.linalg.inv(move), z),
            (there, true_poses()[order[name]], true),
        ):
            local = (rays * d[:, None])[z > 0]
            out.append(local @ world_from_cam[:3, :3].T + world_from_cam[:3, 3])
    return np.concatenate(seen), np.concatenate(there)


class TestPoses:
    """True cameras."""

    def tum(self, path: Path, poses: Floats, times: Floats) -> Path:
        q = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        lines = ["# timestamp tx ty tz qx qy qz qw"]
        lines += [" ".join(map(repr, map(float, row))) for row in np.c_[times, poses[:, :3, 3], q]]
        path.write_text("\n".join(lines) + "\n")
        return path

    def test_a_model_in_another_frame_is_no_error(self, root: Path, tmp_path: Path) -> None:
        model = write_true_model(tmp_path / "cameras", true_poses())
        poses = run(root, config(model)).figures["poses"]
        assert poses["images"] == COUNT and poses["pairs"] == COUNT * (COUNT - 1) / 2
        assert poses["auc"] == pytest.approx([1] * 4) and poses["rra"] == pytest.approx([1] * 4)
        assert max(poses["ate_rmse"], poses["rpe_translation"], poses["rpe_rotation_deg"]) < 1e-5

    def test_a_sparse_model_alone_is_a_result(self, root: Path, tmp_path: Path) -> None:
        model = write_true_model(tmp_path / "cameras", true_poses())
        done = run(root / "sparse" / "0", config(model))
        assert done.path == root / "sparse" / "0-evaluation.json"
        assert done.figures["poses"]["ate_rmse"] < 1e-5
        assert done.figures["depth"] is done.figures["cloud"] is None

    def test_turned_cameras_are_off_by_their_angle(self, root: Path, tmp_path: Path) -> None:
        turned = true_poses()
        turned[0, :3, :3] = turned[0, :3, :3] @ Rotation.from_euler("y", 7.5, degrees=True).as_matrix()
        model = write_true_model(tmp_path / "cameras", turned)
        poses = run(root, config(model)).figures["poses"]
        assert poses["rra"] == pytest.approx([0.6, 1, 1, 1])  # the four pairs of one camera, of ten
        assert poses["ate_rmse"] < 1e-5
        assert poses["auc"][1] <= 0.6 + 0.4 * 3 / 10

    def test_scale_counts_where_it_is_not_aligned(self, root: Path, tmp_path: Path) -> None:
        model = write_true_model(tmp_path / "cameras", true_poses())
        rigid = run(root, config(model, units={"pose_scale": False})).figures["poses"]
        assert rigid["ate_rmse"] < 1e-5
        larger = config(model, units={"pose_scale": False, "metres_per_unit": 2 * METRES})
        centres = true_poses()[:, :3, 3]
        spread = np.sqrt(np.square(centres - centres.mean(0)).sum(1).mean())
        assert run(root, larger).figures["poses"]["ate_rmse"] == pytest.approx(spread, rel=1e-4)

    def test_a_trajectory_by_order_or_by_time(self, root: Path, tmp_path: Path) -> None:
        order = np.argsort(names())
        by_order = self.tum(tmp_path / "order.txt", true_poses()[order], np.arange(COUNT) * 0.1)
        assert run(root, config(by_order, match="order")).figures["poses"]["ate_rmse"] < 1e-5
        with pytest.raises(InputError, match="--match order"):
            run(root, config(by_order))
        model = _pycolmap.load().Reconstruction(str(root / "sparse" / "0"))
        times = 1305031102.0 + 0.1 * np.arange(COUNT)
        for image in model.images.values():
            image.name = f"{times[names().index(image.name)]:.6f}.png"
        shutil.rmtree(root / "sparse" / "0")
        (root / "sparse" / "0").mkdir()
        model.write(str(root / "sparse" / "0"))
        more = np.r_[times + 0.005, times + 0.05]
        by_time = self.tum(tmp_path / "time.txt", np.r_[true_poses(), true_poses()[::-1]], more)
        poses = run(root / "sparse", config(by_time)).figures["poses"]
        assert poses["images"] == COUNT
        assert poses["ate_rmse"] < 1e-5

    def test_without_evo_the_angles_are_there_and_the_rest_is_explained(
        self, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(__import__("sys").modules, "evo.core", None)
        done = run(root, config(write_true_model(tmp_path / "cameras", true_poses())))
        assert "colmap-tco[evaluate]" in done.figures["poses"]["left_out"]
        assert done.figures["poses"]["auc"] == pytest.approx([1] * 4)
        assert "ATE and RPE are left out" in done.summary()

    def test_cameras_on_a_line_have_angles_alone(self, root: Path, tmp_path: Path) -> None:
        line = true_poses()
        line[:, :3, 3] = np.outer(np.arange(COUNT), [1, 2, 3])
        poses = run(root, config(write_true_model(tmp_path / "cameras", line))).figures["poses"]
        assert "on one line" in poses["left_out"] and "ate_rmse" not in poses
        assert poses["rra"] == pytest.approx([1] * 4)


class TestFaults:
    """What cannot work is told, with the file, before anything is written."""

    def refused(self, path: Path, settings: EvaluateConfig, told: str) -> None:
        files = sorted(path.parent.rglob("*"))
        with pytest.raises(InputError, match=told):
            evaluate(path, settings, Progress())
        assert sorted(path.parent.rglob("*")) == files

    def test_results_that_are_none(self, root: Path, depths: Path, tmp_path: Path) -> None:
        self.refused(tmp_path / "nothing", config(depths), "no such result")
        self.refused(root / "images", config(depths), "no dense workspace")
        self.refused(root / "dense-tco" / "report.json", config(depths), "not a cloud")
        self.refused(root / "sparse", config(depths), "no depth maps to compare")
        self.refused(root, config(), "--truth is missing")

    def test_truths_that_are_none(self, root: Path, depths: Path, tmp_path: Path) -> None:
        empty, table, broken = tmp_path / "empty", tmp_path / "t.csv", tmp_path / "b.ply"
        empty.mkdir()
        table.write_text("1,2\n")
        broken.write_text("ply\n")
        self.refused(root, config(tmp_path / "none"), "no such file or folder")
        self.refused(root, config(empty), "without depth maps")
        self.refused(root, config(table), "not a truth that can be read")
        self.refused(root, config(broken), "neither points nor triangles")
        self.refused(root, config(depths, depths), "of the same kind")

    @pytest.mark.parametrize(
        "text", ["1 2 3\n", "1 2 3 4 5 6 7 x\n", "1 2 3 4 0 0 0 0\n", "1 nan 3 4 0 0 0 1\n", "# only this\n"]
    )
    def test_trajectories_that_are_none(self, root: Path, tmp_path: Path, text: str) -> None:
        (tmp_path / "t.txt").write_text(text)
        self.refused(root, config(tmp_path / "t.txt"), "no poses" if text[0] == "#" else "line 1")

    def test_maps_that_do_not_fit(self, root: Path, depths: Path, tmp_path: Path) -> None:
        name = names()[2]
        folder = tmp_path / "d"
        folder.mkdir()
        cv2.imwrite(str(folder / f"{name}.png"), np.ones((HEIGHT, WIDTH), np.uint8))
        self.refused(root, config(folder), "uint8 pixels; depth maps are 16-bit")
        cv2.imwrite(str(folder / f"{name}.png"), np.ones((HEIGHT, WIDTH, 3), np.uint16))
        self.refused(root, config(folder), "one channel")
        cv2.imwrite(str(folder / f"{name}.png"), np.ones((HEIGHT, 2 * WIDTH), np.uint16))
        self.refused(root, config(folder), "--model_path")
        (folder / f"{name}.png").write_bytes(b"no picture")
        self.refused(root, config(folder), "cannot be decoded")
        (folder / f"{name}.png").rename(folder / "other.png")
        self.refused(root, config(folder), "it looked for")
        (folder / f"{name}.npy").write_bytes(b"no array")
        self.refused(root, config(folder), "not a NumPy array")

    def test_a_camera_that_moved(self, root: Path, depths: Path, tmp_path: Path) -> None:
        model = write_true_model(tmp_path / "moved", true_poses())
        self.refused(root, config(depths, model_path=model), "differs from that of the model")

    def test_no_correspondence_for_a_similarity(self, root: Path, tmp_path: Path) -> None:
        truth = write_cloud(tmp_path / "truth.ply", plane_cloud(100))
        self.refused(root, config(truth, align="sim3"), "--truth scan.ply,cameras")

    def test_clouds_without_enough_points(self, root: Path, tmp_path: Path) -> None:
        truth = write_cloud(tmp_path / "truth.ply", plane_cloud(2))
        self.refused(root, config(truth), "at least 3 points")

    def test_cameras_of_other_images(self, root: Path, tmp_path: Path) -> None:
        model = write_true_model(tmp_path / "m", true_poses())
        other = _pycolmap.load().Reconstruction(str(model))
        for image in other.images.values():
            image.name = f"other/{image.image_id}.jpg"
        other.write(str(model))
        self.refused(root, config(model), "no pose for any image")

    def test_a_file_that_is_not_ours_is_kept(self, root: Path, depths: Path, tmp_path: Path) -> None:
        mine = tmp_path / "mine.json"
        mine.write_text('{"a": 1}')
        self.refused(root, config(depths, output_path=mine), "no earlier evaluation")
        assert mine.read_text() == '{"a": 1}'
        self.refused(root, config(depths, output_path=tmp_path), "is a folder")
        once = run(root, config(depths, output_path=tmp_path / "e.json")).path.read_bytes()
        assert run(root, config(depths, output_path=tmp_path / "e.json")).path.read_bytes() == once

    @pytest.mark.parametrize(
        ("make", "told"),
        [
            (lambda: UnitConfig(metres_per_unit=0), "--metres_per_unit must be positive"),
            (lambda: UnitConfig(depth_unit=-1), "--depth_unit must not be negative"),
            (lambda: CloudConfig(thresholds=()), "--thresholds"),
            (lambda: CloudConfig(thresholds=(0.1, -1)), "--thresholds"),
            (lambda: CloudConfig(align="icp", icp_threshold=0), "--align icp"),
            (lambda: EvaluateConfig(max_pixels=0), "--max_pixels"),
        ],
    )
    def test_settings_that_mean_nothing(self, make: Any, told: str) -> None:
        with pytest.raises(ValueError, match=told):
            make()


def test_the_command_line_prints_the_tables(
    root: Path, depths: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = write_true_model(tmp_path / "cameras", true_poses())
    words = ["--truth", f"{depths},{model}", "--metres-per-unit", str(METRES), "--align", "sim3"]
    assert main(["evaluate", str(root), *words, "-o", str(tmp_path / "e.json")]) == 0
    shown = capsys.readouterr().out
    for told in ("depth, 54000 measured pixels of 5 images", "AbsRel", "precision", "AUC", "ATE", "e.json"):
        assert told in shown
    written = json.loads((tmp_path / "e.json").read_text())
    assert written["settings"]["align"] == "sim3" and written["settings"]["metres_per_unit"] == "0.25"
    assert main(["evaluate", str(root), "-q"]) == 3
    assert "--truth is missing" in capsys.readouterr().err


def score_module(shared: Path) -> ModuleType:
    path = shared / "tools" / "score.py"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    spec = importlib.util.spec_from_file_location("score", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_real_images_score_as_by_an_independent_program(shared: Path, tmp_path: Path) -> None:
    """Three views of a real scene with made-up depths: d2, d5, coverage and median of another's program."""
    kitchen = shared / "data" / "kitchen"
    score = score_module(shared)
    gt, _, views = score.load(str(kitchen))
    chosen = sorted(views)[:3]
    root = tmp_path / "dense"
    scale = gt["metres_per_colmap_unit"]
    _pycolmap.load().undistort_images(
        str(root), str(kitchen / gt["model"]), str(kitchen / "images"), image_names=chosen
    )
    dense = _pycolmap.load().Reconstruction(str(root / "sparse"))
    cameras = {image.name: dense.cameras[image.camera_id] for image in dense.images.values()}
    rng = np.random.default_rng(0)
    (tmp_path / "depth").mkdir()
    for name in chosen:
        coarse = cv2.resize(rng.uniform(0.9, 1.1, (8, 10)), (cameras[name].width, cameras[name].height))
        depth = np.median(views[name]["z"]) * coarse
        depth[rng.uniform(size=depth.shape) < 0.1] = 0
        write_map(root / "stereo" / "depth_maps" / f"{name}.geometric.bin", depth)
        png = f"{Path(name).stem}.png"
        shutil.copy(kitchen / "gt" / "depth" / png, tmp_path / "depth" / png)
    settings = replace(
        config(tmp_path / "depth", model_path=kitchen / gt["model"], units={"metres_per_unit": scale}),
        output_path=tmp_path / "e.json",
    )
    found = run(root, settings).figures["depth"]
    maps = {n: read_map(root / "stereo" / "depth_maps" / f"{n}.geometric.bin") for n in chosen}
    predicted = {n: score.resample(maps[n], cameras[n], views[n]) for n in chosen}
    theirs = score.score(gt, {n: views[n] for n in chosen}, predicted, None)
    ours = (found["coverage"], found["d2"], found["d5"])
    assert ours == pytest.approx(tuple(theirs[k] for k in ("cover", "d2", "d5")), abs=6e-5)  # it rounds
    assert found["median"] == pytest.approx(theirs["med"], rel=0.01)  # it takes a part of the pixels
    assert 0.8 < found["coverage"] < 0.95 and 0 < found["d2"] < found["d5"] < 0.9
