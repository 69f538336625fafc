"""The forecast of views between the cameras of synthetic rigs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.core.rig import overlaps
from morgs_mi.fit.forecast import forecast
from tests.scenes.cameras import arc, look_at_cameras

NO_POINTS = np.zeros((0, 3))


def ring(count):
    return look_at_cameras(arc(2 * np.pi * np.arange(count) / count, 4), 40)


def test_forecast__is_good_for_a_ring_of_many_cameras():
    result = forecast(ring(40), NO_POINTS)
    assert result.spacing == pytest.approx(9)
    assert result.overlap > 0.95
    start = "Views between the cameras will be good: 40 cameras, 9 degrees apart, "
    assert result.sentence.startswith(start)
    assert result.sentence.endswith("of what they see.")


@pytest.mark.parametrize(
    ("count", "degrees", "quality", "more"),
    [(4, 58, "poor", 16), (8, 28, "poor", 14), (8, 15, "fair", 5)],
)
def test_forecast__names_the_cameras_that_would_help(count, degrees, quality, more):
    angles = np.deg2rad(degrees * (np.arange(count) - (count - 1) / 2))
    result = forecast(look_at_cameras(arc(angles, 4), 40), NO_POINTS)
    assert result.spacing == pytest.approx(degrees)
    assert result.sentence.startswith(
        f"Views between the cameras will be {quality}: {count} cameras, {degrees} degrees apart,"
    )
    advice = f"Cameras at most 9 degrees apart would make them good: {more} more on an arc."
    assert result.sentence.endswith(advice)


def test_forecast__measures_two_cameras_side_by_side_at_the_depth_of_the_points():
    cameras = [c for x in (-0.1, 0.1) for c in look_at_cameras([(x, 0, -4)], 40, target=(x, 0, 0))]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    for depth in (4, 8):
        result = forecast(cameras, points + np.array([0, 0, depth - 4]))
        assert result.spacing == pytest.approx(np.rad2deg(0.2 / depth), rel=0.1)
        assert result.overlap > 0.9


def test_forecast__sees_that_neighbours_share_little():
    cameras = look_at_cameras(arc(np.deg2rad([-6, -2, 2, 6]), 4), 4)
    spread = [
        look_at_cameras([camera.position], 4, target=(0.5 * i, 0, 0))[0]
        for i, camera in enumerate(cameras)
    ]
    result = forecast(spread, NO_POINTS)
    assert result.spacing < 5
    assert result.quality == "poor"
    assert result.sentence.endswith("They would be good if neighbours shared more.")


def test_overlaps__are_the_shares_of_an_image_that_each_camera_sees():
    wide, narrow = (look_at_cameras([(0, 0, -4)], fov)[0] for fov in (53.13, 28.07))
    away = look_at_cameras([(0, 0, -4)], 40, target=(0, 0, -8))[0]
    # Half the width and half the height.
    expected = [[1, 0.25, 0], [1, 1, 0], [0, 0, 1]]
    assert_allclose(overlaps([wide, narrow, away], np.zeros((1, 3))), expected, atol=0.01)
