"""The way from original pixels to network pixels and back, through coordinates and through pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from colmap_tco import _pycolmap
from colmap_tco.errors import InputError
from colmap_tco.pinhole import MAX_AREA, Pinhole, undistorted_camera
from colmap_tco.views import (
    ChunkFrame,
    View,
    ViewConfig,
    batch,
    canvas_camera,
    canvas_size,
    crop,
    make_views,
    mask_file,
    network_from_original,
    network_image,
    network_size,
    original_from_network,
    undistorted_image,
)
from colmap_tco.workspace import open_workspace
from tests.conftest import DISTORTIONS

SIZES = [(160, 120), (96, 144)]
STRIDE = 8


def view_of(
    camera: Any, path: Path = Path("none.png"), max_size: int = 120, mask: Path | None = None
) -> View:
    pinhole = undistorted_camera(camera)
    network = pinhole.resized(*network_size(pinhole, max_size, STRIDE))
    return View(path.name, 1, path, camera, pinhole, network, np.eye(4)[:3], mask)


def pixels(camera: Any, count: int = 200) -> np.ndarray:
    """Random pixels of the middle 80 %, where no fisheye of these tests reaches the limit of a pinhole."""
    rng = np.random.default_rng(0)
    size = np.array([camera.width, camera.height])
    return size * (0.1 + 0.8 * rng.random((count, 2)))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("model", DISTORTIONS)
def test_maps_are_inverse_to_each_other(
    model: str, size: tuple[int, int], make_camera: Callable[..., Any]
) -> None:
    view = view_of(make_camera(model=model, size=size))
    xy = pixels(view.original)
    there = network_from_original(view, xy)
    assert np.abs(original_from_network(view, there) - xy).max() < 1e-3
    assert np.abs(network_from_original(view, original_from_network(view, there)) - there).max() < 1e-3


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("model", DISTORTIONS)
def test_the_network_camera_projects_where_the_map_leads(
    model: str, size: tuple[int, int], make_camera: Callable[..., Any]
) -> None:
    """K of the network on a 3D point = COLMAP's own projection of it, then the map."""
    view = view_of(make_camera(model=model, size=size))
    points = np.random.default_rng(1).uniform([-1, -1, 3], [1, 1, 6], (100, 3))
    original = np.asarray(view.original.img_from_cam(points))
    homogeneous = points @ view.network.K.T
    expected = homogeneous[:, :2] / homogeneous[:, 2:]
    assert np.abs(network_from_original(view, original) - expected).max() < 1e-3


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("model", DISTORTIONS)
def test_the_principal_point_is_exactly_in_the_middle(
    model: str, size: tuple[int, int], make_camera: Callable[..., Any]
) -> None:
    view = view_of(make_camera(model=model, size=size))
    for camera in (view.camera, view.network, canvas_camera(view, (160, 160))):
        assert (2 * camera.cx, 2 * camera.cy) == (camera.width, camera.height)
    assert view.network.width % STRIDE == view.network.height % STRIDE == 0
    assert max(view.network.width, view.network.height) <= 120
    assert view.camera.width * view.camera.height <= MAX_AREA * size[0] * size[1] * 1.02
    assert np.allclose((view.camera.fx, view.camera.fy), _pycolmap.focal_lengths(view.original))


def blobs(centres: np.ndarray, size: tuple[int, int], sigma: float) -> np.ndarray:
    """A grey picture (H, W) uint8 of Gaussian spots, sampled at pixel centres (x + 0.5, y + 0.5)."""
    x, y = np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5
    spots = [
        np.exp(-((y - v) ** 2)[:, None] / (2 * sigma**2)) * np.exp(-((x - u) ** 2)[None] / (2 * sigma**2))
        for u, v in centres
    ]
    return np.round(255 * np.sum(spots, 0)).clip(0, 255).astype(np.uint8)


