"""Find and check the images and the model of a workspace, and own the name of every path in it."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from colmap_tco import _pycolmap, model_files
from colmap_tco._pycolmap import Model, Registered
from colmap_tco.errors import InputError
from colmap_tco.image_files import PICTURES, decoded_size, list_images, other_formats
from colmap_tco.lens import implausible
from tco.config import knob

log = logging.getLogger(__name__)

LISTED = 10
"""How many names an error message lists before it says how many more there are."""


@dataclass(frozen=True)
class WorkspaceConfig:
    """Where the inputs are, when not in their usual places."""

    image_path: str = knob("", "folder of the images; empty: <workspace>/images, or the workspace itself")
    model_path: str = knob(
        "",
        "folder of the sparse model; empty: of sparse/*, sparse/ and the workspace the one with most images",
    )


@dataclass(frozen=True)
class DensePaths:
    """Every path of a dense workspace, COLMAP's names (``mvs/workspace.cc``)."""

    root: Path

    @property
    def images(self) -> Path:
        """Folder of the undistorted images."""
        return self.root / "images"

    @property
    def sparse(self) -> Path:
        """Folder of the undistorted model."""
        return self.root / "sparse"

    @property
    def stereo(self) -> Path:
        """Folder of the maps and of the two .cfg files."""
        return self.root / "stereo"

    @property
    def fusion_cfg(self) -> Path:
        """List of the images to fuse."""
        return self.stereo / "fusion.cfg"

    @property
    def patch_match_cfg(self) -> Path:
        """List of reference images and their sources."""
        return self.stereo / "patch-match.cfg"

    @property
    def ply(self) -> Path:
        """The fused cloud."""
        return self.root / "fused.ply"

    @property
    def vis(self) -> Path:
        """The views that confirm each point of the cloud."""
        return self.root / "fused.ply.vis"

    @property
    def report(self) -> Path:
        """Versions, settings, timings, figures."""
        return self.root / "report.json"

    @property
    def page(self) -> Path:
        """The report as a page for the browser."""
        return self.root / "report.html"

    @property
    def manifest(self) -> Path:
        """What a later run needs to know to resume."""
        return self.root / "manifest.json"

    def image(self, name: str) -> Path:
        """The undistorted image."""
        return self.images / name

    def depth_map(self, name: str) -> Path:
        """The depth map of an image that agrees with the others', in COLMAP's matrix format."""
        return self.stereo / "depth_maps" / f"{name}.geometric.bin"

    def normal_map(self, name: str) -> Path:
        """The normal map of an image, in COLMAP's matrix format."""
        return self.stereo / "normal_maps" / f"{name}.geometric.bin"

    def own_maps(self, name: str) -> tuple[Path, Path]:
        """Depth and normal map from before the other images were asked, which COLMAP calls photometric."""
        file = f"{name}.photometric.bin"
        return self.stereo / "depth_maps" / file, self.stereo / "normal_maps" / file

    def confidence_map(self, name: str) -> Path:
        """The confidence of the depth map, in the same format; COLMAP ignores the folder."""
        return self.stereo / "confidence_maps" / f"{name}.geometric.bin"

    def error_map(self, name: str) -> Path:
        """The standard error of the depth map, in the same format; COLMAP ignores the folder."""
        return self.stereo / "error_maps" / f"{name}.geometric.bin"


@dataclass(frozen=True)
class Workspace:
    """A checked workspace.

    Attributes:
        root: the folder that the user named.
        image_folder: the folder to which the names in the model are relative.
        model_path: folder of the chosen model.
        model: the ``pycolmap.Reconstruction``.
        images: registered images whose files are usable, ordered by name.
        reasons: sentences that say why these images and this model, and what is to be doubted in it.
        skipped: name → why a registered image is not used.
        unregistered: name → why a picture in the image folder has no camera in this model.
    """

    root: Path
    image_folder: Path
    model_path: Path
    model: Model
    images: tuple[Registered, ...]
    reasons: tuple[str, ...]
    skipped: Mapping[str, str] = field(default_factory=dict)
    unregistered: Mapping[str, str] = field(default_factory=dict)

    @property
    def dense(self) -> DensePaths:
        """The finished result."""
        return dense_paths(self.root)

    @property
    def partial(self) -> DensePaths:
        """The result while it is being made; renamed to ``dense`` at the end."""
        return partial_paths(self.root)


