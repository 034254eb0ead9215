"""Registered images → undistorted, centred, resized views, with the exact map back to their pixels.

Three pixel frames, all with the centre of the top-left pixel at (0.5, 0.5):

original    the image file and COLMAP's camera;
full        ``View.camera``: the same centre, orientation and central resolution, no distortion, and the
            principal point exactly in the middle, by cropping or padding;
network     ``View.network``: ``full`` resized so that both sides are multiples of the backbone's stride.

Views of one chunk are padded symmetrically to a common canvas, which keeps principal points centred.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Camera, Floats, Mask, Registered
from colmap_tco.errors import InputError
from colmap_tco.image_files import read_image
from colmap_tco.pinhole import CELL, Pinhole, trusted_cells, undistorted_camera
from colmap_tco.workspace import Workspace, listing
from tco.config import check_range, knob

if TYPE_CHECKING:
    from tco.types import Cameras, Views

log = logging.getLogger(__name__)

_Map = TypeVar("_Map", bound=Any)
_BAND = 256


@dataclass(frozen=True)
class ViewConfig:
    """How images are prepared for the network."""

    max_image_size: int = knob(
        0,
        "longer side of the images that the network sees, pixels; memory and time grow with its square. 0: "
        "what suits the network, 320 for sweep, 518 for vggt and pi3, 504 for da3",
    )
    mask_path: str = knob(
        "",
        "folder of masks for the original images, <image name>.png, 0 is excluded; empty: none",
    )

    def __post_init__(self) -> None:
        check_range(self, "max_image_size", 0)


@dataclass(frozen=True)
class View:
    """One image, with its three pixel frames.

    Attributes:
        name: the image's name in the model.
        image_id: COLMAP's id.
        path: the image file.
        original: COLMAP's camera.
        camera: undistorted, full resolution, principal point at (width / 2, height / 2).
        network: ``camera`` resized for the backbone.
        cam_from_world: (3, 4) float64, COLMAP's.
        mask_path: mask in the original frame, or None.
    """

    name: str
    image_id: int
    path: Path
    original: Camera
    camera: Pinhole
    network: Pinhole
    cam_from_world: Floats = field(repr=False)
    mask_path: Path | None = None


@dataclass(frozen=True)
class ChunkFrame:
    """The coordinates of a chunk: the first view is the world, and lengths are divided by ``scale``.

    Differences are taken in float64 before anything becomes float32, so that coordinates of 1e6 m
    (projected map coordinates) lose no precision.

    Attributes:
        cam_from_world: (3, 4) COLMAP's pose of the first view.
        scale: COLMAP units per unit of the chunk.
    """

    cam_from_world: Floats
    scale: float

    def world_from_cam(self, view: View) -> Floats:
        """(4, 4) pose of a view in the chunk's frame and units."""
        R0, R = self.cam_from_world[:, :3], view.cam_from_world[:, :3]
        moved = -R.T @ view.cam_from_world[:, 3] + R0.T @ self.cam_from_world[:, 3]
        pose = np.eye(4)
        pose[:3, :3] = R0 @ R.T
        pose[:3, 3] = R0 @ moved / self.scale
        return pose


def make_views(
    workspace: Workspace, config: ViewConfig, stride: int, usual_size: int = 320
) -> tuple[list[View], dict[str, str]]:
    """The usable images of a workspace as views, ordered by name, and name → reason for the others.

    Args:
        workspace: the checked workspace.
        config: size and masks.
        stride: of the backbone; sides of network images are multiples of it.
        usual_size: longer side of network images where the configuration names none.

    Raises:
        InputError: no image is left, or there are no masks in the folder that was named.
    """
    if config.max_image_size == 0:
        config = replace(config, max_image_size=usual_size)
    if config.max_image_size < stride:
        raise InputError(f"--max_image_size {config.max_image_size} is below the network's stride {stride}")
    views: list[View] = []
    skipped: dict[str, str] = {}
    pinholes: dict[int, Pinhole | InputError] = {}
    for entry in workspace.images:
        key = int(entry.camera.camera_id)
        if key not in pinholes:
            pinholes[key] = _pinhole_or_error(entry.camera)
        pinhole = pinholes[key]
        if isinstance(pinhole, InputError):
            skipped[entry.name] = str(pinhole)
        elif min(pinhole.width, pinhole.height) < stride:
            skipped[entry.name] = f"smaller than the network's stride of {stride} pixels"
        else:
            views.append(_view(workspace.image_folder, entry, pinhole, config, stride))
    if not views:
        raise InputError(f"no image can be used:\n{listing(skipped)}")
    _check_masks(views, config)
    return views, skipped


