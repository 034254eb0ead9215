"""Settings of the search for poses; nothing heavy is imported, so that a command line starts quickly."""

from __future__ import annotations

from dataclasses import dataclass

from tco.config import knob


@dataclass(frozen=True)
class PoseConfig:
    """Rough poses, moved until the depths of the views agree (``tco/poses.py``)."""

    sizes: tuple[int, ...] = knob(
        (48, 80, 160),
        "longer sides of the images, from coarse to fine, pixels; the first decides how wrong poses may be, "
        "the last how exact they get and how long it takes",
    )
    iterations: tuple[int, ...] = knob((14, 6, 5), "most Gauss–Newton steps at each of the sizes")
    neighbours: int = knob(6, "views that each view is rendered into; more tie long sequences better")
    least_overlap: float = knob(
        0.2, "share of a view's depths that another must see, by the rough poses, to be compared with it"
    )
    geometric: float = knob(
        0.1,
        "weight of the depths of the rendered surfels; 0: colours alone. Raise it to 1 where the depths are "
        "exact or pictures say little",
    )
    photometric: float = knob(
        1.0,
        "weight of the colours of the rendered surfels; 0: depths alone, for lights that change or depths "
        "without pictures of any use",
    )
    rough_rotation: float = knob(3.0, "standard deviation of the rough rotations, degrees")
    rough_centre: float = knob(
        0.05, "standard deviation of the rough centres, as a share of their mean distance from their middle"
    )
    rough_focal: float = knob(
        0.0, "standard deviation of the relative focal length, one factor for all views; 0 keeps them"
    )
    independent: float = knob(
        100.0,
        "independent comparisons in a view: errors of neighbouring pixels are alike, so that all pixels "
        "together weigh no more than this many against the rough poses. Raise it where these are worse than "
        "their standard deviations say",
    )
    noise_floor: float = knob(
        0.003, "relative depth error that is never taken for better: what the sensor cannot resolve"
    )
    occlusion_tolerance: float = knob(
        0.02, "a rendered surface further behind a measured one by this share of its depth does not count; "
        "ten standard deviations of what the views disagree by at the moment, where that is more",
    )  # fmt: skip

    def __post_init__(self) -> None:
        if not self.sizes or len(self.sizes) != len(self.iterations) or min(self.iterations) < 0:
            raise ValueError("sizes and iterations must be as many, at least one, and none negative")
        if self.geometric < 0 or self.photometric < 0 or self.geometric + self.photometric == 0:
            raise ValueError("one of geometric and photometric must be above 0, and none below")
        if min(self.rough_rotation, self.rough_centre) <= 0 or self.rough_focal < 0:
            raise ValueError("the standard deviations of rough poses are positive, that of focal not below 0")
        if self.neighbours < 1 or self.independent <= 0 or self.noise_floor <= 0:
            raise ValueError("neighbours, independent and noise_floor are positive")
