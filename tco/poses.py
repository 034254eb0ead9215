"""Poses from depth priors: rough cameras are moved until the depths that the views were given agree.

The objective is the geometric compatibility of TCO (arXiv 2604.03878): the depth map of a source view becomes
2D Gaussian surfels, which are rendered into other views and compared with the depths there. The depths are
known here, and only the cameras are free: :class:`tco.corrections.CameraCorrections`, held by how rough the
poses are. Nothing in between has to be adapted, so the minimum is sought by Gauss–Newton steps
(:mod:`tco.linearise`) instead of Adam's: tens of renders a view instead of thousands. Steps start on small
images, where a pixel is as wide as the errors, and with a robust kernel as wide as the views disagree.

The unknown scale of the rough centres, and one factor of all focal lengths, may be free, too. The world stays
that of the rough poses: the result is moved rigidly so that it lies as near to them as it can.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from tco.align import Similarity, align_cameras
from tco.corrections import CameraCorrections
from tco.geometry import invert, pixel_grid, project, rays, sample, transform
from tco.linearise import COLUMNS, Linear, Pair
from tco.objective import ObjectiveConfig
from tco.pose_options import PoseConfig
from tco.render import render
from tco.surfels import from_depth, supported
from tco.types import Cameras, Priors, Views

logger = logging.getLogger(__name__)

Report = Callable[[dict[str, float]], None]

_TRUSTED = 100.0
"""Confidence of a measured depth: its surfel is nearly opaque."""
_SETTLED = 0.02
"""Largest change in standard deviations of the rough poses below which a size is done."""
_LONGEST = 3.0
"""Longest turn or shift of a step in standard deviations: beyond, the derivatives say little."""
_FIRST_NOISE = 0.1
"""Relative depth that views are taken to disagree by before anything is known."""
_FREE_SCALE = 0.3
"""Standard deviation of the logarithm of a scale that is not known but roughly found."""
_LOOSE = 0.3
"""Relative difference of depths below which two rough views may show the same surface."""


@dataclass(frozen=True)
class Level:
    """The views at one size.

    Attributes:
        views: V pictures.
        K: (V, 3, 3) intrinsics in their pixels.
        depth: (V, H, W) measured, 0 where it is not.
    """

    views: Views
    K: Tensor
    depth: Tensor


@dataclass(frozen=True)
class Poses:
    """What was found.

    Attributes:
        cameras: of V views, with the intrinsics of the finest level.
        scale: factor of the rough centres.
        focal: factor of the focal lengths.
        moved: V flags; False for a view that has no depth, or none that others see, and stays where it was.
        history: of each step ``size``, ``geometric`` or ``photometric`` (robust standard deviation of what
            the views disagree by), and ``step`` (largest change in standard deviations of the rough poses).
    """

    cameras: Cameras
    scale: float
    focal: float
    moved: tuple[bool, ...]
    history: list[dict[str, float]] = field(default_factory=list)


def surfel_share(level: Level) -> float:
    """Share of the measured pixels whose four neighbours are measured, too: only these become surfels."""
    known = level.views.valid & (level.depth > 0)
    count = int(known.sum())
    return float(torch.stack([supported(mask) for mask in known]).sum()) / count if count else 0.0


class NothingSharedError(ValueError):
    """No view's depths are seen by another."""


def rough_priors(cameras: Cameras, config: PoseConfig) -> Priors:
    """Rough cameras with the standard deviations that the settings name.

    Raises:
        ValueError: fewer than two views, or all centres in one point, whose mean distance is no unit.
    """
    centre = cameras.world_from_cam[:, :3, 3]
    if len(centre) < 2:
        raise ValueError("poses are found relative to other views: it takes at least two")
    unit = (centre - centre.mean(0)).norm(dim=-1).mean()
    if float(unit) <= 1e-9:
        raise ValueError("the rough camera centres all coincide: 5 % of their distance would be nothing")
    like = torch.ones_like(centre[:, 0])
    return Priors(
        cameras,
        rotation_sigma=math.radians(config.rough_rotation) * like,
        centre_sigma=config.rough_centre * unit * like,
        focal_sigma=config.rough_focal * like,
    )


