"""Pictures whose faint texture shows: contrast-limited adaptive histogram equalisation of their brightness.

Dark cupboards and white walls have texture of a few steps of brightness, which is little beside the contrast
of the whole picture. Spread out over each tile's own histogram it can be matched. The factor by which
differences may grow is limited, so that noise stays noise (Zuiderveld, Contrast limited adaptive histogram
equalization, Graphics Gems IV, 1994; here OpenCV's, on 16 bits).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

TILES = 4
"""Tiles along the longer side of a picture; between their middles what they say is interpolated."""
LEVELS = 1 << 16
"""Levels of brightness that OpenCV counts."""
LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in brightness (ITU-R BT.601)."""


def equalised(images: Tensor, valid: Tensor, gain: float) -> Tensor:
    """The same pictures with their brightness equalised locally; differences of colours stay as they are.

    Args:
        images: (V, 3, H, W) in [0, 1].
        valid: (V, H, W) pixels that show something. Others, and those that are not finite, take part as the
            mean of these and come back as they were.
        gain: factor that differences of brightness may grow by, at most; 0 changes nothing.

    Returns:
        (V, 3, H, W), brightness in [0, 1], on the device of ``images`` and of their type.
    """
    if gain == 0:
        return images
    weights = images.new_tensor(LUMA).view(3, 1, 1)
    brightness = (images * weights).sum(1)
    known = valid & brightness.isfinite()
    brightness = brightness.where(known, torch.zeros_like(brightness)).clamp(0, 1)
    mean = brightness.sum((1, 2), keepdim=True) / known.sum((1, 2), keepdim=True).clamp_min(1)
    brightness = brightness.where(known, mean)
    grey = brightness.detach().float().cpu().numpy()
    spread = torch.from_numpy(np.stack([_equalised(one, gain) for one in grey])).to(images)
    return images + ((spread - brightness) * known).unsqueeze(1)


def _equalised(grey: NDArray[np.float32], gain: float) -> NDArray[np.float32]:
    """One picture (H, W) in [0, 1].

    OpenCV clips histograms at a whole number of pixels n. With pixels at every m-th level the factor is
    n · levels / (m · pixels of a tile): n is chosen so that m, which is rounded, is 4 or more.
    """
    h, w = grey.shape
    side = max(h, w) / TILES
    across, down = max(1, round(w / side)), max(1, round(h / side))
    area = math.ceil(w / across) * math.ceil(h / down)
    clip = max(1, math.ceil(4 * gain * area / LEVELS))
    step = max(1, round(clip * LEVELS / (area * gain)))
    levels = (np.rint(grey * ((LEVELS - 1) / step)) * step).clip(0, LEVELS - 1).astype(np.uint16)
    filtered = cv2.createCLAHE((clip + 0.5) * LEVELS / area, (across, down)).apply(levels)
    return filtered.astype(np.float32) / np.float32(LEVELS - 1)
