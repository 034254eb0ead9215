"""What is said of a result whose depths cannot be right, though they pass through COLMAP's points."""

from __future__ import annotations

from typing import Any

import pytest

from colmap_tco.report import STRANGE, doubt

GOOD = {"plausible": True, "error": 0.01, "error_of_one_depth": 0.3}
BAD = {"plausible": False, "error": 0.25, "error_of_one_depth": 0.3}


def chunk(rotation: float, centre: float) -> dict[str, Any]:
    return {"agreement": {"rotation_degrees": rotation, "centre": centre}}


def test_nothing_is_said_of_what_is_good() -> None:
    assert doubt(GOOD, [{"agreement": {}}]) == "", "a network that takes the cameras has none of its own"
    assert doubt(GOOD, [chunk(2.0, 0.1), chunk(9.0, 0.7)]) == ""


def test_depths_that_contradict_the_points() -> None:
    told = doubt(BAD, [chunk(2.0, 0.1)])
    assert (
        "contradict COLMAP's points (median error 25 %, where one depth for each view would have 30 %)"
        in told
    )


@pytest.mark.parametrize("strange", [(STRANGE["rotation_degrees"] + 1, 0.1), (1.0, STRANGE["centre"] + 0.01)])
def test_a_network_that_found_other_cameras(strange: tuple[float, float]) -> None:
    """The worst group of views is named."""
    told = doubt(GOOD, [chunk(1.0, 0.05), chunk(*strange)])
    assert f"rotations by {strange[0]:.1f}°, centres by {100 * strange[1]:.0f} %" in told
    assert told.endswith("do not use them")
