"""Distortion at the corners against its formula, and who is warned of."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import pytest

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Registered
from colmap_tco.check import CheckConfig, check
from colmap_tco.lens import MOST, implausible, pincushion
from colmap_tco.progress import Progress
from colmap_tco.workspace import open_workspace

SIZE = (640, 480)
HALF_DIAGONAL = 400.0


def radial(focal: float, undistorted: float, k: float) -> _pycolmap.Camera:
    """A camera whose corner is at this normalised radius without distortion: f · (u + k u³) = 400 pixels."""
    assert focal * (undistorted + k * undistorted**3) == pytest.approx(HALF_DIAGONAL)
    return _pycolmap.camera("SIMPLE_RADIAL", SIZE, [focal, 320.0, 240.0, k])


@pytest.mark.parametrize("k", [-0.2, 0.0, 0.1, 0.5])
def test_it_is_what_the_polynomial_adds_at_the_corner(k: float) -> None:
    u = 0.45
    assert pincushion(radial(HALF_DIAGONAL / (u + k * u**3), u, k)) == pytest.approx(k * u**2, abs=1e-6)


def test_it_is_of_the_farthest_corner() -> None:
    """With the principal point off the middle the opposite corner is distorted most."""
    camera = _pycolmap.camera("SIMPLE_RADIAL", SIZE, [800.0, 220.0, 180.0, 0.3])
    (u,) = _pycolmap.cam_from_img(camera, [[640.0, 480.0]])  # type: ignore[arg-type]
    assert pincushion(camera) == pytest.approx(0.3 * float(u @ u), rel=1e-6)


def test_fisheye_lenses_are_barrels() -> None:
    camera = _pycolmap.camera("OPENCV_FISHEYE", SIZE, [300.0, 300.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0])
    assert pincushion(camera) < 0


def images(*shares: float) -> list[Registered]:
    """Two views by each camera, of these shares of the most that a lens may have."""
    u, found = 0.45, []
    for number, share in enumerate(shares, 1):
        k = share * MOST / u**2
        camera = radial(HALF_DIAGONAL / (u + k * u**3), u, k)
        camera.camera_id = number
        found += [Registered(2 * number + i, f"{number}-{i}.jpg", camera, None) for i in (0, 1)]  # type: ignore[arg-type]
    return found


def test_only_more_than_lenses_have_is_told_of() -> None:
    assert implausible(images(0.9)) == []
    (told,) = implausible(images(1.3))
    assert told.startswith("1 of 1 cameras") and "camera 1 (SIMPLE_RADIAL) 6 % at the corners" in told


def test_many_cameras_are_one_sentence_and_the_worst_is_named() -> None:
    (told,) = implausible(images(0.2, 1.5, 2.0, 1.1, -3.0))
    assert told.startswith("3 of 5 cameras") and "camera 3 (SIMPLE_RADIAL) 10 %" in told


def test_opening_a_workspace_and_checking_it_warn_and_the_report_keeps_it(
    make_workspace: Callable[..., Path], tmp_path: Path, caplog: pytest.LogCaptureFixture, shot: type
) -> None:
    """A strong pincushion in a model that is otherwise consistent; a plain one says nothing."""
    plain = open_workspace(make_workspace(tmp_path / "plain"))
    assert not caplog.records and not any("pincushion" in reason for reason in plain.reasons)
    bent = shot(params=(110.0, 80.0, 60.0, 0.5))
    root = make_workspace(tmp_path / "bent", (bent,) * 5)
    with caplog.at_level(logging.WARNING):
        opened = open_workspace(root)
    assert [r.message for r in caplog.records] == [r for r in opened.reasons if "pincushion" in r]
    assert len(caplog.records) == 1
    assert "pincushion" in check(root, CheckConfig(), Progress()).images
