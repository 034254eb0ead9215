"""Readers of the datasets that the paper evaluates on, in the layouts in which they are published."""

from __future__ import annotations

from pathlib import Path

from colmap_tco.datasets.base import Dataset, Frame, Scene
from colmap_tco.datasets.choice import CHOICES, Choice, choice
from colmap_tco.datasets.dtu import DTU
from colmap_tco.datasets.eth3d import ETH3D
from colmap_tco.datasets.nrgbd import NRGBD
from colmap_tco.datasets.scannet import ScanNet
from colmap_tco.datasets.seven_scenes import SevenScenes

__all__ = [
    "CHOICES", "DTU", "ETH3D", "NRGBD", "Choice", "Dataset", "Frame", "ScanNet", "Scene", "SevenScenes",
    "choice", "open_dataset",
]  # fmt: skip


def open_dataset(name: str, root: Path, as_published: bool = False) -> Dataset:
    """The reader of a dataset.

    Args:
        name: one of ``CHOICES``.
        root: its folder.
        as_published: 7-Scenes alone: with the focal length and poses of the published evaluations.

    Raises:
        InputError: the folder is not there.
        KeyError: there is no such dataset.
    """
    if name == "7scenes":
        return SevenScenes(root, as_published)
    readers: dict[str, type[ETH3D] | type[DTU] | type[NRGBD] | type[ScanNet]] = {
        "eth3d": ETH3D, "dtu": DTU, "nrgbd": NRGBD, "scannet": ScanNet,
    }  # fmt: skip
    return readers[name](root)
