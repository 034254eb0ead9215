"""``colmap-tco check`` says what densify will do, and does nothing itself."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from colmap_tco.backbones import Budget, NetworkConfig, select
from colmap_tco.check import CheckConfig, check
from colmap_tco.errors import InputError, MissingError
from colmap_tco.memory import canvas_pixels, footprint
from colmap_tco.progress import Progress
from colmap_tco.published import NETWORKS, PUBLISHED
from colmap_tco.views import ViewConfig, make_views
from colmap_tco.weights import _note_accepted
from colmap_tco.workspace import open_workspace
from tco.options import TCOConfig
from tests.colmap_tco.test_backbones import empty_cache, fetched, written

if TYPE_CHECKING:
    from tests.conftest import Room

__all__ = ["empty_cache"]

PLAIN = CheckConfig(network=NetworkConfig(device="cpu"))


def test_every_network_is_told_with_its_need_and_its_state(room: Room) -> None:
    before = sorted(room.root.rglob("*"))
    found = check(room.root, PLAIN, Progress())
    assert sorted(room.root.rglob("*")) == before
    assert [need.network.name for need in found.needs] == list(NETWORKS)
    states = {need.network.name: need.state for need in found.needs}
    assert states["sweep"] == "ready"
    assert states["vggt"] == "not fetched (5.0 GB, CC BY-NC 4.0): colmap-tco weights fetch vggt"
    assert states["mini"].startswith("no weights yet: python -m benchmarks.gpu.train_mini")
    text = found.summary()
    assert "7 images registered in " in text and "densify would run on cpu" in text
    assert "densify would run sweep (auto: no weights" in text
    for need in found.needs:
        needs = footprint(need.network.name, "cpu", 40, recompute=need.recompute)
        assert need.bytes == needs.bytes(need.chunk, need.size[0] * need.size[1])


def test_it_plans_as_densify_does(make_workspace: Callable[..., Path], shot: type, tmp_path: Path) -> None:
    """The same canvas and the same chunks, with mixed sizes and a given number of views."""
    root = make_workspace(tmp_path / "w", [shot((160, 120))] * 4 + [shot((120, 160))] * 3)
    views, _ = make_views(open_workspace(root), ViewConfig(), NETWORKS["sweep"].stride)
    (need, *_) = check(root, PLAIN, Progress()).needs
    assert need.size[0] * need.size[1] == canvas_pixels(views)
    budget = Budget.of(select(PLAIN.network), views, PLAIN.network, steps=40)
    assert need.chunk == min(budget.views(), 7)
    three = replace(PLAIN, network=replace(PLAIN.network, chunk_size=3))
    assert check(root, three, Progress()).needs[0].chunk == 3
    forward = check(root, replace(PLAIN, tco=TCOConfig(steps=0)), Progress()).needs[0]
    assert forward.bytes <= need.bytes
    larger = check(root, replace(PLAIN, views=ViewConfig(max_image_size=64)), Progress()).needs[0]
    assert max(larger.size) == 64


def test_activations_computed_again_are_planned_as_densify_does(room: Room, tmp_path: Path) -> None:
    file = str(written(tmp_path / "w.safetensors", "vggt"))
    plain = NetworkConfig(backbone="vggt", weights=file, device="cpu")
    told, bytes_of = {}, {}
    for choice in ("always", "never"):
        config = replace(PLAIN, network=replace(plain, recompute=choice))
        found = check(room.root, config, Progress())
        need = next(need for need in found.needs if need.network.name == "vggt")
        told[choice], bytes_of[choice] = found.choice, need.bytes
        chosen = select(config.network)
        views, _ = make_views(open_workspace(room.root), ViewConfig(), chosen.network.stride, 518)
        budget = Budget.of(chosen, views, config.network, steps=config.tco.steps)
        assert budget.recompute is need.recompute is (choice == "always")
        assert budget.needs.bytes(need.chunk, budget.pixels) == need.bytes
    assert bytes_of["always"] < bytes_of["never"]
    assert "activations computed again" in told["always"] and "again" not in told["never"]


def test_bare_images_are_enough(room: Room, tmp_path: Path) -> None:
    shutil.copytree(room.root / "images", tmp_path / "images")
    found = check(tmp_path, PLAIN, Progress())
    assert f"7 images in {tmp_path / 'images'}, which densify would map first" in found.images
    assert found.needs[0].size == (320, 240)
    alone = tmp_path / "alone" / "images"
    alone.mkdir(parents=True)
    shutil.copy(next((room.root / "images").iterdir()), alone)
    with pytest.raises(InputError, match="one picture; densify needs at least two"):
        check(alone.parent, PLAIN, Progress())
    elsewhere = replace(PLAIN, workspace=replace(PLAIN.workspace, image_path=str(room.root / "sparse")))
    with pytest.raises(InputError, match="no pictures"):
        check(tmp_path, elsewhere, Progress())


def test_what_would_stop_densify_is_told(room: Room, tmp_path: Path) -> None:
    vggt = replace(PLAIN, network=NetworkConfig(backbone="vggt", device="cpu"))
    assert (
        "densify would stop: the weights of vggt are not on this machine"
        in check(room.root, vggt, Progress()).choice
    )
    file = str(written(tmp_path / "w.safetensors", "pi3"))
    mine = replace(PLAIN, network=NetworkConfig(weights=file, device="cpu"))
    assert f"densify would run pi3 ({file} holds weights of pi3)" in check(room.root, mine, Progress()).choice
    states = {need.network.name: need.state for need in check(room.root, mine, Progress()).needs}
    assert states["pi3"] == "ready"
    assert {states[name] for name in ("sweep", "vggt")} == {"the file named with --weights is not of it"}
    with pytest.raises(MissingError, match="--device cuda:99"):
        check(room.root, replace(PLAIN, network=NetworkConfig(device="cuda:99")), Progress())


def test_ready_is_what_densify_runs(room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fetched weights do not suffice: auto asks for the licence, and da3 for its authors' package."""

    def state(name: str) -> str:
        return next(n.state for n in check(room.root, PLAIN, Progress()).needs if n.network.name == name)

    fetched(tmp_path, "pi3")
    assert state("pi3").startswith(
        "ready with --backbone pi3; auto leaves it out until its licence is accepted"
    )
    _note_accepted(*PUBLISHED["pi3"])
    assert state("pi3") == "ready"
    monkeypatch.setitem(NETWORKS, "da3", replace(NETWORKS["da3"], modules=("no_such_module",)))
    fetched(tmp_path, "da3")
    assert state("da3").startswith("needs no_such_module, not installed: pip install")
