"""Forecast of views between the cameras of a fitted first frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi import RenderConfig
from morgs_mi.fit.forecast import Forecast
from morgs_mi.fit.unseen_views import REGRESSION, Regression, UnseenViews, features_of, unseen_views
from morgs_mi.fit.view import View
from tests.scenes.ball import ball, bytes_of, images_of, opaque_ball, problem, views
from tests.scenes.cameras import look_at_cameras

NO_POINTS = np.zeros((0, 3))
RIG = Forecast(cameras=8, spacing=8.0, overlap=0.9, reach=9.0)
IMAGES = bytes_of(images_of(opaque_ball()))


def features(gaussians, images=IMAGES, masks=(None,) * 4, cameras=None) -> tuple[float, float]:
    """Return the disagreement and the training PSNR of the four views."""
    view_tuple = tuple(map(View, cameras or views(), images, masks))
    return features_of(gaussians, view_tuple, NO_POINTS, RenderConfig())


def squares(gaussians, *args, **kwargs) -> float:
    """Return the mean least square difference of the training views from the others."""
    disagreement, psnr = features(gaussians, *args, **kwargs)
    return (10 ** (disagreement / 10) - 1) * 10 ** (-psnr / 10)


def test_features_of__is_small_where_the_surfaces_are_right():
    shifted = replace(opaque_ball(), means=np.asarray(opaque_ball().means) + np.array([0, 0, 0.3]))
    assert squares(opaque_ball()) < 0.6 * squares(shifted)


def test_features_of__measures_the_training_views():
    disagreement, psnr = features(ball(80))
    assert psnr == pytest.approx(problem(IMAGES).psnr(ball(80)))
    assert disagreement > 0


def test_features_of__ignores_masked_pixels():
    columns = np.arange(IMAGES[0].shape[1])
    spoiled = [np.where(columns[:, None] < 39, 255, image).astype(np.uint8) for image in IMAGES]
    masks = [np.broadcast_to(columns >= 40, image.shape[:2]) for image in IMAGES]
    clean = features(opaque_ball(), IMAGES, masks)
    np.testing.assert_allclose(features(opaque_ball(), spoiled, masks), clean, rtol=1e-6)
    assert features(opaque_ball(), spoiled)[1] < clean[1]


def test_features_of__counts_views_that_share_nothing_as_wrong():
    away = look_at_cameras([(0, 0, -4)], 40, target=(0, 0, -8))[0]
    cameras = [views()[0], away]
    assert squares(
        opaque_ball(), cameras=cameras, images=IMAGES[:2], masks=(None, None)
    ) == pytest.approx(1)


def test_Regression__widens_the_interval_outside_its_data():
    regression = Regression(1.0, (0.5, -0.1), (0.0, 20.0), (10.0, 40.0), 0.5)
    assert regression.loss((8.0, 30.0)) == 2
    assert regression.margin((8.0, 30.0)) == 1.5
    assert regression.loss((0.0, 30.0)) == 0, "there is no gain"
    assert regression.margin((0.0, 30.0)) == 0.5
    assert regression.margin((8.0, 41.0)) == 2 * 0.5 * (1 + regression.loss((8.0, 41.0)))
    assert not regression.is_outside((8.0, 30.0))
    assert all(map(regression.is_outside, [(11.0, 30.0), (8.0, 19.0)]))


@pytest.mark.parametrize(
    ("training_psnr", "loss", "margin", "is_outside", "sentence"),
    [
        (
            23.9,
            2.0,
            1.8,
            False,
            "fair: 22 dB in the mean, nine times in ten between 20 and 24; 8 cameras",
        ),
        (
            34.0,
            2.0,
            1.4,
            False,
            "good: 32 dB in the mean, nine times in ten between 31 and 33; 8 cameras",
        ),
        (
            34.0,
            9.0,
            2.9,
            False,
            "poor: 25 dB in the mean, nine times in ten between 22 and 28; 8 cameras",
        ),
        (
            34.0,
            2.0,
            2.4,
            True,
            "good: 32 dB in the mean, nine times in ten between 30 and 34, a wider range",
        ),
        (
            34.0,
            5.0,
            3.1,
            False,
            "fair: 8 cameras, 8 degrees apart, neighbours share 90 % of what they see. They have",
        ),
    ],
)
def test_sentence__has_a_number_where_the_interval_is_narrow(
    training_psnr, loss, margin, is_outside, sentence
):
    forecast = UnseenViews(RIG, training_psnr, loss, margin, is_outside)
    assert forecast.sentence.startswith(f"Views between the cameras will be {sentence}")
    assert (forecast.expected_psnr is None) == (forecast.interval is None) == (2 * margin > 6)


def test_sentence__has_the_word_by_the_angles_alone_where_they_are_wide():
    forecast = UnseenViews(replace(RIG, reach=40.0), 34.0, 2.0, 1.0)
    assert forecast.expected_psnr is None
    assert forecast.sentence.startswith("Views between the cameras will be poor: 8 cameras")
    assert forecast.sentence.endswith("They have at most 34 dB.")


def test_unseen_views__follow_from_the_features():
    forecast = unseen_views(problem(IMAGES), ball(80))
    values = features(ball(80))
    assert (forecast.loss, forecast.margin) == (REGRESSION.loss(values), REGRESSION.margin(values))
    assert forecast.training_psnr == values[1]
    assert forecast.rig.cameras == 4
