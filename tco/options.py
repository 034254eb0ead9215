"""Settings of test-time optimisation; nothing heavy is imported, so that a command line starts quickly."""

from __future__ import annotations

from dataclasses import dataclass

from tco.config import knob


@dataclass(frozen=True)
class TCOConfig:
    """Test-time constrained optimisation (Zhou et al., arXiv 2604.03878)."""

    steps: int = knob(
        40, "optimisation steps of each chunk; 0 leaves the network as it is (plain feed-forward)"
    )
    rate: float = knob(1.5e-3, "learning rate of the adapters (Adam); lower it if the loss jumps")
    lora_rank: int = knob(4, "rank of the adapters; more adapts more and overfits sooner")
    lora_alpha: float = knob(16.0, "adapters are scaled by alpha / rank")
    lora_targets: tuple[str, ...] = knob(
        ("qkv", "proj", "fc1", "fc2", "conv"), "name patterns of the decoder's layers that get adapters"
    )
    photometric_weight: float = knob(
        1.0, "weight of the colours of the rendered surfels; 0 switches rendering off"
    )
    sparse_weight: float = knob(0.01, "weight of the triangulated points, in inverse depth")
    consistency_weight: float = knob(1.0, "weight of the agreement with the depths of the other views")
    camera_weight: float = knob(
        1.0, "weight of the pose and focal priors, each in units of its own uncertainty"
    )
    camera_rate: float = knob(
        0.02,
        "learning rate of the small corrections of the cameras, in standard deviations; 0 holds them fixed",
    )
    point_dropout: float = knob(
        0.5,
        "share of the points that each step hides from the network and asks it to predict from the others",
    )
    targets: int = knob(4, "views that each step renders into, drawn from those that overlap most")
    refresh: int = knob(10, "steps after which the depths of all views are computed anew")
    occlusion_tolerance: float = knob(
        0.02, "a rendered surface further behind the target's own by this share of its depth does not count"
    )
    consistency_start: float = knob(
        0.5,
        "share of the steps after which the depths of the views are tied to each other: earlier, wrong "
        "depths that agree would hold each other in place against the colours",
    )
    consistency_tolerance: float = knob(
        0.02, "relative depth difference above which two views' disagreement is weighed less and less"
    )
    exposure: bool = knob(
        True, "match brightness and contrast of each pair of views before comparing colours"
    )
    structure: float = knob(0.5, "share of the structural term (SSIM) in the comparison of colours")
    clip: float = knob(1.0, "largest norm of the gradient")

    def __post_init__(self) -> None:
        if self.steps < 0 or self.targets < 1 or self.refresh < 1:
            raise ValueError("steps must not be negative, targets and refresh at least 1")
        if not 0 <= self.point_dropout < 1:
            raise ValueError(f"point_dropout is a share below 1, not {self.point_dropout}")
