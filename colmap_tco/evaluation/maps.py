"""True depth maps beside the predicted ones: found by name, brought to the same pixels and unit.

The true map's pixels are those of an image of a model, distorted or not; a map may be smaller or larger than
its image. The prediction is looked up at the centre of each of its pixels, nearest neighbour, so that the
truth is never interpolated. Undistortion does not turn the camera, so depth stays depth.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Registered
from colmap_tco.errors import InputError
from colmap_tco.evaluation.sources import Outcome, world_from_cam
from colmap_tco.export.dense import DenseView
from colmap_tco.maps import map_intrinsics, read_map

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]
Depth = NDArray[np.float32]

PNG_UNIT = 0.001
NO_MEASUREMENT = 65535
"""Value of 16-bit maps that some sensors write where they have none, 7-Scenes among them."""
_MOVED = 1e-4
_ASPECT = 0.01
_WORDS = (".color", "_color", "-color", "color", "rgb", "image")


@dataclass(frozen=True)
class DepthPair:
    """One image's depth, predicted and true, at the N pixels that were measured.

    Attributes:
        name: of the image.
        predicted: (N,) in units of the model, 0 where there is none.
        truth: (N,) metres, or whatever the truth's unit is.
        rays: (N, 3) in the camera's frame, of unit z.
        world_from_cam: (4, 4) of the result.
    """

    name: str
    predicted: Depth
    truth: Depth
    rays: Floats
    world_from_cam: Floats


def depth_pairs(outcome: Outcome, files: Mapping[str, Path], unit: float, most: int) -> Iterator[DepthPair]:
    """The pairs of images, one after the other.

    Args:
        outcome: with a dense workspace.
        files: name of the image → true map, as :func:`true_maps` finds them.
        unit: of the numbers in them; 0: 0.001 for PNG, 1 for others.
        most: pixels of an image; of more, a random choice.

    Raises:
        InputError: a map that cannot be read, has no shape of its image, or belongs to a camera that moved.
    """
    assert outcome.dense is not None
    views = {view.name: view for view in outcome.dense.views}
    for name, file in files.items():
        entry, view = outcome.cameras[name], views.get(name)
        truth = read_depth(file, unit)
        _check_shape(file, truth.shape, entry)
        rows, columns = np.nonzero(truth > 0)
        if len(rows) > most:
            chosen = np.random.default_rng(0).choice(len(rows), most, replace=False)
            rows, columns = rows[chosen], columns[chosen]
        rays = _rays(entry, truth.shape, rows, columns)
        predicted = np.zeros(len(rows), np.float32)
        path = outcome.dense.paths.depth_map(name)
        if view is not None and path.is_file():
            _check_pose(entry, view)
            predicted = _look_up(read_map(path), view, rays)
        (pose,) = world_from_cam([entry])
        yield DepthPair(name, predicted, truth[rows, columns], rays, pose)


def true_maps(outcome: Outcome, folder: Path) -> dict[str, Path]:
    """Name → file of the true map, for the images that have one, ordered by name.

    Raises:
        InputError: no image has one.
    """
    found = {}
    for name in sorted(outcome.cameras):
        path = next((p for p in candidates(folder, name) if p.is_file()), None)
        if path is not None:
            found[name] = path
    if not found:
        name = min(outcome.cameras)
        tried = ", ".join(str(p.relative_to(folder)) for p in candidates(folder, name)[:6])
        raise InputError(
            f"{folder}: no depth map for any image of {outcome.path}; for {name} it looked for {tried}, …"
        )
    if len(found) < len(outcome.cameras):
        log.warning(
            "%s has maps for %d of %d images; the others are not evaluated",
            folder, len(found), len(outcome.cameras),
        )  # fmt: skip
    return found


def candidates(folder: Path, name: str) -> list[Path]:
    """Where the true map of an image may be: its name with or without ending, ``color`` read as depth."""
    stem = str(Path(name).with_suffix(""))
    stems = [name, stem, f"{stem}.depth", f"{stem}_depth"]
    stems += [stem.replace(word, word.replace(word.strip("._-"), "depth")) for word in _WORDS if word in stem]
    endings = (".png", ".npy", ".geometric.bin", ".photometric.bin", ".bin")
    return [folder / (s + ending) for s in dict.fromkeys(stems) for ending in endings]


def read_depth(path: Path, unit: float) -> Depth:
    """A depth map (H, W) times ``unit``, 0 where nothing was measured.

    Args:
        path: 16-bit PNG, NumPy array, or COLMAP map.
        unit: 0 stands for 0.001 (PNG) or 1 (others).

    Raises:
        InputError: it cannot be read, or is no map of one channel; 8-bit pictures are refused.
    """
    if path.suffix.lower() == ".png":
        values = _read_png(path)
    elif path.suffix.lower() == ".npy":
        values = _read_npy(path)
    else:
        values = np.asarray(read_map(path), np.float64)
    if values.ndim != 2:
        raise InputError(f"{path}: a depth map has one channel, this has the shape {values.shape}")
    scale = unit or (PNG_UNIT if path.suffix.lower() == ".png" else 1.0)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(values) & (values > 0), values * scale, 0).astype(np.float32)


def _read_png(path: Path) -> Floats:
    import cv2

    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise InputError(f"{path}: cannot be decoded")
    if values.dtype != np.uint16:
        raise InputError(f"{path}: {values.dtype} pixels; depth maps are 16-bit PNG, NumPy or COLMAP files")
    return np.where(values == NO_MEASUREMENT, 0, values).astype(np.float64)


def _read_npy(path: Path) -> Floats:
    try:
        return np.squeeze(np.load(path, allow_pickle=False)).astype(np.float64)
    except (ValueError, TypeError, OSError, EOFError) as error:
        raise InputError(f"{path}: not a NumPy array of numbers ({error})") from error


def _check_shape(file: Path, shape: tuple[int, ...], entry: Registered) -> None:
    width, height = _pycolmap.camera_size(entry.camera)
    if abs(shape[1] / shape[0] / (width / height) - 1) > _ASPECT:
        raise InputError(
            f"{file}: {shape[1]}×{shape[0]} pixels, its image {entry.name} has {width}×{height}: the shapes "
            "differ; name the model whose images the depth maps belong to with --model_path"
        )


def _check_pose(entry: Registered, view: DenseView) -> None:
    moved = float(np.abs(entry.cam_from_world - view.cam_from_world).max())
    size = max(1.0, float(np.abs(entry.cam_from_world[:, 3]).max()))
    if moved > _MOVED * size:
        raise InputError(
            f"{view.name}: its camera in the dense workspace differs from that of the model by {moved:.2g}; "
            "depth maps are only comparable in the same camera. Name the model with --model_path."
        )


def _rays(
    entry: Registered, shape: tuple[int, ...], rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> Floats:
    """Rays (N, 3) of unit z through the centres of pixels of a map of (H, W) ``shape``."""
    width, height = _pycolmap.camera_size(entry.camera)
    pixels = np.stack([(columns + 0.5) * width / shape[1], (rows + 0.5) * height / shape[0]], 1)
    return np.c_[_pycolmap.cam_from_img(entry.camera, pixels), np.ones(len(pixels))]


def _look_up(depth: Depth, view: DenseView, rays: Floats) -> Depth:
    """The depth (N,) of the pixels that rays (N, 3) meet; 0 outside."""
    fx, fy, cx, cy = map_intrinsics(view.camera, depth.shape)
    with np.errstate(invalid="ignore"):
        u, v = np.floor(rays[:, 0] * fx + cx), np.floor(rays[:, 1] * fy + cy)
        inside = (u >= 0) & (u < depth.shape[1]) & (v >= 0) & (v < depth.shape[0])
    out = np.zeros(len(rays), np.float32)
    out[inside] = np.maximum(depth[v[inside].astype(np.intp), u[inside].astype(np.intp)], 0)
    return out
