"""The named terms that a step lowers, each from what its source view predicts."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tco import penalties
from tco.corrections import CameraCorrections
from tco.objective import NothingVisibleError, ObjectiveConfig, geometric, photometric
from tco.options import TCOConfig
from tco.surfels import Adjustment, SurfelConfig, Surfels, from_depth
from tco.types import Cameras, HeldCameras, Prediction, Priors, SparseDepth, Views
from tco.warped import warped_difference

logger = logging.getLogger(__name__)

Penalty = Callable[[int, Tensor, Cameras], "Tensor | None"]
"""Of a view, its depth (H, W) and the cameras of all views: a scalar, or None where there is none."""


@dataclass(frozen=True)
class ExtraTerm:
    """A penalty of the caller's own, lowered together with the others.

    Attributes:
        name: under which the history has it; none that a term has already.
        weight: of it in the sum; 0: it is not computed.
        penalty: called with the index of a step's source view, its depth (H, W), and the cameras of all V
            views as they are believed now. It is differentiable in both, and None of a view of which it has
            nothing to say. The world and the unit of length are those of the priors.
    """

    name: str
    weight: float
    penalty: Penalty

    def __post_init__(self) -> None:
        if self.name in OWN or self.weight < 0:
            raise ValueError(
                f"an extra term needs a name other than {', '.join(sorted(OWN))} and a weight that is not "
                f"negative, not {self.name!r} and {self.weight}"
            )


COMPATIBILITY = frozenset({"photometric", "geometric", "warped"})
"""Terms that compare a view with others."""
HELD = ("rotation", "translation", "focal")
"""Terms that hold the cameras that a network predicts."""
OWN = COMPATIBILITY | set(HELD) | {"smoothness", "sparse", "depth", "cameras", "loss", "hidden", "held_out"}
"""Names that the history has already."""


class Terms:
    """Terms of the views of one chunk, with what is known of them.

    Attributes:
        looked_up: the views with the pictures that pixels are looked up in (weight ``warped``).
        sparse: triangulated points, one :class:`SparseDepth` a view, empty where there are none.
        overlap: (V, V) how much views share; all alike where it is not known.
    """

    def __init__(
        self, views: Views, priors: Priors, config: TCOConfig, extra: Sequence[ExtraTerm] = ()
    ) -> None:
        """Check that every term that has a weight has its data.

        Raises:
            ValueError: it has not, or two extra terms have one name.
        """
        self.views, self.config, self.given, self.depth = views, config, priors.cameras, priors.depth
        self.depth_sigma, self.extra = priors.depth_sigma, tuple(extra)
        if len({term.name for term in extra}) < len(extra):
            raise ValueError(f"extra terms of one name: {', '.join(term.name for term in extra)}")
        self.held = priors.held
        if self.held is not None and self.given is not None:
            raise ValueError("cameras are given, so that there are none of the network's own to be held")
        if self.held is not None and len(views) < 2 and self.held.rotation + self.held.translation > 0:
            logger.warning("%s: one view has no relative pose to be held", views.names[0])
        if config.depth_weight > 0:
            self._check_depth()
        if self.given is not None and config.sparse_weight > 0 and priors.sparse is None:
            raise ValueError("sparse_weight is set and there are no sparse points among the priors")
        self.looked_up = in_colours(views, config.polish.polish_colours)
        self.sparse = priors.sparse or (_no_points(views.images),) * len(views)
        alike = torch.ones(len(views), len(views)).fill_diagonal_(0)
        self.overlap = alike if priors.overlap is None else priors.overlap
        self.objective, self.surfels = comparison(config)

    def _check_depth(self) -> None:
        """Raise a ValueError if there is no dense depth."""
        if self.depth is None:
            raise ValueError("depth_weight is set and there is no dense depth among the priors")
        if int(((self.depth > 0) & self.views.valid).sum()) < 2:
            raise ValueError("depth_weight is set and the dense depth is empty: all of it is 0 or masked out")

    def weights(self, movable: bool) -> dict[str, float]:
        """The weight of each term; one that is not here is not computed.

        Args:
            movable: whether given cameras may move, and so have a term that holds them.
        """
        c = self.config
        cameras = 1.0 if c.ablation.plain_cameras else c.camera_weight
        every = {
            "photometric": c.photometric_weight,
            "geometric": c.geometric_weight,
            "sparse": c.sparse_weight,
            "depth": c.depth_weight,
            "cameras": cameras if movable else 0.0,
            **{term.name: term.weight for term in self.extra},
        }
        if self.held is not None:
            alone = len(self.views) < 2  # which has no relative pose
            every |= {name: getattr(self.held, name) for name in (HELD[2:] if alone else HELD)}
        return {name: weight for name, weight in every.items() if weight > 0}

    def of_source(
        self, source: int, targets: Sequence[int], prediction: Prediction, context: Prediction,
        cameras: Cameras, weights: Mapping[str, float], adjust: Adjustment | None = None,
    ) -> dict[str, Tensor]:  # fmt: skip
        """Terms with a weight of one source view, those for which it has data.

        Args:
            source: index of the view, one of ``prediction.views``.
            targets: views that it is compared with; none: it is compared with none.
            prediction: differentiable.
            context: prediction for all views, which is not. If ``prediction`` is of all views, it counts.
            cameras: of all views, as they are believed now.
            weights: which terms are wanted.
            adjust: changes of the surfels.
        """
        depth = prediction.depth[prediction.views.index(source)]
        terms = {}
        if "sparse" in weights and len(self.sparse[source]):
            terms["sparse"] = penalties.sparse_depth(depth, self.sparse[source])
        if "depth" in weights:
            terms |= self._depth(prediction, context)
        for term in self.extra:
            value = term.penalty(source, depth, cameras) if term.name in weights else None
            if value is not None:
                terms[term.name] = value
        terms |= self._held(prediction.cameras, weights)
        if not targets:
            return terms
        try:
            terms |= self._compatibility(source, list(targets), prediction, context, cameras, weights, adjust)
        except NothingVisibleError as error:
            logger.warning("%s: no compatibility in this step: %s", self.views.names[source], error)
        return terms

    def _depth(self, prediction: Prediction, context: Prediction) -> dict[str, Tensor]:
        """Penalty of the dense prior on the views that were predicted; none where it says nothing of them.

        In standard deviations where these are known, else after one scale and shift of all views' depths.
        """
        assert self.depth is not None
        chosen = list(prediction.views)
        mask = (self.depth > 0) & self.views.valid
        if not bool(mask[chosen].any()):
            return {}
        if self.depth_sigma is not None:
            given = prediction.depth, self.depth[chosen], mask[chosen], self.depth_sigma[chosen]
            return {"depth": penalties.depth_uncertain(*given)}
        at = torch.as_tensor(chosen, device=mask.device)
        every = context.depth.index_copy(0, at, prediction.depth)
        if self.config.ablation.published_objective:
            sure = context.confidence.index_copy(0, at, prediction.confidence)
            return {"depth": penalties.depth_reference(every, self.depth, mask, sure, 0.5)}
        return {"depth": penalties.depth(every, self.depth, mask, chosen)}

    def _held(self, ours: Cameras, weights: Mapping[str, float]) -> dict[str, Tensor]:
        """Penalties on the network's own cameras (arXiv 2604.03878, section 3.2.2), or by uncertainty."""
        if self.held is None:
            return {}
        published = self.config.ablation.published_objective
        names = [name for name in HELD if name in weights]
        return {name: penalties.held(name, ours, self.held, published) for name in names}

    def _compatibility(
        self, source: int, targets: list[int], prediction: Prediction, context: Prediction,
        cameras: Cameras, weights: Mapping[str, float], adjust: Adjustment | None,
    ) -> dict[str, Tensor]:  # fmt: skip
        """Compatibility of one source with its targets, in colour and in depth."""
        terms, depth = {}, prediction.depth[prediction.views.index(source)]
        known = prediction if len(prediction.views) == len(self.views) else context
        there = known.depth[targets], self.views.valid[targets], self.objective
        if weights.keys() & {"photometric", "geometric"}:
            surfels = self._surfels(source, prediction, cameras, adjust)
        if "photometric" in weights:
            terms["photometric"] = photometric(surfels, self.views.images[targets], cameras[targets], *there)
        if "geometric" in weights:
            terms["geometric"] = geometric(surfels, cameras[targets], *there)
        if "warped" in weights:
            opacity = self._opacity(source, prediction).detach()
            terms["warped"] = warped_difference(
                depth, opacity, self.looked_up, cameras, (source, targets), context, self.objective
            )
        return terms

    def _opacity(self, source: int, prediction: Prediction) -> Tensor:
        """Weight (H, W) of the pixels of a source: the opacity that their surfels have."""
        confidence = prediction.confidence[prediction.views.index(source)]
        opacity = 1 - 1 / confidence if self.surfels.confident_opacity else torch.ones_like(confidence)
        return opacity * self.views.valid[source]

    def _surfels(
        self, source: int, prediction: Prediction, cameras: Cameras, adjust: Adjustment | None
    ) -> Surfels:
        i = prediction.views.index(source)
        return from_depth(
            prediction.depth[i], cameras.K[source], cameras.world_from_cam[source],
            self.views.images[source], prediction.confidence[i],
            valid=self.views.valid[source], config=self.surfels, adjust=adjust,
        )  # fmt: skip

    def of_cameras(self, corrections: CameraCorrections, cameras: Cameras) -> Tensor:
        """Departure (scalar) of corrected cameras from what was given."""
        if not self.config.ablation.plain_cameras:
            return corrections.penalty(self.config.camera_kernel)
        assert self.given is not None
        known, published = HeldCameras(self.given), self.config.ablation.published_objective
        parts = [getattr(known, name) * penalties.held(name, cameras, known, published) for name in HELD]
        return torch.stack(parts).sum()


