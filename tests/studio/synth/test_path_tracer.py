"""The path tracer: rays, encoding, and noise."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.studio.synth.ground_truth import compute_ground_truth
from morgs_mi.studio.synth.path_tracer import PathTracer
from morgs_mi.studio.synth.scene import Light, Scene
from tests.assertions import assert_close
from tests.studio.synth.frames import psnr


@pytest.mark.slow
def test_surface_points__agree_with_rays_of_the_mitsuba_sensor(tracer):
    camera = tracer.scene.rig.cameras(3, 64, 48)[2]
    K = camera.K.copy()
    K[:2, 2] += 7, -5
    camera = replace(camera, K=K)
    surface = tracer.surface_points(camera)
    points = surface.positions
    y, x = np.mgrid[:48, :64].reshape(2, -1) + 0.5
    rays, _ = mi.load_dict(camera.sensor()).sample_ray(0, 0, mi.Point2f(x / 64, y / 48), 0)
    hit = tracer._scene.ray_intersect(mi.Ray3f(rays.o, rays.d))
    assert_close(np.array(hit.p).T.reshape(48, 64, 3)[5:-5, 5:-5], points[5:-5, 5:-5], atol=2e-3)
    pixels, depth = camera.project(points)
    assert_close(pixels, np.stack([x, y], axis=-1).reshape(48, 64, 2), atol=1e-3)
    poses = tracer.poses(0)
    np.testing.assert_allclose(
        compute_ground_truth(camera, surface, poses, None, poses).depth, depth, rtol=1e-6
    )


@pytest.mark.parametrize("radiance", [0.001, 0.18, 0.6, 3.0])
def test_render__returns_srgb_encoded_images(radiance):
    light = Light({"type": "constant", "radiance": {"type": "rgb", "value": radiance}})
    scene = Scene("sky", {}, {"sky": light})
    image = PathTracer(scene).render(scene.rig.cameras(2, 8, 8)[0], 1, 0)
    linear = min(radiance, 1.0)
    encoded = 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055
    np.testing.assert_array_equal(image, np.uint8(round(255 * encoded)))


@pytest.mark.slow
def test_render__sampling_noise_is_below_that_of_a_camera(tracer):
    camera = tracer.scene.rig.cameras(3, 96, 72)[1]
    tracer.set_time(0.1)
    # Measured: 41 dB at 320x240. A small image has larger pixels, with more texture in each.
    assert psnr(tracer.render(camera, 16, 1), tracer.render(camera, 1024, 2)) > 38


@pytest.mark.slow
def test_render__sensor_noise_has_the_requested_standard_deviation(tracer):
    tracer.set_time(0.0)
    camera = tracer.scene.rig.cameras(3, 160, 120)[0]
    clean = tracer.render(camera, 64, 0).astype(float)
    noisy, again = (tracer.render(camera, 64, 0, 0.02).astype(float) for _ in range(2))
    np.testing.assert_array_equal(noisy, again)
    mask = (clean > 30) & (clean < 225)
    # Rounding two images to bytes adds 1/6 to a variance of 26 squared grey levels.
    assert abs((noisy - clean)[mask].std() / (255 * 0.02) - 1) < 0.03
    assert abs((noisy - clean)[mask].mean()) < 0.15
