"""The points that the first frame starts from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi import Camera
from morgs_mi.fit.initialise import fill_points, focus_point, scene_extent, seed_points, seen_points
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


def moved(camera: Camera, shift: np.ndarray) -> Camera:
    """Return the camera in a world whose origin lies elsewhere."""
    viewmat = np.array(camera.viewmat, float)
    viewmat[:3, 3] -= viewmat[:3, :3] @ shift
    return replace(camera, viewmat=viewmat)


def parallel_cameras() -> list[Camera]:
    return [c for x in (-1.0, 0.0, 1.0) for c in look_at_cameras([(x, 0, -4)], 40, target=(x, 0, 0))]


@pytest.mark.parametrize(
    "cameras",
    [look_at_cameras(arc((-0.4, 0, 0.4), 4), 40), parallel_cameras(), parallel_cameras()[:1]],
    ids=["converging", "parallel", "single"],
)
def test_focus_point__does_not_depend_on_the_origin_of_the_world(cameras: list[Camera]):
    shift = np.array([3.0, -2.0, 40.0])
    there = [moved(camera, shift) for camera in cameras]
    np.testing.assert_allclose(focus_point(there), focus_point(cameras) + shift, atol=1e-4)


def test_focus_point__is_where_converging_cameras_look():
    cameras = look_at_cameras(arc((-0.4, 0, 0.4), 4), 40, target=(0.3, 0.1, 0.2))
    np.testing.assert_allclose(focus_point(cameras), (0.3, 0.1, 0.2), atol=1e-6)


def test_seed_points__are_far_before_parallel_cameras():
    cameras = parallel_cameras()
    images = [np.zeros((c.height, c.width, 3), np.uint8) for c in cameras]
    points, _ = seed_points(cameras, images, [None] * 3, 300, np.random.default_rng(0))
    depths = cameras[0].project(points)[1] / scene_extent(cameras)
    assert 3 < depths.min() < 4
    assert 20 < depths.max() < 31


def test_seed_points__lie_on_valid_pixels_in_their_colours():
    cameras = look_at_cameras(arc((-0.2, 0.0, 0.2), 3), 60)
    masks = [np.zeros((c.height, c.width), bool) for c in cameras]
    images = [np.full((c.height, c.width, 3), 255, np.uint8) for c in cameras]
    for mask, image in zip(masks[:2], images, strict=False):
        mask[10:20, 30:50] = True
        image[10:20, 30:50] = 51
    points, colors = seed_points(cameras, images, masks, 101, np.random.default_rng(0))
    assert len(points) == len(colors) == 101
    np.testing.assert_allclose(colors, 0.2)
    shown = np.zeros(101, bool)
    for camera, mask in zip(cameras, masks, strict=True):
        seen, pixels, _ = seen_points(camera, points)
        columns, rows = pixels.astype(int).T
        shown[seen] |= mask[rows, columns]
    assert shown.all()


def test_seen_points__leaves_out_points_behind_and_beside_the_camera():
    (camera,) = look_at_cameras([(0, 0, -3)], 60)
    inside, pixels, depths = seen_points(camera, np.array([(0, 0, 0), (0, 0, -6), (9, 0, 0)]))
    assert inside.tolist() == [True, False, False]
    np.testing.assert_allclose(pixels, [(camera.width / 2, camera.height / 2)])
    np.testing.assert_allclose(depths, [3])
