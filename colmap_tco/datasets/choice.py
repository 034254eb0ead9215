"""Which frames the published evaluations take.

7-Scenes, NRGBD, ETH3D, DTU: ``configs/data/mv_recon.yaml`` and ``datasets/seq-id-maps`` of π³'s branch
``evaluation``, which TCO uses too; every so-manieth frame from the first on. TCO's runs (arXiv 2604.03878,
section 4.1.1; ``scripts/`` of its code) take the sparse settings of 7-Scenes and NRGBD, 200 and 500, and 5
for ETH3D and DTU. The dense settings, 40 and 100, are π³'s alone. ScanNet: six views at strides 1, 4 and 16
of the 90 prepared ones (``configs/evaluation/relpose-distance.yaml`` of TCO, ``pose_eval_stride`` and
``pose_eval_num_frames``).
"""

from __future__ import annotations

from dataclasses import dataclass

from colmap_tco.errors import InputError


@dataclass(frozen=True)
class Choice:
    """Every so-manieth frame, at most so many.

    Attributes:
        stride: positive.
        limit: number of frames, None for all.
    """

    stride: int
    limit: int | None = None

    def frames(self, count: int) -> list[int]:
        """Positions of the chosen of ``count`` frames."""
        return list(range(0, count, self.stride))[: self.limit]


CHOICES: dict[str, dict[str, Choice]] = {
    "eth3d": {"stride5": Choice(5)},
    "dtu": {"stride5": Choice(5)},
    "7scenes": {"sparse": Choice(200), "dense": Choice(40)},
    "nrgbd": {"sparse": Choice(500), "dense": Choice(100)},
    "scannet": {"stride1": Choice(1, 6), "stride4": Choice(4, 6), "stride16": Choice(16, 6)},
}
"""Dataset → setting → its frames; the first setting is the one that is meant if none is named."""


def choice(dataset: str, setting: str = "") -> tuple[str, Choice]:
    """A setting of a dataset, and what it is called.

    Raises:
        InputError: the dataset has no such setting.
    """
    settings = CHOICES[dataset]
    name = setting or next(iter(settings))
    if name not in settings:
        raise InputError(f"--setting {setting}: {dataset} has {', '.join(settings)}")
    return name, settings[name]
