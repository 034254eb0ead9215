"""Training samples: augmentation that keeps the geometry, and points as COLMAP would have them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from colmap_tco.overlap import overlap
from tco.geometry import invert, project, transform, unproject
from tco.geometry import sample as sampled
from tco.types import Priors
from training.dataset import (
    Tracks,
    assemble,
    flipped,
    jittered,
    load,
    read,
    resized,
    triangulated,
    write,
)
from training.photo import _shaken, photographed
from training.scenes import Sample, generate

SHAPE = (72, 96)


@pytest.fixture(scope="module")
def scene() -> Sample:
    return generate(5, 4, SHAPE, "desk")


@pytest.fixture(scope="module")
def tracks(scene: Sample) -> Tracks:
    return triangulated(scene, np.random.default_rng(0))


def reprojected(s: Sample, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (H, W, 2) and depths (H, W) in view b of what view a sees."""
    h, w = s.depth.shape[1:]
    y, x = np.mgrid[0:h, 0:w] + 0.5
    ray = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(s.K[a].astype(float)).T
    m = s.cam_from_world[b].astype(float) @ np.linalg.inv(s.cam_from_world[a].astype(float))
    local = (ray * s.depth[a][..., None]) @ m[:3, :3].T + m[:3, 3]
    pixel = local @ s.K[b].astype(float).T
    with np.errstate(divide="ignore", invalid="ignore"):
        return pixel[..., :2] / pixel[..., 2:], local[..., 2]


def test_a_mirrored_world_projects_to_mirrored_pixels(scene: Sample) -> None:
    off = replace(scene, K=scene.K + np.array([[0, 0, 5], [0, 0, -2], [0, 0, 0]], np.float32))
    mirror = flipped(off)
    for a, b in ((0, 1), (2, 0), (1, 3)):
        xy, z = reprojected(off, a, b)
        got, theirs = reprojected(mirror, a, b)
        known = scene.depth[a] > 0
        np.testing.assert_allclose(theirs[:, ::-1][known], z[known], rtol=1e-4)
        front = known & (z > 0.05)
        expected = np.stack([SHAPE[1] - xy[..., 0], xy[..., 1]], -1)
        np.testing.assert_allclose(got[:, ::-1][front], expected[front], rtol=1e-3, atol=1e-2)
    assert np.array_equal(mirror.images, scene.images[:, :, ::-1])
    np.testing.assert_allclose(np.linalg.det(mirror.cam_from_world[:, :3, :3]), 1, atol=1e-5)


def test_mirroring_twice_changes_nothing(scene: Sample) -> None:
    twice = flipped(flipped(scene))
    for name in ("images", "depth", "K", "cam_from_world"):
        np.testing.assert_allclose(getattr(twice, name), getattr(scene, name), atol=1e-6)


@pytest.mark.parametrize("shape", [(36, 48), (48, 64), (60, 96)])
def test_resizing_keeps_rays_and_depths(scene: Sample, shape: tuple[int, int]) -> None:
    """A pixel of the smaller map has the depth of a pixel of the larger that its centre falls into."""
    small = resized(scene, shape)
    assert small.images.shape == (4, *shape, 3) and small.depth.shape == (4, *shape)
    ratio = np.array([SHAPE[1] / shape[1], SHAPE[0] / shape[0]])
    for y, x in ((0, 0), (shape[0] - 1, shape[1] - 1), (17, 23)):
        pixel = (np.array([x, y]) + 0.5) * ratio
        ray = [np.linalg.inv(k) @ [*p, 1] for k, p in ((small.K[1], (x + 0.5, y + 0.5)), (scene.K[1], pixel))]
        np.testing.assert_allclose(ray[0], ray[1], rtol=1e-5)
        assert small.depth[1, y, x] == scene.depth[1, int(pixel[1]), int(pixel[0])]
    assert resized(scene, SHAPE) is scene


