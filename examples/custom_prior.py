"""A prior of your own: what is nearly on a plane lies on it.

    python examples/custom_prior.py WORKSPACE [--plane=0,1,0,-1.5]

A floor, a façade or the water are known to be flat. The plane n·X + d = 0 is given in COLMAP's frame, or
found as the one that most of COLMAP's points lie on. With e the distance of a pixel's point from it, in
parts of its depth, the penalty is the mean of e² / (e² + r²) (Geman and McClure 1985): it draws what is
within about r, and leaves alone what is further away, which is not on the plane.

Any function of a view's depth and of the cameras can be such a term: ``tco.terms.ExtraTerm`` gives it a
name, under which the history has it, and a weight. It is lowered together with the others, by the adapters
first and by the refinement of each pixel's depth after that.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from colmap_tco.scene import Scene, open_scene
from colmap_tco.views import ViewConfig
from tco.backbones.weights import load_sweep
from tco.geometry import transform, unproject
from tco.optimize import Outcome, optimize
from tco.options import TCOConfig
from tco.terms import ExtraTerm
from tco.types import Cameras

Floats = NDArray[np.floating]


def plane_term(plane: Floats, weight: float = 0.1, reach: float = 0.02) -> ExtraTerm:
    """The penalty for a plane (4,) in the chunk's frame, as ``Scene.chunk_plane`` gives it."""
    normal, offset = torch.tensor(plane[:3]).float(), float(plane[3])

    def penalty(view: int, depth: Tensor, cameras: Cameras) -> Tensor:
        local = unproject(depth, cameras.K[view]).reshape(-1, 3)
        points = transform(cameras.world_from_cam[view], local)
        e = (points @ normal.to(points) + offset) / depth.reshape(-1)
        return (e.square() / (e.square() + reach**2)).mean()

    return ExtraTerm("plane", weight, penalty)


def dominant_plane(xyz: Floats, reach: float, draws: int = 1000) -> Floats:
    """The plane (4,) through three of the points (N, 3) to which most of them are nearer than ``reach``."""
    rng = np.random.default_rng(0)
    a, b, c = (xyz[rng.integers(len(xyz), size=draws)] for _ in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal, a = normal[length > 0] / length[length > 0, None], a[length > 0]
    offset = -(normal * a).sum(1)
    best = np.argmax((np.abs(normal @ xyz.T + offset[:, None]) < reach).sum(1))
    return np.append(normal[best], offset[best])


def adapt(scene: Scene, plane: Floats | None, config: TCOConfig) -> Outcome:
    """The embedded network, optimised with the plane or, for comparison, without."""
    extra = [] if plane is None else [plane_term(scene.chunk_plane(plane))]
    return optimize(load_sweep(), scene.views, scene.priors, config, extra=extra)


def main() -> None:
    """Optimise without and with the plane, and show how much of the pictures is on it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--plane", help="a,b,c,d of a X + b Y + c Z + d = 0 in COLMAP's frame")
    parser.add_argument("--size", type=int, default=320)
    parser.add_argument("--steps", type=int, default=10)
    args = parser.parse_args()
    scene = open_scene(args.workspace, ViewConfig(max_image_size=args.size))
    if args.plane:
        plane = np.array([float(word) for word in args.plane.split(",")])
    else:
        plane = dominant_plane(scene.tracks.xyz, 0.01 * scene.frame.scale)
        print(f"plane of COLMAP's points: {','.join(f'{value:.6g}' for value in plane)}")
    for given in (None, plane):
        outcome = adapt(scene, given, TCOConfig(steps=args.steps))
        cloud, _ = scene.fuse(outcome.prediction)
        distance = np.abs(cloud.points @ plane[:3] + plane[3]) / np.linalg.norm(plane[:3]) / scene.frame.scale
        near = distance < 0.03
        what = "without the plane" if given is None else "with it"
        print(
            f"{what}: {near.mean():.0%} of {len(cloud)} points are near, at a median distance of "
            f"{np.median(distance[near]):.2%} of the scene's depth"
        )


if __name__ == "__main__":
    main()
