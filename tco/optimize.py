"""Test-time constrained optimisation: adapt a frozen multi-view network to views and their priors."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from tco.backbones.base import Backbone
from tco.corrections import CameraCorrections
from tco.lora import LoRAConfig, adapted
from tco.objective import NothingVisibleError, ObjectiveConfig, consistency, photometric
from tco.options import TCOConfig
from tco.penalties import sparse_depth
from tco.surfels import from_depth
from tco.types import Cameras, Prediction, Priors, SparseDepth, Views

logger = logging.getLogger(__name__)

Report = Callable[[int, dict[str, float]], None]


@dataclass(frozen=True)
class Outcome:
    """What optimisation gives.

    Attributes:
        prediction: of all views.
        cameras: of all views, with their corrections.
        corrections: how far each camera went (``CameraCorrections.sizes``); empty if none could move.
        history: the named terms of every step, unweighted, and their weighted sum as ``loss``.
        rolled_back: steps at which the loss or its gradient was not finite; ``config.steps`` among them
            stands for the prediction after the last.
    """

    prediction: Prediction
    cameras: Cameras
    corrections: dict[str, list[float]] = field(default_factory=dict)
    history: list[dict[str, float]] = field(default_factory=list)
    rolled_back: tuple[int, ...] = ()


def optimize(
    backbone: Backbone,
    views: Views,
    priors: Priors,
    config: TCOConfig | None = None,
    seed: int = 0,
    report: Report | None = None,
) -> Outcome:
    """Adapt ``backbone`` to the views and predict all of them; the network is left as it was.

    Per step, one source view is decoded, becomes surfels, and is rendered into the views that overlap
    it most; the difference in colour, the disagreement in depth, the error at triangulated points and
    the departure from the camera priors are lowered by Adam on low-rank adapters of the decoder.

    Args:
        backbone: a network that takes cameras as input.
        views: V views on one canvas.
        priors: cameras with uncertainties, sparse points, overlap.
        config: settings; ``steps = 0`` predicts without adapting.
        seed: of all randomness.
        report: called after every step with its number and its terms.

    Raises:
        ValueError: a term has a weight and its prior is missing.
    """
    config = config or TCOConfig()
    with torch.no_grad():
        encoded = backbone.encode(views, priors)
        first = backbone.decode(encoded)
    if config.steps == 0:
        return Outcome(first, first.cameras)
    run = _Run(backbone, views, priors, config, encoded, first, torch.Generator().manual_seed(seed))
    with run.adapters() as parameters:
        run.prepare(parameters)
        for step in range(config.steps):
            terms = run.step(step)
            if report is not None:
                report(step, terms)
        return run.outcome()


class _Run:
    """State of one optimisation."""

    def __init__(
        self, backbone: Backbone, views: Views, priors: Priors, config: TCOConfig,
        encoded: Any, context: Prediction, generator: torch.Generator,
    ) -> None:  # fmt: skip
        if priors.cameras is None or priors.overlap is None or priors.sparse is None:
            raise ValueError("optimisation needs cameras, overlap and sparse points as priors")
        self.backbone, self.views, self.priors, self.config = backbone, views, priors, config
        self.encoded, self.context, self.generator = encoded, context, generator
        self.overlap, self.sparse = priors.overlap, priors.sparse
        self.corrections = CameraCorrections(priors) if config.camera_rate > 0 else None
        self.objective = ObjectiveConfig(
            occlusion_tolerance=config.occlusion_tolerance,
            exposure=config.exposure,
            structure=config.structure,
        )
        self.order: list[int] = []
        self.history: list[dict[str, float]] = []
        self.rolled_back: list[int] = []

    def adapters(self) -> AbstractContextManager[list[torch.nn.Parameter]]:
        """Low-rank adapters on the decoder, drawn from this run's generator."""
        c = self.config
        lora = LoRAConfig(rank=c.lora_rank, alpha=c.lora_alpha, targets=c.lora_targets)
        return adapted(self.backbone.decoder(), lora, self.generator)

    def prepare(self, parameters: Sequence[torch.nn.Parameter]) -> None:
        """Optimiser over the adapters and the camera corrections; remember the start as the best state."""
        c = self.config
        groups: list[dict[str, Any]] = [{"params": list(parameters), "lr": c.rate}]
        if self.corrections is not None:
            groups.append({"params": list(self.corrections.parameters()), "lr": c.camera_rate})
        self.optimiser = torch.optim.Adam(groups)
        self.parameters = [p for group in groups for p in group["params"]]
        self.best, self.best_loss = self._state(), math.inf

    def _state(self) -> tuple[list[Tensor], Prediction]:
        """The parameters and the context as they are now."""
        return [p.detach().clone() for p in self.parameters], self.context

    def cameras(self) -> Cameras:
        """The cameras as they are believed now."""
        assert self.priors.cameras is not None
        return self.priors.cameras if self.corrections is None else self.corrections()

    def step(self, number: int) -> dict[str, float]:
        """One step; returns its terms and their weighted sum."""
        c = self.config
        if number and number % c.refresh == 0:
            with torch.no_grad():
                self.context = self.backbone.decode(self.encoded, context=self.context)
        source = self._next_source()
        terms = self._terms(source)
        if not terms:
            self.history.append({"loss": 0.0})
            return self.history[-1]
        weights = {
            "photometric": c.photometric_weight,
            "consistency": c.consistency_weight if number >= c.consistency_start * c.steps else 0.0,
            "sparse": c.sparse_weight,
            "cameras": c.camera_weight,
        }
        loss = torch.stack([weights[name] * value for name, value in terms.items()]).sum()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, c.clip)
        figures = {
            **{name: float(value.detach()) for name, value in terms.items()},
            "loss": float(loss.detach()),
        }
        self._update(number, figures["loss"], bool(torch.isfinite(norm)))
        self.history.append(figures)
        return figures

    def _update(self, number: int, loss: float, finite_gradient: bool) -> None:
        """Take the optimiser's step, or go back to the best state if loss or gradient is not finite."""
        if not (math.isfinite(loss) and finite_gradient):
            logger.warning(
                "step %d: the loss or its gradient is not finite; back to the best state so far", number
            )
            self._roll_back(number)
            for group in self.optimiser.param_groups:
                group["lr"] *= 0.5
            return
        if loss < self.best_loss:
            self.best, self.best_loss = self._state(), loss
        self.optimiser.step()

    @torch.no_grad()
    def _roll_back(self, number: int) -> None:
        """Back to the best state; its context too, since later ones may come from bad parameters."""
        self.rolled_back.append(number)
        values, self.context = self.best
        for p, kept in zip(self.parameters, values, strict=True):
            p.copy_(kept)

    def _next_source(self) -> int:
        """Views in a random order, each once before any comes again."""
        if not self.order:
            self.order = torch.randperm(len(self.views), generator=self.generator).tolist()
        return self.order.pop()

    def _targets(self, source: int) -> list[int]:
        """Views to render into: drawn without repetition, with the number of common points as odds."""
        odds = self.overlap[source].cpu().clone()
        odds[source] = 0
        count = min(self.config.targets, int((odds > 0).sum()))
        if count == 0:
            return []
        return torch.multinomial(odds, count, generator=self.generator).tolist()

    def _terms(self, source: int) -> dict[str, Tensor]:
        """Named terms of one source view."""
        c, points = self.config, self.sparse[source]
        shown = torch.rand(len(points), generator=self.generator).to(points.depth.device) >= c.point_dropout
        encoded = self.encoded
        if c.point_dropout > 0 and int(shown.sum()) >= FEWEST_POINTS:
            encoded = self.backbone.with_points(encoded, {source: points[shown]})
        prediction = self.backbone.decode(encoded, [source], self.context)
        cameras, targets = self.cameras(), self._targets(source)
        terms: dict[str, Tensor] = {}
        if targets:
            try:
                terms.update(self._compatibility(source, targets, prediction, cameras))
            except NothingVisibleError as error:
                logger.warning("%s: no compatibility in this step: %s", self.views.names[source], error)
        if c.sparse_weight > 0 and len(points):
            terms["sparse"] = sparse_depth(prediction.depth[0], points)
        if self.corrections is not None:
            terms["cameras"] = self.corrections.penalty()
        return terms

    def _compatibility(
        self, source: int, targets: list[int], prediction: Prediction, cameras: Cameras
    ) -> dict[str, Tensor]:
        """Compatibility of one source with its targets, in colour and in depth."""
        c, depth, terms = self.config, prediction.depth[0], {}
        if c.photometric_weight > 0:
            surfels = from_depth(
                depth, cameras.K[source], cameras.world_from_cam[source], self.views.images[source],
                prediction.confidence[0], valid=self.views.valid[source],
            )  # fmt: skip
            terms["photometric"] = photometric(
                surfels, self.views.images[targets], cameras[targets], self.context.depth[targets],
                self.views.valid[targets], self.objective,
            )  # fmt: skip
        if c.consistency_weight > 0:
            terms["consistency"] = consistency(
                depth, cameras, source, targets, self.context, c.consistency_tolerance
            )
        return terms

    def outcome(self) -> Outcome:
        """Predict all views with the adapted network, as the best step had it if the last ruined it."""
        with torch.no_grad():
            prediction = self.backbone.decode(self.encoded, context=self.context)
            if not bool(torch.isfinite(prediction.depth).all()):
                logger.warning("the last step gave depths that are not finite; back to the best state")
                self._roll_back(self.config.steps)
                prediction = self.backbone.decode(self.encoded, context=self.context)
            cameras = self.cameras()
        cameras = Cameras(cameras.world_from_cam.detach(), cameras.K.detach())
        prediction = replace(
            prediction, depth=prediction.depth.detach(), confidence=prediction.confidence.detach()
        )
        sizes = {} if self.corrections is None else self.corrections.sizes()
        return Outcome(prediction, cameras, sizes, self.history, tuple(self.rolled_back))


FEWEST_POINTS = 4
"""A view keeps at least this many points as input when others are hidden."""


def errors_at_points(prediction: Prediction, points: Sequence[SparseDepth]) -> list[Tensor]:
    """Relative depth errors at points, one (N,) a view of the prediction, in the order of ``points``.

    The depth at a point is that of the pixel it falls into: what a user reads off the map.
    """
    out = []
    for depth, sparse in zip(prediction.depth, points, strict=True):
        h, w = depth.shape
        x, y = sparse.xy.long().unbind(-1)
        out.append(depth[y.clamp(0, h - 1), x.clamp(0, w - 1)] / sparse.depth - 1)
    return out
