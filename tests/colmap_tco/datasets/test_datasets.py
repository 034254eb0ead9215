"""Readers against miniature datasets in the published layouts: axes, units, pixels, holes, frames, errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_tco.datasets import CHOICES, Dataset, Scene, choice, open_dataset
from colmap_tco.datasets.base import pixel_centres, rays
from colmap_tco.datasets.seven_scenes import COLOUR_FROM_DEPTH, PUBLISHED_FOCAL, registered
from colmap_tco.errors import InputError
from tests.colmap_tco.datasets import layouts
from tests.colmap_tco.datasets.layouts import DOT, NORMAL, OFFSET, Camera

Writer = Callable[..., list[Camera]]

WRITERS: dict[str, tuple[str, Writer, str, float]] = {
    "7scenes": ("7scenes", layouts.seven_scenes, "chess/seq-03", 0.004),
    "7scenes, projected": ("7scenes", lambda r, n=3: layouts.seven_scenes(r, n, True), "chess/seq-03", 6e-4),
    "nrgbd": ("nrgbd", layouts.nrgbd, "kitchen", 6e-4),
    "dtu": ("dtu", layouts.dtu, "scan4", 0.005),
    "eth3d": ("eth3d", layouts.eth3d, "courtyard", 0.01),
    "eth3d, prepared": ("eth3d", layouts.eth3d_prepared, "pipes", 1e-6),
    "scannet": ("scannet", layouts.scannet, "scene0707_00", 0.01),
    "scannet, prepared": (
        "scannet", lambda r, n=8: layouts.scannet(r, n, prepared=True), "scene0707_00", 0.01,
    ),
}  # fmt: skip
"""Layout → dataset, writer, scene, and by how many metres the wall may be off: rounding to millimetres, and
the slope of the wall over half a pixel where depth was looked up in another camera's pixels."""


def off_the_wall(scene: Scene, step: int = 7) -> np.ndarray:
    """Distances in metres from the wall of what the depth maps say, at some pixels of the pictures."""
    found = []
    for frame in scene.frames:
        xy = pixel_centres(*frame.size)[::step]
        depth = frame.depth_at(xy)
        known = depth > 0
        assert known.mean() > 0.5
        xyz = rays(xy[known], frame.K) * depth[known, None]
        xyz = xyz @ frame.world_from_cam[:3, :3].T + frame.world_from_cam[:3, 3]
        found.append(np.abs(xyz @ NORMAL - OFFSET))
    return np.concatenate(found)


@pytest.fixture(params=WRITERS)
def layout(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Dataset, str, list[Camera], float]:
    name, write, scene, tolerance = WRITERS[request.param]
    cameras = write(tmp_path)
    return open_dataset(name, tmp_path), scene, cameras, tolerance


def test_a_known_point_is_seen_where_its_picture_shows_it(
    layout: tuple[Dataset, str, list[Camera], float],
) -> None:
    """The dot was drawn by the dataset's own conventions; the reader's camera must point at it."""
    dataset, scene, cameras, _ = layout
    assert dataset.scenes() == [scene]
    frames = list(range(dataset.count(scene)))
    read = dataset.read(scene, frames).frames
    assert len(read) == len(frames) > 2
    for frame in read:
        local = np.linalg.inv(frame.world_from_cam)[:3] @ [*DOT, 1]
        x, y, _ = frame.K @ local / local[2]
        image = cv2.imread(str(frame.image), cv2.IMREAD_GRAYSCALE)
        assert image.shape == frame.size[::-1]
        assert image[int(y), int(x)] > 200
        assert image[int(y) + 6, int(x)] < 50
        np.testing.assert_allclose(
            frame.world_from_cam[:3, :3] @ frame.world_from_cam[:3, :3].T, np.eye(3), atol=1e-9
        )
    if dataset.name != "scannet":
        for frame, camera in zip(read, cameras, strict=True):
            np.testing.assert_allclose(frame.world_from_cam, camera.pose, atol=1e-6)
            np.testing.assert_allclose(frame.K, camera.K, atol=1e-9)


