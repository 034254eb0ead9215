"""All chunks of a scene, one after the other: what is not finished is predicted, and its maps are written."""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from colmap_tco import outputs
from colmap_tco.attempts import within_memory
from colmap_tco.backbones import Budget, Selected, load
from colmap_tco.chunks import Chunk, ChunkPlan
from colmap_tco.errors import UsageError
from colmap_tco.fill import Existing, fill
from colmap_tco.memory import release
from colmap_tco.pictures import Pictures
from colmap_tco.predict import ChunkResult, predict_chunk
from colmap_tco.priors import PriorConfig
from colmap_tco.progress import Progress
from colmap_tco.resume import Result
from colmap_tco.tracks import Covisibility, Tracks
from colmap_tco.views import View
from tco.options import TCOConfig

if TYPE_CHECKING:
    from tco.backbones.base import Backbone

log = logging.getLogger(__name__)

SHOWN = ("loss", "held_out")
"""Terms of a step that are shown while it runs."""


class Scene(NamedTuple):
    """What all chunks are taken from: the points, the views, and how much these share."""

    tracks: Tracks
    views: Sequence[View]
    pairs: Covisibility


class Means(NamedTuple):
    """What chunks are predicted with: the network, the memory for it, depths to be completed, and threads."""

    chosen: Selected
    budget: Budget
    existing: Existing | None
    num_threads: int = -1


def predict_chunks(
    result: Result, scene: Scene, plan: ChunkPlan, means: Means,
    settings: tuple[PriorConfig, TCOConfig, int], progress: Progress,
) -> dict[str, str]:  # fmt: skip
    """Optimise the chunks that are not finished yet and write the maps of their views.

    Returns:
        Name → why a view could not be predicted.

    Raises:
        UsageError: names of layers to be adapted that the network does not have.
    """
    start = time.monotonic()
    todo = [c for c in plan.chunks if not all(result.is_done(scene.views[i].name) for i in c.owned)]
    progress.stage("optimisation", sum(len(c.owned) for c in todo))
    if not todo:
        return {}
    chosen, budget, existing, threads = means
    backbone, failed = _loaded(chosen._replace(recompute=budget.recompute), settings[1]), {}
    if len(plan.chunks) > 1:
        log.info("%d views in %d overlapping chunks", sum(len(c.owned) for c in todo), len(todo))
    pictures = Pictures(lambda view, image: _write_picture(result, view, image))
    device = chosen.device

    def work(chunk: Chunk) -> ChunkResult:
        pace = Pace(chunk, settings[1], progress)
        return predict_chunk(
            (backbone, device), scene.tracks, scene.views, chunk, settings, pace.step, pictures, threads
        )

    with progress_told(result, len(scene.views)):
        for attempt in within_memory(
            todo, scene.pairs.common, work, budget.views_now, lambda: release(device)
        ):
            owned = [scene.views[i] for i in attempt.chunk.owned]
            if attempt.result is None:
                failed.update({view.name: attempt.why for view in owned})
                continue
            result.mark_done(_write_chunk(result, owned, attempt.result, existing))
            result.mark_chunk(
                {
                    "views": [scene.views[i].name for i in attempt.chunk.views],
                    "owned": len(owned),
                    "reduced": attempt.chunk not in plan.chunks,
                    "agreement": attempt.result.agreement,
                    "seconds": time.monotonic() - start,
                    "loss": outputs.plain(attempt.result.history),
                }
            )
            _collect_between(plan)
            start = time.monotonic()
            progress.reach(sum(result.is_done(scene.views[i].name) for c in todo for i in c.owned))
    return failed


def _collect_between(plan: ChunkPlan) -> None:
    """Free the cycles of garbage that a run else leaves (:func:`colmap_tco.memory.cycles_left`)."""
    if len(plan.chunks) > 1:
        gc.collect()


def _loaded(chosen: Selected, config: TCOConfig) -> Backbone:
    """The network, if it has what the settings are about; the optimisation would find out later, or never."""
    from tco.lora import LoRAConfig, adapted

    backbone = load(chosen)
    if backbone.uses_cameras and config.own_cameras != "published":
        raise UsageError(
            f"--own_cameras {config.own_cameras}: {backbone.name} is given the cameras and finds none of its "
            "own; what holds their corrections are camera_weight and camera_kernel"
        )
    if not config.steps:
        return backbone
    names = LoRAConfig(targets=config.lora_targets, unfrozen=config.ablation.unfrozen)
    try:
        with adapted(backbone.decoder(), names):
            return backbone
    except ValueError as error:
        raise UsageError(f"--lora_targets, --unfrozen: {error}") from error


@contextmanager
def progress_told(result: Result, views: int) -> Iterator[None]:
    """Say at an interruption what is there already, so that nobody begins anew."""
    try:
        yield
    except KeyboardInterrupt:
        count = len(result.views)
        log.warning("%d of %d views are finished; the same command goes on after them", count, views)
        raise


ENCODING, STEP, POLISHING = 1.3, 5.0, 0.2
"""What it takes to encode one view, to take one step on the network, and to look at one view in a step on the
depths, in the seconds that decoding one view takes; of ``sweep`` on ``kitchen``, by a profile of ``densify``.
They decide where the bar stands within a chunk, no more."""


class Pace:
    """Tells the progress, in views, how far the work on a chunk is."""

    def __init__(self, chunk: Chunk, config: TCOConfig, progress: Progress) -> None:
        """Count from where the progress is now."""
        self._progress, self._begin, self._owned = progress, progress.done, len(chunk.owned)
        self._first, self._last = (1 + ENCODING) * len(chunk.views), len(chunk.owned)
        self._steps, self._count = config.steps, 0
        self._polishing = POLISHING * config.polish.polish_sources
        network = self._first + STEP * config.steps + self._last
        self._total = network + self._polishing * config.polish.steps(len(chunk.owned))

    def step(self, terms: Mapping[str, float]) -> None:
        """One step is done, on the network or, after all of these, on the depths."""
        self._count += 1
        work = self._first + STEP * min(self._count, self._steps)
        if self._count > self._steps:
            work += self._last + self._polishing * (self._count - self._steps)
        # What remains of a chunk, the writing of its maps, is hardly anything.
        done = self._begin + self._owned * min(1.0, work / self._total)
        self._progress.reach(done, **{name: terms[name] for name in SHOWN if name in terms})


def _write_picture(result: Result, view: View, image: NDArray[np.uint8]) -> None:
    """Write the undistorted image of a view, unless an earlier run did."""
    if not result.is_done(view.name):
        outputs.write_image(result.paths.image(view.name), image)


def _write_chunk(
    result: Result, owned: Sequence[View], done: ChunkResult, existing: Existing | None
) -> dict[str, Any]:
    """Write the maps of a chunk's own views; returns name → figures of each."""
    figures: dict[str, Any] = {}
    for view in owned:
        r = done.views[view.name]
        maps, filled = fill(existing, view, r.maps) if existing else (r.maps, {})
        own = fill(existing, view, r.own)[0] if existing else r.own
        outputs.write_maps(result.paths, view.name, maps, own)
        camera = r.corrected.camera
        told: Any = outputs.plain({**r.figures, **filled})
        # Rounded like the figures of the report, a camera in map coordinates would be metres off.
        exact = {"cam_from_world": r.corrected.cam_from_world.tolist(), "focal": [camera.fx, camera.fy]}
        figures[view.name] = {**told, **exact}
    return figures