def centroid(image: np.ndarray, near: np.ndarray, radius: float) -> np.ndarray:
    """Centre of mass of a picture (H, W) within a circle, in pixels with centres at + 0.5."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    weight = image * (np.hypot(x - near[0], y - near[1]) < radius)
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


@pytest.mark.parametrize("size", [(320, 240), (208, 304)])
@pytest.mark.parametrize("model", DISTORTIONS)
def test_pictures_move_as_the_map_says(
    model: str, size: tuple[int, int], make_camera: Callable[..., Any], tmp_path: Path
) -> None:
    """Spots drawn in the original file appear in the network's picture where the map puts them: decoding,
    undistortion, centring, area filter, separate scales along x and y, and half pixels, all at once."""
    x, y = np.meshgrid(np.linspace(0.2, 0.8, 4) * size[0], np.linspace(0.2, 0.8, 4) * size[1])
    centres = np.stack([x, y], -1).reshape(-1, 2) + np.random.default_rng(2).random((16, 2))
    cv2.imwrite(str(tmp_path / "a.png"), blobs(centres, size, sigma=4.0))
    view = view_of(make_camera(model=model, size=size), tmp_path / "a.png", max_size=150)
    image, _ = network_image(view)
    expected = network_from_original(view, centres)
    # A second pass centres the circle, so that its rim cuts the spot evenly.
    found = [centroid(image[..., 1], centroid(image[..., 1], near, 8), 8) for near in expected]
    error = np.linalg.norm(np.array(found) - expected, axis=1)
    assert error.max() < 0.1, error


def test_an_exactly_centred_pinhole_is_left_alone(make_camera: Callable[..., Any], tmp_path: Path) -> None:
    camera = make_camera(model="PINHOLE", params=(130.0, 131.0, 80.0, 60.0))
    picture = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    image, valid = undistorted_image(view_of(camera, tmp_path / "a.png"))
    assert np.array_equal(image, picture[..., ::-1])
    assert valid.all()


@pytest.mark.parametrize("shift", [(0, 0), (7, 0), (-11, 4)])
def test_padding_is_marked_invalid_and_no_pixel_is_lost(
    shift: tuple[int, int], make_camera: Callable[..., Any], tmp_path: Path
) -> None:
    """A principal point s pixels off widens the picture by 2 |s|, of which exactly the original is valid."""
    camera = make_camera(model="PINHOLE", params=(150.0, 150.0, 80.0 + shift[0], 60.0 + shift[1]))
    picture = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    image, valid = undistorted_image(view_of(camera, tmp_path / "a.png"))
    assert image.shape == (120 + 2 * abs(shift[1]), 160 + 2 * abs(shift[0]), 3)
    assert valid.sum() == 160 * 120
    assert np.array_equal(image[valid], picture[..., ::-1].reshape(-1, 3))


def test_mild_distortion_keeps_every_original_pixel(make_camera: Callable[..., Any]) -> None:
    camera = make_camera(model="SIMPLE_RADIAL", params=(144.0, 80.0, 60.0, -0.03))
    view = view_of(camera)
    edge = np.linspace(0, 1, 50)[:, None]
    border = np.concatenate([edge * c + (1 - edge) * d for c, d in zip(*corners(160, 120), strict=True)])
    there = view.camera.pixels(_pycolmap.cam_from_img(camera, border))
    assert (there > -1).all()
    assert (there < np.array([view.camera.width, view.camera.height]) + 1).all()


def corners(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    ring = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    return ring, np.roll(ring, -1, 0)


def test_a_distortion_that_folds_back_shows_nothing_twice(
    make_camera: Callable[..., Any], tmp_path: Path
) -> None:
    """r (1 + k r²) with k < 0 turns at r = 1 / √(−3 k): beyond it, the picture comes again, mirrored."""
    k = -0.4
    camera = make_camera(model="SIMPLE_RADIAL", params=(70.0, 80.0, 60.0, k))
    cv2.imwrite(str(tmp_path / "a.png"), np.full((120, 160, 3), 200, np.uint8))
    view = view_of(camera, tmp_path / "a.png")
    _, valid = undistorted_image(view)
    y, x = np.mgrid[: view.camera.height, : view.camera.width] + 0.5
    radius = np.linalg.norm(view.camera.normalised(np.stack([x, y], -1).reshape(-1, 2)), axis=1)
    assert radius[valid.ravel()].max() <= 1 / np.sqrt(-3 * k) + 1e-6
    assert valid.mean() > 0.3


def test_wide_fisheyes_are_cropped_and_spheres_refused(make_camera: Callable[..., Any]) -> None:
    params = (45.0, 45.0, 80.0, 60.0, 0.0, 0.0, 0.0, 0.0)
    wide = undistorted_camera(make_camera(model="OPENCV_FISHEYE", params=params))
    assert np.degrees(np.arctan(wide.cx / wide.fx)) <= 60.5
    if hasattr(_pycolmap.load().CameraModelId, "EQUIRECTANGULAR"):
        sphere = _pycolmap.load().Camera.create_from_model_name(1, "EQUIRECTANGULAR", 1.0, 160, 80)
        with pytest.raises(InputError, match="EQUIRECTANGULAR"):
            undistorted_camera(sphere)


def test_a_principal_point_outside_the_picture_is_refused(make_camera: Callable[..., Any]) -> None:
    with pytest.raises(InputError, match="principal point"):
        undistorted_camera(make_camera(model="PINHOLE", params=(150.0, 150.0, -400.0, 60.0)))


def test_downscaling_filters_by_area(make_camera: Callable[..., Any], tmp_path: Path) -> None:
    """A chessboard of single pixels becomes grey; sampled, it would stay black and white."""
    board = np.indices((120, 160)).sum(0) % 2 * 255
    cv2.imwrite(str(tmp_path / "a.png"), board.astype(np.uint8))
    camera = make_camera(model="PINHOLE", params=(150.0, 150.0, 80.0, 60.0))
    image, valid = network_image(view_of(camera, tmp_path / "a.png", max_size=80))
    assert image.shape == (64, 80, 3)
    assert valid.all()
    assert np.abs(image - 0.5).max() < 0.08


def test_padding_does_not_darken_the_border(make_camera: Callable[..., Any], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((120, 160, 3), 180, np.uint8))
    camera = make_camera(model="PINHOLE", params=(150.0, 150.0, 86.3, 57.1))
    image, valid = network_image(view_of(camera, tmp_path / "a.png", max_size=80))
    assert 0 < (~valid).sum() < valid.sum() / 4
    assert np.abs(image[valid] - 180 / 255).max() < 0.01
    assert not image[~valid].any()


def test_masks_travel_with_the_picture(make_camera: Callable[..., Any], tmp_path: Path) -> None:
    """A mask in the original frame excludes the same original pixels, whatever the distortion."""
    mask = np.full((120, 160), 255, np.uint8)
    mask[:, :70] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    cv2.imwrite(str(tmp_path / "a.png"), np.full((120, 160, 3), 99, np.uint8))
    camera = make_camera(model="OPENCV")
    view = view_of(camera, tmp_path / "a.png", max_size=160, mask=tmp_path / "mask.png")
    _, open_pixels = undistorted_image(view_of(camera, tmp_path / "a.png"))
    _, kept = undistorted_image(view)
    y, x = np.mgrid[: view.camera.height, : view.camera.width] + 0.5
    original = _pycolmap.img_from_cam(camera, view.camera.normalised(np.stack([x, y], -1).reshape(-1, 2)))
    right = (original[:, 0] > 70.1).reshape(kept.shape)
    left = (original[:, 0] < 69.9).reshape(kept.shape)
    assert np.array_equal(kept[right], open_pixels[right])
    assert not kept[left].any()


def test_a_mask_of_another_size_is_refused(make_camera: Callable[..., Any], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), np.zeros((60, 80), np.uint8))
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((120, 160, 3), np.uint8))
    with pytest.raises(InputError, match=r"mask.png: 80×60 pixels where its camera has 160×120"):
        undistorted_image(view_of(make_camera(), tmp_path / "a.png", mask=tmp_path / "mask.png"))


@pytest.mark.parametrize(
    ("name", "expected"), [("a.jpg", "a.jpg.png"), ("s/a.png", "s/a.png"), ("b.PNG", "b.PNG")]
)
def test_mask_names_are_colmaps(name: str, expected: str) -> None:
    assert mask_file(Path("m"), name) == Path("m") / expected


def test_mask_folders_without_masks_are_an_error(workspace_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no mask; expected for instance .*000.png"):
        make_views(open_workspace(workspace_folder), ViewConfig(mask_path=str(tmp_path)), STRIDE)


@pytest.mark.parametrize(
    ("size", "most", "stride", "expected"),
    [
        ((640, 480), 640, 14, (630, 476)),
        ((640, 480), 320, 8, (320, 240)),
        ((1296, 1936), 640, 8, (432, 640)),
        ((100, 50), 640, 8, (96, 48)),
        ((4000, 20), 640, 16, (640, 16)),
    ],
)
def test_network_sizes(size: tuple[int, int], most: int, stride: int, expected: tuple[int, int]) -> None:
    assert network_size(Pinhole(*size, 1.0, 1.0, 0.0, 0.0), most, stride) == expected


def test_mixed_sizes_share_a_canvas(make_workspace: Callable[..., Path], shot: Any, tmp_path: Path) -> None:
    shots = (shot(), shot(size=(96, 144), model="OPENCV"), shot(size=(200, 120), model="PINHOLE"))
    workspace = open_workspace(make_workspace(tmp_path, shots))
    views, skipped = make_views(workspace, ViewConfig(max_image_size=128), STRIDE)
    assert not skipped
    images, cameras = batch(views, ChunkFrame(views[0].cam_from_world, 2.0))
    height, width = canvas_size(views)
    assert images.images.shape == (3, 3, height, width)
    assert height % STRIDE == width % STRIDE == 0
    assert torch.equal(cameras.K[:, :2, 2], torch.tensor([[width / 2, height / 2]]).expand(3, 2))
    for i, view in enumerate(views):
        own, valid = network_image(view)
        assert torch.equal(crop(view, images.images)[i].permute(1, 2, 0), torch.from_numpy(own))
        assert np.array_equal(crop(view, images.valid.numpy())[i], valid)
        assert images.valid[i].sum() == valid.sum()


def test_odd_padding_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot be centred"):
        Pinhole(7, 8, 1.0, 1.0, 3.5, 4.0).padded(8, 8)


def test_chunk_poses_keep_their_precision_in_map_coordinates(
    make_workspace: Callable[..., Path], tmp_path: Path
) -> None:
    """A scene at 1e6 m has the same chunk as at the origin, to a micrometre."""
    poses = []
    for origin in ((0.0, 0.0, 0.0), (4.5e5, 5.4e6, 120.0)):
        root = make_workspace(tmp_path / str(len(poses)), origin=origin)
        views, _ = make_views(open_workspace(root), ViewConfig(max_image_size=64), STRIDE)
        frame = ChunkFrame(views[0].cam_from_world, 4.0)
        poses.append(np.stack([frame.world_from_cam(view) for view in views]))
    assert np.array_equal(poses[0][0], np.eye(4)) or np.allclose(poses[0][0], np.eye(4), atol=1e-12)
    assert np.abs(poses[0] - poses[1]).max() < 1e-6


@pytest.mark.parametrize("name", ["kitchen", "office", "livingroom", "fountain", "lund_door"])
def test_real_workspaces(name: str, shared: Path) -> None:
    """Keypoints of real pictures survive the way there and back, and nearly all the picture is kept."""
    workspace = open_workspace(shared / "data" / name, num_threads=1)
    views, skipped = make_views(workspace, ViewConfig(), 14)
    assert not skipped
    xy, _ = _pycolmap.observations(workspace.model, views[0].image_id)
    there = network_from_original(views[0], xy)
    assert ((there > 0) & (there < (views[0].network.width, views[0].network.height))).all()
    assert np.abs(original_from_network(views[0], there) - xy).max() < 0.01
    image, valid = network_image(views[0])
    assert valid.mean() > 0.9
    assert image[valid].std() > 0.05
