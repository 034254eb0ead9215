"""The rows of the paper's tables: what each changes, as ``--rows`` spells them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from colmap_tco.bench.noise import Noise
from colmap_tco.errors import InputError
from tco.options import PolishConfig, TCOConfig

PRIORS = ("pose", "intrinsics", "depth")

MEANING = {
    "base": "the network alone: no priors, no steps",
    "raw-depth": "the network's depths, unprojected with the prior cameras, its baselines' mean length kept",
    "tco": "optimised with the priors of --priors",
    "pose": "optimised with the poses alone",
    "intrinsics": "optimised with the intrinsics alone",
    "depth": "optimised with the depths alone",
    "adapt-only": "as tco, without refining depths after the steps on the network",
    "no-compatibility": "as adapt-only, without comparing views: the priors' penalties alone",
    "rank=N": "as tco, with adapters of this rank; the paper has 1, 4 and 16",
    "radius=X": "as tco, with surfels of this radius, in steps between points; the paper tries 0.05 to 5",
    "heads": "as tco, with the network's heads trained in full beside the adapters",
    "surfels": "from raw-depth, the surfels' depths, radii and turns optimised in place of the network",
    "steps=N": "as tco, with so many steps; the paper's curve has 0 to 80",
    "noise=R/T/F": "as tco, priors wrong by R degrees, a share T of the centres' spread, F of focal lengths",
}
"""Row → what it is. N, X, R, T and F are numbers."""


@dataclass(frozen=True)
class Row:
    """One row.

    Attributes:
        name: as it was asked for.
        priors: what is given.
        cameras: whether the prior cameras take the place of the network's own.
        surfels: whether the surfels are optimised in place of the network.
        heads: whether the heads are trained, too.
        changes: settings of :class:`tco.options.TCOConfig` that differ from those of the run.
        ablation: settings of :class:`tco.options.AblationConfig` that do.
        noise: of the prior cameras.
    """

    name: str
    priors: tuple[str, ...]
    cameras: bool = False
    surfels: bool = False
    heads: bool = False
    changes: tuple[tuple[str, Any], ...] = ()
    ablation: tuple[tuple[str, Any], ...] = ()
    noise: Noise = Noise()

    def config(self, plain: TCOConfig) -> TCOConfig:
        """The settings of the run with what this row changes."""
        ablation = replace(plain.ablation, **dict(self.ablation))
        return replace(plain, ablation=ablation, **dict(self.changes))


_FORWARD = (("steps", 0),)
_ADAPT = (("polish", PolishConfig(polish_looks=0)),)
_SILENT = (("photometric_weight", 0.0), ("geometric_weight", 0.0), *_ADAPT)
_SURFELS = (("free_depth", True), ("free_surfels", True))


def parse_rows(names: Sequence[str], priors: Sequence[str]) -> tuple[Row, ...]:
    """The rows that a command line names.

    Args:
        names: such as ``tco`` or ``rank=16``.
        priors: those of rows that do not say otherwise.

    Raises:
        InputError: a row or prior that does not exist, a number that is none, a row twice, or no row.
    """
    wrong = [prior for prior in priors if prior not in PRIORS]
    if wrong:
        raise InputError(f"--priors {wrong[0]}: there are {', '.join(PRIORS)}")
    if not names or len(set(names)) < len(names):
        raise InputError("--rows names no row, or one of them twice")
    return tuple(_parse(name, tuple(p for p in PRIORS if p in priors)) for name in names)


def _parse(name: str, priors: tuple[str, ...]) -> Row:
    kind, _, value = name.partition("=")
    plain = Row(name, priors)
    fixed = {
        "base": Row(name, (), changes=_FORWARD),
        "raw-depth": replace(plain, cameras=True, changes=_FORWARD),
        "tco": plain,
        "adapt-only": replace(plain, changes=_ADAPT),
        "no-compatibility": replace(plain, changes=_SILENT),
        "heads": replace(plain, heads=True),
        "surfels": replace(
            plain, cameras=True, surfels=True, ablation=_SURFELS, changes=(("lora_targets", ()),)
        ),
        **{prior: Row(name, (prior,)) for prior in PRIORS},
    }
    if kind in fixed and not value:
        return fixed[kind]
    numbers = _numbers(name, value, 3 if kind == "noise" else 1)
    if kind == "rank" and numbers[0] == int(numbers[0]) >= 1:
        return replace(plain, changes=(("lora_rank", int(numbers[0])),))
    if kind == "steps" and numbers[0] == int(numbers[0]):  # so many, whatever the cameras
        return replace(plain, changes=(("steps", int(numbers[0])), ("uncertain_steps", 0)))
    if kind == "radius" and numbers[0] > 0:
        return replace(plain, ablation=(("radius_factor", numbers[0]),))
    if kind == "noise":
        return replace(plain, noise=Noise(*numbers))
    raise _unknown(name)


def _numbers(name: str, value: str, count: int) -> tuple[float, ...]:
    try:
        numbers = tuple(map(float, value.split("/")))
    except ValueError:
        raise _unknown(name) from None
    if len(numbers) != count or not all(0 <= n < float("inf") for n in numbers):
        raise _unknown(name)
    return numbers


def _unknown(name: str) -> InputError:
    return InputError(f"--rows {name}: there are {', '.join(MEANING)}, with numbers for the capitals")
