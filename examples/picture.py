"""Draw a cloud as a picture: ``python -m examples.picture WORKSPACE/dense-tco cloud.png``."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco.ply import read_ply

Floats = NDArray[np.float64]


def draw(
    points: Floats,
    colors: NDArray[np.uint8],
    cam_from_world: Floats,
    focal: float,
    size: tuple[int, int],
    dot: int = 2,
) -> NDArray[np.uint8]:
    """Points as squares of ``dot`` pixels, near over far, on white; RGB (H, W, 3)."""
    h, w = size
    local = points @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    ahead = local[:, 2] > 1e-6
    local, colors = local[ahead], colors[ahead]
    xy = np.floor(local[:, :2] / local[:, 2:] * focal + np.array([w / 2, h / 2])).astype(int)
    picture = np.full((h, w, 3), 255, np.uint8)
    order = np.argsort(-local[:, 2], kind="stable")
    for dx in range(dot):
        for dy in range(dot):
            x, y = xy[order, 0] + dx, xy[order, 1] + dy
            inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
            flat = y[inside] * w + x[inside]
            # Of several points in one pixel the last in the order, the nearest, is kept.
            last, index = np.unique(flat[::-1], return_index=True)
            picture.reshape(-1, 3)[last] = colors[order][inside][::-1][index]
    return picture


def viewpoints(model_path: Path, points: Floats) -> list[tuple[Floats, float, float]]:
    """Three views of a cloud: as its middle camera saw it, and from either side and above.

    Returns:
        (cam_from_world (3, 4), focal length over image width, aspect height / width) of each.
    """
    entries = _pycolmap.registered(_pycolmap.read_model(model_path))
    poses = [np.asarray(e.cam_from_world, float) for e in entries]
    centres = np.array([-m[:, :3].T @ m[:, 3] for m in poses])
    middle = int(np.argmin(((centres - centres.mean(0)) ** 2).sum(1)))
    width, height = _pycolmap.camera_size(entries[middle].camera)
    focal = _pycolmap.focal_lengths(entries[middle].camera)[0] / width
    base = poses[middle]
    depth = float(np.median(points @ base[2, :3] + base[2, 3]))
    views = []
    for yaw, pitch, back in ((0.0, 0.0, 0.0), (0.45, 0.25, 0.35), (-0.45, 0.25, 0.35)):
        turn = cv2.Rodrigues(np.array([pitch, yaw, 0.0]))[0]
        # Turn around the point in the middle of the picture at the median depth, then step back.
        shift = np.array([0, 0, depth]) - turn @ np.array([0, 0, depth]) + np.array([0, 0, back * depth])
        views.append(
            (np.column_stack([turn @ base[:, :3], turn @ base[:, 3] + shift]), focal, height / width)
        )
    return views


def cloud_picture(dense: Path, width: int = 640) -> NDArray[np.uint8]:
    """Three renderings of ``fused.ply`` side by side, RGB."""
    points, _, colors = read_ply(dense / "fused.ply")
    panels = []
    for pose, focal, aspect in viewpoints(dense / "sparse", points):
        size = (round(width * aspect), width)
        panels.append(draw(points, colors, pose, focal * width, size))
    return np.concatenate(panels, 1)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dense", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    cv2.imwrite(str(args.out), cloud_picture(args.dense)[..., ::-1])


if __name__ == "__main__":
    main()