def refine(
    levels: Sequence[Level], rough: Tensor, config: PoseConfig, free_scale: bool = False,
    report: Report | None = None,
) -> Poses:  # fmt: skip
    """Move rough poses until rendered and measured depths (and colours, if wanted) agree.

    Args:
        levels: the views from coarse to fine, as many as ``config.iterations``.
        rough: (V, 4, 4) world_from_cam; centres in the unit of the depths, up to a factor if ``free_scale``.
        config: settings.
        free_scale: whether a common factor of the centres is sought, too.
        report: called with the figures of every step.

    Raises:
        NothingSharedError: no view's depths are seen by another from the rough poses.
        ValueError: levels that are not as many as the iterations, or rough poses without extent.
    """
    if len(levels) != len(config.iterations):
        raise ValueError(f"{len(config.iterations)} sizes are wanted, and {len(levels)} given")
    priors = rough_priors(Cameras(rough.double(), levels[-1].K.double()), config)
    state = _State(priors, free_scale)
    history: list[dict[str, float]] = []
    pairs = overlapping(levels[0], state.cameras(levels[0]).world_from_cam, config)
    for level, count in zip(levels, config.iterations, strict=True):
        for _ in range(count):
            figures = _step(level, state, pairs, config)
            history.append({"size": float(max(level.views.size)), **figures})
            if report is not None:
                report(history[-1])
            if figures["step"] < _SETTLED:
                break
    linked = {view for s, targets in enumerate(pairs) for t in targets for view in (s, t)}
    cameras = state.cameras(levels[-1])
    moved = tuple(view in linked for view in range(len(rough)))
    kept = torch.tensor(moved)
    base = state.scaled(priors.cameras)
    poses = beside(cameras.world_from_cam, base.world_from_cam, kept)
    return Poses(Cameras(poses, cameras.K), state.scale, math.exp(float(state.zoom)), moved, history)


def beside(poses: Tensor, rough: Tensor, kept: Tensor) -> Tensor:
    """Poses (V, 4, 4) moved rigidly, those ``kept`` (V,) nearest to rough ones; others: rough."""
    if int(kept.sum()) < 2:
        return poses
    near = align_cameras(poses[kept], rough[kept])
    mean, target = (p[kept][:, :3, 3].mean(0) for p in (poses, rough))
    rigid = Similarity(torch.ones_like(near.scale), near.R, target - near.R @ mean)
    return torch.where(kept[:, None, None], rigid.poses(poses), rough)


