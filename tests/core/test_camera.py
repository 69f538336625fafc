"""The camera, against Mitsuba's own sensor, central differences and its own inverse."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.core.camera import Camera
from tests.assertions import assert_close


@pytest.fixture(params=[(0.0, 0.0), (9.0, -6.0), (-5.5, 7.25)], ids=["centred", "right_up", "left_down"])
def camera(request) -> Camera:
    camera = Camera.look_at((0.3, 0.5, 4), (0, 0, 0), (0, 1, 0), 40, 64, 48, "cam00")
    K = camera.K.copy()
    K[:2, 2] += request.param
    return replace(camera, K=K)


def test_project__agrees_with_the_mitsuba_sensor(camera):
    point = np.array([0.2, -0.3, 0.1])
    lamp = {
        "type": "sphere",
        "center": point.tolist(),
        "radius": 0.05,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }
    scene = mi.load_dict({"type": "scene", "lamp": lamp, "sensor": camera.sensor()})
    image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=64))[..., 0]
    y, x = np.mgrid[:48, :64] + 0.5
    seen = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
    # A ball's image is an ellipse whose middle is not quite the image of its centre; noise is 0.02 px.
    assert_close(seen, camera.project(point)[0], atol=0.1)


def test_project__inverts_the_rays_of_the_mitsuba_sensor(camera):
    y, x = np.mgrid[:48, :64].reshape(2, -1) + 0.5
    rays, _ = mi.load_dict(camera.sensor()).sample_ray(0, 0, mi.Point2f(x / 64, y / 48), 0)
    points = np.array(rays.o + 3 * rays.d).T
    assert_close(camera.project(points)[0], np.stack([x, y], axis=1), atol=2e-3)


def test_unproject__inverts_project(camera):
    points = np.random.default_rng(0).uniform(-1, 1, (4, 5, 3))
    pixels, depths = camera.project(points)
    assert pixels.shape == (4, 5, 2)
    assert_close(camera.unproject(pixels, depths), points, atol=1e-12)


def test_rays__start_at_the_camera_and_pass_through_their_pixels(camera):
    pixels = np.random.default_rng(1).uniform((0, 0), (64, 48), (7, 2))
    origin, directions = camera.rays(pixels)
    np.testing.assert_allclose(origin, camera.position)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    assert_close(camera.project(origin + 2.5 * directions)[0], pixels, atol=1e-9)


def test_projection_jacobian__agrees_with_central_differences(camera):
    points, h = np.random.default_rng(2).uniform(-0.5, 0.5, (6, 3)), 1e-5
    J = camera.projection_jacobian(points)
    for k in range(3):
        step = h * np.eye(3)[k]
        difference = (camera.project(points + step)[0] - camera.project(points - step)[0]) / (2 * h)
        np.testing.assert_allclose(J[:, :, k], difference, rtol=1e-6, atol=1e-6)
    behind = camera.unproject(np.zeros((1, 2)), np.array([-1.0]))
    assert not camera.projection_jacobian(behind).any()
