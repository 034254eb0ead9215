"""Poses of an adapted network: in the unit of the depths, whatever the network's own is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from colmap_tco.errors import InputError
from colmap_tco.pose_network import SETTINGS, find
from tests.tco.published import some_views, tiny_pi3, tiny_vggt


@pytest.mark.parametrize("network", [tiny_vggt, tiny_pi3])
def test_the_poses_have_the_unit_of_the_depths(network: object) -> None:
    """Centres grow with the depths, rotations and focal lengths do not change."""
    backbone, views = network(), some_views(3)  # type: ignore[operator]
    g = torch.Generator().manual_seed(1)
    depth = 1 + torch.rand(3, 42, 56, generator=g)
    plain = replace(SETTINGS, steps=0)
    one, K = find(backbone, views, depth, plain, 0)
    three, K3 = find(backbone, views, 3 * depth, plain, 0)
    np.testing.assert_allclose(three[:, :3, 3], 3 * one[:, :3, 3], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(three[:, :3, :3], one[:, :3, :3], atol=1e-7)
    np.testing.assert_allclose(K3, K)


def test_adaptation_to_depths_changes_the_poses_and_leaves_the_network(
    caplog: pytest.LogCaptureFixture,
) -> None:
    backbone, views = tiny_vggt(), some_views(3)
    depth = 1 + torch.rand(3, 42, 56, generator=torch.Generator().manual_seed(1))
    before = {name: value.clone() for name, value in backbone.state_dict().items()}
    plain, _ = find(backbone, views, depth, replace(SETTINGS, steps=0), 0)
    adapted, _ = find(backbone, views, depth, replace(SETTINGS, steps=2, lora_targets=("qkv", "proj")), 0)
    assert np.isfinite(adapted).all()
    assert np.abs(adapted - plain).max() > 1e-6
    assert all(torch.equal(value, before[name]) for name, value in backbone.state_dict().items())


def test_no_measured_pixel_is_an_error() -> None:
    with pytest.raises(InputError, match="no measured pixel"):
        find(tiny_vggt(), some_views(2), torch.zeros(2, 42, 56), SETTINGS, 0)
