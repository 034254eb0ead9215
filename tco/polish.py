"""After the network was adapted: the depths themselves, refined where the pictures say more than it does.

Adapters change what the network makes of all views at once, and cannot put right what it makes of one place.
Here the network's answer D is held fixed and multiplied by a field of factors, exp(δ), of which δ is a sum of
bilinearly interpolated grids, zero at first. The objective is that of the adaptation: a source compared with
the other views in colour, and its depths with points. Since each pixel has a depth of its own to
move, colours are looked up where the pixel falls (:mod:`tco.warping`) and not rendered. No network is run, so
that a step costs a fraction of one that adapts, and all views' depths are those of the moment.

The paper optimises surfels directly as an ablation, without a network, and finds it worse (arXiv 2604.03878).
Here that comes after the network, and on coarse grids; cells of one pixel are better on some sets and by some
measures and worse by others (``docs/ablations.md``).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tco.adam import Adam
from tco.geometry import pixel_grid
from tco.options import TCOConfig
from tco.parallel import side_by_side
from tco.schedule import Sources, draw_targets
from tco.terms import COMPATIBILITY, Terms, errors_at, means
from tco.types import Cameras, Prediction, Priors, SparseDepth

logger = logging.getLogger(__name__)

LAST_RATE = 0.2
"""The learning rate falls linearly to this share of the first."""
BETAS = (0.5, 0.99)
"""Decay of Adam's means. Each view is a source few times, so that a longer memory would never be filled."""


