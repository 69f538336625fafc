"""Comparing two fits where none of a few views can be withheld."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi import RenderConfig, rasterize
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.fit import agreement
from morgs_mi.fit.agreement import Agreement, compare_fits, views_between
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.cross_validation import trial_steps
from morgs_mi.fit.first_frame import FirstFrame
from morgs_mi.fit.view import View
from tests.scenes.ball import ball, images_of, opaque_ball, views
from tests.scenes.cameras import arc, look_at_cameras

CONFIG = FitConfig(sh_degree=0, first_frame_steps=25, num_gaussians=150)


def bytes_of(gaussians):
    return [(255 * image + 0.5).astype(np.uint8) for image in images_of(gaussians)]


def views_with(images):
    return [View(camera, image) for camera, image in zip(views(), images, strict=True)]


def compare(start, on_step=None, seed=0):
    images = bytes_of(opaque_ball())
    render = RenderConfig(reproducible=True)
    return compare_fits(start, views_with(images), 3.0, CONFIG, render, seed, on_step)


def test_views_between__lie_halfway_between_neighbours():
    cameras = look_at_cameras(arc(np.deg2rad([-20, 0, 30]), 4), 40)
    angles, between = views_between(cameras, np.zeros((0, 3)))
    np.testing.assert_allclose(angles, [20, 20, 30], atol=1e-6)
    assert len(between) == 2
    for view, degrees in zip(between, (-10, 15), strict=True):
        (expected,) = look_at_cameras(arc([np.deg2rad(degrees)], 4), 40)
        np.testing.assert_allclose(view.viewmat[:3, :3], expected.viewmat[:3, :3], atol=1e-6)
        np.testing.assert_allclose(view.viewmat[:2, 3], 0, atol=1e-6)
        assert 3.5 < view.viewmat[2, 3] < 4


def test_compare_fits__is_the_same_every_time():
    done = []
    first, second = compare(ball(80), on_step=done.append), compare(ball(80))
    assert first == second != compare(ball(80), seed=1)
    assert done == list(range(1, 2 * trial_steps(CONFIG) + 1))


def test_compare_fits__measures_the_difference_between_the_cameras(monkeypatch: pytest.MonkeyPatch):
    fits = [ball(400), opaque_ball()]
    given = iter(fits)
    monkeypatch.setattr(agreement, "fit_first_frame", lambda *_: FirstFrame(next(given), {}, 1))
    found = compare_fits(ball(80), views_with(bytes_of(fits[1])), 3.0, CONFIG, RenderConfig(), 0)
    _, between = views_between(views(), np.asarray(ball(80).means))
    shown = [[np.asarray(rasterize(fit, view, ("color",)).color) for view in between] for fit in fits]
    expected = [psnr(*pair) for pair in zip(*shown, strict=True)]
    np.testing.assert_allclose(found.differences, expected, atol=1e-3)
    assert found.expected_psnr < min(found.training_psnr, max(expected) + 3.01)


def test_expected_psnr__adds_half_the_difference_and_the_error():
    # 0.5 * 2e-3 + 1e-3 and 0.5 * 0.4e-3 + 1e-3
    found = Agreement(4, 30.0, (26.9897, 33.9794), 30.0)
    assert found.expected_psnr == pytest.approx((26.9897 + 29.2082) / 2, abs=1e-3)


@pytest.mark.parametrize(
    ("difference", "training", "expected", "poor"), [(33, 36, 33, False), (18, 20, 17, True), (23, 36, 26, True)]
)
def test_sentence__says_what_to_expect(difference: float, training: float, expected: int, poor: bool):
    sentence = Agreement(4, 30.0, (difference,), training).sentence
    assert f"about {expected} dB" in sentence
    assert ("will be poor" in sentence) == poor
    assert ("30 degrees apart" in sentence) == poor