class _State:
    """The unknowns, each in standard deviations but for the logarithm of the scale.

    Attributes:
        noise: relative depth by which the views disagreed in the last step.
    """

    def __init__(self, priors: Priors, free_scale: bool) -> None:
        self.priors, self.free_scale = priors, free_scale
        self.corrections = CameraCorrections(priors)
        self.log_scale = torch.zeros((), dtype=torch.float64)
        self.noise = _FIRST_NOISE

    @property
    def scale(self) -> float:
        """Factor of the rough centres."""
        return math.exp(float(self.log_scale))

    @property
    def zoom(self) -> Tensor:
        """Logarithm of the factor of all focal lengths."""
        sigma = self.corrections.sigmas[2]
        return (self.corrections.zoom.detach() * sigma)[0]

    def scaled(self, cameras: Cameras | None) -> Cameras:
        """Cameras with their centres scaled."""
        assert cameras is not None
        pose = cameras.world_from_cam.clone()
        pose[:, :3, 3] *= self.scale
        return Cameras(pose, cameras.K)

    @torch.no_grad()
    def cameras(self, level: Level) -> Cameras:
        """The cameras as they are believed now, for the images of a level."""
        K = level.K.double().clone()
        K[:, [0, 1], [0, 1]] *= self.zoom.exp()
        return Cameras(self.scaled(self.corrections()).world_from_cam, K)

    def columns(self, source: int, target: int, jacobian: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives (P, 14) by the unknowns themselves, and where (14,) these are in the whole vector."""
        rotation, centre, focal = self.corrections.sigmas
        v = len(rotation)
        J = jacobian.clone()
        units = {"source_turn": rotation[source], "target_turn": rotation[target],
                 "source_shift": centre[source] * self.scale, "target_shift": centre[target] * self.scale,
                 "focal": focal[0]}  # fmt: skip
        for name, unit in units.items():
            J[:, COLUMNS[name]] *= unit
        six = torch.arange(6)
        where = torch.cat([6 * source + six, 6 * target + six, torch.tensor([6 * v, 6 * v + 1])])
        return J, where

    def prior(self) -> tuple[Tensor, Tensor]:
        """Weights (6 V + 2,) and values of the unknowns that the rough poses hold at zero."""
        c = self.corrections
        each = torch.cat([c.turn, c.shift], 1).detach().reshape(-1)
        value = torch.cat([each, c.zoom.detach()[:1], self.log_scale.reshape(1)])
        weight = torch.ones_like(value)
        weight[-2] = 1.0 if float(c.sigmas[2][0]) > 0 else _FIXED
        weight[-1] = _FREE_SCALE**-2 if self.free_scale else _FIXED
        return weight, value

    @torch.no_grad()
    def add(self, change: Tensor) -> float:
        """Take a step (6 V + 2,), no view's longer than :data:`_LONGEST`; returns the longest as it was."""
        c = self.corrections
        each = change[:-2].reshape(-1, 2, 3)
        length = each.norm(dim=-1).amax(-1)
        each = each * (_LONGEST / length.clamp_min(_LONGEST))[:, None, None]
        c.turn.add_(each[:, 0])
        c.shift.add_(each[:, 1])
        c.zoom.add_(change[-2].clamp(-_LONGEST, _LONGEST))
        if self.free_scale:
            self.log_scale += change[-1].clamp(-_LONGEST * _FREE_SCALE, _LONGEST * _FREE_SCALE)
        return float(length.max())


_NOISE_OF_BRIGHTNESS = 0.01
"""Difference of brightness that is never taken for better."""
_FIXED = 1e12
"""Weight of an unknown that is none."""


@torch.no_grad()
def _step(
    level: Level, state: _State, pairs: Sequence[Sequence[int]], config: PoseConfig
) -> dict[str, float]:
    """One Gauss–Newton step on all pairs at once, with Huber weights by the present disagreement."""
    cameras = state.cameras(level)
    parts: dict[str, list[tuple[int, int, Linear]]] = {"geometric": [], "photometric": []}
    tolerance = max(config.occlusion_tolerance, 10 * state.noise)
    for source, targets in enumerate(pairs):
        for target, pair in zip(targets, _rendered(level, cameras, source, targets), strict=True):
            for name, linear in _residuals(level, pair, target, config, tolerance).items():
                parts[name].append((source, target, linear))
    weight, value = state.prior()
    H, g, figures = torch.diag(weight), weight * value, {}
    for name, found in parts.items():
        if found:
            spread = _spread([linear for _, _, linear in found], _floor(name, config))
            figures[name] = spread
            share = getattr(config, name)
            _accumulate(H, g, found, state, (spread, share * config.independent * len(level.K)))
    if "geometric" in figures:
        state.noise = figures["geometric"]
    change = torch.linalg.solve(H, -g)
    longest = state.add(change)
    return {**figures, "step": longest}


def _floor(name: str, config: PoseConfig) -> float:
    return config.noise_floor if name == "geometric" else _NOISE_OF_BRIGHTNESS


def _spread(found: Sequence[Linear], floor: float) -> float:
    """Robust standard deviation of all residuals: 1.4826 times their median size."""
    every = torch.cat([linear.residual.abs() for linear in found])
    return max(floor, 1.4826 * float(every.median())) if len(every) else floor


def _accumulate(
    H: Tensor, g: Tensor, found: Sequence[tuple[int, int, Linear]], state: _State,
    scale: tuple[float, float],
) -> None:  # fmt: skip
    """Add the normal equations of some residuals to H and g.

    Args:
        H: (N, N). g: (N,).
        found: source, target and residuals.
        state: which unknown is where.
        scale: standard deviation, and the number of independent comparisons that all residuals are worth.
    """
    spread, worth = scale
    whole = sum(float(linear.weight.sum()) for _, _, linear in found)
    for source, target, linear in found:
        J, where = state.columns(source, target, linear.jacobian)
        # A kernel that redescends would drop the edges: while poses are wrong, these are far off, and most
        # of what tells how a view must move along its surfaces.
        robust = linear.weight / (linear.residual.abs() / (2 * spread)).clamp_min(1.0)
        W = robust * worth / max(whole, 1e-9) / spread**2
        H[where.unsqueeze(1), where.unsqueeze(0)] += J.T @ (W.unsqueeze(1) * J)
        g[where] += J.T @ (W * linear.residual)


def _rendered(level: Level, cameras: Cameras, source: int, targets: Sequence[int]) -> list[Pair]:
    """The surfels of a source as each of its targets sees them."""
    if not targets:
        return []
    views, single = level.views, cameras.to(dtype=torch.float32)
    depth, chosen = level.depth[source], list(targets)
    surfels = from_depth(
        depth, single.K[source], single.world_from_cam[source], views.images[source],
        torch.full_like(depth, _TRUSTED), valid=views.valid[source] & (depth > 0),
    )  # fmt: skip
    out = render(surfels, single[chosen], views.size, ObjectiveConfig().renderer)
    color = out.color / out.alpha.clamp_min(1 / 255).unsqueeze(-1)
    return [
        Pair((out.depth[i], color[i], out.alpha[i]), cameras[[source, target]])
        for i, target in enumerate(targets)
    ]


def _residuals(
    level: Level, pair: Pair, target: int, config: PoseConfig, tolerance: float
) -> dict[str, Linear]:
    """What a pair disagrees by, where it is not hidden by what the target measured."""
    measured, valid = level.depth[target], level.views.valid[target]
    seen = valid & ((measured == 0) | (pair.depth <= (1 + tolerance) * measured))
    found = {}
    if config.geometric > 0:
        found["geometric"] = pair.geometric(measured, seen)
    if config.photometric > 0:
        found["photometric"] = pair.photometric(level.views.images[target], seen)
    return found


@torch.no_grad()
def overlapping(level: Level, world_from_cam: Tensor, config: PoseConfig) -> list[list[int]]:
    """The views to render each view into: half of them those that see most of its depths, half from the rest.

    The overlap of a source and a target is the share of its known depths that fall into the target, where
    its own depth, if known, is not a third less. The rest are drawn evenly by overlap among those above the
    least, so that far views tie a sequence, too.

    Raises:
        NothingSharedError: no view has any.
    """
    shares = torch.stack([_shares(level, world_from_cam, s) for s in range(len(level.K))])
    if not bool((shares >= config.least_overlap).any()):
        raise NothingSharedError(
            f"no view sees {100 * config.least_overlap:.0f} % of the depths of another from the rough poses: "
            "these are too far off, or in another unit than the depths"
        )
    chosen = []
    for share in shares:
        order = [int(i) for i in share.argsort(descending=True) if share[i] >= config.least_overlap]
        near = order[: (config.neighbours + 1) // 2]
        rest = order[len(near) :]
        more = min(config.neighbours - len(near), len(rest))
        picked = [rest[(2 * i + 1) * len(rest) // (2 * more)] for i in range(more)]
        chosen.append(near + picked)
    return chosen


def _shares(level: Level, world_from_cam: Tensor, source: int) -> Tensor:
    """Share (V,) of a view's known depths that each other view sees; 0 for itself and where it has none."""
    depth, (h, w) = level.depth[source], level.views.size
    known = level.views.valid[source] & (depth > 0)
    shares = torch.zeros(len(level.K), dtype=torch.float64)
    if not bool(known.any()):
        return shares
    K = level.K.double()
    points = rays(pixel_grid(h, w, K)[known], K[source]) * depth[known].double().unsqueeze(-1)
    for target in range(len(K)):
        if target == source or not bool((level.depth[target] > 0).any()):
            continue
        moved = transform(invert(world_from_cam[target]) @ world_from_cam[source], points)
        xy, z = project(moved, K[target])
        inside = (z > 0) & ((xy >= 0) & (xy < xy.new_tensor([w, h]))).all(-1)
        there = sample(level.depth[target][None, None].double(), xy.unsqueeze(0), "nearest")[0, 0]
        visible = inside & (there > 0) & ((z / there.clamp_min(1e-9)).log().abs() < _LOOSE)
        shares[target] = visible.double().mean()
    return shares
