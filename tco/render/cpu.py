"""The portable engines: splats to pixels on CPU threads, one target each.

Each splat adds itself to the pixels of its box, so that the state is a few numbers a pixel and nothing
grows with surfels × pixels. The backward pass repeats the walk. Arithmetic is in float64 whatever the
type of the tensors, so that both walks take the same decisions. Ray transforms come in float64, too: planes
that pass near the camera need the digits.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from tco.render import kernels
from tco.render.kernels import Array
from tco.render.project import Splats, finished


class _Blending(Protocol):
    """How the sorted splats (N, 16) of one target, with their boxes, become its image (H, W, 5)."""

    def forward(self, target: int, splats: Array, boxes: Array, size: tuple[int, int]) -> Array:
        """The image (H, W, 5)."""
        ...

    def backward(self, target: int, splats: Array, boxes: Array, image: Array, upstream: Array) -> Array:
        """Derivatives by the splats (N, 16) from those by the image (H, W, 5)."""
        ...


class _Layers:
    """Alpha compositing, front to back: colours, sum of depths, alpha."""

    def forward(self, target: int, splats: Array, boxes: Array, size: tuple[int, int]) -> Array:
        image = np.zeros((*size, 5))
        image[..., 4] = 1
        kernels.composite(splats, boxes, image)
        image[..., 4] = 1 - np.abs(image[..., 4])
        return image

    def backward(self, target: int, splats: Array, boxes: Array, image: Array, upstream: Array) -> Array:
        rest = np.stack([(upstream * image).sum(-1), np.ones(image.shape[:2])], -1)
        grads = np.zeros((len(splats), 16))
        kernels.composite_backward(splats, boxes, upstream, rest, grads)
        return grads


class _Surface:
    """Sums over the splats of the nearest surface: colours, depths, weights."""

    def __init__(self, tolerances: list[float]) -> None:
        self.tolerances = tolerances
        self.depths: dict[int, Array] = {}

    def forward(self, target: int, splats: Array, boxes: Array, size: tuple[int, int]) -> Array:
        image, depth = np.zeros((*size, 5)), np.full(size, np.inf)
        kernels.nearest(splats, boxes, depth)
        kernels.blend(splats, boxes, depth, self.tolerances[target], image)
        self.depths[target] = depth
        return image

    def backward(self, target: int, splats: Array, boxes: Array, image: Array, upstream: Array) -> Array:
        grads = np.zeros((len(splats), 16))
        depth = self.depths[target]
        kernels.blend_backward(splats, boxes, depth, self.tolerances[target], upstream, grads)
        return grads


class _Rasterize(torch.autograd.Function):
    """Splats (boxes, ray transforms, centres, depths, opacities, colours) to the parts of their images."""

    @staticmethod
    def forward(
        ctx: Any, blending: _Blending, size: tuple[int, int], boxes: Tensor, *tensors: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        arrays, all_boxes = [_array(t) for t in tensors], _array(boxes)
        image = np.empty((len(all_boxes), *size, 5))
        orders: list[Array] = [np.empty(0, np.int64)] * len(all_boxes)

        def draw(t: int) -> None:
            orders[t] = _front_to_back(all_boxes[t], arrays[2][t])
            image[t] = blending.forward(t, _pack(arrays, t, orders[t]), all_boxes[t][orders[t]], size)

        _each(draw, len(all_boxes))
        ctx.kept = blending, arrays, all_boxes, orders, image, tensors[0].device
        parts = image[..., :3], image[..., 3], image[..., 4]
        color, depth, alpha = (
            torch.from_numpy(p.astype(arrays[-1].dtype)).to(tensors[0].device) for p in parts
        )
        return color, depth, alpha

    @staticmethod
    def backward(ctx: Any, color: Tensor, depth: Tensor, alpha: Tensor) -> Any:
        blending, arrays, boxes, orders, image, device = ctx.kept
        upstream = np.empty(image.shape)
        upstream[..., :3], upstream[..., 3], upstream[..., 4] = _array(color), _array(depth), _array(alpha)
        targets, n = boxes.shape[:2]
        by_transform = np.zeros((targets, n, 9), arrays[0].dtype)
        others = np.zeros((targets, n, 7), arrays[-1].dtype)

        def differentiate(t: int) -> None:
            splats = _pack(arrays, t, orders[t])
            grads = blending.backward(t, splats, boxes[t][orders[t]], image[t], upstream[t])
            by_transform[t][orders[t]], others[t][orders[t]] = grads[:, :9], grads[:, 9:]

        _each(differentiate, targets)
        shared = others[..., 3:].sum(0)
        per_target = by_transform.reshape(targets, n, 3, 3), others[..., :2], others[..., 2]
        parts = *per_target, shared[:, 0], shared[:, 1:]
        return None, None, None, *(torch.from_numpy(p).to(device) for p in parts)


def _array(tensor: Tensor) -> Array:
    return tensor.detach().cpu().contiguous().numpy()


def _front_to_back(boxes: Array, depths: Array) -> Array:
    """Indices of the splats with a box, by depth; equal depths stay in the order of the surfels."""
    seen = np.flatnonzero(boxes[:, 1] > boxes[:, 0])
    return seen[np.argsort(depths[seen], kind="stable")]


def _pack(arrays: list[Array], target: int, order: Array) -> Array:
    """Rows of 16 numbers (N, 16) of the splats of one target in the given order."""
    transforms, centres, depths, opacities, colors = arrays
    rows = np.empty((len(order), 16))
    rows[:, :9] = transforms[target].reshape(-1, 9)[order]
    rows[:, 9:11], rows[:, 11] = centres[target][order], depths[target][order]
    rows[:, 12], rows[:, 13:] = opacities[order], colors[order]
    return rows


def _each(task: Callable[[int], None], count: int) -> None:
    """Run ``task`` for 0 … count − 1 on as many threads as torch uses."""
    workers = min(count, torch.get_num_threads())
    if workers <= 1:
        for i in range(count):
            task(i)
        return
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(task, range(count)))


def _rasterize(blending: _Blending, splats: Splats, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    s = splats
    return _Rasterize.apply(blending, size, s.boxes, s.transforms, s.centres, s.depths, s.opacities, s.colors)


def rasterize(splats: Splats, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (T, H, W, 3), sum of weighted depths (T, H, W) and alpha (T, H, W) by alpha compositing.

    Differentiable in all floating fields of ``splats``, in float32 and float64, on any device (the work
    is done on the CPU, on ``torch.get_num_threads()`` threads).
    """
    return _rasterize(_Layers(), splats, size)


def rasterize_surface(splats: Splats, focal: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`rasterize`, by a weighted mean over the surfels of the nearest surface.

    The surface at a pixel is the nearest surfel with sigma ≤ 1.1 there. All surfels within a relative
    depth of 0.01 + 4 / focal of it are averaged with the weights w = opacity · exp(−sigma), in no
    order; alpha is 1 − exp(−Σ w). The tolerance admits slopes of 60° across a footprint. Which surfels
    belong to the surface is held constant in the derivative.

    Args:
        splats: N surfels in T targets.
        focal: (T,) focal lengths of the targets in pixels.
        size: (H, W).
    """
    tolerances = [0.01 + 4 / f for f in focal.detach().cpu().tolist()]
    return finished(*_rasterize(_Surface(tolerances), splats, size))
