"""The renderer against its definition, against arithmetic by hand, and against the published numbers.

The fast engine is compared with the brute-force twin, values and gradients, in every situation that
the engine treats specially; the twin is compared with finite differences and with closed forms.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.geometry import rigid, so3_exp
from tco.render import ENGINES, render
from tco.render.project import project
from tco.surfels import SurfelConfig, Surfels, from_depth
from tco.types import Cameras

PARITY = Path(__file__).parents[3] / "shared" / "parity" / "tco_losses.npz"
SIZE = (14, 18)
F64 = torch.float64


def cameras(views: int = 3) -> Cameras:
    """Cameras near the origin that look along z, with a little turn and shift each."""
    k = torch.arange(views, dtype=F64).unsqueeze(-1)
    pose = rigid(
        so3_exp(k * torch.tensor([0.02, -0.05, 0.1], dtype=F64)), k * torch.tensor([0.1, 0, -0.05], dtype=F64)
    )
    K = torch.tensor([[15.0, 0, 9], [0, 16.0, 7], [0, 0, 1]], dtype=F64)
    return Cameras(pose, K.expand(views, 3, 3).clone())


def surfels(n: int = 60, seed: int = 0) -> Surfels:
    """Random surfels in front of the cameras, of about one to six pixels."""
    g = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=F64)

    z = 1 + 2 * rand(n, 1)
    means = torch.cat([(rand(n, 2) - 0.5) * torch.tensor([1.3, 1.0], dtype=F64) * z, z], -1)
    quats = torch.nn.functional.normalize(rand(n, 4) - 0.5, dim=-1)
    return Surfels(means, quats, 0.05 + 0.25 * rand(n, 2), 0.1 + 0.9 * rand(n), rand(n, 3))


def grazing() -> Surfels:
    """Surfels whose planes pass within a thousandth of a radian, or exactly, through the camera."""
    s = surfels(20, 1)
    sight = torch.nn.functional.normalize(s.means, dim=-1)
    side = torch.nn.functional.normalize(
        torch.linalg.cross(sight, torch.tensor([[0.0, 1, 0]], dtype=F64)), dim=-1
    )
    lean = torch.linspace(0, 1e-3, 20, dtype=F64).unsqueeze(-1)
    t_u = torch.nn.functional.normalize(sight + lean * torch.linalg.cross(sight, side), dim=-1)
    from tco.geometry import quat_from_matrix

    return replace(s, quats=quat_from_matrix(torch.stack([t_u, side, torch.linalg.cross(t_u, side)], -1)))


def behind() -> Surfels:
    """Half of the surfels behind the camera, some in its plane, one nearer than the near plane."""
    s = surfels(30, 2)
    means = s.means.clone()
    means[:12, 2] *= -1
    means[12:15, 2] = 0
    means[15, 2] = 0.005
    means[16:20, 2] = 0.12  # in front, but discs of 0.05 to 0.3 reach behind the camera
    return replace(s, means=means)


def at_borders() -> Surfels:
    """Surfels on and beyond the four borders of the image of the first camera."""
    s = surfels(40, 3)
    edge = torch.tensor([[-0.6, 0], [0.6, 0], [0, -0.44], [0, 0.44]], dtype=F64).repeat(10, 1)
    outward = torch.linspace(0.9, 1.5, 40, dtype=F64).unsqueeze(-1)
    return replace(s, means=torch.cat([edge * outward * s.means[:, 2:], s.means[:, 2:]], -1))


def stacked() -> Surfels:
    """Forty opaque surfels in line: transmittance runs out, alphas are clamped, depths are equal in pairs."""
    s = surfels(40, 4)
    z = 1 + 0.05 * (torch.arange(40) // 2).to(F64)
    means = torch.stack([0.02 * s.means[:, 0], 0.02 * s.means[:, 1], z], -1)
    return replace(s, means=means, opacities=torch.ones(40, dtype=F64), scales=s.scales + 0.2)


def tiny() -> Surfels:
    """Surfels far below a pixel, which are seen through the low-pass filter alone."""
    s = surfels(50, 5)
    return replace(s, scales=s.scales * 1e-3)


def unseen() -> Surfels:
    s = surfels(10, 6)
    return replace(s, means=s.means * torch.tensor([1, 1, -1.0], dtype=F64))


SCENES = {f.__name__: f for f in (surfels, grazing, behind, at_borders, stacked, tiny, unseen)}
FIELDS = ("means", "quats", "scales", "opacities", "colors")


def moved(pose: Tensor, twist: Tensor) -> Tensor:
    """Poses (T, 4, 4) turned and shifted in their own frames by (T, 6)."""
    return pose @ rigid(so3_exp(twist[:, :3]), twist[:, 3:])


def gradients(
    scene: Surfels, cams: Cameras, engine: str, dtype: torch.dtype = F64
) -> tuple[list[Tensor], list[Tensor]]:
    """Images, and the gradients of a random linear functional of them by all inputs.

    Poses move on the group, by twists: what a matrix that is no rotation would give is undefined.
    """
    scene, cams = scene.to(dtype=dtype), cams.to(dtype=dtype)
    leaves = [getattr(scene, f).clone().requires_grad_(True) for f in FIELDS]
    K = cams.K.clone().requires_grad_(True)
    twist = torch.zeros(len(cams), 6, dtype=dtype, requires_grad=True)
    rendered = render(Surfels(*leaves), Cameras(moved(cams.world_from_cam, twist), K), SIZE, engine)
    images = [rendered.color, rendered.depth * rendered.alpha, rendered.alpha]
    g = torch.Generator().manual_seed(7)
    loss = sum((i.double() * torch.randn(i.shape, generator=g, dtype=F64)).sum() for i in images)
    assert isinstance(loss, Tensor)
    grads = list(torch.autograd.grad(loss, [*leaves, twist, K]))
    grads[-1] = grads[-1][:, [0, 1, 0, 1], [0, 1, 2, 2]]  # the twin has no skew
    return images, grads


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(
    ("engine", "definition"),
    [("cpu", "twin"), ("surface", "surface_twin"), ("surface_pairs", "surface_twin")],
)
def test_engines_agree_with_their_twins(name: str, dtype: torch.dtype, engine: str, definition: str) -> None:
    scene = SCENES[name]()
    ours, our_grads = gradients(scene, cameras(), engine, dtype)
    twin, twin_grads = gradients(scene, cameras(), definition)
    tolerance = 1e-9 if dtype == torch.float64 else 1e-4
    for a, b in zip(ours, twin, strict=True):
        assert a.dtype == dtype
        torch.testing.assert_close(a.double(), b, atol=tolerance, rtol=tolerance)
    if name == "unseen":
        assert all(float(g.abs().max()) == 0 for g in our_grads) and float(ours[2].abs().max()) == 0
        return
    for label, a, b in zip((*FIELDS, "pose", "K"), our_grads, twin_grads, strict=True):
        # Grazing surfels divide by a plane's slope of down to 1e-3: tensors of float32 lose digits there, and
        # the loops, which are in float64, do not.
        lost = dtype == torch.float32 and name == "grazing" and engine == "surface_pairs"
        limit = 3e-4 if lost else tolerance
        assert float((a.double() - b).norm()) <= limit * float(b.norm()) + 1e-12, label


@pytest.mark.parametrize("name", [n for n in SCENES if n not in ("unseen", "stacked")])
@pytest.mark.parametrize("engine", ["cpu", "surface"])
def test_gradients_are_differences_on_every_scene(name: str, engine: str) -> None:
    """Along a random direction of each input, to 1e-4, by steps that are too small to cross a threshold.

    Stacked surfels have equal depths in pairs, and change places at once.
    """
    scene, cams = SCENES[name](), cameras()
    _, grads = gradients(scene, cams, engine)
    g = torch.Generator().manual_seed(10)
    leaves = [*(getattr(scene, f) for f in FIELDS), torch.zeros(len(cams), 6, dtype=F64), cams.K]

    def value(args: list[Tensor]) -> float:
        *parts, twist, K = args
        rendered = render(Surfels(*parts), Cameras(moved(cams.world_from_cam, twist), K), SIZE, engine)
        images = [rendered.color, rendered.depth * rendered.alpha, rendered.alpha]
        fixed = torch.Generator().manual_seed(7)
        return sum(float((i * torch.randn(i.shape, generator=fixed, dtype=F64)).sum()) for i in images)

    for k, label in enumerate((*FIELDS, "pose", "K")):
        way = torch.randn(leaves[k].shape, generator=g, dtype=F64)
        if label == "K":
            way[:, [0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] = 0
            expected = float((grads[k] * way[:, [0, 1, 0, 1], [0, 1, 2, 2]]).sum())
        else:
            expected = float((grads[k] * way).sum())
        ends = [[*leaves[:k], leaves[k] + s * 1e-8 * way, *leaves[k + 1 :]] for s in (1, -1)]
        found = (value(ends[0]) - value(ends[1])) / 2e-8
        assert found == pytest.approx(expected, rel=1e-4, abs=1e-5 * (1 + float(grads[k].norm()))), label


@pytest.mark.parametrize("name", [n for n in SCENES if n != "unseen"])
def test_scenes_show_something(name: str) -> None:
    assert float(render(SCENES[name](), cameras(), SIZE).alpha.max()) > 0.1


def smooth() -> Surfels:
    """Few surfels of moderate opacity, away from every threshold, so that differences are derivatives."""
    s = surfels(5, 8)
    return replace(s, opacities=0.4 + 0.1 * s.opacities, scales=s.scales + 5.0)


@pytest.mark.parametrize("engine", ["twin", "cpu", "surface_twin", "surface", "surface_pairs"])
def test_derivatives_match_finite_differences(engine: str) -> None:
    """Large surfels cover all pixels (no threshold is crossed); poses move on the group."""
    scene, cams = smooth(), cameras(2)
    scene = replace(scene, means=scene.means + torch.tensor([0, 0, 30.0], dtype=F64))
    leaves = [getattr(scene, f).clone().requires_grad_(True) for f in FIELDS]
    twist = torch.zeros(2, 6, dtype=F64, requires_grad=True)
    focal = torch.zeros(2, 4, dtype=F64, requires_grad=True)

    def f(*args: Tensor) -> tuple[Tensor, ...]:
        *parts, twist, focal = args
        pose = moved(cams.world_from_cam, twist)
        zero = torch.zeros_like(focal[:, 0])
        change = torch.stack(
            [focal[:, 0], zero, focal[:, 2], zero, focal[:, 1], focal[:, 3], zero, zero, zero], -1
        )
        color, depth, alpha = ENGINES[engine](
            Surfels(*parts), Cameras(pose, cams.K + change.reshape(2, 3, 3)), (4, 5)
        )
        return color, depth, alpha

    assert torch.autograd.gradcheck(f, (*leaves, twist, focal), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("engine", ["cpu", "twin"])
def test_one_frontal_surfel_is_a_gaussian(engine: str) -> None:
    """A disc of 3 pixels at depth 2, centred at pixel (9, 7): alpha = o exp(−|Δ|² / (2·3²))."""
    scene = Surfels(
        torch.tensor([[0.0, 0, 2]], dtype=F64), torch.tensor([[1.0, 0, 0, 0]], dtype=F64),
        torch.tensor([[0.4, 0.375]], dtype=F64), torch.tensor([0.8], dtype=F64),
        torch.tensor([[1, 0.5, 0.25]], dtype=F64),
    )  # fmt: skip
    out = render(scene, cameras(1), SIZE, engine)
    y, x = torch.meshgrid(torch.arange(14, dtype=F64) + 0.5, torch.arange(18, dtype=F64) + 0.5, indexing="ij")
    alpha = 0.8 * torch.exp(-((x - 9) ** 2 + (y - 7) ** 2) / 18)
    alpha = torch.where(alpha < 1 / 255, 0, alpha)
    torch.testing.assert_close(out.alpha[0], alpha)
    torch.testing.assert_close(out.color[0], alpha.unsqueeze(-1) * scene.colors)
    torch.testing.assert_close(out.depth[0], torch.where(alpha > 0, 2.0, 0.0).to(F64))


def test_two_surfels_composite_front_to_back() -> None:
    """On the axis, alphas 0.5 in front of 0.6: weights 0.5 and 0.3, whatever the order of the input."""
    scene = Surfels(
        torch.tensor([[0.0, 0, 4], [0, 0, 2]], dtype=F64), torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=F64),
        torch.full((2, 2), 0.5, dtype=F64), torch.tensor([0.6, 0.5], dtype=F64), torch.eye(3, dtype=F64)[:2],
    )  # fmt: skip
    K = torch.tensor([[15.0, 0, 9.5], [0, 15.0, 7.5], [0, 0, 1]], dtype=F64).unsqueeze(0)
    out = render(scene, Cameras(torch.eye(4, dtype=F64).unsqueeze(0), K), SIZE)
    assert out.color[0, 7, 9].tolist() == pytest.approx([0.3, 0.5, 0])
    assert float(out.depth[0, 7, 9]) == pytest.approx((0.5 * 2 + 0.3 * 4) / 0.8)


def test_low_pass_filter_keeps_a_point_visible() -> None:
    """A surfel of no size shows as exp(−|Δ|²) around its pixel."""
    scene = replace(smooth(), scales=torch.full((5, 2), 1e-9, dtype=F64))
    scene = Surfels(*(getattr(scene, f)[:1] for f in FIELDS))
    scene = replace(scene, means=torch.tensor([[0.0, 0, 2]], dtype=F64))
    out = render(scene, cameras(1), SIZE)
    assert float(out.alpha[0, 7, 9]) == pytest.approx(float(scene.opacities[0]) * math.exp(-0.5))
    assert float(out.alpha[0, 7, 10]) == pytest.approx(float(scene.opacities[0]) * math.exp(-2.5))


def test_surface_is_the_mean_of_what_is_near_and_hides_what_is_behind() -> None:
    """On the axis: two surfels of a surface with weights 0.5 and 0.25, one behind, a skirt in front."""
    means = torch.tensor([[0.0, 0, 2], [0, 0, 2.01], [0, 0, 4], [0.3, 0, 1]], dtype=F64)
    scene = Surfels(
        means, torch.tensor([[1.0, 0, 0, 0]] * 4, dtype=F64), torch.full((4, 2), 0.1, dtype=F64),
        torch.tensor([0.5, 0.25, 1.0, 1.0], dtype=F64), torch.eye(4, dtype=F64)[:, :3],
    )  # fmt: skip
    K = torch.tensor([[15.0, 0, 9.5], [0, 15.0, 7.5], [0, 0, 1]], dtype=F64).unsqueeze(0)
    out = render(scene, Cameras(torch.eye(4, dtype=F64).unsqueeze(0), K), SIZE, "surface")
    alpha = 1 - math.exp(-0.75)
    assert float(out.alpha[0, 7, 9]) == pytest.approx(alpha)
    assert out.color[0, 7, 9].tolist() == pytest.approx([alpha * 2 / 3, alpha / 3, 0])
    assert float(out.depth[0, 7, 9]) == pytest.approx(2 + 0.01 / 3)


def on_axis(depths: list[float], opacities: list[float], scale: float = 0.5) -> tuple[Surfels, Cameras]:
    """Frontal surfels on the axis of a camera of focal length 15, which meets the centre of pixel (9, 7)."""
    n = len(depths)
    means = torch.tensor([[0.0, 0, z] for z in depths], dtype=F64)
    frames = torch.tensor([[1.0, 0, 0, 0]] * n, dtype=F64)
    sizes, gray = torch.full((n, 2), scale, dtype=F64), torch.full((n, 3), 0.5, dtype=F64)
    K = torch.tensor([[15.0, 0, 9.5], [0, 15.0, 7.5], [0, 0, 1]], dtype=F64).unsqueeze(0)
    eye = torch.eye(4, dtype=F64).unsqueeze(0)
    return Surfels(means, frames, sizes, torch.tensor(opacities, dtype=F64), gray), Cameras(eye, K)


@pytest.mark.parametrize(
    ("opacities", "alpha"),
    [
        ([1.0], 0.99),
        ([1.0, 0.985], 1 - 0.01 * 0.015),
        ([0.95, 0.95, 0.97], 0.9975),  # would leave 0.75e-4: the pixel is finished before
        ([0.95, 0.95, 0.97, 0.5], 0.9975),  # and takes nothing afterwards
        ([0.95, 0.95, 0.95], 1 - 1.25e-4),
        ([0.0039], 0.0),
        ([0.004], 0.004),
    ],
)
@pytest.mark.parametrize("engine", ["cpu", "twin"])
def test_thresholds_of_compositing(opacities: list[float], alpha: float, engine: str) -> None:
    scene, cams = on_axis([1.0 + k for k in range(len(opacities))], opacities)
    assert float(render(scene, cams, SIZE, engine).alpha[0, 7, 9]) == pytest.approx(alpha, abs=1e-12)


@pytest.mark.parametrize("engine", ["cpu", "surface", "twin"])
def test_nothing_nearer_than_the_near_plane_is_seen(engine: str) -> None:
    scene, cams = on_axis([0.02], [0.5], scale=0.001)
    assert float(render(scene, cams, SIZE, engine, near=0.021).alpha.max()) == 0
    assert float(render(scene, cams, SIZE, engine, near=0.019).alpha.max()) > 0.3


def test_blocks_of_pairs_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = gradients(surfels(), cameras(), "surface_pairs")
    monkeypatch.setattr("tco.render.pairs._BLOCK", 50)
    parts = gradients(surfels(), cameras(), "surface_pairs")
    for a, b in zip(whole[0] + whole[1], parts[0] + parts[1], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("engine", ["surface", "surface_pairs", "surface_twin"])
def test_tolerance_of_a_surface_is_that_of_a_slope_of_60_degrees(engine: str) -> None:
    """At focal length 15 surfels within 0.01 + 4 / 15 of the nearest depth are one surface."""
    for part, together in ((0.99, True), (1.01, False)):
        scene, cams = on_axis([1.0, 1 + part * (0.01 + 4 / 15)], [0.5, 0.5])
        alpha = 1 - math.exp(-1.0 if together else -0.5)
        assert float(render(scene, cams, SIZE, engine).alpha[0, 7, 9]) == pytest.approx(alpha)


def test_moving_world_and_cameras_together_changes_nothing() -> None:
    scene, cams = surfels(), cameras()
    world = rigid(so3_exp(torch.tensor([1.0, -2, 0.5], dtype=F64)), torch.tensor([3.0, 1, -4], dtype=F64))
    from tco.geometry import matrix_from_quat, quat_from_matrix, transform

    moved = replace(
        scene,
        means=transform(world, scene.means),
        quats=quat_from_matrix(world[:3, :3] @ matrix_from_quat(scene.quats)),
    )
    a, b = render(scene, cams, SIZE), render(moved, Cameras(world @ cams.world_from_cam, cams.K), SIZE)
    torch.testing.assert_close(a.color, b.color)
    torch.testing.assert_close(a.depth, b.depth)


def test_order_of_surfels_does_not_matter() -> None:
    scene = surfels()
    p = torch.randperm(len(scene), generator=torch.Generator().manual_seed(0))
    a, b = (
        render(scene, cameras(), SIZE),
        render(Surfels(*(getattr(scene, f)[p] for f in FIELDS)), cameras(), SIZE),
    )
    torch.testing.assert_close(a.color, b.color)


def test_threads_do_not_change_a_digit() -> None:
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            results.append(gradients(surfels(), cameras(), "cpu"))
    finally:
        torch.set_num_threads(before)
    for a, b in zip(results[0][0] + results[0][1], results[1][0] + results[1][1], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("name", SCENES)
def test_boxes_are_as_tight_as_they_may_be(name: str) -> None:
    """Nothing visible lies outside (that is the agreement with the twin); boxes stay inside the image."""
    boxes = project(SCENES[name](), cameras(), SIZE).boxes
    assert bool((boxes >= 0).all())
    assert int(boxes[..., 1].max()) <= SIZE[1] and int(boxes[..., 3].max()) <= SIZE[0]
    if name == "tiny":
        seen = boxes[boxes[..., 1] > boxes[..., 0]]
        assert int((seen[:, 1] - seen[:, 0]).max()) <= 6


def test_a_plane_seen_from_another_view_has_its_depth() -> None:
    """Surfels of a frontal wall at 2, rendered 0.3 nearer: expected depth 1.7 where it is covered."""
    h, w = 24, 32
    K = torch.tensor([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]], dtype=F64)
    eye, ones = torch.eye(4, dtype=F64), torch.ones(h, w, dtype=F64)
    wall = from_depth(
        2 * ones, K, eye, torch.rand(3, h, w).double(), 1e3 * ones, config=SurfelConfig(radius_factor=1.0)
    )
    near = eye.clone()
    near[:3, 3] = torch.tensor([0.05, -0.02, 0.3])
    out = render(wall, Cameras(near.unsqueeze(0), K.unsqueeze(0)), (h, w))
    inside = out.alpha[0, 4:-4, 4:-4]
    assert float(inside.min()) > 0.9
    torch.testing.assert_close(out.depth[0, 4:-4, 4:-4], torch.full_like(inside, 1.7))


@pytest.mark.parametrize("slope", [0.0, 0.4, -0.4])
def test_surface_engine_keeps_the_picture_in_place(slope: float) -> None:
    """With one convention for pixel centres, a view rendered into itself comes back unshifted.

    Compositing moves it on a slant, because the nearer of two overlapping surfels hides the other.
    """
    h, w = 24, 32
    y, x = torch.meshgrid(torch.arange(h, dtype=F64), torch.arange(w, dtype=F64), indexing="ij")
    blob = torch.exp(-((x - 15) ** 2 + (y - 11) ** 2) / 18).expand(3, h, w)
    K = torch.tensor([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]], dtype=F64)
    eye, ones = torch.eye(4, dtype=F64), torch.ones(h, w, dtype=F64)
    depth = 2 / (1 - slope * (x + 0.5 - 16) / 30)

    def shift(engine: str, config: SurfelConfig) -> tuple[float, float]:
        s = from_depth(depth, K, eye, blob, 20 * ones, config=config)
        out = render(s, Cameras(eye.unsqueeze(0), K.unsqueeze(0)), (h, w), engine)
        c = out.color[0, ..., 0] / out.alpha[0].clamp_min(1e-3)
        c = c * (c > 0.05)
        return float((c * x).sum() / c.sum()) - 15, float((c * y).sum() / c.sum()) - 11

    assert shift("surface", SurfelConfig()) == pytest.approx((0, 0), abs=0.02)
    assert shift("surface", SurfelConfig(pixel_centre=0.0)) == pytest.approx((-0.5, -0.5), abs=0.05)
    if slope:
        assert shift("cpu", SurfelConfig())[0] * slope > 0.1 * abs(slope)


def test_errors_name_the_cause() -> None:
    with pytest.raises(ValueError, match="no renderer 'opengl'"):
        render(surfels(), cameras(), SIZE, "opengl")
    cams = cameras()
    cams.K[0, 2, 2] = 2
    with pytest.raises(ValueError, match="last row of K"):
        render(surfels(), cams, SIZE)


@pytest.mark.skipif(not PARITY.exists(), reason="the published numbers are not beside this checkout")
@pytest.mark.parametrize("engine", ["cpu", "twin"])
def test_parity_with_gsplat(engine: str) -> None:
    data = {k: torch.from_numpy(v) for k, v in np.load(PARITY).items()}
    v = int(data["photo_source_view"][0])
    scene = from_depth(
        data["depth"][v], data["K"][v], data["cam_to_world"][v], data["images"][v], data["conf"][v],
        config=SurfelConfig(pixel_centre=0.0),
    )  # fmt: skip
    # The published run rendered the views in a random order, the source first.
    order = [3, 2, 0, 1]
    out = render(scene, Cameras(data["cam_to_world"], data["K"])[order], (24, 32), engine)
    images = (out.color, out.depth.unsqueeze(-1), out.alpha.unsqueeze(-1))
    for name, ours in zip(("render_RGB", "render_ED", "render_alpha"), images, strict=True):
        torch.testing.assert_close(ours.float(), data[name], atol=1e-5, rtol=1e-4)
