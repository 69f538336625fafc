"""The points that the first frame starts from."""

from __future__ import annotations

import numpy as np

from morgs_mi.fit.initialise import fill_points, seen_points
from tests.scenes.cameras import arc, look_at_cameras


def few_points():
    """Return 40 points of a wall at z = 2 that fill the right half of the views, cameras in front of it, and images."""
    rng, cameras = np.random.default_rng(0), look_at_cameras(arc((-0.2, 0.0, 0.2), 3), 60)
    points = np.stack([rng.uniform(0.2, 2, 40), rng.uniform(-2, 2, 40), np.full(40, 2.0)], axis=1)
    images = [np.full((c.height, c.width, 3), 51, np.uint8) for c in cameras]
    return points, np.full((40, 3), 0.8), cameras, images


def test_fill_points__adds_points_at_the_depth_of_the_others_where_views_show_none():
    points, colors, cameras, images = few_points()
    filled, filled_colors = fill_points(points, colors, cameras, images, [None] * 3, 1000, np.random.default_rng(1))
    assert filled.shape == filled_colors.shape == (1000, 3)
    np.testing.assert_array_equal(filled[:40], points)
    added = np.isclose(filled_colors, 0.2).all(axis=1)
    assert 300 < added.sum() < 900
    assert np.mean(filled[added, 0] < 0.2) > 0.7
    assert np.abs(filled[added, 2] - 2).max() < 1.5
    assert np.abs(filled[~added, 2] - 2).max() < 1e-6


def test_fill_points__adds_none_where_pixels_are_not_valid():
    points, colors, cameras, images = few_points()
    masks = [np.zeros((c.height, c.width), bool) for c in cameras]
    filled, filled_colors = fill_points(points, colors, cameras, images, masks, 100, np.random.default_rng(1))
    assert len(filled) == 100
    np.testing.assert_allclose(filled_colors, 0.8)


def test_seen_points__leaves_out_points_behind_and_beside_the_camera():
    (camera,) = look_at_cameras([(0, 0, -3)], 60)
    inside, pixels, depths = seen_points(camera, np.array([(0, 0, 0), (0, 0, -6), (9, 0, 0)]))
    assert inside.tolist() == [True, False, False]
    np.testing.assert_allclose(pixels, [(camera.width / 2, camera.height / 2)])
    np.testing.assert_allclose(depths, [3])
