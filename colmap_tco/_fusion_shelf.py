"""The views that :mod:`colmap_tco.fusion` holds in memory: filtered when read, dropped when it is full."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _fusion_kernels as kernels
from colmap_tco._fusion_gaps import Covered
from colmap_tco._vote_kernels import Surface
from colmap_tco.fusion_config import FusionConfig
from colmap_tco.fusion_input import FusionMaps, FusionView
from colmap_tco.maps import map_intrinsics
from colmap_tco.workers import Workers

_MARKS = {
    "no_depth": kernels.NO_DEPTH,
    "mask": kernels.MASKED,
    "min_confidence": kernels.LOW_CONFIDENCE,
    "no_normal": kernels.NO_NORMAL,
    "max_view_angle": kernels.GRAZING,
    "max_depth_bend": kernels.EDGE,
    "max_depth_ratio": kernels.FAR,
}


_ROWS = 128
"""Rows that a thread filters at a time."""


@dataclass(frozen=True)
class ShelfView:
    """A view as the kernels take it.

    Attributes:
        surface: depth, 0 where it is missing or a filter dropped it; normal and confidence as they were read.
        camera: (6,) of the maps, see :func:`colmap_tco._fusion_kernels.camera`.
        image: (H', W', 3) uint8.
        image_camera: (6,) of ``image``.
        taken: (H, W) uint8, 1 where a point has been made of the pixel.
        dropped: how many pixels each filter removed.
    """

    surface: Surface
    camera: NDArray[np.float64]
    image: NDArray[np.uint8]
    image_camera: NDArray[np.float64]
    taken: NDArray[np.uint8]
    dropped: dict[str, int]

    @property
    def depth(self) -> NDArray[np.float32]:
        """(H, W) of ``surface``."""
        return self.surface[0]

    @property
    def nbytes(self) -> int:
        """Memory of the arrays."""
        return sum(array.nbytes for array in (*self.surface, self.image, self.taken))


class Shelf:
    """Loads views, keeps the most recently used ones up to ``cache_size``, and remembers taken pixels.

    The reference and one neighbour are in use at a time; where these two alone exceed the size, they
    are held all the same.
    """

    def __init__(
        self,
        views: Sequence[FusionView],
        config: FusionConfig,
        workers: Workers,
        covered: tuple[Covered, float] | None = None,
    ) -> None:
        """Of these views; for ``covered`` see :func:`colmap_tco.fusion._in_parts`."""
        self.workers = workers
        self._covered = covered
        self._finished = 0
        self.loads = 0
        self.peak_bytes = 0
        self._views = views
        self._config = config
        self._limit = config.cache_size * 1e9
        self._held: OrderedDict[int, ShelfView] = OrderedDict()
        self._bytes = 0
        self._largest = 0
        """Bytes of the views that are held, and of the largest that was."""
        self._in_use: set[int] = set()
        self._taken: dict[int, NDArray[np.uint8]] = {}
        """One bit a pixel of the views that are not held."""
        self._last = list(range(len(views)))
        """The last reference that needs each view."""
        for reference, view in enumerate(views):
            for other in view.neighbours[: config.check_num_images]:
                self._last[other] = max(self._last[other], reference)

    def get(self, position: int) -> ShelfView:
        """The view at this position of the list, read if it is not held."""
        if position not in self._held:
            self._make_room()
            view = self._prepare(position)
            self._held[position] = view
            self._bytes += view.nbytes
            self._largest = max(self._largest, view.nbytes)
            self._shrink()
            self.loads += 1
            self.peak_bytes = max(self.peak_bytes, self._bytes)
        self._held.move_to_end(position)
        return self._held[position]

    def finish(self, position: int) -> None:
        """Drop the views that no reference after this one needs, and forget which of its pixels are taken."""
        for done in [p for p in self._held if self._last[p] <= position]:
            self._bytes -= self._held.pop(done).nbytes
        self._taken.pop(position, None)
        self._finished = position + 1

    def together(self, reference: int, others: Sequence[int]) -> Iterator[list[tuple[int, ShelfView]]]:
        """The other views with their numbers, in runs of as many as fit beside the reference, at least one.

        Where there are no others, there is one run of none. The views of a run are held until the next is
        asked for.
        """
        run: list[tuple[int, ShelfView]] = []
        try:
            self._in_use = {reference}
            own = used = self.get(reference).nbytes
            for number, other in enumerate(others):
                if run and used + self._largest > self._limit:
                    yield run
                    run, used, self._in_use = [], own, {reference}
                self._in_use.add(other)
                run.append((number, self.get(other)))
                used += run[-1][1].nbytes
            if run or not others:
                yield run
        finally:
            self._in_use = set()

    def _make_room(self) -> None:
        """Drop views as if the next were as large as the largest so far, to keep the limit while reading."""
        while len(self._held) > 1 and self._bytes + self._largest > self._limit and self._drop_oldest():
            pass

    def _shrink(self) -> None:
        while len(self._held) > 2 and self._bytes > self._limit and self._drop_oldest():
            pass

    def _drop_oldest(self) -> bool:
        """Drop the view that was used longest ago and is not in use; False if there is none."""
        position = next((p for p in self._held if p not in self._in_use), None)
        if position is None:
            return False
        view = self._held.pop(position)
        self._bytes -= view.nbytes
        self._taken[position] = np.packbits(view.taken)
        return True

    def _prepare(self, position: int) -> ShelfView:
        view = self._views[position]
        maps = view.load()
        _check_maps(view, maps, self._config)
        shape = maps.depth.shape
        depth = np.empty(shape, np.float32)
        camera = kernels.camera(map_intrinsics(view.camera, shape))
        arrays, bounds = _arrays(maps), _bounds(self._config, view, maps)

        def filtered(part: slice) -> NDArray[np.int64]:
            counts = np.zeros(kernels.NOT_FINITE + 1, np.int64)
            kernels.filtered(arrays, camera, bounds, (part.start, part.stop), depth, counts)
            return counts

        counts = np.sum(self.workers.run(shape[0], _ROWS, filtered), 0)
        if counts[kernels.NOT_FINITE]:
            raise ValueError(
                f"{view.name}: depths, normals and confidences must be finite, confidences above 0; "
                "mark missing depths and normals with 0"
            )
        dropped = {name: int(counts[mark]) for name, mark in _MARKS.items()}
        taken = np.zeros(shape, np.uint8)
        if self._covered is not None and position >= self._finished:
            dropped["max_agreed_error"] = self._start(position, maps, depth, camera, taken)
        if position in self._taken:
            taken = np.unpackbits(self._taken.pop(position), count=taken.size).reshape(shape)
        return ShelfView(
            (depth, arrays[1], arrays[2]),
            camera,
            np.ascontiguousarray(maps.image),
            kernels.camera(map_intrinsics(view.camera, maps.image.shape)),
            taken,
            dropped,
        )

    def _start(
        self,
        position: int,
        maps: FusionMaps,
        depth: NDArray[np.float32],
        camera: NDArray[np.float64],
        taken: NDArray[np.uint8],
    ) -> int:
        """Mark the pixels that shall make no point as taken, and count those whose error is why."""
        assert self._covered is not None
        if maps.error is None:
            raise ValueError(
                f"{self._views[position].name}: agreed maps need the standard error of their depths"
            )
        unsure = (depth > 0) & ~((maps.error > 0) & (maps.error <= self._config.max_agreed_error))
        taken[unsure] = 1
        if position not in self._taken:
            covered, depth_error = self._covered
            covered.mark(position, depth, camera, depth_error, taken, self.workers)
        return int(unsure.sum())


def _arrays(maps: FusionMaps) -> kernels.Maps:
    """The maps as the loop takes them; where there is no confidence, it is 1."""
    shape = maps.depth.shape
    confidence = np.ones(shape, np.float32) if maps.confidence is None else maps.confidence
    return (
        np.ascontiguousarray(maps.depth, np.float32),
        np.ascontiguousarray(maps.normal, np.float32),
        np.ascontiguousarray(confidence, np.float32),
        np.zeros((0, 0), bool) if maps.mask is None else np.ascontiguousarray(maps.mask, bool),
    )


def _bounds(config: FusionConfig, view: FusionView, maps: FusionMaps) -> kernels.Bounds:
    least = 1.0 if maps.confidence is None else config.min_confidence
    bend = config.max_depth_bend if config.max_depth_bend > 0 else math.inf
    far = config.max_depth_ratio * view.reach if config.max_depth_ratio > 0 else math.inf
    sure = float(np.float32(view.sure))  # as the maps have it
    return least, bend, math.cos(math.radians(config.max_view_angle)), far, sure


def _check_maps(view: FusionView, maps: FusionMaps, config: FusionConfig) -> None:
    shape = maps.depth.shape
    if maps.confidence is None and config.sigma_at_one > 0:
        raise ValueError(f"{view.name}: sigma_at_one needs a confidence, it has none")
    if maps.normal.shape != (*shape, 3):
        raise ValueError(f"{view.name}: normals {maps.normal.shape} do not fit the depths {shape}")
    for name, array in (("confidence", maps.confidence), ("mask", maps.mask), ("error", maps.error)):
        if array is not None and array.shape != shape:
            raise ValueError(f"{view.name}: {name} {array.shape} does not fit the depths {shape}")
    if maps.image.dtype != np.uint8 or maps.image.ndim != 3 or maps.image.shape[2] != 3:
        raise ValueError(
            f"{view.name}: the image must be (H, W, 3) uint8, not {maps.image.shape} {maps.image.dtype}"
        )
