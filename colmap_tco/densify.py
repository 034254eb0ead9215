"""The product: COLMAP workspace in, dense workspace out.

workspace → views, priors → chunks → tco.optimize(backbone) → Prediction → fusion → outputs
"""

from __future__ import annotations

import dataclasses
import json
import logging
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from colmap_tco import _pycolmap, outputs
from colmap_tco.chunks import ChunkPlan, plan_chunks, source_views
from colmap_tco.errors import InputError, PartlyDoneError
from colmap_tco.fusion import FusionConfig, fuse
from colmap_tco.lock import locked
from colmap_tco.mapping import MappingConfig, ensure_model
from colmap_tco.predict import (
    NetworkConfig,
    chunk_limit,
    free_memory,
    load_network,
    predict_chunk,
    weights_file,
)
from colmap_tco.priors import PriorConfig, with_points
from colmap_tco.progress import Progress
from colmap_tco.resume import Result, fingerprint, open_result
from colmap_tco.tracks import Covisibility, Tracks, covisibility, read_tracks
from colmap_tco.views import View, ViewConfig, make_views
from colmap_tco.workspace import Workspace, WorkspaceConfig, existing_root, open_workspace
from tco.config import knob
from tco.options import TCOConfig

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DensifyConfig:
    """Everything that ``colmap-tco densify`` can be told."""

    seed: int = knob(0, "seed of all randomness; the same seed, inputs and machine give the same result")
    overwrite: bool = knob(False, "replace an earlier result that was made with other settings")
    refine_cameras: bool = knob(
        False, "write the cameras as corrected by the optimisation instead of COLMAP's own"
    )
    network: NetworkConfig = field(default_factory=NetworkConfig)
    tco: TCOConfig = field(default_factory=TCOConfig)
    views: ViewConfig = field(default_factory=ViewConfig)
    priors: PriorConfig = field(default_factory=PriorConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    workspace: WorkspaceConfig = field(default_factory=WorkspaceConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)

    @property
    def num_threads(self) -> int:
        """Threads of all stages; not positive: one a core."""
        return self.fusion.num_threads


@dataclass(frozen=True)
class Densified:
    """Where the result is, and its report."""

    folder: Path
    report: Mapping[str, Any]
    fresh: bool

    def summary(self) -> str:
        """What the user wants to know at the end."""
        r, held = self.report, self.report["held_out"]
        state = "made" if self.fresh else "already made with these settings"
        quality = "no point was held out"
        if held["points"]:
            quality = (
                f"{100 * held['within_5_percent']:.1f} % of {held['points']} held-out points within 5 % "
                f"(median error {100 * held['median_error']:.2f} %)"
            )
        return (
            f"{self.folder / 'fused.ply'}: {r['points']} points from {r['images']['used']} views, {state}\n"
            f"{quality}; {sum(r['seconds'].values()):.0f} s; details in {self.folder / 'report.json'}"
        )


def densify(root: Path, config: DensifyConfig, progress: Progress) -> Densified:
    """Make depth maps, normal maps and a fused cloud of a workspace, in ``<root>/dense-tco/``.

    Nothing that the user had is changed; an interrupted run is continued by the next.

    Raises:
        InputError: images, model or masks that cannot be used, a result with other settings is there, or
            another run is working on the workspace.
        MissingError: no such device or weights.
        PartlyDoneError: everything was written, but some views had to be left out; also where an earlier
            run with these settings did so.
    """
    root = existing_root(root)
    with locked(root):
        done = _densify(root, config, progress)
    left = done.report["images"]["skipped"]
    if left:
        raise PartlyDoneError(f"{done.summary()}\n{left} images were left out; report.json says why of each")
    return done


def _densify(root: Path, config: DensifyConfig, progress: Progress) -> Densified:
    """The whole way, with the workspace locked."""
    clock = _Clock()
    progress.plan(STAGES)
    with clock("workspace"):
        progress.stage("workspace", 1)
        backbone, device = load_network(config.network)
        workspace = _open_or_map(root, config)
        views, skipped = make_views(workspace, config.views, backbone.stride)
        tracks = read_tracks(workspace.model)
        views, blind = with_points(tracks, views, config.priors, config.seed)
        pairs = covisibility(tracks, [view.image_id for view in views])
        plan = plan_chunks(pairs.common, chunk_limit(views, config.network, free_memory()))
        key, maps = _fingerprints(workspace, views, config)
        result = open_result(root, key, config.overwrite, maps)
    if result.finished:
        return Densified(result.paths.root, json.loads(result.paths.report.read_text("utf-8")), fresh=False)
    alone = {views[i].name: why for i, why in plan.skipped.items()}
    skipped = {**workspace.skipped, **skipped, **blind, **alone}
    with clock("optimisation"), _threads(config.num_threads):
        _predict(result, tracks, views, plan, config, (backbone, device), progress)
    used = _used(result, views, config.refine_cameras)
    if not used:
        raise InputError(f"no view could be used: {outputs.plain(skipped)}")
    with clock("fusion"):
        report = _fuse_and_write(result, workspace, used, pairs, views, config, progress)
    report |= {
        "views": _view_table(result, used, skipped, workspace.unregistered),
        "images": {"used": len(used), "skipped": len(skipped), "unregistered": len(workspace.unregistered)},
        "held_out": _held_out(result),
        "loss": [chunk["loss"] for chunk in result.chunks],
        "workspace": {"model": workspace.model_path, "reasons": workspace.reasons},
        "settings": config,
        "versions": _versions(),
        "device": str(device),
        "seconds": clock.seconds,
    }
    outputs.write_report(result.paths.report, report)
    folder = result.publish().root
    return Densified(folder, json.loads((folder / "report.json").read_text("utf-8")), fresh=True)


STAGES = {"workspace": 2.0, "optimisation": 80.0, "fusion": 18.0}
"""Stages of a run and about how much of its time each takes."""


class _Clock:
    """Seconds spent in each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.monotonic()
        yield
        self.seconds[name] = time.monotonic() - start


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Limit torch to a number of threads; a number that is not positive changes nothing."""
    import torch

    before = torch.get_num_threads()
    if count > 0:
        torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _open_or_map(root: Path, config: DensifyConfig) -> Workspace:
    """The workspace; where it has no model, one is made of its images first."""
    if not config.workspace.model_path:
        ensure_model(root, config.workspace.image_path, config.mapping, config.num_threads, config.seed)
    return open_workspace(root, config.workspace, config.num_threads)


def _fingerprints(workspace: Workspace, views: Sequence[View], config: DensifyConfig) -> tuple[str, str]:
    """Two texts: one changes with everything that decides the result, one with what decides the maps."""
    kept = dataclasses.replace(
        config, overwrite=False, fusion=dataclasses.replace(config.fusion, num_threads=-1)
    )
    mapped = dataclasses.replace(kept, refine_cameras=False, fusion=FusionConfig())
    masks = [view.mask_path for view in views if view.mask_path is not None]
    model = [path for path in workspace.model_path.iterdir() if path.suffix in (".bin", ".txt")]
    contents = [*model, *masks, weights_file(config.network)]
    pictures = [view.path for view in views]

    def key(settings: DensifyConfig) -> str:
        told = {"settings": outputs.plain(settings), "versions": _versions()}
        return fingerprint(told, contents, pictures)

    return key(kept), key(mapped)


def _predict(
    result: Result, tracks: Tracks, views: Sequence[View], plan: ChunkPlan, config: DensifyConfig,
    network: Any, progress: Progress,
) -> None:  # fmt: skip
    """Optimise the chunks that are not finished yet and write the maps of their views."""
    todo = [c for c in plan.chunks if not all(result.is_done(views[i].name) for i in c.owned)]
    progress.stage("optimisation", sum(config.tco.steps + len(c.owned) for c in todo))
    for chunk in todo:
        settings = (config.priors, config.tco, config.seed)
        done = predict_chunk(
            network, tracks, views, chunk, settings, lambda terms: progress.advance(1, loss=terms["loss"])
        )
        for view in (views[i] for i in chunk.owned):
            r = done.views[view.name]
            outputs.write_view(result.paths, view, r.maps)
            camera = r.corrected.camera
            # Rounded like the figures of the report, a camera in map coordinates would be metres off.
            exact = {
                "cam_from_world": r.corrected.cam_from_world.tolist(),
                "focal": [camera.fx, camera.fy],
            }
            figures: Any = outputs.plain(r.figures)
            result.mark_done(view.name, {**figures, **exact})
            progress.advance(1)
        names = [views[i].name for i in chunk.owned]
        loss: Any = outputs.plain(done.history)
        result.mark_chunk({"views": names, "loss": loss})


def _used(result: Result, views: Sequence[View], refine: bool) -> list[View]:
    """The finished views, with COLMAP's cameras or with the corrected ones."""
    used = [view for view in views if result.is_done(view.name)]
    if not refine:
        return used
    moved = []
    for view in used:
        figures: Any = result.views[view.name]
        fx, fy = figures["focal"]
        camera = dataclasses.replace(view.camera, fx=fx, fy=fy)
        moved.append(
            dataclasses.replace(view, camera=camera, cam_from_world=np.array(figures["cam_from_world"]))
        )
    return moved


def _fuse_and_write(
    result: Result, workspace: Workspace, used: Sequence[View], pairs: Covisibility, views: Sequence[View],
    config: DensifyConfig, progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    """Model, lists and cloud; returns their figures for the report."""
    progress.stage("fusion", 1)
    names = [view.name for view in views]
    sources = source_views(pairs, config.fusion.check_num_images)
    neighbours = {names[i]: [names[j] for j in sources[i]] for i in range(len(names))}
    originals = {view.name: view for view in views}
    model = outputs.undistorted_model(workspace.model, used, originals)
    indices = outputs.write_model(result.paths, model)
    outputs.write_lists(result.paths, {view.name: neighbours[view.name] for view in used})
    cloud, report = fuse(outputs.fusion_views(result.paths, used, neighbours, indices), config.fusion)
    outputs.write_cloud(result.paths, cloud)
    progress.advance(1)
    return {"points": len(cloud), "fusion": report.as_dict()}


def _view_table(
    result: Result, used: Sequence[View], skipped: Mapping[str, str], unregistered: Mapping[str, str]
) -> dict[str, Any]:
    """Every image: used with its figures, or why not."""
    table: dict[str, Any] = {v.name: {"state": "used", **result.views[v.name]} for v in used}
    table.update({name: {"state": "skipped", "why": why} for name, why in skipped.items()})
    table.update({name: {"state": "unregistered", "why": why} for name, why in unregistered.items()})
    return dict(sorted(table.items()))


def _held_out(result: Result) -> dict[str, Any]:
    """The user's quality figure: errors at points that neither network nor optimisation saw."""
    rows: list[Any] = [v for v in result.views.values() if v["points_held_out"]]
    count = sum(r["points_held_out"] for r in rows)
    if not count:
        return {"points": 0, "median_error": None, "within_5_percent": None}
    share = sum(r["held_out_within_5_percent"] * r["points_held_out"] for r in rows) / count
    return {
        "points": count,
        "median_error": float(np.median([r["error_at_held_out"] for r in rows])),
        "within_5_percent": share,
    }


def _versions() -> dict[str, str]:
    """Versions of everything that can change the result."""
    found = {"python": platform.python_version(), "pycolmap": ".".join(map(str, _pycolmap.version()))}
    for name in ("colmap-tco", "torch", "numpy", "opencv-python-headless", "numba"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found
