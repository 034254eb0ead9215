"""Settings of test-time optimisation; nothing heavy is imported, so that a command line starts quickly."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from tco.config import POSITIVE, check_range, knob

EVERY = 1_000_000
"""More than any chunk has views: every target, every source."""


@dataclass(frozen=True)
class AblationConfig:
    """Variants of the optimisation, to be measured (``benchmarks/ablations.py``)."""

    unfrozen: tuple[str, ...] = knob(
        (), "name patterns of the decoder's modules that are trained in full beside the adapters; * is all"
    )
    unfrozen_rate: float = knob(
        1e-5, "learning rate of these modules (Adam), as the published code has it for heads"
    )
    radius_factor: float = knob(
        0.5, "radius of a surfel in steps between neighbouring points; the paper tries 0.05 to 5"
    )
    confident_opacity: bool = knob(
        True, "opacity of a surfel from the confidence of its pixel; without, all are opaque"
    )
    free_surfels: bool = knob(False, "learn radii and orientation of each surfel, too")
    free_depth: bool = knob(
        False,
        "learn a factor of each pixel's depth, too; without lora_targets, in place of the network",
    )
    free_rate: float = knob(5e-3, "learning rate of what free_surfels and free_depth add (Adam, logarithms)")
    decode_all: bool = knob(
        False,
        "decode all views with gradients in every step, as published, not the source alone",
    )
    source_order: str = knob(
        "epoch",
        "how source views are drawn. epoch: each once before any comes again; overlap: by how well they "
        "overlap with the others; uniform: with repetition, as published",
        choices=("epoch", "overlap", "uniform"),
    )
    published_objective: bool = knob(
        False,
        "compare as the published code does: surfels composited by the renderer cpu or gsplat, colours "
        "premultiplied by alpha, no tolerance for occlusions but 1e-4 of the mean depth, the source among "
        "its targets; and its variants of the penalties of focal lengths and dense depths",
    )
    renderer: str = knob(
        "surface",
        "engine that renders surfels. surface puts the lowest loss at the true depth; cpu and gsplat (CUDA) "
        "composite as published, which moves it by up to half a pixel of parallax",
        choices=("surface", "cpu", "gsplat"),
    )
    run_ahead: bool = knob(
        True,
        "compute what comes before the first adapted block once, by networks that can; without, in every "
        "step, as published",
    )
    plain_cameras: bool = knob(
        False,
        "hold cameras by the paper's penalties (angle, normalised centres, focal lengths in pixels; weights "
        "1, 2 and 0.01) instead of by their uncertainty",
    )

    def __post_init__(self) -> None:
        check_range(self, "radius_factor free_rate", POSITIVE)


@dataclass(frozen=True)
class PolishConfig:
    """Refinement of each pixel's depth after the network was adapted (``tco/polish.py``)."""

    polish_looks: int = knob(
        10,
        "times that each view's depths are refined, after the steps on the network; 0, or no steps at all: "
        "never",
    )
    polish_rate: float = knob(
        6.5e-3,
        "learning rate of the logarithms of the depths' factors (Adam); lower it if surfaces get rough",
    )
    polish_uncertainty: float = knob(
        0.0025,
        "depths are not refined where the standard deviations of the cameras move pixels by more than this "
        "share of the longer side: depths would make up for the cameras' errors",
    )
    polish_sources: int = knob(2, "views whose depths each step of these refines")
    polish_colours: bool = knob(
        False, "refine by all colours; else by their mean alone, which says as much in two thirds of the time"
    )
    polish_smoothness: float = knob(
        0.1,
        "weight of the mean difference between the logarithms of the factors of neighbouring pixels, less "
        "across edges of the picture; raise it if surfaces get rough",
    )
    polish_growth: float = knob(
        2.0,
        "a refined depth is taken back if the views' standard error around it has grown by more than this "
        "factor; 0: none is",
    )
    polish_levels: tuple[int, ...] = knob(
        (2, 8), "sides of the cells that share a factor, in pixels of the network's image; 1 follows noise"
    )

    def __post_init__(self) -> None:
        if self.polish_looks < 0 or self.polish_sources < 1 or not self.polish_levels:
            raise ValueError("polish_looks must not be negative, and there must be a source and a level")
        check_range(self, "polish_rate polish_uncertainty polish_smoothness polish_growth", 0)
        check_range(self, "polish_levels", 1)

    def steps(self, views: int) -> int:
        """Steps that refine each of so many views as often as wanted."""
        return -(-self.polish_looks * views // self.polish_sources)


@dataclass(frozen=True)
class ConsensusConfig:
    """What views say together (``tco/consensus.py``), planes (``tco/planar``), contest (``tco/contest.py``).

    No optimisation, and without steps, too.
    """

    consensus_rounds: int = knob(
        2,
        "times that each pixel's depth is moved to the weighted median of what the views say of it, each "
        "with its own depths; 0: the depths of a view are its own alone, not on planes nor contested either",
    )
    consensus_views: int = knob(20, "views that a pixel asks, those that overlap best")
    consensus_reach: float = knob(
        0.15,
        "largest logarithm of the ratio of two depths that are taken for the same surface; lower it where "
        "thin things stand close before others",
    )
    consensus_width: float = knob(
        0.01,
        "logarithms this far from the median count half in the mean that is taken around it; the depths' "
        "noise, not their errors",
    )
    consensus_uncertainty: float = knob(
        0.006,
        "views are not asked where the standard deviations of the cameras move pixels by more than this "
        "share of the longer side: what others see is then elsewhere",
    )
    contest_views: int = knob(
        8,
        "views that overlap best, whose depths a pixel may take instead of its own, where they and the "
        "pictures say so; two must agree with it; 0: none",
    )
    planes: int = knob(
        20,
        "planes at most of each group of views, onto which depths are moved where they are unsure or nearly "
        "on one: plain walls, floors, cupboards; 0: none",
    )
    plane_share: float = knob(
        0.003, "share of all pixels that a plane needs: by their confidence when it is found, by number later"
    )
    plane_trust: float = knob(
        5.0,
        "most that it costs a pixel to be moved far off its depth, as reckoned by its error; raise it where "
        "things that are nearly flat are flattened",
    )
    plane_smoothness: float = knob(
        2.0,
        "cost of a step in depth, and of a plane's border, per pixel of its length in pictures of 256 × 192 "
        "pixels; raise it for larger planes with straighter borders",
    )

    plane_square: float = knob(
        0.5,
        "where most surfaces of a scene face along three directions at right angles: most that it costs a "
        "pixel to be on a plane that does not; 0: such directions are not looked for",
    )
    plane_colour: float = knob(
        1.0,
        "what it costs a pixel to keep a depth that is unsure, where sure pixels of its colour are on "
        "planes: up to this many times the logarithm of how much rarer its colour is off them; 0: nothing",
    )

    def __post_init__(self) -> None:
        if self.planes < 0 or not 0 < self.plane_share < 1:
            raise ValueError("planes must not be negative, and plane_share between 0 and 1")
        if self.plane_trust <= 0:
            raise ValueError("plane_trust must be positive")
        check_range(self, "plane_smoothness plane_square plane_colour", 0)
        if self.consensus_rounds < 0 or self.consensus_views < 1:
            raise ValueError("consensus_rounds must not be negative, and consensus_views at least 1")
        if self.contest_views < 0 or self.contest_views == 1:
            raise ValueError("contest_views must be 0, or at least 2: two views must agree with a depth")
        if not (self.consensus_reach > 0 and self.consensus_width > 0):
            raise ValueError("consensus_reach and consensus_width must be positive")
        if self.consensus_uncertainty < 0:
            raise ValueError("consensus_uncertainty must not be negative")


@dataclass(frozen=True)
class HintsConfig:
    """What the views agree on, told to a network that takes points as input (``tco/hints.py``)."""

    hint_rounds: int = knob(
        1,
        "times that a network that takes points is asked again, with further ones where the views agreed on "
        "what it said before, in groups of eight views or more; 0: it is given COLMAP's points alone",
    )
    hint_points: int = knob(600, "further points of a view, at most, spread over the picture")
    hint_error: float = knob(
        0.01,
        "largest relative standard error of an agreed depth, or of the plane it is on, that becomes a point",
    )
    hint_confidence: float = knob(
        1.3,
        "least confidence of a depth that becomes a point; planes at right angles to others need none",
    )
    hint_distance: float = knob(
        0.04, "least distance of a further point from COLMAP's, as a share of the longer side of the picture"
    )

    def __post_init__(self) -> None:
        check_range(self, "hint_rounds hint_confidence hint_distance", 0)
        check_range(self, "hint_points", 1)
        check_range(self, "hint_error", POSITIVE)


@dataclass(frozen=True)
class TCOConfig:
    """Test-time constrained optimisation (Zhou et al., arXiv 2604.03878)."""

    steps: int = knob(
        2,
        "optimisation steps of each chunk on the network; 0 leaves it as it is (plain feed-forward), and "
        "depths are not refined then. The paper takes 40 at a lower rate; other networks than sweep do, too",
    )
    uncertain_steps: int = knob(
        0,
        "so many at least, unless none are wanted, where cameras are too uncertain for depths to be refined "
        "(polish_uncertainty): these steps are then all that seeks the cameras; sweep takes 12 unless steps "
        "are given",
    )
    rate: float = knob(7e-4, "learning rate of the adapters (Adam); lower it if the loss jumps")
    lora_rank: int = knob(4, "rank of the adapters; more adapts more and overfits sooner")
    lora_alpha: float = knob(16.0, "adapters are scaled by alpha / rank")
    lora_targets: tuple[str, ...] = knob(
        ("qkv", "proj", "fc1", "fc2", "conv"),
        "name patterns of the decoder's layers that get adapters; *refine.1.* would be the last block of one",
    )
    photometric_weight: float = knob(
        1.0, "weight of the colours of the rendered surfels; 0 switches rendering off"
    )
    geometric_weight: float = knob(
        0.0, "weight of the depths of the rendered surfels; 1 to find poses from known depths"
    )
    depth_weight: float = knob(
        0.0, "weight of dense depths among the priors, after one scale and shift for all that is predicted"
    )
    sparse_weight: float = knob(0.01, "weight of the triangulated points, in inverse depth")
    camera_weight: float = knob(
        3e-4,
        "weight of the pose and focal priors, each in units of its own uncertainty. With b the colour error "
        "of a right model and n the independent comparisons in a view, b / n is the weight of the most "
        "probable cameras: 0.02 / 60. Raise it where large parts of the pictures mislead",
    )
    camera_rate: float = knob(
        0.05,
        "learning rate of the small corrections of the cameras, in standard deviations; 0 holds them fixed",
    )
    camera_kernel: str = knob(
        "huber",
        "growth of a camera's penalty beyond 2 standard deviations: quadratic, huber (linear) or cauchy "
        "(logarithmic, lets a wrong prior go)",
        choices=("quadratic", "huber", "cauchy"),
    )
    own_cameras: str = knob(
        "published",
        "what holds a network that finds its cameras to COLMAP's. published: the paper's penalties and "
        "weights, for cameras that are exact; uncertainty: their errors in standard deviations of COLMAP's, "
        "with camera_weight and camera_kernel, so that cameras that are known badly pull less",
        choices=("published", "uncertainty"),
    )
    reencode: float = knob(
        1.0,
        "pixels by which corrections must have moved a view before the network is given the corrected "
        "cameras, at the next refresh; 0: never",
    )
    point_dropout: float = knob(
        0.5,
        "share of the points that each step hides from the network and asks it to predict from the others",
    )
    sources: int = knob(1, "views that each step renders from; more are steadier and as much dearer")
    targets: int = knob(4, "views that each step renders into, drawn from those that overlap most")
    refresh: int = knob(10, "steps after which the depths of all views are computed anew")
    stop_after: int = knob(
        0,
        "stop when the error at the tracks that are held out has not fallen for this many steps (where none "
        "are, at points hidden in the step); 0 takes all steps",
    )
    occlusion_tolerance: float = knob(
        0.02, "a rendered surface further behind the target's own by this share of its depth does not count"
    )
    exposure: bool = knob(
        True, "match brightness and contrast of each pair of views before comparing colours"
    )
    structure: float = knob(0.85, "share of the structural term (SSIM) in the comparison of colours")
    clip: float = knob(1.0, "largest norm of the gradient")
    polish: PolishConfig = field(default_factory=PolishConfig)
    hints: HintsConfig = field(default_factory=HintsConfig)
    consensus: ConsensusConfig = field(default_factory=ConsensusConfig)
    ablation: AblationConfig = field(default_factory=AblationConfig)

    def all_steps(self, views: int) -> int:
        """Steps on the network, and those on the depths of so many views, which only follow upon some."""
        return self.steps + self.polish.steps(views) if self.steps else 0

    def __post_init__(self) -> None:
        if self.steps < 0 or self.targets < 1 or self.refresh < 1 or self.sources < 1:
            raise ValueError("steps must not be negative, targets, sources and refresh at least 1")
        if not 0 <= self.point_dropout < 1:
            raise ValueError(f"point_dropout is a share below 1, not {self.point_dropout}")
        check_range(self, "lora_rank", 1)
        check_range(self, "lora_alpha clip", POSITIVE)
        check_range(self, "structure", 0, 1)
        check_range(self, "photometric_weight geometric_weight depth_weight sparse_weight", 0)
        check_range(self, "camera_weight rate camera_rate", 0)
        check_range(self, "reencode stop_after occlusion_tolerance uncertain_steps", 0)

    def reference_schedule(self) -> TCOConfig:
        """The same objective on the published schedule, by a network that is asked once.

        A source drawn uniformly, all blocks run and all views decoded with gradients in every step, every
        other view a target. What the network multiplies in is its own (``dtype`` of what loads it).
        With ``published_objective`` it is what the published code does.
        """
        ablation = replace(self.ablation, decode_all=True, source_order="uniform", run_ahead=False)
        return replace(
            self, sources=1, targets=EVERY, refresh=1, ablation=ablation,
            polish=PolishConfig(polish_looks=0), hints=replace(self.hints, hint_rounds=0),
        )  # fmt: skip
