"""Bytes that a published network's tensors take at once, counted from the shapes: nothing is computed.

The network runs on tensors without content (PyTorch's ``FakeTensorMode``), which choose the same operations
as those of a CPU would, and every storage counts from the operation that makes it until it is freed. So
whole networks at whole size take seconds, wherever this runs. What PyTorch needs inside an operation, the
process, and the rest of the pipeline are not in it: :mod:`benchmarks.memory` adds what it measures of them.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from benchmarks.backbone import drawn
from tco.backbones import da3, mini, pi3, vggt
from tco.backbones.base import Backbone
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
STATES = 6
"""Copies of the adapters: themselves, gradients, two moments of Adam, the best state, the one before it."""


class Count(NamedTuple):
    """Bytes.

    Attributes:
        weights: of the network.
        forward: beside them, encoding and then decoding all views.
        optimised: the same, then decoding one view with adapters, and going back.
    """

    weights: int
    forward: int
    optimised: int


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


def count(network: str, dtype: torch.dtype, size: tuple[int, int, int]) -> Count:
    """Count one size: views, width, height."""
    n, width, height = size
    module: Any = empty(network, dtype) if network not in IN_EARNEST else random(network, dtype)
    backbone: Backbone = module
    with nullcontext() if network in IN_EARNEST else FakeTensorMode():
        if network not in IN_EARNEST:
            fake(module)
        weights = sum(t.numel() * t.element_size() for t in tensors(module))
        views = Views(torch.zeros(n, 3, height, width), torch.ones(n, height, width) > 0, ("",) * n)
        priors = Priors(Cameras(torch.eye(4).repeat(n, 1, 1), torch.eye(3).repeat(n, 1, 1)))
        with Alive(module) as alive:
            with torch.no_grad():
                encoded = backbone.encode(views, priors)
                context = backbone.decode(encoded)
            forward = alive.most
            with adapted(backbone.decoder(), LoRAConfig()) as adapters:
                found = backbone.decode(encoded, [0], context)
                cameras = found.cameras
                (found.depth.sum() + cameras.world_from_cam.sum() + cameras.K.sum()).backward()
                states = (STATES - 1) * sum(p.numel() * p.element_size() for p in adapters)
        return Count(weights, forward, alive.most + states)
