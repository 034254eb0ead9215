"""Directions at right angles: found in a room, not where there are none, and what follows from them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.consensus import Agreement
from tco.geometry import pixel_grid, rays, rigid, so3_exp
from tco.hints import further_points
from tco.options import ConsensusConfig, TCOConfig
from tco.planar.fit import ALIKE, find, refit
from tco.planar.frame import Frame, by_edges, by_normals, edges, frame_of, turned
from tco.planar.hinges import LEAN, WIDTH, hinged, nearest_along
from tco.planar.label import ASKEW, DOUBTFUL, FREE, KEPT, cost_of_facing, cost_of_keeping
from tco.planar.run import flattened
from tco.planar.view import ERROR, Floats, Plane, Shown, guessed, shown
from tco.types import Cameras, Prediction, Priors, SparseDepth, Views

CONFIG = ConsensusConfig()
SIZE = (120, 160)
FINER = 3
"""Pixels are means of so many by so many."""
FRONT = 3.0
"""Distance of the cupboard's front from the first camera's centre, along the axis that faces it."""


@dataclass(frozen=True)
class Room:
    """Views of a room: floor, two walls and a cupboard, the depth of whose front nobody knows.

    Attributes:
        views, cameras, depth: as of :class:`tco.toy.Wall`.
        front: (V, H, W) where the cupboard's front is.
        axes: (3, 3) the room's directions, rows: to the right, down and ahead.
    """

    views: Views
    cameras: Cameras
    depth: Tensor
    front: Tensor
    axes: Floats

    def guess(self) -> Tensor:
        """The depths with a front that leans out of the room's directions, by a third at its lower edge."""
        depth = self.depth.clone()
        for i, j in torch.nonzero(self.front.any(1)).tolist():
            rows = torch.nonzero(self.front[i, :, j]).squeeze(1)
            depth[i, rows, j] /= 1 + 0.33 * torch.linspace(0, 1, len(rows))
        return depth

    def agreement(self, depth: Tensor, doubt: float = 0.25) -> Agreement:
        """Depths of relative error 1 %, but ``doubt`` on the front."""
        error = torch.where(self.front, doubt, 0.01)
        prediction = Prediction(depth, 1 + ERROR / error, self.cameras, tuple(range(len(depth))))
        return Agreement(prediction, torch.full_like(depth, 0.01))

    def shown(self, depth: Tensor, doubt: float = 0.25, stride: int = 1) -> list[Shown]:
        prediction = self.agreement(depth, doubt).prediction
        return [shown(prediction, self.cameras, self.views, i, stride) for i in range(len(depth))]


