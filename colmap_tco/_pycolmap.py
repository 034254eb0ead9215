"""The one place that knows pycolmap: its versions (3.11 to 4.2), its import order, its vague errors.

pycolmap is loaded on first use, because the command line imports its neighbours for their settings.
Nothing else in this package imports it.
"""

from __future__ import annotations

import logging
import os
import tempfile
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from colmap_tco import model_files
from colmap_tco.errors import InputError
from colmap_tco.signals import sigterm_kept

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]
Model: TypeAlias = Any
"""A ``pycolmap.Reconstruction``."""
Camera: TypeAlias = Any
"""A ``pycolmap.Camera``."""

SPHERICAL = ("EQUIRECTANGULAR",)


@cache
def load() -> Any:
    """The pycolmap module, imported after every other user of zlib.

    Of its own log only errors come through, all of it where the logger ``pycolmap`` is enabled for INFO.
    The wheels of 4.1.1 and later bring a zlib of their own. Whoever binds zlib's symbols after them
    gets theirs, and PNG writing (Pillow, OpenCV), ``np.savez_compressed`` and gzip abort the process;
    imported before, each keeps the zlib that it was built with.
    """
    import gzip  # noqa: F401
    import zlib  # noqa: F401

    import cv2  # noqa: F401
    from PIL import Image

    Image.init()  # loads the plug-ins, PNG among them
    with sigterm_kept():
        import pycolmap
    talkative = logging.getLogger("pycolmap").isEnabledFor(logging.INFO)
    pycolmap.logging.minloglevel = 0 if talkative else 2  # glog's INFO and ERROR
    return pycolmap


def version() -> tuple[int, int]:
    """(major, minor) of the installed pycolmap."""
    major, minor = load().__version__.split(".")[:2]
    return int(major), int(minor)


def read_model(path: Path) -> Model:
    """The reconstruction in a folder, binary or text.

    Raises:
        InputError: a file is missing, truncated, or not COLMAP's format.
    """
    missing = model_files.missing(path)
    if missing:
        raise InputError(f"{path}: {', '.join(missing)} missing; a model needs {model_files.NAMES}")
    cut = model_files.cut_off(path)
    if cut:
        raise _broken(path, f"{cut} ends before its last entry")
    try:
        model = load().Reconstruction(str(path))
    except (ValueError, IndexError, KeyError, RuntimeError, MemoryError) as error:
        raise _broken(path, f"COLMAP's reader says: {error}") from error
    fault = _fault(path, model)
    if fault:
        raise _broken(path, fault)
    return model


def _broken(path: Path, cause: str) -> InputError:
    return InputError(
        f"{path}: not readable as a COLMAP model, probably a truncated or interrupted copy "
        f"({cause}; {model_files.sizes(path)}). Copy or export the model again."
    )


def _fault(path: Path, model: Model) -> str:
    """What shows that a model was read from incomplete files though the reader did not complain."""
    for camera in model.cameras.values():
        if not _plausible(camera):
            return f"camera {camera.camera_id} has no valid size or focal length"
    if model_files.kind_of(path) == ".bin" and (path / "cameras.bin").stat().st_size < _cameras_size(model):
        return "cameras.bin ends before its last entry"
    in_images = sum(image.num_points3D for image in model.images.values())
    in_points = sum(point.track.length() for point in model.points3D.values())
    if in_images != in_points:
        return f"its images have {in_images} observations, its points {in_points}"
    return ""


def _plausible(camera: Camera) -> bool:
    params = np.asarray(camera.params, float)
    return bool(camera.width > 0 and camera.height > 0 and np.isfinite(params).all() and params[0] > 0) or (
        is_spherical(camera)
    )


def _cameras_size(model: Model) -> int:
    """Bytes of a complete cameras.bin: a count, then id, model, width, height and parameters."""
    return 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())


def is_spherical(camera: Camera) -> bool:
    """Whether the camera covers directions that no single pinhole can (its focal length does not exist)."""
    return str(camera.model.name) in SPHERICAL


