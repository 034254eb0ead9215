"""Rendered scenes unlike those that the embedded network is trained on, in the form of the shared real sets.

    python -m benchmarks.rendered runs/rendered [--scenes hills knots walk temple]

Training scenes are made of boxes, spheres, cylinders and slabs by the tracer in ``training/``. These are
triangle meshes (Open3D's Embree), with colours from a noise of their own: ``hills``, a displaced ground with
standing stones seen from the air; ``knots``, thin curved bodies over a table; ``walk``, the room of the demo,
which training never sees; and ``temple``, columns under a clouded sky, which has no depth. Each becomes a
workspace with ``images/``, ``sparse/`` made by COLMAP, and ``gt/`` as ``../shared/tools/score.py`` reads it;
one unit of the scene is a metre.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco.mapping import ensure_model
from examples.demo import spread
from training.paths import look_at
from training.scenes import Sample, walk

Floats = NDArray[np.float64]
SHAPE = (480, 640)
VIEWS = 12


def noise(points: Floats, octaves: int, seed: int) -> Floats:
    """Value noise (N,) in [0, 1] at points (N, 3): random numbers on a lattice, smoothly interpolated."""
    table = np.random.default_rng(seed).random(1 << 16)
    total, weight, out = 0.0, 1.0, np.zeros(len(points))
    for octave in range(octaves):
        scaled = points * 2.0**octave + 17.3 * octave
        cell = np.floor(scaled).astype(np.int64)
        t = scaled - cell
        t = t * t * (3 - 2 * t)
        value = np.zeros(len(points))
        for corner in np.ndindex(2, 2, 2):
            at = cell + np.array(corner)
            key = (at * np.array([73856093, 19349663, 83492791])).sum(-1)
            share = np.where(np.array(corner) == 1, t, 1 - t).prod(-1)
            value += share * table[(key ^ (key >> 13)) & 0xFFFF]
        out += weight * value
        total, weight = total + weight, 0.6 * weight
    return out / total


def painted(points: Floats, scale: float, seed: int) -> Floats:
    """Linear colours (N, 3) of a material that varies in brightness and hue."""
    light, hue = noise(points * scale, 5, seed), noise(points * 0.3 * scale, 2, seed + 1)
    ends = np.random.default_rng(seed).uniform(0.1, 0.9, (2, 3))
    contrast = 1 / (1 + np.exp(-14 * (light - 0.5)))
    return (0.25 + 0.75 * contrast[:, None]) * (ends[0] + hue[:, None] * (ends[1] - ends[0]))


def hills() -> tuple[list, list[Floats]]:
    """A displaced ground with stones, and an arc of cameras above it."""
    import open3d as o3d

    n = 400
    x, y = np.meshgrid(np.linspace(-6, 6, n), np.linspace(-6, 6, n))
    flat = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    z = 1.6 * noise(flat * 0.35 + 3, 4, 5)
    corners = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([corners, corners + 1, corners + n], -1),
            np.stack([corners + 1, corners + n + 1, corners + n], -1),
        ]
    )
    ground = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(np.c_[flat[:, :2], z]), o3d.utility.Vector3iVector(faces)
    )
    bodies, rng = [ground], np.random.default_rng(2)
    for _ in range(9):
        stone = o3d.geometry.TriangleMesh.create_cylinder(rng.uniform(0.1, 0.35), rng.uniform(1, 2.4), 24, 8)
        points = np.asarray(stone.vertices)
        points *= 1 + 0.3 * (noise(points * 2.5 + 9, 3, 7)[:, None] - 0.5)
        stone.vertices = o3d.utility.Vector3dVector(points + np.r_[rng.uniform(-3, 3, 2), 1.0])
        bodies.append(stone)
    turns = np.linspace(-0.6, 0.6, VIEWS)
    eyes = [np.array([7 * np.sin(t), -7 * np.cos(t), 4.6 + 0.4 * np.sin(5 * t)]) for t in turns]
    return bodies, [look_at(eye, np.array([0.3 * t, 0.2, 0.6])) for eye, t in zip(eyes, turns, strict=True)]


def knots() -> tuple[list, list[Floats]]:
    """A knot, a band and a ring over a table with a wall behind."""
    import open3d as o3d

    make = o3d.geometry.TriangleMesh
    bodies = [
        make.create_mobius(70, 15, 1, 0.45, 1, 1, 0.25).translate((-0.5, 0.1, 0.45)),
        make.create_torus(0.32, 0.05, 60, 30).rotate(
            make.get_rotation_matrix_from_xyz((1.1, 0.3, 0)), (0, 0, 0)
        ).translate((0.55, -0.15, 0.36)),
        make.create_box(4, 4, 0.1).translate((-2, -1.6, -0.1)),
        make.create_box(4, 0.1, 2.5).translate((-2, 1.3, -0.1)),
    ]  # fmt: skip
    t = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    curve = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], -1)
    beads = o3d.geometry.TriangleMesh()
    for point in 0.11 * curve + np.array([0.1, 0.5, 0.55]):
        beads += make.create_sphere(0.035, 8).translate(point)
    turns = np.linspace(-0.55, 0.55, VIEWS)
    eyes = [np.array([2.2 * np.sin(t), -2.0 * np.cos(t), 1.15 + 0.25 * np.sin(4 * t)]) for t in turns]
    return [*bodies, beads], [look_at(eye, np.array([0, 0.15, 0.35])) for eye in eyes]


def temple() -> tuple[list, list[Floats]]:
    """Columns on steps with a beam over them and a wall behind, from an arc at eye height: much is sky."""
    import open3d as o3d

    make = o3d.geometry.TriangleMesh
    bodies = [
        make.create_box(60, 60, 0.1).translate((-30, -30, -0.1)),
        make.create_box(9, 5, 0.3).translate((-4.5, -2.5, 0)),
        make.create_box(8, 4, 0.3).translate((-4, -2, 0.3)),
        make.create_box(7.6, 0.8, 0.7).translate((-3.8, -1.8, 3.6)),
        make.create_box(5, 0.4, 2.2).translate((-4, 1.4, 0.6)),
    ]
    for x in np.linspace(-3.4, 3.4, 6):
        column = make.create_cylinder(0.3, 3.0, 32, 12)
        points = np.asarray(column.vertices)
        points[:, :2] *= 1 + 0.08 * np.cos(12 * np.arctan2(points[:, 1], points[:, 0]))[:, None]
        bodies.append(column.translate((x, -1.4, 2.1)))
    bodies.append(make.create_icosahedron(0.6).translate((2.6, -4.0, 0.55)))
    turns = np.linspace(-0.5, 0.5, VIEWS)
    eyes = [np.array([9 * np.sin(t), -9 * np.cos(t), 1.6 + 0.2 * np.sin(5 * t)]) for t in turns]
    return bodies, [look_at(eye, np.array([0.5 * t, 0, 2.4])) for eye, t in zip(eyes, turns, strict=True)]


def clouds(rays: Floats) -> Floats:
    """Linear colours (N, 3) of a sky in directions (N, 3): blue, paler at the horizon, with clouds."""
    up = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    blue = np.array([0.25, 0.45, 0.85]) + (1 - np.clip(up[:, 2:], 0, 1)) ** 3 * np.array([0.5, 0.4, 0.1])
    cover = 1 / (1 + np.exp(-18 * (noise(up * np.array([3, 3, 7]), 5, 31) - 0.55)))
    return blue + cover[:, None] * (0.95 - blue)


def traced(
    bodies: list,
    poses: list[Floats],
    scale: float,
    shape: tuple[int, int] = SHAPE,
    fine: int = 2,
    sky: Callable[[Floats], Floats] = lambda rays: np.full(rays.shape, 0.8),
) -> Sample:
    """Pictures (h, w) of bodies, each of another material, from cameras world_from_cam, lit by sun and sky.

    Where there is no body, ``sky`` tells the linear colours (N, 3) in directions (N, 3). Colours are the
    mean of ``fine`` × ``fine`` rays a pixel, depths are those of its centre.
    """
    import open3d as o3d

    scene, (h, w) = o3d.t.geometry.RaycastingScene(), shape
    for body in bodies:
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(body))
    K = np.array([[0.8 * w, 0, w / 2], [0, 0.8 * w, h / 2], [0, 0, 1]])
    u, v = np.meshgrid((np.arange(fine * w) + 0.5) / fine, (np.arange(fine * h) + 0.5) / fine)
    dense = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(K).T
    u, v = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    middle = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(K).T
    sun = np.array([-0.4, -0.5, 0.77])
    images, depths, rng = [], [], np.random.default_rng(0)
    for pose in poses:
        rotation, eye = pose[:3, :3], pose[:3, 3]
        hit = _cast(scene, eye, middle @ rotation.T)
        depths.append(np.where(np.isfinite(hit["t_hit"]), hit["t_hit"], 0).reshape(h, w))
        rays = dense @ rotation.T
        hit = _cast(scene, eye, rays)
        seen = np.isfinite(hit["t_hit"])
        points = eye + np.where(seen, hit["t_hit"], 0)[:, None] * rays
        color = np.empty((len(rays), 3))
        color[~seen] = sky(rays[~seen])
        for body in range(len(bodies)):
            mine = seen & (hit["geometry_ids"] == body)
            color[mine] = painted(points[mine], scale, 20 + body)
        lit = _cast(scene, points + 2e-3 * sun, np.broadcast_to(sun, points.shape))["t_hit"]
        facing = np.abs(hit["primitive_normals"] @ sun) * ~np.isfinite(lit)
        color[seen] *= (0.45 + 0.75 * facing)[seen, None]
        picture = color.reshape(h, fine, w, fine, 3).mean((1, 3)) ** (1 / 2.2)
        picture = 235 * np.clip(picture * rng.uniform(0.9, 1.05), 0, 1) + rng.normal(0, 2, (h, w, 3))
        images.append(np.clip(picture, 0, 255).astype(np.uint8))
    cams = np.stack([np.linalg.inv(p) for p in poses]).astype(np.float32)
    Ks = np.stack([K] * len(poses)).astype(np.float32)
    return Sample(np.stack(images), np.stack(depths).astype(np.float32), Ks, cams)


def _cast(scene: object, origins: Floats, rays: Floats) -> dict[str, NDArray]:
    both = np.concatenate([np.broadcast_to(origins, rays.shape), rays], -1).astype(np.float32)
    return {name: value.numpy() for name, value in scene.cast_rays(both).items()}  # type: ignore[attr-defined]


SCENES: dict[str, Callable[[], Sample]] = {
    "hills": lambda: traced(*hills(), scale=2.0),
    "knots": lambda: traced(*knots(), scale=9.0),
    "walk": lambda: walk(seed=11, views=VIEWS, shape=SHAPE),
    "temple": lambda: traced(*temple(), scale=1.5, sky=clouds),
}


def made(name: str, root: Path) -> Path:
    """The workspace of a scene; rendered and mapped if it is not there yet."""
    folder = (root / name).resolve()
    if (folder / "gt" / "gt.json").exists():
        return folder
    sample = SCENES[name]()
    names = [f"view_{i:02d}.png" for i in range(len(sample.images))]
    for part in ("images", "gt/depth"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    for file, image, depth in zip(names, sample.images, sample.depth, strict=True):
        cv2.imwrite(str(folder / "images" / file), image[..., ::-1])
        cv2.imwrite(str(folder / "gt" / "depth" / file), np.rint(1000 * depth).astype(np.uint16))
    model = ensure_model(folder)[0]
    entries = {e.name: e for e in _pycolmap.registered(_pycolmap.read_model(model))}
    used = [i for i, file in enumerate(names) if file in entries]
    if len(used) < len(names):
        raise SystemExit(f"{folder}: COLMAP registered {len(used)} of {len(names)} views")
    theirs = spread([entries[names[i]].cam_from_world for i in used])
    unit = spread([sample.cam_from_world[i][:3] for i in used]) / theirs
    table = {"model": str(model.relative_to(folder)), "metres_per_colmap_unit": unit, "images": len(used)}
    (folder / "gt" / "gt.json").write_text(json.dumps(table), encoding="utf-8")
    return folder


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    args = parser.parse_args()
    for name in args.scenes:
        made(name, args.folder)


if __name__ == "__main__":
    main()
