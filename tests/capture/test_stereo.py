"""Dense points of textured planes at known depths."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.capture.stereo import stereo_points
from morgs_mi.core.rig import seen_points
from tests.scenes.textured import distance_to_planes


@pytest.fixture(scope="module")
def views(textured_capture):
    images = next(textured_capture.frames()).images
    return [
        (camera, image, None)
        for camera, image in zip(textured_capture.cameras, images, strict=True)
    ][:3]


def dense(views):
    return stereo_points(views, np.zeros((0, 3)), np.random.default_rng(0))


@pytest.fixture(scope="module")
def points_and_colors(views):
    return dense(views)


@pytest.mark.slow
def test_stereo_points__lie_on_the_surfaces(views, points_and_colors):
    camera, image, _ = views[0]
    points, colors = points_and_colors
    assert len(points) == len(colors) > 6000
    distance = distance_to_planes(points)
    assert np.median(distance) < 0.02
    assert np.mean(distance < 0.1) > 0.9
    mask, pixels, _ = seen_points(camera, points)
    columns, rows = pixels.astype(int).T
    assert np.median(np.abs(image[rows, columns] / 255.0 - colors[mask])) < 0.05


@pytest.mark.slow
def test_stereo_points__are_the_same_every_time(views, points_and_colors):
    assert_array_equal(points_and_colors[0], dense(views)[0])


@pytest.mark.slow
def test_stereo_points__leaves_out_pixels_that_are_not_valid(views):
    left_half = np.zeros(views[0][1].shape[:2], bool)
    left_half[:, : views[0][0].width // 2] = True
    points, _ = dense([(camera, image, left_half) for camera, image, _ in views])
    assert len(points) > 1000
    # Valid pixels of the third view confirm what the other two have in common.
    for camera, *_ in views:
        assert (camera.project(points)[0][:, 0] < camera.width / 2 + 2).all()


def test_stereo_points__finds_none_if_one_camera_is_before_the_other(views):
    camera, image, _ = views[0]
    for shift in ((0.1, 0, -0.5), (0, 0, -1)):
        pose = np.eye(4)
        pose[:3, 3] = shift
        ahead = replace(camera, viewmat=pose @ camera.viewmat)
        assert len(dense([(camera, image, None), (ahead, image, None)])[0]) == 0


def test_stereo_points__finds_none_between_distant_cameras(textured_capture):
    images = next(textured_capture.frames()).images
    points, colors = dense([(textured_capture.cameras[k], images[k], None) for k in (0, 5)])
    assert points.shape == colors.shape == (0, 3)
