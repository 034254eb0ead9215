"""What the page shows, gathered from a finished dense workspace: cloud, cameras, maps, errors, figures."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Model
from colmap_tco.dense import by_position, dense_views, point_confidence, thinned
from colmap_tco.image_files import read_image
from colmap_tco.maps import read_map
from colmap_tco.page.quantise import grid, levels, lossless, normal_codes, packed, photograph
from colmap_tco.ply import read_ply, read_vis
from colmap_tco.priors import held_out, usable_points
from colmap_tco.tracks import Tracks, read_tracks
from colmap_tco.views import View
from colmap_tco.workspace import DensePaths

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Limits:
    """How much of a result fits on the page.

    Attributes:
        cloud: points of the dense cloud, and of the sparse one.
        observations: errors at points, over all views.
        map_bytes: of all pictures together; more are made smaller.
        smallest: longest side of a picture that is not made smaller, pixels.
    """

    cloud: int = 150_000
    observations: int = 200_000
    map_bytes: int = 8_000_000
    smallest: int = 64


def content(paths: DensePaths, report: Mapping[str, Any], limits: Limits = Limits()) -> dict[str, Any]:
    """Everything that the page shows, as JSON can hold it.

    Args:
        paths: a dense workspace with maps, model and cloud.
        report: what ``report.json`` holds.
        limits: beyond which things are thinned or made smaller.

    Raises:
        InputError: a file is missing or damaged.
    """
    model = _pycolmap.read_model(paths.sparse)
    tracks, views = read_tracks(model), dense_views(paths, model)
    settings = report["settings"]
    held = (float(settings["priors"]["holdout"]), int(settings["seed"]))
    most = max(50, limits.observations // max(len(views), 1))
    with ThreadPoolExecutor(1) as beside:  # the cloud is half of the work
        cloud = beside.submit(dense_cloud, paths, model, views, limits.cloud)
        shown = {
            view.name: camera_of(view) | {"errors": errors_at_points(paths, tracks, view, held, most)}
            for view in views
        }
        for name, maps in all_maps(paths, views, limits).items():
            shown[name]["maps"] = maps
    rows = [{"name": name, **row, **shown.get(name, {})} for name, row in report["views"].items()]
    rest = {key: value for key, value in report.items() if key not in ("views", "loss")}
    return {
        "title": paths.root.absolute().parent.name,
        "up": up(views).tolist(),
        "report": rest,
        "loss": [columns(steps) for steps in report["loss"]],
        "views": rows,
        "cloud": cloud.result(),
        "sparse": sparse_cloud(model, held, limits.cloud),
    }


def up(views: Sequence[View]) -> NDArray[np.float64]:
    """The direction (3,) that is up in the mean of the pictures, unit length; −y where they cancel."""
    mean = -np.sum([view.cam_from_world[1, :3] for view in views], axis=0)
    length = np.linalg.norm(mean)
    return mean / length if length > 1e-3 * max(len(views), 1) else np.array([0.0, -1.0, 0.0])


def camera_of(view: View) -> dict[str, Any]:
    """Centre, rotation (rows: x, y, z of the camera in the world) and half extents at depth 1."""
    R, t = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
    c = view.camera
    return {
        "centre": (-R.T @ t).tolist(),
        "axes": R.tolist(),
        "half": [c.width / 2 / c.fx, c.height / 2 / c.fy],
        "size": [c.width, c.height],
    }


def columns(steps: Sequence[Mapping[str, float]]) -> dict[str, list[float | None]]:
    """The terms of all steps, name → one value a step, None where a step lacks it."""
    names = dict.fromkeys(name for step in steps for name in step)
    return {name: [step.get(name) for step in steps] for name in names}


def chosen_points(count: int, most: int, seed: int = 0) -> NDArray[np.int64]:
    """Indices of at most ``most`` of ``count`` points, in their order, the same every time."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(seed).permutation(count)[:most])


def dense_cloud(paths: DensePaths, model: Model, views: Sequence[View], most: int) -> dict[str, Any]:
    """The fused cloud: positions, colours, normals, number of confirming views, mean confidence."""
    points, normals, colors = read_ply(paths.ply)
    chosen = chosen_points(len(points), most)
    visibility = thinned(read_vis(paths.vis), chosen)
    points = points[chosen]
    confidence = point_confidence(paths, by_position(model, views), points, visibility)
    codes, low, high = levels(confidence)
    return _placed(points, colors[chosen]) | {
        "all": len(normals),
        "normal": packed(np.rint(127 * normals[chosen]).astype(np.int8)),
        "seen": packed(np.diff(visibility.start).clip(0, 255).astype(np.uint8)),
        "confidence": {"codes": packed(codes), "low": low, "high": high},
    }


