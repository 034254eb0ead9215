"""The embedded network: a plane-sweep multi-view transformer that is given the cameras.

Frozen encoder: image features, and per view a volume of group-wise correlations over planes in
inverse depth, fused over the source views by attention per hypothesis. Adapted decoder: a 3-D
network with a transformer on its coarsest level turns the volume and the sparse points into depth;
two passes of a finer sweep refine it, each hypothesis being judged by the features of the source
views and by the depths that the other views predict.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tco.backbones.layers import Block, Conv, FeatureNet, Pointwise, Residual, rotary
from tco.backbones.sweeping import (
    Hints,
    aggregate,
    correlations,
    depth_agreement,
    interpolate_points,
    inverse_range,
    relative_cameras,
)
from tco.types import Cameras, Prediction, Priors, SparseDepth, Views


@dataclass(frozen=True)
class SweepConfig:
    """Sizes of the network; stored beside its weights.

    Attributes:
        planes: hypotheses of the coarse sweep, uniform in inverse depth.
        groups: correlation groups of the coarse and of the fine sweep.
        coarse, fine, context: channels of the features.
        volume: channels of the fused correlation volume.
        tokens, heads, blocks: transformer on the coarsest level.
        hypotheses: of each refinement pass.
        spacing: step of each refinement pass, in coarse planes.
        hidden: channels of the refinement.
    """

    planes: int = 48
    groups: tuple[int, int] = (8, 4)
    coarse: int = 32
    fine: int = 16
    context: int = 24
    volume: int = 12
    tokens: int = 192
    heads: int = 4
    blocks: int = 3
    hypotheses: int = 8
    spacing: tuple[float, ...] = (0.3, 0.08)
    hidden: int = 40


@dataclass(frozen=True)
class Encoded:
    """What the encoder keeps of V views.

    Attributes:
        volume: (V, C, D, H/4, W/4) fused correlations.
        fine, context: (V, ·, H/2, W/2). top: (V, ·, H/16, W/16).
        lo, step: (V,) first plane and distance of the planes, in inverse depth.
        sources: (V, S) indices of the source views, best first.
        cameras: of all views.
        hints: interpolated sparse points at 1/4 and at 1/2.
    """

    volume: Tensor
    fine: Tensor
    context: Tensor
    top: Tensor
    lo: Tensor
    step: Tensor
    sources: Tensor
    cameras: Cameras
    hints: tuple[Hints, Hints]


class Volume(nn.Module):
    """Three levels of 3-D convolutions; on the coarsest, each column of the volume is a token."""

    def __init__(self, c: SweepConfig, top: int) -> None:
        super().__init__()
        self.planes = c.planes
        self.stem = Conv(3, c.volume + 4, 12)
        self.down1 = nn.Sequential(Conv(3, 12, 24, stride=2), Conv(3, 24, 24))
        self.down2 = nn.Sequential(Conv(3, 24, 32, stride=2), Conv(3, 32, 32))
        self.embed = nn.Linear(32 * c.planes // 4 + top, c.tokens)
        self.blocks = nn.ModuleList(Block(c.tokens, c.heads) for _ in range(c.blocks))
        self.norm = nn.LayerNorm(c.tokens)
        self.unembed = nn.Linear(c.tokens, 32 * c.planes // 4)
        self.up1, self.up0 = Pointwise(32, 24), Pointwise(24, 12)
        self.out1, self.out0 = Conv(3, 24, 24), Conv(3, 12, 12)
        self.head = nn.Conv3d(12, 1, 3, padding=1)
        nn.init.zeros_(self.unembed.weight)

    def forward(self, volume: Tensor, hints: Hints, lo: Tensor, step: Tensor, top: Tensor) -> Tensor:
        """Volume (B, C, D, h, w), points, planes and context → scores (B, D, h, w)."""
        x = torch.cat([volume, hints.as_volume(lo, step, self.planes)], 1)
        x0 = self.stem(x.contiguous(memory_format=torch.channels_last_3d))
        x1 = self.down1(x0)
        x2 = self.down2(x1)
        b, c, d, h, w = x2.shape
        tokens = torch.cat([x2.reshape(b, c * d, h * w), top.flatten(2)], 1).transpose(1, 2)
        tokens = self.embed(tokens)
        cos, sin = rotary(h, w, tokens.shape[-1] // self.blocks[0].heads, tokens)
        for block in self.blocks:
            tokens = block(tokens, cos, sin)
        x2 = x2 + self.unembed(self.norm(tokens)).transpose(1, 2).reshape(b, c, d, h, w)
        x1 = self.out1(x1 + F.interpolate(self.up1(x2), size=x1.shape[2:], mode="trilinear"))
        x0 = self.out0(x0 + F.interpolate(self.up0(x1), size=x0.shape[2:], mode="trilinear"))
        return self.head(x0).squeeze(1).float()


class Refine(nn.Module):
    """Chooses among hypotheses around the present depth, at half resolution."""

    def __init__(self, c: SweepConfig, upsample: bool) -> None:
        super().__init__()
        per = c.groups[1] + 3
        self.stem = nn.Sequential(
            Conv(2, per * c.hypotheses + c.context + 4, c.hidden), Residual(2, c.hidden)
        )
        self.body = nn.Sequential(Residual(2, c.hidden, 2), Residual(2, c.hidden, 4), Residual(2, c.hidden))
        self.head = nn.Conv2d(c.hidden, c.hypotheses + 2, 3, padding=1)
        self.mask = nn.Sequential(Conv(2, c.hidden + c.context, 32), Pointwise(32, 36)) if upsample else None

    def forward(self, x: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Features (B, ·, h, w) → scores (B, D, h, w), offset and log-error (B, 2, h, w), mask (B, 36, h, w).

        The mask is for the last pass, which upsamples; None in the others.
        """
        y = self.body(self.stem(torch.cat([x, context], 1)))
        out = self.head(y)
        mask = None if self.mask is None else self.mask(torch.cat([y, context], 1))
        return out[:, :-2].float(), out[:, -2:].float(), None if mask is None else mask.float()


