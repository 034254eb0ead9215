"""Densify a workspace from Python, and read what was written.

    python examples/quickstart.py WORKSPACE

WORKSPACE holds ``images/`` and, if there is one, COLMAP's ``sparse/``; without one the images are mapped
first. ``make demo`` leaves such a folder in ``demo/``. The same from a shell: ``colmap-tco densify
WORKSPACE``.
"""

from __future__ import annotations

import argparse
import json
import logging
from pathlib import Path

import numpy as np

from colmap_tco.densify import DensifyConfig, densify
from colmap_tco.errors import DensifyError, PartlyDoneError
from colmap_tco.maps import read_map
from colmap_tco.ply import read_ply
from colmap_tco.views import ViewConfig
from colmap_tco.workspace import dense_paths
from tco.options import TCOConfig


def main() -> None:
    """Densify, then look at the cloud, at one depth map and at the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument(
        "--size", type=int, default=0, help="longer side of the network's pictures; 0: its own"
    )
    parser.add_argument("--steps", type=int, default=TCOConfig().steps, help="0: the network alone")
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")

    # Every flag of the command line is a field of a dataclass: --max_image_size is ViewConfig's.
    config = DensifyConfig(views=ViewConfig(max_image_size=args.size), tco=TCOConfig(steps=args.steps))
    try:
        densify(args.workspace, config)
    except PartlyDoneError as error:  # everything is written; some images had to be left out
        print(error)
    except DensifyError as error:  # the message says what to do about it
        raise SystemExit(str(error)) from error

    paths = dense_paths(args.workspace)  # workspace/dense-tco, a dense workspace as COLMAP has it
    points, normals, colors = read_ply(paths.ply)  # (N, 3) each, in COLMAP's frame
    red, green, blue = colors.mean(0).round()
    print(f"{paths.ply}: {len(points)} points, {len(normals)} normals, mean colour {red}, {green}, {blue}")

    report = json.loads(paths.report.read_text("utf-8"))
    name = next(name for name, view in report["views"].items() if view["state"] == "used")
    depth = read_map(paths.depth_map(name))  # (H, W) along the optical axis, in COLMAP units; 0: none
    low, high = np.quantile(depth[depth > 0], [0.05, 0.95])
    print(f"{paths.depth_map(name)}: {depth.shape[1]}×{depth.shape[0]}, depths from {low:.3g} to {high:.3g}")

    held = report["held_out"]  # points of the model that the optimisation did not see
    if held["points"]:
        print(f"{100 * held['within_5_percent']:.0f} % of {held['points']} held-out points within 5 %")


if __name__ == "__main__":
    main()
