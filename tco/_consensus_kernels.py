"""The compiled loop of :mod:`tco.consensus` on a CPU: all rounds of one pixel after the other."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from tco.geometry import invert
from tco.options import ConsensusConfig
from tco.render.kernels import Array, compiled
from tco.types import Cameras

ALL = 1 - 1e-5
"""Share of what is mixed at a place from which on all of it counts; less is at a border."""


def ask(evidence: Tensor, cameras: Cameras, view: int, others: list[int], config: ConsensusConfig) -> Tensor:
    """Depth (H, W) of a view after all rounds; see :func:`tco.consensus.ask_views`, the plain twin."""
    maps = evidence.permute(0, 2, 3, 1).contiguous().numpy()
    h, w = maps.shape[1:3]
    other_from_view = invert(cameras.world_from_cam[others].double()) @ cameras.world_from_cam[view].double()
    ways = np.concatenate(
        [other_from_view[:, :3, :4].reshape(-1, 12).numpy(), _intrinsics(cameras.K[others])], 1
    )
    out = np.empty((h, w), maps.dtype)
    own = _intrinsics(cameras.K[[view]])[0]
    rules = (config.consensus_rounds, config.consensus_reach, config.consensus_width)
    threads = max(1, min(torch.get_num_threads(), os.cpu_count() or 1))
    bounds = np.linspace(0, h, threads + 1).astype(int)
    chosen = np.array(others, np.int64)

    def rows(k: int) -> None:
        _rows(maps, (view, own), (chosen, ways), rules, (bounds[k], bounds[k + 1]), out)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(rows, range(threads)))
    return torch.from_numpy(out).to(evidence)


def _intrinsics(K: Tensor) -> Array:
    """Focal lengths and principal points (V, 4)."""
    packed: Array = torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], 1).double().numpy()
    return packed


@compiled
def _rows(
    maps: Array,
    asking: tuple[int, Array],
    asked: tuple[Array, Array],
    rules: tuple[int, float, float],
    rows: tuple[int, int],
    out: Array,
) -> None:
    """Fill rows of ``out``.

    ``asking``: the view and its intrinsics; ``asked``: S views and their (S, 16) transforms and intrinsics;
    ``rules``: rounds, reach, width.
    """
    (view, K), (others, ways), (rounds, reach, width) = asking, asked, rules
    w = maps.shape[2]
    values, weights = np.empty(len(others) + 1), np.empty(len(others) + 1)
    point, seen = np.empty(3), np.empty(3)
    for y in range(rows[0], rows[1]):
        for x in range(w):
            own = 1.0 / maps[view, y, x, 0]
            depth = own
            for _ in range(rounds):
                values[0], weights[0], count = math.log(own / depth), maps[view, y, x, 1], 1
                point[0] = (x + 0.5 - K[2]) / K[0] * depth
                point[1] = (y + 0.5 - K[3]) / K[1] * depth
                point[2] = depth
                for k in range(len(others)):
                    z = _look(maps[others[k]], ways[k], point, seen)
                    if z <= 0.0 or seen[2] <= ALL:
                        continue
                    change = -math.log(max(seen[0] * z, 1e-9))
                    if abs(change) < reach:
                        values[count], weights[count] = change, seen[1]
                        count += 1
                depth *= math.exp(_robust_mean(values, weights, count, width))
            out[y, x] = depth


@compiled
def _look(maps: Array, way: Array, point: Array, seen: Array) -> float:
    """Depth of a point in another view, 0 if that does not see it; ``seen`` (3,) is what it has there.

    The four pixels around the place are mixed, with nothing beyond the border.
    """
    h, w = maps.shape[0], maps.shape[1]
    z = way[8] * point[0] + way[9] * point[1] + way[10] * point[2] + way[11]
    if z <= 1e-6:
        return 0.0
    u = (way[0] * point[0] + way[1] * point[1] + way[2] * point[2] + way[3]) / z * way[12] + way[14] - 0.5
    v = (way[4] * point[0] + way[5] * point[1] + way[6] * point[2] + way[7]) / z * way[13] + way[15] - 0.5
    if not (u > -1.0 and u < w and v > -1.0 and v < h):
        return 0.0
    x, y = math.floor(u), math.floor(v)
    fx, fy = u - x, v - y
    seen[:] = 0.0
    for i in range(2):
        for j in range(2):
            r, c = y + i, x + j
            if 0 <= r < h and 0 <= c < w:
                share = (fy if i else 1.0 - fy) * (fx if j else 1.0 - fx)
                for n in range(3):
                    seen[n] += share * maps[r, c, n]
    return z


@compiled
def _robust_mean(values: Array, weights: Array, count: int, width: float) -> float:
    """See :func:`tco.consensus.robust_mean`; the first ``count`` values, which are sorted in place."""
    total = 0.0
    for i in range(count):
        v, q, j = values[i], weights[i], i
        total += q
        while j > 0 and values[j - 1] > v:
            values[j], weights[j] = values[j - 1], weights[j - 1]
            j -= 1
        values[j], weights[j] = v, q
    running, at = 0.0, 0
    for i in range(count):
        running += weights[i]
        at = i
        if running >= total / 2:
            break
    median, over, under = values[at], 0.0, 0.0
    for i in range(count):
        off = (values[i] - median) / width
        near = weights[i] / (1.0 + off * off)
        over += near * values[i]
        under += near
    return over / under
