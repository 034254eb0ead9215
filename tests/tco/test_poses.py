"""Poses from depth: derivatives, the way back of an analytic scene, gauge, scale, focal length, errors."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tco.geometry import invert, pixel_grid, rays, rigid, so3_exp
from tco.linearise import Pair, _slopes
from tco.penalties import in_first_view, rotation_angle
from tco.pose_options import PoseConfig
from tco.poses import (
    Level,
    NothingSharedError,
    Poses,
    _rendered,
    _State,
    beside,
    overlapping,
    refine,
    rough_priors,
    surfel_share,
)
from tco.toy import wall
from tco.types import Cameras, Views

F64 = torch.float64
SIZES = ((36, 48), (72, 96))
EXACT = {"geometric": 1.0, "independent": 1000.0, "neighbours": 4}
"""Settings for depths without error."""
CONFIG = PoseConfig(sizes=(48, 96), iterations=(12, 6), **EXACT)


def corner(size: tuple[int, int], poses: Tensor) -> Level:
    """What views see of the inside of a box with a block on its floor: exact depths, waves for colours.

    Planes x = ±1.5, y = 1, y = −1.2, z = 3 and a sphere of radius 0.6 at (0.4, 0.4, 2.2), so that all
    motions show.
    """
    h, w = size
    K = torch.tensor([[0.9 * w, 0, w / 2], [0, 0.9 * w, h / 2], [0, 0, 1]], dtype=F64).repeat(
        len(poses), 1, 1
    )
    local = rays(pixel_grid(h, w, K).reshape(1, -1, 2), K)
    way = local @ poses[:, :3, :3].transpose(1, 2)
    centre = poses[:, None, :3, 3]
    depths = []
    for axis, place in ((0, 1.5), (0, -1.5), (1, 1.0), (1, -1.2), (2, 3.0)):
        z = (place - centre[..., axis]) / way[..., axis]
        depths.append(torch.where(z > 0, z, torch.inf))
    offset = centre - torch.tensor([0.4, 0.4, 2.2], dtype=F64)
    a, b = (way * way).sum(-1), (way * offset).sum(-1)
    root = b * b - a * ((offset * offset).sum(-1) - 0.36)
    depths.append(torch.where(root > 0, (-b - root.clamp_min(0).sqrt()) / a, torch.inf))
    depth = torch.stack(depths).amin(0)
    points = centre + depth.unsqueeze(-1) * way
    color = 0.5 + 0.2 * torch.sin(6 * points) + 0.2 * torch.sin(3.1 * points.roll(1, -1) + 1)
    images = color.transpose(1, 2).reshape(len(poses), 3, h, w).float()
    views = Views(images, torch.ones(len(poses), h, w).bool(), tuple(f"{i}" for i in range(len(poses))))
    return Level(views, K.float(), depth.reshape(len(poses), h, w).float())


def arc(views: int = 5) -> Tensor:
    """Exact poses (V, 4, 4) on an arc."""
    step = torch.linspace(-1, 1, views, dtype=F64).unsqueeze(-1)
    turn = so3_exp(step * torch.tensor([0.05, -0.15, 0.03], dtype=F64))
    bend = torch.cat([0.4 * step, 0.1 * step**2, 0.1 * step.cos()], 1)
    return rigid(turn, bend)


def perturbed(poses: Tensor, seed: int = 0, degrees: float = 3.0, share: float = 0.05) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    axis, way = torch.nn.functional.normalize(torch.randn(2, len(poses), 3, generator=g, dtype=F64), dim=-1)
    centre = poses[:, :3, 3]
    unit = (centre - centre.mean(0)).norm(dim=-1).mean()
    return rigid(poses[:, :3, :3] @ so3_exp(math.radians(degrees) * axis), centre + share * unit * way)


def errors(found: Tensor, exact: Tensor) -> tuple[float, float]:
    """Largest relative rotation (degrees) and centre, relative to the first view."""
    ours, theirs = in_first_view(found), in_first_view(exact)
    angle = torch.rad2deg(rotation_angle(ours[:, :3, :3], theirs[:, :3, :3])).max()
    return float(angle), float((ours[:, :3, 3] - theirs[:, :3, 3]).norm(dim=-1).max())


@pytest.fixture(scope="module")
def levels() -> list[Level]:
    return [corner(size, arc()) for size in SIZES]


@pytest.fixture(scope="module")
def found(levels: list[Level]) -> Poses:
    return refine(levels, perturbed(arc()), CONFIG)


def test_three_degrees_and_five_per_cent_come_back(found: Poses) -> None:
    """From 5.6° and 33 mm between views to less than a fifth and two thirds of it in 18 steps."""
    before, after = errors(perturbed(arc()), arc()), errors(found.cameras.world_from_cam, arc())
    assert before[0] > 3 and before[1] > 0.02
    assert after[0] < before[0] / 5
    assert after[1] < before[1] / 1.5
    assert all(found.moved)


def test_true_poses_stay(levels: list[Level]) -> None:
    """Where they are to a twentieth of a degree and 3 mm: far less than a pixel."""
    done = refine(levels[1:], arc(), PoseConfig(sizes=(96,), iterations=(4,), **EXACT))
    angle, centre = errors(done.cameras.world_from_cam, arc())
    assert angle < 0.08 and centre < 0.005


def test_depths_alone_are_enough_where_surfaces_show_all_motions(levels: list[Level]) -> None:
    config = PoseConfig(sizes=(48, 96), iterations=(12, 6), photometric=0.0, **EXACT)
    done = refine(levels, perturbed(arc()), config)
    assert set(done.history[0]) == {"size", "geometric", "step"}
    assert errors(done.cameras.world_from_cam, arc())[0] < errors(perturbed(arc()), arc())[0] / 3


def test_the_world_of_the_rough_poses_is_kept_and_does_not_matter(levels: list[Level], found: Poses) -> None:
    """Rough poses in another world give the same poses in that world; the mean centre stays."""
    move = rigid(
        so3_exp(torch.tensor([0.4, -0.2, 1.0], dtype=F64)), torch.tensor([5.0, -3.0, 2.0], dtype=F64)
    )
    rough = perturbed(arc())
    other = refine(levels, move @ rough, CONFIG)
    torch.testing.assert_close(
        invert(move) @ other.cameras.world_from_cam, found.cameras.world_from_cam, atol=2e-3, rtol=0
    )
    mean = found.cameras.world_from_cam[:, :3, 3].mean(0)
    torch.testing.assert_close(mean, rough[:, :3, 3].mean(0), atol=1e-9, rtol=0)


def test_an_unknown_scale_is_found(levels: list[Level]) -> None:
    rough = perturbed(arc(), degrees=1.0)
    rough[:, :3, 3] *= 0.75
    done = refine(levels, rough, CONFIG, free_scale=True)
    assert done.scale == pytest.approx(1 / 0.75, rel=0.05)
    held = refine(levels, rough, CONFIG)
    assert held.scale == 1.0


def test_a_focal_length_is_found(levels: list[Level]) -> None:
    """All focal lengths 3 % too long."""
    wrong = []
    for level in levels:
        K = level.K.clone()
        K[:, [0, 1], [0, 1]] *= 1.03
        wrong.append(Level(level.views, K, level.depth))
    config = PoseConfig(sizes=(48, 96), iterations=(12, 6), rough_focal=0.03, **EXACT)
    done = refine(wrong, perturbed(arc(), degrees=1.0), config)
    assert 1 / 1.03 - 0.008 < done.focal < 0.99
    assert refine(wrong, arc(), PoseConfig(sizes=(48, 96), iterations=(1, 1))).focal == 1.0


def test_a_view_without_depth_stays_where_it_was(levels: list[Level]) -> None:
    rough = perturbed(arc())
    blind = [Level(lv.views, lv.K, lv.depth.clone()) for lv in levels]
    for level in blind:
        level.depth[2] = 0
    done = refine(blind[:1], rough, PoseConfig(sizes=(48,), iterations=(3,), neighbours=4))
    assert done.moved == (True, True, False, True, True)
    torch.testing.assert_close(done.cameras.world_from_cam[2], rough[2], atol=1e-10, rtol=0)
    assert errors(done.cameras.world_from_cam[[0, 1, 3, 4]], arc()[[0, 1, 3, 4]])[0] < 3


def test_noise_and_holes_leave_it_near(levels: list[Level]) -> None:
    """1 % of noise and a third of the depths missing in blocks."""
    g = torch.Generator().manual_seed(5)
    noisy = []
    for level in levels:
        v, h, w = level.depth.shape
        holes = torch.rand(v, h // 12, w // 12, generator=g) < 0.33
        holes = holes.repeat_interleave(12, 1).repeat_interleave(12, 2)
        depth = level.depth * (1 + 0.01 * torch.randn(v, h, w, generator=g))
        noisy.append(Level(level.views, level.K, torch.where(holes, 0.0, depth)))
    done = refine(noisy, perturbed(arc()), CONFIG)
    assert errors(done.cameras.world_from_cam, arc())[0] < errors(perturbed(arc()), arc())[0] / 3


@pytest.mark.parametrize("name", ["geometric", "photometric"])
def test_derivatives_are_those_of_the_renderer(name: str) -> None:
    """Every column against central differences of rendered depth and colour, source and target moved."""
    scene = wall(3, (96, 128), slope=0.5)
    assert scene.priors.cameras is not None
    level = Level(scene.views, scene.priors.cameras.K, scene.depth)
    poses = scene.priors.cameras.world_from_cam.double()
    priors = rough_priors(Cameras(poses, level.K.double()), PoseConfig(rough_focal=0.01))

    def pair_at(change: Tensor) -> Pair:
        state = _State(priors, True)
        state.add(change)
        return _rendered(level, state.cameras(level), 0, [2])[0]

    def values(pair: Pair) -> Tensor:
        return pair.depth.double().log() if name == "geometric" else pair.color.double().mean(-1)

    none = torch.zeros(3 * 6 + 2, dtype=F64)
    base = pair_at(none)
    seen = torch.ones_like(base.drawn)
    shown = base.depth if name == "geometric" else base.color.mean(-1)
    # The picture is the rendering itself, so that gain and bias are 1 and 0.
    picture = base.color.permute(2, 0, 1)
    linear = base.geometric(level.depth[2], seen) if name == "geometric" else base.photometric(picture, seen)
    steepest = 0.2 * base.depth if name == "geometric" else torch.full_like(shown, torch.inf)
    keep = _slopes(shown, base.drawn, steepest)[1]
    jacobian, where = _State(priors, True).columns(0, 2, linear.jacobian)
    largest = float(jacobian[:, :12].norm(dim=0).max())
    for column, place in enumerate(where.tolist()):
        change = none.clone()
        change[place] = 0.05
        numeric = ((values(pair_at(change)) - values(pair_at(-change))) / 0.1)[keep]
        assert float((numeric - jacobian[:, column]).norm()) < 0.1 * float(numeric.norm()) + 0.005 * largest


def test_overlap_prefers_what_is_near_and_skips_what_is_not_seen(levels: list[Level]) -> None:
    chosen = overlapping(levels[0], arc(), PoseConfig(neighbours=2))
    assert all(view not in targets and len(set(targets)) == 2 for view, targets in enumerate(chosen))
    assert 1 in chosen[0] and 3 in chosen[4]
    away = arc()
    away[:, :3, 3] += torch.arange(5, dtype=F64).unsqueeze(-1) * torch.tensor([50.0, 0, 0], dtype=F64)
    with pytest.raises(NothingSharedError, match="20 %"):
        overlapping(levels[0], away, PoseConfig())


def test_the_rigid_motion_that_is_left_over_is_taken_out() -> None:
    move = rigid(so3_exp(torch.tensor([0.1, 0.2, -0.3], dtype=F64)), torch.ones(3, dtype=F64))
    every = torch.ones(5).bool()
    torch.testing.assert_close(beside(move @ arc(), arc(), every), arc(), atol=1e-12, rtol=0)


def test_few_measured_pixels_have_neighbours() -> None:
    level = corner((36, 48), arc(2))
    assert surfel_share(level) == 1.0
    sparse = torch.zeros_like(level.depth)
    sparse[:, ::2, ::2] = level.depth[:, ::2, ::2]
    assert surfel_share(Level(level.views, level.K, sparse)) == 0.0


def test_what_cannot_be_refined_is_an_error(levels: list[Level]) -> None:
    with pytest.raises(ValueError, match="2 sizes are wanted, and 1 given"):
        refine(levels[:1], arc(), CONFIG)
    same = arc().clone()
    same[:, :3, 3] = 0
    with pytest.raises(ValueError, match="all coincide"):
        refine(levels, same, CONFIG)
    with pytest.raises(ValueError, match="at least two"):
        rough_priors(Cameras(arc(1), levels[0].K[:1].double()), CONFIG)
    with pytest.raises(ValueError, match="above 0"):
        PoseConfig(geometric=0.0, photometric=0.0)
    with pytest.raises(ValueError, match="as many"):
        PoseConfig(sizes=(48,))