class DepthField(nn.Module):
    """Logarithms of factors of the depths of V views: sums of grids, each a level of coarser pixels.

    Each view's grids are parameters of their own, so that Adam leaves alone the views that a step does not
    look at: their gradient is none, not zero, and what it remembers of them neither moves them on nor fades.
    """

    def __init__(self, depth: Tensor, levels: Sequence[int]) -> None:
        """Take shape, dtype and device from the depth (V, H, W); a grid for each side of its cells in pixels.

        Raises:
            ValueError: no level, or one below a pixel.
        """
        super().__init__()
        if not levels or min(levels) < 1:
            raise ValueError(f"the sides of the cells must be at least a pixel, not {tuple(levels)}")
        views, *size = depth.shape
        self.size, self.levels = (size[0], size[1]), tuple(levels)
        self.grids = nn.ParameterList(
            depth.new_zeros(1, *(-(-s // level) for s in size)) for _ in range(views) for level in levels
        )

    def forward(self, views: Sequence[int]) -> Tensor:
        """δ (len(views), H, W)."""
        h, w = self.size
        total = None
        for i, level in enumerate(self.levels):
            part = torch.stack([self.grids[view * len(self.levels) + i] for view in views])
            if level > 1:
                whole = (part.shape[-2] * level, part.shape[-1] * level)
                part = F.interpolate(part, whole, mode="bilinear", align_corners=False)[..., :h, :w]
            total = part if total is None else total + part
        assert total is not None
        return total.squeeze(1)


@dataclass(frozen=True)
class Polished:
    """What polishing gives.

    Attributes:
        prediction: of all views.
        history: the terms of every step, and their weighted sum as ``loss``.
        skipped: steps, counted from 0, whose loss or gradient was not finite.
    """

    prediction: Prediction
    history: list[dict[str, float]]
    skipped: list[int]


def polish(
    prediction: Prediction,
    cameras: Cameras,
    terms: Terms,
    config: TCOConfig,
    generator: torch.Generator,
    report: Callable[[int, dict[str, float]], None] | None = None,
    watched: Sequence[SparseDepth] = (),
) -> Polished:
    """Refine the depths of all V views but those that only help; confidences stay.

    Args:
        prediction: of all views.
        cameras: of all views, held fixed.
        terms: of these views.
        config: ``config.polish`` says how long and how fast; weights and targets are the adaptation's.
        generator: draws sources and targets.
        report: called after every step with its number, from ``config.steps`` on, and its terms.
        watched: points of each view that nothing is fitted to; see :func:`tco.optimize.optimize`.
    """
    c = config.polish
    run = _Polishing(prediction, cameras, terms, config, generator, watched)
    optimiser = Adam([(run.field.parameters(), c.polish_rate)], BETAS)
    history: list[dict[str, float]] = []
    skipped: list[int] = []
    steps = c.steps(len(terms.views.wanted))
    for step in range(steps):
        optimiser.groups[0].lr = c.polish_rate * (1 - (1 - LAST_RATE) * step / steps)
        optimiser.zero_grad()
        figures = {"loss": 0.0} | {name: float(value) for name, value in run.gradients().items()}
        if _finite(run.field, figures["loss"]):
            optimiser.step()
            run.renew()
        else:
            logger.warning("step %d on the depths: the loss or its gradient is not finite; skipped", step)
            skipped.append(step)
        history.append(figures)
        if report is not None:
            report(config.steps + step, figures)
    with torch.no_grad():
        return Polished(run.refined(range(len(prediction.depth))), history, skipped)


class _Polishing:
    """The objective of one chunk's depths; arguments as in :func:`polish`."""

    def __init__(
        self, prediction: Prediction, cameras: Cameras, terms: Terms, config: TCOConfig,
        generator: torch.Generator, watched: Sequence[SparseDepth],
    ) -> None:  # fmt: skip
        self.prediction, self.cameras, self.terms, self.config = prediction, cameras, terms, config
        self.generator, self.watched = generator, watched
        self.field = DepthField(prediction.depth, config.polish.polish_levels)
        self.sources = Sources("epoch", terms.overlap, generator, terms.views.helpers)
        self.weights = _weights(terms, config)
        self.edges = picture_edges(terms.views.images)
        self.now = replace(prediction, depth=prediction.depth.clone(), stages=())
        self.drawn: list[int] = []

    def gradients(self) -> dict[str, Tensor]:
        """Means of the terms over the sources of a step, whose gradients are added to the field's."""
        self.drawn = self.sources.draw(self.config.polish.polish_sources)
        pairs = [(source, self.targets(source)) for source in self.drawn]
        if self.terms.extra:  # which need not allow that two are computed at once
            return means([self.of_source(*pair) for pair in pairs])
        return means(side_by_side(lambda pair: self.of_source(*pair), pairs, self.prediction.depth.device))

    @torch.no_grad()
    def renew(self) -> None:
        """Compute anew what has changed: the depths of the step's sources, and no others'."""
        self.now.depth[self.drawn] = self.refined(self.drawn).depth

    def targets(self, source: int) -> list[int]:
        """Views that a source is compared with."""
        if not self.weights.keys() & COMPATIBILITY:
            return []
        return draw_targets(self.terms.overlap, source, self.config.targets, self.generator)

    def of_source(self, source: int, targets: Sequence[int]) -> dict[str, Tensor]:
        """Terms of one source, whose gradients are added to the field's."""
        change = self.field([source])
        mine = self.refined([source], change)
        part = self.terms.of_source(source, targets, mine, self.now, self.cameras, self.weights)
        if "smoothness" in self.weights:
            part["smoothness"] = roughness(change[0], [edge[source] for edge in self.edges])
        found = {name: value.detach() for name, value in part.items()}
        if part:
            loss = torch.stack([self.weights[name] * value for name, value in part.items()]).sum()
            (loss / self.config.polish.polish_sources).backward()
            found["loss"] = loss.detach()
        if self.watched and len(self.watched[source]):
            found["held_out"] = errors_at(mine.depth[0].detach(), self.watched[source]).abs().median()
        return found

    def refined(self, views: Sequence[int], change: Tensor | None = None) -> Prediction:
        """The prediction of some views with its depths times exp(``change``), by default the field's."""
        chosen = list(views)
        factor = torch.exp(self.field(chosen) if change is None else change)
        return replace(
            self.prediction,
            depth=self.prediction.depth[chosen] * factor,
            confidence=self.prediction.confidence[chosen],
            views=tuple(chosen),
            stages=(),
        )


def displacement(priors: Priors, size: tuple[int, int]) -> float:
    """How far one standard deviation of its camera moves a pixel, in parts of the longer side.

    Rotation moves it by f σ_R, the centre by f σ_c / d at the depth d of the view's points, the focal length
    by σ_f times its distance from the principal point; the root of their squares, the median
    over views, so that a few with hardly a point do not decide. What has no standard deviation is exact.

    Args:
        priors: of V views, with cameras.
        size: height and width of the views, pixels.
    """
    assert priors.cameras is not None
    K = priors.cameras.K
    f = K[:, 0, 0]
    radius = (pixel_grid(*size, like=K) - K[:, None, None, :2, 2]).norm(dim=-1).mean((1, 2))
    moved = torch.zeros_like(f)
    if priors.rotation_sigma is not None:
        moved = moved + (f * priors.rotation_sigma) ** 2
    if priors.centre_sigma is not None and priors.sparse is not None:
        depths = [s.depth.median() if len(s) else s.depth.new_tensor(math.inf) for s in priors.sparse]
        moved = moved + (f * priors.centre_sigma / torch.stack(depths).to(f)) ** 2
    if priors.focal_sigma is not None:
        moved = moved + (radius * priors.focal_sigma) ** 2
    return float(moved.sqrt().median()) / max(size)


def too_uncertain(priors: Priors, size: tuple[int, int], bound: float, consequence: str) -> bool:
    """Whether :func:`displacement` exceeds a bound; what follows from that is told.

    Args:
        priors: of V views, with cameras.
        size: height and width of the views, pixels.
        bound: in parts of the longer side.
        consequence: the end of the warning.
    """
    moved = displacement(priors, size)
    if moved > bound:
        logger.warning("the cameras are uncertain by %.1f pixels: %s", moved * max(size), consequence)
    return moved > bound


def steps_on_network(config: TCOConfig, priors: Priors, size: tuple[int, int]) -> int:
    """How many steps the network is adapted by: as many as wanted, or more where cameras have to be sought.

    Args:
        config: ``steps`` and ``uncertain_steps``.
        priors: of V views.
        size: height and width of the views, pixels.
    """
    if config.steps == 0 or priors.cameras is None:
        return config.steps
    sought = displacement(priors, size) > config.polish.polish_uncertainty
    return max(config.steps, config.uncertain_steps) if sought else config.steps


def _weights(terms: Terms, config: TCOConfig) -> dict[str, float]:
    """The adaptation's weights, with colours warped, and with what polishing weighs in its own way."""
    c = config.polish
    weights = terms.weights(False)
    if "photometric" in weights:
        weights["warped"] = weights.pop("photometric")
    if c.polish_smoothness > 0:
        weights["smoothness"] = c.polish_smoothness
    return weights


EDGE = 0.1
"""A step of the picture by this much, of 1, is an edge: it leaves a part 1 / e of the smoothness."""


def picture_edges(images: Tensor) -> tuple[Tensor, Tensor]:
    """exp(−|step| / ``EDGE``) between neighbours: (V, H, W − 1) along rows and (V, H − 1, W) down."""
    across = (images[..., 1:] - images[..., :-1]).abs().mean(1)
    down = (images[..., 1:, :] - images[..., :-1, :]).abs().mean(1)
    return torch.exp(-across / EDGE), torch.exp(-down / EDGE)


def roughness(field: Tensor, edges: Sequence[Tensor]) -> Tensor:
    """Mean absolute step (scalar) of a field (H, W) from pixel to pixel, weighted; see :func:`picture_edges`.

    The field, not the depth, is kept smooth: what the network sees of a surface's shape stays, and what it is
    off by changes from one thing in the picture to the next.
    """
    across, down = edges
    return (across * field.diff(dim=1).abs()).mean() + (down * field.diff(dim=0).abs()).mean()


def _finite(field: DepthField, loss: float) -> bool:
    grads = [p.grad for p in field.parameters() if p.grad is not None]
    return math.isfinite(loss) and all(bool(torch.isfinite(g).all()) for g in grads)
