"""What the views agree on as further points: which pixels these are, and what the network is told."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from tco.backbones.sweep import Encoded, Sweep
from tco.backbones.weights import load_sweep
from tco.consensus import Agreement
from tco.geometry import project
from tco.hints import (
    LEAST,
    UNTRACKED,
    agreed_points,
    as_planes_are,
    further_points,
    joined,
    reduced,
    spread,
    told,
    with_more,
)
from tco.optimize import optimize
from tco.options import ConsensusConfig, HintsConfig, TCOConfig
from tco.planar.run import OnPlanes
from tco.toy import Toy, Wall, wall
from tco.types import Prediction, Priors, SparseDepth, Views

PLAIN = TCOConfig(steps=0)


@pytest.fixture
def few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many views as the rendered scene has are enough."""
    monkeypatch.setattr("tco.hints.FEWEST_VIEWS", 5)


def hints(**changes: float) -> TCOConfig:
    return replace(PLAIN, hints=replace(HintsConfig(), **changes))


@pytest.fixture(scope="module")
def scene() -> Wall:
    return wall(4, (48, 64))


@pytest.fixture(scope="module")
def network() -> Sweep:
    return load_sweep()


@pytest.fixture(scope="module")
def encoded(network: Sweep, rendered: tuple[Views, Priors, Tensor]) -> Encoded:
    with torch.no_grad():
        return network.encode(*rendered[:2])


def agreement(scene: Wall, error: Tensor | float = 0.005, confidence: Tensor | float = 5.0) -> Agreement:
    assert scene.priors.cameras is not None
    every = torch.ones_like(scene.depth)
    views = tuple(range(len(every)))
    prediction = Prediction(scene.depth, every * confidence, scene.priors.cameras, views)
    return Agreement(prediction, every * error)


def given(scene: Wall, keep: int = 5) -> list[SparseDepth]:
    assert scene.priors.sparse is not None
    return [points[torch.arange(keep)] for points in scene.priors.sparse]


def pixels(points: SparseDepth) -> tuple[Tensor, Tensor]:
    """Rows and columns of points that are in the middle of a pixel."""
    assert torch.equal(points.xy % 1, torch.full_like(points.xy, 0.5))
    return points.xy[:, 1].long(), points.xy[:, 0].long()


def test_points_are_pixels_with_their_depths(scene: Wall) -> None:
    found = agreed_points(agreement(scene), scene.views, given(scene), hints(hint_points=50))
    assert list(found) == [0, 1, 2, 3]
    for i, points in found.items():
        rows, columns = pixels(points)
        assert len(points) == 50 and len(set(zip(rows.tolist(), columns.tolist(), strict=True))) == 50
        assert torch.equal(points.depth, scene.depth[i, rows, columns])
        assert torch.allclose(points.sigma, torch.tensor(0.005))
        assert (points.track == UNTRACKED).all()


def test_only_what_is_known_well_counts(scene: Wall) -> None:
    """Error, confidence, validity and depth decide, each in a quarter of the picture of its own."""
    error, confidence = torch.full((4, 48, 64), 0.005), torch.full((4, 48, 64), 5.0)
    error[:, :, :16], confidence[:, :, 16:32] = 0.02, 1.2
    valid = scene.views.valid.clone()
    valid[:, :, 32:40] = False
    what = agreement(scene, error, confidence)
    depth = what.prediction.depth.clone()
    depth[:, :, 40:44], depth[:, :, 44:48] = -1.0, float("nan")
    what = replace(what, prediction=replace(what.prediction, depth=depth))
    views = replace(scene.views, valid=valid)
    config = hints(hint_points=10_000, hint_error=0.01, hint_confidence=1.3, hint_distance=0.0)
    found = agreed_points(what, views, given(scene), config)
    assert list(found) == [0, 1, 2, 3]
    for points in found.values():
        assert len(points) == 48 * 16 and int(pixels(points)[1].min()) == 48


