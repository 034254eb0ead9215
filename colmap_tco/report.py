"""What ``report.json`` says: every image, how good the depths are, and with which versions they were made."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from colmap_tco import _pycolmap
from colmap_tco.resume import Result
from colmap_tco.views import View


def contents(result: Result, used: Sequence[View], left: Mapping[str, Mapping[str, str]]) -> dict[str, Any]:
    """What the report says of images and chunks, and with which versions it was made.

    Args:
        result: with the figures of every finished view and chunk.
        used: the views that the cloud is made of.
        left: state (skipped, failed, unregistered) → name → why an image is in it.
    """
    held, chunks = held_out(result), [dict(chunk) for chunk in result.chunks]
    for chunk in chunks:
        del chunk["loss"]
    return {
        "views": view_table(result, used, left),
        "images": {"used": len(used), **{state: len(reasons) for state, reasons in left.items()}},
        "chunks": chunks,
        "held_out": held,
        "doubt": doubt(held, chunks),
        "loss": [chunk["loss"] for chunk in result.chunks],
        "versions": versions(),
    }


def view_table(
    result: Result, used: Sequence[View], others: Mapping[str, Mapping[str, str]]
) -> dict[str, Any]:
    """Every image: used with its figures, or its other state (skipped, failed, unregistered) and why."""
    table: dict[str, Any] = {v.name: {"state": "used", **result.views[v.name]} for v in used}
    for state, reasons in others.items():
        table.update({name: {"state": state, "why": why} for name, why in reasons.items()})
    return dict(sorted(table.items()))


def held_out(result: Result) -> dict[str, Any]:
    """The user's quality figure: errors at points that neither network nor optimisation saw.

    A result is plausible if its error (at points that were seen, where none was held out) is below half of
    that of one depth for each view, or small enough to be one of a scene that has no relief.
    """
    rows: list[Any] = list(result.views.values())
    held = [r for r in rows if r["points_held_out"]]
    error = float(np.median([r["error_at_held_out"] for r in held] or [r["error_at_points"] for r in rows]))
    flat = float(np.median([r["error_of_one_depth"] for r in rows]))
    count = sum(r["points_held_out"] for r in held)
    share = sum(r["held_out_within_5_percent"] * r["points_held_out"] for r in held) / max(count, 1)
    return {
        "points": count,
        "median_error": error if held else None,
        "within_5_percent": share if held else None,
        "error": error,
        "error_of_one_depth": flat,
        "plausible": error < max(0.5 * flat, SMALL_ERROR),
    }


SMALL_ERROR = 0.02
"""Relative depth error that is good in any scene."""

STRANGE_ROTATION = 10.0
"""Degrees between a network's own cameras and COLMAP's from which on it has not understood the views."""

STRANGE_CENTRES = {"centre": 0.75, "centre_over_depth": 0.05}
"""The same of their centres, in units of their mean distance from the middle and of the depth of the points,
if both are exceeded: what knows nothing of the cameras is off by about 1 of the first, and where they hardly
moved they are off by as much though a network knows them to a hundredth of the depth."""


def doubt(held: Mapping[str, Any], chunks: Sequence[Mapping[str, Any]]) -> str:
    """Why the depths should not be used, or nothing.

    They contradict COLMAP's points. Or they agree with them because they were moved there, and the network
    that they come from, which finds cameras itself, found others. (Depth Anything 3 is told the cameras.)

    Args:
        held: of :func:`held_out`.
        chunks: each with the ``agreement`` of the network's cameras with COLMAP's, if it predicts any.
    """
    if not held["plausible"]:
        return (
            f"the depths contradict COLMAP's points (median error {100 * held['error']:.0f} %, where one "
            f"depth for each view would have {100 * held['error_of_one_depth']:.0f} %): do not use them"
        )
    strange = [chunk["agreement"] for chunk in chunks if chunk["agreement"] and _strange(chunk["agreement"])]
    if not strange:
        return ""
    worst = max(strange, key=lambda one: one["rotation_degrees"])
    turn, shift = f"{worst['rotation_degrees']:.1f}°", f"{100 * worst['centre']:.0f} %"
    where = f" in {len(strange)} of {len(chunks)} groups of views" if len(chunks) > 1 else ""
    return (
        f"the network's own cameras contradict COLMAP's{where} (rotations by {turn}, centres by {shift} of "
        "their spread): between COLMAP's points its depths mean nothing there, do not use them"
    )


def _strange(agreement: Mapping[str, float]) -> bool:
    far = all(agreement[part] > bound for part, bound in STRANGE_CENTRES.items())
    return far or agreement["rotation_degrees"] > STRANGE_ROTATION


def versions() -> dict[str, str]:
    """Versions of everything that can change the result."""
    found = {"python": platform.python_version(), "pycolmap": ".".join(map(str, _pycolmap.version()))}
    for name in ("colmap-tco", "torch", "numpy", "opencv-python-headless", "numba"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def other_versions(before: Mapping[str, str]) -> str:
    """Of what this run has other versions than that of a report; empty: of nothing."""
    now = versions()
    return ", ".join(f"{k} {v}, now {now[k]}" for k, v in before.items() if now.get(k, v) != v)
