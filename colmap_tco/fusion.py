"""Depth maps → one cloud: cross-view consistency, merging, normals, colours.

Each view in turn is the reference. A pixel of it becomes a point if enough neighbouring views agree:
its depth, moved into the neighbour, meets the surface that the neighbour's depth and normal describe
there (``max_depth_error``), that surface point falls back onto the pixel (``max_reproj_error``), and
the two normals agree (``max_normal_error``). The point is the confidence-weighted mean of the agreeing
surfaces, its colour the median of their full-resolution images, and the pixels of the other views
that it was made of are not used as references again.

Views are loaded when they are needed and kept while they fit ``cache_size``, so that memory does not
grow with the number of views. The result does not depend on the number of threads.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_tco.errors import DensifyError
from colmap_tco.fusion_config import FusionConfig
from colmap_tco.fusion_input import FusionMaps, FusionView
from colmap_tco.fusion_report import FusionReport, Tolerance, why_empty
from colmap_tco.fusion_votes import Votes
from colmap_tco.ply import Cloud, Visibility, join
from colmap_tco.thin import thin
from colmap_tco.workers import Workers

if TYPE_CHECKING:
    from colmap_tco._fusion_kernels import Limits
    from colmap_tco._fusion_shelf import Shelf, ShelfView

__all__ = ["EmptyCloudError", "FusionConfig", "FusionMaps", "FusionView", "fuse", "fuse_views"]

T = TypeVar("T")
log = logging.getLogger(__name__)

_BLOCK = 2_000_000
"""Pixels of a reference that are voted on together; bounds the memory of the votes (some 100 MB)."""
_RANGE = 65_536
"""Pixels that a thread takes at a time."""
_COLOR_SAMPLES = 15
"""Views that a colour is the median of, at most."""
_FEWEST_VIEWS = 3
"""Where fewer views than ``min_num_pixels`` can see a point, all of them but at least these must agree."""


class EmptyCloudError(DensifyError):
    """Fusion left no point.

    Attributes:
        cloud: of no points.
        report: what removed them.
    """

    def __init__(self, cloud: Cloud, report: FusionReport) -> None:
        super().__init__(why_empty(report))
        self.cloud, self.report = cloud, report


def fuse(views: Sequence[FusionView], config: FusionConfig | None = None) -> tuple[Cloud, FusionReport]:
    """Fuse all views into one cloud; see :func:`fuse_views`.

    Raises:
        EmptyCloudError: no point is left; the message names the filter that removed most.
    """
    config = config or FusionConfig()
    report = FusionReport()
    cloud = join(fuse_views(views, config, report))
    kept = thin(cloud.points, config.voxel_size, config.max_points)
    if len(kept) < len(cloud):
        report.thin(kept)
        cloud = cloud.select(kept)
    if not len(cloud):
        raise EmptyCloudError(cloud, report)
    if report.lowered:
        log.info("%d of %d points are confirmed by fewer than min_num_pixels=%d views, for no more see them",
                 report.lowered, len(cloud), config.min_num_pixels)  # fmt: skip
    return cloud, report


def fuse_views(views: Sequence[FusionView], config: FusionConfig, report: FusionReport) -> Iterator[Cloud]:
    """Fuse view after view: one cloud for each of ``views`` in turn, in the world frame.

    Args:
        views: all views; their neighbours are positions in this list.
        config: bounds and filters.
        report: is filled while the clouds are taken.

    Raises:
        ValueError: settings or neighbours out of range, or arrays of a view that do not fit together.
    """
    from colmap_tco import _fusion_noise
    from colmap_tco._fusion_shelf import Shelf

    _check(views, config)
    with Workers(config.num_threads) as workers:
        shelf = Shelf(views, config, workers)
        tolerance = report.tolerance = _fusion_noise.tolerance(shelf, views, config)
        log.debug("fusion tolerates %s", tolerance)
        for position, view in enumerate(views):
            cloud = _fuse_reference(shelf, views, position, config, tolerance, report)
            report.points[view.name] = len(cloud)
            report.pixels["points"] += len(cloud)
            report.loads, report.peak_bytes = shelf.loads, shelf.peak_bytes
            shelf.finish(position)
            yield cloud


def _check(views: Sequence[FusionView], config: FusionConfig) -> None:
    for name in ("min_num_pixels", "check_num_images", "max_reproj_error", "max_depth_error", "cache_size"):
        if not getattr(config, name) > 0:
            raise ValueError(f"{name} must be positive, not {getattr(config, name)}")
    for name in ("voxel_size", "max_points", "max_depth_ratio", "min_tri_angle"):
        if not getattr(config, name) >= 0:
            raise ValueError(f"{name} must not be negative, it is {getattr(config, name)}")
    if config.roi and not (len(config.roi) == 6 and np.all(np.less(config.roi[:3], config.roi[3:]))):
        raise ValueError(
            f"roi must be xmin,ymin,zmin,xmax,ymax,zmax with each minimum below its maximum, not {config.roi}"
        )
    for position, view in enumerate(views):
        wrong = [n for n in view.neighbours if not 0 <= n < len(views) or n == position]
        if wrong or len(set(view.neighbours)) != len(view.neighbours):
            raise ValueError(f"{view.name}: neighbours {view.neighbours} are not other views, each once")


def _fuse_reference(
    shelf: Shelf,
    views: Sequence[FusionView],
    position: int,
    config: FusionConfig,
    tolerance: Tolerance,
    report: FusionReport,
) -> Cloud:
    """The points of one reference view."""
    # A set in ascending order: the result does not depend on the order within the list.
    neighbours = sorted(views[position].neighbours[: config.check_num_images])
    reference = shelf.get(position)
    for reason, count in reference.dropped.items():
        report.pixels[reason] += count
    report.pixels["all"] += reference.taken.size
    has_depth = (reference.packed[..., 0] > 0).ravel()
    free = has_depth & (reference.taken.ravel() == 0)
    report.pixels["already_fused"] += int(has_depth.sum() - free.sum())
    pixels = np.flatnonzero(free)
    blocks = np.array_split(pixels, max(1, math.ceil(len(pixels) / _BLOCK)))
    fuser = _Reference(shelf, views, position, neighbours, config, tolerance, report)
    return join(fuser.fuse(block) for block in blocks)


@dataclass(frozen=True)
class _Reference:
    """One reference view and its neighbours."""

    shelf: Shelf
    views: Sequence[FusionView]
    position: int
    neighbours: list[int]
    config: FusionConfig
    tolerance: Tolerance
    report: FusionReport

    def fuse(self, pixels: NDArray[np.int64]) -> Cloud:
        """The points of these pixels (M,), flat indices into the reference."""
        votes = self._vote(pixels)
        keep = self._accept(votes)
        pixels, votes = pixels[keep], votes.select(keep)
        points, normals = self._average(pixels, votes)
        colors = self._colors_and_marks(points, votes)
        view = self.views[self.position]
        rotation, centre = view.cam_from_world[:3, :3], _centre(view)
        cloud = Cloud(
            points.astype(np.float64) @ rotation + centre,
            (normals @ rotation).astype(np.float32),
            colors,
            self._visibility(votes),
        )
        return self._crop(cloud) if self.config.roi else cloud

    def _crop(self, cloud: Cloud) -> Cloud:
        """The points in the region of interest, at the very end, so that the region changes none of them."""
        low, high = np.array(self.config.roi[:3]), np.array(self.config.roi[3:])
        inside = np.flatnonzero(((cloud.points >= low) & (cloud.points <= high)).all(1))
        self.report.pixels["roi"] += len(cloud) - len(inside)
        return cloud.select(inside)

    def _vote(self, pixels: NDArray[np.int64]) -> Votes:
        from colmap_tco import _fusion_kernels as kernels

        votes = Votes.none(len(pixels), len(self.neighbours))
        for slot in range(len(self.neighbours)):
            found = self._vote_of(slot, pixels, votes)
            failed = self.report.comparisons
            failed["max_depth_error"] += int(found[[kernels.OCCLUDED, kernels.THROUGH, kernels.DEPTH]].sum())
            failed["max_reproj_error"] += int(found[kernels.REPROJECTION])
            failed["max_normal_error"] += int(found[kernels.NORMAL])
        return votes

    def _vote_of(self, slot: int, pixels: NDArray[np.int64], votes: Votes) -> NDArray[np.int64]:
        """Add the votes of the neighbour in this slot; returns how often each outcome came up."""
        from colmap_tco import _fusion_kernels as kernels

        limits, other = self._limits(), self.shelf.get(self.neighbours[slot])
        ref, theirs, pair = self._own().packed, other.packed, self._pair(slot, other.camera)

        def run(part: slice) -> NDArray[np.int64]:
            outcomes = np.zeros(kernels.AGREES + 1, np.int64)
            kernels.vote(ref, pixels[part], theirs, pair, limits, slot, tuple(votes.select(part)), outcomes)
            return outcomes

        return np.sum([np.zeros(kernels.AGREES + 1, np.int64), *self._run(len(pixels), run)], 0)

    def _run(self, length: int, function: Callable[[slice], T]) -> list[T]:
        return self.shelf.workers.run(length, _RANGE, function)

    def _accept(self, votes: Votes) -> NDArray[np.bool_]:
        """Which pixels have the support that they need; counts the others."""
        wanted = self.config.min_num_pixels
        fewest = min(wanted, max(2, min(_FEWEST_VIEWS, 1 + len(self.neighbours))))
        required = np.minimum(wanted, np.maximum(fewest, votes.seen + 1))
        supported = votes.support >= required
        through = np.zeros(len(supported), bool)
        if self.config.max_conflicts > 0:
            through = votes.conflicts > self.config.max_conflicts * votes.support
        keep = supported & ~through
        self.report.pixels["max_conflicts"] += int(through.sum())
        self.report.pixels["min_num_pixels"] += int((~supported & ~through).sum())
        if self.config.min_tri_angle > 0:
            least = math.cos(math.radians(self.config.min_tri_angle))
            narrow = keep & (votes.support > 1) & (votes.cosine > least)
            self.report.pixels["min_tri_angle"] += int(narrow.sum())
            keep &= ~narrow
        self.report.lowered += int((keep & (votes.support < wanted)).sum())
        return keep

    def _average(
        self, pixels: NDArray[np.int64], votes: Votes
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        from colmap_tco import _merge_kernels as kernels

        points, normals = np.empty((len(pixels), 3), np.float32), np.empty((len(pixels), 3), np.float32)
        ref, camera = self._own().packed, self._own().camera
        self._run(
            len(pixels),
            lambda p: kernels.average(ref, camera, pixels[p], tuple(votes.select(p)), points[p], normals[p]),
        )
        return points, normals

    def _colors_and_marks(self, points: NDArray[np.float32], votes: Votes) -> NDArray[np.uint8]:
        """Colours (M, 3) of the points, whose pixels in the other views are marked as taken."""
        from colmap_tco import _fusion_kernels, _merge_kernels

        own = self._own()
        samples = np.empty((len(points), min(_COLOR_SAMPLES, 1 + len(self.neighbours)), 3), np.uint8)
        count = np.zeros(len(points), np.uint8)
        footprint = points[:, 2] * np.float32(own.camera[4])

        def sample(view: ShelfView, who: NDArray[np.bool_], pair: NDArray[np.float64]) -> None:
            kernel, image = _merge_kernels.sample_colors, view.image
            self._run(len(points), lambda p: kernel(points[p], who[p], pair, image, samples[p], count[p]))

        def mark(view: ShelfView, who: NDArray[np.bool_], pair: NDArray[np.float64]) -> None:
            kernel, view_of, taken, error = (
                _merge_kernels.mark_taken,
                view.packed,
                view.taken,
                self.tolerance.depth,
            )
            self._run(
                len(points), lambda p: kernel(points[p], who[p], footprint[p], view_of, pair, error, taken)
            )

        sample(
            own, np.ones(len(points), bool), _fusion_kernels.pair(own.camera, own.image_camera, np.eye(3, 4))
        )
        for slot, neighbour in enumerate(self.neighbours):
            other, who = self.shelf.get(neighbour), votes.agrees(slot)
            sample(other, who, self._pair(slot, other.image_camera))
            mark(other, who, self._pair(slot, other.camera))
        colors = np.empty((len(points), 3), np.uint8)
        self._run(len(points), lambda p: _merge_kernels.median_colors(samples[p], count[p], colors[p]))
        return colors

    def _visibility(self, votes: Votes) -> Visibility:
        from colmap_tco import _merge_kernels

        own = self.views[self.position].index
        theirs = np.array([self.views[p].index for p in self.neighbours], np.uint32)
        slots = np.argsort(theirs, kind="stable")
        before = int((theirs < own).sum())
        start = np.zeros(len(votes.support) + 1, np.int64)
        np.cumsum(votes.support, out=start[1:])
        images = np.empty(start[-1], np.uint32)
        _merge_kernels.list_views(votes.who, slots, theirs, (before, own), start, images)
        return Visibility(start, images)

    def _own(self) -> ShelfView:
        return self.shelf.get(self.position)

    def _pair(self, slot: int, camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """The reference and the neighbour in this slot, of which ``camera`` is the map's or the image's."""
        from colmap_tco import _fusion_kernels as kernels

        other = self.views[self.neighbours[slot]]
        return kernels.pair(
            self._own().camera, camera, other_from_reference(other, self.views[self.position])
        )

    def _limits(self) -> Limits:
        return (
            self.tolerance.depth,
            self.tolerance.reproj,
            math.cos(math.radians(self.tolerance.normal)),
            self.config.sigma_at_one,
            self.config.most_depth_error,
        )


def other_from_reference(other: FusionView, reference: FusionView) -> NDArray[np.float64]:
    """The (3, 4) transform between two cameras, without loss where world coordinates are large."""
    rotation = other.cam_from_world[:3, :3] @ reference.cam_from_world[:3, :3].T
    shift = other.cam_from_world[:3, :3] @ (_centre(reference) - _centre(other))
    return np.ascontiguousarray(np.concatenate([rotation, shift[:, None]], 1))


def _centre(view: FusionView) -> NDArray[np.float64]:
    """World position (3,) of the camera."""
    return -view.cam_from_world[:3, :3].T @ view.cam_from_world[:3, 3]
