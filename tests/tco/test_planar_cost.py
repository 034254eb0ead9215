"""What it costs a pixel to take a plane, and planes that are fitted in spite of wrong pixels."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.consensus import Agreement
from tco.options import ConsensusConfig
from tco.planar import run
from tco.planar.fit import refit
from tco.planar.label import (
    CERTAIN,
    CLEAR,
    DOUBT,
    LEAST,
    MOST,
    MOST_UNLIKE,
    NEAR,
    NEVER,
    SHRINK,
    UNLIKE,
    UNSURE,
    VAGUE,
    WIDE,
    colour_bins,
    cost_of_colour,
    costs_of,
    labelled,
)
from tco.planar.view import ERROR, Floats, Plane, Shown, shown, within
from tco.toy import Wall, wall
from tco.types import Prediction

SLOPE = 0.3
NORMAL, OFFSET = np.array([-SLOPE, 0, 1]) / math.hypot(SLOPE, 1), 2 / math.hypot(SLOPE, 1)
CONFIG = ConsensusConfig()
WEIGHT = 1.7
"""Of colours where a depth is kept, in the tests of its cost."""
KNOWN = Plane(NORMAL.astype(np.float32), OFFSET, np.zeros(3), np.eye(3)[:2], np.zeros((3, 3)))


@pytest.fixture(scope="module")
def scene() -> Wall:
    return wall(6, (96, 128), SLOPE)


def seen(scene: Wall, depth: Tensor, confidence: Tensor | None = None) -> list[Shown]:
    """The views with these depths, of confidence 6 unless another is given."""
    cameras = scene.priors.cameras
    assert cameras is not None
    sure = torch.full_like(depth, 6.0) if confidence is None else confidence
    prediction = Prediction(depth, sure, cameras, tuple(range(len(depth))))
    return [shown(prediction, cameras, scene.views, i) for i in range(len(depth))]


def cost(view: Shown) -> Floats:
    """Of the wall's own plane, which is known exactly."""
    return costs_of(view, [KNOWN], colour_bins(view), CONFIG).cost[0]


def cost_of_keeping_on_colour(view: Shown) -> Floats:
    """Beside the wall's own plane as the only one."""
    colours = colour_bins(view)
    on_it = costs_of(view, [KNOWN], colours, CONFIG).near[0]
    return cost_of_colour(view, colours, on_it, replace(CONFIG, plane_colour=WEIGHT))


def plain(view: Shown) -> Shown:
    """Of one colour."""
    return replace(view, image=np.full_like(view.image, 0.5))


