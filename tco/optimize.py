"""Test-time constrained optimisation: adapt a frozen multi-view network to views and their priors."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from tco.adam import Adam
from tco.backbones.base import Backbone, RunsAhead
from tco.context import detached, due, enlarged, first_word, merged
from tco.corrections import CameraCorrections
from tco.free import FreePixels
from tco.hints import joined, told, with_more
from tco.lora import LoRAConfig, adapted, changed, fits
from tco.options import TCOConfig
from tco.penalties import sparse_depth
from tco.polish import polish, steps_on_network, too_uncertain
from tco.schedule import Sources, Stagnation, draw_targets
from tco.terms import COMPATIBILITY, ExtraTerm, Terms, errors_at, means
from tco.types import Cameras, Prediction, Priors, SparseDepth, Views

logger = logging.getLogger(__name__)

BETAS = (0.9, 0.999)
"""Decay of Adam's means, as the paper's code leaves it."""

Report = Callable[[int, dict[str, float]], None]


@dataclass(frozen=True)
class Outcome:
    """What optimisation gives.

    Attributes:
        prediction: of all views.
        cameras: of all views, with their corrections.
        corrections: how far each camera went (``CameraCorrections.sizes``); empty if none could move.
        history: the named terms of every step, unweighted, and their weighted sum as ``loss``; first the
            steps on the network, then those on the depths.
        rolled_back: steps at which the loss or its gradient was not finite; ``config.steps`` among them
            stands for the prediction after the last.
        skipped: steps on the depths, counted from 0, of which the same is true.
        before: the prediction with its depths as the network gave them, if they were refined since.
        told: points that a view was told of beside those of the priors (:mod:`tco.hints`).
    """

    prediction: Prediction
    cameras: Cameras
    corrections: dict[str, list[float]] = field(default_factory=dict)
    history: list[dict[str, float]] = field(default_factory=list)
    rolled_back: tuple[int, ...] = ()
    skipped: tuple[int, ...] = ()
    before: Prediction | None = None
    told: Mapping[int, SparseDepth] = field(default_factory=dict)


def optimize(
    backbone: Backbone,
    views: Views,
    priors: Priors,
    config: TCOConfig | None = None,
    seed: int = 0,
    report: Report | None = None,
    watched: Sequence[SparseDepth] = (),
    extra: Sequence[ExtraTerm] = (),
) -> Outcome:
    """Adapt ``backbone`` to the views and predict all of them; the network is left as it was.

    Per step, one source view is decoded, becomes surfels, and is rendered into the views that overlap
    it most; the difference in colour, the error at triangulated points and the departure from the camera
    priors are lowered by Adam on low-rank adapters of the decoder. Then the depths themselves are refined by
    the same objective (:mod:`tco.polish`).

    Without cameras among the priors, a network that predicts them is adapted to find them: by dense depths
    (``geometric_weight`` and ``depth_weight``), colours, or both.

    Args:
        backbone: the network.
        views: V views on one canvas.
        priors: cameras with uncertainties, sparse points, overlap; or dense depth alone.
        config: settings; ``steps = 0`` predicts without adapting, and see ``uncertain_steps``.
        seed: of all randomness.
        report: called after every step with its number and its terms.
        watched: points of each view that nothing is fitted to. The history then holds ``held_out``: the mean
            over a step's sources of the median relative error at their points, as they are decoded in the
            step, with a part of their input points hidden, or refined in it. It steers nothing, but for
            ``stop_after``, which stops the steps on the network when it falls no more.
        extra: penalties of the caller's own (:class:`tco.terms.ExtraTerm`), lowered with the others, in the
            steps on the network and in those on the depths.

    Raises:
        ValueError: a term has a weight and its prior is missing, or nothing may change.

    Example, a network of three numbers that learns where a wall is:

    >>> from tco.options import TCOConfig
    >>> from tco.optimize import optimize
    >>> from tco.toy import Toy, wall
    >>> scene, network = wall(), Toy()
    >>> config = TCOConfig(steps=12, rate=0.01, lora_targets=("plane",))
    >>> plain = optimize(network, scene.views, scene.priors, TCOConfig(steps=0))
    >>> adapted = optimize(network, scene.views, scene.priors, config)
    >>> error = [float((o.prediction.depth / scene.depth - 1).abs().mean()) for o in (plain, adapted)]
    >>> error[1] < error[0] / 3
    True
    """
    config = config or TCOConfig()
    config = replace(config, steps=steps_on_network(config, priors, views.size))
    with torch.no_grad():
        encoded, said, points = told(backbone, backbone.encode(views, priors), views, priors, config, seed)
        if config.steps == 0:
            prediction = backbone.decode(encoded)
            return Outcome(prediction, prediction.cameras, told=points)
        context = enlarged(said or first_word(backbone, encoded), views.size)
    terms, generator = Terms(views, priors, config, extra), torch.Generator().manual_seed(seed)
    run = _Run(backbone, views, priors, terms, encoded, context, generator)
    run.watched, run.told = watched, points
    with run.adapters() as parameters:
        run.prepare(parameters)
        for step in range(config.steps):
            figures = run.step(step)
            if report is not None:
                report(step, figures)
            if run.stopped:
                logger.info("stopped after %d steps: the error at unseen points falls no more", step + 1)
                break
        adapted_outcome = run.outcome()
    return run.polished(adapted_outcome, report)


class _Run:
    """State of one optimisation."""

    def __init__(
        self, backbone: Backbone, views: Views, priors: Priors, terms: Terms,
        encoded: Any, context: Prediction, generator: torch.Generator,
    ) -> None:  # fmt: skip
        if priors.cameras is None and backbone.uses_cameras:
            raise ValueError(f"{backbone.name} needs cameras, overlap and sparse points as priors")
        config = terms.config
        self.backbone, self.views, self.priors, self.config = backbone, views, priors, config
        self.encoded, self.context, self.generator = encoded, context, generator
        self.terms = terms
        self.encoded_cameras = priors.cameras
        movable = config.camera_rate > 0 and priors.cameras is not None
        self.corrections = CameraCorrections(priors) if movable else None
        a = config.ablation
        self.free = FreePixels(context.depth, a.free_depth, a.free_surfels)
        self.sources = Sources(a.source_order, self.terms.overlap, generator, views.helpers)
        self.stagnation: Stagnation | None = None
        self.history: list[dict[str, float]] = []
        self.rolled_back: list[int] = []
        self.watched: Sequence[SparseDepth] = ()
        self.told: Mapping[int, SparseDepth] = {}
        self.stopped = False

    def adapters(self) -> AbstractContextManager[list[torch.nn.Parameter]]:
        """Low-rank adapters, drawn from this run's generator; what comes before them is computed, once."""
        c, decoder = self.config, self.backbone.decoder()
        lora = LoRAConfig(c.lora_rank, c.lora_alpha, self._targets(), c.ablation.unfrozen)
        self.changing = changed(decoder, lora)
        self.encoded = self._ahead(self.encoded)
        return adapted(decoder, lora, self.generator)

    def _ahead(self, encoded: Any) -> Any:
        """With what comes before the adapters computed, by networks that can, if wanted."""
        if self.config.ablation.run_ahead and isinstance(self.backbone, RunsAhead):
            return self.backbone.ahead(encoded, self.changing)
        return encoded

    def _targets(self) -> tuple[str, ...]:
        """Patterns of the layers to adapt: as given; of the default those that fit any."""
        patterns = self.config.lora_targets
        if patterns != TCOConfig().lora_targets:
            return patterns
        return tuple(p for p in patterns if fits(self.backbone.decoder(), p))

    def prepare(self, parameters: Sequence[torch.nn.Parameter]) -> None:
        """Optimiser over the adapters and the camera corrections; remember the start as the best state."""
        c, own = self.config, {id(p) for p in self.backbone.decoder().parameters()}
        groups = [
            ([p for p in parameters if id(p) not in own], c.rate),
            ([p for p in parameters if id(p) in own], c.ablation.unfrozen_rate),
            (list(self.free.parameters()), c.ablation.free_rate),
        ]
        if self.corrections is not None:
            groups.append((list(self.corrections.parameters()), c.camera_rate))
        self.parameters = [p for params, _ in groups for p in params]
        if not self.parameters:
            raise ValueError("there is nothing to optimise: no adapters, no camera_rate, no free pixels")
        self.optimiser = Adam([group for group in groups if group[0]], BETAS)
        patience = c.stop_after * c.sources
        self.stagnation = Stagnation(self._measured(), patience) if patience else None
        self.weights = self.terms.weights(self.corrections is not None)
        self.best, self.best_loss = self._state(), math.inf

    def _measured(self) -> list[int]:
        """Views whose error can tell when to stop: sources that have points of which some are unseen."""
        if self.watched:
            return [view for view in self.views.wanted if len(self.watched[view])]
        return [view for view in self.views.wanted if len(self.terms.sparse[view]) > FEWEST_POINTS]

    def _state(self) -> tuple[list[Tensor], Prediction]:
        """The parameters and the context as they are now."""
        return [p.detach().clone() for p in self.parameters], self.context

    def cameras(self, prediction: Prediction) -> Cameras:
        """The cameras as they are believed now: corrected, given, or, if none are known, predicted."""
        if self.corrections is not None:
            return self.corrections()
        return prediction.cameras if self.priors.cameras is None else self.priors.cameras

    def step(self, number: int) -> dict[str, float]:
        """One step; returns its terms and their weighted sum."""
        terms = self._evaluate(number, self.sources.draw(self.config.sources))
        seen = {name: terms.pop(name) for name in ("hidden", "held_out") if name in terms}
        loss = torch.stack(
            [self.weights[name] * value for name, value in terms.items()] or [torch.zeros(())]
        ).sum()
        if not loss.requires_grad:
            self.history.append({"loss": float(loss)})
            return self.history[-1]
        self.optimiser.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, self.config.clip)
        figures = {
            **{name: float(value.detach()) for name, value in terms.items()},
            "loss": float(loss.detach()),
        }
        self._update(number, figures["loss"], bool(torch.isfinite(norm)))
        figures |= {name: float(value) for name, value in seen.items()}
        self.history.append(figures)
        return figures

    def _update(self, number: int, loss: float, finite_gradient: bool) -> None:
        """Take the optimiser's step, or go back to the best state if loss or gradient is not finite."""
        if not (math.isfinite(loss) and finite_gradient):
            logger.warning(
                "step %d: the loss or its gradient is not finite; back to the best state so far", number
            )
            self._roll_back(number)
            for group in self.optimiser.groups:
                group.lr *= 0.5
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

    def _evaluate(self, number: int, sources: list[int]) -> dict[str, Tensor]:
        """Named terms of a step, means over its sources; and errors that only tell, see :meth:`_watch`."""
        weights = self.weights
        shown = {source: self._hide(source) for source in sources}
        count, overlap = self.config.targets, self.terms.overlap
        targets = {source: draw_targets(overlap, source, count, self.generator) for source in sources}
        if self.config.ablation.published_objective and count >= len(self.views):
            targets = {source: list(range(len(self.views))) for source in sources}  # the source among them
        if not weights.keys() & COMPATIBILITY:
            targets = {source: [] for source in sources}
        prediction, parts = self.context, []
        if weights.keys() - {"cameras"}:
            self._refresh(number)
            prediction = self._predict(shown)
        cameras = self.cameras(prediction)
        if weights.keys() - {"cameras"}:
            for source in sources:
                adjust = self.free.adjustment(source)
                part = self.terms.of_source(
                    source, targets[source], prediction, self.context, cameras, weights, adjust
                )
                parts.append(part | self._watch(source, shown[source], prediction))
        terms = means(parts)
        if "cameras" in weights and self.corrections is not None:
            terms["cameras"] = self.terms.of_cameras(self.corrections, cameras)
        return terms

    def _watch(self, source: int, shown: Tensor, prediction: Prediction) -> dict[str, Tensor]:
        """``held_out``: the error at watched points; and see whether it is time to stop.

        Where no points are watched, those that the network was not shown tell that, as ``hidden``: they are
        in the loss, and so know less of it.
        """
        depth = prediction.depth[prediction.views.index(source)].detach()
        found, points = {}, self.watched[source] if self.watched else None
        if points is not None and len(points):
            found["held_out"] = errors_at(depth, points).abs().median()
        if self.stagnation is None:
            return found
        if points is None:
            points = self.terms.sparse[source][~shown]
            if len(points):
                found["hidden"] = sparse_depth(depth, points)
        if len(points):
            self.stopped |= self.stagnation.add(source, float(sparse_depth(depth, points)))
        return found

    def _hide(self, source: int) -> Tensor:
        """Which points of a view (N,) the network is shown in this step."""
        points, share = self.terms.sparse[source], self.config.point_dropout
        shown = torch.rand(len(points), generator=self.generator).to(points.depth.device) >= share
        return shown if int(shown.sum()) >= FEWEST_POINTS else torch.ones_like(shown)

    def _predict(self, points: Mapping[int, Tensor]) -> Prediction:
        """Depths of the sources with a part of their points hidden; of all views if all are decoded."""
        encoded = self.encoded
        kept = {s: self.terms.sparse[s][shown] for s, shown in points.items() if not bool(shown.all())}
        kept = {s: joined(p, self.told[s]) if s in self.told else p for s, p in kept.items()}
        if kept:
            encoded = self.backbone.with_points(encoded, kept)
        views = None if self.config.ablation.decode_all else list(points)
        prediction = self._decode(encoded, views, self.context)
        if views is None:
            self.context = detached(prediction)
        return prediction

    def _decode(
        self, encoded: Any, views: list[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        return self.free.apply_to(self.backbone.decode(encoded, views, context))

    @torch.no_grad()
    def _refresh(self, number: int) -> None:
        """Compute the context anew where it is too old, with corrected cameras if they went far."""
        if due(number, self.config.refresh):
            self._reencode()
            self.context = merged(self.context, self._decode(self.encoded, context=self.context))

    @torch.no_grad()
    def _reencode(self) -> None:
        """Give the network the corrected cameras if they went far since it was given any."""
        if self.corrections is None or not self._moved(self.corrections):
            return
        self.encoded_cameras = self.corrections()
        priors = replace(self.priors, cameras=self.encoded_cameras)
        encoded = self.backbone.encode(self.views, priors)
        self.encoded = self._ahead(with_more(self.backbone, encoded, self.terms.sparse, self.told))

    def _moved(self, corrections: CameraCorrections) -> bool:
        """Whether the network should be given the corrected cameras."""
        limit = self.config.reencode
        if limit == 0 or not self.backbone.uses_cameras or self.encoded_cameras is None:
            return False
        return corrections.pixels(self.encoded_cameras, float(self.context.depth.median())) > limit

    def outcome(self) -> Outcome:
        """Predict all views with the adapted network, as the best step had it if the last ruined it."""
        with torch.no_grad():
            self._reencode()
            prediction = self._decode(self.encoded, context=self.context)
            if not bool(torch.isfinite(prediction.depth).all()):
                logger.warning("the last step gave depths that are not finite; back to the best state")
                self._roll_back(self.config.steps)
                prediction = self._decode(self.encoded, context=self.context)
            cameras = self.cameras(prediction)
        cameras = Cameras(cameras.world_from_cam.detach(), cameras.K.detach())
        prediction = detached(prediction)
        sizes = {} if self.corrections is None else self.corrections.sizes()
        return Outcome(prediction, cameras, sizes, self.history, tuple(self.rolled_back), told=self.told)

    def polished(self, outcome: Outcome, report: Report | None) -> Outcome:
        """The outcome with its depths refined, if that is wanted; where cameras are sought it is not."""
        c = self.config.polish
        if c.polish_looks == 0 or self.priors.cameras is None:
            return outcome
        consequence = "depths are not refined (--polish_uncertainty)"
        if too_uncertain(self.priors, self.views.size, c.polish_uncertainty, consequence):
            return outcome
        done = polish(
            outcome.prediction, outcome.cameras, self.terms, self.config, self.generator, report, self.watched
        )
        return replace(
            outcome,
            prediction=done.prediction,
            before=outcome.prediction,
            history=[*outcome.history, *done.history],
            skipped=tuple(done.skipped),
        )


FEWEST_POINTS = 4
"""A view keeps at least this many points as input when others are hidden."""
