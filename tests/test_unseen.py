"""Stretches of public sequences as workspaces: the Kinect's two cameras, the unit, what is missing."""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import unseen
from benchmarks.sets import known
from benchmarks.unseen import COLOUR_BESIDE, COLOUR_CAMERA, DEPTH_CAMERA, is_stretch, made, registered
from colmap_tco import _pycolmap
from colmap_tco.lens import pincushion


@pytest.mark.parametrize(("x", "y", "z"), [(320, 240, 1000), (100, 400, 700), (600, 50, 4000)])
def test_a_depth_falls_where_the_colour_camera_sees_its_point(x: int, y: int, z: int) -> None:
    depth = np.zeros((480, 640), np.uint16)
    depth[y, x] = z
    (focal, cx, cy), (to, tx, ty) = DEPTH_CAMERA, COLOUR_CAMERA
    point = np.array([(x - cx) / focal * z + COLOUR_BESIDE[0], (y - cy) / focal * z + COLOUR_BESIDE[1]])
    u, v = np.rint(to * point / z + (tx, ty)).astype(int)
    found = registered(depth)
    assert found[v, u] == z and np.count_nonzero(found) == 1


def test_the_nearest_of_what_falls_on_one_pixel_is_seen() -> None:
    """A plane is seen at its depth everywhere; a near patch hides what is behind it, from 22 mm beside."""
    depth = np.full((480, 640), 2000, np.uint16)
    depth[200:280, 300:340] = 500
    found = registered(depth)
    assert set(np.unique(found)) == {0, 500, 2000}
    to, middle = COLOUR_CAMERA[0], COLOUR_CAMERA[1]
    shift = to * COLOUR_BESIDE[0] / 500
    left = round(to * (300 - 320) / 585 + shift + middle)
    assert found[230, left + 2] == 500 and found[230, left - 4] == 2000


def test_names_are_those_of_a_sequence_and_a_frame() -> None:
    assert is_stretch("icl-140") and is_stretch("redkitchen-000")
    assert not any(map(is_stretch, ("icl", "icl-", "kitchen", "hills-000", "icl--3")))
    assert known("icl-140") == "icl-140" and known("kitchen") == "kitchen"
    with pytest.raises(argparse.ArgumentTypeError, match="attic is none of kitchen"):
        known("attic")


def test_what_was_looked_at_is_not_among_what_nothing_was_chosen_by() -> None:
    assert not set(unseen.UNTUNED) & set(unseen.LOOKED_AT)
    assert len(set(unseen.MAPPED)) == len(unseen.MAPPED) and all(map(is_stretch, unseen.MAPPED))
    assert unseen.parser().parse_args([]).names == list(unseen.MAPPED)


def test_a_sequence_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(unseen, "SOURCES", tmp_path / "sources")
    with pytest.raises(SystemExit, match=r"00140\.jpg"):
        made("icl-140", tmp_path / "unseen")
    assert not (tmp_path / "unseen" / "icl-140" / "gt" / "gt.json").exists()


def test_what_is_made_already_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = tmp_path / "icl-140" / "gt"
    there.mkdir(parents=True)
    (there / "gt.json").write_text(json.dumps({"model": "sparse/0"}), "utf-8")
    monkeypatch.setattr(unseen, "SOURCES", tmp_path / "nowhere")
    assert made("icl-140", tmp_path) == (tmp_path / "icl-140").resolve()


def test_frames_become_a_workspace_with_its_truth(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, make_workspace: Callable[..., Path]
) -> None:
    """The sensor's depths are a quarter of the model's, but a third are wrong and some out of range."""
    names = [f"{i:05d}.png" for i in range(5)]
    given = make_workspace(tmp_path / "given", names=names)
    base = tmp_path / "sources" / "made"
    base.mkdir(parents=True)
    for name, depth in measured(given / "sparse" / "0", 0.25).items():
        shutil.copy(given / "images" / name, base / name)
        depth[0] = 60_000
        cv2.imwrite(str(base / f"d{name}"), depth)
    monkeypatch.setattr(unseen, "SOURCES", tmp_path / "sources")
    monkeypatch.setattr(unseen, "VIEWS", len(names))
    monkeypatch.setattr(unseen, "FEWEST", len(names))
    monkeypatch.setitem(unseen.SEQUENCES, "made", unseen.Sequence("made", "{:05d}.png", "d{:05d}.png", 1))
    shutil.copytree(given / "sparse", tmp_path / "unseen" / "made-0" / "sparse")
    folder = made("made-0", tmp_path / "unseen")
    told = json.loads((folder / "gt" / "gt.json").read_text("utf-8"))
    assert told == {"model": "sparse/0", "metres_per_colmap_unit": pytest.approx(0.25, rel=0.01), "images": 5}
    assert [file.name for file in sorted((folder / "images").iterdir())] == names
    assert unseen.agreeing(folder) == pytest.approx(2 / 3, abs=0.03)
    cells = [cell.strip() for cell in unseen.row("made-0", folder).split("|")]
    cameras = [e.camera for e in _pycolmap.registered(_pycolmap.read_model(given / "sparse" / "0"))]
    assert cells[1:3] == ["made-0", "5"] and float(cells[3]) == pytest.approx(2 / 3, abs=0.03)
    assert float(cells[4]) == pytest.approx(100 * max(map(pincushion, cameras)), abs=0.06)
    truth = cv2.imread(str(folder / "gt" / "depth" / names[1]), cv2.IMREAD_UNCHANGED)
    assert truth[0].max() == 0 and truth.max() > 0
    monkeypatch.setattr(unseen, "FEWEST", 6)
    shutil.rmtree(folder / "gt")
    with pytest.raises(SystemExit, match="registered 5 of 5 frames, fewer than 6"):
        made("made-0", tmp_path / "unseen")


def measured(path: Path, unit: float) -> dict[str, np.ndarray]:
    """Depth at each keypoint of a model in millimetres, by name; every third is wrong."""
    model = _pycolmap.read_model(path)
    ids, xyz, _ = _pycolmap.points(model)
    position = dict(zip(ids.tolist(), xyz, strict=True))
    found = {}
    for entry in _pycolmap.registered(model):
        w, h = _pycolmap.camera_size(entry.camera)
        depth = np.zeros((h, w), np.uint16)
        keypoints, seen = _pycolmap.observations(model, entry.image_id)
        for number, ((x, y), point) in enumerate(zip(keypoints, seen, strict=True)):
            z = (entry.cam_from_world @ np.r_[position[int(point)], 1])[2]
            depth[min(int(y), h - 1), min(int(x), w - 1)] = round(1000 * z * (unit if number % 3 else 0.7))
        found[entry.name] = depth
    return found
