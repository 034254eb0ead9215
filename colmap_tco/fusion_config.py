"""What the user can tell the fusion."""

from __future__ import annotations

from dataclasses import dataclass

from tco.config import knob

_POSITIVE = (
    "min_num_pixels", "max_reproj_error", "max_depth_error", "max_normal_error", "check_num_images",
    "cache_size", "max_view_angle",
)  # fmt: skip
_NOT_NEGATIVE = (
    "min_confidence", "max_depth_bend", "max_conflicts", "sigma_at_one", "most_depth_error",
    "max_depth_ratio", "min_tri_angle", "max_agreed_error", "voxel_size", "max_points",
)  # fmt: skip
_LARGEST = {"max_normal_error": 180.0, "max_view_angle": 90.0, "min_tri_angle": 180.0}
"""Degrees."""


@dataclass(frozen=True)
class FusionConfig:
    """Which depths agree and which pixels take part; COLMAP's names and defaults where these exist."""

    min_num_pixels: int = knob(
        5,
        "Views that must agree on a point, the reference included. A pixel that fewer views could see "
        "needs all of those, at least 3 (2 where a view has one neighbour). Lower it for few images.",
    )
    max_reproj_error: float = knob(
        2.0,
        "Largest distance, in pixels of the depth map, between a pixel and its way to a neighbour and back.",
    )
    max_depth_error: float = knob(
        0.01, "Largest relative difference between depths that agree: |z − d| / z. Raise it for noisy depths."
    )
    max_normal_error: float = knob(10.0, "Largest angle, in degrees, between normals that agree.")
    check_num_images: int = knob(50, "Neighbours that a view is compared with, the best overlapping first.")
    cache_size: float = knob(
        4.0,
        "Gigabytes of maps and images kept in memory (COLMAP: 32). More saves reading when views are many. "
        "The points come on top, with some 130 bytes each.",
    )
    num_threads: int = knob(-1, "Threads of all stages; -1 is one a core.")
    min_confidence: float = knob(
        1.1,
        "Pixels of a lower confidence are dropped: sky and guesses. Of the network in the package it is "
        "1 + 0.02 / expected relative error, so that 1.1 stands for 20 %; 1 keeps all. Maps that have no "
        "confidence are all kept.",
    )
    max_depth_bend: float = knob(
        0.05,
        "Pixels beside a discontinuity, where flying points arise, are dropped: those whose inverse depth q "
        "has a relative second difference |q₋ − 2 q + q₊| / q above this; planes have none. Depths that "
        "fill_only keeps stay. 0: off.",
    )
    max_view_angle: float = knob(
        85.0, "Surfaces seen at a larger angle to their normal, in degrees, are dropped. 90: off."
    )
    max_conflicts: float = knob(
        1.0,
        "A point is dropped if the views that look through it, to a surface behind, are more than this many "
        "times the views that agree on it. 0 switches it off.",
    )
    adapt_to_noise: bool = knob(
        True,
        "Widen max_depth_error, max_reproj_error and max_normal_error to 1.5 times the median difference "
        "between the views, for depths less exact than those of PatchMatch; at most to most_depth_error, 4 "
        "times max_reproj_error, and 45 degrees. Off: the values as given.",
    )
    sigma_at_one: float = knob(
        0.0,
        "Relative depth error s of a pixel of confidence 1; that of confidence c is s / c. If given, the "
        "allowed error is max(max_depth_error, √(s²/c₁² + s²/c₂²)), at most most_depth_error, for depths "
        "whose confidence is calibrated. 0: not used.",
    )
    most_depth_error: float = knob(
        0.05, "Bound of the allowed relative error where adapt_to_noise or sigma_at_one raises it."
    )
    max_depth_ratio: float = knob(
        3.0,
        "Sky and far background: pixels deeper than this many times the depth that 98 % of the model's "
        "points in the view do not exceed are dropped. Raise it where a background without points matters. "
        "0: off.",
    )
    min_tri_angle: float = knob(
        0.25,
        "Far background: points are dropped if all views that agree on them see them from within this "
        "angle, in degrees, of the reference's direction: their depth is little more than a guess. 0: off.",
    )
    roi: tuple[float, ...] = knob(
        (),
        "Keep only points within xmin,ymin,zmin,xmax,ymax,zmax, in the coordinates of the model; the others "
        "are cut off, those that stay do not change. Empty: all points.",
    )
    max_agreed_error: float = knob(
        0.003,
        "Where the cloud has gaps, depths that the views agreed on are taken if their relative standard "
        "error, by how far apart the views were, is at most this. Raise it, up to 0.01, for fewer gaps and "
        "rougher surfaces in them. 0: the gaps stay.",
    )
    voxel_size: float = knob(
        0.0,
        "Thin the cloud to one point in each cube of this side, in units of the model: the one nearest to "
        "the middle of the points there. 0: off.",
    )
    max_points: int = knob(
        0,
        "Thin the cloud evenly in space to at most so many points, by the smallest cubes that do (see "
        "voxel_size); 3D Gaussian splatting wants 300000 to 500000. 0: off.",
    )

    def __post_init__(self) -> None:
        for name in _POSITIVE:
            if not getattr(self, name) > 0:
                raise ValueError(f"--{name} must be positive, not {getattr(self, name)}")
        for name in _NOT_NEGATIVE:
            if not getattr(self, name) >= 0:
                raise ValueError(f"--{name} must not be negative, it is {getattr(self, name)}")
        for name, most in _LARGEST.items():
            if getattr(self, name) > most:
                raise ValueError(f"--{name} must be at most {most:g}, it is {getattr(self, name)}")
        low, high = self.roi[:3], self.roi[3:]
        if self.roi and not (len(self.roi) == 6 and all(a < b for a, b in zip(low, high, strict=True))):
            raise ValueError(
                "--roi must be xmin,ymin,zmin,xmax,ymax,zmax with each minimum below its maximum, not "
                f"{','.join(map(str, self.roi))}"
            )
