"""Adam by torch's functions is torch's class, and does not import its compiler."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from torch import Tensor

from tco.adam import Adam

F64 = torch.float64


def parameters(seed: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [
        torch.randn(shape, generator=generator, dtype=F64).requires_grad_()
        for shape in ((3, 4), (5,), (2, 2))
    ]


def test_it_is_that_of_torch_with_rates_that_change_and_gradients_that_are_missing() -> None:
    ours, theirs = parameters(0), parameters(0)
    betas = (0.6, 0.98)
    mine = Adam([(ours[:2], 0.1), (ours[2:], 0.01)], betas)
    reference = torch.optim.Adam(
        [{"params": theirs[:2], "lr": 0.1}, {"params": theirs[2:], "lr": 0.01}], betas=betas
    )
    for step in range(12):
        mine.zero_grad()
        reference.zero_grad(set_to_none=True)
        for values in (ours, theirs):
            # The second has no gradient in every third step, the third none at first.
            used = [values[0]] + values[1:2] * (step % 3 > 0) + values[2:] * (step > 4)
            torch.stack([(v.sin() * (1 + i + step)).sum() for i, v in enumerate(used)]).sum().backward()
        mine.groups[0].lr = reference.param_groups[0]["lr"] = 0.1 / (1 + step)
        mine.step()
        reference.step()
        for a, b in zip(ours, theirs, strict=True):
            assert torch.equal(a, b)
    assert not torch.equal(ours[2], parameters(0)[2])


def test_the_first_step_is_as_long_as_the_rate() -> None:
    """The mean of the gradients over the root of that of their squares is a sign."""
    value = torch.tensor([3.0, -2.0, 0.5], dtype=F64, requires_grad=True)
    optimiser = Adam([([value], 0.25)], (0.9, 0.999))
    (value * torch.tensor([1e-3, 7.0, -40.0], dtype=F64)).sum().backward()
    optimiser.step()
    assert value.tolist() == pytest.approx([2.75, -2.25, 0.75], rel=1e-4)


def test_without_gradients_nothing_moves() -> None:
    value = torch.ones(2, requires_grad=True)
    Adam([([value], 0.1), ([], 0.1)], (0.9, 0.999)).step()
    assert torch.equal(value.detach(), torch.ones(2))


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="must not be negative"):
        Adam([([torch.ones(1)], -0.1)], (0.9, 0.999))
    with pytest.raises(ValueError, match="decays"):
        Adam([([torch.ones(1)], 0.1)], (0.9, 1.0))


def test_an_optimisation_does_not_import_the_compiler() -> None:
    code = (
        "import sys\n"
        "from tco.optimize import optimize\n"
        "from tco.options import TCOConfig\n"
        "from tco.toy import Toy, wall\n"
        "scene = wall(4)\n"
        "optimize(Toy(), scene.views, scene.priors, TCOConfig(steps=2, lora_targets=('plane',)))\n"
        "sys.exit('torch._dynamo' in sys.modules)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
