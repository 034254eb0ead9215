"""The views that :mod:`colmap_tco.fusion` holds in memory: filtered when read, dropped when it is full."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from colmap_tco import _fusion_kernels as kernels
from colmap_tco.fusion import FusionConfig, FusionMaps, FusionView
from colmap_tco.maps import map_intrinsics

_MARKS = {
    "no_depth": kernels.NO_DEPTH,
    "mask": kernels.MASKED,
    "min_confidence": kernels.LOW_CONFIDENCE,
    "no_normal": kernels.NO_NORMAL,
    "max_view_angle": kernels.GRAZING,
    "max_depth_bend": kernels.EDGE,
}


@contextmanager
def threads(wanted: int) -> Iterator[None]:
    """Run the kernels with this many threads, all that there are if not positive."""
    before = numba.get_num_threads()
    most = numba.config.NUMBA_NUM_THREADS
    numba.set_num_threads(min(wanted, most) if wanted > 0 else most)
    try:
        yield
    finally:
        numba.set_num_threads(before)


@dataclass(frozen=True)
class ShelfView:
    """A view as the kernels take it.

    Attributes:
        maps: depth without the pixels that filters dropped, normals, confidence, intrinsics.
        image: (H', W', 3) uint8.
        image_intrinsics: (4,) fx, fy, cx, cy of ``image``.
        taken: (H, W) uint8, 1 where a point has been made of the pixel.
        dropped: how many pixels each filter removed.
    """

    maps: kernels.Maps
    image: NDArray[np.uint8]
    image_intrinsics: NDArray[np.float64]
    taken: NDArray[np.uint8]
    dropped: dict[str, int]

    @property
    def nbytes(self) -> int:
        """Memory of the arrays."""
        return int(sum(a.nbytes for a in self.maps) + self.image.nbytes + self.taken.nbytes)


class Shelf:
    """Loads views, keeps the most recently used ones up to ``cache_size``, and remembers taken pixels.

    The reference and one neighbour are in use at a time; where these two alone exceed the size, they
    are held all the same.
    """

    def __init__(self, views: Sequence[FusionView], config: FusionConfig) -> None:
        self.loads = 0
        self.peak_bytes = 0
        self._views = views
        self._config = config
        self._limit = config.cache_size * 1e9
        self._held: OrderedDict[int, ShelfView] = OrderedDict()
        self._bytes = 0
        self._taken: dict[int, NDArray[np.uint8]] = {}
        """One bit a pixel of the views that are not held."""

    def get(self, position: int) -> ShelfView:
        """The view at this position of the list, read if it is not held."""
        if position not in self._held:
            self._make_room()
            view = self._prepare(position)
            self._held[position] = view
            self._bytes += view.nbytes
            self._shrink()
            self.loads += 1
            self.peak_bytes = max(self.peak_bytes, self._bytes)
        self._held.move_to_end(position)
        return self._held[position]

    def finish(self, position: int) -> None:
        """Forget which pixels of a view are taken: it has been the reference."""
        self._taken.pop(position, None)

    def _make_room(self) -> None:
        """Drop views as if the next were as large as the largest held, to keep the limit while reading."""
        expected = max((view.nbytes for view in self._held.values()), default=0)
        while len(self._held) > 1 and self._bytes + expected > self._limit:
            self._drop_oldest()

    def _shrink(self) -> None:
        while len(self._held) > 2 and self._bytes > self._limit:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        position, view = self._held.popitem(last=False)
        self._bytes -= view.nbytes
        self._taken[position] = np.packbits(view.taken)

    def _prepare(self, position: int) -> ShelfView:
        view = self._views[position]
        maps = view.load()
        _check_maps(view, maps)
        shape = maps.depth.shape
        intrinsics = map_intrinsics(view.camera, shape)
        confidence = np.zeros((0, 0), np.float32) if maps.confidence is None else maps.confidence
        whole = kernels.Maps(
            np.ascontiguousarray(maps.depth, np.float32),
            np.ascontiguousarray(maps.normal, np.float32),
            np.ascontiguousarray(confidence, np.float32),
            np.concatenate([intrinsics, 1.0 / intrinsics[:2]]),
        )
        marks = np.zeros(shape, np.uint8)
        if maps.mask is not None:
            marks[~maps.mask] = kernels.MASKED
        kernels.classify(whole, _bounds(self._config), marks)
        taken = np.zeros(shape, np.uint8)
        if position in self._taken:
            taken = np.unpackbits(self._taken.pop(position), count=marks.size).reshape(shape)
        numbers = np.bincount(marks.ravel(), minlength=kernels.EDGE + 1)
        return ShelfView(
            whole._replace(depth=np.where(marks == kernels.KEEP, whole.depth, np.float32(0))),
            np.ascontiguousarray(maps.image),
            map_intrinsics(view.camera, maps.image.shape),
            taken,
            {name: int(numbers[mark]) for name, mark in _MARKS.items()},
        )


def _bounds(config: FusionConfig) -> tuple[float, float, float]:
    bend = config.max_depth_bend if config.max_depth_bend > 0 else math.inf
    return config.min_confidence, bend, math.cos(math.radians(config.max_view_angle))


def _check_maps(view: FusionView, maps: FusionMaps) -> None:
    shape = maps.depth.shape
    if maps.normal.shape != (*shape, 3):
        raise ValueError(f"{view.name}: normals {maps.normal.shape} do not fit the depths {shape}")
    for name, array in (("confidence", maps.confidence), ("mask", maps.mask)):
        if array is not None and array.shape != shape:
            raise ValueError(f"{view.name}: {name} {array.shape} does not fit the depths {shape}")
    if maps.image.dtype != np.uint8 or maps.image.ndim != 3 or maps.image.shape[2] != 3:
        raise ValueError(
            f"{view.name}: the image must be (H, W, 3) uint8, not {maps.image.shape} {maps.image.dtype}"
        )
    if not np.isfinite(maps.depth).all() or not np.isfinite(maps.normal).all():
        raise ValueError(f"{view.name}: depths and normals must be finite; mark missing ones with 0")