def _view(folder: Path, entry: Registered, pinhole: Pinhole, config: ViewConfig, stride: int) -> View:
    network = pinhole.resized(*network_size(pinhole, config.max_image_size, stride))
    mask = mask_file(Path(config.mask_path), entry.name) if config.mask_path else None
    found = mask if mask is not None and mask.is_file() else None
    pose = np.ascontiguousarray(entry.cam_from_world, float)
    return View(entry.name, entry.image_id, folder / entry.name, entry.camera, pinhole, network, pose, found)


def _check_masks(views: Sequence[View], config: ViewConfig) -> None:
    if not config.mask_path:
        return
    found = sum(view.mask_path is not None for view in views)
    if not found:
        example = mask_file(Path(config.mask_path), views[0].name)
        raise InputError(f"--mask_path {config.mask_path} holds no mask; expected for instance {example}")
    log.info("%d of %d views have a mask", found, len(views))


def mask_file(folder: Path, name: str) -> Path:
    """Where the mask of an image is expected: ``<name>.png``, or the same name where it ends in .png."""
    return folder / (name if name.lower().endswith(".png") else f"{name}.png")


def network_size(camera: Pinhole, max_image_size: int, stride: int) -> tuple[int, int]:
    """(width, height) nearest to the camera's shape, multiples of stride, never enlarged."""
    scale = min(1.0, max_image_size / max(camera.width, camera.height))

    def side(length: int) -> int:
        most = min(max_image_size, length) // stride
        return max(1, min(round(length * scale / stride), most)) * stride

    return side(camera.width), side(camera.height)


def _pinhole_or_error(camera: Camera) -> Pinhole | InputError:
    try:
        return undistorted_camera(camera)
    except InputError as error:
        return error


class Band(NamedTuple):
    """Some rows of the undistorted images of a camera.

    Attributes:
        rows: of the image.
        u, v: (h, W) places in the original, as ``cv2.remap`` wants them.
        valid: (h, W) whether these are in the picture, and the distortion has an inverse there.
    """

    rows: slice
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    valid: Mask


