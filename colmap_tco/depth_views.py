"""Measured depth maps in the pixels of the views: whatever their own resolution, and never interpolated."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco.errors import InputError
from colmap_tco.evaluation.maps import candidates, read_depth
from colmap_tco.views import View, network_from_original, original_from_network

if TYPE_CHECKING:
    from torch import Tensor

log = logging.getLogger(__name__)

Depth = NDArray[np.float32]

ASPECT = 0.01
"""Relative difference of shapes above which a map is not of the same picture."""
LEAST_DEPTHS = 100
"""Measured pixels below which a map is as good as none."""


def find_depths(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Name → file of the depth map, for the images that have one.

    A map has the name of its image with another ending, or with the word depth for color; see
    :func:`colmap_tco.evaluation.maps.candidates`.

    Raises:
        InputError: there is no such folder, or fewer than two images have a map.
    """
    if not folder.is_dir():
        raise InputError(f"--depths {folder}: there is no such folder")
    files = {name: next((p for p in candidates(folder, name) if p.is_file()), None) for name in names}
    found = {name: file for name, file in files.items() if file is not None}
    if len(found) < 2:
        tried = ", ".join(p.name for p in candidates(folder, names[0])[:6])
        raise InputError(
            f"--depths {folder}: {len(found)} of {len(names)} images have a depth map there, and poses take "
            f"two; for {names[0]} it looked for {tried}, …"
        )
    return found


def read_depths(files: Mapping[str, Path], views: Sequence[View], unit: float) -> dict[str, Depth]:
    """Name → depth map (H, W) as it was measured, 0 where it was not; maps that hold nothing are left out.

    Args:
        files: name → file, as :func:`find_depths` gives it.
        views: whose maps are wanted.
        unit: of the values of 16-bit PNG files; the others hold lengths.

    Raises:
        InputError: a map cannot be read or has another shape than its image, or fewer than two hold depths.
    """
    maps = {}
    for view in views:
        if view.name not in files:
            continue
        path = files[view.name]
        depth = read_depth(path, unit if path.suffix.lower() == ".png" else 0.0)
        width, height = _pycolmap.camera_size(view.original)
        if abs(depth.shape[1] / depth.shape[0] / (width / height) - 1) > ASPECT:
            raise InputError(
                f"{path}: {depth.shape[1]}×{depth.shape[0]} pixels do not show the same picture as "
                f"{view.name} with {width}×{height}; register the depth maps to the images first"
            )
        if np.count_nonzero(depth) >= LEAST_DEPTHS:
            maps[view.name] = depth
        else:
            log.warning("%s: %d pixels are measured, as good as none", path, np.count_nonzero(depth))
    if len(maps) < 2:
        raise InputError(
            f"{len(maps)} images have a depth map with measured pixels, and poses take two; 0, NaN and 65535 "
            "count as not measured"
        )
    return maps


def depth_in(view: View, measured: Depth) -> Depth:
    """The depth map (H, W) of ``view.network`` from what was measured.

    A pixel takes the lower median of the measurements that fall into it, or, where the map is coarser than
    the pixels, the measurement that it falls into. So every value was measured, edges stay edges, and
    scattered measurements (LiDAR) fill small images.
    """
    h, w = view.network.height, view.network.width
    size = np.array(_pycolmap.camera_size(view.original), float)
    per_pixel = size / measured.shape[::-1]
    rows, columns = np.nonzero(measured)
    original = np.stack([columns + 0.5, rows + 0.5], 1) * per_pixel
    at = network_from_original(view, original)
    with np.errstate(invalid="ignore"):
        inside = ((at >= 0) & (at < (w, h))).all(1)
    x, y = np.floor(at[inside]).astype(np.intp).T
    out = _medians(y * w + x, measured[rows[inside], columns[inside]], h * w).reshape(h, w)
    empty_y, empty_x = np.nonzero(out == 0)
    back = original_from_network(view, np.stack([empty_x + 0.5, empty_y + 0.5], 1)) / per_pixel
    with np.errstate(invalid="ignore"):
        inside = ((back >= 0) & (back < measured.shape[::-1])).all(1)
    u, v = np.floor(back[inside]).astype(np.intp).T
    out[empty_y[inside], empty_x[inside]] = measured[v, u]
    return out


def _medians(cell: NDArray[np.intp], values: Depth, cells: int) -> Depth:
    """Lower median (cells,) of the values that belong to each cell; 0 where there are none."""
    order = np.lexsort((values, cell))
    count = np.bincount(cell, minlength=cells)
    first = np.cumsum(count) - count
    out = np.zeros(cells, np.float32)
    some = count > 0
    out[some] = values[order][first[some] + (count[some] - 1) // 2]
    return out


def on_canvas(views: Sequence[View], maps: Mapping[str, Depth], canvas: tuple[int, int]) -> Tensor:
    """Depths (V, H, W) of the views' network images on a canvas (H, W); 0 where there are none."""
    import torch

    from colmap_tco.views import crop

    depth = torch.zeros(len(views), *canvas)
    for i, view in enumerate(views):
        if view.name in maps:
            crop(view, depth[i])[:] = torch.from_numpy(depth_in(view, maps[view.name]))
    return depth
