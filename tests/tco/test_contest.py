"""Depths that others contradict: votes, pictures, who hides whom, and what stays."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from tco import contest
from tco._contest_kernels import carry
from tco.contest import (
    BEHIND,
    BEST,
    BEYOND,
    CONTRAST,
    LEAST,
    MARGIN,
    NOISE,
    RADIUS,
    SAME,
    SHOWN,
    SIDE,
    WORTH,
    settled,
)
from tco.options import ConsensusConfig
from tco.schedule import most_overlapping
from tco.toy import Wall, wall
from tco.types import Cameras, Views

VIEWS, CONFIG = 6, ConsensusConfig()
PATCH = (slice(16, 30), slice(24, 40))
"""Of the middle view's 48 × 64 pixels."""
Doubles = NDArray[np.float64]


@pytest.fixture(scope="module")
def scene() -> Wall:
    return wall(VIEWS)


def cameras(scene: Wall) -> Cameras:
    assert scene.priors.cameras is not None
    return scene.priors.cameras


def overlap(scene: Wall) -> Tensor:
    assert scene.priors.overlap is not None
    return scene.priors.overlap


def decided(
    scene: Wall, depth: Tensor, views: Views | None = None, config: ConsensusConfig = CONFIG
) -> tuple[Tensor, Tensor]:
    return settled(depth, cameras(scene), views or scene.views, overlap(scene), config)


def flat(scene: Wall) -> Views:
    """Pictures that show nothing, so that views alone decide."""
    return replace(scene.views, images=torch.full_like(scene.views.images, 0.5))


def wrong(scene: Wall, factor: float, views: tuple[int, ...] = (2,)) -> Tensor:
    depth = scene.depth.clone()
    for view in views:
        depth[view][PATCH] *= factor
    return depth


def test_depths_that_all_share_stay(scene: Wall) -> None:
    depth, taken = decided(scene, scene.depth)
    assert not taken.any()
    assert torch.equal(depth, scene.depth)


@pytest.mark.parametrize("factor", [0.7, 0.9, 1.1, 1.4])
@pytest.mark.parametrize("pictures", [True, False])
def test_what_one_view_alone_says_is_replaced(scene: Wall, factor: float, pictures: bool) -> None:
    """Nearer and farther, by views alone and with pictures; by a depth up to a pixel away, so not exactly."""
    said = wrong(scene, factor)
    depth, taken = decided(scene, said, None if pictures else flat(scene))
    assert float(taken[2][PATCH].float().mean()) > 0.97
    new = (depth[2][PATCH] / scene.depth[2][PATCH]).log().abs()[taken[2][PATCH]]
    assert float(new.max()) < 0.01
    elsewhere = taken.clone()
    elsewhere[2][PATCH] = False
    assert float(elsewhere.float().mean()) < 2e-3
    assert torch.equal(depth[~taken], said[~taken])


def test_views_that_err_together_are_believed_where_pictures_show_nothing(scene: Wall) -> None:
    """The wall is wrong in all views but one: alone it is outvoted, and then takes the wrong depth."""
    said = 1.3 * scene.depth
    said[2] = scene.depth[2]
    depth, taken = decided(scene, said, flat(scene))
    assert float(taken[2].float().mean()) > 0.8
    assert float((depth[2] / said[2]).log()[taken[2]].median()) > 0.15


def test_pictures_do_not_outweigh_more_than_two_votes(scene: Wall) -> None:
    """Four of six are wrong alike: 1 + 3 − 2 votes, for the truth 2 − 3, whatever pictures say."""
    said = 1.3 * scene.depth
    said[[2, 3]] = scene.depth[[2, 3]]
    taken = decided(scene, said)[1][[0, 1, 4, 5], 14:-14, 20:-20]
    assert float(taken.float().mean()) < 0.02


def test_a_depth_takes_two_others(scene: Wall) -> None:
    """Of two views neither can be told which is right."""
    two = wall(2)
    said = two.depth.clone()
    said[1][PATCH] *= 1.3
    assert not decided(two, said)[1].any()


