"""The scene in closed form is what it says, and the camera and depth that explain it are found."""

from __future__ import annotations

import doctest
import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import tco.optimize
from tco.backbones.base import Backbone
from tco.corrections import CameraCorrections
from tco.geometry import invert, project, sample, so3_exp, transform, unproject
from tco.optimize import Outcome, optimize
from tco.options import AblationConfig, PolishConfig, TCOConfig
from tco.penalties import focal, rotation, rotation_angle, translation
from tco.terms import Terms
from tco.toy import Toy, Wall, wall
from tco.types import Cameras

TRUE = (-0.15, 0.0, 0.5)
ALONE = PolishConfig(polish_looks=0)
FIT = TCOConfig(steps=12, rate=0.01, lora_targets=("plane",), camera_rate=0, polish=ALONE)


@pytest.fixture(scope="module")
def scene() -> Wall:
    return wall()


def error(outcome: Outcome, scene: Wall) -> float:
    return float((outcome.prediction.depth / scene.depth - 1).abs().mean())


def test_the_example_runs() -> None:
    """The ten lines in the documentation of :func:`tco.optimize.optimize`."""
    failed, run = doctest.testmod(tco.optimize)
    assert run >= 5 and failed == 0


def test_the_true_plane_is_the_true_depth(scene: Wall) -> None:
    net = Toy(TRUE)
    assert isinstance(net, Backbone)
    with torch.no_grad():
        depth = net.decode(net.encode(scene.views, scene.priors)).depth
    torch.testing.assert_close(depth, scene.depth)


def test_points_of_one_view_have_the_same_colour_in_another(scene: Wall) -> None:
    """Surfaces are seen where the cameras say: the half pixel, the transforms and the texture agree."""
    cameras = scene.priors.cameras
    assert cameras is not None
    points = transform(cameras.world_from_cam[0], unproject(scene.depth[0], cameras.K[0]).reshape(-1, 3))
    xy, z = project(transform(invert(cameras.world_from_cam[2]), points), cameras.K[2])
    inside = ((xy > 1) & (xy < xy.new_tensor([63.0, 47.0]))).all(-1)
    assert float(inside.float().mean()) > 0.5
    colors = sample(scene.views.images[2:3], xy[inside].unsqueeze(0))[0]
    own = scene.views.images[0].flatten(1)[:, inside]
    depth = 1 / sample(1 / scene.depth[2][None, None], xy[inside].unsqueeze(0))[0, 0]
    torch.testing.assert_close(depth, z[inside], rtol=1e-4, atol=0)
    assert float((colors - own).abs().mean()) < 0.01  # what bilinear interpolation loses
    assert float((colors - own.flip(1)).abs().mean()) > 0.1


def turned(scene: Wall, view: int, degrees: float) -> tuple[Wall, Tensor]:
    """The scene with the camera prior of one view turned by as much as its σ says, and the true poses."""
    cameras, sigma = scene.priors.cameras, scene.priors.rotation_sigma
    assert cameras is not None and sigma is not None
    pose, sigma = cameras.world_from_cam.clone(), sigma.clone()
    axis = torch.tensor([0.6, 0.64, -0.48])
    pose[view, :3, :3] = pose[view, :3, :3] @ so3_exp(math.radians(degrees) * axis)
    sigma[view] = math.radians(degrees)
    priors = replace(scene.priors, cameras=Cameras(pose, cameras.K), rotation_sigma=sigma)
    return replace(scene, priors=priors), cameras.world_from_cam


def degrees_off(outcome: Outcome, truth: Tensor) -> Tensor:
    pose = outcome.cameras.world_from_cam
    return torch.rad2deg(rotation_angle(pose[:, :3, :3], truth[:, :3, :3]))


