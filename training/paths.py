"""Where people stand and look when they take pictures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from training.builder import Rng, Vec


def look_at(eye: Vec, target: Vec, roll: float = 0.0) -> Vec:
    """world_from_cam (4, 4) of a camera at ``eye`` that looks at ``target``, upright but for ``roll``."""
    z = target - eye
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1.0])
    x = x / (np.linalg.norm(x) + 1e-9)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    pose = np.eye(4)
    pose[:3] = np.stack([c * x + s * y, -s * x + c * y, z, eye], -1)
    return pose


def path(rng: Rng, eye: Vec, target: Vec, views: int, distance: float) -> list[Vec]:
    """Poses (world_from_cam) of a hand-held walk: baselines of 2 to 40 % of the distance, mostly sideways."""
    base = look_at(eye, target)
    poses = [look_at(eye, target, rng.normal(0, 0.08))]
    reach = distance * np.exp(rng.uniform(np.log(0.06), np.log(0.45)))
    turn = rng.uniform(0, 2 * np.pi)
    for _ in range(1, views):
        a = turn + rng.choice([0, np.pi]) + rng.normal(0, 0.6)
        size = reach * rng.uniform(0.15, 1.0)
        offset = size * np.array([np.cos(a), 0.6 * np.sin(a), 0.35 * rng.normal()])
        moved = eye + base[:3, :3] @ offset
        aim = target + base[:3, :3] @ (offset * rng.uniform(0, 0.9) + rng.normal(0, 0.04, 3) * distance)
        poses.append(look_at(moved, aim, rng.normal(0, 0.08)))
    return poses


def arc(rng: Rng, eye: Vec, target: Vec, views: int, distance: float) -> list[Vec]:
    """Poses on a part of a circle around what is seen, 3 to 15 degrees apart, the middle one first."""
    centre = eye + (target - eye) / np.linalg.norm(target - eye) * distance
    step = np.deg2rad(np.exp(rng.uniform(np.log(3), np.log(15)))) * rng.choice([-1, 1])
    poses = []
    for k in sorted(range(views), key=lambda k: abs(k - views // 2)):
        a = step * (k - views // 2 + rng.normal(0, 0.15))
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
        at = centre + turn @ (eye - centre) * rng.normal(1, 0.04) + [0, 0, rng.normal(0, 0.03) * distance]
        poses.append(look_at(at, centre + rng.normal(0, 0.04, 3) * distance, rng.normal(0, 0.05)))
    return poses


def pan(rng: Rng, eye: Vec, target: Vec, views: int, distance: float) -> list[Vec]:
    """Poses of a slow turn with a drifting hand: 1 to 6 % of the distance from one view to the next."""
    base, size = look_at(eye, target)[:3, :3], distance * np.exp(rng.uniform(np.log(0.01), np.log(0.06)))
    drift = rng.normal(0, 1, 3) * [1, 0.5, 0.6]
    drift /= np.linalg.norm(drift)
    turn, roll, poses = rng.normal(0, 0.08), rng.normal(0, 0.06), []
    for k in range(views):
        at = eye + base @ (size * (k * drift + rng.normal(0, 0.2, 3) * (k > 0)))
        aim = target + base @ (np.array([k * turn, 0.3 * k * turn * rng.normal(), 0]) * distance)
        poses.append(look_at(at, aim, roll + rng.normal(0, 0.03)))
    return poses


def advance(rng: Rng, eye: Vec, target: Vec, views: int, distance: float) -> list[Vec]:
    """Poses of somebody who walks towards what they look at, or away, swaying."""
    base, size = look_at(eye, target)[:3, :3], distance * np.exp(rng.uniform(np.log(0.02), np.log(0.09)))
    side, way = rng.normal(0, 0.25), rng.choice([-1, 1])
    poses = []
    for k in range(views):
        sway = rng.normal(0, 0.25, 3) * [1, 0.7, 0.5] * (k > 0)
        at = eye + base @ (size * (way * k * np.array([side, 0, 1.0]) + sway))
        poses.append(look_at(at, target + rng.normal(0, 0.03, 3) * distance, rng.normal(0, 0.05)))
    return poses


PATHS: tuple[tuple[Callable[[Rng, Vec, Vec, int, float], list[Vec]], float], ...] = (
    (path, 0.45),
    (arc, 0.2),
    (pan, 0.2),
    (advance, 0.15),
)
"""Ways to take pictures, and how often they are taken."""