def test_pictures_decide_where_votes_are_near(scene: Wall) -> None:
    """Two views right and two wrong: votes are within the margin; with pictures the wrong take the right.

    Where both right ones see the place: at its borders one of them does not.
    """
    some = [0, 2, 3, 5]
    four = replace(scene.views, images=scene.views.images[some], valid=scene.views.valid[some])
    four = replace(four, names=tuple(scene.views.names[i] for i in some))
    poses, shared = cameras(scene)[some], overlap(scene)[some][:, some]
    said = scene.depth[some].clone()
    said[:2] *= 1.25
    nothing = replace(four, images=torch.full_like(four.images, 0.5))
    with_pictures, taken = settled(said, poses, four, shared, CONFIG)
    _, without = settled(said, poses, nothing, shared, CONFIG)
    inner = (slice(None), slice(14, -14), slice(20, -20))
    right = ((with_pictures / scene.depth[some]).log().abs() < 0.01)[inner].float().mean((1, 2))
    assert float(without[inner].float().mean()) < 0.2
    assert float(right[:2].min()) > 0.9
    assert float(right[2:].min()) > 0.99
    assert float(taken[:2][inner].float().mean()) > 0.9


def scattered(scene: Wall, seed: int) -> Tensor:
    """Noise, patches of several depths in several views, and pixels that know nothing."""
    generator = torch.Generator().manual_seed(seed)
    depth = scene.depth * (1 + 0.008 * torch.randn(scene.depth.shape, generator=generator))
    for view in range(len(depth)):
        for _ in range(4):
            y, x = (int(torch.randint(0, n - 10, (1,), generator=generator)) for n in depth.shape[1:])
            depth[view, y : y + 10, x : x + 10] *= float(0.7 + 0.6 * torch.rand(1, generator=generator))
    depth[1, 5, 7], depth[2, 9, 9], depth[3, 20:24, 30:34] = math.nan, math.inf, 0.0
    return depth


def place(scene: Wall, source: int, target: int, xy: Doubles, d: float) -> tuple[Doubles, Doubles]:
    """Where pixels (N, 2) of a depth fall in another view (N, 2), and their depths there (N,)."""
    K, pose = (t.double().numpy() for t in (cameras(scene).K, cameras(scene).world_from_cam))
    rays = np.concatenate([xy, np.ones((len(xy), 1))], 1) @ np.linalg.inv(K[source]).T
    world = d * rays @ pose[source, :3, :3].T + pose[source, :3, 3]
    local = (world - pose[target, :3, 3]) @ pose[target, :3, :3]
    image = local @ K[target].T
    return image[:, :2] / image[:, 2:], image[:, 2]


def correlated(scene: Wall, grey: Doubles, i: int, j: int, y: int, x: int, d: float) -> float:
    """Weighted correlation of a window of view i with what it falls on in view j; 0 if too little is seen."""
    h, w = grey.shape[1:]
    there = [
        (a, b)
        for b in range(y - SIDE, y + SIDE + 1)
        for a in range(x - SIDE, x + SIDE + 1)
        if 0 <= a < w and 0 <= b < h and grey[i, b, a] >= 0
    ]
    columns, rows = np.array(there).T
    mine = grey[i, rows, columns]
    apart = (columns - x) ** 2 + (rows - y) ** 2
    weight = np.exp(-apart / (2 * SIDE**2)) * np.exp(-abs(mine - grey[i, y, x]) / CONTRAST)
    uv = place(scene, i, j, np.stack([columns, rows], 1) + 0.5, d)[0] - 0.5
    inside = ((uv >= 0) & (uv < np.array([w - 1, h - 1]))).all(1)
    corner = np.where(inside[:, None], uv, 0).astype(int)
    f = (uv - corner).T
    c, r = corner.T
    four = [grey[j, r + b, c + a] for b in (0, 1) for a in (0, 1)]
    inside &= np.min(four, 0) >= 0
    if weight[inside].sum() < SHOWN * weight.sum():
        return 0.0
    mixed = (four[0] * (1 - f[0]) + four[1] * f[0]) * (1 - f[1])
    mixed += (four[2] * (1 - f[0]) + four[3] * f[0]) * f[1]
    weight, a, b = (v[inside] for v in (weight / weight[inside].sum(), mine, mixed))
    a, b = a - (weight * a).sum(), b - (weight * b).sum()
    scale = ((weight * a * a).sum() + NOISE) * ((weight * b * b).sum() + NOISE)
    return float((weight * a * b).sum() / np.sqrt(scale))


