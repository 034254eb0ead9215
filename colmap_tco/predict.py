"""One chunk of views → depth maps at COLMAP's scale: priors, self-check, optimisation, figures per view."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_tco.chunks import Chunk
from colmap_tco.errors import MissingError
from colmap_tco.normals import normals_from_depth
from colmap_tco.outputs import ViewMaps
from colmap_tco.priors import PriorConfig, build_priors, check_projection, chunk_frame
from colmap_tco.tracks import Tracks
from colmap_tco.views import View, batch, canvas_size, crop
from tco.config import knob
from tco.options import TCOConfig

if TYPE_CHECKING:
    import torch

    from tco.backbones.sweep import Sweep
    from tco.optimize import Outcome
    from tco.types import Cameras, Prediction

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class NetworkConfig:
    """The network, and where it runs."""

    weights: str = knob("", "file of weights (safetensors) to use instead of those in the package")
    device: str = knob(
        "auto", "auto: cuda if there is one, else cpu; or any name that torch knows, such as cuda:1"
    )
    chunk_size: int = knob(
        0, "views that are optimised together; 0: as many as fit half of the free memory, at most 40"
    )


@dataclass(frozen=True)
class ViewResult:
    """One view of a finished chunk.

    Attributes:
        maps: depth, normals and confidence at the size of ``view.network``, in COLMAP units.
        figures: numbers for the report.
        corrected: the view with its corrected camera.
    """

    maps: ViewMaps
    figures: dict[str, object]
    corrected: View


@dataclass(frozen=True)
class ChunkResult:
    """Results of the views that a chunk owns, by name, and the terms of every step."""

    views: dict[str, ViewResult]
    history: list[dict[str, float]]


def choose_device(name: str) -> torch.device:
    """The device that ``--device`` names.

    Raises:
        MissingError: it is not there.
    """
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise MissingError(f"--device {name}: not usable here ({error}); try --device cpu") from error
    return device


def weights_file(config: NetworkConfig) -> Path:
    """The file that ``--weights`` names, or the one in the package."""
    from tco.backbones.weights import EMBEDDED

    return Path(config.weights).expanduser() if config.weights else EMBEDDED


def load_network(config: NetworkConfig) -> tuple[Sweep, torch.device]:
    """The network on its device.

    Raises:
        MissingError: no such device, or weights that are missing or of another network.
    """
    from tco.backbones.weights import WeightsError, load_sweep

    device = choose_device(config.device)
    try:
        return load_sweep(weights_file(config), device), device
    except WeightsError as error:
        raise MissingError(str(error)) from error


def free_memory() -> int:
    """Bytes that can be had without swapping.

    On Linux ``MemAvailable``, which, unlike the free pages, counts what the file cache would give back;
    elsewhere half of what is installed.
    """
    meminfo = Path("/proc/meminfo")
    for line in meminfo.read_text().splitlines() if meminfo.is_file() else ():
        if line.startswith("MemAvailable:"):
            return 1024 * int(line.split()[1])
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2


def chunk_limit(views: Sequence[View], config: NetworkConfig, memory: int) -> int:
    """Views a chunk: what half of the memory holds beside one decoding with gradients, from 2 to 40.

    The bytes a pixel are estimates on the safe side, from the sizes of the arrays, not measurements.
    """
    if config.chunk_size:
        return max(2, config.chunk_size)
    height, width = canvas_size(views)
    pixels = height * width
    room = memory / 2 - pixels * BYTES_STEP
    return int(np.clip(room / (pixels * BYTES_VIEW), 2, 40))


BYTES_VIEW, BYTES_STEP = 300, 6000
"""Memory that stays for each view of a chunk, and that one step needs, in bytes a pixel of the canvas."""


def predict_chunk(
    network: tuple[Sweep, torch.device],
    tracks: Tracks,
    views: Sequence[View],
    chunk: Chunk,
    settings: tuple[PriorConfig, TCOConfig, int],
    report: Callable[[dict[str, float]], None],
) -> ChunkResult:
    """Optimise one chunk and give the results of the views that it owns.

    Args:
        network: backbone and device.
        tracks: of the model.
        views: all views of the workspace; the chunk's indices refer to them.
        chunk: owned and context views.
        settings: of priors and optimisation, and the seed.
        report: called with the terms of each step.

    Raises:
        InputError: the points do not project where the keypoints are, or an image cannot be read.
    """
    from tco.optimize import errors_at_points, optimize

    (backbone, device), (prior_config, tco_config, seed) = network, settings
    members = [views[i] for i in chunk.views]
    frame = chunk_frame(tracks, members)
    images, cameras = batch(members, frame)
    check = check_projection(tracks, members, frame, cameras)
    priors = build_priors(tracks, members, frame, prior_config, seed)
    outcome = optimize(
        backbone,
        images.to(device),
        priors.optimise.to(device),
        tco_config,
        seed,
        lambda _, terms: report(terms),
    )
    prediction, moved = outcome.prediction.to("cpu"), outcome.cameras.to("cpu")
    assert priors.optimise.sparse is not None
    used = errors_at_points(prediction, priors.optimise.sparse)
    held = errors_at_points(prediction, priors.held_out)
    results = {}
    for i in range(len(chunk.owned)):
        view = members[i]
        valid = crop(view, images.valid[i]).numpy()
        figures: dict[str, object] = {
            "points": len(used[i]),
            "points_held_out": len(held[i]),
            "error_at_points": _median(used[i]),
            "error_at_held_out": _median(held[i]),
            "held_out_within_5_percent": float((held[i].abs() < 0.05).float().mean())
            if len(held[i])
            else None,
            "reprojection_error_pixels": check.per_view.get(view.name),
            "correction": _correction(outcome, i, frame.scale),
        }
        corrected = corrected_view(view, frame.scale, cameras, moved, i)
        results[view.name] = ViewResult(_maps(view, prediction, i, valid, frame.scale), figures, corrected)
    return ChunkResult(results, outcome.history)


def _median(errors: torch.Tensor) -> float | None:
    return float(errors.abs().median()) if len(errors) else None


def _correction(outcome: Outcome, i: int, scale: float) -> dict[str, float]:
    """How far the camera of a view went: degrees, COLMAP units, relative focal length."""
    sizes = outcome.corrections
    if not sizes:
        return {"rotation_degrees": 0.0, "centre": 0.0, "focal": 0.0}
    return {**{name: values[i] for name, values in sizes.items()}, "centre": sizes["centre"][i] * scale}


def _maps(view: View, prediction: Prediction, i: int, valid: np.ndarray, scale: float) -> ViewMaps:
    """Depth in COLMAP units, normals and confidence of one view, 0 and 1 where the image is not valid."""
    depth = np.where(valid, crop(view, prediction.depth[i]).numpy() * scale, 0).astype(np.float32)
    confidence = np.where(valid, crop(view, prediction.confidence[i]).numpy(), 1).astype(np.float32)
    return ViewMaps(depth, normals_from_depth(depth, view.network), confidence)


def corrected_view(view: View, scale: float, before: Cameras, after: Cameras, i: int) -> View:
    """The view with its camera corrected as camera ``i`` was, in COLMAP's frame and units.

    Only the difference of the two is applied, to COLMAP's camera in float64: the rounding of a chunk's
    float32 cameras would be metres where the model has the coordinates of a map.

    Args:
        view: with COLMAP's camera.
        scale: COLMAP units per unit of the chunk.
        before: the chunk's cameras as the optimisation was given them.
        after: as it left them.
        i: index of the view in the chunk.
    """
    old, new = (cameras.world_from_cam[i].double().numpy() for cameras in (before, after))
    # The rotation nearest to a product of matrices that are orthogonal to float32 alone.
    u, _, vt = np.linalg.svd(new[:3, :3].T @ old[:3, :3])
    turn = u @ vt
    shift = scale * old[:3, :3].T @ (new[:3, 3] - old[:3, 3])
    R, t = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
    factor = float(after.K[i, 0, 0]) / float(before.K[i, 0, 0])
    camera = replace(view.camera, fx=view.camera.fx * factor, fy=view.camera.fy * factor)
    return replace(view, camera=camera, cam_from_world=np.column_stack([turn @ R, turn @ (t - shift)]))
