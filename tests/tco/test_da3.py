"""Depth Anything 3: what the authors' package computes, with and without cameras; files; gradients."""

from __future__ import annotations

import ast
import functools
import importlib.util
import json
import math
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file, save_model
from torch import Tensor, nn

from colmap_tco.published import PUBLISHED
from tco.backbones.base import Backbone
from tco.backbones.checkpoints import save, tied
from tco.backbones.da3 import DA3, DA3Config, DA3Network, _reference, load, normalized_cameras
from tco.backbones.dinov2 import normalized
from tco.backbones.identify import identify
from tco.backbones.weights import WeightsError
from tco.geometry import invert, rigid, so3_exp
from tco.types import Cameras, Prediction, Priors, Views
from tests.tco.published import (
    TINY_DA3,
    check_any_size,
    check_bfloat16,
    check_gradients,
    check_recomputing,
    check_subset,
    difference,
    randomized,
    some_views,
    tiny_da3,
)

PACKAGE = importlib.util.find_spec("depth_anything_3")
if PACKAGE is None or PACKAGE.submodule_search_locations is None:
    pytest.skip("the package depth-anything-3 is not installed", allow_module_level=True)
PRESETS = {"da3-base": DA3Config.base(), "da3-small": DA3Config.small()}
NEAR = 1e-5


def some_cameras(count: int, size: tuple[int, int], spread: float = 3.0) -> Cameras:
    """Cameras in different places, turned and with different focal lengths."""
    generator = torch.Generator().manual_seed(7)
    turn, centre = torch.randn(2, count, 3, generator=generator)
    K = torch.eye(3).repeat(count, 1, 1)
    K[:, 0, 0], K[:, 1, 1] = torch.linspace(40, 60, count), torch.linspace(45, 52, count)
    K[:, 0, 2], K[:, 1, 2] = 0.5 * size[1], 0.5 * size[0]
    return Cameras(rigid(so3_exp(0.5 * turn), spread * centre), K)


def package_normalisation() -> Any:
    """The method of the package's interface, taken from its file: the module itself imports far more."""
    from depth_anything_3.utils.geometry import affine_inverse

    assert PACKAGE is not None and PACKAGE.submodule_search_locations
    tree = ast.parse((Path(PACKAGE.submodule_search_locations[0]) / "api.py").read_text(encoding="utf-8"))
    (method,) = (n for n in ast.walk(tree) if getattr(n, "name", "") == "_normalize_extrinsics")
    assert isinstance(method, ast.FunctionDef)
    names: dict[str, Any] = {"torch": torch, "affine_inverse": affine_inverse}
    future = ast.parse("from __future__ import annotations").body
    exec(compile(ast.Module([*future, method], []), "api.py", "exec"), names)
    return names["_normalize_extrinsics"]


@torch.no_grad()
def by_package(network: nn.Module, views: Views, cameras: Cameras | None) -> dict[str, Tensor]:
    """What the package's own forward pass gives, in our terms."""
    model: Any = network.get_submodule("model")
    given: tuple[Tensor, ...] = ()
    if cameras is not None:
        cam_from_world = invert(cameras.world_from_cam).unsqueeze(0)
        given = (package_normalisation()(None, cam_from_world), cameras.K.unsqueeze(0))
    out = model(normalized(views.images).unsqueeze(0), *given)
    bottom = torch.tensor([0.0, 0, 0, 1]).expand(len(views), 1, 4)
    pose = invert(torch.cat([out.extrinsics[0], bottom], 1))
    return {
        "depth": out.depth[0],
        "confidence": out.depth_conf[0],
        "world_from_cam": pose,
        "K": out.intrinsics[0],
    }


def assert_same(ours: Prediction, theirs: dict[str, Tensor]) -> None:
    assert difference(ours.depth, theirs["depth"]) < NEAR
    assert difference(ours.confidence, theirs["confidence"]) < NEAR
    assert difference(ours.cameras.world_from_cam, theirs["world_from_cam"]) < NEAR
    assert difference(ours.cameras.K, theirs["K"]) < NEAR


@torch.no_grad()
def predicted(backbone: Backbone, views: Views, cameras: Cameras | None = None) -> Prediction:
    return backbone.decode(backbone.encode(views, Priors(cameras=cameras)))


@pytest.fixture(scope="module")
def backbone() -> DA3:
    return tiny_da3()


