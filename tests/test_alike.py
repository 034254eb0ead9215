"""How alike two results are: medians and shares of relative differences, on maps as they are written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.alike import depths, difference
from colmap_tco.maps import write_map


def test_differences_are_relative_and_of_pixels_that_both_have() -> None:
    first = np.array([1.0, 2.0, 4.0, 0.0, 5.0], np.float32)
    other = np.array([1.01, 2.0, 4.4, 3.0, 0.0], np.float32)
    median, apart = difference(first, other)
    assert median == pytest.approx(0.01, rel=1e-5) and apart == pytest.approx(1 / 3)
    assert difference(first, first) == (0, 0)


def test_scale_of_both_does_not_matter() -> None:
    rng = np.random.default_rng(0)
    first, off = rng.uniform(1, 9, 500), rng.normal(0, 0.02, 500)
    a, b = first.astype(np.float32), (first * (1 + off)).astype(np.float32)
    assert difference(8 * a, 8 * b) == difference(a, b)
    assert difference(a, b)[1] == pytest.approx((np.abs(off) > 0.02).mean(), abs=0.005)


def test_results_that_cannot_be_compared_are_named() -> None:
    with pytest.raises(ValueError, match="2 and 3 pixels"):
        difference(np.ones(2, np.float32), np.ones(3, np.float32))
    with pytest.raises(ValueError, match="no pixel"):
        difference(np.zeros(2, np.float32), np.ones(2, np.float32))


def test_maps_are_read_by_name_and_those_before_optimisation_are_not(tmp_path: Path) -> None:
    folder = tmp_path / "stereo" / "depth_maps"
    folder.mkdir(parents=True)
    for name, value in (("b.jpg.geometric", 2), ("a.jpg.geometric", 1), ("a.jpg.photometric", 7)):
        write_map(folder / f"{name}.bin", np.full((2, 3), value, np.float32))
    assert depths(tmp_path).tolist() == [1] * 6 + [2] * 6