def expected(scene: Wall, depth: Doubles, grey: Doubles, i: int) -> Doubles:
    """The rule of :mod:`tco.contest`, pixel by pixel in float64; depths are 0 where there are none."""
    others, (h, w) = most_overlapping(overlap(scene), i, CONFIG.contest_views), depth.shape[1:]
    told = np.zeros((len(others), h, w))
    for k, j in enumerate(others):
        for y, x in np.argwhere(depth[j] > 0):
            uv, z = place(scene, j, i, np.array([[x + 0.5, y + 0.5]]), depth[j, y, x])
            low, high = np.floor(uv[0] - RADIUS).astype(int), np.floor(uv[0] + RADIUS).astype(int)
            for b in range(max(low[1], 0), min(high[1], h - 1) + 1):
                for a in range(max(low[0], 0), min(high[0], w - 1) + 1):
                    told[k, b, a] = min(told[k, b, a] or math.inf, z[0])

    def votes(y: int, x: int, d: float) -> tuple[int, int]:
        agree, against = 0, int(((told[:, y, x] > 0) & (told[:, y, x] < d * (1 - BEYOND))).sum())
        for j in others:
            uv, z = place(scene, i, j, np.array([[x + 0.5, y + 0.5]]), d)
            if ((uv >= 0) & (uv < np.array([w, h]))).all():
                there = depth[j, int(uv[0, 1]), int(uv[0, 0])]
                agree += bool(there > 0 and abs(there / z[0] - 1) < SAME)
                against += bool(there > z[0] * (1 + BEYOND))
        return agree, agree - against

    def alike(y: int, x: int, d: float) -> float:
        return float(np.mean(sorted(correlated(scene, grey, i, j, y, x, d) for j in others)[-BEST:]))

    out = depth[i].copy()
    for y, x in np.argwhere(depth[i] > 0):
        own = depth[i, y, x]
        rivals = [d for d in told[:, y, x] if d > 0 and abs(d / own - 1) > SAME]
        for_own = votes(y, x, own)[1] + 1
        rivals = [d for d in rivals if votes(y, x, d)[0] >= LEAST and votes(y, x, d)[1] >= for_own - BEHIND]
        if rivals:
            score = [votes(y, x, d)[1] + WORTH * alike(y, x, d) for d in rivals]
            if max(score) > for_own + WORTH * alike(y, x, own) + MARGIN:
                out[y, x] = rivals[int(np.argmax(score))]
    return out


@pytest.mark.parametrize(("seed", "contrast"), [(0, 1.0), (1, 1.0), (2, 0.01)])
def test_loops_do_what_the_rule_says(seed: int, contrast: float) -> None:
    """But for pixels where a decision falls by a rounding; also where pictures show little but noise."""
    scene = wall(VIEWS, (36, 48))
    said = scattered(scene, seed)
    valid = torch.rand(said.shape, generator=torch.Generator().manual_seed(seed)) > 0.01
    valid[0, :, :5] = valid[4, 30:] = False
    images = 0.5 + contrast * (scene.views.images - 0.5)
    depth, taken = decided(scene, said, replace(scene.views, valid=valid, images=images))
    clean = said.where(said.isfinite() & valid, torch.zeros(())).double().numpy()
    grey = images.double().mean(1).where(valid, torch.tensor(-1.0).double()).numpy()
    for i in (0, 3):
        rule = expected(scene, clean, grey, i)
        seen = torch.from_numpy(clean[i] > 0)
        same = torch.isclose(depth[i].double(), torch.from_numpy(rule), rtol=1e-4, atol=0)[seen]
        assert float(same.double().mean()) > 0.998, float(same.double().mean())
        assert 0.02 < float((rule != clean[i]).mean()) < 0.5  # so that agreeing means something
        assert torch.equal(depth[i][~taken[i]].nan_to_num(), said[i][~taken[i]].nan_to_num())


