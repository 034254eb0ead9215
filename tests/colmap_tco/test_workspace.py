"""Finding, choosing and checking what a user points at; nothing of it may change."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from colmap_tco import _pycolmap
from colmap_tco.errors import InputError
from colmap_tco.image_files import decoded_size, list_images, read_image
from colmap_tco.workspace import (
    DensePaths,
    WorkspaceConfig,
    dense_paths,
    find_images,
    find_models,
    open_workspace,
    partial_paths,
    unregistered_images,
)


def fingerprint(root: Path) -> dict[str, str]:
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def truncate(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def to_binary(folder: Path) -> None:
    """Turn a text model into a binary one."""
    _pycolmap.load().Reconstruction(str(folder)).write_binary(str(folder))
    for path in folder.glob("*.txt"):
        path.unlink()


@pytest.fixture
def root(tmp_path: Path, make_workspace: Callable[..., Path]) -> Path:
    """A workspace that a test may break."""
    return make_workspace(tmp_path / "workspace")


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_models_and_images_are_found_in_their_usual_places(
    place: str, binary: bool, make_workspace: Callable[..., Path], tmp_path: Path
) -> None:
    root = make_workspace(tmp_path / "w", sparse="model")
    (root / place).mkdir(parents=True, exist_ok=True)
    for path in (root / "model").iterdir():
        shutil.move(path, root / place / path.name)
    if binary:
        to_binary(root / place)
    before = fingerprint(root)
    workspace = open_workspace(root)
    assert workspace.model_path == (root / place).absolute()
    assert workspace.image_folder == root / "images"
    assert [entry.name for entry in workspace.images] == [f"00{i}.png" for i in range(5)]
    assert not workspace.skipped
    assert fingerprint(root) == before


def test_the_model_with_most_images_wins_then_points_then_name(
    root: Path, make_workspace: Callable[..., Path], shot: Any, tmp_path: Path
) -> None:
    for index, (views, points) in enumerate([(3, 900), (5, 100), (5, 400), (5, 400)], 1):
        other = make_workspace(tmp_path / f"w{index}", (shot(),) * views, points=points)
        shutil.copytree(other / "sparse" / "0", root / "sparse" / str(index))
    workspace = open_workspace(root)
    assert workspace.model_path.name == "3"
    assert "5 images, 400 points, the most of 5 models" in workspace.reasons[0]
    assert "1: 3 images" in workspace.reasons[0]
    chosen = open_workspace(root, WorkspaceConfig(model_path=str(root / "sparse" / "1")))
    assert len(chosen.images) == 3


def test_a_broken_model_beside_a_good_one_is_named_and_passed_over(root: Path) -> None:
    shutil.copytree(root / "sparse" / "0", root / "sparse" / "1")
    truncate(root / "sparse" / "1" / "images.txt", 0.5)
    workspace = open_workspace(root)
    assert workspace.model_path.name == "0"
    assert "sparse/1 not considered" in workspace.reasons[1]


@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.95])
def test_truncated_binary_models_are_reported_as_such(file: str, share: float, root: Path) -> None:
    to_binary(root / "sparse" / "0")
    truncate(root / "sparse" / "0" / f"{file}.bin", share)
    with pytest.raises(InputError, match=rf"(?s)sparse/0.*truncated.*{file}.bin \d+ bytes.*again"):
        open_workspace(root)


@pytest.mark.parametrize("file", ["images.txt", "points3D.txt"])
def test_truncated_text_models_are_reported_as_such(file: str, root: Path) -> None:
    path = root / "sparse" / "0" / file
    path.write_text(path.read_text(encoding="utf-8")[:-40], encoding="utf-8")
    with pytest.raises(InputError, match=r"(?s)sparse/0.*truncated"):
        open_workspace(root)


def test_a_model_with_a_file_missing_is_reported(root: Path) -> None:
    (root / "sparse" / "0" / "points3D.txt").unlink()
    with pytest.raises(InputError, match=r"points3D.txt missing"):
        open_workspace(root)


def test_a_model_without_points_is_no_use(root: Path) -> None:
    (root / "sparse" / "0" / "points3D.txt").write_text("", encoding="utf-8")
    images = root / "sparse" / "0" / "images.txt"
    lines = images.read_text(encoding="utf-8").splitlines()
    images.write_text(
        "\n".join(line if i % 2 == 0 else "" for i, line in enumerate(lines)) + "\n", encoding="utf-8"
    )
    with pytest.raises(InputError, match=r"(?s)5 images, 0 points.*point_triangulator"):
        open_workspace(root)


def test_missing_pictures_are_skipped_by_name_until_none_is_left(root: Path) -> None:
    (root / "images" / "001.png").unlink()
    workspace = open_workspace(root)
    assert [entry.name for entry in workspace.images] == ["000.png", "002.png", "003.png", "004.png"]
    assert "no file" in workspace.skipped["001.png"]
    for path in (root / "images").iterdir():
        path.rename(path.with_name("x" + path.name))
    with pytest.raises(InputError, match=r"(?s)none of the 5 images.*000.png: .*no file.*--image_path"):
        open_workspace(root)


def test_truncated_pictures_are_skipped(make_workspace: Callable[..., Path], tmp_path: Path) -> None:
    names = ["a.jpg", "b.png", "c.jpg", "d.bmp", "e.jpg"]
    root = make_workspace(tmp_path / "w", names=names)
    for name in names[:2]:
        truncate(root / "images" / name, 0.9)
    (root / "images" / "c.jpg").write_text("this is no picture", encoding="utf-8")
    workspace = open_workspace(root)
    assert set(workspace.skipped) == {"a.jpg", "b.png", "c.jpg"}
    assert all("cannot be decoded" in reason for reason in workspace.skipped.values())


def test_a_jpeg_that_lacks_its_last_bytes_is_not_accepted(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (200, 300, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "a.jpg"), noise)
    assert decoded_size(tmp_path / "a.jpg") == (300, 200)
    truncate(tmp_path / "a.jpg", 0.99)
    assert read_image(tmp_path / "a.jpg").shape == (200, 300, 3)
    with pytest.raises(InputError, match="truncated"):
        decoded_size(tmp_path / "a.jpg")


@pytest.mark.parametrize(("size", "hint"), [((120, 160), "rotated"), ((80, 60), "resized")])
def test_pictures_of_another_size_are_skipped(size: tuple[int, int], hint: str, root: Path) -> None:
    cv2.imwrite(str(root / "images" / "002.png"), np.zeros((size[1], size[0], 3), np.uint8))
    reason = open_workspace(root).skipped["002.png"]
    assert f"{size[0]}×{size[1]} pixels where its camera has 160×120" in reason
    assert hint in reason


def test_exif_orientation_is_ignored_as_colmap_does(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(np.zeros((60, 90, 3), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    assert cv2.imread(str(tmp_path / "a.jpg")).shape == (90, 60, 3)
    assert read_image(tmp_path / "a.jpg").shape == (60, 90, 3)
    assert decoded_size(tmp_path / "a.jpg") == (90, 60)


@pytest.mark.parametrize("shape", [(20, 30), (20, 30, 3), (20, 30, 4)])
def test_pictures_come_as_rgb(shape: tuple[int, ...], tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
    Image.fromarray(picture).save(tmp_path / "a.png")
    expected = picture[..., :3] if len(shape) == 3 else np.repeat(picture[..., None], 3, 2)
    assert np.array_equal(read_image(tmp_path / "a.png"), expected)


def test_unreadable_pictures_are_an_error_that_names_them(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none.jpg: missing"):
        read_image(tmp_path / "none.jpg")


def test_pictures_in_the_root_and_in_sub_folders(make_workspace: Callable[..., Path], tmp_path: Path) -> None:
    nested = make_workspace(tmp_path / "nested", names=[f"cam{i % 2}/{i}.png" for i in range(5)])
    assert [e.name for e in open_workspace(nested).images] == sorted(f"cam{i % 2}/{i}.png" for i in range(5))
    flat = make_workspace(tmp_path / "flat")
    for path in list((flat / "images").iterdir()):
        path.rename(flat / path.name)
    (flat / "images").rmdir()
    workspace = open_workspace(flat)
    assert workspace.image_folder == flat
    assert len(workspace.images) == 5
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(nested / "images", elsewhere)
    shutil.rmtree(nested / "images")
    assert len(open_workspace(nested, WorkspaceConfig(image_path=str(elsewhere))).images) == 5


def test_names_relative_to_the_root_are_found(make_workspace: Callable[..., Path], tmp_path: Path) -> None:
    root = make_workspace(tmp_path / "w", names=[f"images/{i}.png" for i in range(5)])
    for path in list((root / "images" / "images").iterdir()):
        path.rename(root / "images" / path.name)
    (root / "images" / "images").rmdir()
    assert open_workspace(root).image_folder == root


def test_nothing_to_work_on_is_said_clearly(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not a folder"):
        open_workspace(tmp_path / "none")
    with pytest.raises(InputError, match="no sparse model"):
        open_workspace(tmp_path)
    with pytest.raises(InputError, match="no pictures"):
        find_images(tmp_path)
    with pytest.raises(InputError, match=r"--image_path .* holds no pictures"):
        find_images(tmp_path, str(tmp_path))
    assert find_models(tmp_path) == []


def test_hidden_folders_hold_no_pictures(root: Path) -> None:
    (root / "images" / ".thumbs").mkdir()
    shutil.copy(root / "images" / "000.png", root / "images" / ".thumbs" / "000.png")
    assert list_images(root / "images") == [f"00{i}.png" for i in range(5)]


def test_dense_paths_are_colmaps() -> None:
    paths = dense_paths(Path("w"))
    assert paths == DensePaths(Path("w/dense-tco"))
    assert partial_paths(Path("w")).root == Path("w/.dense-tco.partial")
    assert paths.depth_map("s/a.jpg") == Path("w/dense-tco/stereo/depth_maps/s/a.jpg.geometric.bin")
    assert paths.normal_map("a.jpg") == Path("w/dense-tco/stereo/normal_maps/a.jpg.geometric.bin")
    assert (paths.fusion_cfg.name, paths.patch_match_cfg.name) == ("fusion.cfg", "patch-match.cfg")
    assert (paths.ply.name, paths.vis.name) == ("fused.ply", "fused.ply.vis")
    places = {paths.image("a"), paths.confidence_map("a"), paths.report, paths.manifest, paths.sparse}
    assert len(places) == 5


@pytest.mark.parametrize(
    ("name", "model", "images"),
    [
        ("kitchen", "sparse/0", 15),
        ("office", "sparse/2", 15),
        ("livingroom", "sparse/1", 15),
        ("fountain", "sparse/0", 11),
        ("lund_door", "sparse/0", 12),
    ],
)
def test_real_workspaces(name: str, model: str, images: int, shared: Path) -> None:
    root = shared / "data" / name
    workspace = open_workspace(root, num_threads=1)
    assert workspace.model_path == root / model
    assert len(workspace.images) == images
    assert not workspace.skipped


@pytest.mark.parametrize("name", ["fountain", "lund_door"])
def test_pinhole_models_keep_ids_names_poses_and_points(name: str, shared: Path) -> None:
    """A model rewritten with PINHOLE cameras agrees with the original wherever they can agree."""
    model = _pycolmap.read_model(shared / "data" / name / "sparse" / "0")
    images = []
    for entry in _pycolmap.registered(model):
        fx, fy = _pycolmap.focal_lengths(entry.camera)
        width, height = _pycolmap.camera_size(entry.camera)
        xy, ids = _pycolmap.observations(model, entry.image_id)
        rays = _pycolmap.cam_from_img(entry.camera, xy)
        camera = (width, height, fx, fy, width / 2, height / 2)
        images.append(_pycolmap.PinholeImage(entry, camera, rays * (fx, fy) + (width / 2, height / 2), ids))
    new = _pycolmap.pinhole_model(images, _pycolmap.points(model))
    assert {camera.model.name for camera in new.cameras.values()} == {"PINHOLE"}
    assert len(new.cameras) == 1
    for a, b in zip(_pycolmap.registered(model), _pycolmap.registered(new), strict=True):
        assert (a.image_id, a.name) == (b.image_id, b.name)
        assert np.abs(a.cam_from_world - b.cam_from_world).max() < 1e-6
    for a, b in zip(_pycolmap.points(model), _pycolmap.points(new), strict=True):
        assert np.allclose(a, b, rtol=1e-9)
    assert new.compute_num_observations() == model.compute_num_observations()
    old = np.mean([point.error for point in model.points3D.values()])
    assert new.compute_mean_reprojection_error() == pytest.approx(old, rel=0.05)


def test_pictures_that_are_not_in_the_model_say_what_is_wrong_with_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Not registered for want of matches, not whole, or of a kind that COLMAP does not read."""
    folder = tmp_path / "images"
    (folder / "phone").mkdir(parents=True)
    cv2.imwrite(str(folder / "fine.png"), np.zeros((8, 8, 3), np.uint8))
    (folder / "notes.jpg").write_text("not a picture")
    (folder / "empty.png").touch()
    (folder / "phone" / "IMG_1.HEIC").touch()
    (folder / "FINE.CR2").touch()  # beside fine.png, as cameras write both
    (folder / "other.png").touch()
    why = unregistered_images(tmp_path, folder, [], {"other.png": Path("sparse/1")})
    assert list(why) == ["phone/IMG_1.HEIC", "empty.png", "fine.png", "notes.jpg", "other.png"]
    assert why["fine.png"].startswith("COLMAP did not register it: too few matches")
    assert "cannot be decoded" in why["notes.jpg"] and "cannot be decoded" in why["empty.png"]
    assert why["phone/IMG_1.HEIC"] == "COLMAP reads no HEIC; convert it to JPEG"
    assert "registered it in sparse/1" in why["other.png"]


def test_a_folder_of_pictures_that_colmap_does_not_read_says_so(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.dng").touch()
    told = r"convert those that are there to JPEG:\n  images/a\.dng: COLMAP reads no DNG"
    with pytest.raises(InputError, match=told):
        find_images(tmp_path)
