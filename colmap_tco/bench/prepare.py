"""A scene of a dataset as a network sees it, with the truth in the same pixels.

Networks that predict cameras see each picture resized to one canvas. Networks that take cameras and points as
input get what they get from ``densify``: a COLMAP workspace is made of the pictures and the prior cameras,
COLMAP triangulates points between them from the pictures alone, and views and priors are made of that. No
true depth goes into either.
"""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_tco.datasets.base import Floats, Frame, Scene, inverse, pixel_centres, rays
from colmap_tco.errors import InputError
from colmap_tco.image_files import read_image
from colmap_tco.pinhole import Pinhole

if TYPE_CHECKING:
    from tco.types import Cameras, Priors, Views

log = logging.getLogger(__name__)

SHALLOWEST = 1e-4
"""Metres; the published evaluations count true depths above this."""


@dataclass(frozen=True)
class Prepared:
    """V views of a scene.

    Attributes:
        views: what the network sees.
        cameras: the prior cameras, in the frame of the first view, in units of ``unit``.
        world_from_cam: (V, 4, 4) true poses, metres, in the frame of the dataset.
        K: (V, 3, 3) true intrinsics, pixels of the canvas.
        depth: (V, H, W) true depth in metres, 0 where there is none.
        unit: metres per unit of what the network is given.
        priors: what a network that takes cameras and points is given beside the views; None for others.
    """

    views: Views
    cameras: Cameras
    world_from_cam: Floats
    K: Floats
    depth: NDArray[np.float32]
    unit: float = 1.0
    priors: Priors | None = None

    @property
    def known(self) -> NDArray[np.bool_]:
        """Where (V, H, W) the truth is known and the canvas shows picture."""
        found: NDArray[np.bool_] = (self.depth > SHALLOWEST) & self.views.valid.numpy()
        return found

    @property
    def points(self) -> Floats:
        """The true points (V, H, W, 3) in metres; at the camera's centre where the truth is not known."""
        return unproject(self.depth, self.K, self.world_from_cam)


def unproject(
    depth: NDArray[np.floating], K: Floats, world_from_cam: Floats, directions: Floats | None = None
) -> Floats:
    """World points (V, H, W, 3) of depth maps (V, H, W), at pixel centres.

    ``directions`` (V, H, W, 2) are x / z and y / z of the pixels, by default those of the intrinsics.
    """
    views, height, width = depth.shape
    centres, found = pixel_centres(width, height), np.empty((views, height, width, 3))
    for i in range(views):
        ray = rays(centres, K[i])
        if directions is not None:
            ray = np.concatenate([directions[i].reshape(-1, 2), np.ones_like(ray[:, :1])], 1)
        local = ray * depth[i].reshape(-1, 1)
        world = local @ world_from_cam[i, :3, :3].T + world_from_cam[i, :3, 3]
        found[i] = world.reshape(height, width, 3)
    return found


def resized(scene: Scene, width: int, stride: int) -> Prepared:
    """Pictures resized to one canvas, ``width`` wide, as high as the first frame has it.

    Both sides are multiples of ``stride``; each picture has its own scale along each axis, as in the
    published evaluations, whose pictures of a scene differ by a few pixels.

    Raises:
        InputError: a picture or depth map cannot be read, or the canvas would be lower than the stride.
    """
    import cv2
    import torch

    from tco.types import Views

    first = scene.frames[0].size
    size = _multiple(width, stride), _multiple(first[1] * width / first[0], stride)
    if min(size) < stride:
        raise InputError(f"--image_width {width}: the network takes pictures of at least {stride} pixels")
    images, K, depth = [], [], []
    for frame in scene.frames:
        picture = cv2.resize(read_image(frame.image), size, interpolation=cv2.INTER_AREA)
        images.append(torch.from_numpy(picture).permute(2, 0, 1).float() / 255)
        camera = Pinhole(*frame.size, *_focal_and_centre(frame)).resized(*size)
        K.append(camera.K)
        scale = np.array(frame.size) / size
        depth.append(frame.depth_at(pixel_centres(*size) * scale).reshape(size[1], size[0]))
    names = tuple(frame.name for frame in scene.frames)
    valid = torch.ones(len(images), size[1], size[0], dtype=torch.bool)
    poses = np.stack([frame.world_from_cam for frame in scene.frames])
    views, intrinsics = Views(torch.stack(images), valid, names), np.stack(K)
    return Prepared(views, as_cameras(poses, intrinsics), poses, intrinsics, np.stack(depth))


def as_cameras(world_from_cam: Floats, K: Floats) -> Cameras:
    """Cameras in the frame of the first; differences are taken in float64."""
    import torch

    from tco.types import Cameras

    local = inverse(world_from_cam[0]) @ world_from_cam
    return Cameras(torch.from_numpy(local).float(), torch.from_numpy(K).float())


def _multiple(length: float, stride: int) -> int:
    return round(length / stride) * stride


def _focal_and_centre(frame: Frame) -> tuple[float, float, float, float]:
    return float(frame.K[0, 0]), float(frame.K[1, 1]), float(frame.K[0, 2]), float(frame.K[1, 2])


def triangulated(scene: Scene, width: int, stride: int, folder: Path, seed: int = 0) -> Prepared:
    """A COLMAP workspace of the scene in ``folder``, and what ``densify`` would give a network of it.

    Raises:
        InputError: too few features match between the pictures for COLMAP to triangulate points.
    """
    from colmap_tco.bench.triangulate import Picture, triangulate
    from colmap_tco.priors import PriorConfig, build_priors, chunk_frame, with_points
    from colmap_tco.tracks import read_tracks
    from colmap_tco.views import ViewConfig, batch, make_views, original_from_network
    from colmap_tco.workspace import open_workspace

    frames = {f"{i:05d}{frame.image.suffix}": frame for i, frame in enumerate(scene.frames)}
    _copy_pictures(frames, folder / "images")
    pictures = [
        Picture(name, Pinhole(*f.size, *_focal_and_centre(f)), inverse(f.world_from_cam)[:3])
        for name, f in frames.items()
    ]
    triangulate(folder, pictures, seed)
    workspace = open_workspace(folder)
    found, skipped = make_views(workspace, ViewConfig(max_image_size=width), stride)
    tracks = read_tracks(workspace.model)
    config = PriorConfig(holdout=0)
    views, few = with_points(tracks, found, config)
    for name, reason in (skipped | few).items():
        log.warning("%s: %s is left out, also of the truth: %s", scene.name, frames[name].name, reason)
    frame = chunk_frame(tracks, views)
    priors = build_priors(tracks, views, frame, config, seed).optimise
    images, cameras = batch(views, frame)
    height, wide = images.size
    depth = np.zeros((len(views), height, wide), np.float32)
    K = cameras.K.double().numpy()
    for i, view in enumerate(views):
        left, top = (wide - view.network.width) // 2, (height - view.network.height) // 2
        xy = pixel_centres(wide, height) - (left, top)
        depth[i] = frames[view.name].depth_at(original_from_network(view, xy)).reshape(height, wide)
    poses = np.stack([frames[view.name].world_from_cam for view in views])
    return Prepared(images, cameras, poses, K, depth, frame.scale, priors)


def _copy_pictures(frames: dict[str, Frame], folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame in frames.items():
        shutil.copyfile(frame.image, folder / name)