def test_true_depths_lie_on_the_wall_in_metres(layout: tuple[Dataset, str, list[Camera], float]) -> None:
    dataset, scene, _, tolerance = layout
    off = off_the_wall(dataset.read(scene, range(dataset.count(scene))))
    assert np.median(off) < tolerance / 2
    assert np.quantile(off, 0.99) < tolerance


def test_holes_are_zero_and_nothing_is_negative_or_infinite(
    layout: tuple[Dataset, str, list[Camera], float],
) -> None:
    dataset, scene, _, _ = layout
    for frame in dataset.read(scene, [0, 1]).frames:
        depth = frame.depth()
        assert depth.dtype == np.float32
        assert np.isfinite(depth).all() and (depth >= 0).all() and (depth < 10.001).all()
        assert (depth == 0).any()
        outside = np.array([[-1e4, 5.0], [1e4, 5.0], [5.0, -1e4], [5.0, 1e4]])
        assert not frame.depth_at(outside).any()


def test_frames_are_picked_by_position_in_the_order_asked_for(
    layout: tuple[Dataset, str, list[Camera], float],
) -> None:
    dataset, scene, _, _ = layout
    every = dataset.read(scene, range(3)).frames
    picked = dataset.read(scene, [2, 0]).frames
    assert [f.name for f in picked] == [every[2].name, every[0].name]
    np.testing.assert_array_equal(picked[0].world_from_cam, every[2].world_from_cam)
    with pytest.raises(InputError, match=r"no frame 99"):
        dataset.read(scene, [99])


def test_numbers_without_leading_zeros_are_ordered_as_numbers(tmp_path: Path) -> None:
    layouts.nrgbd(tmp_path, 12)
    names = [f.name for f in open_dataset("nrgbd", tmp_path).read("kitchen", range(12)).frames]
    assert names == [f"img{i}" for i in range(12)]


def test_scannet_takes_every_third_of_the_first_270(tmp_path: Path) -> None:
    layouts.scannet(tmp_path, 3)
    color = tmp_path / "scene0707_00" / "color"
    for i in range(3, 300):
        (color / f"{i}.jpg").write_bytes(b"")
    dataset = open_dataset("scannet", tmp_path)
    assert dataset.count("scene0707_00") == 90
    stem = [path.stem for path in dataset.pictures("scene0707_00")]  # type: ignore[attr-defined]
    assert stem[:3] == ["0", "3", "6"] and stem[-1] == "267"


@pytest.mark.parametrize("prepared", [False, True])
def test_scannet_s_depths_count_between_a_millimetre_and_ten_metres(tmp_path: Path, prepared: bool) -> None:
    layouts.scannet(tmp_path, 3, prepared=prepared)
    (file,) = tmp_path.rglob("frame_0000.png" if prepared else "depth/0.png")
    counts = np.full((120, 160), 2500, np.uint16)
    counts[0, :4] = [1, 2, 9999, 10_000]
    assert cv2.imwrite(str(file), counts)
    (frame,) = open_dataset("scannet", tmp_path).read("scene0707_00", [0]).frames
    np.testing.assert_allclose(frame.depth()[0, :5], [0, 0.002, 9.999, 0, 2.5], rtol=1e-6)


@pytest.mark.parametrize(
    ("dataset", "setting", "count", "frames"),
    [
        ("7scenes", "", 1000, [0, 200, 400, 600, 800]),
        ("7scenes", "", 500, [0, 200, 400]),
        ("7scenes", "dense", 100, [0, 40, 80]),
        ("nrgbd", "sparse", 1442, [0, 500, 1000]),
        ("nrgbd", "dense", 250, [0, 100, 200]),
        ("eth3d", "", 38, [0, 5, 10, 15, 20, 25, 30, 35]),
        ("dtu", "", 49, [0, 5, 10, 15, 20, 25, 30, 35, 40, 45]),
        ("scannet", "stride1", 90, [0, 1, 2, 3, 4, 5]),
        ("scannet", "stride4", 90, [0, 4, 8, 12, 16, 20]),
        ("scannet", "stride16", 90, [0, 16, 32, 48, 64, 80]),
    ],
)  # fmt: skip
def test_frame_choice_is_that_of_the_published_lists(
    dataset: str, setting: str, count: int, frames: Sequence[int]
) -> None:
    """The lists of π³'s datasets/seq-id-maps, for the scene whose length is in the second last column."""
    assert choice(dataset, setting)[1].frames(count) == frames


