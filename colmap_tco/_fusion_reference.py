"""One reference view of :mod:`colmap_tco.fusion` at a time: votes, means, colours, marks, visibility.

The pixels of the reference are split into ranges. A thread takes a range through all neighbours that are
in memory together, and where these are all, through all steps: so what is noted of its pixels, and what is
read of the neighbours, stays in the thread's own cache.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _fusion_kernels, _mean_kernels, _merge_kernels, _vote_kernels
from colmap_tco._fusion_gaps import Covered
from colmap_tco._fusion_shelf import Shelf, ShelfView
from colmap_tco.fusion_config import FusionConfig
from colmap_tco.fusion_input import FusionView, centre, other_from_reference
from colmap_tco.fusion_report import FusionReport, Tolerance
from colmap_tco.ply import Cloud, Visibility

_BLOCK_BYTES = 1 << 28
"""Most memory of the votes on those pixels of a reference that are voted on together. So much is needed where
the neighbours do not fit the cache together; where they do, a thread has the votes of one range at a time."""
_RANGE = 64 * _vote_kernels.TILE
"""Pixels that a thread takes at a time."""
_COLOR_SAMPLES = 15
"""Views that a colour is the median of, at most."""
_FEWEST_VIEWS = 3
"""Where fewer views than ``min_num_pixels`` can see a point, all of them but at least these must agree."""


@dataclass(frozen=True)
class Bounds:
    """What agrees, and what is taken for noise.

    Attributes:
        tolerance: of comparisons.
        widths: of the means, see :func:`colmap_tco._mean_kernels.average`.
    """

    tolerance: Tolerance
    widths: tuple[float, float]


@dataclass(frozen=True)
class _Neighbour:
    """A neighbour of the reference that is in memory.

    Attributes:
        slot: its number among the neighbours.
        view: it.
        maps: the reference and its maps, see :func:`colmap_tco._fusion_kernels.pair`.
        image: the reference and its image.
    """

    slot: int
    view: ShelfView
    maps: _vote_kernels.Pair
    image: _vote_kernels.Pair

    @property
    def bit(self) -> np.uint64:
        """Its bit in its word."""
        return np.uint64(1) << np.uint64(self.slot & 63)


Group = list[_Neighbour]
"""Neighbours that are in memory together."""

Lost = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Of a range: ``failed`` of :class:`_Part` and ``removed`` of :class:`_Points`."""


@dataclass(frozen=True)
class _Part:
    """A range of M pixels of the reference, and the votes on them.

    Attributes:
        count: M.
        tiles: see :mod:`colmap_tco._vote_kernels`.
        votes: see there.
        who: (words, at least M) one bit for each neighbour that agrees.
        failed: (3,) comparisons that failed by depth, reprojection and normal.
    """

    count: int
    tiles: _vote_kernels.Tiles
    votes: _vote_kernels.Votes
    who: NDArray[np.uint64]
    failed: NDArray[np.int64]


@dataclass(frozen=True)
class _Points:
    """The K pixels of a part that became points.

    Attributes:
        who: (words, K) one bit for each neighbour that agrees.
        failed: of the part.
        supports: (K,) views that agree on each, the reference included.
        local: (3, K) in the frame of the reference.
        points: (K, 3) in the frame of the model.
        normals: (K, 3) there.
        samples: (tiles, S, 3, TILE) colours, see :mod:`colmap_tco._merge_kernels`.
        sampled: (K,) how many of the S are filled.
        removed: (4,) see :func:`colmap_tco._vote_kernels.accept`.
    """

    who: NDArray[np.uint64]
    failed: NDArray[np.int64]
    supports: NDArray[np.int64]
    local: NDArray[np.float32]
    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    samples: NDArray[np.uint8]
    sampled: NDArray[np.uint8]
    removed: NDArray[np.int64]


