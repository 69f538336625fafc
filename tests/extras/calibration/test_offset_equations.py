"""Equations of time offsets, on a ball with images rendered at known ones."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from morgs_mi import rasterize
from morgs_mi.core.view import View
from morgs_mi.extras.calibration.offset_equations import offset_equations
from tests.scenes.ball import opaque_ball
from tests.scenes.cameras import look_at_cameras

# The ball moves by about a pixel per frame, and the equations are linear: offsets are found to a
# twentieth of a pixel, not exactly.
POSITIONS = (
    (0.4, -0.3, -4),
    (-0.8, 0.3, -4),
    (0.8, 0.9, -3.8),
    (-0.5, -0.8, -4.2),
    (1.2, 0.1, -3.9),
)
# Height, width and colours of the images.
SIZE = (48, 64, 3)
OFFSETS = np.array([-0.6, -0.2, 0.1, 0.4, 0.3])


def turning_ball():
    """Return a ball that moves by about a pixel per frame, and turns."""
    ball = opaque_ball()
    x, y, z = np.asarray(ball.means).T
    return replace(
        ball, motion=np.float32((0.04, 0.02, -0.01)) + 0.03 * np.stack([-z, 0 * y, x], axis=1)
    )


def equations(
    ball,
    offsets=OFFSETS,
    held_out=(),
    away=0.0,
    positions=POSITIONS,
    noise=None,
):
    """Return the equations of a ball that is shown at offsets, with Gaussians that are away from
    their places.
    """
    cameras = look_at_cameras(list(positions), 40)
    views = []
    for index, (camera, offset) in enumerate(zip(cameras, offsets, strict=True)):
        moved_ball = replace(
            ball, means=np.asarray(ball.means) + np.float32(offset) * np.asarray(ball.motion)
        )
        image = np.asarray(rasterize(moved_ball, camera, ("color",)).color) + (
            0 if noise is None else noise[index]
        )
        views.append(View(camera, np.clip(image, 0, 1).astype(np.float32)))
    displaced = replace(ball, means=(np.asarray(ball.means) + away).astype(np.float32))
    train = ~np.isin(np.arange(len(cameras)), held_out)
    return offset_equations(displaced, views, train, 0.0)


def test_solution__has_a_mean_of_zero_over_the_training_views():
    held_out = equations(turning_ball(), held_out=[0])
    assert not held_out.matrix[1:, 0].any()
    assert_allclose(held_out.solution(), OFFSETS - OFFSETS[1:].mean(), atol=0.08)


def test_solution__does_not_depend_on_gaussians_that_are_away_from_their_places():
    ball = turning_ball()
    away = np.float32((0.02, -0.02, 0.01))
    assert_allclose(equations(ball, away=away).solution(), equations(ball).solution(), atol=0.03)


def test_solution__is_how_far_each_view_is_ahead_with_what_the_fit_hides():
    system = equations(turning_ball())
    assert_allclose(system.solution(), OFFSETS, atol=0.06)
    assert_allclose(system.solution(share=0.5), 2 * system.solution())


def test_sum__is_between_its_timestamps():
    ball = turning_ball()
    both = equations(ball) + equations(ball, 0 * OFFSETS)
    assert_allclose(both.solution(), OFFSETS / 2, atol=0.05)


def test_errors__are_large_where_a_change_of_depth_explains_an_offset():
    ball = opaque_ball()
    pair = [(-0.8, 0.0, -4.0), (0.8, 0.0, -4.0)]
    noise = np.random.default_rng(0).normal(0, 0.02, (2, *SIZE))
    along, across = (
        equations(
            replace(ball, motion=np.tile(np.float32(motion), (400, 1))),
            np.zeros(2),
            positions=pair,
            noise=noise,
        )
        for motion in ((0.04, 0, 0), (0, 0.04, 0))
    )
    assert across.errors(0)[1] < 0.05
    assert along.errors(0)[1] > 0.5
    assert along.errors(0)[0] == 0


@pytest.mark.slow
def test_errors__are_those_of_repeated_noise():
    ball = turning_ball()
    rng = np.random.default_rng(0)
    systems = [
        equations(ball, 0 * OFFSETS, noise=rng.normal(0, 0.02, (5, *SIZE))) for _ in range(20)
    ]
    spread = np.std([each.solution() - each.solution()[0] for each in systems], axis=0)[1:]
    assert_allclose(np.mean([each.errors(0) for each in systems], axis=0)[1:], spread, rtol=0.4)


def test_solution__leaves_views_where_they_are_without_motion():
    still = replace(opaque_ball(), motion=np.zeros((400, 3), np.float32))
    system = equations(still)
    assert not system.own.any()
    assert_array_equal(system.solution(), 0)