def test_points_are_seen_where_the_surface_is(scene: Sample, tracks: Tracks) -> None:
    """Most are off by about their sigma along the ray; some are wrong altogether, as in real models."""
    assert len(tracks.xyz) > 30 and tracks.seen.shape == (4, len(tracks.xyz))
    assert (tracks.seen.sum(0) >= 3).all()
    assert (tracks.sigma > 0).all() and np.median(tracks.sigma) < 0.05
    errors = []
    for i in range(4):
        m = scene.cam_from_world[i].astype(float)
        local = tracks.xyz[tracks.seen[i]] @ m[:3, :3].T + m[:3, 3]
        x, y = np.floor((local / local[:, 2:]) @ scene.K[i].T)[:, :2].T.astype(int)
        inside = (x >= 0) & (y >= 0) & (x < SHAPE[1]) & (y < SHAPE[0])
        depth = scene.depth[i, y[inside], x[inside]]
        errors.append(
            np.abs(local[inside, 2] / np.maximum(depth, 1e-6) - 1) / tracks.sigma[tracks.seen[i]][inside]
        )
    error = np.concatenate(errors)
    assert 0.2 < np.median(error) < 1.5
    assert (error > 5).mean() < 0.2


def test_points_sit_at_corners_and_not_on_plain_walls(scene: Sample) -> None:
    half = Sample(scene.images.copy(), scene.depth, scene.K, scene.cam_from_world)
    half.images[:, :, :48] = 128
    found = triangulated(half, np.random.default_rng(0))
    m = half.cam_from_world[0].astype(float)
    local = found.xyz @ m[:3, :3].T + m[:3, 3]
    x = (local[:, 0] / local[:, 2] * half.K[0, 0, 0] + half.K[0, 0, 2])[found.seen[0]]
    assert (x > 44).mean() > 0.7


def test_priors_are_consistent_with_each_other(scene: Sample, tracks: Tracks) -> None:
    views, priors, truth = assemble(scene, scene.images.astype(np.float32) / 255, tracks)
    assert isinstance(priors, Priors) and priors.cameras is not None
    assert priors.sparse is not None and priors.overlap is not None
    assert views.images.shape == (4, 3, *SHAPE) and bool(views.valid.all())
    torch.testing.assert_close(priors.cameras.world_from_cam[0], torch.eye(4), rtol=0, atol=1e-5)
    every = torch.cat([points.depth for points in priors.sparse])
    assert float(every.median()) == pytest.approx(1, abs=0.02)

    xyz = {}
    for i, points in enumerate(priors.sparse):
        # One point has one position, whichever view's pixel and depth it is computed from.
        K, pose = priors.cameras.K[i], priors.cameras.world_from_cam[i]
        ray = torch.cat([points.xy, torch.ones(len(points), 1)], 1) @ torch.linalg.inv(K).T
        world = transform(pose, ray * points.depth.unsqueeze(1))
        for key, position in zip(points.track.tolist(), world, strict=True):
            torch.testing.assert_close(position, xyz.setdefault(key, position), rtol=1e-3, atol=1e-3)
        assert np.array_equal(points.track.numpy(), np.flatnonzero(tracks.seen[i]))
        for j, other in enumerate(priors.sparse):
            shared = set(points.track.tolist()) & set(other.track.tolist())
            assert bool(priors.overlap[i, j] > 0) == (i != j and bool(shared))
    centres = np.linalg.inv(scene.cam_from_world.astype(np.float64))[:, :3, 3]
    told = overlap([np.flatnonzero(seen) for seen in tracks.seen], centres, tracks.xyz)
    np.testing.assert_allclose(priors.overlap, told, rtol=1e-5)

    # The true depth is in the same unit: it warps one view onto the next.
    source_from_view = invert(priors.cameras.world_from_cam[1]) @ priors.cameras.world_from_cam[0]
    points3 = transform(source_from_view, unproject(truth[0], priors.cameras.K[0]).reshape(-1, 3))
    xy, z = project(points3, priors.cameras.K[1])
    theirs = sampled(truth[1:2, None], xy[None], mode="nearest")[0, 0]
    ok = (theirs > 0) & (truth[0].reshape(-1) > 0)
    assert ((z / theirs - 1).abs()[ok] < 0.02).float().mean() > 0.6