def test_a_wrong_camera_is_corrected_and_right_ones_are_left_alone(scene: Wall) -> None:
    """One degree, which is a pixel, with a σ of one degree, at the default weights and rates."""
    wrong, truth = turned(scene, 1, 1.0)
    config = TCOConfig(steps=40, rate=0, lora_targets=("plane",), polish=ALONE)
    off = degrees_off(optimize(Toy(TRUE), wrong.views, wrong.priors, config), truth)
    assert float(off[1]) < 0.2
    assert float(off[[0, 2, 3]].max()) < 0.1  # their σ

    right = optimize(Toy(TRUE), scene.views, scene.priors, config)
    assert float(degrees_off(right, truth).max()) < 0.03
    assert max(right.corrections["centre"]) < 0.0006 and max(map(abs, right.corrections["focal"])) < 0.0006


def test_a_certain_prior_outweighs_the_colours(scene: Wall) -> None:
    """A camera that is wrong by many of its own standard deviations stays, as the penalty is quadratic."""
    wrong, truth = turned(scene, 1, 1.0)
    sigma = torch.full((4,), math.radians(0.005))
    config = TCOConfig(steps=16, rate=0, lora_targets=("plane",), camera_kernel="quadratic", camera_rate=0.1)
    outcome = optimize(Toy(TRUE), wrong.views, replace(wrong.priors, rotation_sigma=sigma), config)
    assert 0.95 < float(degrees_off(outcome, truth)[1]) <= 1.01


def test_the_plane_is_found(scene: Wall) -> None:
    before = optimize(Toy(), scene.views, scene.priors, TCOConfig(steps=0))
    after = optimize(Toy(), scene.views, scene.priors, FIT)
    assert error(after, scene) < 0.35 * error(before, scene)


@pytest.mark.parametrize(
    ("config", "share"),
    [
        (replace(FIT, sources=2), 0.35),
        (FIT.reference_schedule(), 0.35),
        (replace(FIT, ablation=AblationConfig(published_objective=True)).reference_schedule(), 0.35),
        (replace(FIT, ablation=AblationConfig(source_order="overlap")), 0.4),
        (replace(FIT, ablation=AblationConfig(confident_opacity=False, radius_factor=1.0)), 0.35),
        (replace(FIT, ablation=AblationConfig(free_surfels=True)), 0.35),
        (
            replace(FIT, lora_targets=(), ablation=AblationConfig(unfrozen=("plane",), unfrozen_rate=0.01)),
            0.5,
        ),
        (replace(FIT, lora_targets=(), ablation=AblationConfig(free_depth=True, free_rate=0.03)), 0.85),
    ],
    ids=["sources", "reference", "published", "overlap", "opaque", "surfels", "unfrozen", "depth"],
)
def test_every_variant_lowers_the_error(scene: Wall, config: TCOConfig, share: float) -> None:
    before = optimize(Toy(), scene.views, scene.priors, TCOConfig(steps=0))
    net = Toy()
    after = optimize(net, scene.views, scene.priors, config)
    assert error(after, scene) < share * error(before, scene)
    assert torch.equal(net.plane.weight, Toy().plane.weight)


def test_unfrozen_modules_have_a_rate_of_their_own_beside_the_adapters(scene: Wall) -> None:
    """Adam's first step is as long as the rate, so that it tells whose rate moved what."""

    def moved(rate: float, unfrozen_rate: float) -> Tensor:
        ablation = AblationConfig(unfrozen=("plane",), unfrozen_rate=unfrozen_rate)
        config = replace(FIT, steps=1, rate=rate, ablation=ablation)
        return optimize(Toy(), scene.views, scene.priors, config).prediction.depth

    alone = optimize(Toy(), scene.views, scene.priors, replace(FIT, steps=1)).prediction.depth
    still = moved(0, 0)
    torch.testing.assert_close(moved(0.01, 0), alone)
    small, large = (moved(0, rate) - still for rate in (0.001, 0.002))
    assert float(small.abs().max()) > 1e-4
    torch.testing.assert_close(large, 2 * small, rtol=0.02, atol=1e-5)