def room(turn: tuple[float, float, float] = (0.3, -0.5, 0.2), views: int = 4, slant: float = 0.0) -> Room:
    """The room, turned as a whole; with ``slant`` (radians) its right wall is no longer at right angles."""
    h, w = (FINER * n for n in SIZE)
    axes = so3_exp(torch.tensor([turn], dtype=torch.float64))[0]
    K = torch.tensor([[0.8 * w, 0, w / 2], [0, 0.8 * w, h / 2], [0, 0, 1]], dtype=torch.float64)
    step = torch.linspace(-1, 1, views, dtype=torch.float64).unsqueeze(-1)
    about = so3_exp(torch.tensor([[-0.27, 0.1, 0.0]]).double() + step * torch.tensor([0.02, -0.08, 0.03]))
    pose = rigid(about, torch.tensor([0.0, -0.7, 0.0]) + step * torch.tensor([0.25, 0.05, 0.04]).double())
    ray = rays(pixel_grid(h, w, K).reshape(1, -1, 2), K.repeat(views, 1, 1)) @ pose[:, :3, :3].mT
    eye = pose[:, None, :3, 3]
    right = (math.cos(slant), 0.0, math.sin(slant))
    surfaces = [  # normal, offset, least and most of (x, y, z), grey
        ((0, 1, 0), 1.0, (-9, -9, -9), (9, 9, 9), 0.45),
        ((0, 0, 1), 4.0, (-9, -9, -9), (9, 9, 9), 0.75),
        (right, 1.9 * right[0] + 4 * right[2], (-9, -9, -9), (9, 9, 9), 0.95),
        ((0, 0, 1), FRONT, (-1.5, 0.0, 0), (0.9, 1, 9), 0.25),
        ((0, 1, 0), 0.0, (-1.5, -9, FRONT), (0.9, 9, 4), 0.1),
        ((1, 0, 0), 0.9, (-9, 0.0, FRONT), (9, 1, 4), 0.35),
    ]
    depth = torch.full((views, h * w), math.inf, dtype=torch.float64)
    which = torch.zeros(views, h * w, dtype=torch.int64)
    for k, (normal, offset, least, most, _) in enumerate(surfaces):
        n = torch.tensor(normal, dtype=torch.float64)
        at = (offset - eye @ n) / (ray @ n)
        x = eye + at.unsqueeze(-1) * ray
        there = ((x > torch.tensor(least) - 1e-9) & (x < torch.tensor(most) + 1e-9)).all(-1)
        there &= (at > 0) & (at < depth)
        depth, which = torch.where(there, at, depth), torch.where(there, k, which)
    grey = torch.tensor([s[-1] for s in surfaces])[which].reshape(views, 1, h, w)
    grey = torch.nn.functional.avg_pool2d(grey, FINER)
    valid = torch.ones(views, *SIZE).bool()
    middle = slice(FINER // 2, None, FINER)
    depth, which = (x.reshape(views, h, w)[:, middle, middle] for x in (depth, which))
    world = rigid(axes.T, torch.zeros(3, dtype=torch.float64)) @ pose
    names = tuple(map(str, range(views)))
    pictures = Views(grey.repeat(1, 3, 1, 1).float(), valid, names)
    K = K / torch.tensor([[FINER], [FINER], [1.0]], dtype=torch.float64)
    cameras = Cameras(world.float(), K.repeat(views, 1, 1).float())
    return Room(pictures, cameras, depth.float(), which == 3, axes.numpy())


@pytest.fixture(scope="module")
def scene() -> Room:
    return room()


def degrees_off(found: Floats, truth: Floats) -> float:
    """The largest angle between an axis and the nearest of the true ones."""
    return float(np.degrees(np.arccos(np.abs(found @ truth.T).max(-1).clip(0, 1))).max())


def sought(room: Room, depth: Tensor) -> Frame | None:
    views = room.shown(depth)
    planes = find(views, len(views), CONFIG, np.random.default_rng(0))
    return frame_of(room.shown(depth, stride=2), planes, [edges(view) for view in views])


def tilted(axes: Floats, degrees: float) -> Floats:
    turn = math.radians(degrees) * torch.tensor([[0.6, -0.64, 0.48]], dtype=torch.float64)
    return np.asarray(so3_exp(turn)[0].numpy() @ axes)


def test_an_edge_and_the_camera_span_a_plane_that_holds_the_edge(scene: Room) -> None:
    """Two halves of a picture: the edge between them is found where it is, along the whole height."""
    view = scene.shown(scene.depth)[1]
    image = np.zeros_like(view.image)
    image[:, 70:] = 0.8
    normal, length = edges(replace(view, image=image))
    best = int(length.argmax())
    assert length[best] > 0.9 * SIZE[0]
    for y in (0, 60, 119):
        beside = view.directions[y, 69] + view.directions[y, 70]
        assert abs(float(normal[best] @ beside)) < 0.01 * np.linalg.norm(beside)


def test_the_rooms_directions_are_found(scene: Room) -> None:
    found = sought(scene, scene.guess())
    assert found is not None
    assert degrees_off(found.axes, scene.axes) < 0.3
    assert np.allclose(found.axes @ found.axes.T, np.eye(3), atol=1e-5)


def test_a_slanted_wall_does_not_turn_them() -> None:
    slanted = room(slant=0.5)
    found = sought(slanted, slanted.depth)
    assert found is not None
    assert degrees_off(found.axes, slanted.axes) < 0.5


def test_without_edges_along_them_there_are_none(scene: Room) -> None:
    views = scene.shown(scene.depth)
    planes = find(views, len(views), CONFIG, np.random.default_rng(0))
    rng = np.random.default_rng(0)
    anywhere = rng.standard_normal((400, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    assert frame_of(views, planes, [(anywhere, np.ones(400))]) is None
    plain = [replace(view, image=np.full_like(view.image, 0.5)) for view in views]
    assert frame_of(views, planes, [edges(view) for view in plain]) is None
    assert frame_of(views, [], [edges(view) for view in views]) is None


def test_normals_that_face_anywhere_have_no_directions(scene: Room) -> None:
    """A ball: the edges of a room, but surfaces of all directions."""
    h, w = SIZE
    y, x = torch.meshgrid(torch.linspace(-0.75, 0.75, h), torch.linspace(-1, 1, w), indexing="ij")
    ball = (2.5 - 1.4 * (1.6 - x**2 - y**2).sqrt()).expand(len(scene.depth), h, w)
    lines = [edges(view) for view in scene.shown(scene.depth)]
    flat = find(scene.shown(scene.depth), len(scene.depth), CONFIG, np.random.default_rng(0))
    assert frame_of(scene.shown(scene.depth), flat, lines) is not None
    assert frame_of(scene.shown(ball), flat, lines) is None


@pytest.mark.parametrize("degrees", [0.0, 8.0])
def test_directions_are_fitted_to_normals(degrees: float) -> None:
    """Ten times as many along one of them as along each of the others, a fifth anywhere."""
    rng, axes = np.random.default_rng(1), room().axes
    rows = np.repeat(axes, [1000, 100, 100], 0) * rng.choice([-1, 1], (1200, 1))
    rows = rows + 0.03 * rng.standard_normal(rows.shape)
    n = np.concatenate([rows, rng.standard_normal((300, 3))])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    found = by_normals(n, np.ones(len(n)), tilted(axes, degrees))
    assert degrees_off(found, axes) < 1.0
    assert np.linalg.det(found) == pytest.approx(1)


def test_a_large_floor_does_not_decide_on_all_three() -> None:
    """A thousand normals of it lean by 3°, a hundred of each wall are exact: the roots of both decide."""
    axes = room().axes
    lean = so3_exp(torch.from_numpy(math.radians(3.0) * axes[1])[None])[0].numpy()
    n = np.concatenate([np.repeat(axes[:1] @ lean.T, 1000, 0), np.repeat(axes[1:], 100, 0)])
    found = by_normals(n, np.ones(len(n)), axes)
    expected = 3 * math.sqrt(1000) / (math.sqrt(1000) + math.sqrt(100))
    assert degrees_off(found, axes) == pytest.approx(expected, rel=0.02)


def test_the_nearest_direction_is_on_the_side_of_the_normal(scene: Room) -> None:
    frame = Frame(scene.axes)
    for k, sign in ((0, 1), (1, -1), (2, 1), (2, -1)):
        normal = sign * tilted(scene.axes, 8)[k]
        assert np.allclose(frame.nearest(normal), sign * scene.axes[k])
        assert 0 < float(frame.astray(normal)) <= 8 + 1e-6


def lines_along(axes: Floats, counts: tuple[int, int, int], seed: int = 2) -> tuple[Floats, Floats]:
    """Normals of planes that hold an axis, to 0.1°, and as many of any; lengths."""
    rng = np.random.default_rng(seed)
    held = np.repeat(axes, counts, 0)
    n = np.cross(held, rng.standard_normal(held.shape)) + 0.0017 * rng.standard_normal(held.shape)
    n = np.concatenate([n / np.linalg.norm(n, axis=1, keepdims=True), rng.standard_normal((len(n), 3))])
    return n / np.linalg.norm(n, axis=1, keepdims=True), rng.uniform(10, 50, len(n))


@pytest.mark.parametrize("angle", [-44.0, -13.0, 0.0, 30.3])
def test_the_others_are_turned_about_the_first_to_where_the_edges_are(angle: float) -> None:
    axes = room().axes
    a = math.radians(angle)
    second = math.cos(a) * axes[1] + math.sin(a) * axes[2]
    start = np.stack([axes[0], second, np.cross(axes[0], second)])
    found = turned(*lines_along(axes, (5, 40, 30)), start)
    assert degrees_off(found, axes) < 0.3
    assert np.allclose(found[0], axes[0])


@pytest.mark.parametrize("counts", [(40, 40, 40), (60, 40, 0)])
def test_directions_are_fitted_to_edges(counts: tuple[int, int, int]) -> None:
    """Two of them are enough; to a small part of how far a single edge is off."""
    axes = room().axes
    found = by_edges(*lines_along(axes, counts), tilted(axes, 1.0))
    assert degrees_off(found, axes) < 0.15
    assert np.allclose(found @ found.T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("ahead", [True, False])
def test_the_nearest_is_looked_up_in_four_directions(axis: int, ahead: bool) -> None:
    there = np.random.default_rng(3).random((9, 11)) < 0.25
    found = nearest_along(there, axis, ahead)
    for y, x in np.ndindex(there.shape):
        line, at = (there[:, x], y) if axis == 0 else (there[y], x)
        hits = [k for k in np.flatnonzero(line) if (k >= at if ahead else k <= at)]
        expected = -1 if not hits else (min(hits) if ahead else max(hits))
        assert found[y, x] == expected


def offsets_along(planes: list[Plane], axis: Floats) -> list[float]:
    return [p.offset * float(np.sign(p.normal @ axis)) for p in planes if abs(p.normal @ axis) > 0.999]


def test_a_plane_is_put_up_at_the_rim_of_what_is_unsure(scene: Room) -> None:
    """The worktop's edge has the front's distance; a plane that is known is not put up again."""
    views, frame = scene.shown(scene.guess(), stride=2), Frame(scene.axes.astype(np.float32))
    planes = hinged(views, frame, [])
    middle = float(torch.tensor(np.median([v.depth for v in views])))
    nearest = min(offsets_along(planes, scene.axes[2]), key=lambda offset: abs(offset - FRONT))
    assert abs(nearest - FRONT) < 2 * WIDTH * middle
    best = next(p for p in planes if p.offset * float(np.sign(p.normal @ scene.axes[2])) == nearest)
    assert best.guess is not None
    assert math.sqrt(best.covariance[0, 0]) == pytest.approx(math.radians(LEAN))
    again = offsets_along(hinged(views, frame, [best]), scene.axes[2])
    assert all(abs(offset - nearest) > WIDTH * middle for offset in again)
    assert hinged(scene.shown(scene.depth, doubt=0.01, stride=2), frame, []) == []


def posterior(scene: Room, error: float, share: float) -> tuple[Plane, Plane, Floats]:
    """A front put up 1 % too far, fitted to the true depths of so large a share of its pixels."""
    views = scene.shown(scene.depth, doubt=error)
    axis = scene.axes[2].astype(np.float32)
    centre = np.mean([v.points[f].mean(0) for v, f in zip(views, scene.front.numpy(), strict=True)], 0)
    centre = centre + (1.01 * FRONT - centre @ axis) * axis
    guess = guessed(axis, 1.01 * FRONT, centre, LEAN, 0.02)
    keep = np.random.default_rng(0).random(scene.front.shape) < share
    labels = [np.where(f & k, 1, 0) for f, k in zip(scene.front.numpy(), keep, strict=True)]
    config = replace(CONFIG, plane_share=1e-6)
    fitted = refit(views, labels, [replace(guess, guess=guess)], config)[0]
    across, at = [], []
    for view, label in zip(views, labels, strict=True):
        on = label == 1
        across.append((view.depth * np.abs(view.directions @ axis))[on])
        at.append(np.concatenate([(view.points[on] - centre) @ guess.axes.T, np.ones((on.sum(), 1))], -1))
    information = 1 / (ALIKE * SIZE[0] * SIZE[1]) / (error * np.concatenate(across)) ** 2
    rows = np.concatenate(at)
    precision = rows.T @ (information[:, None] * rows) + np.linalg.inv(guess.covariance)
    return guess, fitted, np.linalg.inv(precision)


def test_a_plane_that_was_put_up_moves_as_far_as_its_pixels_are_sure(scene: Room) -> None:
    """Sure pixels take it to where they are; few unsure ones leave it; between, by the inverse variances."""
    _, sure, _ = posterior(scene, 0.01, 1.0)
    assert sure.offset == pytest.approx(FRONT, rel=1e-3)
    guess, unsure, _ = posterior(scene, 0.5, 0.02)
    assert unsure.offset == pytest.approx(guess.offset, rel=1e-3)
    _, between, covariance = posterior(scene, 0.2, 0.2)
    assert np.allclose(between.covariance, covariance, rtol=0.05)
    part = covariance[2, 2] / guess.covariance[2, 2]
    moved = (between.offset - FRONT) / (guess.offset - FRONT)
    assert 0.05 < moved < 0.95 and abs(moved - part) < 0.1


def test_planes_nearly_along_a_direction_are_expected_to_be(scene: Room) -> None:
    """Three degrees off, and hardly sure: back to the direction; sure, or far from all of them: as fitted."""
    views, frame = scene.shown(scene.depth, doubt=0.6), Frame(scene.axes.astype(np.float32))
    labels = [np.where(front, 1, 0) for front in scene.front.numpy()]
    few = [np.where(np.random.default_rng(4).random(x.shape) < 0.03, x, 0) for x in labels]
    depth = scene.depth * (1 + 0.05 * torch.linspace(-1, 1, SIZE[1]))
    leaning = scene.shown(depth, doubt=0.4)
    config = replace(CONFIG, plane_share=1e-6)
    start = guessed(scene.axes[2].astype(np.float32), FRONT, FRONT * scene.axes[2], 1.0, 0.1)
    free, pulled = (refit(leaning, few, [start], config, f)[0] for f in (None, frame))
    assert 3 < float(frame.astray(free.normal)) < 9
    assert float(frame.astray(pulled.normal)) < 0.5
    sure = refit(scene.shown(depth, doubt=0.01), labels, [start], config, frame)[0]
    assert float(frame.astray(sure.normal)) > 2
    elsewhere = Frame(tilted(scene.axes, 20).astype(np.float32))
    same = refit(views, labels, [start], config, elsewhere)[0]
    assert np.allclose(same.normal, refit(views, labels, [start], config)[0].normal)


def test_a_plane_costs_by_its_angle(scene: Room) -> None:
    frame = Frame(scene.axes.astype(np.float32))

    def cost(degrees: float) -> float:
        a = math.radians(degrees)
        normal = (math.cos(a) * scene.axes[1] - math.sin(a) * scene.axes[0]).astype(np.float32)
        return cost_of_facing(guessed(normal, 1.0, normal, 1.0, 0.1), frame, CONFIG)

    assert cost(FREE - 1) == 0
    assert cost(FREE + ASKEW) == pytest.approx(CONFIG.plane_square / 2, rel=1e-3)
    assert cost(20) < cost(40) < CONFIG.plane_square


def test_unsure_slanted_depths_cost_and_others_do_not(scene: Room) -> None:
    along, elsewhere = (Frame(x.astype(np.float32)) for x in (scene.axes, tilted(scene.axes, 45)))
    front = scene.front[1].numpy()
    inside = front & np.roll(front, 8, 0) & np.roll(front, -8, 0)
    upright = scene.shown(scene.depth, doubt=DOUBTFUL)[1]
    slanted = cost_of_keeping(upright, elsewhere, CONFIG)
    assert np.median(slanted[inside]) == pytest.approx(KEPT * CONFIG.plane_square / 2, rel=1e-3)
    assert np.median(cost_of_keeping(upright, along, CONFIG)[inside]) == 0
    ramp = cost_of_keeping(scene.shown(scene.guess(), doubt=DOUBTFUL)[1], along, CONFIG)
    assert np.median(ramp[inside]) > 0.9 * np.median(slanted[inside])
    sure = cost_of_keeping(scene.shown(scene.depth, doubt=0.01)[1], elsewhere, CONFIG)
    assert 0 < sure.max() < 0.02 * KEPT * CONFIG.plane_square


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.3, -0.5, 0.2), (-1.0, 2.0, 0.5)])
def test_a_plain_front_stands_upright(turn: tuple[float, float, float]) -> None:
    """It no longer leans, in whatever direction the world's axes are; without directions it goes on to."""
    turned_room = room(turn)
    given = turned_room.agreement(turned_room.guess(), doubt=0.4)

    def right(config: ConsensusConfig) -> float:
        flat = flattened(given, turned_room.cameras, turned_room.views, config)
        off = (flat.agreement.prediction.depth / turned_room.depth - 1).abs()
        return float((off < 0.05)[turned_room.front].float().mean())

    before = (given.prediction.depth / turned_room.depth - 1).abs()[turned_room.front]
    assert float((before < 0.05).float().mean()) < 0.5
    assert right(replace(CONFIG, plane_square=3.0)) > 0.9
    assert right(replace(CONFIG, plane_square=0.0)) < 0.6


def test_planes_are_known_by_whether_they_face_along_a_direction() -> None:
    """The right wall is slanted by 20°, the others are not; without directions none does."""
    slanted = room(slant=math.radians(-20))
    given = slanted.agreement(slanted.depth)
    flat = flattened(given, slanted.cameras, slanted.views, CONFIG)
    astray = [degrees_off(plane.normal[None], slanted.axes) for plane in flat.planes]
    assert flat.square == tuple(degrees < 10 for degrees in astray)
    assert set(flat.square) == {False, True}
    on = flat.labels > 0
    assert torch.equal(flat.error.isfinite(), on)
    assert float(flat.error[on].median()) < 0.005
    none = flattened(given, slanted.cameras, slanted.views, replace(CONFIG, plane_square=0.0))
    assert len(none.planes) > 1 and not any(none.square)


@pytest.mark.parametrize("square", [0.0, 3.0])
def test_the_network_is_told_where_the_plain_front_is(scene: Room, square: float) -> None:
    """It is unsure of the front, which leans: it is told of pixels there only on a plane at right angles."""
    count = len(scene.depth)
    nothing = SparseDepth(*(torch.zeros(shape) for shape in ((0, 2), 0, 0)), torch.zeros(0).long())
    priors = Priors(scene.cameras, (nothing,) * count, overlap=9.0 * (1 - torch.eye(count)))
    config = TCOConfig(consensus=replace(CONFIG, plane_square=square))
    prediction = scene.agreement(scene.guess(), doubt=0.4).prediction
    depths, right = 0, 0
    for i, points in further_points(prediction, scene.views, priors, config).items():
        columns, rows = points.xy.long().unbind(1)
        there = scene.front[i, rows, columns]
        off = (points.depth / scene.depth[i, rows, columns] - 1).abs()[there]
        depths, right = depths + len(off), right + int((off < 0.05).sum())
    if square:
        assert depths > 100 and right > 0.9 * depths
    else:
        assert depths == 0
