"""Terms: a weight without its data is an error, depths ignore scale, and poses are found from depths."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tco import penalties
from tco.backbones.base import Backbone
from tco.context import detached
from tco.geometry import invert, rigid, so3_exp
from tco.optimize import optimize
from tco.options import AblationConfig, PolishConfig, TCOConfig
from tco.penalties import in_first_view, rotation_angle
from tco.terms import ExtraTerm, Terms, means
from tco.toy import Toy, Wall, wall
from tco.types import Cameras, HeldCameras, Prediction, Priors, SparseDepth, Views

PARITY = Path(__file__).parents[3] / "shared" / "parity"


@pytest.fixture(scope="module")
def scene() -> Wall:
    return wall(points=20)


class Moving(nn.Module):
    """A network that knows the depths and predicts the cameras: a twist of each that is not right."""

    name, stride, uses_cameras = "moving", 1, False

    def __init__(self, scene: Wall, degrees: float) -> None:
        super().__init__()
        assert scene.priors.cameras is not None
        self.scene, self.true = scene, scene.priors.cameras
        v = len(self.true)
        self.twist = nn.Linear(v, 6, bias=False)
        wrong = torch.randn(6, v, generator=torch.Generator().manual_seed(2))
        wrong[:3] *= math.radians(degrees)
        wrong[3:] *= 0.01
        self.twist.weight = nn.Parameter(wrong)

    def encode(self, views: Views, priors: Priors) -> None:
        return None

    def with_points(self, encoded: Any, points: Mapping[int, SparseDepth]) -> Any:
        return encoded

    def decode(
        self, encoded: Any, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        chosen = tuple(range(len(self.true))) if views is None else tuple(views)
        twist = self.twist(torch.eye(len(self.true)))
        pose = self.true.world_from_cam @ rigid(so3_exp(twist[:, :3]), twist[:, 3:])
        depth = self.scene.depth[list(chosen)]
        return Prediction(depth, torch.full_like(depth, 10.0), Cameras(pose, self.true.K), chosen)

    def decoder(self) -> nn.Module:
        return self


def rotation_error(cameras: Cameras, scene: Wall) -> float:
    assert scene.priors.cameras is not None
    poses = (in_first_view(c.world_from_cam)[1:, :3, :3] for c in (cameras, scene.priors.cameras))
    return math.degrees(float(rotation_angle(*poses).mean()))


def test_poses_are_found_from_depths(scene: Wall) -> None:
    """Nothing but dense depth is known: the cameras come from the network and make depths and colours agree.

    On a plane the depths alone would leave turns about its normal and shifts along it.
    """
    network = Moving(scene, 0.7)
    assert isinstance(network, Backbone)
    config = TCOConfig(
        steps=20, rate=1e-3, lora_targets=("twist",), geometric_weight=1.0,
        depth_weight=1.0, occlusion_tolerance=0.2,
    )  # fmt: skip
    outcome = optimize(network, scene.views, Priors(depth=scene.depth), config)
    before = optimize(network, scene.views, Priors(depth=scene.depth), TCOConfig(steps=0))
    assert outcome.corrections == {}
    assert outcome.history[0].keys() == {"photometric", "geometric", "depth", "loss"}
    assert rotation_error(outcome.cameras, scene) < 0.5 * rotation_error(before.cameras, scene)


def test_a_weight_without_its_data_is_an_error(scene: Wall) -> None:
    with pytest.raises(ValueError, match="no dense depth"):
        Terms(scene.views, scene.priors, TCOConfig(depth_weight=1.0))
    for nothing in (torch.zeros_like(scene.depth), scene.depth * ~scene.views.valid):
        with pytest.raises(ValueError, match="dense depth is empty"):
            Terms(scene.views, replace(scene.priors, depth=nothing), TCOConfig(depth_weight=1.0))
    bare = replace(scene.priors, sparse=None, overlap=None)
    with pytest.raises(ValueError, match="no sparse points"):
        Terms(scene.views, bare, TCOConfig())
    assert Terms(scene.views, bare, TCOConfig(sparse_weight=0)).overlap.sum() == 4 * 3
    with pytest.raises(ValueError, match="toy needs cameras"):
        optimize(Untold(), scene.views, Priors(depth=scene.depth), TCOConfig(steps=1))


class Untold(Toy):
    """Takes cameras, and has them from elsewhere."""

    def encode(self, views: Views, priors: Priors) -> tuple[Tensor, Tensor, Cameras]:
        return super().encode(views, wall().priors)


def of_source(scene: Wall, depth: Tensor, prior: Tensor, /, **weights: float) -> dict[str, Tensor]:
    assert scene.priors.cameras is not None
    prediction = Prediction(depth, torch.full_like(depth, 10.0), scene.priors.cameras, (0, 1, 2, 3))
    terms = Terms(scene.views, replace(scene.priors, depth=prior), TCOConfig(depth_weight=1.0))
    return terms.of_source(1, [0, 2], prediction, prediction, scene.priors.cameras, weights)


def test_dense_depth_is_compared_after_one_scale_and_shift(scene: Wall) -> None:
    other = 3 * scene.depth + 0.2
    other[:, :5] = 0  # not known there
    assert float(of_source(scene, scene.depth, other, depth=1.0)["depth"]) < 1e-5
    bent = scene.depth * (1 + 0.1 * torch.linspace(0, 1, 64))
    assert float(of_source(scene, bent, other, depth=1.0)["depth"]) > 0.01
    other[1] = 0
    assert of_source(scene, bent, other, depth=1.0)["depth"].isfinite()


def test_the_scale_and_shift_of_dense_depth_are_those_of_all_views(scene: Wall) -> None:
    """One view that drifts against the others is wrong, though by itself it would fit."""
    assert scene.priors.cameras is not None
    terms = Terms(scene.views, replace(scene.priors, depth=scene.depth), TCOConfig(depth_weight=1.0))
    now = Prediction(scene.depth, torch.full_like(scene.depth, 10.0), scene.priors.cameras, (0, 1, 2, 3))
    alone = replace(now, depth=1.5 * scene.depth[1:2], confidence=now.confidence[1:2], views=(1,))
    drifted = now.depth.clone()
    drifted[1] *= 1.5

    def term(part: Prediction, context: Prediction) -> float:
        return float(terms.of_source(1, [], part, context, terms.given, {"depth": 1.0})["depth"])  # type: ignore[arg-type]

    mask = scene.depth > 0
    assert term(alone, now) == pytest.approx(float(penalties.depth(drifted, scene.depth, mask, [1])))
    assert term(alone, now) > 0.05 * float(scene.depth.mean())
    assert term(replace(now, depth=drifted), now) == pytest.approx(
        float(penalties.depth(drifted, scene.depth, mask))
    )


def test_a_view_of_which_dense_depth_says_nothing_has_no_term(scene: Wall) -> None:
    other = scene.depth.clone()
    other[1] = 0
    assert scene.priors.cameras is not None
    terms = Terms(scene.views, replace(scene.priors, depth=other), TCOConfig(depth_weight=1.0))
    now = Prediction(scene.depth, torch.full_like(scene.depth, 10.0), scene.priors.cameras, (0, 1, 2, 3))
    alone = replace(now, depth=scene.depth[1:2], confidence=now.confidence[1:2], views=(1,))
    assert terms.of_source(1, [], alone, now, scene.priors.cameras, {"depth": 1.0}) == {}


def test_dense_depth_with_standard_deviations_is_compared_as_it_is(scene: Wall) -> None:
    """Half a standard deviation costs ½ · ½², and another scale is an error, not aligned away."""
    assert scene.priors.cameras is not None
    sigma = torch.full_like(scene.depth, 0.01)

    def term(factor: float) -> float:
        priors = replace(scene.priors, depth=factor * scene.depth, depth_sigma=sigma)
        terms = Terms(scene.views, priors, TCOConfig(depth_weight=1.0))
        now = Prediction(scene.depth, torch.full_like(sigma, 10.0), terms.given, (0, 1, 2, 3))  # type: ignore[arg-type]
        return float(terms.of_source(1, [], now, now, terms.given, {"depth": 1.0})["depth"])  # type: ignore[arg-type]

    assert term(1.0) < 1e-9
    assert term(1.005) == pytest.approx(0.125, rel=1e-3)
    assert term(1.03) == pytest.approx(2 * (3 - 1), rel=1e-3)  # linear beyond two


ALONE = TCOConfig(
    steps=60, rate=0.02, lora_targets=("plane",), photometric_weight=0, sparse_weight=0,
    camera_rate=0, polish=PolishConfig(polish_looks=0),
)  # fmt: skip
"""Nothing but what the caller adds."""


def towards(target: Tensor, weight: float = 1.0) -> ExtraTerm:
    return ExtraTerm("mine", weight, lambda view, depth, cameras: (depth / target[view] - 1).square().mean())


def test_an_extra_term_alone_brings_the_network_to_its_minimum(scene: Wall) -> None:
    """Toward another plane, which the network can say; and the network itself is left as it was."""
    target, network = wall(slope=0.1, points=20).depth, Toy()
    before = network.plane.weight.clone()
    outcome = optimize(network, scene.views, scene.priors, ALONE, extra=[towards(target)])
    assert outcome.history[0].keys() == {"mine", "loss"}
    assert outcome.history[-1]["mine"] < 1e-3 * outcome.history[0]["mine"]
    assert float((outcome.prediction.depth / target - 1).abs().max()) < 0.02
    assert torch.equal(network.plane.weight, before)


def test_an_extra_term_also_refines_the_depths_themselves(scene: Wall) -> None:
    """Toward depths that the network cannot say: what is left of the error falls in the steps on depths."""
    target = scene.depth * (1 + 0.02 * torch.linspace(-1, 1, 64).square())
    config = replace(ALONE, polish=PolishConfig(polish_looks=20, polish_rate=7e-3))
    plain, refined = (
        optimize(Toy(), scene.views, scene.priors, c, extra=[towards(target)]) for c in (ALONE, config)
    )
    error = [float((o.prediction.depth / target - 1).abs().mean()) for o in (plain, refined)]
    assert error[1] < 0.5 * error[0]
    assert all("mine" in step for step in refined.history)


def test_an_extra_term_may_be_silent_or_off_and_gives_the_cameras(scene: Wall) -> None:
    seen = []

    def only_view_two(view: int, depth: Tensor, cameras: Cameras) -> Tensor | None:
        seen.append((view, tuple(depth.shape), len(cameras)))
        return depth.mean() if view == 2 else None

    own = ExtraTerm("two", 0.5, only_view_two)
    terms = Terms(scene.views, scene.priors, ALONE, [own, ExtraTerm("off", 0.0, only_view_two)])
    assert terms.weights(False) == {"two": 0.5}
    assert terms.given is not None
    now = Prediction(scene.depth, torch.full_like(scene.depth, 10.0), terms.given, (0, 1, 2, 3))
    found = [terms.of_source(i, [], now, now, terms.given, terms.weights(False)) for i in range(4)]
    assert [len(part) for part in found] == [0, 0, 1, 0]
    assert float(found[2]["two"]) == float(scene.depth[2].mean())
    assert seen == [(i, (48, 64), 4) for i in range(4)]


def test_names_and_weights_of_extra_terms_are_checked(scene: Wall) -> None:
    for name, weight in (("photometric", 1.0), ("loss", 1.0), ("rotation", 1.0), ("mine", -1.0)):
        with pytest.raises(ValueError, match="an extra term needs"):
            ExtraTerm(name, weight, lambda *_: None)
    with pytest.raises(ValueError, match="extra terms of one name: mine, mine"):
        Terms(scene.views, scene.priors, ALONE, [towards(scene.depth)] * 2)


def test_only_what_has_a_weight_is_there(scene: Wall) -> None:
    names = ("photometric", "geometric", "sparse", "depth")
    for name in names:
        assert of_source(scene, scene.depth, scene.depth, **{name: 0.3}).keys() == {name}
    every = of_source(scene, scene.depth, scene.depth, **dict.fromkeys(names, 1.0))
    assert every.keys() == set(names)
    assert float(every["geometric"]) < 0.02


def test_means_are_over_the_parts_that_have_a_term() -> None:
    a, b, c = (torch.tensor(x) for x in (1.0, 3.0, 5.0))
    assert means([{"x": a}, {"x": b, "y": c}]) == {"x": torch.tensor(2.0), "y": c}
    assert means([]) == {}


def test_a_networks_own_cameras_are_held_to_what_is_known(scene: Wall) -> None:
    """The penalties alone bring rotations and centres to the known cameras, in whatever world these are."""
    network = Moving(scene, degrees=4.0)
    elsewhere = rigid(so3_exp(torch.tensor([0.4, -1.0, 0.3])), torch.tensor([3.0, -2.0, 5.0]))
    known = Cameras(elsewhere @ network.true.world_from_cam, network.true.K)
    held = Priors(held=HeldCameras(known, rotation=1.0, translation=2.0, focal=0.0))
    config = TCOConfig(
        steps=60, rate=0.01, lora_targets=("twist",), lora_rank=6, photometric_weight=0.0, sparse_weight=0.0,
        camera_rate=0.0,
    )  # fmt: skip

    def turn(outcome_poses: Tensor) -> float:
        ours, theirs = in_first_view(outcome_poses), in_first_view(network.true.world_from_cam)
        return math.degrees(float(rotation_angle(ours[:, :3, :3], theirs[:, :3, :3]).mean()))

    before = optimize(network, scene.views, Priors(), replace(config, steps=0))
    after = optimize(network, scene.views, held, config)
    assert turn(after.cameras.world_from_cam) < 0.25 * turn(before.cameras.world_from_cam)
    assert set(after.history[0]) == {"rotation", "translation", "loss"}
    assert after.history[-1]["loss"] < 0.3 * after.history[0]["loss"]


def test_cameras_are_held_in_standard_deviations_where_these_are_known(scene: Wall) -> None:
    """A turn of one standard deviation costs ½ of the views' shares; without sigmas, its angle."""
    true = Moving(scene, 0.0).true
    turned = true.world_from_cam.clone()
    turned[2] = turned[2] @ rigid(so3_exp(torch.tensor([0.0, 0.03, 0.0])), torch.zeros(3))
    ours = Cameras(turned, true.K * (1 + 0.02 * torch.tensor([1.0, 1.0, 0.0]).diag()))
    sigma = torch.full((4,), 0.03 / math.sqrt(2))
    plain = HeldCameras(true)
    by_sigma = HeldCameras(true, rotation_sigma=sigma, translation_sigma=sigma, focal_sigma=sigma)
    assert float(penalties.held("rotation", ours, plain)) == pytest.approx(0.03 / 4, rel=1e-3)
    assert float(penalties.held("rotation", ours, by_sigma)) == pytest.approx(0.5 / 3, rel=1e-3)
    size = math.log(1.02) / 0.03 * math.sqrt(2)
    assert float(penalties.held("focal", ours, by_sigma)) == pytest.approx(0.5 * size**2, rel=1e-3)
    assert float(penalties.held("translation", ours, by_sigma)) == pytest.approx(0, abs=1e-6)
    focal = float(true.K[0, 0, 0])
    assert float(penalties.held("focal", ours, plain)) == pytest.approx(0.04 * focal, rel=1e-3)
    published = float(penalties.held("focal", ours, plain, published=True))
    assert published == pytest.approx(4 * (0.02 * focal - 0.5) / 6, rel=1e-3)


