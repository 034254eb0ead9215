"""What a network that predicts depths and cameras is taught by: the losses of VGGT on rendered scenes.

They are those of the paper (Wang et al. 2025, arXiv 2503.11651, section 3.4): the truth is expressed in the
first camera and scaled so that the points of all views are 1 away from it on average; the prediction is not
normalised. Where the paper leaves a number open it is that of its authors' training code
(``training/loss.py`` of github.com/facebookresearch/vggt), which also has L1 in place of the paper's Huber
loss for cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tco.backbones.dinov2 import normalized
from tco.backbones.transformer import computing
from tco.backbones.vggt import VGGTNetwork
from tco.backbones.vggt_heads import cam_from_world, depth_of, encoded
from tco.geometry import invert, rigid, transform, unproject
from tco.penalties import rotation_angle
from tco.types import Cameras

CAMERA = 5.0
"""Weight of the camera loss beside that of depth."""

STAGE_DECAY = 0.6
"""Weight of each iteration of the camera head relative to the next."""

PARTS = (1.0, 1.0, 0.5)
"""Weights of translation, quaternion and fields of view."""

ALPHA = 0.2
"""Weight of the logarithm of the confidence: at an error e the best one is ALPHA / e, if that is above 1."""

LOGARITHM = 0.2
"""Weight of the error of the depth's logarithm, which the paper does not have: the head's exponential has no
gradient where its depth is next to nothing, so a network that starts from nothing could not come back."""

SCALES = (1, 2, 4, 8)
"""Steps between the pixels whose differences the gradient loss compares."""

MOST = 5.0
"""Errors of depth do not count beyond this, in units of the mean distance of the points."""

THINNED = 2
"""Of so many pixels across and down, one counts in the figures of depth."""


@dataclass(frozen=True)
class Scenes:
    """A batch of B scenes with V views each.

    Attributes:
        images: (B, V, 3, H, W) RGB in [0, 1].
        depth: (B, V, H, W) camera z, 0 where unknown.
        world_from_cam: (B, V, 4, 4).
        K: (B, V, 3, 3) in pixels.
    """

    images: Tensor
    depth: Tensor
    world_from_cam: Tensor
    K: Tensor

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        return int(self.depth.shape[2]), int(self.depth.shape[3])


@dataclass(frozen=True)
class Answer:
    """What a network says of a batch.

    Attributes:
        poses: encoded poses (B, V, 9) after each iteration of the camera head, the best last.
        depth, confidence: (B, V, H, W).
    """

    poses: Sequence[Tensor]
    depth: Tensor
    confidence: Tensor


def normalised(scenes: Scenes) -> Scenes:
    """The scenes in the frame of their first view, scaled to a mean distance of 1 of their points from it."""
    poses = invert(scenes.world_from_cam[:, :1]) @ scenes.world_from_cam
    points = transform(poses, unproject(scenes.depth, scenes.K).flatten(2, 3))
    known = (scenes.depth > 0).flatten(2)
    total = (points.norm(dim=-1) * known).sum((1, 2))
    unit = (total / known.sum((1, 2)).clamp_min(1)).clamp_min(1e-6)
    moved = rigid(poses[..., :3, :3], poses[..., :3, 3] / unit.view(-1, 1, 1))
    return Scenes(scenes.images, scenes.depth / unit.view(-1, 1, 1, 1), moved, scenes.K)


def answer(network: VGGTNetwork, images: Tensor, dtype: torch.dtype = torch.float32) -> Answer:
    """Run a network on images (B, V, 3, H, W), its blocks in ``dtype`` and its heads in float32."""
    scenes, views, _, height, width = images.shape
    patch = network.config.encoder.patch
    grid = height // patch, width // patch
    with computing(images.device, dtype):
        tokens = network.aggregator.patch_embed(normalized(images.flatten(0, 1)), grid)
        found = network.aggregator(tokens, grid, range(scenes * views), scenes=scenes)
    with computing(images.device, torch.float32):
        poses = network.camera_head(found.camera.float().unflatten(0, (scenes, views)))
        # All views at once: in training their activations are held in any case.
        maps = network.depth_head.some([x.float() for x in found.dense], grid)
    depth, confidence = (x.unflatten(0, (scenes, views)) for x in depth_of(maps))
    return Answer(poses, depth, confidence)


def camera_loss(poses: Sequence[Tensor], truth: Tensor) -> Tensor:
    """Mean over the iterations of L1 errors, each weighted by ``STAGE_DECAY`` to the power of those after it.

    Args:
        poses: encoded poses (…, 9) of the iterations, the best last.
        truth: (…, 9).
    """
    total = truth.new_zeros(())
    for after, pose in enumerate(reversed(poses)):
        parts = (pose - truth).abs().split((3, 4, 2), -1)
        error = sum(w * part.mean() for w, part in zip(PARTS, parts, strict=True))
        total = total + STAGE_DECAY**after * error / len(poses)
    return total


def depth_loss(depth: Tensor, confidence: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Loss of the depth, and of its gradient, both weighted by confidence c.

    The first is the mean over pixels of c · |d − z| − α log c + λ · |log d − log z|, with λ = ``LOGARITHM``;
    the second the mean over ``SCALES`` of c · |Δ(d − z)|, across and down, between neighbours that are both
    known on every 1st, 2nd, 4th and 8th pixel.

    Args:
        depth, confidence, truth: (…, H, W); pixels whose truth is 0 do not count.
    """
    known = truth > 0
    off = torch.where(known, depth - truth, torch.zeros_like(truth)).clamp(-MOST, MOST)
    ratio = torch.where(known, depth, torch.ones_like(truth)).log() - torch.where(known, truth, 1.0).log()
    value = confidence * off.abs() - ALPHA * confidence.log() + LOGARITHM * ratio.abs()
    slope = truth.new_zeros(())
    for s in SCALES:
        e, c, k = off[..., ::s, ::s], confidence[..., ::s, ::s], known[..., ::s, ::s]
        for dim in (-1, -2):
            n = e.shape[dim] - 1
            if n < 1:
                continue
            both = k.narrow(dim, 1, n) & k.narrow(dim, 0, n)
            step = (e.narrow(dim, 1, n) - e.narrow(dim, 0, n)).abs() * c.narrow(dim, 1, n)
            slope = slope + (step * both).sum() / both.sum().clamp_min(1) / len(SCALES)
    return (value * known).sum() / known.sum().clamp_min(1), slope