def dense_paths(root: Path) -> DensePaths:
    """Where the finished result of a workspace goes."""
    return DensePaths(root / "dense-tco")


def partial_paths(root: Path) -> DensePaths:
    """Where the result of a workspace is made."""
    return DensePaths(root / ".dense-tco.partial")


def open_workspace(
    root: Path | str, config: WorkspaceConfig = WorkspaceConfig(), num_threads: int = -1
) -> Workspace:
    """Find, choose and check everything that a run reads.

    Raises:
        InputError: no folder, no images, no usable model, or no registered image with a usable file.
    """
    root = existing_root(root)
    folders = [Path(config.model_path)] if config.model_path else find_models(root)
    model_path, model, reasons, elsewhere = choose_model(root, folders)
    entries = _pycolmap.registered(model)
    folder = find_images(root, config.image_path, [entry.name for entry in entries])
    reasons.append(f"images from {folder}")
    skipped = check_images(folder, entries, num_threads)
    images = tuple(entry for entry in entries if entry.name not in skipped)
    if not images:
        raise InputError(
            f"none of the {len(entries)} images of {model_path} is usable in {folder}:\n{listing(skipped)}\n"
            "Name the folder that the model was made from with --image_path."
        )
    for reason in reasons:
        log.info("%s", reason)
    doubts = implausible(entries)
    for doubt in doubts:
        log.warning("%s", doubt)
    if skipped:
        log.warning("%d of %d images are skipped:\n%s", len(skipped), len(entries), listing(skipped))
    others = unregistered_images(root, folder, [entry.name for entry in entries], elsewhere, num_threads)
    if others:
        log.warning("%d pictures are not in the model:\n%s", len(others), listing(others))
    return Workspace(root, folder, model_path, model, images, (*reasons, *doubts), skipped, others)


def unregistered_images(
    root: Path, folder: Path, names: Sequence[str], elsewhere: Mapping[str, Path], num_threads: int = -1
) -> dict[str, str]:
    """Name → reason for the pictures in the image folder that the model has no camera of.

    Args:
        root: the workspace.
        folder: of the images.
        names: of the registered images.
        elsewhere: name → another model of the workspace that has it.
        num_threads: that decode the pictures, one a core if not positive.
    """
    recursive = folder != root
    left = sorted(set(list_images(folder, recursive)) - set(names))
    with ThreadPoolExecutor(num_threads if num_threads > 0 else os.cpu_count() or 1) as pool:
        reasons = pool.map(lambda name: _why_not(folder, name, elsewhere), left)
        return other_formats(folder, recursive) | dict(zip(left, reasons, strict=True))


def _why_not(folder: Path, name: str, elsewhere: Mapping[str, Path]) -> str:
    if name in elsewhere:
        return f"COLMAP registered it in {elsewhere[name]}, not in the model that was chosen"
    try:
        decoded_size(folder / name)
    except InputError as error:
        return str(error)
    return "COLMAP did not register it: too few matches with the images of the model"


def existing_root(root: Path | str) -> Path:
    """The workspace folder as an absolute path.

    Raises:
        InputError: it is not a folder.
    """
    path = Path(root).expanduser()
    if not path.is_dir():
        raise InputError(f"{path} is not a folder; name the workspace that holds images/ and sparse/")
    return path.absolute()


def listing(reasons: Mapping[str, str]) -> str:
    """Some of the reasons, one a line, for a message."""
    lines = [f"  {name}: {reason}" for name, reason in list(reasons.items())[:LISTED]]
    return "\n".join(lines + [f"  … and {len(reasons) - LISTED} more"] * (len(reasons) > LISTED))


def find_images(root: Path, image_path: str = "", wanted: Sequence[str] = ()) -> Path:
    """The image folder: the one named, else ``images/``, else the root.

    Args:
        root: the workspace.
        image_path: a folder that the user named, taken as it is.
        wanted: names in the model. A folder in which none of them exists is passed over.

    Raises:
        InputError: there are no pictures.
    """
    if image_path:
        folder = Path(image_path).expanduser().absolute()
        if not folder.is_dir() or not list_images(folder):
            raise InputError(f"--image_path {folder} holds no pictures ({', '.join(sorted(PICTURES))})")
        return folder
    candidates = [f for f in (root / "images", root) if f.is_dir() and list_images(f, recursive=f != root)]
    for folder in candidates:
        if any((folder / name).is_file() for name in wanted):
            return folder
    if wanted and any((root / name).is_file() for name in wanted):
        return root
    if not candidates:
        foreign = other_formats(root)
        raise InputError(
            f"{root}: no pictures in {root / 'images'} nor in the folder itself "
            f"({', '.join(sorted(PICTURES))}); name their folder with --image_path"
            + (f", or convert those that are there to JPEG:\n{listing(foreign)}" if foreign else "")
        )
    return candidates[0]


