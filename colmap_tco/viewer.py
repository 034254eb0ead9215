"""``colmap-tco view``: cameras, sparse points and the dense cloud in the browser, filtered by confidence."""

from __future__ import annotations

import logging
import math
import threading
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_tco.errors import InputError, MissingError
from colmap_tco.progress import Progress
from tco.config import knob

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from colmap_tco.views import View
    from colmap_tco.workspace import DensePaths

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ViewerConfig:
    """What ``colmap-tco view`` can be told."""

    open: bool = knob(True, "open the browser; --no_open serves only")
    host: str = knob("127.0.0.1", "address to serve at; 0.0.0.0 lets other machines look too")
    port: int = knob(8080, "port to serve at; the next free one is taken where it is in use")
    max_points: int = knob(1_000_000, "points of the dense cloud that are shown; fewer are quicker")


@dataclass(frozen=True)
class Scene:
    """What is shown, in coordinates around ``origin``, so that float32 holds those of a map.

    Attributes:
        origin: (3,) world position that is (0, 0, 0) in the viewer.
        points: (N, 3) of the dense cloud.
        colors: (N, 3) uint8.
        confidence: (N,) mean over the views that confirm a point.
        seen: (N,) number of these views.
        sparse: (P, 3) COLMAP's points.
        sparse_colors: (P, 3) uint8.
        views: with depth maps.
        up: (3,) what is up in the pictures.
    """

    origin: NDArray[np.float64]
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    seen: NDArray[np.int64]
    sparse: NDArray[np.float32]
    sparse_colors: NDArray[np.uint8]
    views: Sequence[View]
    up: NDArray[np.float64]

    def shown(self, confidence: float, views: int) -> NDArray[np.bool_]:
        """Which points (N,) have at least this confidence and this many views."""
        keep: NDArray[np.bool_] = (self.confidence >= confidence) & (self.seen >= views)
        return keep

    def overview(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Where to look from first (3,) and at what (3,), and their distance: behind the middle camera.

        The middle one is the nearest to the mean of all; what it looks at is as far away as the points before
        it are in the median.
        """
        import numpy as np

        poses = [view.cam_from_world for view in self.views]
        centres = np.array([-m[:, :3].T @ m[:, 3] for m in poses])
        middle = int(np.argmin(((centres - centres.mean(0)) ** 2).sum(1)))
        eye, ahead = centres[middle] - self.origin, poses[middle][2, :3]
        points = self.points if len(self.points) else self.sparse
        depth = (points - eye) @ ahead
        away = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
        position = eye + away * (0.25 * self.up - 0.5 * ahead)
        target = eye + away * ahead
        return position, target, float(np.linalg.norm(target - position))


def read_scene(paths: DensePaths, max_points: int) -> Scene:
    """Read a finished result.

    Raises:
        InputError: a file is missing or damaged.
    """
    import numpy as np

    from colmap_tco import _pycolmap
    from colmap_tco.dense import by_position, dense_views, point_confidence, thinned
    from colmap_tco.page.content import chosen_points, up
    from colmap_tco.ply import read_ply, read_vis

    model = _pycolmap.read_model(paths.sparse)
    views = dense_views(paths, model)
    points, _, colors = read_ply(paths.ply)
    chosen = chosen_points(len(points), max_points)
    points, visibility = points[chosen], thinned(read_vis(paths.vis), chosen)
    _, xyz, rgb = _pycolmap.points(model)
    origin = np.asarray(np.median(points if len(points) else xyz, axis=0), np.float64)
    return Scene(
        origin=origin,
        points=(points - origin).astype(np.float32),
        colors=colors[chosen],
        confidence=point_confidence(paths, by_position(model, views), points, visibility),
        seen=np.diff(visibility.start),
        sparse=(xyz - origin).astype(np.float32),
        sparse_colors=rgb,
        views=views,
        up=up(views),
    )


class Viewer:
    """A running server that shows a scene; :meth:`stop` ends it.

    Attributes:
        scene: what is shown.
        server: the ``viser.ViserServer``.
    """

    def __init__(self, scene: Scene, config: ViewerConfig) -> None:
        viser = load_viser()
        self.scene = scene
        self.server: Any = viser.ViserServer(
            host=config.host, port=config.port, label="colmap-tco", verbose=False
        )
        self.server.scene.set_up_direction(tuple(float(value) for value in scene.up))
        self._look()
        self._add_cameras()
        self._add_controls()
        self.refresh()

    @property
    def url(self) -> str:
        """Where the viewer is served on this machine."""
        host = self.server.get_host()
        return f"http://{'localhost' if host == '0.0.0.0' else host}:{self.server.get_port()}"

    def stop(self) -> None:
        """End the server."""
        self.server.stop()

    def refresh(self) -> int:
        """Show what the controls ask for; returns the number of points of the dense cloud that are shown."""
        keep = self.scene.shown(self.confidence.value, self.seen.value)
        size = self.size.value * self._spacing()
        self.server.scene.add_point_cloud(
            "/dense", self.scene.points[keep], self.scene.colors[keep],
            point_size=size, precision="float32", visible=self.dense.value,
        )  # fmt: skip
        self.server.scene.add_point_cloud(
            "/sparse", self.scene.sparse, self.scene.sparse_colors,
            point_size=3 * size, point_shape="circle", precision="float32", visible=self.sparse.value,
        )  # fmt: skip
        self.frames.visible = self.cameras.value
        shown = int(keep.sum())
        self.count.content = f"{shown:,} of {len(keep):,} points"
        return shown

    def _look(self) -> None:
        """Begin with an overview; the planes that cut near and far follow the size of the scene."""
        camera = self.server.initial_camera
        camera.position, camera.look_at, away = self.scene.overview()
        camera.near, camera.far = away / 1000, 1000 * away

    def _spacing(self) -> float:
        """A length by which neighbouring points of the cloud are apart, roughly."""
        import numpy as np

        points = self.scene.points if len(self.scene.points) else self.scene.sparse
        low, high = np.percentile(points, (5, 95), axis=0)
        return float(np.linalg.norm(high - low)) / max(10.0, float(np.sqrt(len(points))))

    def _add_cameras(self) -> None:
        """One frustum a view; a click on it looks through the camera."""
        import numpy as np

        from colmap_tco.image_files import read_image

        views, server = self.scene.views, self.server
        centres = np.array([-v.cam_from_world[:, :3].T @ v.cam_from_world[:, 3] for v in views])
        steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
        scale = float(np.median(steps)) if len(steps) else self._spacing() * 20
        self.frames = server.scene.add_frame("/cameras", show_axes=False)
        for view, centre in zip(views, centres - self.scene.origin, strict=True):
            picture = read_image(view.path)
            step = max(1, picture.shape[1] // 160)
            frustum = server.scene.add_camera_frustum(
                f"/cameras/{view.image_id}", fov=2 * np.arctan(view.camera.height / 2 / view.camera.fy),
                aspect=view.camera.width / view.camera.height, scale=scale,
                image=np.ascontiguousarray(picture[::step, ::step]),
                wxyz=quaternion(view.cam_from_world[:, :3].T), position=centre,
            )  # fmt: skip

            def look(event: Any, frustum: Any = frustum) -> None:
                event.client.camera.wxyz = frustum.wxyz
                event.client.camera.position = frustum.position

            frustum.on_click(look)

    def _add_controls(self) -> None:
        import numpy as np

        gui, scene = self.server.gui, self.scene
        top = float(np.percentile(scene.confidence, 99)) if len(scene.confidence) else 1.0
        top = max(1.0, math.ceil(10 * top) / 10)
        most = int(scene.seen.max()) if len(scene.seen) else 1
        self.count = gui.add_markdown("")
        self.dense = gui.add_checkbox("dense cloud", True)
        self.sparse = gui.add_checkbox("sparse points", False)
        self.cameras = gui.add_checkbox("cameras", True)
        # A slider needs two ends that differ.
        self.confidence = gui.add_slider("least confidence", 0.0, top, 0.1, 0.0)
        self.seen = gui.add_slider("least views", 0, max(1, most), 1, 0)
        self.size = gui.add_slider("point size", 0.2, 5.0, 0.1, 1.0)
        for control in (self.dense, self.sparse, self.cameras, self.confidence, self.seen, self.size):
            control.on_update(lambda _: self.refresh())


def quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(w, x, y, z) of a rotation matrix (3, 3)."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])


def load_viser() -> Any:
    """The module ``viser``.

    Raises:
        MissingError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingError(
            f"the interactive viewer needs viser ({error}): pip install 'colmap-tco[view]'; "
            "'colmap-tco report' shows the result without it"
        ) from error
    return viser


def view(root: Path, config: ViewerConfig, progress: Progress) -> None:
    """Serve the result of a workspace until Ctrl-C.

    Raises:
        InputError: the workspace has no finished result, or a file of it is damaged.
        MissingError: viser is not installed.
    """
    from colmap_tco.dense import finished
    from colmap_tco.workspace import existing_root

    load_viser()
    if config.max_points < 1:
        raise InputError(f"--max_points {config.max_points}: at least one point must be shown")
    viewer = Viewer(read_scene(finished(existing_root(root)), config.max_points), config)
    progress.close()
    log.info("the result is shown at %s; Ctrl-C ends it", viewer.url)
    if config.open:
        webbrowser.open(viewer.url)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        log.info("the viewer has ended")
    finally:
        viewer.stop()
