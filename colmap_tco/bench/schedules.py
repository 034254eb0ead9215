"""The settings with which TCO's code makes the paper's tables.

``scripts/tco_vggt_*.sh`` and ``configs/evaluation/{mv_recon,relpose-distance}.yaml`` of
github.com/cvlab-stonybrook/TCO. Adapters of rank 4 and alpha 16 on qkv, proj, fc1 and fc2, gradients clipped
at a norm of 1; a source view is drawn uniformly, all views are decoded in every step, and every view is a
target (:meth:`tco.options.TCOConfig.reference_schedule`), compared as that code does
(``published_objective``).
What differs here: docs/bench.md.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from tco.options import TCOConfig

_COMMON: dict[str, Any] = {
    "lora_rank": 4, "lora_alpha": 16.0, "lora_targets": ("qkv", "proj", "fc1", "fc2"), "clip": 1.0,
    "sparse_weight": 0.0, "camera_rate": 0.0, "point_dropout": 0.0,
    "exposure": False, "structure": 0.0,
}  # fmt: skip
_POSES: dict[str, Any] = {"photometric_weight": 0.0, "geometric_weight": 1.0, "depth_weight": 1.0}

SCHEDULES: dict[str, dict[str, Any]] = {
    "eth3d": _COMMON | {"steps": 40, "rate": 5e-4, "photometric_weight": 0.2},
    "7scenes": _COMMON | {"steps": 40, "rate": 1e-3, "photometric_weight": 0.2},
    "nrgbd": _COMMON | {"steps": 40, "rate": 1e-4, "photometric_weight": 1.0},
    "dtu": _COMMON | {"steps": 50, "rate": 2e-4, "photometric_weight": 1.0},
    "scannet": _COMMON | _POSES | {"steps": 40, "rate": 2e-4},
}
"""Dataset → settings of :class:`tco.options.TCOConfig`."""


def published(dataset: str, given: TCOConfig) -> TCOConfig:
    """The published settings of a dataset, where the user left the defaults, on the published schedule.

    With the published objective, unless the ablations' settings say something else of it.
    """
    default = TCOConfig()
    untouched = {f.name for f in fields(TCOConfig) if getattr(given, f.name) == getattr(default, f.name)}
    own = {name: value for name, value in SCHEDULES[dataset].items() if name in untouched}
    if given.ablation == default.ablation:
        own["ablation"] = replace(default.ablation, published_objective=True)
    return replace(given, **own).reference_schedule()
