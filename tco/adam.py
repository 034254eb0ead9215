"""Adam (Kingma and Ba, ICLR 2015) by torch's own functions, without its class.

``torch.optim.Adam`` is wrapped for ``torch.compile``; making one imports all of the compiler, which takes
more than a second of a run of fifteen. What it calls, ``torch.optim.adam.adam``, is public and does not.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.optim.adam import adam

EPSILON = 1e-8
"""Added to the root of the mean square, as torch's class does by default."""


@dataclass
class Group:
    """Parameters of one learning rate; the rate may be changed between steps."""

    params: list[Tensor]
    lr: float


@dataclass
class _Moments:
    """What is remembered of a parameter: means of its gradients and of their squares, and its steps."""

    mean: Tensor
    square: Tensor
    steps: Tensor = field(default_factory=lambda: torch.tensor(0.0))


class Adam:
    """As ``torch.optim.Adam``, in numbers and in that a parameter without gradient is left alone.

    Attributes:
        groups: the parameters and their rates.
    """

    def __init__(self, groups: Iterable[tuple[Iterable[Tensor], float]], betas: tuple[float, float]) -> None:
        """Take parameters with a learning rate, group by group, and the decays of the two means.

        Raises:
            ValueError: a rate is negative or a decay is not in [0, 1).
        """
        self.groups = [Group(list(params), lr) for params, lr in groups]
        self._betas = betas
        self._moments: dict[Tensor, _Moments] = {}
        if any(group.lr < 0 for group in self.groups):
            raise ValueError(f"learning rates must not be negative: {[group.lr for group in self.groups]}")
        if not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"decays are at least 0 and below 1, not {betas}")

    def zero_grad(self) -> None:
        """Forget all gradients."""
        for group in self.groups:
            for p in group.params:
                p.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Move each parameter that has a gradient."""
        for group in self.groups:
            moved = [p for p in group.params if p.grad is not None]
            if not moved:
                continue
            known = [self._known(p) for p in moved]
            adam(
                moved,
                [p.grad for p in moved if p.grad is not None],
                [m.mean for m in known],
                [m.square for m in known],
                [],
                [m.steps for m in known],
                amsgrad=False,
                beta1=self._betas[0],
                beta2=self._betas[1],
                lr=group.lr,
                weight_decay=0.0,
                eps=EPSILON,
                maximize=False,
            )

    def _known(self, p: Tensor) -> _Moments:
        if p not in self._moments:
            self._moments[p] = _Moments(torch.zeros_like(p), torch.zeros_like(p))
        return self._moments[p]
