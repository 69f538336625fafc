"""Dense points of textured planes at known depths."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.core.rig import seen_points
from morgs_mi.fit.stereo import stereo_points
from tests.scenes.textured import distance_to_planes


@pytest.fixture(scope="module")
def views(textured_capture):
    return next(textured_capture.frames()).views[:3]


def dense(views):
    return stereo_points(views, np.zeros((0, 3)), np.random.default_rng(0))


@pytest.fixture(scope="module")
def points_and_colors(views):
    return dense(views)


@pytest.mark.slow
def test_stereo_points__lie_on_the_surfaces(views, points_and_colors):
    points, colors = points_and_colors
    assert len(points) == len(colors) > 6000
    distance = distance_to_planes(points)
    assert np.median(distance) < 0.02
    assert np.mean(distance < 0.1) > 0.9
    mask, pixels, _ = seen_points(views[0].camera, points)
    columns, rows = pixels.astype(int).T
    assert np.median(np.abs(views[0].image[rows, columns] / 255.0 - colors[mask])) < 0.05


@pytest.mark.slow
def test_stereo_points__leaves_out_pixels_that_are_not_valid(views):
    left_half = np.zeros(views[0].image.shape[:2], bool)
    left_half[:, : views[0].camera.width // 2] = True
    points, _ = dense([replace(view, mask=left_half) for view in views])
    assert len(points) > 1000
    # Valid pixels of the third view confirm what the other two have in common.
    for camera in (view.camera for view in views):
        assert (camera.project(points)[0][:, 0] < camera.width / 2 + 2).all()


def test_stereo_points__finds_none_if_one_camera_is_before_the_other(views):
    camera = views[0].camera
    for shift in ((0.1, 0, -0.5), (0, 0, -1)):
        pose = np.eye(4)
        pose[:3, 3] = shift
        ahead = replace(camera, viewmat=pose @ camera.viewmat)
        assert len(dense([views[0], replace(views[0], camera=ahead)])[0]) == 0