def sparse_cloud(model: Model, held: tuple[float, int], most: int) -> dict[str, Any]:
    """COLMAP's points, and which of them were held out."""
    ids, xyz, rgb = _pycolmap.points(model)
    chosen = chosen_points(len(ids), most)
    return _placed(xyz[chosen], rgb[chosen]) | {
        "all": len(ids),
        "held": packed(held_out(ids[chosen], *held).astype(np.uint8)),
    }


def _placed(xyz: NDArray[np.floating], rgb: NDArray[np.uint8]) -> dict[str, Any]:
    codes, corner, step = grid(xyz)
    return {
        "count": len(codes),
        "xyz": packed(codes),
        "corner": corner.tolist(),
        "step": step.tolist(),
        "rgb": packed(rgb),
    }


def errors_at_points(
    paths: DensePaths, tracks: Tracks, view: View, held: tuple[float, int], most: int
) -> dict[str, Any]:
    """Relative depth errors of a view at COLMAP's points, and which of these were held out.

    Where a point falls is given in 1 / 65535 of the picture's sides. Where the map has no depth, the error
    is −1, as a depth of 0 has it.
    """
    xy, depth, ids = usable_points(tracks, view)
    found = read_map(paths.depth_map(view.name))
    x, y = np.floor(xy).astype(int).T
    error = found[y, x] / depth - 1
    out = held_out(ids, *held)
    chosen = chosen_points(len(ids), most)
    size = np.array([view.network.width, view.network.height])
    return {
        "count": len(chosen),
        "all": len(ids),
        "xy": packed(np.rint(65535 * xy[chosen] / size).astype(np.uint16)),
        "error": packed(error[chosen].astype(np.float32)),
        "held": packed(out[chosen].astype(np.uint8)),
    }


def all_maps(paths: DensePaths, views: Sequence[View], limits: Limits) -> dict[str, dict[str, Any]]:
    """The pictures of all views; where they are too many bytes, all smaller, and then of fewer views."""
    scale, every = 1.0, 1
    while True:
        made, total = {}, 0
        for view in views[::every]:
            made[view.name], size = view_maps(paths, view, scale)
            total += size
            if total > limits.map_bytes:
                break
        if total <= limits.map_bytes or len(made) <= 1:
            break
        share = len(made) / len(views[::every])
        smaller = scale * min(0.8, MARGIN * float(np.sqrt(share * limits.map_bytes / total)))
        longest = max(max(v.network.width, v.network.height) for v in views)
        if smaller * longest >= limits.smallest:
            scale = smaller
        else:
            every = max(every + 1, int(np.ceil(every / share)))
    if every > 1 or scale < 1:
        shown, all_views = len(views[::every]), len(views)
        log.info(
            "the page shows maps of %d of %d views, at %.0f %% of their size", shown, all_views, 100 * scale
        )
    return made


MARGIN = 0.93
"""Of the size that is estimated to fit: small pictures take more bytes a pixel, and a new try takes time."""


def view_maps(paths: DensePaths, view: View, scale: float) -> tuple[dict[str, Any], int]:
    """Image, depth, confidence, standard error and normals of one view as data URIs, and their bytes.

    A map that is made smaller keeps values of single pixels; it is never averaged.
    """
    import cv2

    width, height = (max(1, round(scale * side)) for side in (view.network.width, view.network.height))

    def small(array: NDArray[Any]) -> NDArray[Any]:
        same = array.shape[:2] == (height, width)
        return array if same else cv2.resize(array, (width, height), interpolation=cv2.INTER_NEAREST)

    found: dict[str, Any] = {"width": width, "height": height}
    picture = cv2.resize(read_image(paths.image(view.name)), (width, height), interpolation=cv2.INTER_AREA)
    found["image"] = photograph(np.asarray(picture, np.uint8))
    coded = {"depth": paths.depth_map(view.name), "confidence": paths.confidence_map(view.name)}
    if paths.error_map(view.name).is_file():  # a result of an earlier version has none
        coded["error"] = paths.error_map(view.name)
    for kind, path in coded.items():
        codes, low, high = levels(small(read_map(path)))
        found[kind] = {"codes": lossless(codes), "low": low, "high": high}
    found["normal"] = lossless(normal_codes(small(read_map(paths.normal_map(view.name)))))
    uris = [found["image"], found["normal"], *(found[kind]["codes"] for kind in coded)]
    return found, sum(map(len, uris))
