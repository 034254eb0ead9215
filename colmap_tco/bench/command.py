"""``colmap-tco bench``: rows of the paper's tables over a dataset, beside the published figures."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from colmap_tco.backbones import NetworkConfig, Selected, load, select, suited
from colmap_tco.bench.rows import MEANING, Row, parse_rows
from colmap_tco.bench.schedules import published as published_schedule
from colmap_tco.errors import InputError, PartlyDoneError
from colmap_tco.progress import Progress
from colmap_tco.published import Network
from tco.config import knob
from tco.options import TCOConfig

if TYPE_CHECKING:
    from colmap_tco.bench.store import Result
    from colmap_tco.datasets import Choice, Dataset
    from tco.backbones.base import Backbone

log = logging.getLogger(__name__)

TAKE_CAMERAS = ("sweep",)
"""Kinds of networks whose cameras are input, for which TCO's settings were not made."""

DATASETS = ("eth3d", "dtu", "7scenes", "nrgbd", "scannet")

WIDTH = 518
"""Of the pictures that networks see in the published evaluations, pixels."""
WIDTHS = {"scannet": 504}
"""Dataset → their width where it is another: 512, cut to whole patches of 14 pixels."""


@dataclass(frozen=True)
class BenchConfig:
    """What is measured on what."""

    dataset: str = knob("", f"the dataset: {', '.join(DATASETS)}. Points are measured, for scannet poses")
    root: Path | None = knob(None, "its folder, in the layout in which it is published, see docs/bench.md")
    setting: str = knob(
        "",
        "which frames: sparse or dense for 7scenes and nrgbd, stride1, stride4 or stride16 for scannet; "
        "empty: the first of these",
    )
    scenes: tuple[str, ...] = knob((), "scenes, such as courtyard or chess/seq-03; empty: all")
    rows: tuple[str, ...] = knob(
        ("tco",), "rows of the table. " + "; ".join(f"{row}: {told}" for row, told in MEANING.items())
    )
    priors: tuple[str, ...] = knob(
        (), "what is given: pose, intrinsics; for scannet, depth. Empty: all that the table allows"
    )
    output: Path = knob(Path("bench"), "folder of the results; finished scenes in it are kept", alias="-o")
    image_width: int = knob(
        0,
        "width of the pictures that the network sees, pixels; 0: as published, 504 for scannet and 518 for "
        "the others, and 320 for sweep",
    )
    published_settings: bool = knob(
        True,
        "steps, rate and weights of TCO's scripts for the dataset where they were left alone, on its "
        "schedule; off: what densify would do, as always for networks that take cameras as input",
    )
    as_published: bool = knob(
        True,
        "7scenes: focal length and poses as in the published evaluations, which its calibration contradicts; "
        "off: as calibrated",
    )
    seed: int = knob(0, "of the noise and of the optimisation")
    overwrite: bool = knob(False, "replace results that were made with other settings")
    network: NetworkConfig = field(default_factory=NetworkConfig)
    tco: TCOConfig = field(default_factory=TCOConfig)


@dataclass(frozen=True)
class Benched:
    """What was measured.

    Attributes:
        table: table.md.
        text: its content.
    """

    table: Path
    text: str

    def summary(self) -> str:
        """The table and where it is."""
        return f"{self.text}\n{self.table}, and scenes.csv and table.csv beside it"


@dataclass(frozen=True)
class _Run:
    """What all rows and scenes of a run have in common."""

    config: BenchConfig
    dataset: Dataset
    setting: str
    choice: Choice
    scenes: tuple[str, ...]
    there: tuple[str, ...]
    """All scenes of the folder, of which ``scenes`` are to be run."""
    chosen: Selected
    folder: Path
    made_with: Mapping[str, str]
    """Version of this package and fingerprint of the weights, which decide results, too."""


def bench(config: BenchConfig, progress: Progress) -> Benched:
    """Run the rows over the scenes; finished ones are kept from before.

    A scene that cannot be reconstructed or compared gets no figures, and the others go on. The tables also
    have the rows and scenes that earlier calls left in the folder, if this one would make them alike.

    Raises:
        InputError: a dataset, setting, scene, row or prior that does not exist or does not go together, a
            folder that is not in its layout, or results of other settings.
        MissingError: no such device, or weights that are missing.
        PartlyDoneError: some scenes have no figures; the tables were written.
    """
    from colmap_tco.bench.figures import COLUMNS
    from colmap_tco.bench.numbers import published
    from colmap_tco.bench.store import write_tables

    run = _open(config)
    rows = parse_rows(config.rows, _priors(config))
    _check_priors(config.dataset, rows)
    results = _results(run, rows, progress)
    columns = COLUMNS[config.dataset]
    known = published(config.dataset, run.setting)
    every = _with_earlier(run, results)
    table = write_tables(run.folder, every, columns, _about(run, every), known)
    failed = [result for row in results.values() for result in row if result.failed]
    if failed:
        told = "; ".join(f"{r.row}, {r.scene}: {r.failed}" for r in failed[:3])
        raise PartlyDoneError(f"{len(failed)} scenes without figures ({told}); the others are in {table}")
    return Benched(table, table.read_text("utf-8"))