def test_what_is_no_depth_stays_and_says_nothing(scene: Wall) -> None:
    said = wrong(scene, 1.3)
    said[2, 20, 30], said[2, 21, 30], said[2, 22, 30] = math.nan, math.inf, 0.0
    depth, taken = decided(scene, said)
    assert not taken[2, 20:23, 30].any()
    assert torch.equal(depth[2, 20:23, 30].nan_to_num(), said[2, 20:23, 30].nan_to_num())
    nobody = said.clone()
    nobody[[0, 1, 3, 4, 5]] = math.nan
    assert not decided(scene, nobody)[1].any()


def test_pixels_that_do_not_count_stay_and_say_nothing(scene: Wall) -> None:
    said, valid = wrong(scene, 1.3), scene.views.valid.clone()
    valid[2, :22] = False
    taken = decided(scene, said, replace(scene.views, valid=valid))[1]
    assert not taken[2, :22].any()
    assert float(taken[2, 22:30, 24:40].float().mean()) > 0.9
    valid = torch.zeros_like(valid)
    valid[2] = True
    assert not decided(scene, said, replace(scene.views, valid=valid))[1].any()


def test_helpers_take_part_and_are_not_asked_for(scene: Wall) -> None:
    said = wrong(scene, 1.3, (2, 5))
    depth, taken = decided(scene, said, replace(scene.views, helpers=2))
    whole, _ = decided(scene, said)
    assert not taken[4:].any()
    assert torch.equal(depth[4:], said[4:])
    assert torch.equal(depth[:4], whole[:4])


def test_nobody_is_asked_by_none(scene: Wall) -> None:
    said = wrong(scene, 1.3)
    depth, taken = decided(scene, said, config=replace(CONFIG, contest_views=0))
    assert torch.equal(depth, said)
    assert not taken.any()


@pytest.mark.parametrize("views", [-1, 1])
def test_a_number_of_views_that_can_do_nothing_is_refused(views: int) -> None:
    with pytest.raises(ValueError, match="contest_views must be 0, or at least 2"):
        ConsensusConfig(contest_views=views)


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_change_nothing(scene: Wall, threads: int) -> None:
    before, said = torch.get_num_threads(), scattered(scene, 3)
    try:
        torch.set_num_threads(threads)
        many = decided(scene, said)[0]
    finally:
        torch.set_num_threads(before)
    assert torch.equal(many.nan_to_num(), decided(scene, said)[0].nan_to_num())


def test_a_shifted_wall_is_carried_by_its_parallax() -> None:
    """A camera moved by b to the right sees depth z f b / z pixels to the left; f b / z is 3 here."""
    f, z = 40.0, 2.0
    K = torch.tensor([[f, 0, 16], [0, f, 12], [0, 0, 1]]).repeat(2, 1, 1)
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[1, 0, 3] = 3 * z / f
    depth, out = np.full((24, 32), z, np.float32), np.zeros((24, 32), np.float32)
    depth[5, 10] = 0
    carry(depth, contest._pose(Cameras(pose, K), 1, 0), RADIUS, out)
    found = np.full((24, 32), z, np.float32)
    found[:, 29:], found[5, 7] = 0, 0
    np.testing.assert_allclose(out, found, rtol=1e-6)


def test_the_nearest_is_carried_and_what_is_behind_the_camera_is_not() -> None:
    """Both views are at one place: pixels fall on themselves; a wide radius makes neighbours compete."""
    K = torch.tensor([[40.0, 0, 16], [0, 40.0, 12], [0, 0, 1]]).repeat(2, 1, 1)
    pose = torch.eye(4).repeat(2, 1, 1)
    depth = np.arange(1, 24 * 32 + 1, dtype=np.float32).reshape(24, 32)
    out = np.zeros_like(depth)
    carry(depth, contest._pose(Cameras(pose, K), 1, 0), 1.0, out)
    padded = np.pad(depth, 1, constant_values=np.inf)
    least = np.min([padded[b : b + 24, a : a + 32] for b in range(3) for a in range(3)], 0)
    np.testing.assert_allclose(out, least, rtol=1e-5)
    pose[1, 2, 3] = 1e4
    out = np.zeros_like(depth)
    carry(depth, contest._pose(Cameras(pose, K), 1, 0), 1.0, out)
    assert not out.any()
