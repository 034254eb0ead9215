"""A network of your own in one file: depth by attention from pixels to COLMAP's points, adapted to the scene.

    python examples/custom_backbone.py WORKSPACE

Each pixel looks at the triangulated points of its view. How much it takes from each follows from a learnt
metric on position and colour, a single linear layer; its inverse depth is the mean of theirs with these
weights. That is kernel regression (Nadaraya 1964, Watson 1964), and the metric is what low-rank adapters
change at test time.

The class is all that the library needs: a ``Backbone`` (``tco/backbones/base.py``) encodes the views once,
decodes the views of a step differentiably, and names the module whose layers are adapted. Exchange its body
for your own network. One that predicts its cameras sets ``uses_cameras = False``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from colmap_tco.scene import Scene, open_scene
from colmap_tco.views import ViewConfig
from tco.geometry import pixel_grid, sample
from tco.optimize import Outcome, optimize
from tco.options import TCOConfig
from tco.terms import errors_at_points
from tco.types import Cameras, Prediction, Priors, SparseDepth, Views


@dataclass(frozen=True)
class Encoded:
    """What does not change in a chunk: pixels and points as features, and the cameras."""

    pixels: Tensor  # (V, H, W, 5): position in halves of the width, and colour
    images: Tensor  # (V, 3, H, W)
    points: tuple[SparseDepth, ...]
    cameras: Cameras


class Interpolator(nn.Module):
    """Inverse depth of a pixel: mean over the points of its view, weighted by exp(−|M (pixel − point)|²)."""

    name = "interpolator"
    stride = 8  # the canvas has sides of multiples of this
    uses_cameras = True  # they are not predicted, so COLMAP's stand

    def __init__(self, reach: float = 0.1, colour: float = 0.3) -> None:
        """Begin with a metric of a reach in halves of the width, and of one in colours between 0 and 1."""
        super().__init__()
        self.metric = nn.Linear(5, 5, bias=False)
        scales = torch.tensor([reach, reach, colour, colour, colour])
        self.metric.weight = nn.Parameter(torch.diag(1 / scales))

    def encode(self, views: Views, priors: Priors) -> Encoded:
        """Once for a chunk, without gradients."""
        if priors.cameras is None or priors.sparse is None:
            raise ValueError(f"{self.name} needs cameras and sparse points")
        h, w = views.size
        position = pixel_grid(h, w, views.images).expand(len(views), h, w, 2) / (w / 2)
        pixels = torch.cat([position, views.images.permute(0, 2, 3, 1)], -1)
        return Encoded(pixels, views.images, priors.sparse, priors.cameras)

    def with_points(self, encoded: Encoded, points: Mapping[int, SparseDepth]) -> Encoded:
        """Each step hides some points of its view and asks for their depth: here are the others."""
        shown = tuple(points.get(i, own) for i, own in enumerate(encoded.points))
        return replace(encoded, points=shown)

    def decode(
        self, encoded: Encoded, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        """In every step, with gradients; ``context``, the last prediction of all views, is of no use here."""
        chosen = tuple(range(len(encoded.points)) if views is None else views)
        depth, confidence = zip(*(self._one(encoded, view) for view in chosen), strict=True)
        return Prediction(torch.stack(depth), torch.stack(confidence), encoded.cameras, chosen)

    def _one(self, encoded: Encoded, view: int) -> tuple[Tensor, Tensor]:
        """Depth and confidence (H, W) of one view."""
        points, pixels = encoded.points[view], encoded.pixels[view]
        h, w, _ = pixels.shape
        colour = sample(encoded.images[view][None], points.xy[None])[0].T
        keys = self.metric(torch.cat([points.xy / (w / 2), colour], 1))
        distance = torch.cdist(self.metric(pixels.reshape(h * w, 5)), keys).square()
        weight = torch.softmax(-distance, 1)  # (H W, N)
        inverse = weight @ (1 / points.depth)
        # As calibrated for the embedded network: 1 + 0.02 / expected relative error, here the points' spread.
        variance = (weight * (1 / points.depth - inverse[:, None]).square()).sum(1)
        error = 0.01 + variance.clamp_min(0).sqrt() / inverse
        confidence = 1 + 0.02 / error
        return (1 / inverse).reshape(h, w), confidence.reshape(h, w).detach()

    def decoder(self) -> nn.Module:
        """Where ``lora_targets`` are looked for."""
        return self


def adapt(scene: Scene, steps: int) -> Outcome:
    """The network, optimised on a scene; 0 steps: as it begins."""
    config = TCOConfig(steps=steps, rate=0.01, lora_rank=2, lora_targets=("metric",))
    return optimize(Interpolator(), scene.views, scene.priors, config, watched=scene.held_out)


def main() -> None:
    """Depths with and without optimisation, judged at points that neither was given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--steps", type=int, default=30)
    args = parser.parse_args()
    scene = open_scene(args.workspace, ViewConfig(max_image_size=args.size), Interpolator.stride)
    for steps in (0, args.steps):
        outcome = adapt(scene, steps)
        errors = torch.cat(errors_at_points(outcome.prediction, scene.held_out)).abs()
        print(f"{steps} steps: median error at held-out points {errors.median():.2%}")
    cloud, _ = scene.fuse(outcome.prediction)
    print(f"{len(cloud)} points in the fused cloud")


if __name__ == "__main__":
    main()
