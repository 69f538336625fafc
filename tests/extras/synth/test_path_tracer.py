"""The path tracer: rays, encoding, and noise."""

import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi.extras.synth.ground_truth import compute_ground_truth
from morgs_mi.extras.synth.path_tracer import PathTracer
from morgs_mi.extras.synth.scene import Light, Scene
from morgs_mi.testing import assert_close
from tests.scenes.cameras import shift_principal_point


@pytest.mark.slow
def test_surface_points__agree_with_rays_of_the_mitsuba_sensor(tracer):
    camera = shift_principal_point(tracer.scene.rig.cameras(3, 64, 48)[2], 7, -5)
    surface = tracer.surface_points(camera)
    y, x = np.mgrid[:48, :64] + 0.5
    film = mi.Point2f(np.ravel(x / 64), np.ravel(y / 48))
    rays, _ = mi.load_dict(camera.sensor()).sample_ray(0, 0, film, 0)
    hit = tracer._scene.ray_intersect(mi.Ray3f(rays.o, rays.d))
    hits = np.array(hit.p).T.reshape(48, 64, 3)
    inner = np.s_[5:-5, 5:-5]
    assert_close(hits[inner], surface.positions[inner], atol=2e-3)
    pixels, depth = camera.project(surface.positions)
    assert_close(pixels, np.stack([x, y], axis=-1), atol=1e-3)
    poses = tracer.poses(0)
    truth = compute_ground_truth(camera, surface, poses, None, poses)
    assert_allclose(truth.depth, depth, rtol=1e-6)


@pytest.mark.parametrize(
    ("radiance", "expected"),
    [(0.001, 255 * 12.92 * 0.001), (0.6, 255 * (1.055 * 0.6 ** (1 / 2.4) - 0.055)), (3.0, 255)],
)
def test_render__returns_srgb_encoded_images(radiance, expected):
    light = Light({"type": "constant", "radiance": {"type": "rgb", "value": radiance}})
    scene = Scene("sky", {}, {"sky": light})
    image = PathTracer(scene).render(scene.rig.cameras(2, 8, 8)[0], 1, 0)
    assert_array_equal(image, np.uint8(round(expected)))


@pytest.mark.slow
def test_render__sensor_noise_has_the_requested_standard_deviation(tracer):
    tracer.set_time(0.0)
    camera = tracer.scene.rig.cameras(3, 160, 120)[0]
    clean, noisy, again = (
        tracer.render(camera, 64, 0, noise).astype(float) for noise in (0.0, 0.02, 0.02)
    )
    assert_array_equal(noisy, again)
    noise = (noisy - clean)[(clean > 30) & (clean < 225)]
    # Rounding two images to bytes adds 1/6 to a variance of 26 squared grey levels.
    assert abs(noise.std() / (255 * 0.02) - 1) < 0.03
    assert abs(noise.mean()) < 0.15