class Decoder(nn.Module):
    """Everything that test-time adapters may change."""

    def __init__(self, c: SweepConfig) -> None:
        super().__init__()
        self.coarse = Volume(c, 96)
        self.weigh = nn.Sequential(Pointwise(c.groups[1] * c.hypotheses, 16), nn.ReLU(), Pointwise(16, 1))
        self.refine = nn.ModuleList(Refine(c, k + 1 == len(c.spacing)) for k in range(len(c.spacing)))


def channels_last(module: nn.Module) -> None:
    """Lay out the weights of convolutions with channels last, twice as fast on a CPU at these sizes."""
    for m in module.modules():
        if isinstance(m, nn.Conv3d):
            m.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]
        elif isinstance(m, nn.Conv2d):
            m.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def soft_argmax(scores: Tensor, radius: int = 2) -> tuple[Tensor, Tensor]:
    """Expected plane index around the best one and the probability of that neighbourhood, both (B, h, w)."""
    p = scores.softmax(1)
    index = torch.arange(scores.shape[1], device=scores.device, dtype=scores.dtype).view(1, -1, 1, 1)
    near = (index - scores.detach().argmax(1, keepdim=True)).abs() <= radius
    p = p * near
    mass = p.sum(1)
    return (p * index).sum(1) / mass, mass


def convex_upsample(x: Tensor, mask: Tensor) -> Tensor:
    """(B, 1, h, w) → (B, 2h, 2w), each pixel a convex combination of the 3×3 around it."""
    b, _, h, w = x.shape
    weight = mask.reshape(b, 9, 2, 2, h, w).softmax(1)
    patch = F.unfold(F.pad(x, (1, 1, 1, 1), mode="replicate"), 3).reshape(b, 9, 1, 1, h, w)
    return (weight * patch).sum(1).permute(0, 3, 1, 4, 2).reshape(b, 2 * h, 2 * w)


@dataclass(frozen=True)
class Stage:
    """Inverse depth (B, h, w) of one stage, log of its expected relative error, plane scores if coarse."""

    inverse: Tensor
    log_error: Tensor
    scores: Tensor | None = None


