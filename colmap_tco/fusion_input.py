"""The views that are fused, and their arrays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from colmap_tco.pinhole import Pinhole


@dataclass(frozen=True)
class FusionMaps:
    """The arrays of one view.

    Attributes:
        depth: (H, W) camera z, 0 where there is none; may be smaller than the image.
        normal: (H, W, 3) unit normals in the camera frame, facing the camera, 0 where there is none.
        image: (H', W', 3) uint8 RGB, undistorted, of any size with the camera's field of view.
        confidence: (H, W) at least 1, or None if there is none.
        mask: (H, W) bool, False where pixels shall take no part, or None.
        error: (H, W) relative standard error of the depth by how far apart the views were, 0 where it is not
            known; of agreed maps alone, others are None.
    """

    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    image: NDArray[np.uint8]
    confidence: NDArray[np.float32] | None = None
    mask: NDArray[np.bool_] | None = None
    error: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class FusionView:
    """One view of the dense workspace.

    Attributes:
        name: image name, for messages and the report.
        index: position of the image in ``Reconstruction.reg_image_ids()``, for the visibility.
        camera: pinhole of the undistorted image.
        cam_from_world: (3, 4) or (4, 4) float64.
        neighbours: positions in the list of views that is fused, the best overlapping first.
        load: reads the arrays; called again if they had to leave the cache. They are kept, not copied, and
            must not change afterwards.
        reach: depth that hardly a point of the model exceeds in this view, for ``max_depth_ratio``.
        sure: confidence of depths that were confirmed before: ``max_depth_bend`` leaves them; inf: of none.
    """

    name: str
    index: int
    camera: Pinhole
    cam_from_world: NDArray[np.float64]
    neighbours: tuple[int, ...]
    load: Callable[[], FusionMaps]
    reach: float = math.inf
    sure: float = math.inf


def other_from_reference(other: FusionView, reference: FusionView) -> NDArray[np.float64]:
    """The (3, 4) transform between two cameras, without loss where world coordinates are large."""
    rotation = other.cam_from_world[:3, :3] @ reference.cam_from_world[:3, :3].T
    shift = other.cam_from_world[:3, :3] @ (centre(reference) - centre(other))
    return np.ascontiguousarray(np.concatenate([rotation, shift[:, None]], 1))


def centre(view: FusionView) -> NDArray[np.float64]:
    """World position (3,) of the camera."""
    return -view.cam_from_world[:3, :3].T @ view.cam_from_world[:3, 3]
