"""Dense points of textured planes at known depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.capture.capture import Capture
from morgs_mi.capture.stereo import stereo_points
from morgs_mi.core.rig import seen_points
from tests.scenes.textured import distance_to_planes

NO_POINTS = np.zeros((0, 3))


@pytest.fixture(scope="module")
def views(textured_capture: Capture):
    return textured_capture.cameras[:3], next(textured_capture.frames()).images[:3]


@pytest.fixture(scope="module")
def points_and_colors(views):
    cameras, images = views
    return stereo_points(cameras, images, [None] * 3, NO_POINTS, np.random.default_rng(0))


@pytest.mark.slow
def test_stereo_points__lie_on_the_surfaces(views, points_and_colors) -> None:
    (camera, *_), (image, *_) = views
    points, colors = points_and_colors
    assert len(points) == len(colors) > 6000
    distance = distance_to_planes(points)
    assert np.median(distance) < 0.02
    assert np.mean(distance < 0.1) > 0.9
    mask, pixels, _ = seen_points(camera, points)
    columns, rows = pixels.astype(int).T
    assert np.median(np.abs(image[rows, columns] / 255.0 - colors[mask])) < 0.05


@pytest.mark.slow
def test_stereo_points__are_the_same_every_time(views, points_and_colors) -> None:
    cameras, images = views
    again = stereo_points(cameras, images, [None] * 3, NO_POINTS, np.random.default_rng(0))
    np.testing.assert_array_equal(points_and_colors[0], again[0])


@pytest.mark.slow
def test_stereo_points__leaves_out_pixels_that_are_not_valid(views) -> None:
    cameras, images = views
    halves = [np.arange(camera.width) < camera.width // 2 for camera in cameras]
    masks = [
        np.tile(of_row, (camera.height, 1)) for of_row, camera in zip(halves, cameras, strict=True)
    ]
    points, _ = stereo_points(cameras, images, masks, NO_POINTS, np.random.default_rng(0))
    assert len(points) > 1000
    # Valid pixels of the third view confirm what the other two have in common.
    shown = [camera.project(points)[0][:, 0] < camera.width / 2 + 2 for camera in cameras]
    assert np.all(shown)


def test_stereo_points__finds_none_if_one_camera_is_before_the_other(views) -> None:
    (camera, *_), (image, *_) = views
    for shift in ((0.1, 0, -0.5), (0, 0, -1)):
        pose = np.eye(4)
        pose[:3, 3] = shift
        ahead = replace(camera, viewmat=pose @ camera.viewmat)
        points, _ = stereo_points(
            [camera, ahead], [image, image], [None] * 2, NO_POINTS, np.random.default_rng(0)
        )
        assert len(points) == 0


def test_stereo_points__finds_none_between_distant_cameras(textured_capture: Capture) -> None:
    cameras = textured_capture.cameras
    images = next(textured_capture.frames()).images
    ends = [cameras[0], cameras[5]], [images[0], images[5]]
    points, colors = stereo_points(
        ends[0], ends[1], [None] * 2, NO_POINTS, np.random.default_rng(0)
    )
    assert points.shape == colors.shape == (0, 3)