class Reference:
    """A reference view and its neighbours."""

    def __init__(
        self,
        shelf: Shelf,
        views: Sequence[FusionView],
        position: int,
        config: FusionConfig,
        bounds: Bounds,
    ) -> None:
        self._shelf, self._views, self._position = shelf, views, position
        self._config, self._tolerance, self._widths = config, bounds.tolerance, bounds.widths
        # A set in ascending order: the result does not depend on the order within the list.
        self._neighbours = sorted(views[position].neighbours[: config.check_num_images])
        self._own = shelf.get(position)
        self._transforms = [other_from_reference(views[n], views[position]) for n in self._neighbours]
        self._centres = np.zeros((len(self._neighbours), 3), np.float32)
        for slot, move in enumerate(self._transforms):
            self._centres[slot] = -move[:, :3].T @ move[:, 3]

    def fuse(self, report: FusionReport, noted: Covered | None = None) -> list[Cloud]:
        """The points of the view in parts; ``report`` is told of its pixels, and ``noted`` of its points."""
        own = self._own
        for reason, count in own.dropped.items():
            report.pixels[reason] += count
        report.pixels["all"] += own.taken.size
        pixels = np.empty(own.taken.size, np.int64)
        found, valid = _fusion_kernels.free(own.depth, own.taken, pixels)
        report.pixels["already_fused"] += valid - found - own.dropped.get("max_agreed_error", 0)
        pixels, block = pixels[:found], self._block()
        clouds = [
            c for first in range(0, found, block) for c in self._fuse(pixels[first : first + block], report)
        ]
        if noted is not None:
            points = np.concatenate([np.zeros((0, 3)), *(cloud.points for cloud in clouds)])
            noted.add(self._position, points, own.camera)
        if self._config.roi:
            clouds = [self._crop(cloud, report) for cloud in clouds]
        count = sum(map(len, clouds))
        report.points[self._views[self._position].name] = count
        report.pixels["points"] += count
        return clouds

    def _crop(self, cloud: Cloud, report: FusionReport) -> Cloud:
        """The points in the region of interest, at the very end, so that the region changes none of them."""
        low, high = np.array(self._config.roi[:3]), np.array(self._config.roi[3:])
        inside = np.flatnonzero(((cloud.points >= low) & (cloud.points <= high)).all(1))
        report.pixels["roi"] += len(cloud) - len(inside)
        return cloud.select(inside)

    def _fuse(self, pixels: NDArray[np.int64], report: FusionReport) -> list[Cloud]:
        """The points of these pixels (M,), flat indices into the reference, range by range."""
        run = self._shelf.workers
        ranges = [pixels[first : first + _RANGE] for first in range(0, len(pixels), _RANGE)]
        with closing(self._groups()) as groups:
            every = next(groups)
            if len(every) == len(self._neighbours):
                made = run.map(lambda own: self._at_once(own, every), ranges)
                _count(report, [lost for lost, _ in made])
                return [cloud for _, cloud in made]
        merged = self._points(ranges)
        for group in self._groups():
            run.map(lambda points, group=group: self._color(points, group), merged)  # type: ignore[misc]
        _count(report, [(points.failed, points.removed) for points in merged])
        return run.map(self._finish, merged)

    def _at_once(self, pixels: NDArray[np.int64], every: Group) -> tuple[Lost, Cloud]:
        """The points of a range, with all neighbours in memory, and what failed.

        So what the votes have read of them is still in the cache where colours and marks need it.
        """
        part = self._begin(pixels)
        self._vote(part, every)
        points = self._merge(part)
        self._color(points, every)
        return (points.failed, points.removed), self._finish(points)

    def _points(self, ranges: Sequence[NDArray[np.int64]]) -> list[_Points]:
        """The points of ranges of pixels; votes are kept only as long as neighbours are missing."""
        parts: list[_Part | None] = [None] * len(ranges)
        voted = 0

        def vote(i: int) -> _Points | None:
            part = parts[i] or self._begin(ranges[i])
            self._vote(part, group)
            parts[i] = part if voted < len(self._neighbours) else None
            return None if parts[i] else self._merge(part)

        for group in self._groups():
            voted += len(group)
            merged = self._shelf.workers.map(vote, range(len(ranges)))
        return [points for points in merged if points is not None]

    def _groups(self) -> Generator[Group, None, None]:
        """The neighbours, as many at a time as fit into memory; each list is emptied before the next.

        Whoever still has the list would otherwise keep views that the shelf has dropped.
        """
        for held in self._shelf.together(self._position, self._neighbours):
            group = [
                _Neighbour(slot, view, self._pair(slot, view.camera), self._pair(slot, view.image_camera))
                for slot, view in held
            ]
            held.clear()
            try:
                yield group
            finally:
                group.clear()

    def _block(self) -> int:
        """Pixels that are voted on together."""
        tile = _vote_kernels.TILE_SIZE + len(self._neighbours) * _vote_kernels.VOTE_SIZE
        return max(_RANGE, _BLOCK_BYTES * _vote_kernels.TILE // (4 * tile))

    def _begin(self, pixels: NDArray[np.int64]) -> _Part:
        tiles = _vote_kernels.tiles_of(len(pixels))
        _vote_kernels.begin(self._own.surface, pixels, tiles)
        votes = _vote_kernels.votes_of(len(pixels), len(self._neighbours))
        words = max(1, (len(self._neighbours) + 63) // 64)
        who = np.zeros((words, len(tiles) * _vote_kernels.TILE), np.uint64)
        return _Part(len(pixels), tiles, votes, who, np.zeros(3, np.int64))

    def _vote(self, part: _Part, group: Group) -> None:
        tolerance, config = self._tolerance, self._config
        cosine = math.cos(math.radians(tolerance.normal))
        limits = (tolerance.depth, tolerance.reproj, cosine, config.sigma_at_one, config.most_depth_error)
        for n in group:
            _vote_kernels.vote(
                part.tiles, part.votes, n.view.surface, n.maps, limits, n.slot, part.who, part.failed
            )

    def _merge(self, part: _Part) -> _Points:
        """The means at the pixels that have the support that they need."""
        config, own, view = self._config, self._own, self._views[self._position]
        fewest = min(config.min_num_pixels, max(2, min(_FEWEST_VIEWS, 1 + len(self._neighbours))))
        rules = (
            float(config.min_num_pixels),
            float(fewest),
            config.max_conflicts if config.max_conflicts > 0 else math.inf,
            math.cos(math.radians(config.min_tri_angle)) if config.min_tri_angle > 0 else math.inf,
        )
        kept, supports = np.empty(part.count, np.int64), np.empty(part.count, np.int64)
        removed = np.zeros(4, np.int64)
        count = _vote_kernels.accept(part.tiles, part.count, rules, kept, supports, removed)
        kept, supports = kept[:count].copy(), supports[:count].copy()
        means = np.empty((3, count), np.float32), np.empty((count, 3)), np.empty((count, 3), np.float32)
        pose = np.concatenate([view.cam_from_world[:3, :3], centre(view)[None]])
        _mean_kernels.average(
            part.tiles, part.votes, kept, own.camera, pose, self._centres, self._widths, means
        )
        tile = _vote_kernels.TILE
        slots = min(_COLOR_SAMPLES, 1 + len(self._neighbours))
        samples, sampled = np.empty((-(-count // tile), slots, 3, tile), np.uint8), np.zeros(count, np.uint8)
        pair = _fusion_kernels.pair(own.camera, own.image_camera, np.eye(3, 4))
        every, bit = np.ones(count, np.uint64), np.uint64(1)
        _merge_kernels.sample_colors(means[0], every, bit, pair, own.image, samples, sampled)
        return _Points(
            np.ascontiguousarray(part.who[:, kept]), part.failed, supports, *means, samples, sampled, removed
        )

    def _color(self, points: _Points, group: Group) -> None:
        """Sample the colours of a group's images, and mark as taken the pixels that a point is made of."""
        for n in group:
            local, who = points.local, points.who[n.slot >> 6]
            _merge_kernels.sample_colors(
                local, who, n.bit, n.image, n.view.image, points.samples, points.sampled
            )
            if self._neighbours[n.slot] < self._position:
                continue  # it has been the reference, and will not be again
            limits = self._tolerance.depth, 0.0
            _merge_kernels.mark_taken(local, who, n.bit, n.view.depth, n.maps, limits, n.view.taken)

    def _finish(self, points: _Points) -> Cloud:
        """The points with their colours and visibility."""
        colors = np.empty((len(points.supports), 3), np.uint8)
        _merge_kernels.median_colors(points.samples, points.sampled, colors)
        own = self._views[self._position].index
        theirs = np.array([self._views[p].index for p in self._neighbours], np.uint32)
        start = np.concatenate([[0], points.supports]).cumsum()
        images = np.empty(start[-1], np.uint32)
        order, before = np.argsort(theirs, kind="stable"), int((theirs < own).sum())
        _merge_kernels.list_views(points.who, order, theirs, (before, own), images)
        return Cloud(points.points, points.normals, colors, Visibility(start, images))

    def _pair(self, slot: int, camera: NDArray[np.float64]) -> NDArray[np.float32]:
        """The reference and the neighbour in this slot, of which ``camera`` is the map's or the image's."""
        return _fusion_kernels.pair(self._own.camera, camera, self._transforms[slot])


def _count(report: FusionReport, lost: Sequence[Lost]) -> None:
    """Add up what became of the pixels of a block."""
    failed = np.sum([np.zeros(3, np.int64), *(of_range for of_range, _ in lost)], 0)
    for name, number in zip(report.comparisons, failed.tolist(), strict=True):
        report.comparisons[name] += number
    removed = np.sum([np.zeros(4, np.int64), *(of_range for _, of_range in lost)], 0).tolist()
    for name, number in zip(("max_conflicts", "min_num_pixels", "min_tri_angle"), removed, strict=False):
        report.pixels[name] += number
    report.lowered += removed[3]
