"""A real excerpt of 7-Scenes in its published layout: the reader against COLMAP's model of the frames."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_tco import _pycolmap
from colmap_tco.datasets import SevenScenes
from colmap_tco.datasets.base import inverse, project
from colmap_tco.datasets.seven_scenes import FOCAL, PUBLISHED_FOCAL
from tests.colmap_tco.datasets import layouts

FRAMES = 6


@pytest.fixture(scope="module")
def kitchen(shared: Path) -> Path:
    folder = shared / "data" / "kitchen"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    return folder


def rebuilt(kitchen: Path, root: Path) -> tuple[SevenScenes, list[_pycolmap.Registered], float]:
    """The first frames as a sequence of 7-Scenes: pictures, projected depth, COLMAP's poses in metres."""
    unit = json.loads((kitchen / "gt" / "gt.json").read_text())["metres_per_colmap_unit"]
    entries = _pycolmap.registered(_pycolmap.read_model(kitchen / "sparse" / "0"))[:FRAMES]
    folder = root / "redkitchen" / "seq-01"
    layouts.text(root / "redkitchen" / "TestSplit.txt", "sequence1\n")
    for i, entry in enumerate(entries):
        name = f"frame-{i:06d}"
        folder.mkdir(parents=True, exist_ok=True)
        image = cv2.imread(str(kitchen / "images" / entry.name))
        assert cv2.imwrite(str(folder / f"{name}.color.png"), image)
        depth = cv2.imread(
            str(kitchen / "gt" / "depth" / f"{Path(entry.name).stem}.png"), cv2.IMREAD_UNCHANGED
        )
        depth[depth == 0] = 65535
        assert cv2.imwrite(str(folder / f"{name}.depth.proj.png"), depth)
        pose = np.eye(4)
        pose[:3] = entry.cam_from_world
        pose = inverse(pose)
        pose[:3, 3] *= unit
        layouts.matrix(folder / f"{name}.pose.txt", pose)
    return SevenScenes(root, as_published=True), entries, unit


def test_points_that_colmap_triangulated_have_the_sensors_depth(kitchen: Path, tmp_path: Path) -> None:
    """Poses, millimetres, the invalid value and the pixels of the real frames agree with another program."""
    dataset, entries, unit = rebuilt(kitchen, tmp_path)
    assert dataset.scenes() == ["redkitchen/seq-01"] and dataset.count("redkitchen/seq-01") == FRAMES
    model = _pycolmap.read_model(kitchen / "sparse" / "0")
    ids, xyz, _ = _pycolmap.points(model)
    row = {int(key): i for i, key in enumerate(ids)}
    ratios = []
    for frame, entry in zip(dataset.read("redkitchen/seq-01", range(FRAMES)).frames, entries, strict=True):
        xy, seen = _pycolmap.observations(model, entry.image_id)
        world = unit * xyz[[row[int(key)] for key in seen]]
        cam_from_world = inverse(frame.world_from_cam)
        local = world @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        K = frame.K.copy()
        K[0, 0] = K[1, 1] = _pycolmap.focal_lengths(entry.camera)[0]
        # The distortion is left out here: it is below two pixels in most of the picture.
        assert np.median(np.abs(project(local, K) - xy).max(1)) < 1.5
        depth = frame.depth_at(xy)
        measured = depth > 0
        assert 0.5 < measured.mean() < 1
        ratios.append(depth[measured] / local[measured, 2])
    off = np.concatenate(ratios) - 1
    assert abs(np.median(off)) < 0.01
    assert (np.abs(off) < 0.05).mean() > 0.8


def test_self_calibration_speaks_for_the_calibrated_and_against_the_published_focal_length(
    kitchen: Path,
) -> None:
    camera = _pycolmap.registered(_pycolmap.read_model(kitchen / "sparse" / "0"))[0].camera
    focal = _pycolmap.focal_lengths(camera)[0]
    assert abs(FOCAL / focal - 1) < 0.02
    assert abs(PUBLISHED_FOCAL / focal - 1) > 0.06