def some_planes(seed: int, count: int) -> list[Plane]:
    """Anywhere before, beside and behind the cameras, with any covariance."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        normal, centre = rng.standard_normal(3), rng.standard_normal(3) + (0, 0, 1)
        normal = (normal / np.linalg.norm(normal)).astype(np.float32)
        root = 0.05 * rng.standard_normal((3, 3))
        found.append(Plane(normal, float(normal @ centre), centre, within(normal), root @ root.T))
    return found


def test_costs_are_the_formula_of_departure_and_of_the_planes_own_error(scene: Wall) -> None:
    """In float64, where all pixels are of one colour, which is rare on no plane."""
    sure = torch.full_like(scene.depth, 1.3)
    sure[3, :20] = 9.0
    view = plain(seen(scene, scene.depth, sure)[3])
    view = replace(view, known=view.known & (np.arange(128) > 3))
    planes = some_planes(1, 12)
    found = costs_of(view, planes, colour_bins(view), CONFIG)
    exact = replace(view, directions=view.directions.astype(np.float64))
    seen_from_behind = 0
    for plane, cost, log_depth, near in zip(planes, found.cost, found.log_depth, found.near, strict=True):
        depth = plane.depth(exact).astype(np.float64)
        there = (depth > 0) & view.known
        seen_from_behind += int((depth == 0).sum())
        assert (cost[~there] == NEVER).all() and (log_depth[~there] == 0).all() and (near[~there] == 0).all()
        off = np.log(np.where(there, depth, 1) / view.depth)
        apart = (off / (WIDE * view.error).clip(LEAST, MOST)) ** 2
        expected = CONFIG.plane_trust * apart / (1 + apart)
        expected += DOUBT * (plane.error(exact, np.where(there, depth, 1)) / UNSURE) ** 2
        there &= depth < 20  # beyond that a ray is along the plane, and float32 too little
        np.testing.assert_allclose(log_depth[there], np.log(depth[there]), atol=1e-4)
        np.testing.assert_allclose(cost[there], expected.clip(0, NEVER)[there], rtol=1e-3, atol=1e-4)
        width = view.error.clip(LEAST / WIDE, NEAR)
        np.testing.assert_allclose(near[there], np.exp(-0.5 * (off / width) ** 2)[there], atol=2e-3)
    assert 0 < seen_from_behind < 0.9 * 12 * view.depth.size


@pytest.mark.parametrize("factor", [1.5, 5.0])
def test_far_off_a_depth_costs_its_trust_and_no_more(scene: Wall, factor: float) -> None:
    """However far: one wrong depth cannot outweigh all of its neighbours."""
    depth = scene.depth.clone()
    depth[2, 40:44, 50:54] *= factor
    found = cost(plain(seen(scene, depth)[2]))
    assert found[41, 51] == pytest.approx(CONFIG.plane_trust, rel=0.2)
    assert found[41, 51] <= CONFIG.plane_trust
    assert found[10, 10] < 1e-3


def test_a_colour_that_the_plane_does_not_show_costs(scene: Wall) -> None:
    """Equally far off the plane; one is of the plane's colour and the other of none that is on it."""
    depth = scene.depth.clone()
    depth[2, 30:60, 40:80] *= 1.3
    view = plain(seen(scene, depth)[2])
    image = view.image.copy()
    image[30:60, 60:80] = (0.9, 0.1, 0.1)
    found = cost(replace(view, image=image))
    assert found[45, 75] - found[45, 50] > 0.5 * UNLIKE * MOST_UNLIKE
    assert found[45, 75] - found[45, 50] <= UNLIKE * MOST_UNLIKE + 0.1


def test_pixels_count_for_the_colours_of_a_plane_with_the_square_of_their_confidence(scene: Wall) -> None:
    """30 rows of a red patch are at the wall's depth, by unsure pixels; 20 are behind it, by sure ones."""
    sure, depth = torch.full_like(scene.depth, 4.0), scene.depth.clone()
    sure[2, 30:60, 40:80], depth[2, 60:80, 40:80] = 1.5, 1.3 * depth[2, 60:80, 40:80]
    view = plain(seen(scene, depth, sure)[2])
    image = view.image.copy()
    image[30:80, 40:80] = (0.9, 0.1, 0.1)
    here, behind = 30 * 40 * 0.5**2, 20 * 40 * CERTAIN**2
    grey = (96 * 128 - 50 * 40) * CERTAIN**2
    on_it, anywhere = here / (here + grey), (here + behind) / (here + behind + grey)
    found = cost(replace(view, image=image))
    assert found[45, 60] == pytest.approx(UNLIKE * math.log(anywhere / on_it), rel=0.1)


@pytest.fixture
def door(scene: Wall) -> tuple[Shown, slice, slice]:
    """A grey wall, a red thing before it, known well, and a part of the wall with wrong and unsure depths."""
    depth, sure = scene.depth.clone(), torch.full_like(scene.depth, 4.0)
    depth[2, 20:80, 10:40] *= 0.6
    depth[2, 40:56, 80:104] *= 0.8
    sure[2, 40:56, 80:104] = 1.5
    view = plain(seen(scene, depth, sure)[2])
    image = view.image.copy()
    image[20:80, 10:40] = (0.9, 0.1, 0.1)
    return replace(view, image=image), slice(44, 52), slice(84, 100)


