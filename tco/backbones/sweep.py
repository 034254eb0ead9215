"""The embedded network: a plane-sweep multi-view transformer that is given the cameras.

Frozen encoder: image features, and per view a volume of group-wise correlations over planes in
inverse depth, fused over the source views by attention per hypothesis. Adapted decoder: a 3-D
network, led by the image and with a transformer on the columns of its volume, turns correlations and
sparse points into depth; two passes of a finer sweep refine it, each hypothesis being judged by the
features of the source views and by the depths that the other views predict.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from typing import TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tco.backbones.contrast import equalised
from tco.backbones.decoder import Decoder, SweepConfig, convex_upsample, soft_argmax
from tco.backbones.fusing import Fusing
from tco.backbones.layers import FeatureNet
from tco.backbones.sweeping import BACKGROUND, Hints, interpolate_points, inverse_range, relative_cameras
from tco.backbones.transformer import compute_dtype, computing
from tco.backbones.warp import agree, correlate
from tco.parallel import side_by_side
from tco.types import Cameras, Prediction, Priors, SparseDepth, Views

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Encoded:
    """What the encoder keeps of V views.

    Attributes:
        volume: (V, D, H/4, W/4, C) fused correlations.
        fine: (V, ·, H/2, W/2). context: (V, ·, …) at 1/2, 1/4, 1/8, 1/16.
        lo, step: (V,) first plane and distance of the planes, in inverse depth.
        sources: (V, S) indices of the source views, best first.
        cameras: of all views.
        hints: interpolated sparse points at 1/4 and at 1/2.
    """

    volume: Tensor
    fine: Tensor
    context: tuple[Tensor, ...]
    lo: Tensor
    step: Tensor
    sources: Tensor
    cameras: Cameras
    hints: tuple[Hints, Hints]


@dataclass(frozen=True)
class Stage:
    """Inverse depth (B, h, w) of one stage, log of its expected relative error, plane scores if coarse."""

    inverse: Tensor
    log_error: Tensor
    scores: Tensor | None = None

    def __getitem__(self, index: Tensor | slice) -> Stage:
        scores = None if self.scores is None else self.scores[index]
        return Stage(self.inverse[index], self.log_error[index], scores)

    def detached(self) -> Stage:
        """Without gradients and scores."""
        return Stage(self.inverse.detach(), self.log_error.detach())

    def replaced(self, views: Sequence[int], new: Stage) -> Stage:
        """With what is new of some views, without scores."""
        index = torch.as_tensor(list(views), device=self.inverse.device)
        pairs = (self.inverse, new.inverse), (self.log_error, new.log_error)
        return Stage(*(old.index_copy(0, index, part.to(old.dtype)) for old, part in pairs))

    def doubled(self) -> Stage:
        """At twice the resolution, without scores."""
        both = torch.stack([self.inverse, self.log_error], 1)
        inverse, error = F.interpolate(both, scale_factor=2.0, mode="bilinear").unbind(1)
        return Stage(inverse, error)


def joined(stages: Sequence[Stage]) -> Stage:
    """One batch of several, with scores if all have them."""
    scores = [s.scores for s in stages if s.scores is not None]
    every = torch.cat(scores) if len(scores) == len(stages) else None
    return Stage(torch.cat([s.inverse for s in stages]), torch.cat([s.log_error for s in stages]), every)


def channels_last(module: nn.Module) -> None:
    """Lay out the weights of convolutions with channels last, twice as fast on a CPU at these sizes."""
    for m in module.modules():
        if isinstance(m, nn.Conv3d):
            m.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]
        elif isinstance(m, nn.Conv2d):
            m.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


class Sweep(nn.Module):
    """The network; satisfies :class:`tco.backbones.base.Backbone`."""

    name = "sweep"
    stride = 16
    uses_cameras = True

    def __init__(self, config: SweepConfig | None = None, dtype: torch.dtype | None = None) -> None:
        """A network of these sizes, with random weights.

        Args:
            config: its sizes.
            dtype: of products and convolutions, float32 or bfloat16; None: what the device is faster in. Of a
                network in float64 they stay in that, so that finite differences can be taken.
        """
        super().__init__()
        self.config = c = config or SweepConfig()
        self.dtype = dtype
        self.features = FeatureNet(c.coarse, c.fine, c.context)
        self.fuse = nn.Sequential(nn.Linear(c.groups[0] + 2, 16), nn.ReLU(), nn.Linear(16, c.volume + 1))
        self.head = Decoder(c)
        channels_last(self)

    def decoder(self) -> nn.Module:
        """The part that adapters change."""
        return self.head

    def mixed(self, device: torch.device) -> AbstractContextManager[object]:
        """Products and convolutions in the network's type inside the block."""
        return computing(device, self.dtype or compute_dtype(device))

    def metadata(self) -> dict[str, object]:
        """Sizes, to be stored with the weights."""
        return asdict(self.config)

    def encode(self, views: Views, priors: Priors, max_sources: int = 6) -> Encoded:
        """Features and correlation volumes of all views.

        Raises:
            ValueError: cameras, sparse points or overlap are missing, or fewer than two views.
        """
        if priors.cameras is None or priors.sparse is None or priors.overlap is None:
            raise ValueError("the sweep network needs cameras, sparse points and overlap as priors")
        if len(views) < 2:
            raise ValueError("a plane sweep needs at least two views")
        images = equalised(views.images, views.valid, self.config.equalise)
        coarse, fine, context = self._features(images, views.valid)
        lo, hi = inverse_range(priors.sparse, views.images)
        step = (hi - lo) / (self.config.planes - 1)
        order = torch.argsort(priors.overlap, dim=1, descending=True, stable=True)
        sources = order[:, : min(max_sources, len(views) - 1)]
        index = torch.arange(self.config.planes, device=lo.device, dtype=lo.dtype)
        planes = (lo[:, None] + step[:, None] * index)[..., None, None]
        volume = self._volumes(coarse, priors.cameras, sources, planes)
        quarter, half = (interpolate_points(priors.sparse, views.size, s, views.images) for s in (4, 2))
        return Encoded(volume, fine, context, lo, step, sources, priors.cameras, (quarter, half))

    def _features(self, images: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Of all views (V, 3, H, W): those of the coarse and of the fine sweep, and context."""

        def some(block: slice) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
            with self.mixed(images.device):
                found: tuple[Tensor, Tensor, tuple[Tensor, ...]] = self.features(images[block], valid[block])
            return found

        parts = _in_blocks(some, len(images), 2 * images[0, 0].numel(), images.device)
        coarse, fine, context = zip(*parts, strict=True)
        return torch.cat(coarse), torch.cat(fine), tuple(map(torch.cat, zip(*context, strict=True)))

    def with_points(self, encoded: Encoded, points: Mapping[int, SparseDepth]) -> Encoded:
        """The same features with other sparse points as hints of some views."""
        h, w = encoded.fine.shape[-2:]
        index = torch.tensor(list(points), device=encoded.lo.device)
        quarter, half = (
            old.replaced(index, interpolate_points(list(points.values()), (2 * h, 2 * w), s, encoded.lo))
            for old, s in zip(encoded.hints, (4, 2), strict=True)
        )
        return replace(encoded, hints=(quarter, half))

    def _volumes(self, features: Tensor, cameras: Cameras, sources: Tensor, planes: Tensor) -> Tensor:
        """Correlations (V, D, h, w, C) of all views, fused by attention over their sources per hypothesis.

        Without gradients they are made in place, so that the network's largest tensor is there once.
        """
        every, (h, w) = range(len(features)), features.shape[-2:]
        shape, volume = (len(every), planes.shape[1], h, w, self.config.volume), None
        if not torch.is_grad_enabled():
            volume = planes.new_empty(shape, dtype=torch.promote_types(features.dtype, planes.dtype))

        def some(b: slice) -> Tensor:
            into = None if volume is None else volume[b]
            return self._volume(features, cameras, every[b], (sources[b], planes[b]), into)

        parts = _in_blocks(some, len(every), planes.shape[1] * h * w, features.device)
        return torch.cat(parts) if volume is None else volume

    def _volume(
        self, features: Tensor, cameras: Cameras, views: Sequence[int], swept: tuple[Tensor, Tensor],
        into: Tensor | None,
    ) -> Tensor:  # fmt: skip
        """Those of some views, of their (B, S) sources and (B, D, 1, 1) planes, in ``into`` if that is given.

        A softmax accumulated source by source, so that memory does not grow with their number; where no
        source sees a hypothesis the result is 0.
        """
        sources, planes = swept
        relative = relative_cameras(cameras, views, sources, 4)
        reference = torch.as_tensor(list(views), device=sources.device)
        fusing = Fusing(self.fuse, self.mixed, into)
        for s in range(sources.shape[1]):
            pairs = torch.stack([reference, sources[:, s]], 1)
            fusing.add(*correlate(features, pairs, relative[:, s], planes, self.config.groups[0]))
        return fusing.result()

    def decode(
        self, encoded: Encoded, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        """Depth and confidence of some views; see :class:`tco.backbones.base.Backbone`.

        Each pass judges hypotheses by what the stage before says of the other views. If all views are
        decoded that is computed here and a context is not needed; else it comes from the context's
        ``stages``, or, without a context, the others' coarse depths are computed, without gradients.
        """
        every = tuple(range(len(encoded.lo)))
        chosen = every if views is None else tuple(views)
        stage = self.coarse(encoded, chosen)
        worlds = None if chosen == every else self._worlds(encoded, chosen, stage, context)
        kept = []
        for k in range(len(self.config.spacing)):
            own = stage.detached() if k else stage.detached().doubled()
            kept.append(torch.stack([own.inverse, own.log_error], 1))
            world = own if worlds is None else worlds[k].replaced(chosen, own)
            stage = self.refine(k, encoded, chosen, stage, world)
        confidence = expected_confidence(stage.log_error)
        return Prediction(1 / stage.inverse, confidence, encoded.cameras, chosen, tuple(kept))

    def draft(self, encoded: Encoded) -> Prediction:
        """All views without the last pass, which is what doubles the resolution."""
        every, passes = range(len(encoded.lo)), len(self.config.spacing)
        stage, kept = self.coarse(encoded, every), []
        for k in range(passes):
            world = stage.detached() if k else stage.detached().doubled()
            kept.append(torch.stack([world.inverse, world.log_error], 1))
            if k < passes - 1:
                stage = self.refine(k, encoded, every, stage, world)
        factor = 2 * encoded.fine.shape[-1] // stage.inverse.shape[-1]
        scale = encoded.cameras.K.new_tensor([1 / factor, 1 / factor, 1])
        cameras = Cameras(encoded.cameras.world_from_cam, encoded.cameras.K * scale[:, None])
        confidence = expected_confidence(stage.log_error)
        return Prediction(1 / stage.inverse, confidence, cameras, tuple(every), tuple(kept))

    def _worlds(
        self, encoded: Encoded, chosen: tuple[int, ...], stage: Stage, context: Prediction | None
    ) -> list[Stage]:
        """What each pass is told of all views."""
        if context is not None and context.stages:
            return [Stage(*kept.unbind(1)) for kept in context.stages]
        world = self._others(encoded, chosen, stage) if context is None else _world(context)
        return [world] * len(self.config.spacing)

    def _others(self, encoded: Encoded, chosen: tuple[int, ...], stage: Stage) -> Stage:
        """Coarse stages of all views at half resolution, those not chosen computed now."""
        rest = [v for v in range(len(encoded.lo)) if v not in chosen]
        order = torch.argsort(torch.tensor([*chosen, *rest]))
        parts = [stage.detached()]
        if rest:
            with torch.no_grad():
                parts.append(self.coarse(encoded, rest))
        return joined(parts)[order].doubled()

    def coarse(self, encoded: Encoded, views: Sequence[int]) -> Stage:
        """First stage of some views, at 1/4 of the resolution."""
        cells, device = encoded.volume[0, ..., 0].numel(), encoded.volume.device
        return joined(_in_blocks(lambda b: self._swept(encoded, views[b]), len(views), cells, device))

    def _swept(self, encoded: Encoded, views: Sequence[int]) -> Stage:
        """First stage of a few views."""
        v = _index(views, encoded.lo.device)
        lo, step = encoded.lo[v].view(-1, 1, 1), encoded.step[v].view(-1, 1, 1)
        hints = encoded.hints[0][v].as_volume(lo, step, self.config.planes)
        volume = torch.cat([encoded.volume[v], hints], -1).permute(0, 4, 1, 2, 3)
        _, quarter, eighth, sixteenth = (c[v] for c in encoded.context)
        with self.mixed(volume.device):
            scores: Tensor = self.head.coarse(volume, (quarter, eighth, sixteenth))
        planes = lo + step * torch.arange(scores.shape[1], device=lo.device, dtype=lo.dtype).view(1, -1, 1)
        index, mass = soft_argmax(scores, (planes < BACKGROUND * lo).squeeze(-1))
        inverse = lo + step * index
        error = (step / inverse * (0.3 + 3 * (1 - mass))).log()
        return Stage(inverse, error, scores)

    def refine(self, k: int, encoded: Encoded, views: Sequence[int], stage: Stage, world: Stage) -> Stage:
        """Pass ``k`` of the refinement of some views, given half-resolution depths of all views."""
        if stage.inverse.shape[-1] != encoded.fine.shape[-1]:
            stage = stage.doubled()

        def some(block: slice) -> Stage:
            return self._refined(k, encoded, views[block], stage[block], world)

        cells = encoded.fine[0, 0].numel() * self.config.hypotheses
        return joined(_in_blocks(some, len(views), cells, encoded.fine.device))

    def _refined(self, k: int, encoded: Encoded, views: Sequence[int], stage: Stage, world: Stage) -> Stage:
        """One pass for a few views."""
        c = self.config
        v = torch.as_tensor(list(views), device=encoded.lo.device)
        lo, step = encoded.lo[v].view(-1, 1, 1), encoded.step[v].view(-1, 1, 1) * c.spacing[k]
        floor = 0.05 * lo
        lowest = floor + step * c.hypotheses / 2
        start = stage.inverse.detach().maximum(lowest)
        index = torch.arange(c.hypotheses, device=step.device, dtype=step.dtype)
        offset = (index - (c.hypotheses - 1) / 2).view(1, -1, 1, 1)
        planes = start.unsqueeze(1) + step.unsqueeze(1) * offset
        relative = relative_cameras(encoded.cameras, views, encoded.sources[v], 2)
        matching = self._matching(encoded, v, relative, planes)
        agreement = agree(planes, relative, encoded.sources[v], world.inverse, world.log_error)
        rows = _index(views, v.device)
        hints = encoded.hints[1][rows]
        bump, near = hints.at(planes, step)
        sure = torch.stack([stage.log_error.detach(), (step / start).log()], 1)
        x = torch.cat([matching, agreement, bump, near, sure, hints.distance.unsqueeze(1)], 1)
        x = x.contiguous(memory_format=torch.channels_last)
        half, quarter, eighth, _ = (m[rows] for m in encoded.context)
        with self.mixed(x.device):
            scores, extra, mask = self.head.refine[k](x, (half, quarter, eighth))
        moved = (scores.softmax(1) * offset).sum(1) + extra[:, 0]
        inverse = (stage.inverse.maximum(lowest) + step * moved).maximum(floor)
        error = extra[:, 1] + stage.log_error.detach()
        if mask is not None:
            inverse = convex_upsample(inverse.unsqueeze(1), mask)
            error = F.interpolate(error.unsqueeze(1), scale_factor=2.0, mode="bilinear").squeeze(1)
        return Stage(inverse, error)

    def _matching(self, encoded: Encoded, views: Tensor, relative: Tensor, planes: Tensor) -> Tensor:
        """Correlations (B, D·G, h, w) at per-pixel hypotheses, averaged over sources by learned weights."""
        total = weights = torch.zeros((), device=planes.device)
        for s in range(relative.shape[1]):
            pairs = torch.stack([views, encoded.sources[views, s]], 1)
            corr, seen = correlate(
                encoded.fine, pairs, relative[:, s], planes, self.config.groups[1], last=True
            )
            corr = corr.flatten(3)
            with self.mixed(planes.device):
                score = self.head.weigh(corr)
            weight = score.float().clamp(-8, 8).exp() * seen.mean(-1, keepdim=True)
            total, weights = total + weight * corr, weights + weight
        return (total / (weights + 1e-6)).permute(0, 3, 1, 2)


BATCH, LARGE_BATCH = 200_000, 400_000
"""Cells of correlation volumes that are computed at once, on a CPU, where several such are at work side by
side, and elsewhere: small views together, large ones alone."""

ERROR_UNIT = 0.02
"""A relative error of this size has confidence 2, so its surfel is half opaque."""


def expected_confidence(log_error: Tensor) -> Tensor:
    """Confidence ≥ 1 of an expected relative error: 1 + ``ERROR_UNIT`` / error."""
    return 1 + ERROR_UNIT * (-log_error).exp()


def _in_blocks(
    task: Callable[[slice], _Result], views: int, cells: int, device: torch.device
) -> list[_Result]:
    """Results of a task of so many views in groups, of so many cells each; at least one view a group."""
    per = max(1, (BATCH if device.type == "cpu" else LARGE_BATCH) // cells)
    return side_by_side(task, [slice(k, min(k + per, views)) for k in range(0, views, per)], device)


def _index(views: Sequence[int], device: torch.device) -> Tensor | slice:
    """Of rows of tensors: a slice, which copies nothing, where the views follow one another."""
    if list(views) == list(range(views[0], views[-1] + 1)):
        return slice(views[0], views[-1] + 1)
    return torch.as_tensor(list(views), device=device)


def _world(context: Prediction) -> Stage:
    """A prediction of all views as a stage at half of its resolution."""
    error = ERROR_UNIT / (context.confidence - 1)
    inverse, error = F.avg_pool2d(torch.stack([1 / context.depth, error], 1), 2).unbind(1)
    return Stage(inverse, error.log()).detached()
