"""Where every pixel went in :mod:`colmap_tco.fusion`, and what to say when none became a point."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray

FILTERS = {
    "no_depth": "they have no depth",
    "mask": "the masks exclude them",
    "min_confidence": "their confidence is below min_confidence",
    "max_agreed_error": "too few views spoke of them, or these were too far apart (max_agreed_error)",
    "no_normal": "no surface normal could be fitted to them",
    "max_view_angle": "their surface is seen at more than max_view_angle",
    "max_depth_bend": "they lie at discontinuities (max_depth_bend)",
    "max_depth_ratio": "they lie far behind the points of the model (max_depth_ratio)",
    "max_conflicts": "other views look through them (max_conflicts)",
    "min_num_pixels": "fewer than min_num_pixels views agree on them",
    "min_tri_angle": "the views that agree on them see them from nearly the same direction (min_tri_angle)",
    "roi": "they lie outside the region of interest (roi)",
}
"""What removes a pixel, in the order of the tests, and how a message says so."""
AFTER_CONFIRMATION = ("min_tri_angle", "roi")
"""Filters of points that enough views agree on."""
PIXEL_FATES = ("all", *FILTERS, "already_fused", "thinned", "points")
COMPARISONS = ("max_depth_error", "max_reproj_error", "max_normal_error")


@dataclass(frozen=True)
class Tolerance:
    """What counts as agreement.

    Attributes:
        depth: relative depth error.
        reproj: pixels of the depth map.
        normal: degrees.
    """

    depth: float
    reproj: float
    normal: float


@dataclass
class FusionReport:
    """Where every pixel went.

    Attributes:
        pixels: all pixels, then those that each filter removed, then those taken into points of
            earlier views, then those whose points were thinned out, then the points.
        comparisons: how often a pixel and a neighbour did not agree, by the first test that failed.
        tolerance: in use, where it was widened to the noise of the depths.
        points: points a reference view contributed, by name, in the order of the cloud.
        gaps: where the pixels of the agreed maps went, if gaps were filled: its points come after these.
        lowered: points accepted by fewer than ``min_num_pixels`` views because no more could see them,
            those outside the region of interest and those thinned out included.
        loads: how often a view was read.
        peak_bytes: most bytes of maps and images that were held at once.
        cloud_bytes: of all points, those in gaps and those thinned out included; they come on top.
    """

    pixels: dict[str, int] = field(default_factory=lambda: dict.fromkeys(PIXEL_FATES, 0))
    comparisons: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COMPARISONS, 0))
    points: dict[str, int] = field(default_factory=dict)
    tolerance: Tolerance | None = None
    gaps: FusionReport | None = None
    lowered: int = 0
    loads: int = 0
    peak_bytes: int = 0
    cloud_bytes: int = 0

    def thin(self, kept: NDArray[np.int64]) -> None:
        """Take down that of the points so far only ``kept`` (M,), ascending indices, remain."""
        if self.gaps is not None:
            count = self.pixels["points"]
            self.gaps.thin(kept[kept >= count] - count)
            kept = kept[kept < count]
        ends = np.cumsum(list(self.points.values()))
        left = np.diff(np.searchsorted(kept, ends), prepend=0)
        self.points = {name: int(count) for name, count in zip(self.points, left, strict=True)}
        self.pixels["thinned"] += self.pixels["points"] - len(kept)
        self.pixels["points"] = len(kept)

    def as_dict(self) -> dict[str, object]:
        """The report as plain numbers for ``report.json``."""
        return {
            "pixels": dict(self.pixels),
            "comparisons_failed": dict(self.comparisons),
            "tolerance": asdict(self.tolerance) if self.tolerance else None,
            "points_by_view": dict(self.points),
            "points_with_fewer_views": self.lowered,
            "views_read": self.loads,
            "peak_megabytes": round(self.peak_bytes / 1e6, 1),
            "cloud_megabytes": round(self.cloud_bytes / 1e6, 1),
            "gaps": self.gaps.as_dict() if self.gaps else None,
        }


def why_empty(report: FusionReport) -> str:
    """The sentence for a fusion that left no point: which filter removed most, with all counts."""
    removed = {name: report.pixels[name] for name in FILTERS}
    # Where points were confirmed, what removed these is the cause, not what removed most pixels.
    confirmed = [name for name in AFTER_CONFIRMATION if removed[name]]
    worst = max(confirmed or removed, key=lambda name: removed[name])
    counts = ", ".join(f"{name} {number}" for name, number in removed.items() if number)
    text = (
        f"fusion left no point: of {report.pixels['all']} pixels, {removed[worst]} were dropped because "
        f"{FILTERS[worst]}"
    )
    if worst == "min_num_pixels" and any(report.comparisons.values()):
        test = max(report.comparisons, key=lambda name: report.comparisons[name])
        text += f"; most comparisons failed by {test}: raise it, or lower min_num_pixels"
    return f"{text} (removed by each filter: {counts or 'none'})"