def test_a_setting_that_a_dataset_lacks_is_named_with_those_it_has() -> None:
    with pytest.raises(InputError, match="7scenes has sparse, dense"):
        choice("7scenes", "stride5")
    assert set(CHOICES) == {"eth3d", "dtu", "7scenes", "nrgbd", "scannet"}


def test_as_published_7scenes_has_the_evaluations_focal_length_and_the_depth_cameras_poses(
    tmp_path: Path,
) -> None:
    cameras = layouts.seven_scenes(tmp_path)
    read = open_dataset("7scenes", tmp_path, as_published=True).read("chess/seq-03", [0, 1]).frames
    for frame, camera in zip(read, cameras, strict=False):
        assert frame.K[0, 0] == frame.K[1, 1] == PUBLISHED_FOCAL
        np.testing.assert_allclose(frame.world_from_cam, camera.pose @ COLOUR_FROM_DEPTH, atol=1e-9)


def test_registered_depth_keeps_the_nearest_surface() -> None:
    """A near square before a wall: where both fall into a pixel of the colour camera, the square wins."""
    depth = np.full((480, 640), 4.0, np.float32)
    depth[200:280, 280:360] = 1.0
    found = registered(depth)
    local = COLOUR_FROM_DEPTH[:3] @ [0.05, 0.03, 1.0, 1.0]
    x, y = 525 * local[:2] / local[2] + (320, 240)
    assert found[int(y), int(x)] == pytest.approx(local[2], abs=1e-3)
    near = (found > 0) & (found < 2)
    # The square is 80 pixels of the depth camera wide and high, 80 · 525 / 585 in colour.
    assert near.sum() == pytest.approx((80 * 525 / 585) ** 2, rel=0.05)
    assert not ((found > 1.1) & (found < 3.8)).any()


def missing(root: Path, file: str) -> Path:
    path = root / file
    path.unlink()
    return path


@pytest.mark.parametrize(
    ("name", "file", "told"),
    [
        ("7scenes", "chess/TestSplit.txt", "list of test sequences"),
        ("7scenes", "chess/seq-03/frame-000001.pose.txt", "the pose"),
        ("7scenes", "chess/seq-03/frame-000001.depth.png", "the depth map"),
        ("nrgbd", "kitchen/poses.txt", "the poses"),
        ("nrgbd", "kitchen/focal.txt", "focal length"),
        ("nrgbd", "kitchen/depth/depth1.png", "the depth map"),
        ("dtu", "scan4/cams/00000001_cam.txt", "the camera"),
        ("dtu", "scan4/depths/00000001.npy", "the depth map"),
        ("dtu", "scan4/binary_masks/00000001.png", "the mask"),
        ("eth3d", "courtyard/dslr_calibration_undistorted/images.txt", "the poses"),
        ("eth3d", "courtyard/dslr_calibration_jpg/cameras.txt", "the calibration"),
        ("eth3d", "courtyard/ground_truth_depth/dslr_images/DSC_0287.JPG", "the true depth"),
        ("scannet", "scene0707_00/pose/3.txt", "the pose"),
        ("scannet", "scene0707_00/intrinsic/intrinsic_depth.txt", "the intrinsics"),
    ],
)  # fmt: skip
def test_a_missing_file_is_named_with_what_it_is_and_what_to_do(
    name: str, file: str, told: str, tmp_path: Path
) -> None:
    _, write, scene, _ = WRITERS[name]
    write(tmp_path)
    path = missing(tmp_path, file)
    with pytest.raises(InputError) as error:
        dataset = open_dataset(name, tmp_path)
        assert dataset.scenes()
        for frame in dataset.read(scene, [0, 1]).frames:
            frame.depth()
    assert str(path) in str(error.value) and told in str(error.value)
    assert "unpack" in str(error.value) or "export" in str(error.value)


