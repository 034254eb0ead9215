"""Writers of miniature datasets in their published layouts: a wall with one white dot, seen by a few cameras.

Each writer works in the conventions of its dataset, axes, units and pixels alike, so that a reader which
converts wrongly sees the dot elsewhere and the wall bent.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from colmap_tco import _pycolmap

NORMAL, OFFSET = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0]), 2.5
DOT = np.array([0.15, -0.1, 0.0])
DOT[2] = (OFFSET - DOT[:2] @ NORMAL[:2]) / NORMAL[2]
"""The wall is n · X = d in metres, and the dot is on it."""

GL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: world_from_cam (4, 4), OpenCV axes, metres; (width, height); fx, fy, cx, cy."""

    pose: np.ndarray
    size: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def K(self) -> np.ndarray:
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def depth(self) -> np.ndarray:
        """z of the wall at the pixel centres (h, w), 0 behind the camera."""
        x, y = np.meshgrid(np.arange(self.size[0]) + 0.5, np.arange(self.size[1]) + 0.5)
        ray = np.stack([(x - self.cx) / self.fx, (y - self.cy) / self.fy, np.ones_like(x)], -1)
        z = (OFFSET - NORMAL @ self.pose[:3, 3]) / (ray @ self.pose[:3, :3].T @ NORMAL)
        return np.where(z > 0, z, 0)

    def pixel(self, xyz: np.ndarray) -> np.ndarray:
        """Where a world point is seen."""
        x, y, z = np.linalg.inv(self.pose)[:3] @ [*xyz, 1]
        return np.array([self.fx * x / z + self.cx, self.fy * y / z + self.cy])

    def moved(self, pose: np.ndarray) -> Camera:
        return Camera(pose, self.size, self.fx, self.fy, self.cx, self.cy)


def poses(count: int) -> list[np.ndarray]:
    """Cameras that look at the wall from about 2 m, each turned about all of its axes."""
    g = np.random.default_rng(3)
    found = []
    for _ in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(g.uniform(-0.2, 0.2, 3)).as_matrix()
        pose[:3, 3] = g.uniform(-0.3, 0.3, 3)
        found.append(pose)
    return found


def picture(path: Path, size: tuple[int, int], dot: np.ndarray) -> None:
    """Black, with a white square of 5 pixels at the dot."""
    image = np.zeros((size[1], size[0], 3), np.uint8)
    x, y = np.floor(dot).astype(int)
    assert 3 <= x < size[0] - 3 and 3 <= y < size[1] - 3
    image[y - 2 : y + 3, x - 2 : x + 3] = 255
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def millimetres(path: Path, depth: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.round(depth * 1000).astype(np.uint16))


def text(path: Path, content: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)


def matrix(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, values)


def seven_scenes(root: Path, count: int = 3, projected: bool = False) -> list[Camera]:
    """``chess`` with test sequence 3 and training sequence 1; returns the colour cameras.

    The poses in the files are those of the depth camera. In frame 0, the first row is invalid.
    """
    from colmap_tco.datasets.seven_scenes import COLOUR_FROM_DEPTH

    text(root / "chess" / "TestSplit.txt", "sequence3\n")
    text(root / "chess" / "TrainSplit.txt", "sequence1\n")
    folder, found = root / "chess" / "seq-03", []
    for i, pose in enumerate(poses(count)):
        sensor = Camera(pose, (640, 480), 585, 585, 320, 240)
        colour = Camera(pose @ np.linalg.inv(COLOUR_FROM_DEPTH), (640, 480), 525, 525, 320, 240)
        name = f"frame-{i:06d}"
        matrix(folder / f"{name}.pose.txt", pose)
        picture(folder / f"{name}.color.png", colour.size, colour.pixel(DOT))
        raw = np.round(sensor.depth() * 1000).astype(np.uint16)
        raw[0] = 65535
        assert cv2.imwrite(str(folder / f"{name}.depth.png"), raw)
        if projected:
            raw = np.round(colour.depth() * 1000).astype(np.uint16)
            raw[0] = 65535
            assert cv2.imwrite(str(folder / f"{name}.depth.proj.png"), raw)
        found.append(colour)
    return found


def nrgbd(root: Path, count: int = 3, scene: str = "kitchen") -> list[Camera]:
    """A room whose poses have OpenGL's axes; its numbers need no leading zeros and so sort badly as text."""
    rows, found = [], []
    for i, pose in enumerate(poses(count)):
        camera = Camera(pose, (160, 120), 138.5, 138.5, 80, 60)
        gl = pose @ GL
        x, y, z = np.linalg.inv(gl)[:3] @ [*DOT, 1]
        assert z < 0
        dot = np.array([80 + 138.5 * x / -z, 60 - 138.5 * y / -z])
        picture(root / scene / "images" / f"img{i}.png", camera.size, dot)
        depth = camera.depth()
        depth[0, 0] = 11.0
        millimetres(root / scene / "depth" / f"depth{i}.png", depth)
        rows.append(gl)
        found.append(camera)
    matrix(root / scene / "poses.txt", np.concatenate(rows))
    text(root / scene / "focal.txt", "138.5\n")
    return found


