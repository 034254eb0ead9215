"""From a COLMAP workspace to a cloud, step by step, with everything in memory.

    python examples/python_api.py WORKSPACE [-o cloud.ply]

Each line is a stage of ``colmap_tco/densify.py``, which also splits large scenes into chunks, writes
COLMAP's formats and goes on after an interruption. The result is the same. To begin an experiment of your
own, take ``colmap_tco.scene.open_scene``, which is the first half of this in one call.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from colmap_tco.chunks import source_views
from colmap_tco.fusion import fuse
from colmap_tco.outputs import ViewMaps
from colmap_tco.ply import Cloud, write_ply
from colmap_tco.predict import view_maps
from colmap_tco.priors import build_priors, chunk_frame
from colmap_tco.scene import fusion_views
from colmap_tco.tracks import covisibility, read_tracks
from colmap_tco.views import ViewConfig, batch, make_views
from colmap_tco.workspace import open_workspace
from tco.backbones.weights import load_sweep
from tco.conclusion import concluded
from tco.optimize import optimize
from tco.options import TCOConfig
from tco.terms import errors_at_points


def reconstruct(root: Path, size: int, config: TCOConfig) -> tuple[Cloud, dict[str, ViewMaps], torch.Tensor]:
    """The cloud of a workspace, the maps of its views, and the relative errors at held-out points (N,)."""
    network = load_sweep()

    # Workspace: the model with most images, and the images as the network sees them: undistorted, small.
    workspace = open_workspace(root)
    images, skipped = make_views(workspace, ViewConfig(max_image_size=size), network.stride)
    for name, why in skipped.items():
        print(f"{name} is left out: {why}")
    tracks = read_tracks(workspace.model)

    # One chunk: the first camera is its world, and the median depth its unit, so that float32 is enough.
    frame = chunk_frame(tracks, images)
    views, _ = batch(images, frame)

    # Priors: cameras and points, each with a standard deviation; a tenth of the points is held out.
    priors = build_priors(tracks, images, frame)

    # Test-time optimisation. The network is as before when this returns; steps=0 would leave it alone.
    outcome = optimize(network, views, priors.optimise, config)

    # Consensus: each pixel's depth by what all views that see the place say of it; planes among these; then
    # depths that others contradict give way.
    agreement = concluded(outcome, views, priors.optimise, config).agreement
    errors = torch.cat(errors_at_points(agreement.prediction, priors.held_out))

    # Back to COLMAP's units, with a normal for each depth.
    own, maps = (
        [view_maps(v, prediction, i, views.valid, frame.scale, error) for i, v in enumerate(images)]
        for prediction, error in ((outcome.prediction, None), (agreement.prediction, agreement.error))
    )

    # Fusion: what several views found each by itself, gaps filled with what they agreed on; coloured from the
    # full images.
    neighbours = source_views(covisibility(tracks, [view.image_id for view in images]), 50)
    own_views, agreed_views = (fusion_views(images, m, neighbours, tracks) for m in (own, maps))
    cloud, report = fuse(own_views, agreed=agreed_views)
    print({name: count for name, count in report.pixels.items() if count})
    return cloud, {view.name: result for view, result in zip(images, maps, strict=True)}, errors


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("cloud.ply"))
    parser.add_argument("--size", type=int, default=320)
    parser.add_argument("--steps", type=int, default=10)
    args = parser.parse_args()
    cloud, _, errors = reconstruct(args.workspace, args.size, TCOConfig(steps=args.steps))
    write_ply(args.output, cloud.points, cloud.normals, cloud.colors)
    print(f"{args.output}: {len(cloud)} points; median error at held-out points {errors.abs().median():.2%}")


if __name__ == "__main__":
    main()
