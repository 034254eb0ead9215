"""``colmap-tco poses``: a metric trajectory of images from their measured depths.

images, depths → rough poses → levels → tco.poses.refine → workspace with model, images and trajectory
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from colmap_tco import report
from colmap_tco.backbones import NetworkConfig
from colmap_tco.depth_views import Depth, find_depths, on_canvas, read_depths
from colmap_tco.errors import InputError
from colmap_tco.image_files import list_images
from colmap_tco.pose_outputs import OURS, Found, write
from colmap_tco.progress import Progress
from colmap_tco.rough import Rough, RoughConfig, read_rough, scale_of
from colmap_tco.views import ChunkFrame, View, ViewConfig, batch, canvas_size, make_views
from colmap_tco.workspace import Workspace, check_images, listing
from tco.config import knob
from tco.pose_options import PoseConfig

if TYPE_CHECKING:
    from tco.poses import Level, Poses

log = logging.getLogger(__name__)

STRIDE = 4
"""Sides of the images that poses are refined on are multiples of this."""
LEAST_SURFELS = 0.2
"""Share of the measured pixels that must have measured neighbours for a size to be used."""


@dataclass(frozen=True)
class PosesConfig:
    """Where the depths are, and the run as a whole."""

    depths: Path | None = knob(
        None,
        "folder of the depth maps, registered to the images and named like them: 16-bit PNG, .npy or "
        "COLMAP's .bin, of any resolution; 0, NaN and 65535 are not measured",
    )
    depth_unit: float = knob(
        0.001, "length of one count of 16-bit PNG files, metres; .npy and .bin are metres"
    )
    output_path: Path | None = knob(
        None, "folder of the result; none: poses-tco beside the images", alias="-o"
    )
    overwrite: bool = knob(False, "replace an earlier result")
    steps: int = knob(40, "steps of the network's adaptation, where it finds the poses")
    seed: int = knob(0, "seed of all randomness")
    rough: RoughConfig = field(default_factory=RoughConfig)
    poses: PoseConfig = field(default_factory=PoseConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)


@dataclass(frozen=True)
class Trajectory:
    """Where the result is, and its report."""

    folder: Path
    report: Mapping[str, Any]

    def summary(self) -> str:
        """What the user wants to know at the end."""
        r = self.report
        spread = r["disagreement"]["after"].get("geometric")
        agreement = "" if spread is None else f"; depths of the views agree to {100 * spread:.2f} %"
        still = f", {len(r['not_moved'])} stayed where they were" if r["not_moved"] else ""
        return (
            f"{self.folder / 'sparse' / '0'} and trajectory.txt: {r['images']} poses{still}{agreement}\n"
            f"scale {r['scale']:.5g} ({r['scale_origin']}); details in {self.folder / 'report.json'}"
        )


def poses(images: Path, config: PosesConfig, progress: Progress) -> Trajectory:
    """Find the poses of the images in a folder from their depth maps; nothing of the user's is changed.

    Raises:
        InputError: no images or depths, no rough poses and no network that finds any, rough poses from which
            no view sees another, or an earlier result that may not be replaced.
        MissingError: no such device or weights.
    """
    start = time.monotonic()
    folder, output = _folders(images, config)
    names = list_images(folder)
    assert config.depths is not None
    files = find_depths(config.depths.expanduser().absolute(), names)
    progress.plan({"rough poses": 10.0, "refinement": 85.0, "writing": 5.0})
    progress.stage("rough poses", 1)
    rough = _rough(folder, names, files, config, progress)
    rough, skipped = _usable(folder, rough)
    views = _views(folder, rough, config.poses.sizes[-1])
    maps = read_depths(files, views, config.depth_unit)
    blind = [view.name for view in views if view.name not in maps]
    if blind:
        log.warning(
            "%d images have no depth and keep their rough poses: %s", len(blind), ", ".join(blind[:10])
        )
    scale, origin = scale_of(rough, maps, config.rough.rough_scale)
    log.info("%s; scale %s", rough.origin, origin)
    frame = _frame(views, maps, scale)
    levels, settings = _levels(folder, rough, maps, frame, config.poses)
    views = _views(folder, rough, settings.sizes[-1])
    progress.stage("refinement", sum(settings.iterations))
    done = _refined(levels, views, frame, settings, rough.free_scale, progress)
    found = _found(views, frame, scale, done, levels[-1])
    figures = {
        "images": len(views),
        "without_depth": blind,
        "not_moved": [view.name for view, moved in zip(views, done.moved, strict=True) if not moved],
        "skipped": skipped,
        "rough": rough.origin,
        "scale": scale * done.scale,
        "scale_origin": origin + (f", then times {done.scale:.5g}" if rough.free_scale else ""),
        "focal_factor": done.focal,
        "disagreement": {"before": (done.history or [{}])[0], "after": (done.history or [{}])[-1]},
        "history": done.history,
        "settings": config,
        "versions": report.versions(),
        "seconds": time.monotonic() - start,
    }  # fmt: skip
    progress.stage("writing", 1)
    write(output, found, figures)
    return Trajectory(output, figures)


def _folders(images: Path, config: PosesConfig) -> tuple[Path, Path]:
    """Image folder and output folder, checked."""
    folder = images.expanduser().absolute()
    if not folder.is_dir() or not list_images(folder):
        raise InputError(f"{folder}: no folder with pictures; name the folder that holds the images")
    if config.depths is None:
        raise InputError("--depths is missing: the folder of the depth maps that the poses are found from")
    output = (config.output_path or folder.parent / "poses-tco").expanduser().absolute()
    if output.exists():
        if not (output / OURS).is_file():
            raise InputError(f"{output} is there and no result of this command; name another --output_path")
        if not config.overwrite:
            raise InputError(f"{output} is there already; --overwrite replaces it")
    if folder == output or folder in output.parents:
        raise InputError(f"{output} lies in the folder of the images; name another --output_path")
    return folder, output


def _rough(
    folder: Path, names: Sequence[str], files: Mapping[str, Path], config: PosesConfig, progress: Progress
) -> Rough:
    """Rough poses from the user, or from a network."""
    if config.rough.rough is not None:
        return read_rough(folder, names, config.rough)
    from colmap_tco.pose_network import predicted

    known = (files, config.depth_unit, config.rough)
    return predicted(folder, names, known, config.network, (config.steps, config.seed), progress)


def _usable(folder: Path, rough: Rough) -> tuple[Rough, dict[str, str]]:
    """The images whose files can be read, and why the others cannot."""
    skipped = check_images(folder, rough.images)
    if skipped:
        log.warning("%d images are skipped:\n%s", len(skipped), listing(skipped))
    left = tuple(entry for entry in rough.images if entry.name not in skipped)
    if len(left) < 2:
        raise InputError(
            f"{len(left)} images of {folder} are usable, and poses take two:\n{listing(skipped)}"
        )
    return replace(rough, images=left), skipped


def _views(folder: Path, rough: Rough, size: int) -> list[View]:
    workspace = Workspace(folder, folder, folder, rough.model, rough.images, ())
    views, skipped = make_views(workspace, ViewConfig(max_image_size=size), STRIDE)
    if skipped:
        raise InputError(f"images whose cameras cannot be used:\n{listing(skipped)}")
    return views


def _frame(views: Sequence[View], maps: Mapping[str, Depth], scale: float) -> ChunkFrame:
    """The first view as the world, and the median measured depth as the unit of length."""
    return ChunkFrame(views[0].cam_from_world, _unit(maps) / scale)


def _levels(
    folder: Path, rough: Rough, maps: Mapping[str, Depth], frame: ChunkFrame, config: PoseConfig
) -> tuple[list[Level], PoseConfig]:
    """The views at each size at which the depths are dense enough, and the settings for these."""
    from tco.poses import Level, surfel_share

    unit = _unit(maps)
    levels, kept = [], []
    for i, size in enumerate(config.sizes):
        views = _views(folder, rough, size)
        images, cameras = batch(views, frame)
        level = Level(images, cameras.K, on_canvas(views, maps, canvas_size(views)) / unit)
        share = surfel_share(level)
        if share >= LEAST_SURFELS:
            levels.append(level)
            kept.append(i)
        else:
            log.info("size %d is left out: %.0f %% of the measured pixels have neighbours", size, 100 * share)
    if not levels:
        raise InputError(
            f"the depth maps are too sparse: even at {config.sizes[0]} pixels, few measured pixels have "
            "measured neighbours; give a smaller first size with --sizes"
        )
    sizes, iterations = (tuple(values[i] for i in kept) for values in (config.sizes, config.iterations))
    return levels, replace(config, sizes=sizes, iterations=iterations)


def _unit(maps: Mapping[str, Depth]) -> float:
    """Median measured depth: lengths are divided by it inside."""
    return float(np.median([np.median(depth[depth > 0]) for depth in maps.values()]))


def _refined(
    levels: Sequence[Level], views: Sequence[View], frame: ChunkFrame, config: PoseConfig, free: bool,
    progress: Progress,
) -> Poses:  # fmt: skip
    import torch

    from tco.poses import NothingSharedError, refine

    start = torch.from_numpy(np.stack([frame.world_from_cam(view) for view in views]))
    try:
        return refine(levels, start, config, free, lambda terms: progress.advance(1, **terms))
    except NothingSharedError as error:
        raise InputError(
            f"{error}. If the rough poses have another unit, give --rough_scale; if they are rougher than "
            f"{config.rough_rotation:g}°, no refinement finds them"
        ) from error
    except ValueError as error:
        raise InputError(f"these poses cannot be refined: {error}") from error


def _found(views: Sequence[View], frame: ChunkFrame, scale: float, done: Poses, finest: Level) -> Found:
    """The result in the frame of the rough poses, in the unit of the depths, with the measured surfaces."""
    total = scale * done.scale
    R0, t0 = frame.cam_from_world[:, :3], frame.cam_from_world[:, 3]
    unit = frame.scale * scale
    moved = []
    for view, pose in zip(views, done.cameras.world_from_cam.numpy(), strict=True):
        u, _, vt = np.linalg.svd(R0.T @ pose[:3, :3])
        R = (u @ vt).T
        centre = -total * R0.T @ t0 + unit * R0.T @ pose[:3, 3]
        camera = replace(view.camera, fx=view.camera.fx * done.focal, fy=view.camera.fy * done.focal)
        moved.append(replace(view, camera=camera, cam_from_world=np.column_stack([R, -R @ centre])))
    depth = finest.depth.numpy().astype(np.float64) * unit
    return Found(tuple(views), tuple(moved), depth)
