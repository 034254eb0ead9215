"""A device that is not the CPU, for tests on machines that have none: what mixes the two is an error.

Tensors of the device hold one of the CPU's and say that they are elsewhere. Within :class:`Elsewhere` an
operation on them, or one that makes tensors there, is done on the CPU and its result is elsewhere again.
Compiled loops cannot reach them, and, as with a GPU, an operation on tensors of both devices fails, unless
those of the CPU are scalars or the indices of others.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

NAME = "elsewhere"
_setup_privateuseone_for_python_backend(NAME)
PLACE = torch.device(NAME, 0)
torch.get_device_module(NAME).get_amp_supported_dtype = lambda: [torch.bfloat16]
INDEXED = {torch.ops.aten.index.Tensor, torch.ops.aten.index_put_.default, torch.ops.aten.index_put.default,
           torch.ops.aten._index_put_impl_.default}  # fmt: skip
MOVES = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}


class There(torch.Tensor):
    """A tensor that is elsewhere."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> There:
        made = torch.Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), storage_offset=inner.storage_offset(),
            dtype=inner.dtype, device=PLACE,
        )  # fmt: skip
        made.inner = inner
        return made

    def tolist(self) -> Any:
        """The values."""
        return self.inner.tolist()

    def new_tensor(self, data: Any, **kwargs: Any) -> Tensor:
        """New values elsewhere."""
        return There(self.inner.new_tensor(data, **kwargs))

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return done(operation, args, kwargs or {})


def _empty(size: list[int], stride: list[int], *, dtype: torch.dtype | None = None, **_: Any) -> There:
    return There(torch.empty_strided(size, stride, dtype=dtype))


def _filled(source: Tensor, into: Tensor, non_blocking: bool = False) -> Tensor:
    assert isinstance(into, There)
    into.inner.copy_(source.inner if isinstance(source, There) else source)
    return into


KERNELS = torch.library.Library("aten", "IMPL")
"""What PyTorch calls by itself, where no mode sees it, to take lists of indices to where they are used."""
KERNELS.impl("empty_strided", _empty, "PrivateUse1")
KERNELS.impl("_copy_from", _filled, "PrivateUse1")


class Elsewhere(TorchDispatchMode):
    """Makes tensors elsewhere where that is asked for."""

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return done(operation, args, kwargs or {})


def done(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """An operation on the CPU, its result where it belongs."""
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    there = [t for t in tensors if isinstance(t, There)]
    asked = kwargs.get("device")
    result_there = bool(there) if asked is None else torch.device(asked).type == NAME
    if operation in MOVES and asked is None:
        result_there = isinstance(args[0], There)
    elif operation not in MOVES:
        here = [t for t in tensors if not isinstance(t, There) and t.dim()]
        fine = operation in INDEXED and isinstance(args[0], There)
        if there and here and not fine:
            raise RuntimeError(f"{operation}: tensors of two devices")
    if asked is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    same = {id(t.inner): t for t in there}
    inner_args, inner_kwargs = tree_map(lambda x: x.inner if isinstance(x, There) else x, (args, kwargs))
    result = operation(*inner_args, **inner_kwargs)
    if not result_there:
        return result
    return tree_map(lambda x: same.get(id(x), There(x)) if isinstance(x, Tensor) else x, result)


def moved(module: nn.Module) -> nn.Module:
    """A copy of a module, elsewhere."""
    far = copy.deepcopy(module)
    for part in far.modules():
        for name, p in part._parameters.items():
            if p is not None:
                part._parameters[name] = nn.Parameter(There(p.detach()), requires_grad=p.requires_grad)
        for name, b in part._buffers.items():
            if b is not None:
                part._buffers[name] = There(b)
    return far