def test_it_is_a_backbone(backbone: DA3) -> None:
    assert isinstance(backbone, Backbone)
    encoded = backbone.encode(some_views(), Priors())
    assert backbone.with_points(encoded, {}) is encoded


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize(("count", "size"), [(1, (28, 42)), (2, (56, 28)), (3, (42, 42)), (5, (28, 42))])
def test_it_gives_what_the_package_gives(
    backbone: DA3, count: int, size: tuple[int, int], known: bool
) -> None:
    views = some_views(count, size)
    cameras = some_cameras(count, size) if known else None
    assert_same(predicted(backbone, views, cameras), by_package(backbone.network, views, cameras))


def test_any_view_can_be_the_reference(backbone: DA3) -> None:
    """The package moves it to the front and back; the same numbers come without."""
    vit, found = backbone.transformer, set()
    for seed in range(12):
        views = some_views(4, (28, 42), seed)
        with torch.no_grad():
            x = vit.prepare_tokens_with_masks(normalized(views.images).unsqueeze(0))
            for i in range(backbone.network.config.start - 1):
                x = vit.process_attention(x, vit.blocks[i], "local")
        if (reference := _reference(x)) not in found:
            found.add(reference)
            assert_same(predicted(backbone, views), by_package(backbone.network, views, None))
    assert len(found) > 1


def test_cameras_that_are_known_change_the_prediction_but_not_with_the_world(backbone: DA3) -> None:
    """Another world frame or unit of length is the same to the network; another camera is not."""
    views, cameras = some_views(4), some_cameras(4, (42, 56))
    plain = predicted(backbone, views, cameras)
    assert difference(predicted(backbone, views).depth, plain.depth) > 1e-3
    world = rigid(so3_exp(torch.tensor([0.3, -1.0, 2.0])), torch.tensor([5.0, -2.0, 1.0]))
    moved = world @ cameras.world_from_cam
    moved[:, :3, 3] *= 3.7
    again = predicted(backbone, views, Cameras(moved, cameras.K))
    assert difference(again.depth, plain.depth) < 1e-4
    other = Cameras(cameras.world_from_cam, 1.5 * cameras.K)
    assert difference(predicted(backbone, views, other).depth, plain.depth) > 1e-4


