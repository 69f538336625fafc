"""Starts of few cameras far apart around a scene: points on its floor, objects and backdrop."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.fit.far_views import PointCloud, are_around, far_points
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.initialise import (
    NO_POINTS,
    FirstFrameProblem,
    initial_points,
    mean_color,
    seed_points,
)
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.render_config import RenderConfig
from tests.scenes.cameras import arc, look_at_cameras
from tests.scenes.room import CENTRE, FLOOR, RADIUS, rig, room_view


def outwards(cameras):
    """Return cameras turned by 180 degrees."""
    turn = np.diag([-1, 1, -1, 1])
    return [replace(camera, viewmat=turn @ camera.viewmat) for camera in cameras]


@pytest.mark.parametrize(
    ("cameras", "expected"),
    [
        (rig(4), True),
        (rig(12), False),
        (rig(4)[:1], False),
        (look_at_cameras(arc((-0.1, 0, 0.1), 3)), False),
        (outwards(rig(4)), False),
    ],
    ids=["far", "many", "one", "near", "outwards"],
)
def test_are_around__is_true_of_few_far_cameras_that_look_at_one_place(cameras, expected):
    assert are_around(cameras) == expected


def test_far_points__lie_on_the_floor_the_object_and_behind_the_cameras():
    points, colors = far_points([room_view(c) for c in rig()], 2000, np.random.default_rng(0))
    assert points.shape == colors.shape == (2000, 3)
    assert np.isfinite(points).all()
    from_ball = np.linalg.norm(points - CENTRE, axis=1)
    on_floor = np.abs(points[:, 2] - FLOOR) < 0.1
    behind = np.linalg.norm(points, axis=1) > 6
    assert (on_floor | behind | (from_ball < 1.2 * RADIUS)).mean() > 0.97
    in_ball = (from_ball < RADIUS) & ~on_floor
    assert in_ball.sum() > 50
    assert np.abs(colors[in_ball] - [0.8, 0.1, 0.1]).max(axis=1).mean() < 0.1
    assert on_floor.sum() > 400
    assert behind.sum() > 400


def test_far_points__are_of_valid_pixels():
    views = [room_view(camera) for camera in rig()]
    mask = np.zeros((48, 64), bool)
    mask[:24] = True
    masks = (mask, mask, mask, np.zeros_like(mask))
    masked = [replace(view, mask=mask) for view, mask in zip(views, masks, strict=True)]
    points, colors = far_points(masked, 300, np.random.default_rng(0))
    assert points.shape == colors.shape == (300, 3)
    for view in views[:3]:
        view.image[~mask] = 0
    assert colors.min() > 0.05, "pixels that are not valid are black"


def test_initial_points__of_few_far_cameras_are_far_points():
    views = [room_view(camera) for camera in rig()]
    points, _ = initial_points(views, NO_POINTS, 500, np.random.default_rng(0))
    expected, _ = far_points(views, 500, np.random.default_rng(0))
    assert {*map(tuple, points)} <= {*map(tuple, expected)}
    plain = [
        replace(view, image=np.where(view.image[..., :1] > 200, view.image, 0)) for view in views
    ]
    points, _ = initial_points(plain, NO_POINTS, 500, np.random.default_rng(0), (0, 0, 0))
    seeds, _ = seed_points(plain, 500, np.random.default_rng(0), (0, 0, 0))
    assert {*map(tuple, points)} <= {*map(tuple, seeds)}, (
        "the ball alone, before a plain background"
    )
    few = PointCloud(np.zeros((100, 3)), np.zeros((100, 3)))
    points, _ = initial_points(views, few, 500, np.random.default_rng(0))
    assert (np.abs(points) < 1e-9).all(axis=1).sum() == 100, "the given ones, and others"
    assert len(np.unique(points, axis=0)) > 300
    given = np.random.default_rng(0).uniform(-1, 1, (1500, 3))
    points, _ = initial_points(views, PointCloud(given, given * 0), 500, np.random.default_rng(0))
    assert {*map(tuple, points)} <= {*map(tuple, given)}


def test_fit_first_frame__of_far_views_is_better_than_the_nearest_photo():
    """Of a fifth view, 36 degrees from the nearest of four."""
    *views, test = [room_view(camera) for camera in rig(5)]
    render = RenderConfig(background=mean_color(views))
    config = FitConfig(num_gaussians=1000, first_frame_steps=150)
    rng = np.random.default_rng(0)
    problem = FirstFrameProblem.of(views, NO_POINTS, config, render, rng)
    gaussians = fit_first_frame(problem, config, rng).gaussians
    image = np.asarray(rasterize(gaussians, test.camera, ("color",), config=render).color)

    def error(shown):
        return np.square(shown - test.image / 255).mean()

    assert error(image) < 0.5 * min(error(view.image / 255) for view in views)
