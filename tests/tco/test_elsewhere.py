"""Nothing assumes the CPU: the whole optimisation runs on another device, and gives the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.align import KnownCameras
from tco.backbones.weights import load_sweep
from tco.optimize import Outcome, optimize
from tco.options import PolishConfig, TCOConfig
from tco.toy import wall
from tests.elsewhere import NAME, PLACE, Elsewhere, There, moved
from tests.tco.published import tiny_pi3, tiny_vggt

CONFIG = TCOConfig(steps=2, refresh=1, reencode=1e-6, camera_rate=0.5, polish=PolishConfig(polish_looks=1))
"""Every stage: depths computed anew, corrected cameras given to the network, depths refined."""


def test_the_device_is_another() -> None:
    with Elsewhere():
        here, there = torch.rand(4), torch.rand(4).to(PLACE)
        assert there.device.type == NAME and isinstance(there * 2, There)
        torch.testing.assert_close((there + there).cpu(), 2 * there.cpu())
        with pytest.raises(RuntimeError, match="two devices"):
            there + here
        with pytest.raises((RuntimeError, TypeError, ValueError)):
            np.asarray(there.numpy())


@pytest.mark.parametrize("kind", ["sweep", "vggt", "pi3"])
def test_the_whole_optimisation_runs_elsewhere(kind: str) -> None:
    """With the default settings, camera corrections and polishing included; the figures are the CPU's.

    On the CPU rendering and correlations are compiled loops, elsewhere they are tensor operations.
    """
    scene = wall(3, (42, 56) if kind != "sweep" else (32, 48))
    network: Any = {"sweep": load_sweep, "vggt": tiny_vggt, "pi3": tiny_pi3}[kind]()
    targets = ("qkv", "proj", "fc1", "fc2") if kind != "sweep" else TCOConfig().lora_targets
    config = TCOConfig(**{**vars(CONFIG), "lora_targets": targets})

    def run(backbone: Any, there: bool) -> Outcome:
        place = PLACE if there else torch.device("cpu")
        known = backbone if backbone.uses_cameras else KnownCameras(backbone)
        watched = [points.to(place) for points in scene.priors.sparse or ()]
        return optimize(known, scene.views.to(place), scene.priors.to(place), config, watched=watched)

    near = run(network, there=False)
    with Elsewhere():
        far = run(moved(network), there=True)
        depth: Tensor = far.prediction.to("cpu").depth
    assert isinstance(far.prediction.depth, There) and not isinstance(depth, There)
    assert [set(step) for step in far.history] == [set(step) for step in near.history]
    torch.testing.assert_close(depth, near.prediction.depth, rtol=0.02, atol=0)