def find_models(root: Path) -> list[Path]:
    """Folders that hold a sparse model: ``sparse/*``, ``sparse/``, the root, in this order."""
    sparse = root / "sparse"
    inside = sorted(path for path in sparse.iterdir() if path.is_dir()) if sparse.is_dir() else []
    return [folder for folder in [*inside, sparse, root] if _looks_like_model(folder)]


def _looks_like_model(folder: Path) -> bool:
    """At least two of COLMAP's three files, so that a copy with one missing is reported, not overlooked."""
    return any(
        sum((folder / (name + kind)).is_file() for name in model_files.NAMES) >= 2
        for kind in model_files.KINDS
    )


class Chosen(NamedTuple):
    """The model to use.

    Attributes:
        folder: where it is.
        model: the reconstruction.
        reasons: sentences on the choice.
        elsewhere: name → another model that holds an image which this one does not.
    """

    folder: Path
    model: Model
    reasons: list[str]
    elsewhere: dict[str, Path]


def choose_model(root: Path, folders: Sequence[Path]) -> Chosen:
    """The model with most registered images; of equals, with most points; of equals, first by name.

    Raises:
        InputError: no model, none readable, or none with points.
    """
    if not folders:
        raise InputError(f"{root}: no sparse model in sparse/*, sparse/ or the folder itself")
    models: dict[Path, Model] = {}
    reasons, broken = [], {}
    for folder in folders:
        try:
            model = _pycolmap.read_model(folder)
        except InputError as error:
            broken[str(folder)] = str(error)
            continue
        if len(model.points3D) and model.num_reg_images():
            models[folder] = model
        else:
            broken[str(folder)] = f"{_size(model)}: it takes posed images and triangulated points"
    if not models:
        raise InputError(
            f"{root}: no usable sparse model:\n{listing(broken)}\n"
            "Make one with colmap mapper, or add points to known poses with colmap point_triangulator."
        )
    best = min(models, key=lambda f: (-models[f].num_reg_images(), -len(models[f].points3D), str(f)))
    reasons.append(f"model {best}: {_size(models[best])}")
    others = [f"{f.name or f}: {_size(models[f])}" for f in models if f != best]
    if others:
        reasons[0] += f", the most of {len(models)} models ({'; '.join(others)})"
    reasons += [f"model {folder} not considered: {why}" for folder, why in broken.items()]
    elsewhere = {e.name: f for f, other in models.items() if f != best for e in _pycolmap.registered(other)}
    return Chosen(best, models[best], reasons, elsewhere)


def _size(model: Model) -> str:
    return f"{model.num_reg_images()} images, {len(model.points3D)} points"


def check_images(folder: Path, entries: Sequence[Registered], num_threads: int = -1) -> dict[str, str]:
    """Name → reason for the registered images that cannot be used.

    Every file is decoded to its end, at the lowest resolution that the format allows, because a
    truncated JPEG otherwise passes as an image with a grey lower part.
    """
    workers = num_threads if num_threads > 0 else os.cpu_count() or 1
    with ThreadPoolExecutor(workers) as pool:
        reasons = pool.map(lambda entry: _image_fault(folder / entry.name, entry), entries)
        return {entry.name: reason for entry, reason in zip(entries, reasons, strict=True) if reason}


def _image_fault(path: Path, entry: Registered) -> str:
    """Why this file does not serve this image of the model; empty if it does."""
    if not path.is_file():
        return f"the model names it, but there is no file {path}"
    if _pycolmap.is_spherical(entry.camera):
        return f"camera model {entry.camera.model.name} covers more than a pinhole camera can"
    try:
        size = decoded_size(path)
    except InputError as error:
        return str(error)
    expected = _pycolmap.camera_size(entry.camera)
    if size != expected:
        hint = "rotated after mapping" if size == expected[::-1] else "resized or replaced after mapping"
        return f"{size[0]}×{size[1]} pixels where its camera has {expected[0]}×{expected[1]}: {hint}?"
    return ""
