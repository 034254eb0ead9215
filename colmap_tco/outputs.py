"""What a dense workspace holds: undistorted images and model, maps, lists of views, cloud, report.

The folder is COLMAP's dense workspace, so that its tools and those of others read it; see
:class:`colmap_tco.workspace.DensePaths` for the names.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Model
from colmap_tco.atomic import UNFINISHED, atomic_file, write_text
from colmap_tco.errors import DensifyError
from colmap_tco.fusion_input import FusionMaps, FusionView
from colmap_tco.image_files import read_image
from colmap_tco.maps import read_map, write_map
from colmap_tco.ply import Cloud, needs_double, write_ply, write_vis
from colmap_tco.sparse_format import reorder_images
from colmap_tco.tracks import Tracks
from colmap_tco.views import View, map_mask, undistorted_image
from colmap_tco.workspace import DensePaths

JPEG_QUALITY = 95
COLOUR_DETAIL = 4
_DIGITS, _ALL_DIGITS = 6, 17
FEWEST_POINTS, NEARLY_ALL = 10, 0.98
"""Points of a view below which their depths bound nothing, and the share that shall lie before the bound."""


@dataclass(frozen=True)
class ViewMaps:
    """The dense result of one view, in the frame of its undistorted camera.

    Attributes:
        depth: (H, W) camera z in the units of the model, 0 where there is none.
        normal: (H, W, 3) unit normals in the camera frame, facing the camera, 0 where there is none.
        confidence: (H, W) at least 1.
        error: (H, W) relative standard error of the depth by how far apart the views were that were asked, 0
            where too few were; None if none were.
    """

    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    confidence: NDArray[np.float32]
    error: NDArray[np.float32] | None = None


def write_view(paths: DensePaths, view: View, maps: ViewMaps) -> None:
    """Write the undistorted image and the maps of a view.

    Raises:
        InputError: the image cannot be read.
        ValueError: a map holds a value that is not finite.
    """
    image, _ = undistorted_image(view)
    write_image(paths.image(view.name), image)
    write_maps(paths, view.name, maps)


def write_maps(paths: DensePaths, name: str, maps: ViewMaps, own: ViewMaps | None = None) -> None:
    """Write the maps of a view.

    Args:
        paths: the dense workspace.
        name: of the view.
        maps: the result; COLMAP's geometric maps.
        own: what the view said before the others were asked, which fusion takes as independent evidence;
            COLMAP's photometric maps. By default the same.

    Raises:
        ValueError: a map holds a value that is not finite.
    """
    write_map(paths.depth_map(name), maps.depth)
    write_map(paths.normal_map(name), maps.normal)
    write_map(paths.confidence_map(name), maps.confidence)
    write_map(paths.error_map(name), np.zeros_like(maps.depth) if maps.error is None else maps.error)
    own = own or maps
    for path, array in zip(paths.own_maps(name), (own.depth, own.normal), strict=True):
        write_map(path, array)


def write_image(path: Path, image: NDArray[np.uint8]) -> None:
    """Write RGB (H, W, 3) atomically, in the format of its extension; JPEG with quality 95.

    Raises:
        DensifyError: the extension is of a format that cannot be written.
    """
    import cv2

    extension = path.suffix.lower()
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if extension in (".jpg", ".jpeg") else []
    pixels = image.mean(2).round().astype(np.uint8) if extension == ".pgm" else image[..., ::-1]
    try:
        ok, data = cv2.imencode(extension, np.ascontiguousarray(pixels), options)
    except cv2.error as error:
        raise DensifyError(f"{path}: this image format cannot be written ({error.err})") from error
    if not ok:
        raise DensifyError(f"{path}: encoding the image failed")
    with atomic_file(path) as file:
        file.write(data.tobytes())


def undistorted_model(
    model: Model, views: Sequence[View], originals: Mapping[str, View] | None = None
) -> Model:
    """The model of the undistorted images: PINHOLE cameras, the same ids and names, the tracks.

    Observations go through the exact map of the views; those that the distortion cannot be inverted
    for, or that lie outside the undistorted image, are left out.

    Args:
        model: COLMAP's.
        views: with the cameras and poses to write: COLMAP's, or corrected ones.
        originals: where cameras are corrected, name → the view by which the image was undistorted.
    """
    images = []
    for view in views:
        camera = view.camera
        drawn = originals[view.name].camera if originals else camera
        xy, points = _pycolmap.observations(model, view.image_id)
        xy = drawn.pixels(_pycolmap.cam_from_img(view.original, xy))
        with np.errstate(invalid="ignore"):
            inside = ((xy >= 0) & (xy <= (drawn.width, drawn.height))).all(1)
        entry = _pycolmap.Registered(view.image_id, view.name, view.original, view.cam_from_world)
        row = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        images.append(_pycolmap.PinholeImage(entry, row, xy[inside], points[inside]))
    undistorted = _pycolmap.pinhole_model(images, _pycolmap.points(model))
    for view in views:
        undistorted.images[view.image_id].name = view.name  # COLMAP's text format ends a name at a space
    return undistorted


def write_model(paths: DensePaths, model: Model) -> dict[str, int]:
    """Write the undistorted model in binary.

    Returns:
        Name → position in ``reg_image_ids()`` of the model as it is read back, which can differ from
        that of the model in memory. It is how ``fused.ply.vis`` names images.
    """
    paths.sparse.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".sparse{UNFINISHED}", dir=paths.root) as folder:
        model.write(folder)
        for file in sorted(Path(folder).iterdir()):
            os.replace(file, paths.sparse / file.name)
    positions = image_positions(paths)
    ids = {image.name: int(key) for key, image in model.images.items()}
    reorder_images(paths.sparse / "images.bin", [ids[name] for name in positions])
    return positions


def image_positions(paths: DensePaths) -> dict[str, int]:
    """Name → position in ``reg_image_ids()`` of the undistorted model that was written."""
    model = _pycolmap.read_model(paths.sparse)
    return {model.images[key].name: position for position, key in enumerate(model.reg_image_ids())}


def write_lists(paths: DensePaths, neighbours: Mapping[str, Sequence[str]]) -> None:
    """Write ``fusion.cfg`` and ``patch-match.cfg`` and the folder that COLMAP expects beside them.

    Args:
        paths: the dense workspace.
        neighbours: name → names of the views that overlap, the best first. The lists are explicit,
            for OpenMVS reads no others. A name with a comma cannot be in a list and is left out of
            it; a view without any neighbour is given to COLMAP's own choice.
    """
    write_text(paths.fusion_cfg, "".join(f"{name}\n" for name in neighbours))
    lines = []
    for name, sources in neighbours.items():
        listed = [source for source in sources if "," not in source]
        lines += [name, ", ".join(listed) if listed else "__auto__, 20"]
    write_text(paths.patch_match_cfg, "".join(f"{line}\n" for line in lines))
    (paths.stereo / "consistency_graphs").mkdir(parents=True, exist_ok=True)


def write_cloud(paths: DensePaths, cloud: Cloud) -> None:
    """Write ``fused.ply``, in double precision where its coordinates need it, and ``fused.ply.vis``."""
    write_ply(paths.ply, cloud.points, cloud.normals, cloud.colors, needs_double(cloud.points))
    write_vis(paths.vis, cloud.visibility)


def fusion_views(
    paths: DensePaths,
    views: Sequence[View],
    neighbours: Mapping[str, Sequence[str]],
    indices: Mapping[str, int],
    reach: Mapping[str, float] | None = None,
    agreed: bool = False,
    sure: float = math.inf,
) -> list[FusionView]:
    """The views of a dense workspace for :func:`colmap_tco.fusion.fuse`; arrays are read when needed.

    Args:
        paths: where :func:`write_view` has written.
        views: the views to fuse.
        neighbours: name → names of overlapping views, the best first; others than ``views`` are ignored.
        indices: as :func:`write_model` returns them.
        reach: name → depth that hardly a point exceeds, see :func:`reaches`; no bound for other views.
        agreed: with the maps that the views agreed on instead of each view's own.
        sure: see :class:`colmap_tco.fusion_input.FusionView`.
    """
    position = {view.name: i for i, view in enumerate(views)}
    return [
        FusionView(
            name=view.name,
            index=indices[view.name],
            camera=view.camera,
            cam_from_world=view.cam_from_world,
            neighbours=tuple(position[n] for n in neighbours[view.name] if n in position),
            load=lambda view=view: _masked(read_view(paths, view.name, agreed), view),  # type: ignore[misc]
            reach=(reach or {}).get(view.name, math.inf),
            sure=sure,
        )
        for view in views
    ]


def _masked(maps: FusionMaps, view: View) -> FusionMaps:
    """The maps with the mask of the view, so that what it excludes counts under its own name.

    The image is made as small as its colours allow: a point stands for a pixel of the maps.
    """
    image = no_finer(maps.image, maps.depth.shape)
    return replace(maps, image=image, mask=map_mask(view, maps.depth.shape))


def no_finer(image: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """An image (H, W, 3) with at least four pixels along each pixel of a map (h, w), means of its own.

    Of large photos few fit the memory, and fusion would read each of them again and again. A point stands for
    a whole pixel of the map, so that it needs no finer colours.
    """
    import cv2

    factor = min(image.shape[0] // (COLOUR_DETAIL * shape[0]), image.shape[1] // (COLOUR_DETAIL * shape[1]))
    if factor < 2:
        return image
    size = (image.shape[1] // factor, image.shape[0] // factor)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def reaches(tracks: Tracks, views: Sequence[View]) -> dict[str, float]:
    """Name → depth that 2 % of the points in a view exceed; of the views with enough points to say."""
    found = {}
    for view in views:
        xyz = tracks.xyz[tracks.images[view.image_id].point]
        depth = xyz @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3]
        if len(depth) >= FEWEST_POINTS:
            found[view.name] = float(np.quantile(depth, NEARLY_ALL))
    return found


def read_view(paths: DensePaths, name: str, agreed: bool = False) -> FusionMaps:
    """The image of a view and its maps, as :func:`write_view` and :func:`write_maps` wrote them.

    Args:
        paths: the dense workspace.
        name: of the view.
        agreed: the maps that the views agreed on, and how exact these are, instead of the view's own.

    Raises:
        InputError: a file is missing or damaged.
    """
    files = (paths.depth_map(name), paths.normal_map(name)) if agreed else paths.own_maps(name)
    depth, normal = (read_map(path) for path in files)
    return FusionMaps(
        depth=depth,
        normal=normal,
        image=read_image(paths.image(name)),
        confidence=read_map(paths.confidence_map(name)),
        error=read_map(paths.error_map(name)) if agreed else None,
    )


def write_report(path: Path, report: Mapping[str, object]) -> None:
    """Write ``report.json``: plain JSON, see :func:`plain`."""
    import json

    text = json.dumps(plain(report), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def plain(value: object, digits: int = _DIGITS) -> object:
    """``value`` as JSON holds it: dataclasses, arrays, paths and numpy numbers resolved, null for infinity.

    Floats are rounded to ``digits`` significant ones, but for those of dataclasses, which are settings: a box
    in map coordinates would be metres off.

    Raises:
        TypeError: a kind of value that has no plain form.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value), _ALL_DIGITS)
    if isinstance(value, Mapping):
        return {str(key): plain(item, digits) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist(), digits)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float):
        return float(f"{value:.{digits}g}") if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, Iterable):
        return [plain(item, digits) for item in value]
    raise TypeError(f"{type(value).__name__} has no place in a report")
