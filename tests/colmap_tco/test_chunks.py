"""Chunks: every view once, nothing too large, neighbours together; sources in the order of their score."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from colmap_tco import _pycolmap
from colmap_tco.chunks import Chunk, plan_chunks, source_views
from colmap_tco.tracks import Covisibility, covisibility, read_tracks


def scene(views: int, seed: int, reach: float = 0.15) -> np.ndarray:
    """Common counts of cameras scattered over a unit square that see the points near them."""
    rng = np.random.default_rng(seed)
    points, cameras = rng.random((3000, 2)), rng.random((views, 2))
    seen = (np.linalg.norm(points[None] - cameras[:, None], axis=2) < reach).astype(int)
    common: np.ndarray = seen @ seen.T
    np.fill_diagonal(common, 0)
    return common


def connected(common: np.ndarray, group: tuple[int, ...]) -> bool:
    inside, reached = set(group), {group[0]}
    while grown := {b for a in reached for b in inside - reached if common[a, b] > 0}:
        reached |= grown
    return reached == inside


@pytest.mark.parametrize("max_views", [2, 3, 8, 20])
@pytest.mark.parametrize("seed", range(4))
def test_every_view_is_owned_once_and_no_chunk_is_too_large(seed: int, max_views: int) -> None:
    common = scene(60, seed)
    plan = plan_chunks(common, max_views)
    owned = [v for chunk in plan.chunks for v in chunk.owned]
    assert sorted([*owned, *plan.skipped]) == list(range(60))
    for chunk in plan.chunks:
        assert len(chunk.views) == len(set(chunk.views)) <= max_views
        assert chunk.owned == tuple(sorted(chunk.owned))
        for view in chunk.context:
            assert common[view, chunk.owned].any()


@pytest.mark.parametrize("seed", range(4))
def test_every_owned_view_has_a_partner_in_its_chunk(seed: int) -> None:
    common = scene(60, seed)
    for chunk in plan_chunks(common, 10).chunks:
        for view in chunk.owned:
            assert common[view, [v for v in chunk.views if v != view]].any()


@pytest.mark.parametrize("seed", range(4))
def test_groups_are_connected_and_not_wastefully_small(seed: int) -> None:
    common = scene(100, seed, reach=0.3)
    plan = plan_chunks(common, 20)
    assert all(connected(common, chunk.owned) for chunk in plan.chunks)
    assert 100 / 19 <= len(plan.chunks) <= 10


def test_what_fits_is_one_chunk_without_context() -> None:
    common = np.ones((6, 6), int) - np.eye(6, dtype=int)
    assert plan_chunks(common, 6).chunks == (Chunk((0, 1, 2, 3, 4, 5)),)


def test_unconnected_scenes_never_mix() -> None:
    a, b = scene(25, 0, 0.5), scene(30, 1, 0.5)
    common = np.block([[a, np.zeros((25, 30), int)], [np.zeros((30, 25), int), b]])
    for chunk in plan_chunks(common, 8).chunks:
        assert len({view < 25 for view in chunk.views}) == 1


def test_views_without_common_points_are_skipped_with_the_reason() -> None:
    common = np.ones((4, 4), int) - np.eye(4, dtype=int)
    common[2] = common[:, 2] = 0
    plan = plan_chunks(common, 4)
    assert plan.chunks == (Chunk((0, 1, 3)),)
    assert plan.skipped == {2: "shares no 3D point with another view"}


def test_a_walk_is_cut_into_pieces_of_the_walk_in_any_order() -> None:
    """Views along a line, shuffled: the groups are intervals of the line, and their context lies beside."""
    place = np.random.default_rng(0).permutation(40)
    gap = np.abs(np.subtract.outer(place, place))
    common = np.where(gap > 0, np.maximum(0, 100 - 20 * gap), 0)
    for chunk in plan_chunks(common, 13).chunks:
        owned = np.sort(place[list(chunk.owned)])
        assert (np.diff(owned) == 1).all()
        assert all(np.abs(place[view] - owned).min() <= 4 for view in chunk.context)
        assert chunk.context


def test_the_names_of_views_do_not_matter() -> None:
    """Renumbering the views renumbers the plan of a scene without ties, and repeating repeats it."""
    common = scene(50, 3, 0.25) * 1000 + np.random.default_rng(0).integers(0, 1000, (50, 50))
    common = np.triu(common, 1) + np.triu(common, 1).T
    order = np.random.default_rng(1).permutation(50)
    plain, shuffled = plan_chunks(common, 9), plan_chunks(common[np.ix_(order, order)], 9)
    assert plan_chunks(common, 9) == plain
    back = {frozenset(order[list(chunk.owned)].tolist()) for chunk in shuffled.chunks}
    assert back == {frozenset(chunk.owned) for chunk in plain.chunks}


@pytest.mark.parametrize(
    ("common", "max_views"),
    [(np.triu(np.ones((3, 3), int), 1), 4), (np.zeros((2, 3), int), 4), (np.zeros((3, 3), int), 1)],
)
def test_senseless_arguments_are_refused(common: np.ndarray, max_views: int) -> None:
    with pytest.raises(ValueError, match=r"max_views|symmetric"):
        plan_chunks(common, max_views)


def test_sources_follow_the_score_then_the_count() -> None:
    common = np.array([[0, 9, 5, 7, 0], [9, 0, 0, 0, 0], [5, 0, 0, 0, 0], [7, 0, 0, 0, 0], [0, 0, 0, 0, 0]])
    score = np.where(common > 0, 1.0, 0.0)
    score[0, 2] = score[2, 0] = 3.0
    pairs = Covisibility(common, score)
    assert source_views(pairs, 3) == [(2, 1, 3), (0,), (0,), (0,), ()]
    assert source_views(pairs, 1) == [(2,), (0,), (0,), (0,), ()]


def test_sources_of_a_real_scene_have_a_baseline(shared: Path) -> None:
    """The best source is not the nearest camera: its rays meet at a useful angle."""
    tracks = read_tracks(_pycolmap.read_model(shared / "data" / "fountain" / "sparse" / "0"))
    ids = sorted(tracks.images)
    for view, sources in zip(ids, source_views(covisibility(tracks, ids), 3), strict=True):
        best = ids[sources[0]]
        both = np.intersect1d(tracks.images[view].point, tracks.images[best].point)
        a, b = (tracks.xyz[both] - tracks.centres[i] for i in (view, best))
        cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        assert len(both) > 100
        assert 3 < np.degrees(np.arccos(np.median(cosine))) < 25
