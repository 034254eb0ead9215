"""Distortion at the corners against its formula, and who is warned of."""

from __future__ import annotations

import logging

import pytest

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Registered
from colmap_tco.lens import MOST, pincushion, warn_of_lenses

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


@pytest.mark.parametrize(("share", "warnings"), [(0.9, 0), (1.1, 1)])
def test_only_more_than_lenses_have_is_warned_of(
    share: float, warnings: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Once a camera, however many views it has."""
    u = 0.45
    k = share * MOST / u**2
    camera = radial(HALF_DIAGONAL / (u + k * u**3), u, k)
    images = [Registered(i, f"{i}.jpg", camera, None) for i in (1, 2)]  # type: ignore[arg-type]
    with caplog.at_level(logging.WARNING):
        warn_of_lenses(images)
    assert len(caplog.records) == warnings
    assert all("pincushion" in record.message for record in caplog.records)
