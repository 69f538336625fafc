"""The camera value, against Mitsuba's own sensor."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.core.camera import Camera


@pytest.fixture(params=[(0.0, 0.0), (9.0, -6.0), (-5.5, 7.25)], ids=["centred", "right_up", "left_down"])
def camera(request) -> Camera:
    camera = Camera.look_at((0.3, 0.5, 4), (0, 0, 0), (0, 1, 0), 40, 64, 48, "cam00")
    K = camera.K.copy()
    K[:2, 2] += request.param
    return replace(camera, K=K)


def pixel_of(camera: Camera, point: np.ndarray) -> np.ndarray:
    x, y, z = camera.K @ (camera.viewmat @ [*point, 1.0])[:3]
    return np.array([x / z, y / z])


def test_the_sensor_sees_a_point_where_the_matrices_say(camera):
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
    np.testing.assert_allclose(seen, pixel_of(camera, point), atol=0.1)


def test_the_sensors_rays_pass_through_the_pixels_they_belong_to(camera):
    y, x = np.mgrid[:48, :64].reshape(2, -1) + 0.5
    rays, _ = mi.load_dict(camera.sensor()).sample_ray(0, 0, mi.Point2f(x / 64, y / 48), 0)
    points = np.array(rays.o + 3 * rays.d).T
    pixels = np.array([pixel_of(camera, point) for point in points])
    np.testing.assert_allclose(pixels, np.stack([x, y], axis=1), atol=2e-3)