def _open(config: BenchConfig) -> _Run:
    from colmap_tco.datasets import choice, open_dataset
    from colmap_tco.report import versions
    from colmap_tco.resume import fingerprint

    if config.dataset not in DATASETS:
        raise InputError(f"--dataset '{config.dataset}': there are {', '.join(DATASETS)}")
    if config.root is None:
        raise InputError(
            f"--root names no folder: it is where {config.dataset} was unpacked, see docs/bench.md"
        )
    setting, frames = choice(config.dataset, config.setting)
    dataset = open_dataset(config.dataset, config.root, config.as_published)
    there = tuple(dataset.scenes())
    lacking = [scene for scene in config.scenes if scene not in there]
    if lacking:
        raise InputError(f"--scenes {lacking[0]}: {config.root} has {', '.join(there)}")
    chosen = select(config.network)
    made_with = {
        "weights": f"{chosen.weights.name}, {fingerprint({}, [chosen.weights])}",
        "version": versions()["colmap-tco"],
    }
    folder = config.output / f"{config.dataset}-{setting}-{chosen.network.name}"
    wanted = config.scenes or there
    return _Run(config, dataset, setting, frames, wanted, there, chosen, folder, made_with)


def _priors(config: BenchConfig) -> tuple[str, ...]:
    """What is given where rows do not say: all that the table allows, if nothing was named."""
    return config.priors or (("depth",) if config.dataset == "scannet" else ("pose", "intrinsics"))


def _check_priors(dataset: str, rows: Sequence[Row]) -> None:
    """What a table measures cannot be given."""
    for row in rows:
        if dataset == "scannet" and ({"pose", "intrinsics"} & set(row.priors) or row.cameras):
            raise InputError(
                f"--rows {row.name}: for scannet poses are measured, so that they cannot be given; rows with "
                "--priors depth can be run"
            )
        if dataset != "scannet" and "depth" in row.priors:
            raise InputError(
                f"--rows {row.name}: the depth of {dataset} is the truth that points are compared with, so "
                "that it cannot be given; use --priors pose,intrinsics"
            )


def _results(run: _Run, rows: Sequence[Row], progress: Progress) -> dict[str, list[Result]]:
    """Row → results of its scenes; a scene is prepared once for all its rows."""
    from colmap_tco.bench.store import write_result

    found = _finished(run, rows)
    todo = {scene: [row for row in rows if scene not in found[row.name]] for scene in run.scenes}
    open_rows = sum(len(left) for left in todo.values())
    kept_rows = len(rows) * len(run.scenes) - open_rows
    if kept_rows:
        log.info("%s: %d results are kept, %d are to be made", run.folder, kept_rows, open_rows)
    progress.stage("rows and scenes", open_rows)
    if open_rows:
        from tco.backbones.pi3 import Pi3

        network = load(run.chosen)
        if isinstance(network, Pi3):
            network.as_published = run.config.published_settings
        _check_rows(network, rows, _tco(run))
        for scene, left in todo.items():
            for result in _scene(run, network, scene, left):
                write_result(run.folder, _settings(run, _named(rows, result.row), scene), result)
                found[result.row][scene] = result
                progress.advance()
    return {name: [by_scene[scene] for scene in run.scenes] for name, by_scene in found.items()}


def _finished(run: _Run, rows: Sequence[Row]) -> dict[str, dict[str, Result]]:
    """Row → scene → what was made before and has figures."""
    from colmap_tco.bench.store import read_result

    found: dict[str, dict[str, Result]] = {row.name: {} for row in rows}
    for scene in run.scenes:
        for row in rows:
            kept = read_result(run.folder, row.name, scene, _settings(run, row, scene), run.config.overwrite)
            if kept is not None and kept.failed:
                log.info("%s, %s: failed before (%s), tried again", row.name, scene, kept.failed)
            elif kept is not None:
                found[row.name][scene] = kept
    return found


def _with_earlier(run: _Run, results: Mapping[str, Sequence[Result]]) -> dict[str, list[Result]]:
    """The results, and those in the folder that were not asked for and have the settings of this run.

    Rows that were asked for come first, the others in the order in which they are listed; scenes are in that
    of the dataset.
    """
    from colmap_tco.bench.store import read_result, stored

    found = {name: {result.scene: result for result in of_row} for name, of_row in results.items()}
    for name, scene in stored(run.folder):
        if scene in found.get(name, {}):
            continue
        try:
            (row,) = parse_rows([name], _priors(run.config))
            earlier = read_result(run.folder, name, scene, _settings(run, row, scene))
        except InputError as error:
            log.info("%s, %s is left out of the tables: %s", name, scene, error)
            continue
        if earlier is not None:
            found.setdefault(name, {})[scene] = earlier
    listed = list(MEANING)
    names = sorted(found, key=lambda name: -1 if name in results else listed.index(_kind(name)))
    return {name: [found[name][scene] for scene in run.there if scene in found[name]] for name in names}


