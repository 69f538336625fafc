"""The camera, against Mitsuba's own sensor, central differences and its own inverse."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi.core.camera import Camera
from morgs_mi.testing import assert_close


@pytest.fixture(
    params=[(0.0, 0.0), (9.0, -6.0), (-5.5, 7.25)], ids=["centred", "right_up", "left_down"]
)
def camera(request):
    camera = Camera.look_at((0.3, 0.5, 4), (0, 0, 0), (0, 1, 0), 40, 64, 48, "cam00")
    K = camera.K.copy()
    K[:2, 2] += request.param
    return replace(camera, K=K)


def test_project__inverts_the_rays_of_the_mitsuba_sensor(camera):
    y, x = np.mgrid[:48, :64].reshape(2, -1) + 0.5
    rays, _ = mi.load_dict(camera.sensor()).sample_ray(0, 0, mi.Point2f(x / 64, y / 48), 0)
    points = np.array(rays.o + 3 * rays.d).T
    assert_close(camera.project(points)[0], np.stack([x, y], axis=1), atol=2e-3)


def test_from_sensor__inverts_sensor(camera):
    K = camera.K + np.array([[0, 0, 3.5], [0, 0, -2.25], [0, 0, 0]])
    off_centre = replace(camera, K=K, name="cam07", near=0.3)
    crop = {"crop_offset_x": 5, "crop_offset_y": 4, "crop_width": 20, "crop_height": 10}
    view = Camera.from_sensor(mi.load_dict({**off_centre.sensor(**crop), "id": "cam07"}))
    assert_close(view.K, K, atol=1e-4)
    assert_close(view.viewmat, camera.viewmat, atol=1e-6)
    assert (view.width, view.height, view.name) == (camera.width, camera.height, "cam07")
    assert view.near == pytest.approx(0.3)


def test_from_sensor__refuses_other_sensors(camera):
    with pytest.raises(
        ValueError,
        match=r"Camera\.from_sensor\(\): .* got ThinLensCamera; splats are drawn only by",
    ):
        Camera.from_sensor(mi.load_dict({"type": "thinlens", "aperture_radius": 0.1}))
    with pytest.raises(ValueError, match="got a dict"):
        Camera.from_sensor(camera.sensor())


def test_sensor__refuses_focal_lengths_that_differ_by_a_pixel_or_more(camera):
    mi.load_dict(replace(camera, K=np.diag([1, 1 + 0.9 / 48, 1]) @ camera.K).sensor())
    K = np.diag([1, 0.99, 1]) @ camera.K
    K[1, 2] = camera.K[1, 2]
    view = replace(camera, K=K, width=640, height=480)
    with pytest.raises(
        ValueError,
        match=r"Camera\.sensor\(\): `K` must have equal focal lengths.*camera\.square\(\)",
    ):
        view.sensor()
    square = view.square()
    mi.load_dict(square.sensor())
    point = np.array([0.2, -0.3, 0.1])
    scale = [1, square.height / view.height]
    assert_close(square.project(point)[0], view.project(point)[0] * scale, atol=1e-9)
    assert abs(square.K[0, 0] / square.K[1, 1] - 1) * square.height <= 0.5


def test_rays_and_unproject__invert_project(camera):
    points = np.random.default_rng(0).uniform(-1, 1, (4, 5, 3))
    pixels, depths = camera.project(points)
    assert pixels.shape == (4, 5, 2)
    assert_close(camera.unproject(pixels, depths), points, atol=1e-12)
    origin, directions = camera.rays(pixels[0])
    assert_allclose(origin, camera.position)
    assert_allclose(np.linalg.norm(directions, axis=1), 1)
    assert_close(camera.project(origin + 2.5 * directions)[0], pixels[0], atol=1e-9)


def test_projection_jacobian__agrees_with_central_differences(camera):
    points = np.random.default_rng(2).uniform(-0.5, 0.5, (6, 3))
    h = 1e-5
    J = camera.projection_jacobian(points)
    for k in range(3):
        step = h * np.eye(3)[k]
        difference = (camera.project(points + step)[0] - camera.project(points - step)[0]) / (2 * h)
        assert_allclose(J[:, :, k], difference, rtol=1e-6, atol=1e-6)
    behind = camera.unproject(np.zeros((1, 2)), np.array([-1.0]))
    assert not camera.projection_jacobian(behind).any()


K = np.array([[40.0, 0, 16], [0, 40, 8], [0, 0, 1]])
VIEWMAT = np.eye(4)


def test_camera__copies_its_matrices():
    intrinsics = K.copy()
    viewmat = VIEWMAT.copy()
    camera = Camera(intrinsics, viewmat, 32, 16)
    intrinsics[:] = 7
    viewmat[:] = 7
    assert_array_equal(camera.K, K)
    assert_array_equal(camera.viewmat, VIEWMAT)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"near": np.nan}, r"`near` must be a number in \[1e-30, inf\), got nan"),
        ({"delay": 1.5}, r"`delay` must be a number in \[-1, 1\], got 1.5"),
        ({"K": np.eye(2)}, r"`K` must be an array of real numbers \[3, 3\]"),
        ({"K": K + np.eye(3, k=1)}, "a camera without skew"),
        ({"K": -K}, "positive focal lengths"),
        ({"viewmat": VIEWMAT * np.nan}, r"Camera\(\), `viewmat`: the pose must be finite"),
        (
            {"viewmat": np.diag([1, 1, 1, 1e308])},
            "the pose must be finite, with numbers of at most 1e\\+12",
        ),
        ({"viewmat": np.diag([-1.0, 1, 1, 1]) @ VIEWMAT}, "undo any scaling or mirroring"),
        (
            {"viewmat": np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]])},
            "transpose the matrix if",
        ),
    ],
)
def test_camera__refuses_bad_input(change, message):
    with pytest.raises(ValueError, match=message):
        Camera(**{"K": K, "viewmat": VIEWMAT, "width": 32, "height": 16, **change})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"target": (0, -3, 0)}, "`up` must not be parallel"),
        ({"fov_x": 180}, r"`fov_x` must be a number in \(0, 180\), got 180"),
    ],
)
def test_look_at__refuses_bad_input(change, message):
    view = {
        "origin": (0, -3, 0),
        "target": (0, 0, 0),
        "up": (0, 0, 1),
        "fov_x": 40,
        "width": 8,
        "height": 8,
    }
    with pytest.raises(ValueError, match=message):
        Camera.look_at(**{**view, **change})


def test_look_at__has_a_near_plane_before_its_target():
    for distance, near in ((5.0, 0.01), (0.02, 2e-4)):
        camera = Camera.look_at((0, 0, -distance), (0, 0, 0), (0, -1, 0), 40, 32, 24)
        assert camera.near == pytest.approx(near)


def test_camera__is_equal_to_itself_alone():
    first, second = (Camera.look_at((0, y, -4), (0, 0, 0), (0, -1, 0), 40, 48, 32) for y in (0, 1))
    assert second in [first, second]
    assert {first: 1}.get(second) is None
