"""Errors of depth maps against measured ones.

AbsRel, RMSE and δ are those of Eigen et al. 2014 as DUSt3R, MonST3R, CUT3R and π³ report them (code at
github.com/yyfz/Pi3, branch evaluation, ``utils/depth.py``), over the pixels of all views that have both a
prediction and a measurement. Those networks predict every pixel; depth maps of stereo have holes, so two
more figures are over ALL measured pixels and count a hole as a miss: d2 and d5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Scaling = Literal["none", "median", "scale", "scale_shift"]

_LEAST = 1e-5
"""Depths that a shift has made zero or negative count as this in the ratios of δ, as in the public code."""


@dataclass(frozen=True)
class DepthFigures:
    """Errors of predicted depth d against measured depth z, after scaling.

    Attributes:
        abs_rel: mean of |d − z| / z where both are.
        rmse: root of the mean of (d − z)² where both are, in units of the truth.
        delta_1_25: share of pixels with max(d/z, z/d) < 1.25 where both are.
        delta_1_25_2: the same for 1.25².
        delta_1_25_3: the same for 1.25³.
        d2: share of ALL measured pixels with |d/z − 1| < 0.02.
        d5: share of ALL measured pixels with |d/z − 1| < 0.05.
        coverage: share of the measured pixels that have a prediction.
        median: median of |d/z − 1| where both are.
        scale: factor that was applied to d.
        shift: what was added after that, in units of the truth.
        pixels: measured pixels.
    """

    abs_rel: float
    rmse: float
    delta_1_25: float
    delta_1_25_2: float
    delta_1_25_3: float
    d2: float
    d5: float
    coverage: float
    median: float
    scale: float
    shift: float
    pixels: int


def depth_figures(predicted: Floats, truth: Floats, scaling: Scaling = "none") -> DepthFigures:
    """Figures over all pixels of all views together; one scale for all of them.

    Args:
        predicted: (V, H, W), or any shape that ``truth`` has too; 0, negative or NaN where there is none.
        truth: the same shape and unit; 0, negative or NaN where nothing was measured.
        scaling: what is done to the prediction first. none: nothing. median: times
            median(truth) / median(predicted). scale: times Σ d z / Σ d², least squares. scale_shift: the
            least squares solution of s d + t = z. To scale each view on its own, call this once a view.

    Raises:
        ValueError: shapes that differ, an unknown scaling, no measurement, or no pixel with both.
    """
    predicted, truth = np.asarray(predicted, np.float64), np.asarray(truth, np.float64)
    if predicted.shape != truth.shape:
        raise ValueError(f"predicted depth is {predicted.shape}, measured depth {truth.shape}")
    measured = np.isfinite(truth) & (truth > 0)
    both = measured & np.isfinite(predicted) & (predicted > 0)
    if not measured.any():
        raise ValueError("the true depth maps have no measurement")
    if not both.any():
        raise ValueError("no measured pixel has a predicted depth")
    scale, shift = fit(predicted[both], truth[both], scaling)
    d, z = scale * predicted[both] + shift, truth[both]
    error = np.abs(d / z - 1)
    positive = np.maximum(d, _LEAST)
    ratio = np.maximum(positive / z, z / positive)
    total = int(measured.sum())
    return DepthFigures(
        abs_rel=float(error.mean()),
        rmse=float(np.sqrt(((d - z) ** 2).mean())),
        delta_1_25=float((ratio < 1.25).mean()),
        delta_1_25_2=float((ratio < 1.25**2).mean()),
        delta_1_25_3=float((ratio < 1.25**3).mean()),
        d2=int((error < 0.02).sum()) / total,
        d5=int((error < 0.05).sum()) / total,
        coverage=int(both.sum()) / total,
        median=float(np.median(error)),
        scale=scale,
        shift=shift,
        pixels=total,
    )


def fit(d: Floats, z: Floats, scaling: Scaling) -> tuple[float, float]:
    """(scale, shift) that bring depths (N,) to measured ones (N,), see :func:`depth_figures`.

    Raises:
        ValueError: an unknown scaling, or a prediction that is the same everywhere, which has no shift.
    """
    if scaling == "none":
        return 1.0, 0.0
    if scaling == "median":
        return float(np.median(z) / np.median(d)), 0.0
    if scaling == "scale":
        return float(d @ z / (d @ d)), 0.0
    if scaling != "scale_shift":
        raise ValueError(f"scaling {scaling!r} is not one of {', '.join(get_args(Scaling))}")
    about = d - d.mean()
    if float(about @ about) <= 1e-24 * float(d @ d):
        raise ValueError("the predicted depth is the same everywhere: it has a scale but no shift")
    scale = float(about @ (z - z.mean()) / (about @ about))
    return scale, float(z.mean() - scale * d.mean())