def test_jitter_is_a_fraction_of_a_pixel_and_spares_the_first_view(scene: Sample) -> None:
    sizes = []
    for seed in range(20):
        moved = jittered(scene, np.random.default_rng(seed))
        assert np.array_equal(moved.cam_from_world[0], scene.cam_from_world[0])
        turn = moved.cam_from_world[:, :3, :3] @ scene.cam_from_world[:, :3, :3].transpose(0, 2, 1)
        angle = np.linalg.norm(turn - turn.transpose(0, 2, 1), axis=(1, 2)) / np.sqrt(8)
        sizes.append(angle.max() * scene.K[0, 0, 0])
    assert max(sizes) < 1.5
    assert min(sizes) == pytest.approx(0, abs=1e-3) and np.median(sizes) > 0.05
    assert scene.cam_from_world is not moved.cam_from_world


def test_photographs_are_in_range_reproducible_and_still_pictures_of_the_scene(scene: Sample) -> None:
    for seed in range(8):
        picture = photographed(scene.images, np.random.default_rng(seed))
        assert picture.shape == scene.images.shape and picture.dtype == np.float32
        assert picture.min() >= 0 and picture.max() <= 1
        assert np.array_equal(picture, photographed(scene.images, np.random.default_rng(seed)))
        grey = [x.reshape(4, -1, 3).mean(2) for x in (picture, scene.images.astype(float))]
        for ours, theirs in zip(*grey, strict=True):
            assert np.corrcoef(ours, theirs)[0, 1] > 0.5


def test_a_shaken_camera_blurs_along_its_way_and_keeps_the_light() -> None:
    image = np.zeros((41, 41, 3), np.float32)
    image[20, 20] = 1
    spread = _shaken(image, 8.0, 0.0)[..., 0]
    assert spread.sum() == pytest.approx(1, abs=1e-5)
    y, x = np.mgrid[0:41, 0:41] - 20
    assert (spread * x).sum() == pytest.approx(0, abs=1e-4)
    assert (spread * x**2).sum() == pytest.approx(8.0**2 / 12, rel=0.1)  # a line of eight pixels
    assert (spread * y**2).sum() < 0.1
    turned = _shaken(image, 8.0, np.pi / 2)[..., 0]
    np.testing.assert_allclose(turned, spread.T, atol=1e-3)


def test_samples_survive_the_disk_and_are_rendered_once(tmp_path: Path) -> None:
    write(tmp_path, 30, 2, (36, 48), 2)
    files = sorted(tmp_path.iterdir())
    assert [file.name for file in files] == ["000030.npz", "000031.npz"]
    back, again = read(files[0]), generate(30, 2, (36, 48))
    for name in ("images", "depth", "K", "cam_from_world"):
        assert np.array_equal(getattr(back, name), getattr(again, name))
    stamps = [file.stat().st_mtime_ns for file in files]
    write(tmp_path, 30, 3, (36, 48), 2)
    assert [file.stat().st_mtime_ns for file in files] == stamps
    assert len(list(tmp_path.iterdir())) == 3


def test_equal_seeds_load_equal_samples(tmp_path: Path, scene: Sample) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, images=scene.images, depth=scene.depth, K=scene.K, cam_from_world=scene.cam_from_world)
    loaded = [load(path, seed, (48, 64)) for seed in (1, 1, 2)]
    assert all(sample is not None for sample in loaded)
    (a, pa, da), (b, pb, db), (c, _, _) = loaded  # type: ignore[misc]
    assert torch.equal(a.images, b.images) and torch.equal(da, db)
    assert torch.equal(pa.overlap, pb.overlap)
    assert a.images.shape == (4, 3, 48, 64) and da.shape == (4, 48, 64)
    assert not torch.equal(a.images, c.images)


def test_a_sample_without_points_is_left_out(tmp_path: Path, scene: Sample) -> None:
    path = tmp_path / "plain.npz"
    plain = np.full_like(scene.images, 128)
    np.savez(path, images=plain, depth=scene.depth, K=scene.K, cam_from_world=scene.cam_from_world)
    assert load(path, 0, SHAPE) is None