def losses(network: VGGTNetwork, scenes: Scenes, dtype: torch.dtype) -> tuple[Tensor, dict[str, Tensor]]:
    """Total loss of a batch, and figures for the log; see :func:`figures`."""
    true = normalised(scenes)
    found = answer(network, true.images, dtype)
    camera = camera_loss(found.poses, encoded(Cameras(true.world_from_cam, true.K), true.size))
    value, slope = depth_loss(found.depth, found.confidence, true.depth)
    terms = {"camera": camera.detach(), "depth": value.detach(), "slope": slope.detach()}
    return CAMERA * camera + value + slope, terms | figures(found, true)


@torch.no_grad()
def figures(found: Answer, true: Scenes) -> dict[str, Tensor]:
    """Means over a batch, scalars.

    turn: degrees between the rotations of the views but the first, relative to it, and the true ones.
    way: degrees between the directions of their centres as the first sees them, and the true ones.
    absrel, d5: mean relative error of depth, and share within 5 %, after one scale a scene, the median ratio,
    on every second pixel across and down.
    """
    poses = invert(cam_from_world(found.poses[-1]))
    ours, theirs = (invert(p[:, :1]) @ p for p in (poses, true.world_from_cam))
    turn = rotation_angle(ours[:, 1:, :3, :3], theirs[:, 1:, :3, :3])
    a, b = ours[:, 1:, :3, 3], theirs[:, 1:, :3, 3]
    way = torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))
    depth, truth = (d[..., ::THINNED, ::THINNED] for d in (found.depth, true.depth))
    known = truth > 0
    ratio = torch.where(known, truth / depth, torch.full_like(truth, torch.nan))
    scale = ratio.flatten(1).nanmedian(1).values.view(-1, 1, 1, 1)
    error = (scale * depth / truth.clamp_min(1e-6) - 1).abs()[known]
    return {
        "turn": torch.rad2deg(turn).mean(), "way": torch.rad2deg(way).mean(),
        "absrel": error.mean(), "d5": (error < 0.05).float().mean(),
    }  # fmt: skip