class Sweep(nn.Module):
    """The network; satisfies :class:`tco.backbones.base.Backbone`."""

    name = "sweep"
    stride = 16
    uses_cameras = True

    def __init__(self, config: SweepConfig | None = None) -> None:
        super().__init__()
        self.config = c = config or SweepConfig()
        self.features = FeatureNet(c.coarse, c.fine, c.context)
        self.fuse = nn.Sequential(Pointwise(c.groups[0] + 2, 16), nn.ReLU(), Pointwise(16, c.volume + 1))
        self.head = Decoder(c)
        channels_last(self)

    def decoder(self) -> nn.Module:
        """The part that adapters change."""
        return self.head

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
        coarse, fine, context, top = self.features(views.images, views.valid)
        lo, hi = inverse_range(priors.sparse, views.images)
        step = (hi - lo) / (self.config.planes - 1)
        order = torch.argsort(priors.overlap, dim=1, descending=True, stable=True)
        sources = order[:, : min(max_sources, len(views) - 1)]
        volumes = []
        for i in range(len(views)):
            planes = (lo[i] + step[i] * torch.arange(self.config.planes, device=lo.device)).view(1, -1, 1, 1)
            volumes.append(self._volume(coarse, priors.cameras, i, sources[i], planes))
        hints = tuple(interpolate_points(priors.sparse, views.size, s, views.images) for s in (4, 2))
        return Encoded(
            torch.cat(volumes), fine, context, top, lo, step, sources, priors.cameras, (hints[0], hints[1])
        )

    def with_points(self, encoded: Encoded, points: Mapping[int, SparseDepth]) -> Encoded:
        """The same features with other sparse points as hints of some views."""
        h, w = encoded.context.shape[-2:]
        index = torch.tensor(list(points), device=encoded.lo.device)
        quarter, half = (
            old.replaced(index, interpolate_points(list(points.values()), (2 * h, 2 * w), s, encoded.lo))
            for old, s in zip(encoded.hints, (4, 2), strict=True)
        )
        return replace(encoded, hints=(quarter, half))

    def _volume(
        self, features: Tensor, cameras: Cameras, view: int, sources: Tensor, planes: Tensor
    ) -> Tensor:
        """Fused correlations (1, C, D, h, w) of one view with its sources."""
        relative = relative_cameras(cameras, view, sources, 4)
        parts = (
            correlations(features[view : view + 1], features[s : s + 1], m, planes, self.config.groups[0])
            for s, m in zip(sources.tolist(), relative, strict=True)
        )
        return aggregate(parts, self.fuse)

    def decode(
        self, encoded: Encoded, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        """Depth and confidence of some views; see :class:`tco.backbones.base.Backbone`.

        Without a context the other views' coarse depths are computed here, without gradients.
        """
        chosen = tuple(range(len(encoded.lo))) if views is None else tuple(views)
        inverse = None if context is None else F.avg_pool2d(1 / context.depth.unsqueeze(1), 2).squeeze(1)
        error = (
            None if context is None else F.avg_pool2d(1 / (context.confidence - 1).unsqueeze(1), 2).squeeze(1)
        )
        world = (
            Stage(inverse, (ERROR_UNIT * error).log()) if inverse is not None and error is not None else None
        )
        stages = self._coarse_each(encoded, chosen)
        if world is None:
            world = self._others(encoded, chosen, stages)
        for k in range(len(self.config.spacing)):
            stages = [self.refine(k, encoded, v, s, world) for v, s in zip(chosen, stages, strict=True)]
            if len(chosen) == len(encoded.lo) and k + 1 < len(self.config.spacing):
                world = _detached(_stack(stages))
        return _prediction(_stack(stages), encoded.cameras, chosen)

    def _others(self, encoded: Encoded, chosen: tuple[int, ...], stages: list[Stage]) -> Stage:
        """Coarse stages of all views at half resolution, those not chosen computed now."""
        done = dict(zip(chosen, stages, strict=True))
        rest = [v for v in range(len(encoded.lo)) if v not in done]
        with torch.no_grad():
            done.update(zip(rest, self._coarse_each(encoded, rest), strict=True))
        every = [done[v] for v in range(len(encoded.lo))]
        return _detached(_doubled(_stack(every)))

    def _coarse_each(self, encoded: Encoded, views: Sequence[int]) -> list[Stage]:
        """Coarse stages view by view, computed in batches of at most ``BATCH`` columns."""
        per = max(1, BATCH // encoded.volume[0, 0, 0].numel())
        stages: list[Stage] = []
        for k in range(0, len(views), per):
            s = self.coarse(encoded, views[k : k + per])
            assert s.scores is not None
            stages += [
                Stage(s.inverse[i : i + 1], s.log_error[i : i + 1], s.scores[i : i + 1])
                for i in range(len(s.inverse))
            ]
        return stages

    def coarse(self, encoded: Encoded, views: Sequence[int]) -> Stage:
        """First stage of some views, at 1/4 of the resolution."""
        v = torch.as_tensor(list(views), device=encoded.lo.device)
        lo, step = encoded.lo[v].view(-1, 1, 1), encoded.step[v].view(-1, 1, 1)
        hints = encoded.hints[0][v]
        scores = self.head.coarse(encoded.volume[v], hints, lo, step, encoded.top[v])
        index, mass = soft_argmax(scores)
        inverse = lo + step * index
        error = (step / inverse * (0.3 + 3 * (1 - mass))).log()
        return Stage(inverse, error, scores)

    def refine(self, k: int, encoded: Encoded, view: int, stage: Stage, world: Stage) -> Stage:
        """Pass ``k`` of the refinement of one view, given half-resolution depths of all views."""
        c = self.config
        if stage.inverse.shape[-1] != encoded.fine.shape[-1]:
            stage = _doubled(stage)
        step = encoded.step[view] * c.spacing[k]
        floor = encoded.lo[view] * 0.05
        start = stage.inverse.detach().clamp_min(floor + step * c.hypotheses / 2)
        offset = torch.arange(c.hypotheses, device=step.device, dtype=step.dtype) - (c.hypotheses - 1) / 2
        planes = start.unsqueeze(1) + step * offset.view(1, -1, 1, 1)
        matching = self._matching(encoded, view, planes)
        agreement = depth_agreement(
            planes, encoded.cameras, view, encoded.sources[view], world.inverse, world.log_error
        )
        hints = encoded.hints[1][view : view + 1]
        bump, near = hints.at(planes, step)
        sure = torch.stack([stage.log_error.detach(), (step / start).log()], 1)
        x = torch.cat([matching, agreement, bump, near, sure, hints.distance.unsqueeze(1)], 1)
        x = x.contiguous(memory_format=torch.channels_last)
        scores, extra, mask = self.head.refine[k](x, encoded.context[view : view + 1])
        index = (scores.softmax(1) * offset.view(1, -1, 1, 1)).sum(1) + extra[:, 0]
        inverse = (stage.inverse.clamp_min(floor + step * c.hypotheses / 2) + step * index).clamp_min(floor)
        error = extra[:, 1] + stage.log_error.detach()
        if mask is not None:
            inverse = convex_upsample(inverse.unsqueeze(1), mask)
            error = F.interpolate(error.unsqueeze(1), scale_factor=2.0, mode="bilinear").squeeze(1)
        return Stage(inverse, error)

    def _matching(self, encoded: Encoded, view: int, planes: Tensor) -> Tensor:
        """Correlations (1, G·D, h, w) at per-pixel hypotheses, averaged over sources by learned weights."""
        relative = relative_cameras(encoded.cameras, view, encoded.sources[view], 2)
        total = weights = torch.zeros((), device=planes.device)
        for s, m in zip(encoded.sources[view].tolist(), relative, strict=True):
            corr, seen = correlations(
                encoded.fine[view : view + 1], encoded.fine[s : s + 1], m, planes, self.config.groups[1]
            )
            corr = corr.flatten(1, 2)
            weight = self.head.weigh(corr).clamp(-8, 8).exp() * seen.mean(2)
            total, weights = total + weight * corr, weights + weight
        return total / (weights + 1e-6)


BATCH = 5000
"""Columns of correlation volumes that are decoded at once: small ones together, large ones alone."""

ERROR_UNIT = 0.02
"""A relative error of this size has confidence 2, so its surfel is half opaque."""


def _prediction(stage: Stage, cameras: Cameras, views: tuple[int, ...]) -> Prediction:
    return Prediction(1 / stage.inverse, 1 + ERROR_UNIT * (-stage.log_error).exp(), cameras, views)


def _stack(stages: Sequence[Stage]) -> Stage:
    scores = [s.scores for s in stages if s.scores is not None]
    return Stage(
        torch.cat([s.inverse for s in stages]),
        torch.cat([s.log_error for s in stages]),
        torch.cat(scores) if scores else None,
    )


def _detached(stage: Stage) -> Stage:
    return replace(stage, inverse=stage.inverse.detach(), log_error=stage.log_error.detach(), scores=None)


def _doubled(stage: Stage) -> Stage:
    both = torch.stack([stage.inverse, stage.log_error], 1)
    inverse, error = F.interpolate(both, scale_factor=2.0, mode="bilinear").unbind(1)
    return Stage(inverse, error)
