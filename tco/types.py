"""The types that flow through ``tco``, and the page on frames, units and shapes.

Conventions, valid in every module of this package
--------------------------------------------------
Axes        OpenCV: x right, y down, z forward.
Pixels      The centre of the top-left pixel is (0.5, 0.5), as in COLMAP. The principal point of a
            centred camera of width W is W / 2. Code that reproduces a published network or loss
            which assumes integer pixel centres shifts in one named place and says why.
Transforms  ``target_from_source``, 4×4 or 3×4, so that ``cam_from_world @ world_from_cam`` cancels
            by eye. Poses are ``world_from_cam`` unless the name says otherwise.
Depth       Camera z (not ray length), positive. 0 means "none". NaN never appears.
Units       Lengths are in any unit in which the cameras and depths agree. The callers in
            ``colmap_tco`` hand over chunks scaled to a median depth of one.
Shapes      V views, H rows, W columns, N points; images are (V, 3, H, W), RGB in [0, 1].
Confidence  At least 1, as VGGT defines it (1 + exp(x)); a surfel's opacity is 1 − 1 / confidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import torch
    from torch import Tensor

_T = TypeVar("_T", bound="_Movable")


class _Movable:
    """Dataclasses of tensors that move between devices and dtypes together."""

    def to(self: _T, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> _T:
        """Copy of this object on ``device``, its floating tensors as ``dtype``."""
        changes = {f.name: _move(getattr(self, f.name), device, dtype) for f in fields(self)}  # type: ignore[arg-type]
        return replace(self, **changes)  # type: ignore[type-var]


def _move(value: object, device: torch.device | str | None, dtype: torch.dtype | None) -> object:
    import torch

    if isinstance(value, torch.Tensor):
        return value.to(device=device, dtype=dtype if value.is_floating_point() else None)
    if isinstance(value, _Movable):
        return value.to(device, dtype)
    if isinstance(value, tuple) and value and isinstance(value[0], (_Movable, torch.Tensor)):
        return tuple(_move(item, device, dtype) for item in value)
    return value


@dataclass(frozen=True)
class Views(_Movable):
    """What a backbone sees: V images on one canvas.

    Attributes:
        images: (V, 3, H, W) RGB in [0, 1]; where a function says so, (V, C, H, W) of any kind.
        valid: (V, H, W) bool; False where the canvas is padding or masked out.
        names: V image names, used in messages alone.
        helpers: how many of the last views only help the others: their own depths are not asked for.
    """

    images: Tensor
    valid: Tensor
    names: tuple[str, ...]
    helpers: int = 0

    def __len__(self) -> int:
        return int(self.images.shape[0])

    @property
    def wanted(self) -> range:
        """Indices of the views whose depths are asked for."""
        return range(len(self) - self.helpers)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the canvas in pixels."""
        return int(self.images.shape[2]), int(self.images.shape[3])


@dataclass(frozen=True)
class Cameras(_Movable):
    """Pinhole cameras of V views.

    Attributes:
        world_from_cam: (V, 4, 4).
        K: (V, 3, 3) intrinsics in pixels of the canvas.
    """

    world_from_cam: Tensor
    K: Tensor

    def __len__(self) -> int:
        return int(self.K.shape[0])

    def __getitem__(self, views: Sequence[int] | Tensor | slice) -> Cameras:
        return Cameras(self.world_from_cam[views], self.K[views])


@dataclass(frozen=True)
class SparseDepth(_Movable):
    """Triangulated points as one view sees them.

    Attributes:
        xy: (N, 2) pixel coordinates on the canvas.
        depth: (N,) camera z.
        sigma: (N,) standard deviation of the relative depth error (0.01 is one per cent).
        track: (N,) int64 identity of the 3D point, shared between views.
    """

    xy: Tensor
    depth: Tensor
    sigma: Tensor
    track: Tensor

    def __len__(self) -> int:
        return int(self.depth.shape[0])

    def __getitem__(self, keep: Tensor) -> SparseDepth:
        return SparseDepth(self.xy[keep], self.depth[keep], self.sigma[keep], self.track[keep])


@dataclass(frozen=True)
class HeldCameras(_Movable):
    """Cameras that a network's own are held to by the paper's penalties; a weight of 0 leaves a part free.

    Attributes:
        cameras: what is known, in any world and scale.
        rotation: weight of the mean angle between rotations relative to the first view, radians.
        translation: weight of the mean L1 of centres relative to the first view, normalised by distance.
        focal: weight of the mean L1 of focal lengths, pixels.
        rotation_sigma: (V,) standard deviations of the rotations about each axis, radians; if they are given,
            errors are measured in them, under a robust kernel. The weights are then of that.
        translation_sigma: (V,) the same of the centres along each axis, in the unit of ``cameras``.
        focal_sigma: (V,) the same of the relative focal lengths.
        kernel: of errors beyond two standard deviations: quadratic, huber or cauchy.
    """

    cameras: Cameras
    rotation: float = 1.0
    translation: float = 2.0
    focal: float = 0.01
    rotation_sigma: Tensor | None = None
    translation_sigma: Tensor | None = None
    focal_sigma: Tensor | None = None
    kernel: str = "huber"

    def sigma(self, name: str) -> Tensor | None:
        """Standard deviations of a part, ``rotation``, ``translation`` or ``focal``, if they are known."""
        parts = {
            "rotation": self.rotation_sigma,
            "translation": self.translation_sigma,
            "focal": self.focal_sigma,
        }
        return parts[name]


@dataclass(frozen=True)
class Priors(_Movable):
    """What is known about the views beside their pixels; None where it is not known.

    Attributes:
        cameras: poses and intrinsics.
        sparse: one :class:`SparseDepth` a view.
        depth: (V, H, W) dense depth, 0 where there is none.
        overlap: (V, V) at [i, j] how much view j tells of the depths of view i; 0 where they share nothing,
            and on the diagonal.
        rotation_sigma: (V,) standard deviation of the pose prior's rotation about each axis, radians.
        centre_sigma: (V,) standard deviation of the camera centre along each axis, in units of length.
        focal_sigma: (V,) standard deviation of the relative focal length.
        depth_sigma: (V, H, W) standard deviation of the relative error of the dense depth, which then is in
            the unit of the cameras; None: not known, and the depth is of any scale and shift.
        held: for networks that predict their cameras and are to keep predicting them, without ``cameras``:
            what these are held to.
    """

    cameras: Cameras | None = None
    sparse: tuple[SparseDepth, ...] | None = None
    depth: Tensor | None = None
    overlap: Tensor | None = None
    rotation_sigma: Tensor | None = None
    centre_sigma: Tensor | None = None
    focal_sigma: Tensor | None = None
    depth_sigma: Tensor | None = None
    held: HeldCameras | None = None


@dataclass(frozen=True)
class Prediction(_Movable):
    """What a backbone says of some of the views of a chunk.

    Attributes:
        depth: (V, H, W) positive.
        confidence: (V, H, W), at least 1.
        cameras: poses and intrinsics of all views of the chunk, predicted or passed through.
        views: V indices into the chunk, of the views whose depth this is.
        stages: (V, …) tensors that the network wants to find in its next context: what its own stages
            said of these views.
        rays: (V, H, W, 2) x / z and y / z of each pixel, of networks that predict a point map; None: they
            are those of the cameras.
    """

    depth: Tensor
    confidence: Tensor
    cameras: Cameras
    views: tuple[int, ...]
    stages: tuple[Tensor, ...] = ()
    rays: Tensor | None = None
