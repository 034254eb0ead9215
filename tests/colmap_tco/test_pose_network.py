"""Poses of an adapted network: in the unit of the depths, whatever the network's own is."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from colmap_tco.backbones import NetworkConfig
from colmap_tco.errors import InputError
from colmap_tco.evaluation.sources import read_cameras, read_tum
from colmap_tco.pose_network import SETTINGS, find
from colmap_tco.poses import PosesConfig, poses
from colmap_tco.progress import Progress
from colmap_tco.rough import RoughConfig
from tco.backbones.checkpoints import save
from tco.pose_options import PoseConfig
from tests.conftest import Room
from tests.tco.published import TINY_VGGT, some_views, tiny_pi3, tiny_vggt

FEW = 4
BLIND = 2


@pytest.mark.parametrize("network", [tiny_vggt, tiny_pi3])
def test_the_poses_have_the_unit_of_the_depths(network: object) -> None:
    """Centres grow with the depths, rotations and focal lengths do not change."""
    backbone, views = network(), some_views(3)  # type: ignore[operator]
    g = torch.Generator().manual_seed(1)
    depth = 1 + torch.rand(3, 42, 56, generator=g)
    plain = replace(SETTINGS, steps=0)
    one, K = find(backbone, views, depth, plain, 0)
    three, K3 = find(backbone, views, 3 * depth, plain, 0)
    np.testing.assert_allclose(three[:, :3, 3], 3 * one[:, :3, 3], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(three[:, :3, :3], one[:, :3, :3], atol=1e-7)
    np.testing.assert_allclose(K3, K)


def test_adaptation_to_depths_changes_the_poses_and_leaves_the_network(
    caplog: pytest.LogCaptureFixture,
) -> None:
    backbone, views = tiny_vggt(), some_views(3)
    depth = 1 + torch.rand(3, 42, 56, generator=torch.Generator().manual_seed(1))
    before = {name: value.clone() for name, value in backbone.state_dict().items()}
    plain, _ = find(backbone, views, depth, replace(SETTINGS, steps=0), 0)
    adapted, _ = find(backbone, views, depth, replace(SETTINGS, steps=2, lora_targets=("qkv", "proj")), 0)
    assert np.isfinite(adapted).all()
    assert np.abs(adapted - plain).max() > 1e-6
    assert all(torch.equal(value, before[name]) for name, value in backbone.state_dict().items())


def test_no_measured_pixel_is_an_error() -> None:
    with pytest.raises(InputError, match="no measured pixel"):
        find(tiny_vggt(), some_views(2), torch.zeros(2, 42, 56), SETTINGS, 0)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save(path, tiny_vggt().network, TINY_VGGT)
    return path


@pytest.fixture
def small(room: Room, tmp_path: Path) -> tuple[Path, Path]:
    """Images of 112×84 of some views of the room, and depth maps of all but one of them."""
    images, depths = tmp_path / "images", tmp_path / "depths"
    images.mkdir()
    depths.mkdir()
    for i, name in enumerate(room.names[:FEW]):
        picture = cv2.imread(str(room.root / "images" / name))
        cv2.imwrite(str(images / name), cv2.resize(picture, (112, 84), interpolation=cv2.INTER_AREA))
        if i != BLIND:
            counts = (1000 * room.sample.depth[i]).round().astype(np.uint16)
            cv2.imwrite(str(depths / name), counts)
    return images, depths


@pytest.mark.parametrize("known", [False, True], ids=["no camera", "camera given"])
def test_all_images_get_poses_from_a_network_alone(
    known: bool, small: tuple[Path, Path], room: Room, weights: Path, tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """From pictures and depths to the trajectory; an image without depth has its pose from the network."""
    images, depths = small
    K = room.sample.K[0] * np.array([[112 / 320], [84 / 240], [1]])
    camera = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    config = PosesConfig(
        depths=depths, output_path=tmp_path / "out", steps=0,
        rough=RoughConfig(camera_params=camera if known else ()),
        poses=PoseConfig(sizes=(48,), iterations=(2,), neighbours=3),
        network=NetworkConfig(backbone="vggt", weights=str(weights), device="cpu"),
    )  # fmt: skip
    with caplog.at_level(logging.WARNING, logger="colmap_tco"):
        found = poses(images, config, Progress())
    names = list(room.names[:FEW])
    entries = read_cameras(found.folder / "sparse" / "0")
    assert sorted(entries) == names
    assert len(read_tum(found.folder / "trajectory.txt").poses) == FEW
    told = json.loads((found.folder / "report.json").read_text(encoding="utf-8"))
    assert told["images"] == FEW and told["without_depth"] == [names[BLIND]] and names[BLIND] in caplog.text
    focal = np.array([entry.camera.params[0] for entry in entries.values()])
    assert np.allclose(focal, camera[0] * told["focal_factor"]) == known