def test_on_a_plane_its_own_error_counts_and_if_it_is_square_no_confidence(scene: Wall) -> None:
    """Views 2 % apart and a network that is unsure; a plane known to 0.4 %, over half of the pixels."""
    labels = torch.zeros(4, 48, 64, dtype=torch.int64)
    labels[:, :, :16], labels[:, :, 16:32] = 1, 2
    of_plane = torch.full((4, 48, 64), torch.inf).masked_fill(labels > 0, 0.004)
    apart = agreement(scene, 0.02, 1.1)
    flat = OnPlanes(apart, apart, (), labels, of_plane, (False, True))
    config = hints(hint_points=10_000, hint_error=0.01, hint_confidence=1.3, hint_distance=0.0)
    assert agreed_points(apart, scene.views, given(scene), config) == {}
    found = agreed_points(as_planes_are(flat), scene.views, given(scene), config)
    assert list(found) == [0, 1, 2, 3]
    for points in found.values():
        columns = pixels(points)[1]
        assert len(points) == 48 * 16 and int(columns.min()) == 16 and int(columns.max()) == 31
        assert torch.allclose(points.sigma, torch.tensor(0.004))
    sure = agreement(scene, 0.02, 2.0)
    flat = OnPlanes(sure, sure, (), labels, of_plane, (False, True))
    found = agreed_points(as_planes_are(flat), scene.views, given(scene), config)
    assert list(found) == [0, 1, 2, 3]
    for points in found.values():
        assert len(points) == 48 * 32 and int(pixels(points)[1].max()) == 31
    assert torch.equal(apart.prediction.confidence, torch.full((4, 48, 64), 1.1))


def test_errors_have_a_floor(scene: Wall) -> None:
    found = agreed_points(agreement(scene, 1e-6), scene.views, given(scene), PLAIN)
    assert list(found) == [0, 1, 2, 3]
    for points in found.values():
        assert torch.allclose(points.sigma, torch.tensor(LEAST))


@pytest.mark.parametrize("distance", [0.05, 0.2])
def test_points_keep_their_distance_from_colmaps(scene: Wall, distance: float) -> None:
    config, known = hints(hint_points=10_000, hint_distance=distance), given(scene)
    far = distance * 64
    found = agreed_points(agreement(scene), scene.views, known, config)
    assert list(found) == [0, 1, 2, 3]
    for i, points in found.items():
        place = known[i].xy.floor() + 0.5
        assert float(torch.cdist(points.xy, place).min()) >= far - 1e-4
        rows, columns = torch.meshgrid(torch.arange(48), torch.arange(64), indexing="ij")
        every = torch.stack([columns.flatten(), rows.flatten()], 1) + 0.5
        assert len(points) == int((torch.cdist(every, place).amin(1) >= far - 1e-4).sum())


def test_a_view_without_points_is_told_of_everywhere(scene: Wall) -> None:
    known = [points[torch.arange(0)] for points in given(scene)]
    config = hints(hint_points=10_000)
    assert len(agreed_points(agreement(scene), scene.views, known, config)[0]) == 48 * 64


def test_the_seed_draws_them(scene: Wall) -> None:
    def drawn(seed: int) -> Tensor:
        return agreed_points(agreement(scene), scene.views, given(scene), PLAIN, seed)[2].xy

    assert torch.equal(drawn(3), drawn(3)) and not torch.equal(drawn(3), drawn(4))