def comparison(config: TCOConfig) -> tuple[ObjectiveConfig, SurfelConfig]:
    """How surfels are made and compared, by the settings of an optimisation."""
    a = config.ablation
    if a.published_objective:
        engine = "cpu" if a.renderer == "surface" else a.renderer
        surfels = SurfelConfig(a.radius_factor, pixel_centre=0.0, confident_opacity=a.confident_opacity)
        return replace(ObjectiveConfig.reference(), renderer=engine), surfels
    objective = ObjectiveConfig(
        occlusion_tolerance=config.occlusion_tolerance,
        exposure=config.exposure,
        structure=config.structure,
        renderer=a.renderer,
    )
    return objective, SurfelConfig(a.radius_factor, confident_opacity=a.confident_opacity)


def in_colours(views: Views, wanted: bool) -> Views:
    """The views with all their colours if wanted, else with the mean of these, images (V, 1, H, W)."""
    return views if wanted else replace(views, images=views.images.mean(1, keepdim=True))


def errors_at(depth: Tensor, points: SparseDepth) -> Tensor:
    """Relative errors (N,) of one depth map (H, W) at points: of the pixel that each falls into."""
    h, w = depth.shape
    x, y = points.xy.long().unbind(-1)
    return depth[y.clamp(0, h - 1), x.clamp(0, w - 1)] / points.depth - 1


def means(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Mean of each term over the parts that have it, in the order of their first appearance."""
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: torch.stack([part[name] for part in parts if name in part]).mean() for name in names}


def _no_points(like: Tensor) -> SparseDepth:
    none = like.new_zeros(0)
    return SparseDepth(none.reshape(0, 2), none, none, none.long())


def errors_at_points(prediction: Prediction, points: Sequence[SparseDepth]) -> list[Tensor]:
    """Relative depth errors at points, one (N,) a view of the prediction, in the order of ``points``.

    The depth at a point is that of the pixel it falls into: what a user reads off the map.
    """
    return [errors_at(depth, sparse) for depth, sparse in zip(prediction.depth, points, strict=True)]
