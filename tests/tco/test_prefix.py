"""Blocks before the first that adapters change are computed once, and nothing is changed by that."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from benchmarks.wall import scene
from tco.align import KnownCameras
from tco.backbones.base import RunsAhead
from tco.backbones.prefix import first_block
from tco.lora import LoRAConfig, adapted, changed
from tco.optimize import optimize
from tco.options import AblationConfig, PolishConfig, TCOConfig
from tco.types import Priors
from tests.tco.published import some_views, sum_of, tiny_da3, tiny_pi3, tiny_vggt

NEEDS_DA3 = pytest.mark.skipif(find_spec("depth_anything_3") is None, reason="depth-anything-3 is not there")
TINY = [tiny_vggt, tiny_pi3, pytest.param(tiny_da3, marks=NEEDS_DA3)]


def blocks(backbone: Any) -> list[nn.Module]:
    """The decoder's blocks in the order in which they run."""
    decoder = backbone.decoder()
    if isinstance(decoder, nn.ModuleDict):
        return [block for pair in zip(*decoder.values(), strict=True) for block in pair]
    return list(decoder)


def names_from(backbone: Any, first: int) -> tuple[str, ...]:
    """Patterns of the layers of the blocks from an index on."""
    decoder = backbone.decoder()
    count = len(next(iter(decoder.values()))) if isinstance(decoder, nn.ModuleDict) else len(decoder)
    return tuple(f"{i}.attn.qkv" for i in range(first, count))


def counted(backbone: Any) -> list[int]:
    """Counts of the calls of each block, which go on counting."""
    counts = [0] * len(blocks(backbone))

    def hook(index: int) -> Callable[..., None]:
        def add(*_: object) -> None:
            counts[index] += 1

        return add

    for i, block in enumerate(blocks(backbone)):
        block.register_forward_hook(hook(i))
    return counts


@pytest.mark.parametrize("tiny", TINY)
@pytest.mark.parametrize("first", [0, 1, 2, 3])
def test_the_same_prediction_and_gradients(tiny: Callable[[], Any], first: int) -> None:
    """To the last bit: the same operations on the same numbers."""
    backbone = tiny()
    assert isinstance(backbone, RunsAhead)
    config = LoRAConfig(targets=names_from(backbone, first))
    encoded = backbone.encode(some_views(), Priors())
    ahead = backbone.ahead(encoded, changed(backbone.decoder(), config))
    found: list[list[Tensor]] = []
    for features in (encoded, ahead):
        with adapted(backbone.decoder(), config) as parameters:
            with torch.no_grad():
                for p in parameters:
                    p.add_(0.02)
            value = sum_of(backbone, features)
            value.backward()
            grads = [p.grad for p in parameters]
            assert all(g is not None for g in grads)
            found.append([value.detach(), *(g for g in grads if g is not None)])
    assert len(found[0]) > 1
    for a, b in zip(*found, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("tiny", TINY)
def test_what_is_behind_is_not_run_again(tiny: Callable[[], Any]) -> None:
    backbone = tiny()
    encoded = backbone.encode(some_views(), Priors())
    ahead = backbone.ahead(encoded, names_from(backbone, 2))
    counts = counted(backbone)
    with torch.no_grad():
        backbone.decode(ahead, [0])
    behind = 4 if isinstance(backbone.decoder(), nn.ModuleDict) else 2
    assert counts == [0] * behind + [1] * (len(counts) - behind)
    assert not ahead.passed.tokens.requires_grad


def test_optimisation_runs_the_first_blocks_once_more_whatever_the_number_of_steps() -> None:
    """Once for the prediction before any step, once ahead of the steps."""
    results = []
    last, every = names_from(tiny_vggt(), 3), ("*qkv",)
    for targets, ahead in ((last, True), (every, True), (last, False)):
        backbone = tiny_vggt()
        counts = counted(backbone)
        depth = torch.rand(3, 42, 56, generator=torch.Generator().manual_seed(3)) + 1
        config = TCOConfig(
            steps=4, lora_targets=targets, photometric_weight=0, depth_weight=1,
            polish=PolishConfig(polish_looks=0), ablation=AblationConfig(run_ahead=ahead),
        )  # fmt: skip
        optimize(backbone, some_views(), Priors(depth=depth), config)
        results.append(counts)
    few, all_blocks, published = results
    assert few[:6] == [2] * 6
    assert few[-1] == all_blocks[0] == all_blocks[-1] > 4
    assert published == all_blocks, "as published, all blocks are run in every step"
    assert not config.ablation.run_ahead and not TCOConfig().reference_schedule().ablation.run_ahead


def test_a_network_that_is_held_to_known_cameras_runs_ahead_too() -> None:
    backbone, (views, priors) = tiny_vggt(), scene(3, (42, 56))
    wrapped = KnownCameras(backbone)
    encoded = wrapped.encode(views, priors)
    ahead = wrapped.ahead(encoded, names_from(backbone, 2))
    counts = counted(backbone)
    with torch.no_grad():
        plain, again = wrapped.decode(encoded, [2, 0]), wrapped.decode(ahead, [2, 0])
    assert counts == [1, 1, 1, 1, 2, 2, 2, 2]
    assert torch.equal(plain.depth, again.depth) and torch.equal(plain.confidence, again.confidence)


def test_the_first_block_of_names() -> None:
    assert first_block(["frame_blocks.3.attn.qkv", "global_blocks.2.mlp.fc1"], 9) == 2
    assert first_block(["1.attn.qkv"], 9, start=4) == 5
    assert first_block(["7.attn", "norm"], 9) == 0, "a layer that is in no block may come before all"
    assert first_block([], 9, start=4) == 13, "nothing changes: all blocks can be ahead"


def test_modules_that_are_trained_in_full_count_as_changed() -> None:
    decoder = tiny_vggt().decoder()
    names = changed(decoder, LoRAConfig(targets=("3.attn.qkv",), unfrozen=("frame_blocks.1.mlp",)))
    assert first_block(names, 4) == 1
    assert first_block(changed(decoder, LoRAConfig(targets=("3.attn.qkv",))), 4) == 3
    with pytest.raises(ValueError, match="fits no parameters"):
        changed(decoder, LoRAConfig(targets=("3.attn.qkv",), unfrozen=("nothing",)))
