"""The points that the first frame starts from."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi.core.rig import focus_point, scene_extent, seen_points
from morgs_mi.core.view import View
from morgs_mi.fit.far_views import PointCloud
from morgs_mi.fit.initialise import (
    MIN_POINTS,
    _in_light,
    border_color,
    fill_points,
    in_empty_space,
    initial_points,
    seed_points,
    unseen_points,
)
from tests.scenes.cameras import arc, look_at_cameras


def few_points():
    """Return 40 points of a wall at z = 2 that fill the right half of the views, with their
    colours, and the views.
    """
    rng = np.random.default_rng(0)
    cameras = look_at_cameras(arc((-0.2, 0.0, 0.2), 3), 60)
    points = np.stack([rng.uniform(0.2, 2, 40), rng.uniform(-2, 2, 40), np.full(40, 2.0)], axis=1)
    cloud = PointCloud(points, np.full((40, 3), 0.8))
    return cloud, [grey_view(camera) for camera in cameras]


def grey_view(camera, mask=None):
    """Return a view that is dark grey."""
    return View(camera, np.full((camera.height, camera.width, 3), 51, np.uint8), mask)


def test_fill_points__adds_points_at_the_depth_of_the_others_where_views_show_none():
    points, views = few_points()
    filled, filled_colors = fill_points(points, views, 1000, np.random.default_rng(1))
    assert filled.shape == filled_colors.shape == (1000, 3)
    assert_array_equal(filled[:40], points.positions)
    added = np.isclose(filled_colors, 0.2).all(axis=1)
    assert 300 < added.sum() < 900
    assert np.mean(filled[added, 0] < 0.2) > 0.7
    assert np.abs(filled[added, 2] - 2).max() < 1.5
    assert np.abs(filled[~added, 2] - 2).max() < 1e-6


@pytest.mark.parametrize("count", [0, MIN_POINTS - 1, MIN_POINTS, 40, 2000])
def test_initial_points__are_given_ones_with_random_ones_where_these_are_few(count):
    (points, colors), views = few_points()
    point_cloud = PointCloud(np.resize(points, (count, 3)), np.resize(colors, (count, 3)))
    result, result_colors = initial_points(views, point_cloud, 1000, np.random.default_rng(1))
    assert result.shape == result_colors.shape == (1000, 3)
    random = np.isclose(result_colors, 0.2).all(axis=1)
    expected = 1 if count < MIN_POINTS else 0.3 if count < 1000 else 0
    assert random.mean() >= expected
    assert (random.mean() > 0) == (expected > 0)


def test_in_empty_space__is_before_the_near_plane_of_any_camera():
    cameras = [replace(c, near=1.0) for c in look_at_cameras([(0, 0, -3), (0, 0, 3)], 60)]
    means = np.array([(0, 0, -2.5), (0, 0, -1.5), (0, 0, -3.5), (0.2, 0, 2.5), (0.7, 0, -2.5)])
    assert in_empty_space(cameras, means).tolist() == [True, False, False, True, False]
    assert not in_empty_space([], means).any()


@pytest.mark.parametrize("count", [0, 40, 2000])
def test_initial_points__leave_the_space_before_near_planes_empty(count):
    (points, colors), views = few_points()
    views = [replace(view, camera=replace(view.camera, near=5.0)) for view in views]
    points = np.concatenate([points, points - (0, 0, 4)])
    point_cloud = PointCloud(np.resize(points, (count, 3)), np.resize(colors, (count, 3)))
    chosen, _ = initial_points(views, point_cloud, 1000, np.random.default_rng(1))
    assert len(chosen) > 950
    assert not in_empty_space([view.camera for view in views], chosen).any()


def moved(camera, shift):
    """Return the camera in a world with another origin."""
    viewmat = np.array(camera.viewmat, float)
    viewmat[:3, 3] -= viewmat[:3, :3] @ shift
    return replace(camera, viewmat=viewmat)


def parallel_cameras():
    return [
        c for x in (-1.0, 0.0, 1.0) for c in look_at_cameras([(x, 0, -4)], 40, target=(x, 0, 0))
    ]


@pytest.mark.parametrize(
    "cameras",
    [look_at_cameras(arc((-0.4, 0, 0.4), 4), 40), parallel_cameras(), parallel_cameras()[:1]],
    ids=["converging", "parallel", "single"],
)
def test_focus_point__does_not_depend_on_the_origin_of_the_world(cameras):
    shift = np.array([3.0, -2.0, 40.0])
    there = [moved(camera, shift) for camera in cameras]
    assert_allclose(focus_point(there), focus_point(cameras) + shift, atol=1e-4)


def test_focus_point__is_where_converging_cameras_look():
    cameras = look_at_cameras(arc((-0.4, 0, 0.4), 4), 40, target=(0.3, 0.1, 0.2))
    assert_allclose(focus_point(cameras), (0.3, 0.1, 0.2), atol=1e-6)


def test_seed_points__are_far_before_parallel_cameras():
    cameras = parallel_cameras()
    points, _ = seed_points(
        [grey_view(camera) for camera in cameras], 300, np.random.default_rng(0)
    )
    depths = cameras[0].project(points)[1] / scene_extent(cameras)
    assert 3 < depths.min() < 4
    assert 20 < depths.max() < 31


def test_seed_points__lie_on_valid_pixels_in_their_colours():
    mask = np.zeros((48, 64), bool)
    mask[10:20, 30:50] = True
    _, grey_views = few_points()
    views = [
        replace(view, image=np.where(valid[..., None], view.image, 255), mask=valid)
        for view, valid in zip(grey_views, (mask, mask, np.zeros_like(mask)), strict=True)
    ]
    points, colors = seed_points(views, 101, np.random.default_rng(0))
    assert len(points) == len(colors) == 101
    assert_allclose(colors, 0.2)
    shown = np.zeros(101, bool)
    for view in views[:2]:
        rows_of_points, pixels, _ = seen_points(view.camera, points)
        columns, rows = pixels.astype(int).T
        shown[rows_of_points] |= mask[rows, columns]
    assert shown.all()


def red_ball_views(background):
    """Return eight views around a red ball of radius 1 at the origin, over a plain background."""
    views = []
    for camera in look_at_cameras(arc(np.arange(8) * np.pi / 4, 5, y=-1)):
        image = np.full((camera.height, camera.width, 3), background, np.float32)
        rows, columns = np.indices(image.shape[:2])
        origin, rays = camera.rays(np.stack([columns, rows], axis=-1) + 0.5)
        image[np.linalg.norm(np.cross(rays, origin), axis=-1) < 1] = 0.8, 0.1, 0.1
        views.append(View(camera, image))
    return views


def test_seed_points__lie_where_most_views_show_their_colour():
    background = (0.9, 0.9, 0.9)
    views = red_ball_views(background)
    points, colors = seed_points(views, 400, np.random.default_rng(0), background)
    assert_allclose(colors, np.tile([0.8, 0.1, 0.1], (400, 1)), atol=1e-6)
    assert np.quantile(np.linalg.norm(points, axis=1), 0.95) < 1.2
    _, colors = seed_points(views, 400, np.random.default_rng(0))
    is_background = np.isclose(colors, 0.9).all(axis=1)
    assert 0.5 < is_background.mean() < 0.95, "without a background, all pixels have points"


def test_border_color__is_what_borders_have_in_common():
    views = red_ball_views((0.9, 0.8, 0.7))
    assert_allclose(border_color(views), (0.9, 0.8, 0.7), atol=1e-6)
    rng = np.random.default_rng(0)
    noisy = [
        replace(view, image=view.image + rng.normal(0, 0.1, view.image.shape)) for view in views
    ]
    assert border_color(noisy) is None
    masks = [np.zeros(view.image.shape[:2], bool) for view in views]
    for mask in masks:
        mask[20:30, 20:30] = True
    masked = [replace(view, mask=mask) for view, mask in zip(views, masks, strict=True)]
    assert border_color(masked) is None


def test_in_light__points_get_the_median_colours_of_hdr_views():
    """The points of a recording have colours of 8 bits; a view in which something hides a point
    does not matter.
    """
    cameras = look_at_cameras([(x, 0, -4) for x in (-0.5, 0, 0.5)], 60, 40, 30)
    images = [np.full((30, 40, 3), light, np.float32) for light in (2.5, 2.6, 0.1)]
    masks = [None, np.ones((30, 40), bool), None]
    views = [View(*view) for view in zip(cameras, images, masks, strict=True)]
    cube = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))
    outside = np.array([[90, 0, 0]])
    points = PointCloud(np.concatenate([cube, outside]), np.full((31, 3), 0.75))
    expected = np.repeat([2.5, 0.75], (30, 1))[:, None] * np.ones(3)
    assert_allclose(_in_light(points, views).colors, expected)


@pytest.mark.parametrize(
    ("change", "share"),
    [
        (lambda points: points, None),
        (lambda points: points - np.array([0, 0, 100]), 0),  # behind the cameras
        (lambda points: np.where(np.arange(len(points))[:, None] % 25, 50, points), 4),
        (lambda points: np.where(np.arange(len(points))[:, None] % 10, 50, points), None),
    ],
)
def test_unseen_points__names_points_that_hardly_a_camera_sees(change, share):
    cameras = look_at_cameras(arc((-0.2, 0.0, 0.2), 3), 60)
    points = change(np.random.default_rng(0).uniform(-0.5, 0.5, (100, 3)))
    start = "" if share is None else f"the cameras see {share} % of the {len(points)} points, which"
    sentence = unseen_points(cameras, points)
    assert sentence.startswith(start)
    assert bool(sentence) == bool(start)
