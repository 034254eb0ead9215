"""Poses from depth: how far rough poses come back when the sensor's depths are known.

    python -m benchmarks.poses [--sets kitchen office livingroom] [--seeds 0 1] [--output docs/poses.md]

COLMAP's poses, in metres, are turned about a random axis by a normal angle (3°) and moved in a random
direction by a normal length (5 % of the mean distance of the centres from their middle). They go into
the command as a TUM trajectory with COLMAP's camera, with the sensor's depth maps. ATE and RPE are
root mean squares after Umeyama's alignment with scale, by evo, against COLMAP's. COLMAP, camera and depth
themselves agree to 0.5 to 2 %, so that errors of some millimetres cannot be told from the truth's: rows
``exact`` start from COLMAP's own poses and say where the depths would have them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.sets import SETS, SHARED
from benchmarks.tables import publish, to_file
from colmap_tco import _pycolmap
from colmap_tco.evaluation.sources import read_cameras, read_tum, world_from_cam
from colmap_tco.evaluation.trajectory import TrajectoryFigures, trajectory_figures
from colmap_tco.poses import PosesConfig, poses
from colmap_tco.progress import Progress
from colmap_tco.rough import RoughConfig
from tco.pose_options import PoseConfig

ROTATION, TRANSLATION = 3.0, 0.05


def perturbed(world: np.ndarray, seed: int) -> np.ndarray:
    """Poses (V, 4, 4) with normal errors: angles about random axes, shares of the centres' distance."""
    from scipy.spatial.transform import Rotation

    rng, out, centre = np.random.default_rng(seed), world.copy(), world[:, :3, 3]
    unit = np.linalg.norm(centre - centre.mean(0), axis=1).mean()
    for pose in out:
        axis, way = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
        pose[:3, :3] = (
            pose[:3, :3] @ Rotation.from_rotvec(np.radians(ROTATION) * rng.normal() * axis).as_matrix()
        )
        pose[:3, 3] += TRANSLATION * unit * rng.normal() * way
    return out


def write_tum(path: Path, world: np.ndarray) -> None:
    """A trajectory whose timestamps are the places in the order."""
    from scipy.spatial.transform import Rotation

    rows = [
        [place, *pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        for place, pose in enumerate(world)
    ]
    np.savetxt(path, np.array(rows), fmt="%.12g")


def measured(
    name: str, seed: int | None, config: PoseConfig
) -> tuple[float, TrajectoryFigures, TrajectoryFigures, float]:
    """Mean distance of the centres, figures before and after, and seconds; no seed: COLMAP's own poses."""
    root = SHARED / "data" / name
    known = json.loads((root / "gt" / "gt.json").read_text(encoding="utf-8"))
    entries = read_cameras(root / known["model"])
    truth = world_from_cam([entries[image] for image in sorted(entries)])
    truth[:, :3, 3] *= known["metres_per_colmap_unit"]
    rough = truth if seed is None else perturbed(truth, seed)
    camera = next(iter(entries.values())).camera
    with tempfile.TemporaryDirectory() as folder:
        images = Path(folder) / "images"
        images.mkdir()
        for image in entries:
            (images / image).symlink_to(root / "images" / image)
        write_tum(Path(folder) / "rough.txt", rough)
        given = RoughConfig(
            rough=Path(folder) / "rough.txt", match="order", camera_model=str(camera.model.name),
            camera_params=tuple(np.asarray(camera.params, float).tolist()),
        )  # fmt: skip
        found = poses(
            images, PosesConfig(depths=root / "gt" / "depth", rough=given, poses=config), Progress()
        )
        ours = read_tum(found.folder / "trajectory.txt").poses
    centre = truth[:, :3, 3]
    unit = np.linalg.norm(centre - centre.mean(0), axis=1).mean()
    return (
        float(unit),
        trajectory_figures(rough, truth),
        trajectory_figures(ours, truth),
        found.report["seconds"],
    )


def row(name: str, seed: int | None, config: PoseConfig) -> str:
    """A line of the table."""
    unit, before, after, seconds = measured(name, seed, config)
    pairs = [
        f"{1000 * before.ate_rmse:.1f} → {1000 * after.ate_rmse:.1f}",
        f"{1000 * before.rpe_translation:.1f} → {1000 * after.rpe_translation:.1f}",
        f"{before.rpe_rotation_deg:.2f} → {after.rpe_rotation_deg:.2f}",
    ]
    start = "exact" if seed is None else f"seed {seed}"
    return f"| {name} | {1000 * unit:.0f} | {start} | " + " | ".join(pairs) + f" | {seconds:.0f} |"


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=SETS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--exact", action="store_true", help="start from COLMAP's own poses, too")
    parser.add_argument("--photometric", type=float, default=PoseConfig().photometric)
    parser.add_argument("--geometric", type=float, default=PoseConfig().geometric)
    to_file(parser)
    return parser


def main() -> None:
    """Measure and publish, row by row."""
    args = parser().parse_args()
    _pycolmap.load()
    config = replace(PoseConfig(), photometric=args.photometric, geometric=args.geometric)
    lines = [
        f"geometric {config.geometric:g}, photometric {config.photometric:g}, sizes {config.sizes}\n",
        "| set | mean distance mm | start | ATE mm | RPE translation mm | RPE rotation ° | seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in args.sets:
        for seed in [*args.seeds, *([None] if args.exact else [])]:
            lines.append(row(name, seed, config))
            publish("\n".join(lines) + "\n" if args.output else lines[-1] + "\n", args.output, args.part)


if __name__ == "__main__":
    main()