def test_a_depth_of_a_colour_that_is_on_planes_elsewhere_costs_by_how_unsure_it_is(
    door: tuple[Shown, slice, slice],
) -> None:
    """The chance of grey off the plane against that anywhere, shrunk as for planes. Red costs nothing."""
    view, rows, columns = door
    red, unsure, pixels = 60 * 30 * CERTAIN**2, 16 * 24, 96 * 128
    for sure in (0.5, 1.0, 2.0):
        held = view.sure.copy()
        held[40:56, 80:104] = sure
        found = cost_of_keeping_on_colour(replace(view, sure=held))
        off = unsure * sure**2
        every = (pixels - 60 * 30 - unsure) * CERTAIN**2 + off
        ratio = (off + SHRINK * every) / (off + red + SHRINK * (every + red)) * (every + red) / every
        times = (ERROR / sure / VAGUE) ** 2
        expected = WEIGHT * (min(-math.log(ratio), MOST_UNLIKE) - CLEAR) * times / (1 + times)
        np.testing.assert_allclose(found[rows, columns], expected, rtol=0.05)
        assert found[30:70, 15:35].max() == 0.0


def test_colours_that_are_off_planes_as_often_as_on_them_cost_nothing(
    door: tuple[Shown, slice, slice],
) -> None:
    view, rows, columns = door
    found = cost_of_keeping_on_colour(plain(view))
    assert found[rows, columns].max() == 0.0


def test_an_unsure_depth_goes_to_the_plane_that_has_its_colour(door: tuple[Shown, slice, slice]) -> None:
    """A fifth too near and unsure: grey as the wall it is of the wall, red as the thing before it is not."""
    view, rows, columns = door
    config = replace(CONFIG, plane_trust=2.0)
    grey = labelled(view, [KNOWN], config)
    image = view.image.copy()
    image[40:56, 80:104] = (0.9, 0.1, 0.1)
    red = labelled(replace(view, image=image), [KNOWN], config)
    assert (grey[rows, columns] == 1).all() and (grey[25:75, 15:35] == 0).all()
    assert (red[rows, columns] == 0).all()
    deaf = labelled(view, [KNOWN], replace(config, plane_colour=0.0))
    assert (deaf[rows, columns] == 0).all()


def test_where_there_is_no_depth_the_plane_cannot_be(scene: Wall) -> None:
    depth = scene.depth.clone()
    depth[2, 5, 6] = 0.0
    found = cost(plain(seen(scene, depth)[2]))
    assert found[5, 6] == np.float32(NEVER) and (found == np.float32(NEVER)).sum() == 1


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_wrong_pixels_of_a_plane_hardly_move_it(scene: Wall, share: float) -> None:
    """Some of the pixels that took it are 40 % too deep; it stays within half a per cent of the wall."""
    depth = scene.depth.clone()
    wrong = torch.rand(depth.shape, generator=torch.Generator().manual_seed(3)) < share
    depth[wrong] *= 1.4
    views = seen(scene, depth)
    labels = [np.ones(view.depth.shape, np.int64) for view in views]
    (plane,) = refit(views, labels, [KNOWN], CONFIG)
    truth = seen(scene, scene.depth)[2]
    assert np.abs(plane.depth(truth) / truth.depth - 1).max() < 0.005


def test_a_label_whose_plane_is_behind_the_camera_is_none(
    scene: Wall, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Labels of larger pictures are those of coarser ones, where a plane may still be in front."""
    everywhere_one = np.ones(tuple(scene.depth.shape[1:]), np.int64)
    monkeypatch.setattr(run, "labelled", lambda *_args, **_kw: everywhere_one.copy())
    behind = replace(KNOWN, offset=-OFFSET)
    monkeypatch.setattr(run, "find", lambda *_args: [behind])
    monkeypatch.setattr(run, "refit", lambda *_args: [behind])
    cameras = scene.priors.cameras
    assert cameras is not None
    prediction = Prediction(scene.depth, torch.full_like(scene.depth, 6.0), cameras, tuple(range(6)))
    agreement = Agreement(prediction, torch.full_like(scene.depth, 0.01))
    found = run.flattened(agreement, cameras, scene.views, CONFIG)
    assert int(found.labels.abs().max()) == 0
    assert torch.equal(found.agreement.prediction.depth, scene.depth)
