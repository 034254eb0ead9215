"""The product: COLMAP workspace in, dense workspace out.

workspace → views, priors → chunks → tco.optimize(backbone) → Prediction → consensus, fusion → outputs
"""

from __future__ import annotations

import dataclasses
import json
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from colmap_tco import outputs, report
from colmap_tco.backbones import Budget, NetworkConfig, select, suited
from colmap_tco.chunks import plan_chunks, source_views
from colmap_tco.chunkwise import Means, Scene, predict_chunks
from colmap_tco.errors import InputError, OutOfMemoryError, PartlyDoneError
from colmap_tco.fill import Existing, FillConfig, open_existing
from colmap_tco.flags import given_flags
from colmap_tco.fusion import EmptyCloudError, FusionConfig, fuse
from colmap_tco.lock import locked
from colmap_tco.mapping import MappingConfig, ensure_model
from colmap_tco.memory import cycles_left
from colmap_tco.origin import origin_of
from colmap_tco.page.write import write_page
from colmap_tco.pose_covariance import with_deviations
from colmap_tco.priors import PriorConfig, with_points
from colmap_tco.progress import Progress
from colmap_tco.resume import Result, open_result
from colmap_tco.tracks import Covisibility, Tracks, covisibility, read_tracks
from colmap_tco.views import View, ViewConfig, make_views
from colmap_tco.workspace import Workspace, WorkspaceConfig, existing_root, find_models, open_workspace
from tco.config import check_range, knob
from tco.options import TCOConfig

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DensifyConfig:
    """The run as a whole.

    What is in ``given`` stands where the network has settings of its own in place of the defaults.
    """

    seed: int = knob(0, "seed of all randomness; the same seed, inputs and machine give the same result")
    overwrite: bool = knob(False, "replace an earlier result that was made with other settings")
    refine_cameras: bool = knob(
        False, "write the cameras as corrected by the optimisation instead of COLMAP's own"
    )
    report_page: bool = knob(
        True, "write report.html too, the result as one page for the browser (a few megabytes)"
    )
    network: NetworkConfig = field(default_factory=NetworkConfig)
    tco: TCOConfig = field(default_factory=TCOConfig)
    views: ViewConfig = field(default_factory=ViewConfig)
    priors: PriorConfig = field(default_factory=PriorConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    fill: FillConfig = field(default_factory=FillConfig)
    workspace: WorkspaceConfig = field(default_factory=WorkspaceConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    given: tuple[str, ...] = given_flags()

    def __post_init__(self) -> None:
        check_range(self, "seed", 0, 2**31 - 1)  # what COLMAP takes

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

    def doubts(self) -> list[str]:
        """What keeps the result from being complete and good, a sentence each."""
        images, told = self.report["images"], []
        left = images["skipped"] + images["failed"]
        if left:
            told.append(f"{left} images were left out; report.json says why of each")
        return [*told, *(self.report[name] for name in ("doubt", "no_points") if self.report[name])]

    def summary(self) -> str:
        """What the user wants to know at the end."""
        r, held = self.report, self.report["held_out"]
        state = "made" if self.fresh else "already made with these settings"
        quality = "no point was held out"
        if held["points"]:
            quality = (
                f"{100 * held['within_5_percent']:.1f} % of {held['points']} depths at held-out points "
                f"within 5 % (median error {100 * held['median_error']:.2f} %)"
            )
        smaller = sum(chunk["reduced"] for chunk in r["chunks"])
        memory = f"the memory was too little for the planned groups of views: {smaller} smaller ones\n"
        return (
            f"{self.folder / 'fused.ply'}: {r['points']} points from {r['images']['used']} views, {state}\n"
            f"{memory if smaller else ''}"
            f"{quality}; {sum(r['seconds'].values()):.0f} s; details in {self.folder / 'report.json'}"
        )


def densify(
    root: Path, config: DensifyConfig = DensifyConfig(), progress: Progress | None = None
) -> Densified:
    """Make depth maps, normal maps and a fused cloud of a workspace, in ``<root>/dense-tco/``.

    Nothing that the user had is changed; an interrupted run is continued by the next. Without a ``progress``,
    that is logged.

    Raises:
        InputError: images, model or masks that cannot be used, a result or finished views with other
            settings are there, or another run is working on the workspace.
        UsageError: the network lacks layers that the settings name.
        OutOfMemoryError: not even two views fit.
        MissingError: no such device or weights.
        PartlyDoneError: everything was written, but some views had to be left out, or the depths contradict
            the points of the model, or the network's cameras COLMAP's; also where an earlier run with these
            settings found so.
    """
    root = existing_root(root)
    progress = progress or Progress()
    with locked(root), cycles_left():
        bare = _begin(root, config, progress)  # before torch is imported, which takes seconds
        with limited_threads(config.num_threads):
            done = _densify(root, config, bare, progress)
    doubts = done.doubts()
    if doubts:
        raise PartlyDoneError("\n".join([done.summary(), *doubts]))
    return done


def _begin(root: Path, config: DensifyConfig, progress: Progress) -> bool:
    """Plan the stages and begin the first; returns whether a model has to be made."""
    bare = not config.workspace.model_path and not find_models(root)
    progress.plan({**(MAPPING_STAGES if bare else {}), **STAGES})
    progress.stage("pictures" if bare else "workspace", 1)
    return bare


def _densify(root: Path, config: DensifyConfig, bare: bool, progress: Progress) -> Densified:
    """The whole way, with the workspace locked."""
    clock = _Clock()
    with clock("workspace"):
        chosen = select(config.network)
        config = dataclasses.replace(config, tco=suited(config.tco, chosen.network, config.given))
    if bare:
        with clock("mapping"):
            _map(root, config, progress)
        progress.stage("workspace", 1)
    with clock("workspace"):
        workspace = open_workspace(root, config.workspace, config.num_threads)
        views, skipped = make_views(workspace, config.views, chosen.network.stride, chosen.network.image_size)
        _tell_size(views, config.views)
        tracks = read_tracks(workspace.model, logging.INFO)
        if config.priors.pose_covariance:
            tracks = with_deviations(tracks, workspace.model)
        views, blind = with_points(tracks, views, config.priors, config.seed)
        pairs = covisibility(tracks, [view.image_id for view in views])
        budget = Budget.of(chosen, views, config.network, config.tco.steps)
        existing = _existing(config, views)
        origin = origin_of(workspace, views, config, chosen, existing)
        result = open_result(root, origin, config.overwrite)
    if result.finished:
        return _finished(result)
    if bare:
        result.mark_mapping(clock.seconds["mapping"])
    plan = plan_chunks(pairs.common, result.chunk_size(budget.views()))
    alone = {views[i].name: why for i, why in plan.skipped.items()}
    skipped = {**workspace.skipped, **skipped, **blind, **alone}
    with clock("optimisation"):
        means = Means(chosen, budget, existing, config.num_threads)
        settings = (config.priors, config.tco, config.seed)
        failed = predict_chunks(result, Scene(tracks, views, pairs), plan, means, settings, progress)
    used = _used(result, views, config.refine_cameras)
    if not used:
        _nothing_used(skipped, failed)
    with clock("fusion"):
        figures = _fuse_and_write(result, workspace, used, (pairs, tracks), views, config, progress)
    left = {"skipped": skipped, "failed": failed, "unregistered": workspace.unregistered}
    figures |= report.contents(result, used, left) | {
        "backbone": chosen.describe(),
        "workspace": {"model": workspace.model_path, "reasons": workspace.reasons},
        "settings": config,
        "device": str(chosen.device),
        "seconds": result.seconds(clock.seconds),
    }
    progress.stage("report", 1)
    outputs.write_report(result.paths.report, figures)
    if config.report_page:
        write_page(result.paths, json.loads(result.paths.report.read_text("utf-8")))
    folder = result.publish().root
    return Densified(folder, json.loads((folder / "report.json").read_text("utf-8")), fresh=True)


def _tell_size(views: Sequence[View], config: ViewConfig) -> None:
    """Say how large the maps get, and how to change that."""
    largest = max(views, key=lambda view: view.network.width * view.network.height)
    small, full = largest.network, largest.camera
    log.info(
        "depth maps of %d×%d pixels, from pictures of %d×%d (--max_image_size: more, for time and memory "
        "with its square)", small.width, small.height, full.width, full.height,
    )  # fmt: skip
    if config.max_image_size > max(full.width, full.height):
        log.warning("--max_image_size %d is more than the pictures have", config.max_image_size)


def _finished(result: Result) -> Densified:
    """What an earlier run has made."""
    told = json.loads(result.paths.report.read_text("utf-8"))
    others = report.other_versions(told["versions"])
    if others:
        log.info("it was made with other versions (%s); --overwrite makes it anew", others)
    return Densified(result.paths.root, told, fresh=False)


STAGES = {"workspace": 3.0, "optimisation": 82.0, "fusion": 11.0, "report": 4.0}
"""Stages of a run and about how much of its time each takes."""

MAPPING_STAGES = {"pictures": 2.0, "features": 15.0, "matching": 30.0, "mapping": 30.0}
"""Stages before those where there is no model, in the same unit."""


class _Clock:
    """Seconds spent in each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.monotonic()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - start


@contextmanager
def limited_threads(count: int) -> Iterator[None]:
    """Limit torch and OpenCV to a number of threads; one that is not positive changes nothing."""
    import cv2
    import torch

    before = torch.get_num_threads(), cv2.getNumThreads()
    if count > 0:
        torch.set_num_threads(count)
        cv2.setNumThreads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


def _map(root: Path, config: DensifyConfig, progress: Progress) -> None:
    """Make a model of the images of a workspace that has none."""
    images = config.workspace.image_path
    ensure_model(root, images, config.mapping, config.num_threads, config.seed, progress)


def _existing(config: DensifyConfig, views: Sequence[View]) -> Existing | None:
    """The PatchMatch result to complete, if any."""
    if config.fill.fill_only and config.refine_cameras:
        raise InputError(
            "--fill_only keeps depths of COLMAP's cameras, --refine_cameras moves these: give one of the two"
        )
    return open_existing(config.fill, views)


def _asked(result: Result, views: Sequence[View]) -> bool:
    """Whether there is a view of which the others were asked."""
    told: list[Any] = [result.views[view.name] for view in views]
    return any((figures.get("asked_by_consensus") or 0) > 0 for figures in told)


def _nothing_used(skipped: Mapping[str, str], failed: Mapping[str, str]) -> NoReturn:
    """Say why there is no result at all."""
    if failed:
        raise OutOfMemoryError(
            f"not even two views fit the memory: {next(iter(failed.values()))}; smaller images "
            "(--max_image_size) or a smaller network (--backbone sweep) need less"
        )
    raise InputError(f"no view could be used: {outputs.plain(skipped)}")


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
    result: Result, workspace: Workspace, used: Sequence[View], seen: tuple[Covisibility, Tracks],
    views: Sequence[View], config: DensifyConfig, progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    """Model, lists and cloud; returns their figures for the report."""
    pairs, tracks = seen
    filling = config.fusion.max_agreed_error > 0 and _asked(result, used)
    progress.stage("fusion", len(used) * (2 if filling else 1))
    names = [view.name for view in views]
    sources = source_views(pairs, config.fusion.check_num_images)
    neighbours = {names[i]: [names[j] for j in sources[i]] for i in range(len(names))}
    originals = {view.name: view for view in views}
    model = outputs.undistorted_model(workspace.model, used, originals)
    indices = outputs.write_model(result.paths, model)
    outputs.write_lists(result.paths, {view.name: neighbours[view.name] for view in used})
    why = None
    try:
        reach = outputs.reaches(tracks, used)
        own, agreed = (
            outputs.fusion_views(result.paths, used, neighbours, indices, reach, together, config.fill.sure)
            for together in (False, True)
        )
        cloud, fused = fuse(own, config.fusion, progress.advance, agreed if filling else ())
    except EmptyCloudError as error:  # the depth maps are there all the same
        cloud, fused, why = error.cloud, error.report, str(error)
    outputs.write_cloud(result.paths, cloud)
    return {"points": len(cloud), "no_points": why, "fusion": fused.as_dict()}
