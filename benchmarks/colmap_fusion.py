"""Fuse a result with COLMAP's own stereo fusion and compare the two clouds.

``python -m benchmarks.colmap_fusion workspace/dense-tco`` prints the points of each, and the share of each
that lies within a hundredth of the scene's extent of the other.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from colmap_tco import _pycolmap
from colmap_tco.ply import read_ply


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dense", type=Path)
    dense = parser.parse_args().dense
    pycolmap = _pycolmap.load()
    with tempfile.TemporaryDirectory() as out:
        model = pycolmap.stereo_fusion(out, str(dense), input_type="geometric")
    theirs = np.array([point.xyz for point in model.points3D.values()])
    ours = read_ply(dense / "fused.ply")[0]
    low, high = np.percentile(ours, [5, 95], axis=0)
    extent = float(np.linalg.norm(high - low))
    sys.stdout.write(
        "| cloud | points | median distance to the other / extent | within 1 % |\n|---|---|---|---|\n"
    )
    for name, a, b in (("COLMAP's", theirs, ours), ("ours", ours, theirs)):
        away = cKDTree(b).query(a)[0] / extent
        sys.stdout.write(f"| {name} | {len(a)} | {np.median(away):.2%} | {(away < 0.01).mean():.1%} |\n")


if __name__ == "__main__":
    main()
