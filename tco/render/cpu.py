"""The portable engine: splats to pixels on CPU threads, compiled by numba.

The splats of a target are taken front to back by the depth of their centres, and each adds itself to
the pixels of its box. The state is one transmittance a pixel, so nothing grows with surfels × pixels,
and the backward pass repeats the same walk: with v the contribution of a splat to the loss and V the
total of w v over the pixel, the derivative by its alpha is T v − (V − Σ_{up to here} w v) / (1 − alpha).

At pixel (x, y) the point of the tangent plane is found as in 2D Gaussian splatting: with the columns
X, Y, W of the ray transform, (x W − X) × (y W − Y) ∝ (a, b, 1). The product is affine in x and y:
X × Y + x (Y × W) + y (W × X). Pixels are counted from the corner of the box, which keeps the digits.

A splat is a row of 16 numbers, and so is its derivative: the ray transform (9), the centre (2), depth,
opacity and the colours (3). Rows are packed in the order of depth, so that memory is read in sequence.
Arithmetic is in float64 whatever the type of the arrays, so that both walks take the same decisions.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numba
import numpy as np
import torch
from torch import Tensor

from tco.render.project import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, Splats

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
def _columns(row: Any, x0: Any, y0: Any) -> Any:
    """X, Y, W of a ray transform for pixels counted from the pixel (x0, y0)."""
    W = (row[2], row[5], row[8])
    X = _add((row[0], row[3], row[6]), -(x0 + 0.5), W)
    Y = _add((row[1], row[4], row[7]), -(y0 + 0.5), W)
    return X, Y, W


@numba.njit(inline="always")
def _squared_distance(zeta: Any, dx: Any, dy: Any) -> Any:
    """2 sigma from the hit ∝ zeta and the offset from the centre; True if the hit is the nearer one.

    A ray in the tangent plane (zeta[2] = 0) hits at infinity, which leaves the offset.
    """
    filtered = 2 * (dx * dx + dy * dy)
    hit = zeta[0] * zeta[0] + zeta[1] * zeta[1]
    square = zeta[2] * zeta[2]
    if hit < filtered * square:
        return hit / square, True
    return filtered, False


@_compiled
def _forward(splats: Array, boxes: Array, image: Array) -> None:
    """Rasterise sorted splats (N, 16) into ``image`` (H, W, 5): colours, depth, transmittance from 1 down.

    A finished pixel is marked by the negative of its transmittance, which the caller undoes.
    """
    for row, (x0, x1, y0, y1) in zip(splats, boxes):  # noqa: B905 (numba knows no strict)
        X, Y, W = _columns(row, x0, y0)
        z0, zx, zy = _cross(X, Y), _cross(Y, W), _cross(W, X)
        mx, my, opacity = row[9] - x0 - 0.5, row[10] - y0 - 0.5, row[12]
        limit = 2 * math.log(opacity / MIN_ALPHA) + 1e-9
        for y in range(y1 - y0):
            start = _add(z0, y, zy)
            for x in range(x1 - x0):
                pixel = image[y0 + y, x0 + x]
                if pixel[4] <= 0:
                    continue
                s, _ = _squared_distance(_add(start, x, zx), x - mx, y - my)
                if s > limit:
                    continue
                alpha = opacity * math.exp(-0.5 * s)
                if alpha < MIN_ALPHA:
                    continue
                alpha = min(alpha, MAX_ALPHA)
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
def _backward(splats: Array, boxes: Array, upstream: Array, rest: Array, grads: Array) -> None:
    """Derivatives by sorted splats (N, 16), written to ``grads`` (N, 16), which starts at zero.

    ``upstream`` (H, W, 5) holds the derivatives of the loss by colours, depth and alpha; ``rest``
    (H, W, 2) starts as the total V of the pixel and a transmittance of 1, and is used up.
    """
    for row, box, grad in zip(splats, boxes, grads):  # noqa: B905 (numba knows no strict)
        x0, x1, y0, y1 = box
        X, Y, W = _columns(row, x0, y0)
        z0, zx, zy = _cross(X, Y), _cross(Y, W), _cross(W, X)
        mx, my, opacity = row[9] - x0 - 0.5, row[10] - y0 - 0.5, row[12]
        limit = 2 * math.log(opacity / MIN_ALPHA) + 1e-9
        g0 = gx = gy = (0.0, 0.0, 0.0)
        for y in range(y1 - y0):
            start = _add(z0, y, zy)
            for x in range(x1 - x0):
                left = rest[y0 + y, x0 + x]
                if left[1] <= 0:
                    continue
                zeta = _add(start, x, zx)
                s, hit = _squared_distance(zeta, x - mx, y - my)
                if s > limit:
                    continue
                falloff = math.exp(-0.5 * s)
                alpha = min(opacity * falloff, MAX_ALPHA)
                if alpha < MIN_ALPHA:
                    continue
                after = left[1] * (1 - alpha)
                if after <= MIN_TRANSMITTANCE:
                    left[1] = 0.0
                    continue
                up = upstream[y0 + y, x0 + x]
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
        # For z = p × q the derivative by p is q × dz, and by q it is dz × p.
        dX = _add(_cross(Y, g0), 1, _cross(gy, W))
        dY = _add(_cross(g0, X), 1, _cross(W, gx))
        dW = _add(_cross(gx, Y), 1, _cross(X, gy))
        # X and Y were shifted by multiples of W, which takes a share of theirs.
        dW = _add(_add(dW, -(x0 + 0.5), dX), -(y0 + 0.5), dY)
        for k in range(3):
            grad[3 * k], grad[3 * k + 1], grad[3 * k + 2] = dX[k], dY[k], dW[k]


class _Rasterize(torch.autograd.Function):
    """Splats (boxes, ray transforms, centres, depths, opacities, colours) to colour, depth sum, alpha."""

    @staticmethod
    def forward(
        ctx: Any, size: tuple[int, int], boxes: Tensor, *tensors: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        arrays, all_boxes = [_array(t) for t in tensors], _array(boxes)
        image = np.zeros((len(all_boxes), *size, 5))
        orders: list[Array] = [np.empty(0, np.int64)] * len(all_boxes)

        def draw(t: int) -> None:
            orders[t] = _front_to_back(all_boxes[t], arrays[2][t])
            image[t, ..., 4] = 1
            _forward(_pack(arrays, t, orders[t]), all_boxes[t][orders[t]], image[t])
            image[t, ..., 4] = 1 - np.abs(image[t, ..., 4])

        _each(draw, len(all_boxes))
        ctx.kept = arrays, all_boxes, orders, image, tensors[0].device
        parts = image[..., :3], image[..., 3], image[..., 4]
        color, depth, alpha = (
            torch.from_numpy(p.astype(arrays[0].dtype)).to(tensors[0].device) for p in parts
        )
        return color, depth, alpha

    @staticmethod
    def backward(ctx: Any, color: Tensor, depth: Tensor, alpha: Tensor) -> Any:
        arrays, boxes, orders, image, device = ctx.kept
        upstream = np.empty(image.shape)
        upstream[..., :3], upstream[..., 3], upstream[..., 4] = _array(color), _array(depth), _array(alpha)
        targets, n = boxes.shape[:2]
        grads = np.zeros((targets, n, 16), arrays[0].dtype)

        def differentiate(t: int) -> None:
            order = orders[t]
            rest = np.stack([(upstream[t] * image[t]).sum(-1), np.ones(image.shape[1:3])], -1)
            grad = np.zeros((len(order), 16))
            _backward(_pack(arrays, t, order), boxes[t][order], upstream[t], rest, grad)
            grads[t][order] = grad

        _each(differentiate, targets)
        shared = grads[..., 12:].sum(0)
        parts = (
            grads[..., :9].reshape(targets, n, 3, 3),
            grads[..., 9:11],
            grads[..., 11],
            shared[:, 0],
            shared[:, 1:],
        )
        return None, None, *(torch.from_numpy(p).to(device) for p in parts)


def _pack(arrays: list[Array], target: int, order: Array) -> Array:
    """Rows of 16 numbers (N, 16) of the splats of one target in the given order."""
    transforms, centres, depths, opacities, colors = arrays
    rows = np.empty((len(order), 16))
    rows[:, :9] = transforms[target].reshape(-1, 9)[order]
    rows[:, 9:11], rows[:, 11] = centres[target][order], depths[target][order]
    rows[:, 12], rows[:, 13:] = opacities[order], colors[order]
    return rows


def _array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().contiguous().numpy()


def _front_to_back(boxes: Array, depths: Array) -> Array:
    """Indices of the splats with a box, by depth; equal depths stay in the order of the surfels."""
    seen = np.flatnonzero(boxes[:, 1] > boxes[:, 0])
    return seen[np.argsort(depths[seen], kind="stable")]


def _each(task: Callable[[int], None], count: int) -> None:
    """Run ``task`` for 0 … count − 1 on as many threads as torch uses."""
    workers = min(count, torch.get_num_threads())
    if workers <= 1:
        for i in range(count):
            task(i)
        return
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(task, range(count)))


def rasterize(splats: Splats, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (T, H, W, 3), sum of weighted depths (T, H, W) and alpha (T, H, W) of splats.

    Differentiable in all floating fields of ``splats``, in float32 and float64, on any device (the work
    is done on the CPU, on ``torch.get_num_threads()`` threads, one target each).
    """
    return _Rasterize.apply(
        size, splats.boxes, splats.transforms, splats.centres, splats.depths, splats.opacities, splats.colors
    )
