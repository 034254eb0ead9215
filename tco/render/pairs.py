"""The engine ``surface`` as tensor operations, for devices that the compiled loops cannot reach.

A pair is a splat and a pixel of its box. All pairs of a target are looked at in blocks: first for the nearest
surface at each pixel, then for the pairs that belong to it, which alone are kept, weighed with gradients
and summed. What a block needs for its gradients is computed again in the backward pass, so that memory is
that of the kept pairs' indices and of one block.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from tco.render.kernels import CORE, MIN_ALPHA
from tco.render.project import Splats, finished

_BLOCK = 4_000_000
"""Pairs that are looked at together: some 300 MB."""


def rasterize_pairs(splats: Splats, focal: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (T, H, W, 3), sum of weighted depths (T, H, W) and alpha (T, H, W) of the nearest surfaces.

    What the compiled engine gives (:func:`tco.render.cpu.rasterize_surface`), in the type of the splats, on
    their device. On CUDA the order of summation, and so the last digits, change between runs.

    Args:
        splats: N surfels in T targets.
        focal: (T,) focal lengths of the targets in pixels.
        size: (H, W).
    """
    tolerances = (0.01 + 4 / focal.detach()).tolist()
    images = [_Target(splats, t, tolerance, size).image() for t, tolerance in enumerate(tolerances)]
    color, depth, weight = torch.stack(images).split([3, 1, 1], -1)
    return finished(color, depth.squeeze(-1), weight.squeeze(-1))


class _Target:
    """The splats of one target."""

    def __init__(self, splats: Splats, number: int, tolerance: float, size: tuple[int, int]) -> None:
        self.size, self.tolerance = size, tolerance
        self.boxes = splats.boxes[number].long()
        self.depths, self.opacities, self.colors = splats.depths[number], splats.opacities, splats.colors
        self.hits = _hits(splats.transforms[number], self.boxes)
        corner = self.boxes[:, [0, 2]].to(splats.centres.dtype) + 0.5
        self.offsets = splats.centres[number] - corner

    def image(self) -> Tensor:
        """Colours, depth and weight (H, W, 5), summed over the nearest surface."""
        with torch.no_grad():
            surface = self._surface()
            kept = [self._belonging(surface, *pairs) for pairs in self._pairs()]
        image = self.colors.new_zeros(self.size[0] * self.size[1], 5)
        for who, where in kept:
            values = checkpoint(self._weighed, who, where, use_reentrant=False)
            image = image.index_add(0, self._pixel(who, where), values)
        return image.reshape(*self.size, 5)

    def _pairs(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Blocks of pairs: splats (P,), and positions in their boxes (P,), counted row by row."""
        wide, high = self.boxes[:, 1] - self.boxes[:, 0], self.boxes[:, 3] - self.boxes[:, 2]
        area = wide * high
        seen = area.nonzero().squeeze(1)
        block = area[seen].cumsum(0) // _BLOCK
        # Where nothing is seen there is one empty block: the image still depends on the surfels, by zero.
        sizes = torch.unique_consecutive(block, return_counts=True)[1].tolist() or [0]
        for who in torch.split(seen, sizes):
            count = area[who]
            first = count.cumsum(0) - count
            yield (
                who.repeat_interleave(count),
                torch.arange(int(count.sum()), device=who.device) - first.repeat_interleave(count),
            )

    def _places(self, who: Tensor, where: Tensor) -> tuple[Tensor, Tensor]:
        """Columns and rows in the boxes."""
        wide = self.boxes[who, 1] - self.boxes[who, 0]
        return where % wide, where // wide

    def _pixel(self, who: Tensor, where: Tensor) -> Tensor:
        """Index of the pixel of each pair in the image."""
        x, y = self._places(who, where)
        return (self.boxes[who, 2] + y) * self.size[1] + self.boxes[who, 0] + x

    def _twice_sigma(self, who: Tensor, where: Tensor) -> Tensor:
        """2 sigma of each pair: of the hit or of the offset from the centre, whichever is nearer."""
        x, y = (part.to(self.offsets.dtype).unsqueeze(-1) for part in self._places(who, where))
        zeta = torch.addcmul(torch.addcmul(self.hits[0][who], x, self.hits[1][who]), y, self.hits[2][who])
        away = self.offsets[who] - torch.cat([x, y], -1)
        filtered = 2 * (away**2).sum(-1)
        plane, square = (zeta[:, :2] ** 2).sum(-1), zeta[:, 2] ** 2
        hit = plane < filtered * square
        # Where the offset decides, the quotient is not used and must not make a gradient infinite.
        return torch.where(hit, plane / torch.where(hit, square, torch.ones_like(square)), filtered)

    def _surface(self) -> Tensor:
        """Depth (H · W,) of the nearest splat whose core holds the pixel, infinite where there is none."""
        surface = self.depths.new_full((self.size[0] * self.size[1],), torch.inf)
        for who, where in self._pairs():
            depth = self.depths.detach()[who]
            depth = depth.masked_fill(self._twice_sigma(who, where) > 2 * CORE, torch.inf)
            surface.scatter_reduce_(0, self._pixel(who, where), depth, "amin")
        return surface

    def _belonging(self, surface: Tensor, who: Tensor, where: Tensor) -> tuple[Tensor, Tensor]:
        """The pairs that belong to the surface of their pixel and are not too faint."""
        near = surface[self._pixel(who, where)]
        belongs = (self.depths[who] - near).abs() < self.tolerance * near
        who, where = who[belongs], where[belongs]
        limit = 2 * torch.log(self.opacities / MIN_ALPHA) + 1e-9
        drawn = self._twice_sigma(who, where) <= limit[who]
        return who[drawn], where[drawn]

    def _weighed(self, who: Tensor, where: Tensor) -> Tensor:
        """Colours, depth and 1 (P, 5) of each pair, times opacity · exp(−sigma)."""
        weight = self.opacities[who] * torch.exp(-0.5 * self._twice_sigma(who, where))
        values = torch.cat([self.colors, self.depths.unsqueeze(-1), torch.ones_like(self.colors[:, :1])], -1)
        return values[who] * weight.unsqueeze(-1)


def _hits(transforms: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The hit ∝ z₀ + x z₁ + y z₂ on each splat's plane, three (N, 3), with pixels counted from its box.

    The products are made in float64 and scaled to a length of about 1, which the hit does not depend on;
    after that float32 holds them well.
    """
    x, y, w = transforms.double().unbind(-1)
    corner = boxes[:, [0, 2]].double() + 0.5
    x, y = x - corner[:, :1] * w, y - corner[:, 1:] * w
    parts = torch.linalg.cross(x, y), torch.linalg.cross(y, w), torch.linalg.cross(w, x)
    scale = parts[0].detach().norm(dim=-1, keepdim=True).clamp_min(1e-300)
    first, by_x, by_y = ((part / scale).to(transforms.dtype) for part in parts)
    return first, by_x, by_y
