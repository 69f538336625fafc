"""Few cameras far apart: silhouettes, and the points and Gaussians of what they show."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.reports.far_cameras import hull_points, person_alone, silhouettes
from morgs_mi import FitConfig, StreamConfig, load_capture, rasterize
from tests.scenes.room import CENTRE, RADIUS, rig, room_view


@pytest.fixture(scope="module")
def balls():
    """Views of the red ball, in which its pixels are valid."""
    views = [room_view(camera) for camera in rig()]
    return [replace(view, mask=(view.image == (204, 26, 26)).all(axis=2)) for view in views]


def test_silhouettes__cover_outlines_at_the_size_of_the_views(fitted_clip, small_images):
    capture = load_capture(fitted_clip / "capture", 2, None)
    width, height = capture.at_recorded_size().cameras[0].size
    outline = [[0, 0], [width // 2 - 1, 0], [width // 2 - 1, height - 1], [0, height - 1]]
    masks = silhouettes(capture, dict.fromkeys(capture.names, outline))
    assert masks.keys() == set(capture.names)
    for view in capture.views:
        mask = masks[view.name]
        assert mask.shape == (view.camera.height, view.camera.width)
        assert mask[:, : width // 4].all()
        assert not mask[:, width // 4 :].any()


def test_hull_points__are_in_the_ball_of_all_silhouettes(balls):
    points, colors = hull_points(balls, np.random.default_rng(0))
    assert points.shape == colors.shape == (2000, 3)
    assert np.linalg.norm(points - CENTRE, axis=1).max() < 1.5 * RADIUS
    np.testing.assert_allclose(colors, np.tile([204, 26, 26], (2000, 1)) / 255)


def test_person_alone__is_opaque_in_the_silhouettes_and_nowhere_else(balls):
    config = StreamConfig(FitConfig(first_frame_steps=60))
    gaussians = person_alone(balls, 1.0, config)
    for view in balls:
        alpha = np.asarray(rasterize(gaussians, view.camera).alpha)[..., 0]
        assert alpha[view.mask].mean() > 0.9
        assert alpha[~view.mask].mean() < 0.05