def test_plain_camera_penalties_are_the_papers(scene: Wall) -> None:
    """At the start the cameras are the priors; after a step they are held by angle, centres and focals."""
    wrong, _ = turned(scene, 1, 1.0)
    config = TCOConfig(
        steps=2, rate=0, camera_rate=0.2, lora_targets=("plane",), ablation=AblationConfig(plain_cameras=True)
    )
    outcome = optimize(Toy(TRUE), wrong.views, wrong.priors, config)
    given, got = wrong.priors.cameras, outcome.history[1]
    assert given is not None and outcome.history[0]["cameras"] < 1e-6 < got["cameras"]
    assert got["loss"] == pytest.approx(got["photometric"] + got["cameras"] + 0.01 * got["sparse"], rel=1e-5)


def test_plain_camera_penalties_weigh_1_2_and_a_hundredth(scene: Wall) -> None:
    """Rotation, centres and focal length alone, each against its own penalty."""
    config = TCOConfig(ablation=AblationConfig(plain_cameras=True))
    given = scene.priors.cameras
    assert given is not None
    terms, corrections = Terms(scene.views, scene.priors, config), CameraCorrections(scene.priors)
    turn, pose, K = so3_exp(torch.tensor([0.0, 0.05, 0.0])), given.world_from_cam.clone(), given.K.clone()
    pose[1, :3, :3] = pose[1, :3, :3] @ turn
    rotated = terms.of_cameras(corrections, Cameras(pose, given.K))
    torch.testing.assert_close(rotated, rotation(pose, given.world_from_cam))
    pose = given.world_from_cam.clone()
    pose[1, 0, 3] += 0.1
    moved = terms.of_cameras(corrections, Cameras(pose, given.K))
    torch.testing.assert_close(moved, 2 * translation(pose, given.world_from_cam))
    K[:, 0, 0] *= 1.1
    zoomed = terms.of_cameras(corrections, Cameras(given.world_from_cam, K))
    torch.testing.assert_close(zoomed, 0.01 * focal(K, given.K))
    assert min(map(float, (rotated, moved, zoomed))) > 1e-4


def test_corrected_cameras_are_given_to_the_network(scene: Wall) -> None:
    """A camera that went more than a pixel is encoded anew, at the next refresh and never if not wanted."""
    seen: list[Tensor] = []

    class Watched(Toy):
        def encode(self, views, priors):  # type: ignore[no-untyped-def]
            seen.append(priors.cameras.world_from_cam)
            return super().encode(views, priors)

    wrong, truth = turned(scene, 1, 2.0)
    config = TCOConfig(
        steps=17, rate=0, lora_targets=("plane",), refresh=8, reencode=0.5, camera_rate=0.1, sparse_weight=0
    )
    optimize(Watched(TRUE), wrong.views, wrong.priors, config)
    assert len(seen) >= 2
    before, after = (float(rotation_angle(p[1, :3, :3], truth[1, :3, :3])) for p in (seen[0], seen[-1]))
    assert after < 0.6 * before
    seen.clear()
    optimize(Watched(TRUE), wrong.views, wrong.priors, replace(config, steps=8, refresh=100))
    assert len(seen) == 2  # for the prediction at the end
    seen.clear()
    optimize(Watched(TRUE), wrong.views, wrong.priors, replace(config, steps=9, reencode=0.0))
    assert len(seen) == 1


def test_optimisation_stops_when_hidden_points_gain_nothing(scene: Wall) -> None:
    """From the true plane nothing can be gained; from a wrong one the steps go on while it helps."""
    quick = replace(FIT, steps=30, stop_after=5, rate=1e-4)
    idle = optimize(Toy(TRUE), scene.views, scene.priors, quick)
    assert len(idle.history) < 20
    assert all("hidden" in terms for terms in idle.history)
    busy = optimize(Toy(), scene.views, scene.priors, replace(FIT, stop_after=5))
    assert len(busy.history) == FIT.steps
