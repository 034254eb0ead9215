"""The benchmark of the networks: its count of operations is the formula's, and it runs."""

from __future__ import annotations

import pytest

from benchmarks.backbone import NETWORKS, main, operations
from tco.backbones.pi3 import Pi3Config


def blocks(depth: int, tokens: int, sequence: int, channels: int) -> int:
    """Operations of transformer blocks: 12 C² products a token in linear layers, 2 N C in attention."""
    return 2 * depth * tokens * (12 * channels**2 + 2 * sequence * channels)


def of_pi3(c: Pi3Config, views: int, patches: int) -> int:
    """Operations of a forward pass of π³, all views, by its paper's description."""
    pixels, enc = 14 * 14, c.encoder
    coded, decoded = patches + 1 + enc.registers, patches + c.registers
    total = 2 * views * patches * 3 * pixels * enc.channels
    total += blocks(enc.depth, views * coded, coded, enc.channels)
    total += blocks(c.depth // 2, views * decoded, decoded, c.channels)
    total += blocks(c.depth // 2, views * decoded, views * decoded, c.channels)
    for out in (c.hidden, c.hidden, c.pose):
        total += blocks(c.head_depth, views * decoded, decoded, c.hidden)
        total += 2 * views * decoded * c.hidden * (2 * c.channels + out)
    total += 2 * views * patches * c.hidden * 4 * pixels
    return total + 2 * views * c.pose * (6 * patches * c.pose + 2 * c.pose + 12)


@pytest.mark.parametrize(("views", "size"), [(2, (56, 84)), (5, (28, 42))])
def test_operations_are_those_of_the_formula(views: int, size: tuple[int, int]) -> None:
    patches = size[0] * size[1] // 14**2
    counted = operations("pi3", True, views, size, "forward")
    assert counted == pytest.approx(of_pi3(NETWORKS["pi3"][3], views, patches), rel=1e-4)


def test_going_back_through_frozen_layers_costs_as_much_as_going_forward() -> None:
    """Gradients of the weights are not computed, so a step is less than three forward passes."""
    views, size = 3, (56, 84)
    forward = operations("pi3", True, views, size, "forward")
    assert forward < operations("pi3", True, views, size, "step") < 2.5 * forward


def test_the_blocks_before_the_adapted_ones_cost_a_step_nothing() -> None:
    """Half of the blocks twice, there and back, instead of all; the readers of π³ are run in any case."""
    views, size = 3, (56, 84)
    c, tokens = NETWORKS["pi3"][3], 4 * 6 + NETWORKS["pi3"][3].registers
    half = blocks(c.depth // 4, views * tokens, tokens, c.channels)
    half += blocks(c.depth // 4, views * tokens, views * tokens, c.channels)
    whole, part = (operations("pi3", True, views, size, "step", last) for last in (0, c.depth // 2))
    assert whole - part > 1.8 * half


def test_it_prints_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--small", "--device", "cpu", "--networks", "pi3", "--views", "1", "2", "--size", "28", "42"])
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split("|")[1:4] for line in lines if line.startswith("| ")][1:]
    assert [[cell.strip() for cell in row] for row in rows] == [
        ["pi3", count, kind] for count in "12" for kind in ("forward", "step")
    ]
