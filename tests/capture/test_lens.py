"""Undistortion against OpenCV's own projection through the lens."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.lens import Lens, opencv_lens, undistortion
from morgs_mi.core.camera import Camera
from morgs_mi.testing import assert_close

WIDTH = 160
HEIGHT = 120
LENSES = {
    "SIMPLE_RADIAL": (-0.1,),
    "RADIAL": (0.08, -0.02),
    "OPENCV": (-0.1, 0.02, 0.004, -0.003),
    "OPENCV_FISHEYE": (0.05, -0.01, 0.002, 0.0),
    "FULL_OPENCV": (-0.1, 0.02, 0.004, -0.003, 0.01, 0.02, -0.01, 0.005),
}


def camera(focal=110.0):
    K = np.array([[focal, 0, 71.3], [0, 1.05 * focal, 66.8], [0, 0, 1]])
    return Camera(K, np.eye(4), WIDTH, HEIGHT, "cam")


def dots(centres):
    """Draw a blob at each centre [N, 2], in pixels with centres at +0.5."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    image = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8) for u, v in centres)
    return np.repeat((250 * np.clip(image, 0, 1))[..., None], 3, -1).astype(np.uint8)


def project(lens, points, cam=None):
    """Return the positions [N, 2] of points in the frame of `camera`, or of `cam`, seen through the
    lens, with centres at +0.5.
    """
    K = (cam or camera()).K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    zero = np.zeros(3)
    through = cv2.fisheye.projectPoints if lens.model == "OPENCV_FISHEYE" else cv2.projectPoints
    return through(points[:, None], zero, zero, K, lens.opencv_coefficients)[0].reshape(-1, 2) + 0.5


def assert_centred(image, expected):
    """Assert that blobs [N, 2] lie where they are expected, as far from each other as these."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    for u, v in expected:
        near = image * ((np.abs(x - u) < 7) & (np.abs(y - v) < 7))
        centre = np.array([(near * x).sum(), (near * y).sum()]) / near.sum()
        # 1/32 px of the maps, and the distortion of the blob itself.
        assert_close(centre, (u, v), atol=0.15)


@pytest.mark.parametrize("model", LENSES)
def test_undistortion__moves_points_to_their_pinhole_projections(model):
    cam = camera()
    lens = Lens(model, LENSES[model])
    points = np.array([[x, y, 2.0] for x in (-0.9, -0.1, 0.8) for y in (-0.7, 0.05, 0.6)])
    distorted = project(lens, points)
    expected, _ = cam.project(points)
    assert np.abs(distorted - expected).max() > 1, "the case must bend rays by more than a pixel"

    lens_map = undistortion(cam, lens)
    assert_centred(lens_map(dots(distorted)).astype(float)[..., 0], expected)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
def test_undistortion__removes_what_a_refined_lens_leaves(model):
    cam = camera()
    lens = Lens(model, LENSES.get(model, ()))
    refined = camera(112.0)
    remainder = Lens("RADIAL", (0.06, -0.01))
    points = np.array([[x, y, 2.0] for x in (-0.8, -0.1, 0.7) for y in (-0.6, 0.05, 0.5)])
    # The refined lens shows the points on rays of the calibrated camera, whose lens bends them.
    rays = cam.unproject(project(remainder, points, refined), np.ones(len(points)))
    lens_map = undistortion(cam, lens, (refined, remainder))
    image = lens_map(dots(project(lens, rays))).astype(float)[..., 0]
    assert_centred(image, refined.project(points)[0])


def test_undistortion__is_none_without_distortion():
    assert undistortion(camera(), Lens()) is None
    assert undistortion(camera(), Lens("OPENCV", (0.0, 0.0, 0.0, 0.0))) is None


def test_undistortion__masks_the_empty_corners_of_a_pincushion():
    pincushion, barrel = (
        undistortion(camera(), Lens("SIMPLE_RADIAL", (k1,))).mask for k1 in (0.3, -0.1)
    )
    assert pincushion[HEIGHT // 2, WIDTH // 2]
    assert not pincushion[0, 0]
    assert barrel.all()


@pytest.mark.parametrize(
    ("model", "radius"),
    [("SIMPLE_RADIAL", 1.5**-0.5), ("OPENCV_FISHEYE", np.tan(1.5**-0.5))],
)
def test_undistortion__mask_ends_where_the_polynomial_folds(model, radius):
    """R (1 - 0.5 r^2) decreases beyond r = 0.816; theta (1 - 0.5 theta^2) beyond that angle, of
    tangent 1.066.
    """
    cam = camera(focal=60.0)
    mask = undistortion(cam, Lens(model, (-0.5,))).mask
    pixels = np.stack(np.mgrid[:HEIGHT, :WIDTH][::-1], axis=-1) + 0.5
    places = cam.unproject(pixels, np.ones((HEIGHT, WIDTH)))
    r = np.linalg.norm(places[..., :2], axis=-1)
    assert r.max() > 1.2 * radius
    pixel = 1.5 / cam.K[0, 0]
    assert mask[r < radius - pixel].all()
    assert not mask[r > radius + pixel].any()


@pytest.mark.parametrize(
    ("coefficients", "model", "distortion"),
    [
        ((0.1, 0.2, 0.3, 0.4, 0), "OPENCV", (0.1, 0.2, 0.3, 0.4)),
        ((0.1, 0.2, 0.3, 0.4, 0.5), "FULL_OPENCV", (0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0)),
        ((1, 2, 3, 4, 5, 6, 7, 8), "FULL_OPENCV", (1, 2, 3, 4, 5, 6, 7, 8)),
    ],
)
def test_opencv_lens__keeps_the_order_of_opencv(coefficients, model, distortion):
    lens = opencv_lens(coefficients)
    assert (lens.model, lens.distortion) == (model, distortion)
    assert_array_equal(lens.opencv_coefficients[: len(coefficients)], coefficients)
