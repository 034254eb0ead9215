"""Hand a finished result to a trainer of 3D Gaussian splats, and look at what it gets.

    python examples/quickstart.py WORKSPACE
    python examples/export_splatting.py WORKSPACE [--points 400000]

Writes ``WORKSPACE/dense-tco-3dgs/`` with undistorted ``images/`` and ``sparse/0``: PINHOLE cameras, and the
dense cloud as points with tracks. The original trainer reads it with ``train.py -s
WORKSPACE/dense-tco-3dgs``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from colmap_tco import _pycolmap
from colmap_tco.export.command import ExportConfig, export
from colmap_tco.ply import read_ply


def main() -> None:
    """Export, then read the model back as a trainer does."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--points", type=int, default=400_000, help="most points that a trainer starts from")
    args = parser.parse_args()

    done = export("3dgs", args.workspace, ExportConfig(max_points=args.points, overwrite=True))
    print(done.summary())

    model = _pycolmap.load().Reconstruction(str(done.path / "sparse" / "0"))
    cameras = {camera.model.name for camera in model.cameras.values()}
    tracks = np.array([point.track.length() for point in model.points3D.values()])
    print(f"{model.num_images()} images, {', '.join(cameras)}; {tracks.mean():.1f} of them see a point")

    # The first Gaussians are as large as the points are apart: an even choice matters more than many points.
    points, _, _ = read_ply(done.path / "sparse" / "0" / "points3D.ply")
    size = np.ptp(np.quantile(points, [0.05, 0.95], axis=0), axis=0)
    print(f"{len(points)} points, nine tenths of them within {size[0]:.3g} × {size[1]:.3g} × {size[2]:.3g}")


if __name__ == "__main__":
    main()