def camera(model: str, size: tuple[int, int], params: Sequence[float]) -> Camera:
    """A camera of a model of COLMAP, such as THIN_PRISM_FISHEYE, of this (width, height) in pixels.

    Raises:
        InputError: no such model, or not its number of parameters.
    """
    try:
        found = load().Camera(model=model, width=size[0], height=size[1], params=list(params))
    except (ValueError, RuntimeError, TypeError) as error:
        raise InputError(f"{model} is no camera model of this pycolmap: {error}") from error
    if not found.verify_params():
        raise InputError(f"camera model {model} does not take {len(params)} parameters")
    return found


def camera_size(camera: Camera) -> tuple[int, int]:
    """(width, height) in pixels."""
    return int(camera.width), int(camera.height)


def focal_lengths(camera: Camera) -> tuple[float, float]:
    """(fx, fy) in pixels; not defined for spherical cameras, where pycolmap 4.2 crashes if asked."""
    return float(camera.focal_length_x), float(camera.focal_length_y)


def img_from_cam(camera: Camera, xy: Floats) -> Floats:
    """Pixels (N, 2) of normalised camera coordinates (N, 2), that is x / z and y / z."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        pixels = camera.img_from_cam(np.concatenate([xy, np.ones((len(xy), 1))], 1))
    return np.asarray(pixels, float).reshape(-1, 2)


def cam_from_img(camera: Camera, pixels: Floats, tolerance: float = 0.01) -> Floats:
    """Normalised camera coordinates (N, 2) of pixels (N, 2); NaN where the model has no inverse.

    COLMAP's iteration can leave a wrong value beyond the radius at which a polynomial folds back, and
    fisheye rays at 90° or more come out mirrored: what does not project back within ``tolerance``
    pixels is not accepted.
    """
    pixels = np.ascontiguousarray(pixels, float).reshape(-1, 2)
    xy = np.asarray(camera.cam_from_img(pixels), float).reshape(-1, 2)
    back = img_from_cam(camera, np.where(np.isfinite(xy), xy, 0.0))
    with np.errstate(invalid="ignore"):
        wrong = ~(np.abs(back - pixels).max(1) <= tolerance)
    xy[wrong | ~np.isfinite(xy).all(1)] = np.nan
    return xy


@dataclass(frozen=True)
class Registered:
    """One registered image of a model.

    Attributes:
        image_id: COLMAP's id.
        name: path relative to the image folder, with forward slashes.
        camera: its ``pycolmap.Camera``.
        cam_from_world: (3, 4) float64.
    """

    image_id: int
    name: str
    camera: Camera
    cam_from_world: Floats


def registered(model: Model) -> list[Registered]:
    """The images that have a pose, ordered by name."""
    found = []
    for image in model.images.values():
        if image.has_pose:
            pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
            camera = model.cameras[image.camera_id]
            found.append(Registered(int(image.image_id), image.name, camera, np.array(pose.matrix(), float)))
    return sorted(found, key=lambda entry: entry.name)


def observations(model: Model, image_id: int) -> tuple[Floats, Ints]:
    """Keypoints (N, 2) of one image that belong to a 3D point, and the ids (N,) of those points."""
    points = model.images[image_id].get_observation_points2D()
    xy = np.array([point.xy for point in points], float).reshape(-1, 2)
    return xy, np.array([point.point3D_id for point in points], np.int64)


def points(model: Model) -> tuple[Ints, Floats, NDArray[np.uint8]]:
    """Ids (P,), world positions (P, 3) and RGB colours (P, 3) of the 3D points, ordered by id."""
    entries = sorted(model.points3D.items())
    ids = np.array([key for key, _ in entries], np.int64)
    xyz = np.array([point.xyz for _, point in entries], float).reshape(-1, 3)
    rgb = np.array([point.color for _, point in entries], np.uint8).reshape(-1, 3)
    return ids, xyz, rgb


def point_errors(model: Model) -> Floats:
    """Mean reprojection errors (P,) in pixels of the 3D points, ordered by id."""
    return np.array([point.error for _, point in sorted(model.points3D.items())], float)


@dataclass(frozen=True)
class PinholeImage:
    """One image of a model to be written by :func:`pinhole_model`.

    Attributes:
        entry: id, name and pose.
        camera: width, height, fx, fy, cx, cy.
        xy: (N, 2) keypoints in that camera.
        points: (N,) the ids of their 3D points.
    """

    entry: Registered
    camera: tuple[int, int, float, float, float, float]
    xy: Floats
    points: Ints


def pinhole_model(images: list[PinholeImage], cloud: tuple[Ints, Floats, NDArray[np.uint8]]) -> Model:
    """A reconstruction with PINHOLE cameras alone; ids, names and poses as given.

    It goes through COLMAP's text format (``scene/reconstruction_io_text.cc``), which every version
    reads, so that rigs and frames are made by the version that wants them. Equal cameras are shared.

    Args:
        images: the images to keep.
        cloud: as :func:`points` gives it; points that fewer than two of the images see are left out.
    """
    seen: dict[int, list[tuple[int, int]]] = {}
    for image in images:
        for index, point in enumerate(image.points.tolist()):
            seen.setdefault(point, []).append((image.entry.image_id, index))
    tracks = {point: track for point, track in seen.items() if len({i for i, _ in track}) > 1}
    cameras = {camera: i for i, camera in enumerate(dict.fromkeys(image.camera for image in images), 1)}
    with tempfile.TemporaryDirectory(prefix="colmap-tco-") as folder:
        lines = [f"{i} PINHOLE {_row(camera)}" for camera, i in cameras.items()]
        _write_lines(folder, "cameras.txt", lines)
        _write_lines(folder, "images.txt", [_image_lines(i, cameras[i.camera], tracks) for i in images])
        _write_lines(folder, "points3D.txt", _point_lines(cloud, tracks))
        model = load().Reconstruction(folder)
    model.update_point_3d_errors()
    return model


def _write_lines(folder: str, name: str, lines: Iterable[str]) -> None:
    with open(os.path.join(folder, name), "w", encoding="utf-8") as file:
        file.writelines(line + "\n" for line in lines)


def _row(values: Iterable[float]) -> str:
    """Numbers with all their digits."""
    return " ".join(map(repr, values))


def _image_lines(image: PinholeImage, camera_id: int, kept: Mapping[int, object]) -> str:
    entry = image.entry
    rotation = load().Rotation3d(np.ascontiguousarray(entry.cam_from_world[:, :3]))
    x, y, z, w = np.asarray(rotation.quat, float).tolist()
    pose = _row([w, x, y, z, *entry.cam_from_world[:, 3].tolist()])
    owners = [point if point in kept else -1 for point in image.points.tolist()]
    keypoints = " ".join(f"{_row(xy)} {owner}" for xy, owner in zip(image.xy.tolist(), owners, strict=True))
    return f"{entry.image_id} {pose} {camera_id} {entry.name}\n{keypoints}"


def _point_lines(
    cloud: tuple[Ints, Floats, NDArray[np.uint8]], tracks: Mapping[int, list[tuple[int, int]]]
) -> Iterable[str]:
    for point, xyz, rgb in zip(*(part.tolist() for part in cloud), strict=True):
        if point in tracks:
            track = " ".join(f"{image} {index}" for image, index in tracks[point])
            yield f"{point} {_row(xyz)} {_row(rgb)} 0 {track}"


def extract_features(
    database: Path, folder: Path, names: list[str], share_camera: bool, threads: int, seed: int
) -> None:
    """Add SIFT features of the named images to a database, with one new camera for all or one for each."""
    pycolmap = load()
    pycolmap.set_random_seed(seed)
    kind, key = (
        ("FeatureExtractionOptions", "extraction_options")
        if hasattr(pycolmap, "FeatureExtractionOptions")
        else ("SiftExtractionOptions", "sift_options")
    )
    options = getattr(pycolmap, kind)()
    options.num_threads = threads
    key_names = "image_names" if version() >= (3, 12) else "image_list"
    mode = pycolmap.CameraMode.SINGLE if share_camera else pycolmap.CameraMode.PER_IMAGE
    arguments = {key_names: names, "camera_mode": mode, key: options}
    pycolmap.extract_features(str(database), str(folder), **arguments)


def match(database: Path, threads: int, seed: int, overlap: int | None = None) -> None:
    """Match and verify all pairs, or those at most ``overlap`` (and powers of two) apart in name order."""
    pycolmap = load()
    if overlap is None:
        pycolmap.match_exhaustive(str(database), **_matching(threads, seed))
        return
    modern = hasattr(pycolmap, "SequentialPairingOptions")
    pairing = pycolmap.SequentialPairingOptions() if modern else pycolmap.SequentialMatchingOptions()
    pairing.overlap = overlap
    key = "pairing_options" if modern else "matching_options"
    pycolmap.match_sequential(str(database), **_matching(threads, seed), **{key: pairing})


def can_match_pairs() -> bool:
    """Whether this pycolmap can match a list of pairs (from 4.0)."""
    return hasattr(load(), "match_image_pairs")


def match_pairs(database: Path, pair_list: Path, threads: int, seed: int) -> None:
    """Match and verify the pairs in a text file, two names a line."""
    pairing = load().ImportedPairingOptions()
    pairing.match_list_path = str(pair_list)
    load().match_image_pairs(str(database), pairing_options=pairing, **_matching(threads, seed))


def _matching(threads: int, seed: int) -> dict[str, Any]:
    """Matching and verification options under the names of this version, seeded where it can be."""
    pycolmap = load()
    pycolmap.set_random_seed(seed)
    modern = hasattr(pycolmap, "FeatureMatchingOptions")
    options = pycolmap.FeatureMatchingOptions() if modern else pycolmap.SiftMatchingOptions()
    options.num_threads = threads
    verification = pycolmap.TwoViewGeometryOptions()
    if hasattr(verification.ransac, "random_seed"):
        verification.ransac.random_seed = seed
    return {("matching_options" if modern else "sift_options"): options, "verification_options": verification}


def has_global_mapper() -> bool:
    """Whether this pycolmap has the global mapper (from 4.0)."""
    return hasattr(load(), "global_mapping")


def run_mapper(
    inputs: tuple[Path, Path], output: Path, use_global: bool, threads: int, seed: int,
    registered: Callable[[], None] = lambda: None,
) -> int:  # fmt: skip
    """Reconstruct into ``output``/0, 1, …

    Args:
        inputs: database and image folder.
        output: an existing folder.
        use_global: the global mapper instead of the incremental one.
        threads: -1 for all cores.
        seed: of the random generators, where the version has a setting.
        registered: called whenever the incremental mapper has added an image, after its first two.

    Returns:
        The number of models that hold points.
    """
    pycolmap = load()
    pycolmap.set_random_seed(seed)
    options = pycolmap.GlobalPipelineOptions() if use_global else pycolmap.IncrementalPipelineOptions()
    options.num_threads = threads
    for name, value in (("min_model_size", 3), ("random_seed", seed)):
        if hasattr(options, name):
            setattr(options, name, value)
    run = pycolmap.global_mapping if use_global else pycolmap.incremental_mapping
    told = {} if use_global else {"next_image_callback": registered}
    models = run(str(inputs[0]), str(inputs[1]), str(output), options=options, **told)
    return sum(len(model.points3D) > 0 for model in models.values())


def triangulate_points(model: Model, inputs: tuple[Path, Path], output: Path, threads: int) -> int:
    """Write to ``output`` a model with the cameras of ``model`` and points, and return their number.

    ``inputs`` are a database with matches, whose images, cameras and ids are those of the model, and the
    image folder.
    """
    options = load().IncrementalPipelineOptions()
    options.num_threads = threads
    paths = [str(path) for path in (*inputs, output)]
    found = load().triangulate_points(model, *paths, options=options)
    found.write(paths[-1])
    return len(found.points3D)
