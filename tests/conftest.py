"""Fixtures for all tests: the data beside the repository, and small workspaces made on the spot."""

from __future__ import annotations

import logging
import shutil
import signal
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from colmap_tco import _pycolmap
from colmap_tco.cli import idle_threads_sleep
from colmap_tco.errors import MissingError

if TYPE_CHECKING:
    from torch import Tensor

    from tco.types import Priors, Views
    from training.scenes import Sample

idle_threads_sleep()  # before torch is loaded: on a busy machine the suite else takes several times as long
_pycolmap.load()  # in the order that keeps PNG writing alive, before any test module imports pycolmap

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as of a shell's background jobs
    signal.signal(signal.SIGINT, signal.default_int_handler)

DISTORTIONS = {
    "SIMPLE_PINHOLE": [],
    "PINHOLE": [],
    "SIMPLE_RADIAL": [-0.15],
    "RADIAL": [0.12, -0.05],
    "OPENCV": [-0.2, 0.05, 0.002, -0.003],
    "FULL_OPENCV": [-0.2, 0.05, 0.002, -0.003, 0.01, 0.01, 0.0, 0.0],
    "SIMPLE_RADIAL_FISHEYE": [-0.02],
    "RADIAL_FISHEYE": [0.01, -0.01],
    "OPENCV_FISHEYE": [0.01, -0.01, 0.001, 0.0],
    "FOV": [0.8],
    "THIN_PRISM_FISHEYE": [0.01, -0.01, 0.001, 0.001, 0.0, 0.0, 0.001, 0.001],
}
"""Every camera model that a pinhole can stand for, with telling parameters; those that the version knows."""

NEWER = {
    "RAD_TAN_THIN_PRISM_FISHEYE": [0.01, -0.01, 0, 0, 0, 0, 0.001, 0.001, 0.001, 0.001, -0.001, 0.001],
    "SIMPLE_DIVISION": [-0.1],
    "DIVISION": [0.08],
    "SIMPLE_FISHEYE": [],
    "FISHEYE": [],
    "EUCM": [0.4, 1.1],
}
DISTORTIONS |= {k: v for k, v in NEWER.items() if hasattr(_pycolmap.load().CameraModelId, k)}


@dataclass(frozen=True)
class Shot:
    """A camera of a made-up workspace.

    Attributes:
        size: (width, height).
        model: COLMAP's name.
        params: of that model; empty: a focal length of 0.9 widths and a centre off the middle.
    """

    size: tuple[int, int] = (160, 120)
    model: str = "SIMPLE_RADIAL"
    params: tuple[float, ...] = field(default=())


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real workspaces and reference numbers beside the repository; read only."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not (folder / "data").is_dir():
        pytest.skip("the data folder ../shared is not there")
    return folder


def colmap_camera(shot: Shot) -> _pycolmap.Camera:
    """A pycolmap camera as described, off-centre unless parameters are given."""
    pycolmap = _pycolmap.load()
    width, height = shot.size
    camera = pycolmap.Camera(
        model=shot.model,
        width=width,
        height=height,
        params=shot.params or default_params(shot.model, width, height),
    )
    camera.camera_id = 1
    return camera


def default_params(model: str, width: int, height: int) -> list[float]:
    """A focal length of 0.9 widths, the principal point off the middle, and the model's distortion."""
    focal = [0.9 * max(width, height)]
    if not (model.startswith("SIMPLE") or model in ("RADIAL", "RADIAL_FISHEYE")):
        focal.append(focal[0] * 1.02)
    return [*focal, width / 2 + 3.3, height / 2 - 2.7, *DISTORTIONS[model]]


@pytest.fixture(scope="session")
def make_camera() -> Callable[..., _pycolmap.Camera]:
    """A function that makes a pycolmap camera from the fields of :class:`Shot`."""
    return lambda **fields: colmap_camera(Shot(**fields))


def look_at(centre: np.ndarray, target: np.ndarray) -> np.ndarray:
    """cam_from_world (3, 4) of a camera at ``centre`` that looks at ``target``, y down."""
    z = target - centre
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return np.concatenate([R, -R @ centre[:, None]], 1)


