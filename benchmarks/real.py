"""Sets as the optimisation sees them, with the true depth in the same pixels and unit.

Sets are those of ``benchmarks/sets.py``.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks.sets import SETS, known, workspace
from benchmarks.tables import to_file
from colmap_tco.priors import PriorSet, build_priors, chunk_frame
from colmap_tco.published import NETWORKS
from colmap_tco.tracks import read_tracks
from colmap_tco.views import ViewConfig, batch, make_views, original_from_network
from colmap_tco.workspace import open_workspace
from tco.types import Prediction, Priors, Views

SIZE = NETWORKS["sweep"].image_size
"""Longer side, pixels, of the pictures that densify gives the embedded network by itself."""


@dataclass(frozen=True)
class RealSet:
    """Views of one set, what COLMAP knows of them, and the measured depth (V, H, W), 0 where unknown.

    ``metres`` are those of one unit of depths and cameras.
    """

    name: str
    views: Views
    priors: PriorSet
    truth: Tensor
    metres: float = 1.0

    @property
    def given(self) -> Priors:
        """What the optimisation may use."""
        return self.priors.optimise


def load(name: str, size: int, count: int = 0, stride: int = 16) -> RealSet:
    """The first ``count`` views of a set (0: all), longer sides ``size`` pixels, multiples of ``stride``.

    Raises:
        SystemExit: as :func:`benchmarks.sets.workspace`.
    """
    return load_from(workspace(name), name, size, count, stride)


def load_from(root: Path, name: str, size: int, count: int = 0, stride: int = 16) -> RealSet:
    """As :func:`load`, of a workspace anywhere that has its truth beside it, as the shared sets have."""
    opened = open_workspace(root)
    views, _ = make_views(opened, ViewConfig(max_image_size=size), stride)
    views = views[: count or len(views)]
    tracks = read_tracks(opened.model)
    frame = chunk_frame(tracks, views)
    unit = json.loads((root / "gt" / "gt.json").read_text())["metres_per_colmap_unit"] * frame.scale
    truth = []
    for view in views:
        file = root / "gt" / "depth" / f"{Path(view.name).stem}.png"
        measured = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000 / unit
        h, w = view.network.height, view.network.width
        x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
        at = np.floor(original_from_network(view, np.stack([x, y], -1).reshape(-1, 2))).astype(int)
        at, limit = at.reshape(h, w, 2), np.array(measured.shape[::-1])
        inside = ((at >= 0) & (at < limit)).all(-1)
        depth = np.zeros((h, w), np.float32)
        depth[inside] = measured[at[inside][:, 1], at[inside][:, 0]]
        truth.append(torch.from_numpy(depth))
    priors = build_priors(tracks, views, frame)
    return RealSet(name, batch(views, frame)[0], priors, torch.stack(truth), unit)


def within(prediction: Prediction, truth: Tensor, share: float = 0.05) -> float:
    """Share of the measured pixels whose predicted depth is within ``share`` of the truth."""
    error = (prediction.depth / truth.clamp_min(1e-6) - 1).abs()
    return float((error < share)[truth > 0].float().mean())


def median_error(prediction: Prediction, truth: Tensor) -> float:
    """Median relative error of the depth over the measured pixels."""
    return float((prediction.depth / truth.clamp_min(1e-6) - 1).abs()[truth > 0].median())


def arguments(description: str, sets: tuple[str, ...] = SETS) -> argparse.ArgumentParser:
    """A parser with what all measurements share; ``sets`` are those that are taken if none are named."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("--sets", nargs="+", default=list(sets), type=known)
    parser.add_argument("--size", type=int, default=192, help="longer side of the views, pixels")
    parser.add_argument("--views", type=int, default=8, help="views of each set; 0 is all")
    parser.add_argument("--steps", type=int, default=24)
    parser.add_argument("--weights", type=Path, default=None, help="file of weights instead of the package's")
    to_file(parser)
    return parser
