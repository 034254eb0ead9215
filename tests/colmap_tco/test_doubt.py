"""What is said of a result whose depths cannot be right, though they pass through COLMAP's points."""

from __future__ import annotations

from typing import Any

import pytest

from colmap_tco.report import STRANGE_ROTATION, doubt

GOOD = {"plausible": True, "error": 0.01, "error_of_one_depth": 0.3}
BAD = {"plausible": False, "error": 0.25, "error_of_one_depth": 0.3}


def chunk(rotation: float, centre: float, over_depth: float = 0.2) -> dict[str, Any]:
    found = {"rotation_degrees": rotation, "centre": centre, "centre_over_depth": over_depth}
    return {"agreement": found}


def test_nothing_is_said_of_what_is_good() -> None:
    assert doubt(GOOD, [{"agreement": {}}]) == "", "a network that takes the cameras has none of its own"
    assert doubt(GOOD, [chunk(2.0, 0.1), chunk(9.0, 0.7)]) == ""


def test_cameras_that_hardly_moved_may_be_off_by_their_own_spread() -> None:
    assert doubt(GOOD, [chunk(1.0, 1.2, 0.01)]) == ""
    assert doubt(GOOD, [chunk(1.0, 1.2, 0.1)]) != ""


def test_depths_that_contradict_the_points() -> None:
    told = doubt(BAD, [chunk(2.0, 0.1)])
    assert (
        "contradict COLMAP's points (median error 25 %, where one depth for each view would have 30 %)"
        in told
    )


@pytest.mark.parametrize("strange", [(STRANGE_ROTATION + 1, 0.1), (1.0, 0.9)])
def test_a_network_that_found_other_cameras(strange: tuple[float, float]) -> None:
    told = doubt(GOOD, [chunk(1.0, 0.05), chunk(*strange)])
    assert "in 1 of 2 groups of views" in told
    assert f"rotations by {strange[0]:.1f}°, centres by {100 * strange[1]:.0f} %" in told
    assert told.endswith("do not use them")
    assert "groups" not in doubt(GOOD, [chunk(*strange)])