def write_text_model(
    folder: Path,
    shots: Sequence[Shot],
    poses: np.ndarray,
    xyz: np.ndarray,
    noise: float,
    names: list[str],
    visible: np.ndarray | None = None,
) -> None:
    """COLMAP's text format, written independently of the package.

    Every camera sees what is before it, or what ``visible`` (V, N) says.
    """
    pycolmap = _pycolmap.load()
    rng = np.random.default_rng(5)
    folder.mkdir(parents=True)
    cameras, images = [], []
    tracks: list[list[str]] = [[] for _ in xyz]
    for i, (shot, pose) in enumerate(zip(shots, poses, strict=True), 1):
        camera = colmap_camera(shot)
        params = " ".join(repr(float(value)) for value in camera.params)
        cameras.append(f"{i} {shot.model} {camera.width} {camera.height} {params}")
        local = xyz @ pose[:, :3].T + pose[:, 3]
        uv = np.asarray(camera.img_from_cam(local / local[:, 2:])) + noise * rng.normal(size=(len(xyz), 2))
        inside = (local[:, 2] > 0.1) & (uv > 0).all(1) & (uv < shot.size).all(1)
        seen = np.flatnonzero(inside if visible is None else inside & visible[i - 1])
        for index, point in enumerate(seen):
            tracks[point].append(f"{i} {index}")
        q = pycolmap.Rotation3d(np.ascontiguousarray(pose[:, :3])).quat
        pose_text = " ".join(repr(float(v)) for v in [q[3], q[0], q[1], q[2], *pose[:, 3]])
        points = " ".join(f"{float(uv[p, 0])!r} {float(uv[p, 1])!r} {p + 1}" for p in seen)
        images.append(f"{i} {pose_text} {i} {names[i - 1]}\n{points}")
    points = [
        f"{p + 1} {' '.join(repr(float(v)) for v in xyz[p])} 200 100 50 0.5 {' '.join(track)}"
        for p, track in enumerate(tracks)
        if track
    ]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture(scope="session")
