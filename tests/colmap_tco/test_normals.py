"""Normals from depth: exact on planes, close on a sphere, undisturbed by discontinuities."""

from __future__ import annotations

import numpy as np
import pytest

from colmap_tco.normals import normals_from_depth
from colmap_tco.pinhole import Pinhole

CAMERA = Pinhole(60, 48, 50.0, 55.0, 31.0, 22.5)


def rays(camera, shape):
    h, w = shape
    u, v = np.meshgrid((np.arange(w) + 0.5) * camera.width / w, (np.arange(h) + 0.5) * camera.height / h)
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)


def plane_depth(normal, distance, camera=CAMERA, shape=None):
    """Depth of the plane normal·X = −distance; the normal faces the camera."""
    along = rays(camera, shape or (camera.height, camera.width)) @ normal
    return np.where(along < -1e-3, -distance / along, 0.0)


def unit(*v):
    return np.array(v) / np.linalg.norm(v)


def angles(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


PLANES = [unit(0, 0, -1), unit(0.3, -0.5, -1), unit(-1, 0, -0.5), unit(0, -1, -0.15)]


@pytest.mark.parametrize("normal", PLANES)
@pytest.mark.parametrize("radius", [1, 2, 3])
def test_planes_are_exact_to_the_border(normal, radius):
    depth = plane_depth(normal, 2.0).astype(np.float32)
    normals = normals_from_depth(depth, CAMERA, radius)
    seen = depth > 0
    assert angles(normals[seen], normal).max() < 0.2
    assert np.allclose(np.linalg.norm(normals[seen], axis=-1), 1, atol=1e-6)
    assert not normals[~seen].any()


def test_scaled_map_uses_scaled_intrinsics():
    depth = plane_depth(PLANES[1], 2.0, shape=(24, 20))
    assert angles(normals_from_depth(depth, CAMERA), PLANES[1]).max() < 0.1


@pytest.mark.parametrize("step", [1.05, 1.3, 3.0])
def test_a_step_does_not_bend_the_normals_on_either_side(step):
    near, far = plane_depth(PLANES[1], 2.0), plane_depth(PLANES[2], 2.0)
    depth = np.where(np.arange(60) < 28, near, far * (step * near.max() / far[far > 0].min()))
    normals = normals_from_depth(depth, CAMERA)
    assert angles(normals[:, :28], PLANES[1]).max() < 0.5
    right = depth[:, 28:] > 0
    assert angles(normals[:, 28:][right], PLANES[2]).max() < 0.5


def test_a_small_step_of_one_surface_stays_close():
    depth = np.where(np.arange(60) < 28, 1.0, 1.04) * plane_depth(PLANES[0], 2.0)
    assert angles(normals_from_depth(depth, CAMERA), PLANES[0]).max() < 5.0


def test_a_crease_keeps_both_sides():
    left, right = plane_depth(unit(0.7, 0, -1), 2.0), plane_depth(unit(-0.7, 0, -1), 2.0)
    depth = np.maximum(left, right)
    normals = normals_from_depth(depth, CAMERA)
    truth = np.where((left > right)[..., None], unit(0.7, 0, -1), unit(-0.7, 0, -1))
    error = angles(normals, truth)
    assert (left > right).any() and (left < right).any()
    assert error[np.abs(left - right) > 0.25].max() < 1.0
    assert np.median(error) < 0.1


def test_sphere():
    centre, radius = np.array([0.1, -0.1, 4.0]), 1.2
    ray = rays(CAMERA, (48, 60))
    a, b, c = (ray**2).sum(-1), ray @ centre, centre @ centre - radius**2
    hit = b * b - a * c > 0
    depth = np.where(hit, (b - np.sqrt(np.where(hit, b * b - a * c, 0))) / a, 0)
    truth = (ray * depth[..., None] - centre) / radius
    normals = normals_from_depth(depth, CAMERA)
    frontal = hit & ((truth * ray).sum(-1) / np.linalg.norm(ray, axis=-1) < -0.4)
    assert angles(normals[frontal], truth[frontal]).max() < 5.0
    assert angles(normals[frontal], truth[frontal]).mean() < 1.0


def test_noise_is_averaged():
    rng = np.random.default_rng(0)
    depth = plane_depth(PLANES[0], 2.0) * (1 + 0.002 * rng.standard_normal((48, 60)))
    wide = angles(normals_from_depth(depth, CAMERA, 3), PLANES[0]).mean()
    narrow = angles(normals_from_depth(depth, CAMERA, 1), PLANES[0]).mean()
    assert wide < 0.5 * narrow


def test_every_normal_faces_its_camera():
    depth = np.random.default_rng(1).uniform(1, 3, (48, 60))
    normals = normals_from_depth(depth, CAMERA)
    assert ((normals * rays(CAMERA, (48, 60))).sum(-1) <= 0).all()


def test_scale_of_depth_does_not_matter():
    depth = plane_depth(PLANES[1], 2.0)
    small, large = normals_from_depth(depth * 1e-3, CAMERA), normals_from_depth(depth * 1e3, CAMERA)
    assert angles(small, large).max() < 0.1


def test_lonely_pixels_have_no_normal():
    depth = np.zeros((48, 60))
    depth[10, 10] = 1.0
    depth[20, 5:40] = 1.0
    assert not normals_from_depth(depth, CAMERA).any()


def test_refuses_other_shapes():
    with pytest.raises(ValueError, match=r"\(H, W\)"):
        normals_from_depth(np.ones((2, 2, 1)), CAMERA)
    with pytest.raises(ValueError, match="radius"):
        normals_from_depth(np.ones((4, 4)), CAMERA, 0)
