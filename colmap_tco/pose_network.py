"""Poses that a network finds when TCO adapts it to measured depths (arXiv 2604.03878, the second task)."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_tco._pycolmap import Floats, Registered
from colmap_tco.backbones import NetworkConfig, load, select, suited
from colmap_tco.depth_views import on_canvas, read_depths
from colmap_tco.errors import InputError
from colmap_tco.progress import Progress
from colmap_tco.rough import Rough, RoughConfig, image_size, inverse, make_camera, with_camera
from colmap_tco.views import ChunkFrame, View, ViewConfig, batch, canvas_size, make_views
from colmap_tco.workspace import Workspace
from tco.options import TCOConfig

if TYPE_CHECKING:
    from torch import Tensor

    from tco.backbones.base import Backbone
    from tco.types import Views

log = logging.getLogger(__name__)

SETTINGS = TCOConfig(photometric_weight=0.0, geometric_weight=1.0, depth_weight=1.0)
"""The paper's objective where depths are the prior: compatibility of depths, and the depths themselves."""


def predicted(
    folder: Path, names: Sequence[str], known: tuple[Mapping[str, Path], float, RoughConfig],
    config: NetworkConfig, schedule: tuple[int, int], progress: Progress,
) -> Rough:  # fmt: skip
    """Adapt a network to the measured depths and take its poses, in their unit.

    All images go through the network; those without depth take part in nothing but the views' compatibility.

    Args:
        folder: of the images.
        names: of the images, those without depth among them.
        known: name → depth file, the unit of PNG values, and the camera, if the user named one.
        config: which network.
        schedule: steps, and the seed.
        progress: of the run.

    Raises:
        InputError: the network takes cameras instead of finding them, or an image cannot be read.
        MissingError: no such device or weights.
    """
    files, unit, rough = known
    chosen = select(config)
    backbone = load(chosen)
    if backbone.uses_cameras:
        raise InputError(
            f"no poses to start from: the network {chosen.network.name} takes cameras and finds none. Give "
            "rough poses with --rough (a COLMAP model or a TUM trajectory), or use a network that finds "
            "poses: colmap-tco weights fetch vggt, then --backbone vggt"
        )
    entries = with_camera(folder, names, rough) if rough.camera_params else _guessed(folder, names)
    workspace = Workspace(folder, folder, folder, None, tuple(entries), ())
    settings = ViewConfig(max_image_size=chosen.network.image_size)
    views, skipped = make_views(workspace, settings, chosen.network.stride)
    if skipped:
        raise InputError(f"images that the network cannot be given: {skipped}")
    maps = read_depths(files, views, unit)
    middle = float(np.median([np.median(depth[depth > 0]) for depth in maps.values()]))
    images, _ = batch(views, ChunkFrame(np.eye(4)[:3], 1.0))
    depth = on_canvas(views, maps, canvas_size(views)) / middle
    steps = replace(suited(SETTINGS, chosen.network), steps=schedule[0])
    poses, K = find(backbone, images.to(chosen.device), depth.to(chosen.device), steps, schedule[1])
    poses[:, :3, 3] *= middle
    fitted = [
        _entry(entry, view, pose, intrinsics, bool(rough.camera_params))
        for entry, view, pose, intrinsics in zip(entries, views, poses, K, strict=True)
    ]
    return Rough(tuple(fitted), None, f"poses of {chosen.network.name}, adapted in {schedule[0]} steps", True)


def find(
    backbone: Backbone, images: Views, depth: Tensor, config: TCOConfig, seed: int
) -> tuple[Floats, Floats]:
    """Poses (V, 4, 4) and intrinsics (V, 3, 3) of an adapted network, in the unit of the depths (V, H, W).

    The scale is the median ratio of measured and predicted depths, for a shift, which the depth penalty
    allows, is no motion of cameras.

    Raises:
        InputError: no measured pixel is in the images.
    """
    from tco.optimize import optimize
    from tco.types import Priors

    known = (depth > 0) & images.valid
    if not bool(known.any()):
        raise InputError("no measured pixel falls into the images")
    outcome = optimize(backbone, images, Priors(depth=depth), config, seed)
    prediction = outcome.prediction
    scale = float((depth / prediction.depth.clamp_min(1e-6))[known].median())
    log.info("the network's unit is %.4g of the depths'", scale)
    poses = outcome.cameras.world_from_cam.double().cpu().numpy().copy()
    poses[:, :3, 3] *= scale
    return poses, outcome.cameras.K.double().cpu().numpy()


def _guessed(folder: Path, names: Sequence[str]) -> list[Registered]:
    """The images with cameras that have their size and a middle; the focal length is a placeholder."""
    entries = []
    for number, name in enumerate(sorted(names), 1):
        width, height = image_size(folder / name)
        params = (float(max(width, height)), float(max(width, height)), width / 2, height / 2)
        camera = make_camera("PINHOLE", (width, height), params, number)
        entries.append(Registered(number, name, camera, np.eye(4)[:3]))
    return entries


def _entry(entry: Registered, view: View, pose: Floats, K: Floats, known: bool) -> Registered:
    """The image with its pose and, unless its camera is known, the network's focal lengths."""
    moved = replace(entry, cam_from_world=inverse(pose))
    if known:
        return moved
    size, network = (entry.camera.width, entry.camera.height), view.network
    params = (
        float(K[0, 0]) * size[0] / network.width, float(K[1, 1]) * size[1] / network.height,
        size[0] / 2, size[1] / 2,
    )  # fmt: skip
    return replace(moved, camera=make_camera("PINHOLE", size, params, int(entry.camera.camera_id)))
