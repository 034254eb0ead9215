"""A workspace as one problem for :func:`tco.optimize.optimize`, all its views in a single chunk.

    scene = open_scene(Path("workspace"))
    outcome = optimize(load_sweep(), scene.views, scene.priors)
    together = scene.agreed(outcome.prediction, outcome.cameras)
    cloud, report = scene.fuse(outcome.prediction, together=together)
    maps = scene.maps(together.prediction)

For experiments on scenes that fit the memory. ``colmap_tco.densify`` does the same in chunks, writes files,
and goes on after an interruption.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_tco.chunks import source_views
from colmap_tco.fusion import FusionConfig, FusionMaps, FusionView, fuse
from colmap_tco.outputs import ViewMaps, reaches
from colmap_tco.ply import Cloud
from colmap_tco.pose_covariance import with_deviations
from colmap_tco.predict import view_maps
from colmap_tco.priors import PriorConfig, build_priors, chunk_frame, with_points
from colmap_tco.tracks import Tracks, covisibility, read_tracks
from colmap_tco.views import ChunkFrame, View, ViewConfig, batch, make_views, undistorted_image
from colmap_tco.workspace import open_workspace
from tco.options import ConsensusConfig

if TYPE_CHECKING:
    from torch import Tensor

    from colmap_tco._pycolmap import Floats
    from colmap_tco.fusion_report import FusionReport
    from tco.consensus import Agreement
    from tco.types import Cameras, Prediction, Priors, SparseDepth, Views


@dataclass(frozen=True)
class Scene:
    """What the optimisation takes, and what is needed to go back to COLMAP's frame and units.

    Attributes:
        images: V views with their cameras in COLMAP's frame.
        tracks: of the model.
        frame: the chunk's coordinates: the first camera's, in units of ``frame.scale``.
        views: the pictures on one canvas.
        priors: cameras, points and overlap, in the chunk's coordinates.
        held_out: one ``SparseDepth`` a view, of the points that are not among the priors.
    """

    images: tuple[View, ...]
    tracks: Tracks
    frame: ChunkFrame
    views: Views
    priors: Priors
    held_out: tuple[SparseDepth, ...]

    def maps(self, prediction: Prediction, error: Tensor | None = None) -> list[ViewMaps]:
        """Depths in COLMAP units, normals and confidences of all V views, which the prediction is of.

        Args:
            prediction: of V views.
            error: (V, H, W) of an :class:`tco.consensus.Agreement`, if the prediction is of one.
        """
        scale, valid = self.frame.scale, self.views.valid
        return [view_maps(view, prediction, i, valid, scale, error) for i, view in enumerate(self.images)]

    def agreed(
        self,
        prediction: Prediction,
        cameras: Cameras | None = None,
        config: ConsensusConfig = ConsensusConfig(),
        seed: int = 0,
    ) -> Agreement:
        """What the V views say together of the depths, on planes and after their contest.

        ``densify`` writes the same as maps, but for what it takes back of refined depths where they were made
        worse (:func:`tco.conclusion.concluded`, which needs the whole ``Outcome``).

        Args:
            prediction: of all V views, each by itself.
            cameras: where they stand; by default as in the priors, ``Outcome.cameras`` knows better.
            config: settings.
            seed: of the planes that are drawn.
        """
        from tco.conclusion import finished
        from tco.consensus import agreed

        cameras = cameras or self.priors.cameras
        assert cameras is not None
        agreement = agreed(prediction, cameras, self.views, self.priors, config)
        return finished(agreement, prediction, cameras, self.views, self.priors, config, seed).agreement

    def fuse(
        self,
        prediction: Prediction,
        config: FusionConfig = FusionConfig(),
        together: Agreement | None = None,
    ) -> tuple[Cloud, FusionReport]:
        """The cloud of a prediction of all V views, in COLMAP's frame.

        Args:
            prediction: what optimisation gives: fusion asks how many views found the same by themselves.
            config: settings.
            together: what :meth:`agreed` makes of that, for the gaps; None: they stay.

        Raises:
            EmptyCloudError: no point is left; the message names the filter that removed most.
        """
        pairs = covisibility(self.tracks, [view.image_id for view in self.images])
        sources = source_views(pairs, config.check_num_images)
        views = fusion_views(self.images, self.maps(prediction), sources, self.tracks)
        if together is None:
            return fuse(views, config)
        maps = self.maps(together.prediction, together.error)
        return fuse(views, config, agreed=fusion_views(self.images, maps, sources, self.tracks))

    def chunk_plane(self, plane: Sequence[float]) -> Floats:
        """The plane n·X + d = 0 of COLMAP's frame in the chunk's: (4,), its normal of length one.

        Distances from it are in the chunk's unit.

        Args:
            plane: n and d.
        """
        normal, offset = np.asarray(plane[:3], float), float(plane[3])
        turn, shift = self.frame.cam_from_world[:, :3], self.frame.cam_from_world[:, 3]
        turned = turn @ normal
        return np.append(turned, (offset - turned @ shift) / self.frame.scale) / np.linalg.norm(normal)


def open_scene(
    root: Path,
    config: ViewConfig = ViewConfig(),
    stride: int = 16,
    priors: PriorConfig = PriorConfig(),
    seed: int = 0,
) -> Scene:
    """Read a workspace: its best model, undistorted pictures, and priors of all views that have points.

    Args:
        root: folder with ``images/`` and a model.
        config: size of the pictures; masks.
        stride: of the network that will see them.
        priors: which points are held out.
        seed: of that choice.

    Raises:
        InputError: images or model that cannot be used.
    """
    workspace = open_workspace(root)
    images, _ = make_views(workspace, config, stride)
    tracks = read_tracks(workspace.model)
    if priors.pose_covariance:
        tracks = with_deviations(tracks, workspace.model)
    images, _ = with_points(tracks, images, priors, seed)
    frame = chunk_frame(tracks, images)
    views, _ = batch(images, frame)
    known = build_priors(tracks, images, frame, priors, seed)
    return Scene(tuple(images), tracks, frame, views, known.optimise, known.held_out)


def fusion_views(
    images: Sequence[View], maps: Sequence[ViewMaps], sources: Sequence[Sequence[int]], tracks: Tracks
) -> list[FusionView]:
    """V views and their maps, in memory, as :func:`colmap_tco.fusion.fuse` takes them.

    Args:
        images: the views.
        maps: of each.
        sources: of each, the positions of its neighbours: :func:`colmap_tco.chunks.source_views`.
        tracks: of the model; what lies far behind its points is left out.
    """
    reach = reaches(tracks, images)

    def load(i: int) -> FusionMaps:
        picture, _ = undistorted_image(images[i])
        return FusionMaps(maps[i].depth, maps[i].normal, picture, maps[i].confidence, error=maps[i].error)

    return [
        FusionView(
            view.name, i, view.camera, view.cam_from_world, tuple(sources[i]),
            load=lambda i=i: load(i),  # type: ignore[misc]
            reach=reach.get(view.name, np.inf),
        )
        for i, view in enumerate(images)
    ]  # fmt: skip
