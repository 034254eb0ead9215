"""The CUDA engine: what is done around gsplat's function is proved on a CPU, the function where it runs."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from tco.render import render
from tco.render.gsplat import in_camera, through_identity
from tco.surfels import Surfels
from tco.types import Cameras
from tests.tco.test_render import FIELDS, SCENES, SIZE, cameras, moved, surfels

RUNS = torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None


def in_gsplats_words(*, means: Tensor, quats: Tensor, scales: Tensor, **others: Any) -> tuple[Tensor, ...]:
    """The engine ``cpu`` called as gsplat's function is: the third radius, and targets by view matrices."""
    assert bool((scales[:, 2] < 1e-5).all()) and others["render_mode"] == "RGB+D"
    scene = Surfels(means, quats, scales[:, :2], others["opacities"], others["colors"])
    assert torch.equal(others["viewmats"], torch.eye(4).unsqueeze(0))
    targets = Cameras(others["viewmats"], others["Ks"])
    seen = render(scene, targets, (others["height"], others["width"]), "cpu", others["near_plane"])
    return torch.cat([seen.color, (seen.depth * seen.alpha)[..., None]], -1), seen.alpha[..., None]


def pictures_and_derivatives(scene: Surfels, engine: str) -> list[Tensor]:
    """Colour, sum of depths and alpha; derivatives by the cameras' motion and by every field."""
    target = cameras().to(scene.means.device, scene.means.dtype)
    twist = scene.means.new_zeros(3, 6).requires_grad_(True)
    leaves = {name: getattr(scene, name).clone().requires_grad_(True) for name in FIELDS}
    placed = Cameras(moved(target.world_from_cam, twist), target.K)
    if engine == "through identity":
        parts = through_identity(in_gsplats_words, Surfels(**leaves), placed, SIZE, 0.01)
    else:
        seen = render(Surfels(**leaves), placed, SIZE, engine)
        parts = (seen.color, seen.depth * seen.alpha, seen.alpha)
    g = torch.Generator().manual_seed(2)
    loss = torch.stack([(p * torch.randn(p.shape, generator=g).to(p)).sum() for p in parts]).sum()
    gradients = torch.autograd.grad(loss, [twist, *leaves.values()])
    return [*(p.detach() for p in parts), *gradients]


def close(ours: list[Tensor], theirs: list[Tensor], picture: float, derivative: float) -> None:
    """Differences by norm: the first three are pictures."""
    for k, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        error = float((a.cpu().double() - b.double()).norm() / b.double().norm())
        assert error < (picture if k < 3 else derivative), f"part {k}: {error:.1e}"


@pytest.mark.parametrize("name", ["surfels", "at_borders", "behind"])
def test_a_camera_in_the_origin_sees_what_was_moved_into_its_frame(name: str) -> None:
    """The same picture and derivatives by pose and surfels: those by the pose go by the move alone."""
    scene = SCENES[name]()
    direct = pictures_and_derivatives(scene, "cpu")
    assert float(direct[3].norm()) > 1e-2
    close(pictures_and_derivatives(scene, "through identity"), direct, 1e-5, 1e-4)


def test_frames_that_were_moved_are_turned() -> None:
    """Means and quaternions of one surfel, turned by 90° about z and shifted."""
    pose = torch.tensor([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    half = 0.5**0.5
    one = Surfels(
        torch.tensor([[2.0, 2, 4]]), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 2), torch.ones(1),
        torch.ones(1, 3),
    )  # fmt: skip
    seen = in_camera(one, pose)
    torch.testing.assert_close(seen.means, torch.tensor([[0.0, -1, 1]]))
    torch.testing.assert_close(seen.quats, torch.tensor([[half, 0, 0, -half]]))


@pytest.mark.skipif(torch.cuda.is_available(), reason="this test is about machines without CUDA")
def test_gsplat_without_cuda_says_what_to_do() -> None:
    with pytest.raises(RuntimeError, match="gsplat"):
        render(surfels(), cameras(), SIZE, "gsplat")


def test_gsplat_without_its_kernels_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is where there is CUDA and no compiler: it imports, and has no kernels."""
    from tco.render.gsplat import _rasterizer

    package, folder, backend = (ModuleType(f"gsplat{end}") for end in ("", ".cuda", ".cuda._backend"))
    vars(package)["rasterization_2dgs"], vars(backend)["_C"], vars(folder)["_backend"] = None, None, backend
    for module in (package, folder, backend):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    with pytest.raises(RuntimeError, match=r"without its kernels.*nvcc"):
        _rasterizer(torch.device("cuda"))


@pytest.mark.skipif(not RUNS, reason="gsplat and CUDA are not both here")
@pytest.mark.parametrize("name", ["surfels", "at_borders"])
def test_gsplat_agrees_with_the_cpu(name: str) -> None:
    """No surfel is so opaque that the bound of alpha, which releases of gsplat have otherwise, matters."""
    scene = SCENES[name]()
    scene = replace(scene, opacities=0.9 * scene.opacities)
    ours = pictures_and_derivatives(scene.to("cuda", torch.float32), "gsplat")
    close(ours, pictures_and_derivatives(scene, "cpu"), 2e-3, 2e-2)
