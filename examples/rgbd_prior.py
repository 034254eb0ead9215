"""Depth maps of a sensor as a prior, each pixel with its standard deviation.

    python examples/rgbd_prior.py WORKSPACE DEPTHS [--unit 0.001]

DEPTHS holds ``NAME.png``, 16 bits, for each picture NAME.jpg: the sensor's depth in the pixels of that
picture, 0 where it has none, in units of 0.001 (millimetres, as most RGB-D sets have it). They are moved
into the pictures that the network sees, scaled to COLMAP's unit by the median ratio to its points, and held
as well as the sensor is exact: for a Kinect σ(z) = 1.2 mm + 1.9 mm · (z / m − 0.4)² (Nguyen, Izadi and
Lovell 2012). Holes are filled by the network, whose depths next to them are right now.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from colmap_tco.scene import Scene, open_scene
from colmap_tco.views import View, ViewConfig, canvas_size, crop, original_from_network
from tco.backbones.weights import load_sweep
from tco.optimize import Outcome, optimize
from tco.options import PolishConfig, TCOConfig
from tco.terms import errors_at_points
from tco.types import Priors


def kinect(metres: Tensor) -> Tensor:
    """Standard deviation in metres of a Kinect's depth (any shape) in metres."""
    return 0.0012 + 0.0019 * (metres - 0.4).square()


def sensor_depth(view: View, folder: Path, unit: float) -> Tensor:
    """The sensor's depth in metres at the pixels (h, w) of the network's picture; 0: none."""
    path = folder / f"{Path(view.name).stem}.png"
    measured = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if measured is None:
        return torch.zeros(view.network.height, view.network.width)
    x, y = np.meshgrid(np.arange(view.network.width) + 0.5, np.arange(view.network.height) + 0.5)
    xy = original_from_network(view, np.stack([x, y], -1).reshape(-1, 2))
    # The nearest measurement: a mean across an edge would be a depth at which there is nothing.
    col, row = np.floor(np.nan_to_num(xy, nan=-1)).astype(int).T
    h, w = measured.shape
    inside = (col >= 0) & (col < w) & (row >= 0) & (row < h)
    depth = np.where(inside, measured[row.clip(0, h - 1), col.clip(0, w - 1)] * unit, 0.0)
    return torch.from_numpy(depth.reshape(x.shape)).float()


def with_depth(
    scene: Scene, folder: Path, unit: float, noise: Callable[[Tensor], Tensor] = kinect
) -> tuple[Priors, float]:
    """The scene's priors with the sensor's depth, and metres per COLMAP unit."""
    assert scene.priors.sparse is not None
    metres = torch.zeros(len(scene.images), *canvas_size(scene.images))
    for i, view in enumerate(scene.images):
        crop(view, metres[i])[:] = sensor_depth(view, folder, unit)
    ratios = []
    for own, points in zip(metres, scene.priors.sparse, strict=True):
        x, y = points.xy.long().unbind(1)
        there = own[y, x] > 0
        ratios.append(own[y, x][there] / points.depth[there])
    metres_per_unit = float(torch.cat(ratios).median())  # of the chunk
    sigma = noise(metres) / metres.clamp_min(1e-3)  # relative, as all standard deviations of depths are
    known = replace(scene.priors, depth=metres / metres_per_unit, depth_sigma=sigma)
    return known, metres_per_unit / scene.frame.scale


def adapt(scene: Scene, priors: Priors, steps: int) -> Outcome:
    """The embedded network, optimised with the sensor's depths where these are among the priors."""
    config = TCOConfig(steps=steps)
    if priors.depth is not None:
        # A sensor knows more of each pixel than colours do: more and larger steps on the depths themselves.
        polish = PolishConfig(polish_looks=20, polish_rate=4e-3)
        config = TCOConfig(steps=steps, depth_weight=0.1, polish=polish)
    return optimize(load_sweep(), scene.views, priors, config)


def main() -> None:
    """Depths without and with the sensor, judged at held-out points of COLMAP."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("depths", type=Path)
    parser.add_argument("--unit", type=float, default=0.001, help="metres of one step of the PNG files")
    parser.add_argument("--size", type=int, default=320)
    parser.add_argument("--steps", type=int, default=10)
    args = parser.parse_args()
    scene = open_scene(args.workspace, ViewConfig(max_image_size=args.size))
    known, metres = with_depth(scene, args.depths, args.unit)
    print(f"one COLMAP unit is {metres:.4g} m")
    for what, priors in (("without", scene.priors), ("with", known)):
        outcome = adapt(scene, priors, args.steps)
        errors = torch.cat(errors_at_points(outcome.prediction, scene.held_out)).abs()
        print(f"{what} the sensor: median error at held-out points {errors.median():.2%}")


if __name__ == "__main__":
    main()
