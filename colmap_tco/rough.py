"""Rough poses of images: from a COLMAP model, from a TUM trajectory, or from a network."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Camera, Floats, Model, Registered
from colmap_tco.errors import InputError
from colmap_tco.evaluation.sources import Outcome, matched, read_tum
from colmap_tco.workspace import find_models, listing
from tco.config import knob

if TYPE_CHECKING:
    from colmap_tco.depth_views import Depth

log = logging.getLogger(__name__)

FEWEST_POINTS = 20
"""Triangulated points on measured pixels that tell the scale of a rough model."""


@dataclass(frozen=True)
class RoughConfig:
    """Rough poses and cameras, where no network finds them."""

    rough: Path | None = knob(
        None,
        "rough poses: folder of a COLMAP model, or TUM trajectory (timestamp tx ty tz qx qy qz qw, camera in "
        "the world). none: a network finds them (--backbone vggt, pi3 or da3)",
    )
    match: str = knob(
        "time",
        "how the lines of a TUM trajectory belong to images. time: the file's name is the timestamp; order: "
        "line k is the k-th image by name",
        choices=("time", "order"),
    )
    max_difference: float = knob(0.02, "greatest difference of timestamps that match, seconds")
    camera_model: str = knob(
        "PINHOLE", "COLMAP's camera model of all images, where no rough model has cameras"
    )
    camera_params: tuple[float, ...] = knob(
        (), "its parameters, as COLMAP orders them: for PINHOLE fx,fy,cx,cy; a TUM trajectory needs them"
    )
    rough_scale: float = knob(
        0.0,
        "factor from the unit of the rough poses to that of the depths; 0: the median ratio of depths and "
        "triangulated points where the rough model has some, else 1",
    )
    free_scale: bool = knob(
        False, "improve the scale together with the poses: where it is only roughly known"
    )

    def __post_init__(self) -> None:
        if self.rough_scale < 0 or self.max_difference < 0:
            raise ValueError("rough_scale and max_difference must not be negative")


@dataclass(frozen=True)
class Rough:
    """Images with rough poses.

    Attributes:
        images: with cameras and poses, ordered by name.
        model: the reconstruction that they are of, or None.
        origin: where they are from, as a sentence.
        free_scale: whether their scale is to be improved.
    """

    images: tuple[Registered, ...]
    model: Model | None
    origin: str
    free_scale: bool = False


def read_rough(folder: Path, names: Sequence[str], config: RoughConfig) -> Rough:
    """The rough poses that the user named, of those images that are in the folder.

    Raises:
        InputError: no such model or trajectory, no pose for at least two images, or no camera.
    """
    assert config.rough is not None
    path = config.rough.expanduser().absolute()
    rough = _of_trajectory(path, folder, names, config) if path.is_file() else _of_model(path, config)
    here = set(names)
    images = tuple(entry for entry in rough.images if entry.name in here)
    without = {name: "no rough pose" for name in sorted(here - {entry.name for entry in images})}
    if len(images) < 2:
        raise InputError(
            f"--rough {path} has poses for {len(images)} of the {len(names)} images in {folder}, it takes "
            "two; a model names its images relative to this folder"
        )
    if without:
        log.warning("%d images are left out:\n%s", len(without), listing(without))
    return replace(rough, images=images, free_scale=config.free_scale)


def _of_model(path: Path, config: RoughConfig) -> Rough:
    folders = find_models(path) if path.is_dir() else []
    if not folders:
        raise InputError(f"--rough {path}: neither a TUM trajectory nor a folder with a COLMAP model")
    models = {folder: _pycolmap.read_model(folder) for folder in folders}
    best = max(models, key=lambda f: models[f].num_reg_images())
    images = _pycolmap.registered(models[best])
    if config.camera_params:
        log.warning("--camera_params is not used: %s has cameras", best)
    return Rough(tuple(images), models[best], f"poses of {best}")


def _of_trajectory(path: Path, folder: Path, names: Sequence[str], config: RoughConfig) -> Rough:
    if not config.camera_params:
        raise InputError(
            f"--rough {path} is a trajectory, which has no camera: give --camera_params fx,fy,cx,cy (and "
            "--camera_model where it is not PINHOLE)"
        )
    images = with_camera(folder, names, config)
    entries = {entry.name: entry for entry in images}
    outcome = Outcome(folder, None, None, entries, path)
    poses = matched(outcome, read_tum(path), config.match, config.max_difference)
    found = [replace(entries[name], cam_from_world=inverse(poses[name])) for name in sorted(poses)]
    return Rough(tuple(found), None, f"trajectory {path}")


def with_camera(folder: Path, names: Sequence[str], config: RoughConfig) -> list[Registered]:
    """The images with the camera that the settings name and no pose (the identity), ordered by name.

    Raises:
        InputError: the parameters are not those of the model.
    """
    sizes: dict[tuple[int, int], Camera] = {}
    entries = []
    for number, name in enumerate(sorted(names), 1):
        size = image_size(folder / name)
        if size not in sizes:
            sizes[size] = make_camera(config.camera_model, size, config.camera_params, len(sizes) + 1)
        entries.append(Registered(number, name, sizes[size], np.eye(4)[:3]))
    if len(sizes) > 1 and config.camera_params:
        raise InputError(
            f"{folder}: images of {len(sizes)} sizes ({', '.join(f'{w}×{h}' for w, h in sizes)}) cannot all "
            "have the camera of --camera_params; name a model with their cameras"
        )
    return entries


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of a picture as stored, from its header.

    Raises:
        InputError: it is none.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return image.size
    except (UnidentifiedImageError, OSError) as error:
        raise InputError(f"{path}: cannot be decoded ({error})") from error


def make_camera(kind: str, size: tuple[int, int], params: Sequence[float], number: int) -> Camera:
    """A COLMAP camera.

    Raises:
        InputError: no such model, or other parameters than it has.
    """
    try:
        camera: Any = _pycolmap.load().Camera(
            model=kind, width=size[0], height=size[1], params=[float(value) for value in params]
        )
        valid = camera.verify_params()
    except (ValueError, RuntimeError, TypeError) as error:
        raise InputError(f"--camera_model {kind}: {error}") from error
    if not valid or not params or not params[0] > 0:
        raise InputError(
            f"--camera_params {','.join(f'{value:g}' for value in params)}: not the parameters of "
            f"{kind}, which are {camera.params_info}"
        )
    camera.camera_id = number
    return camera


def inverse(pose: Floats) -> Floats:
    """cam_from_world (3, 4) of world_from_cam (4, 4), or the other way round."""
    R, t = pose[:3, :3], pose[:3, 3]
    return np.column_stack([R.T, -R.T @ t])


def scale_of(rough: Rough, maps: Mapping[str, Depth], given: float) -> tuple[float, str]:
    """Factor from the unit of the rough poses to that of the depths, and where it is from.

    Args:
        rough: with the model whose points are compared.
        maps: name → measured depth (H, W).
        given: what the user said; 0: nothing.
    """
    if given > 0:
        return given, f"as given, {given:g}"
    if rough.model is None:
        return 1.0, "1: taken to be in the unit of the depths"
    ids, xyz, _ = _pycolmap.points(rough.model)
    ratios = [
        _ratios(rough.model, entry, maps[entry.name], (ids, xyz))
        for entry in rough.images
        if entry.name in maps
    ]
    logs = np.log(np.concatenate(ratios)) if ratios else np.zeros(0)
    if len(logs) < FEWEST_POINTS:
        return 1.0, f"1: only {len(logs)} triangulated points are on measured pixels"
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))
    return float(np.exp(middle)), (
        f"{np.exp(middle):.5g}, the median over {len(logs)} triangulated points (spread {100 * spread:.1f} %)"
    )


def _ratios(model: Model, entry: Registered, depth: Depth, points: tuple[Any, Floats]) -> Floats:
    """Measured depth over that of the triangulated point, at the keypoints of an image."""
    pixels, owners = _pycolmap.observations(model, entry.image_id)
    ids, xyz = points
    if not len(pixels):
        return np.zeros(0)
    at = xyz[np.searchsorted(ids, owners)]
    z = at @ entry.cam_from_world[2, :3] + entry.cam_from_world[2, 3]
    scale = np.array(depth.shape[::-1]) / _pycolmap.camera_size(entry.camera)
    x, y = np.floor(pixels * scale).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0]) & (z > 0)
    measured = depth[y[inside], x[inside]].astype(float)
    return np.asarray(measured[measured > 0] / z[inside][measured > 0])
