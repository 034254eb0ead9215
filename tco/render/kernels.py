"""The compiled loops of the CPU engines: sorted splats over the pixels of their boxes.

A splat is a row of 16 numbers, and so is its derivative: the ray transform (9), the centre (2), depth,
opacity and the colours (3). Its box is x0, x1, y0, y1.

At pixel (x, y) the point of the tangent plane is found as in 2D Gaussian splatting: with the columns
X, Y, W of the ray transform, (x W − X) × (y W − Y) ∝ (a, b, 1). The product is affine in x and y:
X × Y + x (Y × W) + y (W × X). Pixels are counted from the corner of the box, which keeps the digits.

numba keeps compiled code by the date of the file of a loop, and does not see changes in what the loop
imports: the helpers and constants of the loops belong into this file.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np

MIN_ALPHA = 1 / 255
"""A surfel that contributes less to a pixel is skipped there."""
MAX_ALPHA = 0.99
"""No surfel hides what is behind it completely."""
MIN_TRANSMITTANCE = 1e-4
"""A pixel is finished before the surfel that would take its transmittance to this or below."""
CORE = 1.1
"""Sigma up to which a surfel counts as the nearest surface: neighbours a step apart cover all pixels."""

_log = logging.getLogger(__name__)
_F = TypeVar("_F", bound=Callable[..., Any])
Array = np.ndarray[Any, Any]


def _compiled(function: _F) -> _F:
    """``function`` as machine code, kept on disk between runs where a folder for that can be written."""
    try:
        return numba.njit(nogil=True, cache=True, error_model="numpy")(function)
    except RuntimeError as error:
        _log.debug("numba cannot keep compiled code on disk, it compiles in each process: %s", error)
        return numba.njit(nogil=True, error_model="numpy")(function)


@numba.njit(inline="always")
def _cross(a: Any, b: Any) -> Any:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(inline="always")
def _add(total: Any, factor: Any, change: Any) -> Any:
    return total[0] + factor * change[0], total[1] + factor * change[1], total[2] + factor * change[2]


@numba.njit(inline="always")
def _columns(row: Any, box: Any) -> Any:
    """X, Y, W of a ray transform for pixels counted from the first of the box."""
    W = (row[2], row[5], row[8])
    X = _add((row[0], row[3], row[6]), -(box[0] + 0.5), W)
    Y = _add((row[1], row[4], row[7]), -(box[2] + 0.5), W)
    return X, Y, W


@numba.njit(inline="always")
def _footprint(row: Any, box: Any) -> Any:
    """Hit at the first pixel of the box, its changes by x and y, the centre, and the largest 2 sigma."""
    X, Y, W = _columns(row, box)
    limit = 2 * math.log(row[12] / MIN_ALPHA) + 1e-9
    return _cross(X, Y), _cross(Y, W), _cross(W, X), row[9] - box[0] - 0.5, row[10] - box[2] - 0.5, limit


@numba.njit(inline="always")
def _twice_sigma(zeta: Any, dx: Any, dy: Any) -> Any:
    """2 sigma from the hit ∝ zeta and the offset from the centre; True if the hit is the nearer one.

    A ray in the tangent plane (zeta[2] = 0) hits at infinity, which leaves the offset.
    """
    filtered = 2 * (dx * dx + dy * dy)
    hit = zeta[0] * zeta[0] + zeta[1] * zeta[1]
    square = zeta[2] * zeta[2]
    if hit < filtered * square:
        return hit / square, True
    return filtered, False


@numba.njit(inline="always")
def _carry(grad: Any, columns: Any, corner: Any, by_zeta: Any) -> None:
    """Write derivatives by X × Y, Y × W and W × X to the nine entries of the ray transform.

    For z = p × q the derivative by p is q × dz, and by q it is dz × p. X and Y were shifted by
    multiples of W, which takes a share of theirs.
    """
    X, Y, W = columns
    g0, gx, gy = by_zeta
    dX = _add(_cross(Y, g0), 1, _cross(gy, W))
    dY = _add(_cross(g0, X), 1, _cross(W, gx))
    dW = _add(_cross(gx, Y), 1, _cross(X, gy))
    dW = _add(_add(dW, -(corner[0] + 0.5), dX), -(corner[1] + 0.5), dY)
    for k in range(3):
        grad[3 * k], grad[3 * k + 1], grad[3 * k + 2] = dX[k], dY[k], dW[k]


@_compiled
def composite(splats: Array, boxes: Array, image: Array) -> None:
    """Splats (N, 16), front first, into ``image`` (H, W, 5): colours, depth, transmittance from 1 down.

    A finished pixel is marked by the negative of its transmittance, which the caller undoes.
    """
    for row, box in zip(splats, boxes):  # noqa: B905 (numba knows no strict)
        z0, zx, zy, mx, my, limit = _footprint(row, box)
        for y in range(box[3] - box[2]):
            start = _add(z0, y, zy)
            for x in range(box[1] - box[0]):
                pixel = image[box[2] + y, box[0] + x]
                if pixel[4] <= 0:
                    continue
                s, _ = _twice_sigma(_add(start, x, zx), x - mx, y - my)
                if s > limit:
                    continue
                alpha = min(row[12] * math.exp(-0.5 * s), MAX_ALPHA)
                if alpha < MIN_ALPHA:
                    continue
                after = pixel[4] * (1 - alpha)
                if after <= MIN_TRANSMITTANCE:
                    pixel[4] = -pixel[4]
                    continue
                weight = alpha * pixel[4]
                pixel[0] += weight * row[13]
                pixel[1] += weight * row[14]
                pixel[2] += weight * row[15]
                pixel[3] += weight * row[11]
                pixel[4] = after


@_compiled
def composite_backward(splats: Array, boxes: Array, upstream: Array, rest: Array, grads: Array) -> None:
    """Derivatives of :func:`composite`, written to ``grads`` (N, 16), which starts at zero.

    With v the contribution of a splat to the loss and V the total of w v over a pixel, the derivative
    by its alpha is T v − (V − Σ_{up to here} w v) / (1 − alpha): the walk is front to back once more.

    ``upstream`` (H, W, 5) holds the derivatives of the loss by colours, depth and alpha; ``rest``
    (H, W, 2) starts as V and a transmittance of 1, and is used up.
    """
    for row, box, grad in zip(splats, boxes, grads):  # noqa: B905 (numba knows no strict)
        z0, zx, zy, mx, my, limit = _footprint(row, box)
        g0 = gx = gy = (0.0, 0.0, 0.0)
        for y in range(box[3] - box[2]):
            start = _add(z0, y, zy)
            for x in range(box[1] - box[0]):
                left = rest[box[2] + y, box[0] + x]
                if left[1] <= 0:
                    continue
                zeta = _add(start, x, zx)
                s, hit = _twice_sigma(zeta, x - mx, y - my)
                if s > limit:
                    continue
                falloff = math.exp(-0.5 * s)
                alpha = min(row[12] * falloff, MAX_ALPHA)
                if alpha < MIN_ALPHA:
                    continue
                after = left[1] * (1 - alpha)
                if after <= MIN_TRANSMITTANCE:
                    left[1] = 0.0
                    continue
                up = upstream[box[2] + y, box[0] + x]
                weight = alpha * left[1]
                value = row[13] * up[0] + row[14] * up[1] + row[15] * up[2] + row[11] * up[3] + up[4]
                left[0] -= weight * value
                g_alpha = left[1] * value - left[0] / (1 - alpha)
                left[1] = after
                grad[13] += weight * up[0]
                grad[14] += weight * up[1]
                grad[15] += weight * up[2]
                grad[11] += weight * up[3]
                if alpha == MAX_ALPHA:
                    continue
                grad[12] += g_alpha * falloff
                if hit:
                    factor = -g_alpha * alpha / (zeta[2] * zeta[2])
                    change = (factor * zeta[0], factor * zeta[1], -factor * s * zeta[2])
                    g0, gx, gy = _add(g0, 1, change), _add(gx, x, change), _add(gy, y, change)
                else:
                    grad[9] += g_alpha * alpha * 2 * (x - mx)
                    grad[10] += g_alpha * alpha * 2 * (y - my)
        _carry(grad, _columns(row, box), (box[0], box[2]), (g0, gx, gy))


@_compiled
def nearest(splats: Array, boxes: Array, depth: Array) -> None:
    """Lower ``depth`` (H, W), infinite at first, to that of the nearest splat whose core holds the pixel."""
    for row, box in zip(splats, boxes):  # noqa: B905 (numba knows no strict)
        z0, zx, zy, mx, my, _ = _footprint(row, box)
        for y in range(box[3] - box[2]):
            start = _add(z0, y, zy)
            for x in range(box[1] - box[0]):
                if row[11] < depth[box[2] + y, box[0] + x]:
                    s, _ = _twice_sigma(_add(start, x, zx), x - mx, y - my)
                    if s <= 2 * CORE:
                        depth[box[2] + y, box[0] + x] = row[11]


@_compiled
def blend(splats: Array, boxes: Array, surface: Array, tolerance: float, image: Array) -> None:
    """Add splats (N, 16) of the nearest surface to ``image`` (H, W, 5): colours, depth and weight.

    The weight is opacity · exp(−sigma). A splat belongs to the surface of a pixel if its depth differs
    from ``surface`` (H, W) by less than the relative tolerance; an infinite surface has none.
    """
    for row, box in zip(splats, boxes):  # noqa: B905 (numba knows no strict)
        z0, zx, zy, mx, my, limit = _footprint(row, box)
        for y in range(box[3] - box[2]):
            start = _add(z0, y, zy)
            for x in range(box[1] - box[0]):
                near = surface[box[2] + y, box[0] + x]
                if not abs(row[11] - near) < tolerance * near:
                    continue
                s, _ = _twice_sigma(_add(start, x, zx), x - mx, y - my)
                if s <= limit:
                    weight = row[12] * math.exp(-0.5 * s)
                    pixel = image[box[2] + y, box[0] + x]
                    pixel[0] += weight * row[13]
                    pixel[1] += weight * row[14]
                    pixel[2] += weight * row[15]
                    pixel[3] += weight * row[11]
                    pixel[4] += weight


@_compiled
def blend_backward(
    splats: Array, boxes: Array, surface: Array, tolerance: float, upstream: Array, grads: Array
) -> None:
    """Derivatives of :func:`blend` for a constant surface, written to ``grads`` (N, 16), zero at first."""
    for row, box, grad in zip(splats, boxes, grads):  # noqa: B905 (numba knows no strict)
        z0, zx, zy, mx, my, limit = _footprint(row, box)
        g0 = gx = gy = (0.0, 0.0, 0.0)
        for y in range(box[3] - box[2]):
            start = _add(z0, y, zy)
            for x in range(box[1] - box[0]):
                near = surface[box[2] + y, box[0] + x]
                if not abs(row[11] - near) < tolerance * near:
                    continue
                zeta = _add(start, x, zx)
                s, hit = _twice_sigma(zeta, x - mx, y - my)
                if s > limit:
                    continue
                falloff = math.exp(-0.5 * s)
                weight = row[12] * falloff
                up = upstream[box[2] + y, box[0] + x]
                value = row[13] * up[0] + row[14] * up[1] + row[15] * up[2] + row[11] * up[3] + up[4]
                grad[13] += weight * up[0]
                grad[14] += weight * up[1]
                grad[15] += weight * up[2]
                grad[11] += weight * up[3]
                grad[12] += value * falloff
                if hit:
                    factor = -value * weight / (zeta[2] * zeta[2])
                    change = (factor * zeta[0], factor * zeta[1], -factor * s * zeta[2])
                    g0, gx, gy = _add(g0, 1, change), _add(gx, x, change), _add(gy, y, change)
                else:
                    grad[9] += value * weight * 2 * (x - mx)
                    grad[10] += value * weight * 2 * (y - my)
        _carry(grad, _columns(row, box), (box[0], box[2]), (g0, gx, gy))
