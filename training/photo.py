"""What real cameras do to a picture, good ones and bad ones."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from training.raytrace import Floats

Rng = np.random.Generator


def _toned(x: Floats, rng: Rng) -> Floats:
    """Exposure and white balance a view, saturation, vignetting, tone curve; some dim, some too bright."""
    v, h, w = x.shape[:3]
    drift, kind = rng.choice([0.0, 0.04, 0.15]), rng.random()
    low, high = (0.2, 0.6) if kind < 0.2 else (1.15, 2.0) if kind < 0.35 else (0.5, 1.15)
    most = 1 / (
        np.quantile(x.mean(-1), 0.6, (1, 2)).reshape(v, 1, 1, 1) + 1e-3
    )  # more than half does not clip
    gain = np.minimum(
        rng.uniform(low, high) * np.exp(rng.normal(0, drift, (v, 1, 1, 1))), np.maximum(0.6, most)
    )
    gain = gain * np.exp(rng.normal(0, 0.06 + 0.3 * drift, (v, 1, 1, 3)))
    grey = x.mean(-1, keepdims=True)
    x = grey + rng.uniform(0.15, 1.05) * (x - grey)
    yy, xx = np.meshgrid(np.linspace(-1, 1, h), np.linspace(-1, 1, w), indexing="ij")
    vignette = 1 - rng.choice([0.0, rng.uniform(0, 0.35)]) * (xx**2 + yy**2)[None, ..., None] / 2
    x = np.clip(x * gain * vignette, 0, 1) ** rng.uniform(0.8, 1.25)
    haze = rng.choice([0.0, rng.uniform(0, 0.15)])  # stray light, as in cheap lenses
    return (haze + (1 - haze) * x).astype(np.float32)


def _shaken(image: Floats, length: float, angle: float) -> Floats:
    """An image (H, W, 3) blurred along a line of so many pixels, as by a hand that moves."""
    size = 2 * int(np.ceil(length / 2)) + 3
    t = np.linspace(-length / 2, length / 2, 4 * size)
    kernel = np.zeros((size, size), np.float32)
    x, y = size // 2 + t * np.cos(angle), size // 2 + t * np.sin(angle)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    for dx in (0, 1):
        for dy in (0, 1):
            np.add.at(kernel, (y0 + dy, x0 + dx), np.abs(1 - dx - (x - x0)) * np.abs(1 - dy - (y - y0)))
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE))


def _noise(rng: Rng, shape: tuple[int, int], grain: float, colored: float) -> Floats:
    """Noise (H, W, 3) of deviation one or less: grey with a share of colour, its grain some pixels wide."""
    grey, color = rng.standard_normal((*shape, 1)), rng.standard_normal((*shape, 3))
    if grain > 0:
        grey, color = (
            gaussian_filter(a, (s, s, 0)) * (1 + 2 * s) for a, s in ((grey, grain), (color, 2 * grain))
        )
    return ((1 - colored) * grey + colored * color).astype(np.float32)


def photographed(images: NDArray[np.uint8], rng: Rng) -> Floats:
    """What a real camera would add: exposure and white balance a view, vignetting, blur, noise, JPEG.

    Args:
        images: (V, H, W, 3).

    Returns:
        (V, H, W, 3) float32 in [0, 1].
    """
    v, h, w = images.shape[:3]
    x = _toned(images.astype(np.float32) / 255, rng)
    noise, grain = rng.choice([0.0, 0.006, 0.012, 0.025]), rng.choice([0.0, rng.uniform(0.3, 1.0)])
    colored, steady = rng.choice([0.0, rng.uniform(0, 1)]), rng.random() < 0.65
    reach, angle = rng.uniform(1, 0.025 * w), rng.uniform(0, np.pi)
    quality = int(rng.integers(40, 97)) if rng.random() < 0.6 else 0
    for i in range(v):
        if rng.random() < 0.4:
            sigma = rng.uniform(0.2, 0.9, 2)
            x[i] = gaussian_filter(x[i], (sigma[0], sigma[1], 0))
        if not steady and rng.random() < 0.6:
            x[i] = _shaken(x[i], float(reach * rng.uniform(0.3, 1)), float(angle + rng.normal(0, 0.4)))
        if noise:
            x[i] += noise * np.float32(rng.uniform(0.5, 1)) * _noise(rng, (h, w), grain, colored)
        if quality:
            code = cv2.imencode(
                ".jpg", np.clip(255 * x[i], 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality]
            )[1]
            x[i] = cv2.imdecode(code, cv2.IMREAD_COLOR).astype(np.float32) / 255
    return np.clip(x, 0, 1).astype(np.float32)
