"""Depth errors that were put in are measured, and scales and shifts that were put in are taken out."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from colmap_tco.evaluation.depth import DepthFigures, Scaling, depth_figures

Floats = NDArray[np.float64]


def truth(views: int = 3) -> Floats:
    return np.random.default_rng(0).uniform(1, 4, (views, 12, 16))


@pytest.mark.parametrize("factor", [1.01, 0.97, 1.2, 1.3, 1.6, 2.5])
def test_a_constant_relative_error_is_measured(factor: float) -> None:
    z = truth()
    found = depth_figures(factor * z, z)
    off, ratio = abs(factor - 1), max(factor, 1 / factor)
    assert (found.abs_rel, found.median) == pytest.approx((off, off))
    assert found.rmse == pytest.approx(off * np.sqrt((z**2).mean()))
    assert (found.d2, found.d5) == (off < 0.02, off < 0.05)
    deltas = (found.delta_1_25, found.delta_1_25_2, found.delta_1_25_3)
    assert deltas == tuple(ratio < 1.25**k for k in (1, 2, 3))
    assert (found.coverage, found.scale, found.shift, found.pixels) == (1, 1, 0, z.size)


def test_holes_are_misses_of_d2_and_d5_but_not_of_the_others() -> None:
    z = truth(4)
    d = z.copy()
    d[0], d[1, 0, 0], d[1, 0, 1] = 0, np.nan, -1
    z[3] = 0
    z[2, 0, 0] = np.nan
    found = depth_figures(d, z)
    measured = 3 * 12 * 16 - 1
    predicted = measured - 12 * 16 - 2
    assert found.pixels == measured
    assert found.coverage == found.d2 == found.d5 == pytest.approx(predicted / measured)
    assert (found.abs_rel, found.delta_1_25) == (0, 1)


@pytest.mark.parametrize("scaling", ["median", "scale", "scale_shift"])
def test_one_scale_for_all_views_is_taken_out(scaling: Scaling) -> None:
    z = truth()
    found = depth_figures(z / 3.7, z, scaling)
    assert found.scale == pytest.approx(3.7)
    assert found.abs_rel == pytest.approx(0, abs=1e-12)
    per_view = z / np.array([1.0, 2, 3])[:, None, None]
    assert depth_figures(per_view, z, scaling).abs_rel > 0.1


def test_a_shift_is_taken_out_where_asked_for() -> None:
    z = truth()
    found = depth_figures(0.5 * z + 2, z, "scale_shift")
    assert (found.scale, found.shift) == pytest.approx((2, -4))
    assert found.rmse == pytest.approx(0, abs=1e-12)


def test_scalings_are_the_minima_that_they_are_called_after() -> None:
    rng = np.random.default_rng(1)
    z = truth()
    d = 0.4 * z + 0.3 + 0.2 * rng.normal(size=z.shape)
    scale = least_squares(lambda s: (s[0] * d - z).ravel(), [1.0]).x[0]
    both = least_squares(lambda s: (s[0] * d + s[1] - z).ravel(), [1.0, 0.0]).x
    assert depth_figures(d, z, "scale").scale == pytest.approx(scale, rel=1e-6)
    found = depth_figures(d, z, "scale_shift")
    assert (found.scale, found.shift) == pytest.approx(tuple(both), rel=1e-5)
    assert depth_figures(d, z, "median").scale == pytest.approx(np.median(z) / np.median(d))


def test_depths_that_a_shift_makes_negative_are_misses_of_delta() -> None:
    z = np.array([1.0, 1.0, 1.0, 9.0])
    d = np.array([3.0, 3.0, 0.1, 9.0])
    found = depth_figures(d, z, "scale_shift")
    moved = found.scale * d + found.shift
    assert moved.min() < 0 < found.scale
    assert found.delta_1_25_3 == pytest.approx(
        np.mean([m > 0 and max(m / t, t / m) < 1.25**3 for m, t in zip(moved, z, strict=True)])
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_every_figure_is_that_of_a_loop_over_the_pixels(seed: int) -> None:
    """Errors of all sizes, holes in both, and no figure that another could be taken for."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(1, 4, (3, 8, 9))
    d = z * np.exp(rng.choice([0.01, 0.04, 0.15, 0.5, 0.8], z.shape) * rng.normal(size=z.shape))
    d[rng.random(z.shape) < 0.2], z[rng.random(z.shape) < 0.1] = 0, np.nan
    relative, squares, near = [], [], []
    within, measured, deltas = [0, 0], 0, [0, 0, 0]
    for predicted, true in zip(d.ravel(), z.ravel(), strict=True):
        if not true > 0:
            continue
        measured += 1
        if not predicted > 0:
            continue
        off = abs(predicted - true) / true
        relative.append(off)
        squares.append((predicted - true) ** 2)
        near.append(max(predicted / true, true / predicted))
        within[0] += off < 0.02
        within[1] += off < 0.05
        for k in range(3):
            deltas[k] += near[-1] < 1.25 ** (k + 1)
    ordered, both = sorted(relative), len(relative)
    expected = {
        "abs_rel": sum(relative) / both,
        "rmse": (sum(squares) / both) ** 0.5,
        "delta_1_25": deltas[0] / both,
        "delta_1_25_2": deltas[1] / both,
        "delta_1_25_3": deltas[2] / both,
        "d2": within[0] / measured,
        "d5": within[1] / measured,
        "coverage": both / measured,
        "median": (ordered[(both - 1) // 2] + ordered[both // 2]) / 2,
        "scale": 1.0,
        "shift": 0.0,
        "pixels": measured,
    }
    assert vars(depth_figures(d, z)) == pytest.approx(expected)
    assert len({round(value, 3) for value in expected.values()}) == len(expected)


def test_figures_are_those_of_the_pixels_in_any_arrangement() -> None:
    z = truth()
    d = z * np.random.default_rng(2).uniform(0.8, 1.3, z.shape)
    assert depth_figures(d, z) == depth_figures(d.ravel(), z.ravel())


@pytest.mark.parametrize(
    ("d", "z", "scaling", "told"),
    [
        (truth(2), truth(3), "none", "is"),
        (truth(), 0 * truth(), "none", "no measurement"),
        (0 * truth(), truth(), "none", "no measured pixel"),
        (truth(), truth(), "some", "not one of none, median, scale, scale_shift"),
        (np.ones((1, 4, 4)), truth(1)[:, :4, :4], "scale_shift", "no shift"),
    ],
)
def test_what_cannot_be_compared_is_refused(d: Floats, z: Floats, scaling: Scaling, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        depth_figures(d, z, scaling)


def test_figures_are_plain_numbers() -> None:
    """So that they can be written as JSON."""
    found = depth_figures(truth(), truth())
    assert all(type(value) in (float, int) for value in vars(found).values())
    assert isinstance(found, DepthFigures)
