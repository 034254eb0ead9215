"""Low-rank adaptation of a module for the time of a ``with`` block (LoRA, Hu et al. 2021).

An adapted layer computes ``W x + (alpha / rank) · B A x`` with its frozen W, a random A that maps to
``rank`` channels and a B that starts at zero, so that the output is unchanged at first.

A linear layer gets the low-rank branch as a forward hook: its backward pass then needs no gradient of
the shape of W, which costs as much as the layer itself (384 → 1536 channels, forward and backward on
one core: 20 % more time than the frozen layer, against 49 % for adding B A to W). A convolution gets
B A added to its weight on the way to the kernel, because a convolution to few channels is slow for its
size (3×3×3, 16 channels: 2.1 times the frozen layer, against 3.0 for a branch). Neither replaces a
layer or a parameter: structure, names and state dict are the same even inside the block, and leaving
it removes what was hooked in.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tco.config import knob

Layer = nn.Linear | nn.Conv2d | nn.Conv3d
_KINDS = (nn.Linear, nn.Conv2d, nn.Conv3d)


@dataclass(frozen=True)
class LoRAConfig:
    """Which layers are adapted, and how."""

    rank: int = knob(4, "Rank of the adapters: more fits more, and overfits sooner.")
    alpha: float = knob(16.0, "The low-rank branch is scaled by alpha / rank; acts like a learning rate.")
    targets: tuple[str, ...] = knob(
        ("qkv", "proj", "fc1", "fc2"),
        "Glob patterns of layer names; one matches a whole dotted name or its last components, and * "
        "crosses dots. Linear, Conv2d and Conv3d layers can be adapted.",
    )
    unfrozen: tuple[str, ...] = knob(
        (), "Glob patterns of modules that are trained in full instead, such as heads (ablation)."
    )
    seed: int = knob(0, "Seed of the random half of the adapters.")

    def __post_init__(self) -> None:
        if self.rank < 1:
            raise ValueError(f"the rank of an adapter is at least 1, not {self.rank}")


def matches(name: str, pattern: str) -> bool:
    """True if the glob fits the dotted name or its last components: ``qkv`` fits ``blocks.3.attn.qkv``."""
    return fnmatchcase(name, pattern) or fnmatchcase(name, f"*.{pattern}")


def fits(module: nn.Module, pattern: str) -> bool:
    """Whether a pattern fits any layer of ``module`` that an adapter can be put on."""
    return any(isinstance(m, _KINDS) and matches(name, pattern) for name, m in module.named_modules())


def select(module: nn.Module, patterns: Iterable[str]) -> dict[str, Layer]:
    """The layers of ``module`` that an adapter can be put on and whose names fit one of the patterns.

    Raises:
        ValueError: a pattern fits no such layer, or one whose kind of use cannot be adapted: a grouped
            convolution, or the output layer of ``nn.MultiheadAttention``, which reads the weight of
            that layer without calling it.
    """
    layers = {name: m for name, m in module.named_modules() if isinstance(m, _KINDS)}
    chosen: set[str] = set()
    for pattern in patterns:
        hits = {name for name in layers if matches(name, pattern)}
        if not hits:
            raise ValueError(
                f"the target {pattern!r} fits no Linear, Conv2d or Conv3d layer of "
                f"{type(module).__name__}; it has, among others, {', '.join(list(layers)[:8]) or 'none'}"
            )
        chosen |= hits
    for name in chosen:
        layer = layers[name]
        if isinstance(layer, nn.modules.linear.NonDynamicallyQuantizableLinear):
            raise ValueError(f"{name} is never called by its nn.MultiheadAttention and cannot be adapted")
        if not isinstance(layer, nn.Linear) and layer.groups != 1:
            raise ValueError(f"{name} is a convolution of {layer.groups} groups; only one can be adapted")
    return {name: layer for name, layer in layers.items() if name in chosen}


def changed(module: nn.Module, config: LoRAConfig) -> list[str]:
    """Dotted names of what :func:`adapted` changes in ``module``: layers, and modules trained in full.

    Raises:
        ValueError: a pattern that fits nothing, or a layer that cannot be adapted.
    """
    _unfrozen(module, config.unfrozen)
    whole = [n for n, _ in module.named_modules() if n and any(matches(n, p) for p in config.unfrozen)]
    return [*select(module, config.targets), *whole]


@contextmanager
def adapted(
    module: nn.Module, config: LoRAConfig | None = None, generator: torch.Generator | None = None
) -> Iterator[list[nn.Parameter]]:
    """Adapters on ``module`` inside the block; bit-identical to before when it is left.

    Yields the parameters to optimise: A and B of every adapted layer in the order of
    ``module.named_modules()``, then those of ``config.unfrozen``. All other parameters are frozen.
    Adapters are at least float32, on the device of their layer. When the block is left, also by an
    exception, the adapters are gone and unfrozen parameters, buffers, ``requires_grad`` and the training
    mode of each submodule are as they were.

    Args:
        module: what is adapted; its structure and state dict do not change.
        config: rank, scale and targets.
        generator: a CPU generator to draw A from, instead of a new one with ``config.seed``.

    Raises:
        ValueError: a pattern that fits nothing, or a layer that cannot be adapted.
    """
    config = config or LoRAConfig()
    layers = select(module, config.targets)
    unfrozen = _unfrozen(module, config.unfrozen)
    generator = generator or torch.Generator().manual_seed(config.seed)
    restore = _snapshot(module, unfrozen)
    parameters: list[nn.Parameter] = []
    with ExitStack() as stack:
        stack.callback(restore)
        module.requires_grad_(False)
        for layer in layers.values():
            a, b = _adapter(layer, config.rank, generator)
            parameters += [a, b]
            stack.callback(_attach(layer, a, b, config.alpha / config.rank))
        for parameter in unfrozen:
            parameter.requires_grad_(True)
        yield parameters + unfrozen


def _unfrozen(module: nn.Module, patterns: Iterable[str]) -> list[nn.Parameter]:
    """Parameters inside the submodules that fit the patterns, each once."""
    chosen: dict[int, nn.Parameter] = {}
    for pattern in patterns:
        hits = [m for name, m in module.named_modules() if name and matches(name, pattern)]
        found = [p for hit in hits for p in hit.parameters()]
        if not found:
            raise ValueError(f"the pattern {pattern!r} fits no parameters of {type(module).__name__}")
        chosen.update((id(p), p) for p in found)
    return list(chosen.values())


def _snapshot(module: nn.Module, unfrozen: list[nn.Parameter]) -> Callable[[], None]:
    """Remember all that a ``with`` block may change; the result puts it back.

    Frozen parameters are not copied: nothing writes to them. Buffers are, as batch normalisation does.
    """
    flags = [(p, p.requires_grad) for p in module.parameters()]
    modes = [(m, m.training) for m in module.modules()]
    values: list[tuple[Tensor, Tensor]] = [(t, t.detach().clone()) for t in [*unfrozen, *module.buffers()]]
    gradients = [(p, p.grad) for p in module.parameters()]

    def restore() -> None:
        with torch.no_grad():
            for tensor, value in values:
                tensor.copy_(value)
        for parameter, flag in flags:
            parameter.requires_grad_(flag)
        for parameter, gradient in gradients:
            parameter.grad = gradient
        for submodule, mode in modes:
            submodule.training = mode

    return restore


def _adapter(layer: Layer, rank: int, generator: torch.Generator) -> tuple[nn.Parameter, nn.Parameter]:
    """A (rank, in, *kernel), uniform within 1 / sqrt(fan in), and B (out, rank), zero."""
    weight = layer.weight
    bound = 1 / math.sqrt(weight[0].numel())
    dtype = torch.promote_types(weight.dtype, torch.float32)
    a = (torch.rand(rank, *weight.shape[1:], generator=generator, dtype=torch.float64) * 2 - 1) * bound
    b = torch.zeros(weight.shape[0], rank, dtype=dtype, device=weight.device)
    return nn.Parameter(a.to(weight.device, dtype)), nn.Parameter(b)


def _attach(layer: Layer, a: nn.Parameter, b: nn.Parameter, scale: float) -> Callable[[], None]:
    """Let ``layer`` compute ``W x + scale · B A x``; the result undoes that. Attachments may nest."""
    if isinstance(layer, nn.Linear):

        def branch(_: nn.Module, args: tuple[Tensor, ...], output: Tensor) -> Tensor:
            x = args[0]
            return output + F.linear(F.linear(x, a.to(x.dtype)), (b * scale).to(x.dtype))

        return layer.register_forward_hook(branch).remove

    inner: Callable[[Tensor, Tensor, Tensor | None], Tensor] = layer._conv_forward
    nested = "_conv_forward" in vars(layer)

    def convolve(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        delta = (scale * b @ a.flatten(1)).reshape(weight.shape)
        return inner(x, weight + delta.to(weight.dtype), bias)

    def detach() -> None:
        if nested:
            vars(layer)["_conv_forward"] = inner
        else:
            del vars(layer)["_conv_forward"]

    vars(layer)["_conv_forward"] = convolve
    return detach
