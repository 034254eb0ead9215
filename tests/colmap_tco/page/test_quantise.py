"""What is embedded comes back within the stated quantisation."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from colmap_tco.page.quantise import (
    grid,
    level_values,
    levels,
    lossless,
    normal_codes,
    normal_values,
    packed,
    photograph,
)


def decoded(uri: str) -> np.ndarray:
    """The numbers of a data URI, RGB."""
    data = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    return np.asarray(picture if picture.ndim == 2 else picture[..., ::-1])


@pytest.mark.parametrize("dtype", ["<u2", ">u2", "<f4", "u1", "i1"])
def test_bytes_are_little_endian_whatever_the_machine_holds(dtype: str) -> None:
    array = np.arange(24).reshape(4, 6).astype(dtype)
    back = np.frombuffer(base64.b64decode(packed(array.T)), np.dtype(dtype).newbyteorder("<"))
    assert (back == array.T.ravel()).all()


@given(st.floats(-6, 6), st.floats(1e-3, 1e4), st.integers(0, 2**31))
def test_positions_are_within_half_a_step_also_far_from_the_origin(
    far: float, extent: float, seed: int
) -> None:
    points = np.random.default_rng(seed).uniform(0, extent, (40, 3)) + 10**far
    codes, corner, step = grid(points)
    error = np.abs(corner + codes * step - points)
    assert (error <= 0.5 * step * (1 + 1e-6) + 1e-15 * 10**far).all()
    assert np.allclose(step, np.ptp(points, axis=0) / 65535)


def test_a_flat_cloud_and_an_empty_one_have_positions() -> None:
    codes, corner, step = grid(np.array([[1.0, 2, 3], [2, 2, 3]]))
    assert (corner + codes * step == [[1, 2, 3], [2, 2, 3]]).all()
    assert grid(np.zeros((0, 3)))[0].shape == (0, 3)


@given(st.floats(1e-3, 1e3), st.floats(1, 1e3), st.integers(0, 2**31))
def test_maps_are_within_the_stated_ratio_and_holes_stay_holes(low: float, ratio: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = np.exp(rng.uniform(np.log(low), np.log(low * ratio), (9, 7)))
    depth[rng.random((9, 7)) < 0.3] = 0
    codes, least, most = levels(depth)
    back = level_values(codes, least, most)
    assert ((back > 0) == (depth > 0)).all()
    there = depth > 0
    bound = (most / least) ** (1 / 508)
    assert (np.maximum(back, depth)[there] / np.minimum(back, depth)[there] <= bound * (1 + 1e-9)).all()


def test_a_map_of_holes_and_one_of_a_single_value() -> None:
    assert not level_values(*levels(np.zeros((3, 4)))).any()
    assert level_values(*levels(np.full((3, 4), 2.5))) == pytest.approx(np.full((3, 4), 2.5))


def test_normals_are_within_a_62nd_and_none_stays_none() -> None:
    normal = np.random.default_rng(1).normal(size=(20, 30, 3))
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    normal[3:5] = 0
    back = normal_values(normal_codes(normal))
    assert np.abs(back - normal).max() <= 1 / 62 + 1e-9
    assert not back[3:5].any()


@pytest.mark.parametrize("shape", [(17, 23), (17, 23, 3)])
def test_maps_travel_as_pictures_without_loss(shape: tuple[int, ...]) -> None:
    codes = np.random.default_rng(2).integers(0, 256, shape, dtype=np.uint8)
    assert (decoded(lossless(codes)) == codes).all()


def test_photographs_keep_their_colours_and_their_order_of_channels() -> None:
    picture = np.zeros((32, 32, 3), np.uint8)
    picture[:, :, 0] = np.linspace(0, 255, 32)
    assert np.abs(decoded(photograph(picture)).astype(int) - picture).max() < 30
