"""Local equalisation: what it may change, by how much at most, and what it must leave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.backbones.contrast import LUMA, equalised
from tco.backbones.decoder import SweepConfig
from tco.backbones.sweep import Sweep
from tco.types import Priors, Views

TINY = SweepConfig(
    planes=16, groups=(4, 2), coarse=16, fine=8, context=8, volume=6, tokens=32, heads=2, blocks=1, hidden=16
)  # fmt: skip


def brightness(images: Tensor) -> Tensor:
    return (images * images.new_tensor(LUMA).view(3, 1, 1)).sum(1)


def noise(amplitude: float, size: tuple[int, int] = (96, 128), level: float = 0.4) -> Tensor:
    """(1, 3, H, W) grey, uniformly distributed within ± half of the amplitude of a level."""
    random = torch.from_numpy(np.random.default_rng(0).random(size, np.float32))
    return (level + amplitude * (random - 0.5)).expand(1, 3, *size)


def everywhere(images: Tensor) -> Tensor:
    return torch.ones(len(images), *images.shape[-2:], dtype=torch.bool)


@pytest.mark.parametrize("gain", [3.0, 10.0, 30.0])
@pytest.mark.parametrize("size", [(96, 128), (192, 256), (300, 200), (37, 61)])
def test_faint_texture_grows_by_the_factor(gain: float, size: tuple[int, int]) -> None:
    """Uniform noise of half of 1 / gain would be spread over all levels, more than twice the gain.

    What is cut off a histogram is shared out among all levels, which adds less than one to the slope. Counts
    of pixels vary by chance, and are whole.
    """
    faint = noise(0.4 / gain, size)
    grown = equalised(faint, everywhere(faint), gain)
    ratio = float(grown.std() / faint.std())
    assert 0.7 * gain < ratio < 1.1 * gain + 1


def test_strong_texture_is_spread_over_all_levels_and_no_further() -> None:
    """Uniform noise over half of the levels: the distribution function maps it to all of them."""
    strong = noise(0.5, (384, 512))
    spread = brightness(equalised(strong, everywhere(strong), 10.0))
    assert float(spread.min()) >= 0 and float(spread.max()) <= 1
    expected = (brightness(strong) - 0.15) / 0.5
    assert float((spread - expected).abs().mean()) < 0.02


def test_order_is_kept_where_all_tiles_show_the_same() -> None:
    tile = noise(0.3, (64, 64))
    image = tile.repeat(1, 1, 3, 4)
    before, after = brightness(image).ravel(), brightness(equalised(image, everywhere(image), 8.0)).ravel()
    order = before.argsort()
    assert float(after[order].diff().min()) > -1e-4


def test_a_plain_picture_shows_nothing_after_either() -> None:
    plain = torch.full((2, 3, 64, 96), 0.3)
    plain[:, 0] = 0.5
    after = equalised(plain, everywhere(plain), 10.0)
    assert float(after.amax((2, 3)).sub(after.amin((2, 3))).abs().max()) < 1e-6


def test_only_brightness_changes() -> None:
    images = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    after = equalised(images, everywhere(images), 10.0)
    assert float((after - images).abs().max()) > 0.05
    assert torch.allclose(after[:, 0] - after[:, 1], images[:, 0] - images[:, 1], atol=1e-6)
    assert torch.allclose(after[:, 2] - after[:, 1], images[:, 2] - images[:, 1], atol=1e-6)
    assert float(brightness(after).min()) >= 0 and float(brightness(after).max()) <= 1 + 1e-6


def test_a_factor_of_none_is_the_picture_itself() -> None:
    images = noise(0.5)
    assert equalised(images, everywhere(images), 0.0) is images


def test_what_is_not_valid_stays_and_has_no_say() -> None:
    images = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(1))
    valid = everywhere(images)
    valid[:, :, 60:] = False
    other = torch.where(valid[:, None], images, torch.zeros(()))
    first, second = equalised(images, valid, 10.0), equalised(other, valid, 10.0)
    assert torch.equal(first[:, :, :, 60:], images[:, :, :, 60:])
    assert torch.allclose(first[:, :, :, :60], second[:, :, :, :60], atol=1e-6)


def test_what_is_no_number_stays_and_harms_nothing_else() -> None:
    images = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(1))
    broken = images.clone()
    broken[0, 1, 10, 20], broken[0, 0, 11, 20] = float("nan"), float("inf")
    hole = everywhere(images)
    hole[0, 10, 20] = hole[0, 11, 20] = False
    first, second = equalised(broken, everywhere(images), 10.0), equalised(images, hole, 10.0)
    there = hole.unsqueeze(1).expand(1, 3, 64, 96)
    assert bool(first[0, 1, 10, 20].isnan()) and bool(first[there].isfinite().all())
    assert torch.allclose(first[there], second[there], atol=1e-6)


def test_a_view_of_nothing_stays_as_it_is() -> None:
    images = noise(0.5)
    assert torch.equal(equalised(images, ~everywhere(images), 10.0), images)


def test_views_do_not_depend_on_each_other() -> None:
    images = torch.rand(3, 3, 48, 64, generator=torch.Generator().manual_seed(2))
    together = equalised(images, everywhere(images), 6.0)
    alone = torch.cat([equalised(one[None], everywhere(one[None]), 6.0) for one in images])
    assert torch.equal(together, alone)


def test_the_network_sees_equalised_pictures(rendered: tuple[Views, Priors, Tensor]) -> None:
    """With the setting, features are those that the network without it has of equalised pictures."""
    views, priors = rendered[:2]
    torch.manual_seed(0)
    plain = Sweep(TINY).eval()
    told = Sweep(replace(TINY, equalise=10.0)).eval()
    told.load_state_dict(plain.state_dict())
    other = replace(views, images=equalised(views.images, views.valid, 10.0))
    with torch.no_grad():
        expected, found = plain.encode(other, priors), told.encode(views, priors)
        before = plain.encode(views, priors)
    assert torch.equal(found.volume, expected.volume) and torch.equal(found.fine, expected.fine)
    assert not torch.allclose(found.fine, before.fine, atol=1e-3)


def test_what_shows_nothing_takes_part_as_the_mean_of_what_does() -> None:
    """Whatever is in a masked half, the other half comes out as if the mean of it were there."""
    images = noise(0.1, level=0.6).clone()
    valid = everywhere(images)
    valid[..., 70:] = False
    filled = images.clone()
    filled[..., 70:] = brightness(images)[valid].mean()
    expected = equalised(filled, everywhere(filled), 10.0)[..., :70]
    images[..., 70:] = torch.rand(1, 3, 96, 58, generator=torch.Generator().manual_seed(1))
    found = equalised(images, valid, 10.0)
    torch.testing.assert_close(found[..., :70], expected, rtol=0, atol=2e-4)
    assert torch.equal(found[..., 70:], images[..., 70:])