def _check_rows(network: Backbone, rows: Sequence[Row], config: TCOConfig) -> None:
    from colmap_tco.bench.methods import check_row, check_settings

    for row in rows:
        check_row(network, row)
        check_settings(row, config)


def _named(rows: Sequence[Row], name: str) -> Row:
    return next(row for row in rows if row.name == name)


def _scene(run: _Run, network: Backbone, scene: str, rows: Sequence[Row]) -> list[Result]:
    """Results of some rows on one scene."""
    from colmap_tco.bench.prepare import Prepared, resized, triangulated
    from colmap_tco.bench.store import Result

    if not rows:
        return []
    wide = width(run.config, run.chosen.network)
    frames: list[int] = []
    with TemporaryDirectory(prefix="colmap-tco-bench-") as folder:
        try:
            frames = run.choice.frames(run.dataset.count(scene))
            read = run.dataset.read(scene, frames)
            prepared: Prepared = (
                triangulated(read, wide, network.stride, Path(folder), run.config.seed)
                if network.uses_cameras
                else resized(read, wide, network.stride)
            )
        except InputError as error:
            log.warning("%s: %s", scene, error)
            return [Result(row.name, scene, {}, 0.0, len(frames), str(error)) for row in rows]
    return [_row(run, network, scene, prepared, row) for row in rows]


def width(config: BenchConfig, network: Network) -> int:
    """Width in pixels of the pictures that a network sees."""
    own = network.image_size if network.kind in TAKE_CAMERAS else WIDTHS.get(config.dataset, WIDTH)
    return config.image_width or own


def _row(run: _Run, network: Backbone, scene: str, prepared: Any, row: Row) -> Result:
    """One row on one scene."""
    from colmap_tco.bench.figures import UNITS, point_figures, pose_figures
    from colmap_tco.bench.methods import reconstruct
    from colmap_tco.bench.store import Result

    config, views = _tco(run), len(prepared.views)
    start, seconds = time.perf_counter(), 0.0
    try:
        made = reconstruct(network, prepared, row, config, run.chosen.device, run.config.seed)
        seconds = time.perf_counter() - start
        if run.config.dataset == "scannet":
            figures = pose_figures(made.world_from_cam, prepared.world_from_cam)
        else:
            per_metre = UNITS.get(run.config.dataset, 1.0)
            figures = point_figures(made.points, prepared.points, prepared.known, per_metre, made.kept)
    except (InputError, ValueError) as error:
        log.warning("%s, %s: %s", row.name, scene, error)
        return Result(row.name, scene, {}, seconds, views, str(error))
    told = ", ".join(f"{name} {value:.4f}" for name, value in figures.items())
    log.info("%s, %s: %d views, %.1f s: %s", row.name, scene, views, seconds, told)
    return Result(row.name, scene, figures, seconds, views)


def _tco(run: _Run) -> TCOConfig:
    """The settings of the optimisation before rows change them."""
    own = suited(run.config.tco, run.chosen.network)
    if not run.config.published_settings or run.chosen.network.kind in TAKE_CAMERAS:
        return own
    return published_schedule(run.config.dataset, run.config.tco)


def _settings(run: _Run, row: Row, scene: str) -> Mapping[str, Any]:
    """All that decides a result, as JSON can hold it."""
    c = run.config
    assert c.root is not None
    return {
        **run.made_with,
        "dataset": c.dataset,
        "root": str(c.root.resolve()),
        "setting": run.setting,
        "as_published": c.as_published,
        "scene": scene,
        "backbone": run.chosen.network.name,
        "image_width": c.image_width,
        "seed": c.seed,
        "row": row.name,
        "priors": list(row.priors),
        "published_settings": c.published_settings,
        "tco": asdict(row.config(_tco(run))),
    }


def _about(run: _Run, rows: Iterable[str]) -> list[str]:
    """What the table's head says."""
    config, unit = _tco(run), "millimetres" if run.config.dataset == "dtu" else "metres"
    what = "Poses, in metres and degrees" if run.config.dataset == "scannet" else f"Points, in {unit}"
    told = "; ".join(f"{name}: {MEANING[_kind(name)]}" for name in rows)
    return [
        f"# {run.config.dataset}, {run.setting}, {run.chosen.network.name}",
        f"{what}; means over scenes. Weights: {run.chosen.weights.name}. Priors: "
        f"{', '.join(_priors(run.config))}. {config.steps} steps at a rate of {config.rate:g} where a row "
        f"does not say otherwise, seed {run.config.seed}.",
        f"Rows: {told}.",
    ]


def _kind(name: str) -> str:
    """``rank=N`` of ``rank=16``."""
    kind = name.partition("=")[0]
    return next((key for key in MEANING if key.partition("=")[0] == kind), name)