def test_a_root_that_is_not_there_or_holds_no_scene_is_named(tmp_path: Path) -> None:
    for name in CHOICES:
        with pytest.raises(InputError, match="--root"):
            open_dataset(name, tmp_path / "nowhere")
        (tmp_path / name).mkdir()
        with pytest.raises(InputError, match=name):
            open_dataset(name, tmp_path / name).scenes()


def test_frames_that_were_not_tracked_are_refused(tmp_path: Path) -> None:
    layouts.scannet(tmp_path, 8)
    layouts.matrix(tmp_path / "scene0707_00" / "pose" / "3.txt", np.full((4, 4), -np.inf))
    dataset = open_dataset("scannet", tmp_path)
    assert len(dataset.read("scene0707_00", [0]).frames) == 1
    with pytest.raises(InputError, match=r"3\.txt.*not tracked"):
        dataset.read("scene0707_00", [0, 1])


def test_damaged_files_are_told_apart_from_missing_ones(tmp_path: Path) -> None:
    layouts.eth3d(tmp_path)
    depth = tmp_path / "courtyard" / "ground_truth_depth" / "dslr_images" / "DSC_0286.JPG"
    depth.write_bytes(depth.read_bytes()[:-4])
    frame = open_dataset("eth3d", tmp_path).read("courtyard", [0]).frames[0]
    with pytest.raises(InputError, match=r"19199 numbers where 160×120"):
        frame.depth()
    layouts.nrgbd(tmp_path / "n")
    layouts.text(tmp_path / "n" / "kitchen" / "poses.txt", "1 0 0 0\n0 1 0 0\n")
    with pytest.raises(InputError, match=r"poses\.txt: 2×4 numbers where 3 pictures make 12×4"):
        open_dataset("nrgbd", tmp_path / "n").read("kitchen", [0])
    layouts.text(tmp_path / "n" / "kitchen" / "poses.txt", "1 0 0 zero\n")
    with pytest.raises(InputError, match=r"poses\.txt: not the poses"):
        open_dataset("nrgbd", tmp_path / "n").read("kitchen", [0])


def test_resized_pictures_are_refused_where_intrinsics_would_not_hold(tmp_path: Path) -> None:
    layouts.seven_scenes(tmp_path / "s")
    layouts.picture(tmp_path / "s/chess/seq-03/frame-000000.color.png", (320, 240), np.array([50.0, 50.0]))
    with pytest.raises(InputError, match="640×480; do not resize"):
        open_dataset("7scenes", tmp_path / "s").read("chess/seq-03", [0])
    layouts.scannet(tmp_path / "n")
    layouts.picture(tmp_path / "n/scene0707_00/color/0.jpg", (640, 480), np.array([50.0, 50.0]))
    with pytest.raises(InputError, match="principal point"):
        open_dataset("scannet", tmp_path / "n").read("scene0707_00", [0])


def test_truth_clouds_are_found_where_their_archives_put_them(tmp_path: Path) -> None:
    layouts.eth3d(tmp_path / "e")
    scene = open_dataset("eth3d", tmp_path / "e").read("courtyard", [0])
    assert scene.cloud == tmp_path / "e/courtyard/dslr_scan_eval/scan_alignment.mlp"
    layouts.dtu(tmp_path / "d")
    assert open_dataset("dtu", tmp_path / "d").read("scan4", [0]).cloud is None
    layouts.text(tmp_path / "d/Points/stl/stl004_total.ply", "ply")
    assert open_dataset("dtu", tmp_path / "d").read("scan4", [0]).cloud is not None
