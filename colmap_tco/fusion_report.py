"""Where every pixel went in :mod:`colmap_tco.fusion`, and what to say when none became a point."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

FILTERS = {
    "no_depth": "they have no depth",
    "mask": "the masks exclude them",
    "min_confidence": "their confidence is below min_confidence",
    "no_normal": "no surface normal could be fitted to them",
    "max_view_angle": "their surface is seen at more than max_view_angle",
    "max_depth_bend": "they lie at discontinuities (max_depth_bend)",
    "max_conflicts": "other views look through them (max_conflicts)",
    "min_num_pixels": "fewer than min_num_pixels views agree on them",
}
"""What removes a pixel, in the order of the tests, and how a message says so."""
PIXEL_FATES = ("all", *FILTERS, "already_fused", "points")
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
            earlier views, then the points.
        comparisons: how often a pixel and a neighbour did not agree, by the first test that failed.
        tolerance: in use, where it was widened to the noise of the depths.
        points: points a reference view contributed, by name.
        lowered: points accepted by fewer than ``min_num_pixels`` views because no more could see them.
        loads: how often a view was read.
        peak_bytes: most bytes of maps and images that were held at once.
    """

    pixels: dict[str, int] = field(default_factory=lambda: dict.fromkeys(PIXEL_FATES, 0))
    comparisons: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COMPARISONS, 0))
    points: dict[str, int] = field(default_factory=dict)
    tolerance: Tolerance | None = None
    lowered: int = 0
    loads: int = 0
    peak_bytes: int = 0

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
        }


def why_empty(report: FusionReport) -> str:
    """The sentence for a fusion that left no point: which filter removed most, with all counts."""
    removed = {name: report.pixels[name] for name in FILTERS}
    worst = max(removed, key=lambda name: removed[name])
    counts = ", ".join(f"{name} {number}" for name, number in removed.items() if number)
    text = (
        f"fusion left no point: of {report.pixels['all']} pixels, {removed[worst]} were dropped because "
        f"{FILTERS[worst]}"
    )
    if worst == "min_num_pixels" and any(report.comparisons.values()):
        test = max(report.comparisons, key=lambda name: report.comparisons[name])
        text += f"; most comparisons failed by {test}: raise it, or lower min_num_pixels"
    return f"{text} (removed by each filter: {counts or 'none'})"
