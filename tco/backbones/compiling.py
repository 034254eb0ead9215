"""``torch.compile`` for networks that are adapted: compiled blocks must see the adapters that come and go."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeVar

import torch._dynamo
from torch import nn

from tco.backbones.base import Backbone

_Backbone = TypeVar("_Backbone", bound=Backbone)


def compiled(backbone: _Backbone, **options: Any) -> _Backbone:
    """The same backbone, the blocks of whose decoder are compiled when they are first called.

    Adapters are forward hooks (:mod:`tco.lora`), and by its default ``torch.compile`` does not look whether
    hooks came or went since it compiled a block: what was compiled before adaptation would go on without the
    adapters, without a word. So this sets ``torch._dynamo.config.skip_nnmodule_hook_guards`` to False, for
    the whole process. Blocks of the same shape share their code, which is compiled three times: plain,
    adapted, and adapted with gradients.

    Args:
        backbone: one whose decoder is made of lists of blocks, as those of VGGT, π³ and Depth Anything 3 are.
        options: of :meth:`torch.nn.Module.compile`, such as ``mode`` or ``backend``.
    """
    torch._dynamo.config.skip_nnmodule_hook_guards = False
    for block in _blocks(backbone.decoder()):
        block.compile(**options)
    return backbone


def _blocks(module: nn.Module) -> Iterator[nn.Module]:
    """The modules in lists and tables of modules, at any depth of these."""
    if not isinstance(module, nn.ModuleList | nn.ModuleDict):
        yield module
        return
    for child in module.children():
        yield from _blocks(child)