def dtu(root: Path, count: int = 3, scene: str = "scan4") -> list[Camera]:
    """A scan in millimetres, its pictures twice as large as depth maps and intrinsics."""
    found = []
    for i, pose in enumerate(poses(count)):
        small = Camera(pose, (160, 120), 150, 148, 84, 57)
        cam_from_world = np.linalg.inv(pose)
        cam_from_world[:3, 3] *= 1000
        lines = ["extrinsic", *(" ".join(map(str, row)) for row in cam_from_world), ""]
        lines += ["intrinsic", *(" ".join(map(str, row)) for row in small.K), "", "425.0 2.5"]
        text(root / scene / "cams" / f"{i:08d}_cam.txt", "\n".join(lines) + "\n")
        large = Camera(pose, (320, 240), 300, 296, 168, 114)
        picture(root / scene / "images" / f"{i:08d}.jpg", large.size, large.pixel(DOT))
        (root / scene / "depths").mkdir(parents=True, exist_ok=True)
        np.save(root / scene / "depths" / f"{i:08d}.npy", (small.depth() * 1000).astype(np.float32))
        mask = np.full((120, 160), 255, np.uint8)
        mask[:, :30] = 0
        (root / scene / "binary_masks").mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(root / scene / "binary_masks" / f"{i:08d}.png"), mask)
        found.append(large)
    return found


FISHEYE = (150.0, 149.0, 81.0, 59.0, 0.05, -0.02, 0.002, -0.001, 0.01, 0.002, 0.001, -0.002)
"""Parameters of THIN_PRISM_FISHEYE, tangential and thin-prism terms among them."""


def eth3d(root: Path, count: int = 3, scene: str = "courtyard") -> list[Camera]:
    """ETH3D's own archives: depth in the pixels of the distorted pictures, infinite in a patch."""
    base, found, images = root / scene, [], []
    distorted = _pycolmap.camera("THIN_PRISM_FISHEYE", (160, 120), FISHEYE)
    x, y = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    rays = _pycolmap.cam_from_img(distorted, np.stack([x, y], -1).reshape(-1, 2)).reshape(120, 160, 2)
    for i, pose in enumerate(poses(count)):
        camera, name = Camera(pose, (150, 110), 140, 141, 74, 56), f"DSC_{i + 286:04d}.JPG"
        picture(base / "images" / "dslr_images_undistorted" / name, camera.size, camera.pixel(DOT))
        ray = np.concatenate([rays, np.ones((120, 160, 1))], -1)
        depth = (OFFSET - NORMAL @ pose[:3, 3]) / (ray @ pose[:3, :3].T @ NORMAL)
        depth[40:44, 60:70] = np.inf
        path = base / "ground_truth_depth" / "dslr_images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        depth.astype("<f4").tofile(path)
        images.append((i + 1, np.linalg.inv(pose), name))
        found.append(camera)
    numbers = " ".join(map(str, FISHEYE))
    calibration(
        base / "dslr_calibration_jpg", f"7 THIN_PRISM_FISHEYE 160 120 {numbers}", "dslr_images", images
    )
    calibration(
        base / "dslr_calibration_undistorted",
        "7 PINHOLE 150 110 140 141 74 56",
        "dslr_images_undistorted",
        images,
    )
    text(base / "dslr_scan_eval" / "scan_alignment.mlp", "<MeshLabProject/>")
    return found


def calibration(folder: Path, camera: str, prefix: str, images: list[tuple[int, np.ndarray, str]]) -> None:
    """COLMAP's text format, with a line of keypoints that is empty and one that is not."""
    text(folder / "cameras.txt", f"# Camera list\n{camera}\n")
    lines = ["# Image list"]
    for i, cam_from_world, name in images:
        qx, qy, qz, qw = Rotation.from_matrix(cam_from_world[:3, :3]).as_quat()
        t = " ".join(map(str, cam_from_world[:3, 3]))
        lines += [f"{i} {qw} {qx} {qy} {qz} {t} 7 {prefix}/{name}", "" if i % 2 else "1.5 2.5 -1"]
    text(folder / "images.txt", "\n".join(lines) + "\n")


def eth3d_prepared(root: Path, count: int = 3, scene: str = "pipes") -> list[Camera]:
    """What π³'s script leaves."""
    base, found = root / scene, []
    for i, pose in enumerate(poses(count)):
        camera, name = Camera(pose, (160, 120), 150, 149, 81, 59), f"DSC_{i + 286:04d}"
        picture(base / "images" / "custom_undistorted" / f"{name}.JPG", camera.size, camera.pixel(DOT))
        path = base / "ground_truth_depth" / "custom_undistorted" / f"{name}.JPG"
        path.parent.mkdir(parents=True, exist_ok=True)
        depth = camera.depth()
        depth[0] = 0
        depth.astype("<f4").tofile(path)
        (base / "custom_undistorted_cam").mkdir(exist_ok=True)
        np.savez(
            base / "custom_undistorted_cam" / f"{name}.npz",
            intrinsics=camera.K,
            extrinsics=np.linalg.inv(pose),
        )
        found.append(camera)
    return found


def scannet(root: Path, count: int = 8, scene: str = "scene0707_00", prepared: bool = False) -> list[Camera]:
    """An exported scene, or its 90 prepared frames; colour and depth differ in size and focal length."""
    base, found, rows = root / scene, [], []
    for i, pose in enumerate(poses(count)):
        colour = Camera(pose, (324, 242), 292.5, 292.5, 162, 121)
        sensor = Camera(pose, (160, 120), 142.7, 142.7, 80, 60)
        depth = sensor.depth()
        depth[0] = 0
        name = f"frame_{i:04d}" if prepared else str(i)
        suffix = "_90" if prepared else ""
        picture(base / f"color{suffix}" / f"{name}.jpg", colour.size, colour.pixel(DOT))
        millimetres(base / f"depth{suffix}" / f"{name}.png", depth)
        rows.append(pose.reshape(-1))
        if not prepared:
            matrix(base / "pose" / f"{name}.txt", pose)
        found.append(colour)
    if prepared:
        matrix(base / "pose_90.txt", np.stack(rows))
    for which, camera in (("color", colour), ("depth", sensor)):
        K = np.eye(4)
        K[:3, :3] = camera.K
        matrix(base / "intrinsic" / f"intrinsic_{which}.txt", K)
    return found
