"""Which pixels lie where a cloud has points already, so that :mod:`colmap_tco.fusion` fills gaps only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _fusion_kernels, _merge_kernels
from colmap_tco.fusion_input import FusionView, centre, other_from_reference
from colmap_tco.workers import Workers


@dataclass(frozen=True)
class _Part:
    """The points of one reference view: (3, M) in its frame, and the camera (6,) of its maps."""

    points: NDArray[np.float32]
    camera: NDArray[np.float64]


class Covered:
    """The points of a fused cloud, view by view, as they cover the maps of the same views."""

    def __init__(self, views: Sequence[FusionView], check_num_images: int) -> None:
        """Of these views; a view's points count in those that it is compared with, or that are with it."""
        self._views = views
        self._parts: dict[int, _Part] = {}
        self._near = [{i} for i in range(len(views))]
        for i, view in enumerate(views):
            for j in view.neighbours[:check_num_images]:
                self._near[i].add(j)
                self._near[j].add(i)

    def __bool__(self) -> bool:
        """Whether there are points."""
        return any(part.points.size for part in self._parts.values())

    def add(self, position: int, points: NDArray[np.float64], camera: NDArray[np.float64]) -> None:
        """The points (M, 3) of a view in the frame of the model, and the camera (6,) of its maps."""
        view = self._views[position]
        local = view.cam_from_world[:3, :3] @ (points - centre(view)).T
        self._parts[position] = _Part(local.astype(np.float32), camera)

    def mark(
        self,
        position: int,
        depth: NDArray[np.float32],
        camera: NDArray[np.float64],
        depth_error: float,
        taken: NDArray[np.uint8],
        workers: Workers,
    ) -> None:
        """Set ``taken`` (H, W) at the pixels of a view that a point covers at about their depth.

        Args:
            position: of the view.
            depth: (H, W) of it.
            camera: (6,) of its maps.
            depth_error: relative difference up to which pixel and point are the same surface.
            taken: is changed.
            workers: share the views whose points these are.
        """

        def mark(other: int) -> None:
            part = self._parts[other]
            move = other_from_reference(self._views[position], self._views[other])
            pair = _fusion_kernels.pair(part.camera, camera, move)
            every, limits = np.ones(part.points.shape[1], np.uint64), (depth_error, 0.5)
            _merge_kernels.mark_taken(part.points, every, np.uint64(1), depth, pair, limits, taken)

        workers.map(mark, sorted(self._near[position] & self._parts.keys()))