def test_points_are_spread_over_the_picture(scene: Wall) -> None:
    """One of each of 6 × 8 squares of 8 pixels; two of each if only half of the squares may be taken."""
    for columns, times in ((64, 1), (32, 2)):
        counts, turn = torch.zeros(48, 64, dtype=torch.bool), torch.rand(48, 64)
        counts[:, :columns] = True
        taken = torch.zeros(48 * 64).scatter_(0, spread(counts, 48, turn), 1.0).reshape(6, 8, 8, 8)
        assert (taken.sum((1, 3))[:, : columns // 8] == times).all() and int(taken.sum()) == 48
        least = turn.reshape(6, 8, 8, 8).amin((1, 3))[:, : columns // 8]
        assert (turn[taken.reshape(48, 64) > 0][:, None] == least.flatten()).any(0).all()
    assert len(spread(counts, 10_000, turn)) == 48 * 32 and len(spread(counts & False, 5, turn)) == 0
    odd = spread(torch.ones(7, 5, dtype=torch.bool), 3, torch.rand(7, 5))
    assert len(set(odd.tolist())) == 3 and int(odd.min()) >= 0 and int(odd.max()) < 35


def test_a_pixel_fewer_changes_one_point(scene: Wall) -> None:
    """Whichever others count, a pixel has its turn; so last bits, too, change little of what is told."""

    def drawn(valid: Tensor) -> list[set[tuple[float, ...]]]:
        found = agreed_points(agreement(scene), replace(scene.views, valid=valid), given(scene), PLAIN)
        return [set(map(tuple, points.xy.tolist())) for points in found.values()]

    valid = scene.views.valid.clone()
    before = drawn(valid)
    x, y = next(iter(before[1]))
    valid[1, int(y), int(x)] = False
    after = drawn(valid)
    assert before[1] - after[1] == {(x, y)} and len(after[1] - before[1]) == 1
    assert [before[i] for i in (0, 2, 3)] == [after[i] for i in (0, 2, 3)]


def test_views_that_help_are_not_told(scene: Wall) -> None:
    views = replace(scene.views, helpers=2)
    assert list(agreed_points(agreement(scene), views, given(scene), PLAIN)) == [0, 1]


def test_nothing_agreed_is_no_point(scene: Wall) -> None:
    nothing = agreement(scene, float("inf"))
    assert agreed_points(nothing, scene.views, given(scene), PLAIN) == {}


def test_joined_has_all_of_both(scene: Wall) -> None:
    one, other = given(scene)[0], given(scene, 3)[1]
    both = joined(one, other)
    assert torch.equal(both.xy, torch.cat([one.xy, other.xy])) and len(both) == 8
    assert torch.equal(both[torch.arange(5)].depth, one.depth)
    assert torch.equal(both[torch.arange(5, 8)].track, other.track)


@pytest.mark.usefixtures("few_views")
def test_the_network_is_told_of_what_is_right(network: Sweep, rendered: tuple[Views, Priors, Tensor]) -> None:
    views, priors, truth = rendered
    assert priors.sparse is not None
    few = replace(priors, sparse=tuple(points[::8] for points in priors.sparse))
    with torch.no_grad():
        start = network.encode(views, few)
    now, said, points = told(network, start, views, few, PLAIN)
    assert sum(map(len, points.values())) > 200
    pairs = [(p.depth, truth[i][p.xy[:, 1].long(), p.xy[:, 0].long()]) for i, p in points.items()]
    depth, true = (torch.cat(part) for part in zip(*pairs, strict=True))
    error = (depth / true - 1).abs()[true > 0]
    assert float((error < 0.02).float().mean()) > 0.8
    with torch.no_grad():
        again = network.decode(with_more(network, start, few.sparse or (), points))
        assert torch.equal(again.depth, network.decode(now).depth)
        assert said is not None and torch.equal(said.depth, network.draft(start).depth)


@pytest.mark.usefixtures("few_views")
def test_no_round_is_the_network_alone(
    network: Sweep, encoded: Encoded, rendered: tuple[Views, Priors, Tensor]
) -> None:
    now, said, points = told(network, encoded, *rendered[:2], hints(hint_rounds=0))
    assert now is encoded and points == {} and said is None


def test_few_views_are_not_asked_to_be_told(
    network: Sweep, encoded: Encoded, rendered: tuple[Views, Priors, Tensor]
) -> None:
    assert len(rendered[0]) == 5
    now, said, points = told(network, encoded, *rendered[:2], PLAIN)
    assert now is encoded and points == {} and said is None


@pytest.mark.usefixtures("few_views")
def test_nobody_to_agree_with_is_the_network_alone(
    network: Sweep, encoded: Encoded, rendered: tuple[Views, Priors, Tensor]
) -> None:
    config = replace(PLAIN, consensus=ConsensusConfig(consensus_rounds=0))
    now, said, points = told(network, encoded, *rendered[:2], config)
    assert now is encoded and points == {} and said is not None


@pytest.mark.usefixtures("few_views")
def test_uncertain_cameras_are_the_network_alone_without_a_word(
    network: Sweep, encoded: Encoded, rendered: tuple[Views, Priors, Tensor], caplog: pytest.LogCaptureFixture
) -> None:
    """The consensus after the optimisation says it once."""
    views, priors, _ = rendered
    unsure = replace(priors, rotation_sigma=torch.full((len(views),), 0.1))
    now, said, points = told(network, encoded, views, unsure, PLAIN)
    assert now is encoded and points == {} and said is None and not caplog.records


def test_a_network_that_takes_no_points_is_asked_once(scene: Wall) -> None:
    class Counting(Toy):
        decoded = 0

        def decode(self, *args: object, **kwargs: object) -> Prediction:
            self.decoded += 1
            return super().decode(*args, **kwargs)  # type: ignore[arg-type]

    toy = Counting()
    features = toy.encode(scene.views, scene.priors)
    now, _, points = told(toy, features, scene.views, scene.priors, PLAIN)
    assert now is features and points == {} and toy.decoded == 0
    optimize(toy, scene.views, scene.priors, replace(PLAIN, steps=0))
    assert toy.decoded == 1


@pytest.mark.usefixtures("few_views")
def test_a_round_that_finds_nothing_keeps_what_the_one_before_found(
    network: Sweep, encoded: Encoded, rendered: tuple[Views, Priors, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    once = told(network, encoded, *rendered[:2], PLAIN)
    asked: list[Agreement] = []

    def first_time_alone(what: Agreement, *args: Any) -> dict[int, SparseDepth]:
        asked.append(what)
        return agreed_points(what, *args) if len(asked) == 1 else {}

    monkeypatch.setattr("tco.hints.agreed_points", first_time_alone)
    now, said, points = told(network, encoded, *rendered[:2], hints(hint_rounds=2))
    assert len(asked) == 2 and points.keys() == once[2].keys()
    with torch.no_grad():
        second = network.decode(once[0])
        assert said is not None and torch.equal(said.depth, second.depth)
        assert torch.equal(network.decode(now).depth, second.depth)


@pytest.mark.usefixtures("few_views")
def test_helpers_are_not_told_of(
    network: Sweep, encoded: Encoded, rendered: tuple[Views, Priors, Tensor]
) -> None:
    views, priors, _ = rendered
    now, _, points = told(network, encoded, replace(views, helpers=2), priors, PLAIN)
    assert set(points) <= {0, 1, 2} and points
    assert torch.equal(now.hints[0].nearest[3:], encoded.hints[0].nearest[3:])
    assert not torch.equal(now.hints[0].nearest[:3], encoded.hints[0].nearest[:3])


def test_a_draft_is_what_the_network_says_at_half_the_resolution(
    network: Sweep, encoded: Encoded, rendered: tuple[Views, Priors, Tensor]
) -> None:
    """Its depths are about those of the whole, and its cameras put points at half of their coordinates."""
    views = rendered[0]
    with torch.no_grad():
        draft, whole = network.draft(encoded), network.decode(encoded)
    h, w = views.size
    assert draft.depth.shape == draft.confidence.shape == (len(views), h // 2, w // 2)
    pooled = 1 / F.avg_pool2d(1 / whole.depth, 2)
    assert float((draft.depth / pooled).log().abs().median()) < 0.01
    points = torch.tensor([[0.3, -0.2, 2.0], [-0.4, 0.1, 1.5]]).expand(len(views), 2, 3)
    halves, places = (project(points, p.cameras.K)[0] for p in (draft, whole))
    torch.testing.assert_close(halves, places / 2)
    assert torch.equal(draft.cameras.world_from_cam, whole.cameras.world_from_cam)
    assert len(draft.stages) == len(whole.stages) > 0
    assert all(torch.equal(a, b) for a, b in zip(draft.stages, whole.stages, strict=True))


def test_points_of_a_draft_are_where_they_are_in_the_whole(
    network: Sweep, encoded: Encoded, rendered: tuple[Views, Priors, Tensor]
) -> None:
    """In the middle of two by two pixels, with the depth there, and no nearer to COLMAP's than allowed."""
    views, priors, truth = rendered
    assert priors.sparse is not None
    config = hints(hint_points=500, hint_distance=0.1)
    with torch.no_grad():
        found = further_points(network.draft(encoded), views, priors, config)
    assert found
    far = 0.1 * max(views.size)
    for i, points in found.items():
        assert torch.equal(points.xy % 2, torch.ones_like(points.xy))
        x, y = (points.xy / 2).long().unbind(1)
        true = F.avg_pool2d(truth[i][None], 2)[0][y, x]
        assert float((points.depth / true - 1).abs().median()) < 0.02
        assert float(torch.cdist(points.xy, priors.sparse[i].xy).min()) >= far - 2.0


@pytest.mark.parametrize(("share", "asked"), [(0.7, True), (1.4, False)])
def test_cameras_are_as_uncertain_at_half_the_resolution(
    network: Sweep, encoded: Encoded, rendered: tuple[Views, Priors, Tensor], share: float, asked: bool
) -> None:
    """How far they move a pixel is in parts of the picture, of whatever size it is."""
    views, priors, _ = rendered
    assert priors.cameras is not None
    bound = PLAIN.consensus.consensus_uncertainty * max(views.size)
    sigma = torch.full((len(views),), share * bound) / priors.cameras.K[:, 0, 0]
    with torch.no_grad():
        draft = network.draft(encoded)
    found = further_points(draft, views, replace(priors, rotation_sigma=sigma), PLAIN)
    assert bool(found) is asked


def test_views_are_reduced_by_means_and_where_all_is_valid(scene: Wall) -> None:
    valid = torch.ones_like(scene.views.valid)
    valid[1, 5, 9] = False
    small = reduced(replace(scene.views, valid=valid), 2)
    assert small.size == (24, 32) and small.names == scene.views.names
    torch.testing.assert_close(small.images[2, 1, 3, 4], scene.views.images[2, 1, 6:8, 8:10].mean())
    assert (~small.valid).nonzero().tolist() == [[1, 2, 4]]


@pytest.mark.usefixtures("few_views")
def test_optimisation_starts_from_what_it_was_told(
    network: Sweep, encoded: Encoded, rendered: tuple[Views, Priors, Tensor]
) -> None:
    """Without steps the prediction is the told one; steps of no size on the network lead back to it."""
    views, priors, _ = rendered
    now, _, points = told(network, encoded, views, priors, PLAIN)
    with torch.no_grad():
        depth = network.decode(now).depth
    outcome = optimize(network, views, priors, PLAIN)
    assert torch.equal(outcome.prediction.depth, depth) and outcome.told.keys() == points.keys()
    still = replace(PLAIN, steps=2, rate=0.0, camera_rate=0.0)
    still = replace(still, polish=replace(still.polish, polish_looks=0))
    assert torch.equal(optimize(network, views, priors, still).prediction.depth, depth)


@pytest.mark.usefixtures("few_views")
@pytest.mark.parametrize("views_asked", [5, 9], ids=["told", "not told"])
def test_steps_compare_with_a_draft(
    rendered: tuple[Views, Priors, Tensor], views_asked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One is made, of which the network is told as well; all views are decoded once, in the end."""

    class Counting(Sweep):
        drafts, wholes = 0, 0

        def draft(self, encoded: Encoded) -> Prediction:
            self.drafts += 1
            return super().draft(encoded)

        def decode(
            self, encoded: Encoded, views: Any = None, context: Prediction | None = None
        ) -> Prediction:
            self.wholes += views is None
            assert context is not None and context.depth.shape[-2:] == rendered[0].size
            return super().decode(encoded, views, context)

    monkeypatch.setattr("tco.hints.FEWEST_VIEWS", views_asked)
    network = Counting()
    network.load_state_dict(load_sweep().state_dict())
    config = replace(PLAIN, steps=1, camera_rate=0.0, polish=replace(PLAIN.polish, polish_looks=0))
    outcome = optimize(network, *rendered[:2], config)
    assert bool(outcome.told) is (views_asked == 5) and (network.drafts, network.wholes) == (1, 1)


def test_what_is_told_comes_beside_what_was_given(
    network: Sweep, encoded: Encoded, rendered: tuple[Views, Priors, Tensor]
) -> None:
    """One further point of a view: nowhere is the nearest point further away than it was."""
    sparse = rendered[1].sparse
    assert sparse is not None
    further = SparseDepth(*(getattr(sparse[1], name)[:1] for name in ("xy", "depth", "sigma", "track")))
    further = replace(further, xy=further.xy * 0 + 0.5)
    told_of = with_more(network, encoded, sparse, {1: further})
    before, after = encoded.hints[1].distance, told_of.hints[1].distance
    assert torch.equal(before[0], after[0])
    assert float((after[1] - before[1]).max()) <= 0 and float(after[1, 0, 0]) < float(before[1, 0, 0])
    assert float((after[1] == before[1]).float().mean()) > 0.5
