"""Bytes that a published network's tensors take at once, counted from the shapes: nothing is computed.

The network runs on tensors without content (PyTorch's ``FakeTensorMode``), which choose the same operations
as those of a CPU would, and every storage counts from the operation that makes it until it is freed. So
whole networks at whole size take seconds, wherever this runs. For CUDA the two things are imitated that it
does otherwise (:func:`as_on`). What PyTorch needs inside an operation, the process, and the rest of the
pipeline are not in it: :mod:`benchmarks.memory` adds what it measures of them.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, NamedTuple
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from benchmarks.backbone import drawn
from tco.backbones import da3, mini, pi3, transformer, vggt
from tco.lora import LoRAConfig, adapted
from tco.types import Cameras, Priors, Views

NETWORKS: dict[str, tuple[Callable[[Any], nn.Module], Any, Callable[..., Any]]] = {
    "vggt": (vggt.VGGTNetwork, vggt.VGGTConfig.vggt_1b(), vggt.VGGT),
    "pi3": (pi3.Pi3Network, pi3.Pi3Config.large(), pi3.Pi3),
    "mini": (vggt.VGGTNetwork, mini.MINI, mini.Mini),
    "da3": (da3.DA3Network, da3.DA3Config.base(), da3.DA3),
    "da3-small": (da3.DA3Network, da3.DA3Config.small(), da3.DA3),
}
"""Network, published sizes, backbone."""
IN_EARNEST = ("da3", "da3-small")
"""Networks that ask for values on their way, so that they are run with random weights."""
EVERY_BLOCK = range(1000)
STATES = 6
"""Copies of the adapters: themselves, gradients, two moments of Adam, the best state, the one before it."""


class Count(NamedTuple):
    """Bytes.

    Attributes:
        weights: of the network.
        forward: beside them, encoding and then decoding all views.
        optimised: the same, then decoding one view with adapters, and going back.
        recomputed: the same, where the activations of all blocks are computed again on the way back.
    """

    weights: int
    forward: int
    optimised: int
    recomputed: int


class Alive(TorchDispatchMode):
    """Bytes of the storages that operations made and that are still there, and the most there were."""

    def __init__(self, network: nn.Module) -> None:
        """What the network holds does not count."""
        super().__init__()
        self.held = [t.untyped_storage() for t in tensors(network)]
        self.known = {storage._cdata for storage in self.held}
        self.now = self.most = 0

    def __torch_dispatch__(
        self, operation: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Run the operation and count what it made."""
        result = operation(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor):
                self._count(leaf.untyped_storage())
        return result

    def _count(self, storage: torch.UntypedStorage) -> None:
        key, size = storage._cdata, storage.nbytes()
        if key in self.known:
            return
        self.known.add(key)
        self.now += size
        self.most = max(self.most, self.now)
        weakref.finalize(storage, self._freed, key, size)

    def _freed(self, key: int, size: int) -> None:
        self.known.discard(key)
        self.now -= size


def tensors(network: nn.Module) -> list[Tensor]:
    """Parameters and buffers."""
    return [*network.parameters(), *network.buffers()]


def empty(network: str, dtype: torch.dtype) -> Any:
    """A published network whose tensors are on no device."""
    build, config, wrap = NETWORKS[network]
    with torch.device("meta"):
        return wrap(build(config), dtype).eval()


def random(network: str, dtype: torch.dtype) -> Any:
    """A published network with random weights."""
    build, config, wrap = NETWORKS[network]
    return drawn(lambda: wrap(build(config), dtype), torch.device("cpu")).eval().requires_grad_(False)


def fake(backbone: nn.Module) -> None:
    """Replace its tensors by ones that say they are on the CPU; call it within a ``FakeTensorMode``."""
    made: dict[int, nn.Parameter] = {}
    for module in backbone.modules():
        for name, p in module._parameters.items():
            if p is not None:
                like = torch.empty(p.shape, dtype=p.dtype)
                module._parameters[name] = made.setdefault(id(p), nn.Parameter(like, requires_grad=False))
        for name, b in module._buffers.items():
            if b is not None:
                module._buffers[name] = torch.empty(b.shape, dtype=b.dtype)


@contextmanager
def as_on(device: str) -> Iterator[None]:
    """Let a CPU choose types as a device does.

    On CUDA attention is computed in the type of its products, and autocast takes layer norms in float32: the
    queries and keys that are normalised are kept so.
    """
    if device != "cuda":
        yield
        return
    plain = torch.nn.functional.layer_norm

    def layer_norm(x: Tensor, *others: Any, **named: Any) -> Tensor:
        return plain(x.float() if torch.is_autocast_enabled("cpu") else x, *others, **named)

    with (
        patch.object(transformer, "attention_dtype", lambda _, products: products),
        patch.object(torch.nn.functional, "layer_norm", layer_norm),
    ):
        yield


def count(network: str, dtype: torch.dtype, size: tuple[int, int, int], device: str = "cpu") -> Count:
    """Count one size: views, width, height; as on a kind of device."""
    module: Any = empty(network, dtype) if network not in IN_EARNEST else random(network, dtype)
    with as_on(device), nullcontext() if network in IN_EARNEST else FakeTensorMode():
        if network not in IN_EARNEST:
            fake(module)
        weights = sum(t.numel() * t.element_size() for t in tensors(module))
        forward, optimised = _alive(module, size)
        module.recompute = EVERY_BLOCK
        _, recomputed = _alive(module, size)
        return Count(weights, forward, optimised, recomputed)


def _alive(backbone: Any, size: tuple[int, int, int]) -> tuple[int, int]:
    """Most bytes beside the weights: of a prediction, and of a step after it."""
    n, width, height = size
    views = Views(torch.zeros(n, 3, height, width), torch.ones(n, height, width) > 0, ("",) * n)
    priors = Priors(Cameras(torch.eye(4).repeat(n, 1, 1), torch.eye(3).repeat(n, 1, 1)))
    with Alive(backbone) as alive:
        with torch.no_grad():
            encoded = backbone.encode(views, priors)
            context = backbone.decode(encoded)
        forward = alive.most
        with adapted(backbone.decoder(), LoRAConfig()) as adapters:
            found = backbone.decode(encoded, [0], context)
            cameras = found.cameras
            (found.depth.sum() + cameras.world_from_cam.sum() + cameras.K.sum()).backward()
            states = (STATES - 1) * sum(p.numel() * p.element_size() for p in adapters)
    return forward, alive.most + states