def sampling(view: View) -> Iterator[Band]:
    """Where the undistorted image of a view takes its pixels: alike for all views of a camera."""
    cells = trusted_cells(view.original, view.camera)
    for rows, pixels in _bands(view):
        trusted = cells[rows.start // CELL : -(-rows.stop // CELL)].repeat(CELL, 0).repeat(CELL, 1)
        with np.errstate(invalid="ignore"):
            within = (pixels >= 0) & (pixels <= _pycolmap.camera_size(view.original))
        inside: Mask = np.logical_and(within[..., 0], within[..., 1])
        yield Band(rows, *_for_opencv(pixels), inside & trusted[: len(inside), : inside.shape[1]])


def undistorted_image(view: View, bands: Iterable[Band] | None = None) -> tuple[NDArray[np.uint8], Mask]:
    """RGB (H, W, 3) in the frame of ``view.camera``, and where it is picture and not masked (H, W).

    Works in bands of rows, so that the maps of large images stay small.

    Args:
        view: the view.
        bands: its :func:`sampling`, if it is known already.

    Raises:
        InputError: the image or its mask cannot be read or has another size than the camera.
    """
    import cv2

    edge = cv2.BORDER_REPLICATE
    source = read_image(view.path)
    _check_size(view, view.path, source)
    mask = _read_mask(view)
    image = np.zeros((view.camera.height, view.camera.width, 3), np.uint8)
    valid = np.zeros(image.shape[:2], bool)
    for rows, u, v, there in sampling(view) if bands is None else bands:
        image[rows] = cv2.remap(source, u, v, cv2.INTER_CUBIC, borderMode=edge)
        valid[rows] = there
        if mask is not None:
            valid[rows] &= cv2.remap(mask, u, v, cv2.INTER_NEAREST, borderMode=edge) > 0
    image[~valid] = 0
    return image, valid


def map_mask(view: View, shape: tuple[int, ...]) -> Mask | None:
    """Where the user's mask keeps at least half of a pixel (H, W) of a map of this shape; None without one.

    A pixel that it does not keep is not valid in :func:`network_image` either.

    Raises:
        InputError: the mask cannot be read or has another size than the camera.
    """
    import cv2

    mask = _read_mask(view)
    if mask is None:
        return None
    kept = np.empty((view.camera.height, view.camera.width), np.float32)
    for rows, pixels in _bands(view):
        warped = cv2.remap(mask, *_for_opencv(pixels), cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        kept[rows] = warped > 0
    share: Mask = cv2.resize(kept, shape[1::-1], interpolation=cv2.INTER_AREA) >= 0.5
    return share


def _bands(view: View) -> Iterator[tuple[slice, Floats]]:
    """Bands of rows of the undistorted image, and the original pixels (h, W, 2) that they show."""
    camera = view.camera
    for top in range(0, camera.height, _BAND):
        rows = slice(top, min(top + _BAND, camera.height))
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(rows.start, rows.stop) + 0.5)
        rays = camera.normalised(np.stack([x, y], -1).reshape(-1, 2))
        yield rows, _pycolmap.img_from_cam(view.original, rays).reshape(*x.shape, 2)


def _for_opencv(pixels: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pixels (h, W, 2) as ``cv2.remap`` wants them: the centre of the first pixel is at 0."""
    at = np.nan_to_num(pixels - 0.5, nan=-1e6).astype(np.float32)
    return np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])


def _check_size(view: View, path: Path, picture: NDArray[Any]) -> None:
    size, expected = (picture.shape[1], picture.shape[0]), _pycolmap.camera_size(view.original)
    if size != expected:
        raise InputError(
            f"{path}: {size[0]}×{size[1]} pixels where its camera has {expected[0]}×{expected[1]}"
        )


def _read_mask(view: View) -> NDArray[Any] | None:
    import cv2

    if view.mask_path is None:
        return None
    mask = cv2.imread(str(view.mask_path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if mask is None:
        raise InputError(f"{view.mask_path}: this mask cannot be decoded; write it as an 8-bit PNG")
    _check_size(view, view.mask_path, mask)
    return mask


Picture = tuple[NDArray[np.float32], Mask]
"""RGB (h, w, 3) in [0, 1] in the frame of ``View.network``, and its valid pixels (h, w)."""


def network_image(view: View) -> Picture:
    """The undistorted image of a view, as small as the network sees it; see :func:`resized`."""
    return resized(view, *undistorted_image(view))


def resized(view: View, image: NDArray[np.uint8], valid: Mask) -> Picture:
    """The picture for the network of an undistorted image (H, W, 3) and its valid pixels (H, W).

    Area-filtered. Only valid pixels contribute, so that padding does not darken the border; a pixel
    is valid if at least half of its area is.
    """
    import cv2

    size = (view.network.width, view.network.height)
    weight = valid.astype(np.float32)
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    colour = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    rgb = colour / np.maximum(share, 1e-6)[..., None] / 255
    keep = share >= 0.5
    rgb[~keep] = 0
    return np.clip(rgb, 0, 1, dtype=np.float32), keep


def network_from_original(view: View, xy: Floats) -> Floats:
    """Network pixels (N, 2) of original pixels (N, 2); NaN where the distortion has no inverse."""
    return view.network.pixels(_pycolmap.cam_from_img(view.original, xy))


def original_from_network(view: View, xy: Floats) -> Floats:
    """Original pixels (N, 2) of network pixels (N, 2); may lie outside the original image."""
    return _pycolmap.img_from_cam(view.original, view.network.normalised(xy))


def canvas_size(views: Sequence[View]) -> tuple[int, int]:
    """(H, W) of the smallest canvas that holds the network images of these views."""
    return max(view.network.height for view in views), max(view.network.width for view in views)


def canvas_camera(view: View, canvas: tuple[int, int]) -> Pinhole:
    """The network camera of a view, centred on a canvas (H, W).

    Raises:
        ValueError: the padding is not an even number of pixels, which an odd stride can cause.
    """
    return view.network.padded(canvas[1], canvas[0])


def canvas_cameras(views: Sequence[View], frame: ChunkFrame) -> Cameras:
    """Poses (V, 4, 4) in the chunk's frame and intrinsics (V, 3, 3) on the canvas, float32."""
    import torch

    from tco.types import Cameras

    canvas = canvas_size(views)
    poses = np.stack([frame.world_from_cam(view) for view in views])
    K = np.stack([canvas_camera(view, canvas).K for view in views])
    return Cameras(torch.from_numpy(poses).float(), torch.from_numpy(K).float())


def batch(
    views: Sequence[View],
    frame: ChunkFrame,
    picture: Callable[[View], Picture] = network_image,
    helpers: int = 0,
) -> tuple[Views, Cameras]:
    """Images and cameras of a chunk on a common canvas, float32.

    Args:
        views: of the chunk.
        frame: of the chunk.
        picture: makes the picture of a view, which takes long where photos are large.
        helpers: how many of the last views only help the others.

    Raises:
        InputError: an image cannot be read.
    """
    import torch

    from tco.types import Views

    canvas = canvas_size(views)
    images = torch.zeros(len(views), 3, *canvas)
    valid = torch.zeros(len(views), *canvas, dtype=torch.bool)
    for i, view in enumerate(views):
        rgb, keep = picture(view)
        crop(view, images[i])[:] = torch.from_numpy(rgb).permute(2, 0, 1)
        crop(view, valid[i])[:] = torch.from_numpy(keep)
    names = tuple(view.name for view in views)
    return Views(images, valid, names, helpers), canvas_cameras(views, frame)


def crop(view: View, maps: _Map) -> _Map:
    """The part (…, h, w) of maps on the canvas (…, H, W) that is the view's own network image; no copy."""
    width, height = view.network.width, view.network.height
    left, top = (maps.shape[-1] - width) // 2, (maps.shape[-2] - height) // 2
    part: _Map = maps[..., top : top + height, left : left + width]
    return part
