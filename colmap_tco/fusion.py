"""Depth maps → one cloud: cross-view consistency, merging, normals, colours.

Each view in turn is the reference. A pixel of it becomes a point if enough neighbouring views agree:
its depth, moved into the neighbour, meets the surface that the neighbour's depth and normal describe
there (``max_depth_error``), that surface point falls back onto the pixel (``max_reproj_error``), and
the two normals agree (``max_normal_error``). The point is a mean of the agreeing surfaces, weighted by
confidence and robust (:mod:`colmap_tco._mean_kernels`), and so is its normal; its colour is the median of
their images, at most 15. The pixels of the other views that it was made of are not used as references again.

Where that leaves gaps, the depths that the views agreed on when they were asked for each other's
(:mod:`tco.consensus`) are fused in the same way. A pixel becomes a point there if the views were hardly
apart on it (``max_agreed_error``), and if no point of the cloud is there yet; the others vote.

Views are loaded when they are needed and kept while they fit ``cache_size``, so that the memory for maps and
images does not grow with their number. That for the points does: 47 bytes each and 4 for each view that
agrees (:attr:`colmap_tco.ply.Cloud.nbytes`), 12 more while gaps are filled, and two thirds as much again at
the end, when the clouds of all views become one. The result does not depend on the number of threads.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from colmap_tco.errors import DensifyError
from colmap_tco.fusion_config import FusionConfig
from colmap_tco.fusion_input import FusionMaps, FusionView
from colmap_tco.fusion_report import FusionReport, why_empty
from colmap_tco.ply import Cloud, join
from colmap_tco.thin import thin
from colmap_tco.workers import Workers

if TYPE_CHECKING:
    from colmap_tco._fusion_gaps import Covered

__all__ = ["EmptyCloudError", "FusionConfig", "FusionMaps", "FusionView", "fuse", "fuse_views"]

log = logging.getLogger(__name__)


class EmptyCloudError(DensifyError):
    """Fusion left no point.

    Attributes:
        cloud: of no points.
        report: what removed them.
    """

    def __init__(self, cloud: Cloud, report: FusionReport) -> None:
        super().__init__(why_empty(report))
        self.cloud, self.report = cloud, report


def fuse(
    views: Sequence[FusionView],
    config: FusionConfig | None = None,
    fused: Callable[[], None] = lambda: None,
    agreed: Sequence[FusionView] = (),
) -> tuple[Cloud, FusionReport]:
    """Fuse all views into one cloud; see :func:`fuse_views`.

    Args:
        views: with what each found by itself.
        config: bounds and filters.
        fused: called after each view, of ``views`` and of ``agreed``.
        agreed: the same views with what they agreed on and its standard error, to fill gaps; none: they stay.

    Returns:
        The cloud, points in gaps last, and the report.

    Raises:
        EmptyCloudError: no point is left; the message names the filter that removed most.
        InputError: ``voxel_size`` is too small for the cloud.
        ValueError: as :func:`fuse_views`; ``agreed`` are other views, or have no error.
    """
    config = config or FusionConfig()
    if agreed and [view.name for view in agreed] != [view.name for view in views]:
        raise ValueError("the agreed maps are not of the same views in the same order")
    report = FusionReport()

    def parts() -> Iterator[Cloud]:
        for clouds in _filled(views, agreed, config, report) if agreed else _in_parts(views, config, report):
            fused()
            yield from clouds

    cloud = join(parts(), 1 if config.num_threads == 1 else 2)
    report.cloud_bytes = cloud.nbytes
    kept = thin(cloud.points, config.voxel_size, config.max_points)
    if len(kept) < len(cloud):
        report.thin(kept)
        cloud = cloud.select(kept)
    if not len(cloud):
        raise EmptyCloudError(cloud, report)
    lowered = report.lowered + (report.gaps.lowered if report.gaps else 0)
    if lowered:
        log.info("%d of %d points are confirmed by fewer than min_num_pixels=%d views, for no more see them",
                 lowered, len(cloud), config.min_num_pixels)  # fmt: skip
    return cloud, report


def _filled(
    views: Sequence[FusionView], agreed: Sequence[FusionView], config: FusionConfig, report: FusionReport
) -> Iterator[list[Cloud]]:
    """The clouds of all views, then those that fill the gaps, in parts; arguments as of :func:`fuse`."""
    from colmap_tco._fusion_gaps import Covered

    covered = Covered(views, config.check_num_images)
    yield from _in_parts(views, config, report, covered)
    if config.max_agreed_error > 0 and covered:
        assert report.tolerance is not None
        report.gaps = FusionReport()
        yield from _in_parts(agreed, config, report.gaps, covered=(covered, report.tolerance.depth))


def fuse_views(views: Sequence[FusionView], config: FusionConfig, report: FusionReport) -> Iterator[Cloud]:
    """Fuse view after view: one cloud for each of ``views`` in turn, in the world frame.

    Args:
        views: all views; their neighbours are positions in this list.
        config: bounds and filters.
        report: is filled while the clouds are taken.

    Raises:
        ValueError: neighbours out of range, or arrays of a view that do not fit together.
    """
    return map(join, _in_parts(views, config, report))


def _in_parts(
    views: Sequence[FusionView],
    config: FusionConfig,
    report: FusionReport,
    noted: Covered | None = None,
    covered: tuple[Covered, float] | None = None,
) -> Iterator[list[Cloud]]:
    """The clouds of :func:`fuse_views` as they are made, each in parts.

    Args:
        views: all views.
        config: bounds and filters.
        report: is filled while the clouds are taken.
        noted: is told of the points, those outside the region of interest among them.
        covered: the points of a cloud whose gaps are to be filled, and the relative difference of depth up to
            which a pixel shows such a point; if given, the views have standard errors, and pixels that show
            one, or that ``max_agreed_error`` excludes, vote and do not become points.
    """
    from colmap_tco import _fusion_noise
    from colmap_tco._fusion_reference import Bounds, Reference
    from colmap_tco._fusion_shelf import Shelf

    _check(views)
    with Workers(config.num_threads) as workers:
        shelf = Shelf(views, config, workers, covered)
        noise = _fusion_noise.noise(shelf, views, config)
        bounds = Bounds(_fusion_noise.tolerance(noise, config), _fusion_noise.widths(noise, config))
        report.tolerance = bounds.tolerance
        log.debug("fusion tolerates %s; means are taken within %.2g of depth and %.2g rad", bounds.tolerance,
                  *bounds.widths)  # fmt: skip
        for position in range(len(views)):
            clouds = Reference(shelf, views, position, config, bounds).fuse(report, noted)
            report.loads, report.peak_bytes = shelf.loads, shelf.peak_bytes
            shelf.finish(position)
            yield clouds


def _check(views: Sequence[FusionView]) -> None:
    for position, view in enumerate(views):
        wrong = [n for n in view.neighbours if not 0 <= n < len(views) or n == position]
        if wrong or len(set(view.neighbours)) != len(view.neighbours):
            raise ValueError(f"{view.name}: neighbours {view.neighbours} are not other views, each once")