def make_workspace() -> Callable[..., Path]:
    """A function that writes a workspace: noise pictures, cameras on an arc, points on a wavy wall.

    Arguments: the folder; ``shots``; ``points``, their number; ``origin``, added to all coordinates;
    ``noise`` of keypoints in pixels; ``names`` of the images; ``sparse``, the folder of the model.
    """

    def make(
        root: Path,
        shots: Sequence[Shot] = (Shot(),) * 5,
        points: int = 150,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        noise: float = 0.0,
        names: list[str] | None = None,
        sparse: str = "sparse/0",
    ) -> Path:
        import cv2

        rng = np.random.default_rng(3)
        names = names or [f"{i:03d}.png" for i in range(len(shots))]
        xy = rng.uniform(-1.6, 1.6, (points, 2))
        xyz = np.concatenate([xy, 4 + 0.4 * np.sin(3 * xy[:, :1])], 1) + origin
        centres = [np.array([x, 0.1 * x * x, 0.0]) + origin for x in np.linspace(-0.8, 0.8, len(shots))]
        target = np.array([0.0, 0.0, 4.0]) + origin
        poses = np.stack([look_at(centre, target) for centre in centres])
        write_text_model(root / sparse, shots, poses, xyz, noise, names)
        for shot, name in zip(shots, names, strict=True):
            path = root / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            width, height = shot.size
            small = rng.integers(0, 256, (height // 8, width // 8, 3), dtype=np.uint8)
            cv2.imwrite(str(path), cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC))
        return root

    return make


@pytest.fixture(scope="session")
def shot() -> type[Shot]:
    """The class that describes a camera of a made-up workspace."""
    return Shot


@pytest.fixture(scope="session")
def workspace_folder(tmp_path_factory: pytest.TempPathFactory, make_workspace: Callable[..., Path]) -> Path:
    """A small workspace of five views, for tests that only read."""
    return make_workspace(tmp_path_factory.mktemp("synthetic"), noise=0.2)


@pytest.fixture(scope="session")
def rendered() -> tuple[Views, Priors, Tensor]:
    """Five 128×96 views of a furnished room, what COLMAP would know, and the true depth (V, H, W)."""
    from training.dataset import assemble, triangulated
    from training.scenes import walk

    sample = walk(4, 5, (96, 128))
    tracks = triangulated(sample, np.random.default_rng(0))
    return assemble(sample, sample.images.astype(np.float32) / 255, tracks)


@dataclass(frozen=True)
class Room:
    """A rendered room and the workspace that was made of it.

    Attributes:
        root: the workspace: PNG images of 320×240, and a model with the true cameras and points.
        names: of the images.
        sample: pictures, true depths and true cameras, in the units of the model.
    """

    root: Path
    names: tuple[str, ...]
    sample: Sample


ROOM_VIEWS = 7


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    """A workspace of a rendered room with exact cameras, exact points and slightly noisy keypoints."""
    import cv2

    from training.scenes import walk

    root = tmp_path_factory.mktemp("room")
    sample = walk(4, ROOM_VIEWS, (240, 320))
    names = tuple(f"view_{i}.png" for i in range(ROOM_VIEWS))
    (root / "images").mkdir()
    for name, image in zip(names, sample.images, strict=True):
        cv2.imwrite(str(root / "images" / name), image[..., ::-1])
    fx, _, cx, _, fy, cy = sample.K[0, :2].ravel().tolist()
    shot = Shot((320, 240), "PINHOLE", (fx, fy, cx, cy))
    xyz, visible = surface_points(sample)
    poses = sample.cam_from_world[:, :3].astype(np.float64)
    u, _, vt = np.linalg.svd(poses[:, :, :3])
    poses[:, :, :3] = u @ vt  # rotations to the precision of float64
    write_text_model(
        root / "sparse" / "0", [shot] * ROOM_VIEWS, poses, xyz, 0.15, list(names), visible=visible
    )
    return Room(root, names, sample)


def surface_points(sample: Sample, each: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """World points (N, 3) on what the views see, and which views see them (V, N): at least three."""
    rng = np.random.default_rng(2)
    points = []
    for depth, K, pose in zip(sample.depth, sample.K, np.linalg.inv(sample.cam_from_world), strict=True):
        y, x = rng.integers(2, depth.shape[0] - 2, each), rng.integers(2, depth.shape[1] - 2, each)
        ray = np.stack([(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], np.ones(each)])
        points.append((pose[:3, :3] @ (ray * depth[y, x]) + pose[:3, 3:]).T)
    xyz = np.concatenate(points).astype(np.float64)
    visible = np.stack([sees(sample, view, xyz) for view in range(len(sample.depth))])
    keep = visible.sum(0) >= 3
    return xyz[keep], visible[:, keep]


def sees(sample: Sample, view: int, xyz: np.ndarray) -> np.ndarray:
    """Which points (N, 3) are on the surface that a view sees, within 1 %."""
    local = xyz @ sample.cam_from_world[view, :3, :3].T + sample.cam_from_world[view, :3, 3]
    z = np.maximum(local[:, 2], 1e-6)
    x, y = np.floor((local / z[:, None]) @ sample.K[view].T).astype(int)[:, :2].T
    h, w = sample.depth.shape[1:]
    inside = (local[:, 2] > 0) & (x >= 0) & (x < w) & (y >= 0) & (y < h)
    depth = sample.depth[view, y.clip(0, h - 1), x.clip(0, w - 1)]
    return inside & (np.abs(z / np.maximum(depth, 1e-6) - 1) < 0.01)


@pytest.fixture
def fresh_room(room: Room, tmp_path: Path) -> Room:
    """A copy of the room's workspace, for tests that write into it."""
    root = tmp_path / "room"
    shutil.copytree(room.root, root, ignore=shutil.ignore_patterns("dense-tco", ".dense-tco*"))
    return Room(root, room.names, room.sample)


@pytest.fixture(autouse=True)
def same_logging() -> Iterator[None]:
    """Undo the logging that the command line sets up, for tests that call it inside this process."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    levels = {name: logging.getLogger(name).level for name in ("colmap_tco", "tco", "pycolmap")}
    yield
    logging.captureWarnings(False)
    root.handlers[:] = handlers
    root.setLevel(level)
    for name, before in levels.items():
        logging.getLogger(name).setLevel(before)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Skip what stops because Open3D cannot be imported, as on machines without its system libraries."""
    try:
        return (yield)
    except MissingError as error:
        if not str(error).startswith("Open3D cannot be imported"):
            raise
        pytest.skip(str(error))
