"""Pictures are made once however many chunks hold a view, and are those that one by one are made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_tco.pictures import Pictures
from colmap_tco.views import View, ViewConfig, make_views, network_image, undistorted_image
from colmap_tco.workspace import open_workspace


@pytest.fixture(scope="module")
def views(
    tmp_path_factory: pytest.TempPathFactory, make_workspace: Callable[..., Path], shot: type
) -> list[View]:
    """Six views of two cameras in turn, with different distortions, smaller than their images."""
    shots = [shot(), shot(model="OPENCV", size=(144, 128))] * 3
    root = make_workspace(tmp_path_factory.mktemp("pictures"), shots)
    return make_views(open_workspace(root), ViewConfig(max_image_size=96), 16)[0]


def test_they_are_what_each_view_gives_alone(views: list[View]) -> None:
    """Of both cameras, though the places of pixels are kept from view to view."""
    taken: dict[str, NDArray[np.uint8]] = {}
    pictures = Pictures(lambda view, image: taken.update({view.name: image}))
    for view in [*views[::2], *views[1::2]]:
        for got, expected in zip(pictures(view), network_image(view), strict=True):
            assert np.array_equal(got, expected)
        assert np.array_equal(taken[view.name], undistorted_image(view)[0])


def test_a_view_is_read_once(views: list[View]) -> None:
    taken: list[str] = []
    pictures = Pictures(lambda view, image: taken.append(view.name))
    first = [pictures(view) for view in views]
    again = [pictures(view) for view in reversed(views)]
    assert taken == [view.name for view in views]
    assert all(a is b for a, b in zip(first, reversed(again), strict=True))


def test_no_more_is_kept_than_allowed(views: list[View]) -> None:
    """With room for three, the three used last stay; one that had to go is made again, and equal."""
    taken: list[str] = []
    size = sum(part.nbytes for part in network_image(views[0]))
    pictures = Pictures(lambda view, image: taken.append(view.name), kept=3 * size)
    same = views[::2]  # of one camera, so that all take as many bytes
    others = [same[0], same[1], same[2], same[0], views[1]]
    made = [pictures(view) for view in others]
    assert taken == [view.name for view in (*same, views[1])]
    before = made[1]
    assert all(np.array_equal(a, b) for a, b in zip(pictures(same[1]), before, strict=True))
    assert taken[-1] == same[1].name, "the one that was used longest ago had to be made again"
    pictures(same[0])
    assert taken[-1] == same[1].name, "the one that was used since is still there"
