"""The camera of the page at the cameras of the rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.playback.viewer.page_view import camera_at, field_of_view, orientation, page_view, point_ahead
from tests.assertions import assert_close
from tests.scenes.cameras import make_camera
from tests.scenes.changing_splats import rig

SCALE = 3.0


class Page:
    """A page of 90x50 pixels at a camera."""

    image_height, aspect = 50, 1.8

    def __init__(self, camera) -> None:
        self.wxyz, self.position = orientation(camera), SCALE * camera.position
        self.fov = field_of_view(camera, self.aspect)


@pytest.mark.parametrize("camera", [make_camera(90, 50), make_camera(20, 80), make_camera(300, 20)])
def test_field_of_view__shows_all_of_the_image(camera):
    view = page_view(Page(camera), SCALE)
    assert (view.width, view.height) == (90, 50)
    corners = np.array([(x, y) for x in (0, camera.width) for y in (0, camera.height)], float)
    pixels, depths = view.project(camera.unproject(corners, np.ones(4)))
    assert (depths > 0).all()
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    assert (low > -1e-6).all()
    assert (high < np.array([90, 50]) + 1e-6).all()
    assert np.min([low, [90, 50] - high]) < 1e-6, "one edge of the image is at the edge of the page"


def test_point_ahead__lies_on_the_axis_at_the_depth_of_the_centre():
    camera, center = rig()[0], np.array([0.3, 0.1, 0.2])
    pixels, depth = camera.project(point_ahead(camera, center))
    assert_close(pixels, camera.K[:2, 2], atol=1e-9)
    assert_close(depth, camera.project(center)[1], atol=1e-9)


def test_camera_at__is_the_nearest_direction_at_that_position():
    cameras = rig()
    assert [camera_at(page_view(Page(camera), SCALE), cameras, 1e-3) for camera in cameras] == [0, 1, 2]
    moved = cameras[1].viewmat.copy()
    moved[2, 3] += 0.01
    assert camera_at(replace(cameras[1], viewmat=moved), cameras, 1e-3) is None
    turned = np.diag([-1.0, 1, -1, 1])
    turned = replace(cameras[1], viewmat=turned @ cameras[1].viewmat)
    assert camera_at(cameras[1], (turned, cameras[1]), 1e-3) == 1