@pytest.mark.parametrize(("count", "spread"), [(1, 1.0), (2, 1.0), (5, 1.0), (6, 20.0), (5, 1e-3)])
def test_cameras_are_normalised_as_the_package_does(count: int, spread: float) -> None:
    pose = some_cameras(count, (28, 28), spread).world_from_cam
    theirs = package_normalisation()(None, invert(pose).unsqueeze(0))[0]
    torch.testing.assert_close(normalized_cameras(pose), theirs, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("chosen", [[2], [3, 0]])
def test_some_views_are_decoded_as_all_are(backbone: DA3, chosen: list[int]) -> None:
    check_subset(backbone, chosen)


@pytest.mark.parametrize(("count", "size"), [(1, (28, 42)), (3, (70, 28)), (9, (28, 28))])
def test_any_number_and_size(backbone: DA3, count: int, size: tuple[int, int]) -> None:
    check_any_size(backbone, count, size)


@pytest.mark.parametrize("size", [(30, 42), (42, 30)])
def test_a_canvas_that_is_not_made_of_patches_is_refused(backbone: DA3, size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"{size[1]}×{size[0]}.*divisible by 14"):
        backbone.encode(some_views(2, size), Priors())


def test_gradients_of_adapters() -> None:
    check_gradients(tiny_da3(), cameras=True)


def test_gradients_of_adapters_with_cameras() -> None:
    given = some_cameras(3, (42, 56))

    class Given(DA3):
        def encode(self, views: Views, priors: Priors) -> Any:
            # The package encodes cameras in float32 whatever the type of its weights.
            single = tiny_da3().encode(Views(views.images.float(), views.valid, views.names), Priors(given))
            return type(single)(single.tokens.double(), single.grid)

    check_gradients(Given(tiny_da3().network).eval().requires_grad_(False), cameras=True)


def test_recomputing_changes_no_gradient(backbone: DA3) -> None:
    check_recomputing(backbone, tiny_da3(recompute=range(3, 5)))


def test_bfloat16(backbone: DA3) -> None:
    check_bfloat16(backbone, tiny_da3(dtype=torch.bfloat16))


def test_adapters_reach_the_blocks_after_the_cameras_alone(backbone: DA3) -> None:
    inside = {id(p) for p in backbone.decoder().parameters()}
    names = {name for name, p in backbone.network.named_parameters() if id(p) in inside}
    after = tuple(f"model.backbone.pretrained.blocks.{i}." for i in range(TINY_DA3.start, TINY_DA3.depth))
    assert names == {name for name in backbone.network.state_dict() if name.startswith(after)}


@pytest.mark.parametrize("start", [3, 5])
def test_sizes_that_the_network_cannot_have_are_refused(start: int) -> None:
    with pytest.raises(ValueError, match="first adapted block is even"):
        DA3Config(start=start)


def file_size(network: nn.Module) -> int:
    """Bytes of the safetensors file of a network on any device, by the format: header, padded to 8, and data.

    A tied tensor is there once, under its first name, and the metadata lists its other names.
    """
    table: dict[str, Any] = {"__metadata__": {n: same[0] for same in tied(network) for n in same[1:]}}
    end = 0
    for name, tensor in sorted(network.state_dict().items()):
        if name not in table["__metadata__"]:
            start, end = end, end + tensor.element_size() * tensor.numel()
            table[name] = {"dtype": "F32", "shape": list(tensor.shape), "data_offsets": [start, end]}
    return 8 + 8 * math.ceil(len(json.dumps(table, separators=(",", ":"))) / 8) + end


def test_the_size_of_a_file_is_foreseen(backbone: DA3, tmp_path: Path) -> None:
    save_model(backbone.network, str(tmp_path / "w"))
    assert file_size(backbone.network) == (tmp_path / "w").stat().st_size


@pytest.mark.parametrize(("name", "network"), [("da3-base", "da3"), ("da3-small", "da3-small")])
def test_sizes_names_and_shapes_are_the_published(
    monkeypatch: pytest.MonkeyPatch, name: str, network: str
) -> None:
    """The file of the package's preset has, to the byte, the size of the published one."""
    from depth_anything_3.cfg import create_object, load_config

    on_cpu = functools.partial(torch.linspace, device="cpu")
    monkeypatch.setattr(torch, "linspace", on_cpu)  # the package reads numbers from it as it builds
    with torch.device("meta"):
        made = DA3Network(PRESETS[name])
        theirs = create_object(load_config(f"depth_anything_3.configs.{name}"))
    shapes = {f"model.{key}": t.shape for key, t in theirs.state_dict().items()}
    assert {key: t.shape for key, t in made.state_dict().items()} == shapes
    assert theirs.backbone.out_layers == list(PRESETS[name].layers)
    vit, ours = theirs.backbone.pretrained, made.model.backbone.pretrained
    for key in ("alt_start", "qknorm_start", "rope_start", "cat_token", "num_heads", "interpolate_offset"):
        assert getattr(vit, key) == getattr(ours, key), key
    assert theirs.head.activation == made.model.head.activation == "exp"
    assert file_size(made) == PUBLISHED[network][1].size


def test_a_checkpoint_with_the_authors_names_round_trips(backbone: DA3, tmp_path: Path) -> None:
    path = tmp_path / "da3.safetensors"
    save(path, backbone.network, TINY_DA3)
    assert identify(path).network == "da3"
    loaded = load(path, dtype=torch.float32)
    assert not loaded.training and not any(p.requires_grad for p in loaded.parameters())
    a, b = (predicted(x, some_views()) for x in (backbone, loaded))
    assert torch.equal(a.depth, b.depth) and torch.equal(a.cameras.K, b.cameras.K)


@pytest.mark.slow
def test_a_file_as_the_authors_write_it_is_loaded_and_told_by_its_width(tmp_path: Path) -> None:
    network = randomized(DA3Network(DA3Config.small()))
    save_model(network, str(tmp_path / "model.safetensors"))
    loaded = load(tmp_path / "model.safetensors", dtype=torch.float32)
    assert loaded.network.config == DA3Config.small()
    views = some_views(2, (28, 42))
    assert_same(predicted(loaded, views), by_package(network.eval(), views, None))


def test_other_files_are_refused(backbone: DA3, tmp_path: Path) -> None:
    tensors = dict(backbone.network.state_dict())
    for names in tied(backbone.network):
        for name in names[1:]:
            del tensors[name]
    save_file(tensors, tmp_path / "tiny")
    with pytest.raises(WeightsError, match=r"are not the \d+ of DA3Network: .*of another shape"):
        load(tmp_path / "tiny")
    info = {"config": json.dumps(vars(TINY_DA3))}
    del tensors["model.cam_enc.token_norm.bias"]
    save_file(tensors, tmp_path / "less", info)
    with pytest.raises(WeightsError, match=r"1 missing \(model\.cam_enc\.token_norm\.bias\)"):
        load(tmp_path / "less")


def test_without_the_package_the_remedy_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "depth_anything_3.model.cam_dec", None)
    with pytest.raises(ModuleNotFoundError, match=r"is missing: pip install .* --no-deps depth-anything-3=="):
        DA3Network(TINY_DA3)


def test_nothing_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    predicted(tiny_da3(), some_views(3))
    printed = capsys.readouterr()
    assert printed.out == printed.err == ""