def test_one_view_alone_has_no_relative_pose_to_hold(scene: Wall) -> None:
    true = Moving(scene, 0.0).true
    one = Views(scene.views.images[:1], scene.views.valid[:1], ("a",))
    terms = Terms(one, Priors(held=HeldCameras(true[:1])), TCOConfig())
    assert terms.weights(False).keys() & {"rotation", "translation", "focal"} == {"focal"}


@pytest.mark.skipif(not PARITY.exists(), reason="the published numbers are not beside this checkout")
@pytest.mark.parametrize("term", ["photometric", "geometric"])
def test_parity_of_the_published_objective_as_the_optimiser_has_it(term: str) -> None:
    """Losses of the published code and their gradients, those by the depths of the targets included."""
    data = {k: torch.from_numpy(v) for k, v in np.load(PARITY / "tco_losses.npz").items()}
    short = {"photometric": "photo", "geometric": "geom"}[term]
    expected = json.loads((PARITY / "tco_losses.json").read_text())
    depth, images = data["depth"].clone().requires_grad_(True), data["images"]
    views = Views(images, torch.ones_like(depth, dtype=torch.bool), ("a",) * len(images))
    cameras = Cameras(data["cam_to_world"], data["K"])
    schedule = TCOConfig(
        sparse_weight=0.0,
        depth_weight=1.0,
        photometric_weight=1.0,
        geometric_weight=1.0,
        ablation=AblationConfig(published_objective=True),
    ).reference_schedule()
    known = Cameras(invert(data["prior_cam_from_world"]), data["prior_K"])
    prior = data["prior_depth"] * data["prior_depth_mask"]
    terms = Terms(views, Priors(depth=prior, held=HeldCameras(known)), schedule)
    now = Prediction(depth, data["conf"], cameras, tuple(range(len(depth))))
    source = int(data[f"{short}_source_view"][0])
    weights = {name: 1.0 for name in (term, "depth", "rotation", "translation", "focal")}
    found = terms.of_source(source, now.views, now, detached(now), cameras, weights)
    assert found[term].item() == pytest.approx(expected[f"{short}_loss"], rel=1e-5)
    # The published angle is an arc cosine clamped to 1 − 1e-7, which gives the first view an angle too.
    assert float(found["rotation"]) == pytest.approx(expected["rot_angle_mean"], rel=1e-3)
    assert float(found["translation"]) == pytest.approx(expected["trans_normed_l1_mean"], rel=1e-4)
    assert float(found["focal"]) == pytest.approx(expected["intrinsics_reference"], rel=1e-4)
    found[term].backward()
    theirs = data[f"{short}_grad_depth"]
    assert depth.grad is not None
    assert float((depth.grad - theirs).norm()) < 1e-4 * float(theirs.norm())


def test_cameras_cannot_be_given_and_held(scene: Wall) -> None:
    cameras = scene.priors.cameras
    assert cameras is not None
    with pytest.raises(ValueError, match="none of the network's own"):
        Terms(scene.views, replace(scene.priors, held=HeldCameras(cameras)), TCOConfig())
