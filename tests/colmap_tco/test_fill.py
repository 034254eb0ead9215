"""A PatchMatch result in COLMAP's own undistorted cameras is kept, exact on planes, and its holes filled."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco.errors import InputError
from colmap_tco.fill import FillConfig, fill, open_existing
from colmap_tco.fusion import FusionConfig, fuse, fuse_views
from colmap_tco.fusion_report import FusionReport
from colmap_tco.maps import write_map
from colmap_tco.normals import normals_from_depth
from colmap_tco.outputs import ViewMaps, fusion_views, undistorted_model, write_model, write_view
from colmap_tco.pinhole import Pinhole
from colmap_tco.views import View, ViewConfig, make_views
from colmap_tco.workspace import DensePaths, Workspace, open_workspace
from tests.colmap_tco.test_whole_chain import NAMES, NORMAL, PIXEL, workspace_of

Floats = NDArray[np.float64]
BIAS = 1.003
"""Of the depths that fill, so that they can be told from those that are kept."""


def plane_depth(view: View, camera: Pinhole, shape: tuple[int, int]) -> NDArray[np.float32]:
    camera = camera.resized(shape[1], shape[0])
    u, v = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    rays = np.c_[camera.normalised(np.c_[u.ravel(), v.ravel()]), np.ones(u.size)]
    R, t = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
    return (-(-R.T @ t @ NORMAL) / (rays @ R @ NORMAL)).reshape(shape).astype(np.float32)


def maps_of(view: View) -> ViewMaps:
    """What the network would say: the plane at its size, a little too far."""
    depth = BIAS * plane_depth(view, view.camera, (view.network.height, view.network.width))
    return ViewMaps(depth, normals_from_depth(depth, view.camera), np.full_like(depth, 3.0))


@dataclass(frozen=True)
class Made:
    root: Path
    workspace: Workspace
    views: list[View]
    dense: DensePaths


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """COLMAP's undistorter has run; its maps hold the left 60 % of the plane, in all views but the last."""
    root = tmp_path_factory.mktemp("fill")
    workspace_of(root, np.zeros(3))
    dense = DensePaths(root / "dense" / "0")
    dense.root.mkdir(parents=True)
    _pycolmap.load().undistort_images(str(dense.root), str(root / "sparse" / "0"), str(root / "images"))
    workspace = open_workspace(root)
    views, _ = make_views(workspace, ViewConfig(max_image_size=160), 8)
    theirs = {entry.name: entry.camera for entry in _pycolmap.registered(_pycolmap.read_model(dense.sparse))}
    for view in views[:-1]:
        camera = theirs[view.name]
        pinhole = Pinhole(camera.width, camera.height, *map(float, camera.params))
        assert (pinhole.width, pinhole.height) != (view.camera.width, view.camera.height)
        shape = (pinhole.height // 2, pinhole.width // 2)
        depth = plane_depth(view, pinhole, shape)
        depth[:, int(0.6 * shape[1]) :] = 0
        normal = normals_from_depth(depth, pinhole)
        write_map(dense.depth_map(view.name), depth)
        write_map(dense.normal_map(view.name), normal)
    return Made(root, workspace, views, dense)


def config(made: Made) -> FillConfig:
    return FillConfig(fill_only=str(made.dense.root))


def test_kept_depths_are_exact_and_the_others_ours(made: Made) -> None:
    existing = open_existing(config(made), made.views)
    assert existing is not None
    for view in made.views[:-1]:
        maps, counts = fill(existing, view, maps_of(view))
        h, w = maps.depth.shape
        assert w == round(view.camera.width * (existing.cameras[view.name].width // 2)
                          / existing.cameras[view.name].width)  # fmt: skip
        ratio = maps.depth / plane_depth(view, view.camera, (h, w))
        kept = maps.confidence == 30
        assert 0.4 * h * w < kept.sum() < 0.65 * h * w
        assert counts == {"pixels_kept": int(kept.sum()), "pixels_filled": int(h * w - kept.sum())}
        assert np.abs(ratio[kept] - 1).max() < 1e-4
        assert np.abs(ratio[~kept] / BIAS - 1).max() < 1e-4
        assert (maps.confidence[~kept] == 3).all()
        assert np.median(np.abs(maps.normal @ view.cam_from_world[:, :3] - NORMAL)) < 0.01


def test_what_the_mask_excludes_is_neither_kept_nor_filled(made: Made, tmp_path: Path) -> None:
    """The upper half of the original picture: of a plane, exactly the pixels whose rays end there."""
    view, existing = made.views[0], open_existing(FillConfig(str(made.dense.root)), made.views)
    assert existing is not None
    mask = np.full((360, 480), 255, np.uint8)
    mask[:180] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    whole, counts = fill(existing, view, maps_of(view))
    cut, fewer = fill(existing, replace(view, mask_path=tmp_path / "mask.png"), maps_of(view))
    kept = cut.depth > 0
    assert np.array_equal(cut.depth[kept], whole.depth[kept])
    assert 0.45 < kept.sum() / (whole.depth > 0).sum() < 0.55
    assert not cut.normal[~kept].any() and (cut.confidence[~kept] == 1).all()
    assert fewer["pixels_kept"] < 0.6 * counts["pixels_kept"]  # type: ignore[operator]
    camera = view.camera.resized(kept.shape[1], kept.shape[0])
    v, u = np.nonzero(kept)
    original = _pycolmap.img_from_cam(view.original, camera.normalised(np.c_[u + 0.5, v + 0.5]))
    assert original[:, 1].min() > 179


def test_the_standard_error_is_that_of_our_own_depths(made: Made, tmp_path: Path) -> None:
    """None of what is kept, nobody was asked about it; none of what the mask excludes."""
    view, existing = made.views[0], open_existing(config(made), made.views)
    assert existing is not None
    mask = np.full((360, 480), 255, np.uint8)
    mask[:180] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    ours = maps_of(view)
    told = np.linspace(0.001, 0.002, ours.depth.shape[1], dtype=np.float32) + 0 * ours.depth
    for masked in (view, replace(view, mask_path=tmp_path / "mask.png")):
        maps, _ = fill(existing, masked, replace(ours, error=told))
        filled = (maps.depth > 0) & (maps.confidence < 30)
        assert maps.error is not None and np.array_equal(maps.error > 0, filled)
        columns = (np.nonzero(filled)[1] + 0.5) / filled.shape[1]
        assert np.abs(maps.error[filled] - 0.001 * (1 + columns)).max() < 0.001 / 50
    assert fill(existing, view, ours)[0].error is None


def test_views_without_a_map_stay_as_they_are(made: Made) -> None:
    existing = open_existing(config(made), made.views)
    assert existing is not None and NAMES[-1] not in existing.cameras
    ours = maps_of(made.views[-1])
    maps, counts = fill(existing, made.views[-1], ours)
    assert maps is ours
    assert counts == {"pixels_kept": 0, "pixels_filled": ours.depth.size}


def test_the_fused_cloud_keeps_the_place_of_what_was_kept(made: Made, tmp_path: Path) -> None:
    existing, paths = open_existing(config(made), made.views), DensePaths(tmp_path)
    assert existing is not None
    for view in made.views:
        write_view(paths, view, fill(existing, view, maps_of(view))[0])
    indices = write_model(paths, undistorted_model(made.workspace.model, made.views))
    neighbours = {name: [other for other in NAMES if other != name] for name in NAMES}
    cloud, _ = fuse(
        fusion_views(paths, made.views, neighbours, indices), FusionConfig(num_threads=1, max_normal_error=30)
    )
    assert len(cloud) > 10_000
    off = cloud.points @ NORMAL
    # Where all is kept the plane, elsewhere the bias: 0.3 % of the depth, moved along the normal.
    kept = np.abs(off) < 0.1 * PIXEL
    assert 0.3 < kept.mean() < 0.9
    assert abs(off[kept].mean()) < 0.02 * PIXEL


def test_kept_depths_stay_where_they_bend_and_ours_do_not(made: Made, tmp_path: Path) -> None:
    """Every third pixel of what is kept is 8 % too near, and so is every third of what fills."""
    existing = open_existing(config(made), made.views)
    assert existing is not None
    paths, kept, filled = DensePaths(tmp_path), 0, 0
    for view in made.views:
        maps, _ = fill(existing, view, maps_of(view))
        third = np.indices(maps.depth.shape).sum(0) % 3 == 0
        write_view(paths, view, replace(maps, depth=np.where(third, 0.92 * maps.depth, maps.depth)))
        inside = np.pad(np.ones(np.subtract(maps.depth.shape, 2), bool), 1)
        kept += int((inside & (maps.confidence == 30)).sum())
        filled += int((inside & (maps.confidence < 30)).sum())
    indices = {view.name: i for i, view in enumerate(made.views)}
    neighbours = {name: [other for other in NAMES if other != name] for name in NAMES}
    for sure, dropped in ((config(made).sure, filled), (FillConfig().sure, kept + filled)):
        views = fusion_views(paths, made.views, neighbours, indices, sure=sure)
        report = FusionReport()
        list(fuse_views(views, FusionConfig(num_threads=1), report))
        assert report.pixels["max_depth_bend"] == pytest.approx(dropped, rel=0.05)
    assert filled > 10_000 < kept


def test_a_result_of_other_cameras_is_refused(made: Made) -> None:
    first = made.views[0]
    pose = first.cam_from_world.copy()
    pose[:, 3] += 0.01
    with pytest.raises(InputError, match=r"0\.png is turned by .* and moved by .*image_undistorter"):
        open_existing(config(made), [replace(first, cam_from_world=pose), *made.views[1:]])


def test_folders_without_a_result_are_named(made: Made, tmp_path: Path) -> None:
    assert open_existing(FillConfig(), made.views) is None
    with pytest.raises(InputError, match="no sparse; name the dense workspace"):
        open_existing(FillConfig(fill_only=str(tmp_path)), made.views)
    shutil.copytree(made.dense.root, tmp_path / "copy")
    copy = DensePaths(tmp_path / "copy")
    copy.normal_map(NAMES[0]).unlink()
    with pytest.raises(InputError, match=r"0\.png\.geometric\.bin is missing"):
        open_existing(FillConfig(fill_only=str(copy.root)), made.views)
    for name in NAMES:
        copy.depth_map(name).unlink(missing_ok=True)
    with pytest.raises(InputError, match=r"no geometric depth map of these views.*geom_consistency"):
        open_existing(FillConfig(fill_only=str(copy.root)), made.views)


def test_distorted_cameras_are_refused(made: Made, tmp_path: Path) -> None:
    shutil.copytree(made.dense.root, tmp_path / "copy")
    shutil.rmtree(tmp_path / "copy" / "sparse")
    shutil.copytree(made.root / "sparse" / "0", tmp_path / "copy" / "sparse")
    with pytest.raises(InputError, match="OPENCV camera, not undistorted"):
        open_existing(FillConfig(fill_only=str(tmp_path / "copy")), made.views)


def test_maps_of_different_sizes_are_refused(made: Made, tmp_path: Path) -> None:
    shutil.copytree(made.dense.root, tmp_path / "copy")
    copy = DensePaths(tmp_path / "copy")
    write_map(copy.normal_map(NAMES[0]), np.zeros((4, 5, 3), np.float32))
    existing = open_existing(FillConfig(fill_only=str(copy.root)), made.views)
    assert existing is not None
    with pytest.raises(InputError, match="does not fit the depths"):
        fill(existing, made.views[0], maps_of(made.views[0]))
