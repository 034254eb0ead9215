"""How uncertain the cameras of a model are, by the covariance of its bundle adjustment.

A model of structure from motion has no frame of its own: it may be turned, moved and scaled as a whole
without a change of any residual. Covariances in a frame that is held fixed (a gauge) say more of what was
fixed than of the camera. Here nothing is: of all frames the one is taken in which the cameras move least in
the sense of least squares (a free network: Triggs et al., Bundle adjustment, a modern synthesis, 2000,
section 9), so that what the cameras have in common counts for none of them.
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Floats, Ints, Model, Registered
from colmap_tco.errors import InputError
from colmap_tco.tracks import Tracks, image_jacobian, inverse, skew

if TYPE_CHECKING:
    from scipy import sparse

log = logging.getLogger(__name__)

FREEDOMS = 7
"""Turning, moving and scaling the whole model changes no residual."""
UNDETERMINED = 1e-10
"""Eigenvalues below this share of the largest, beyond those seven, are of something that no point holds."""


def with_deviations(tracks: Tracks, model: Model) -> Tracks:
    """The tracks with ``deviations`` of all cameras that have points.

    First order, intrinsics held; residuals are taken to be independent and to scatter as the model's do. What
    they have in common is not in it, so that real errors are larger: :mod:`colmap_tco.priors` adds it to what
    the reprojection errors say. Time and memory grow with the cube and the square of the number of cameras.

    Args:
        tracks: of the model.
        model: with points.

    Raises:
        InputError: cameras are not determined by the points.
    """
    entries = [e for e in _pycolmap.registered(model) if len(tracks.images[e.image_id].point)]
    # What moves least: squares of rotations, and half of those of centres in parts of their spread, as in the
    # fit of cameras to others (tco.align.align_cameras).
    centres = np.array([tracks.centres[e.image_id] for e in entries])
    unit = float(np.sqrt(2 * ((centres - centres.mean(0)) ** 2).sum(1).mean())) or 1.0
    values, vectors = np.linalg.eigh(_reduced(tracks, entries, unit))
    free = values > UNDETERMINED * values[-1]
    if int((~free).sum()) > FREEDOMS:
        raise InputError(
            "the cameras are not determined by the points of the model: leave out --pose_covariance, or give "
            "--rotation_sigma and --centre_sigma"
        )
    variance = (vectors[:, FREEDOMS:] ** 2 / values[FREEDOMS:]).sum(1).reshape(-1, 2, 3).mean(-1)
    # The median distance of a normal error in the plane is 1.1774 of its standard deviation along an axis.
    errors = np.concatenate([tracks.images[e.image_id].error for e in entries])
    sigma = float(np.median(errors)) / 1.1774 * np.sqrt(variance) * np.array([1.0, unit])
    log.info(
        "cameras by bundle adjustment: median deviation %.2g° and %.2g units",
        math.degrees(float(np.median(sigma[:, 0]))),
        float(np.median(sigma[:, 1])),
    )
    pairs = {e.image_id: (float(s[0]), float(s[1])) for e, s in zip(entries, sigma, strict=True)}
    return replace(tracks, deviations=pairs)


def _local(tracks: Tracks, entry: Registered) -> Floats:
    """Points (N, 3) that an image sees, in its camera frame."""
    pose = entry.cam_from_world
    return tracks.xyz[tracks.images[entry.image_id].point] @ pose[:, :3].T + pose[:, 3]


def _reduced(tracks: Tracks, entries: list[Registered], unit: float) -> Floats:
    """Information (6V, 6V) of the cameras once the points are free: the Schur complement U − W V⁻¹ Wᵀ.

    Of each camera three rotations about its own axes, then its centre in parts of ``unit``. A pixel's
    derivative by the rotation ω of the camera, exp(ω) R, is that by the point X in the camera's frame times
    −[X]×, and by the centre the negative of that by the point in the world.
    """
    from scipy import sparse

    cameras, seen, at = [], [], []
    for entry in entries:
        local = _local(tracks, entry)
        J = image_jacobian(entry, local)
        moved = J @ entry.cam_from_world[:, :3]
        cameras.append(np.concatenate([-J @ skew(local), -unit * moved], 2))
        seen.append(moved)
        at.append(tracks.images[entry.image_id].point)
    owner = np.repeat(np.arange(len(entries)), [len(points) for points in at])
    J, point = np.concatenate(seen), np.concatenate(at)
    information = np.zeros((len(tracks.xyz), 3, 3))
    np.add.at(information, point, np.swapaxes(J, 1, 2) @ J)
    A = _stacked(np.concatenate(cameras), owner, len(entries))
    B = _stacked(J, point, len(tracks.xyz))
    count = np.arange(len(information) + 1)
    V = sparse.bsr_array((inverse(information), count[:-1], count))
    W = A.T @ B
    reduced: Floats = (A.T @ A - W @ V @ W.T).toarray()
    return reduced


def _stacked(blocks: Floats, column: Ints, columns: int) -> sparse.bsr_array:
    """Blocks (N, 2, K) one below the other, each in its column (N,) of blocks."""
    from scipy import sparse

    count = np.arange(len(blocks) + 1)
    shape = (2 * len(blocks), blocks.shape[2] * columns)
    return sparse.bsr_array((blocks, column, count), shape=shape)
