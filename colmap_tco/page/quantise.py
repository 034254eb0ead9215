"""Numbers as the page holds them: few bytes, a stated error, and the inverse of each code.

Positions are 16-bit multiples of a step from a corner; depths and confidences are 8-bit steps of equal
ratio, in lossless pictures; normals have 63 levels an axis. Arrays travel as base64, little-endian.
"""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

LEVELS = 254
"""Steps between the smallest and the largest value of a map; code 0 is none, 1 the smallest."""
NORMAL_LEVELS = 31
"""Steps from 0 to 1 of a component of a normal map: an error below 1 / 62."""
_NORMAL_STEP, _NORMAL_ZERO = 4, 128
JPEG_QUALITY = 82


def packed(array: NDArray[Any]) -> str:
    """The bytes of an array, row by row and little-endian, as base64."""
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return base64.b64encode(little.tobytes()).decode("ascii")


def grid(xyz: NDArray[np.floating]) -> tuple[NDArray[np.uint16], NDArray[np.float64], NDArray[np.float64]]:
    """Codes (N, 3), corner (3,) and step (3,) of positions (N, 3): each is within half a step of
    ``corner + code * step``."""
    points = np.asarray(xyz, np.float64).reshape(-1, 3)
    if not len(points):
        return np.zeros((0, 3), np.uint16), np.zeros(3), np.ones(3)
    corner = points.min(0)
    step = np.ptp(points, axis=0) / 65535
    step[step == 0] = 1.0
    return np.rint((points - corner) / step).astype(np.uint16), corner, step


def levels(values: NDArray[np.floating]) -> tuple[NDArray[np.uint8], float, float]:
    """Codes of positive values, and the smallest and the largest of them; 0 and below is none.

    Code c > 0 stands for ``low * (high / low) ** ((c - 1) / 254)``, so that the relative error is at most
    ``(high / low) ** (1 / 508) - 1``: 0.5 % where the largest is ten times the smallest.
    """
    there = values > 0
    if not there.any():
        return np.zeros(values.shape, np.uint8), 1.0, 1.0
    low, high = float(values[there].min()), float(values[there].max())
    ratio = np.log(high / low)
    place = np.log(np.where(there, values, low) / low) / (ratio if ratio > 0 else 1.0)
    codes = np.where(there, 1 + np.rint(LEVELS * place.clip(0, 1)), 0).astype(np.uint8)
    return codes, low, high


def level_values(codes: NDArray[np.uint8], low: float, high: float) -> NDArray[np.float64]:
    """The values that codes of :func:`levels` stand for; 0 is none."""
    place = (codes.astype(np.float64) - 1) / LEVELS
    return np.where(codes > 0, low * (high / low) ** place, 0.0)


def normal_codes(normal: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Codes (H, W, 3) of unit normals (H, W, 3); none, (0, 0, 0), is 128 thrice."""
    steps = np.rint(NORMAL_LEVELS * np.asarray(normal, np.float64))
    return np.asarray(_NORMAL_ZERO + _NORMAL_STEP * steps, np.uint8)


def normal_values(codes: NDArray[np.uint8]) -> NDArray[np.float64]:
    """The vectors (H, W, 3) that codes of :func:`normal_codes` stand for, each component within 1 / 62."""
    return (codes.astype(np.float64) - _NORMAL_ZERO) / (_NORMAL_STEP * NORMAL_LEVELS)


def lossless(codes: NDArray[np.uint8]) -> str:
    """A picture (H, W) or RGB (H, W, 3) as a data URI that decodes to the same numbers."""
    import cv2

    # What the filters leave of a map is noise almost without repetition: to search for the little there is
    # takes 20 to 60 times as long, and saves 5 % of a depth map and a fifth of a normal map.
    options = [cv2.IMWRITE_PNG_COMPRESSION, 6, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    options += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_ALL_FILTERS]
    turned = codes if codes.ndim == 2 else np.ascontiguousarray(codes[..., ::-1])
    return _uri("png", cv2.imencode(".png", turned, options))


def photograph(rgb: NDArray[np.uint8]) -> str:
    """A picture (H, W, 3) as a JPEG data URI."""
    import cv2

    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    return _uri("jpeg", cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), options))


def _uri(kind: str, encoded: tuple[bool, NDArray[np.uint8]]) -> str:
    ok, data = encoded
    if not ok:
        raise RuntimeError(f"OpenCV could not encode a picture as {kind}")
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode('ascii')}"
