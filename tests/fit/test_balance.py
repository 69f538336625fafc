"""Balance of cameras with different exposures, against the exposures applied to the images."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi import RenderConfig, rasterize
from morgs_mi.core.color_space import decode_light, encode_light
from morgs_mi.core.rig import scene_extent
from morgs_mi.core.view import View
from morgs_mi.fit.balance import balance_cameras, short_fit_config
from morgs_mi.fit.fit_config import FitConfig, ShortFitConfig
from morgs_mi.fit.initialise import FirstFrameProblem
from morgs_mi.platform.progress import Progress
from tests.scenes.cameras import QUAD, look_at_cameras
from tests.scenes.gaussians import isotropic

RENDER = RenderConfig()
CAMERAS = look_at_cameras(QUAD, 50, 96, 72)
# Factors on the light; their mean logarithm is 0, as in the result.
GAINS = np.exp([0.24, -0.24, 0.12, -0.12])
TONES = np.array([0.3, 0.5, 0.7])[:, None]
FIT = FitConfig(exposure="auto", short_fits=ShortFitConfig(gaussians=400, steps=100, rounds=6))


def scene():
    """A textured wall; all Gaussians are seen by all cameras."""
    rng = np.random.default_rng(0)
    return isotropic(
        rng.uniform((-2.4, -2.0, 0.6), (2.4, 2.0, 1.2), (400, 3)),
        0.16,
        0.95,
        rng.uniform(-1.0, 1.0, (400, 1, 3)),
    )


def exposed(colors, gain):
    return encode_light(np.clip(gain * decode_light(colors), 0, 1))


def images(cameras, gains):
    rendered = [np.asarray(rasterize(scene(), camera, ("color",)).color) for camera in cameras]
    return [
        np.rint(255 * exposed(image.clip(0, 1), g)).astype(np.uint8)
        for g, image in zip(gains, rendered, strict=True)
    ]


def balanced(gains, config=FIT, report=None):
    start = replace(scene(), sh_coeffs=0.8 * scene().sh_coeffs)  # colours of points are about right
    views = tuple(View(*view) for view in zip(CAMERAS, images(CAMERAS, gains), strict=True))
    problem = FirstFrameProblem(start, views, np.zeros((0, 3)), scene_extent(CAMERAS), RENDER)
    return balance_cameras(problem, config, 0, Progress(report))


@pytest.mark.slow
def test_balance_cameras__finds_the_exposures_and_takes_them():
    balance = balanced(GAINS)
    for exposure, gain in zip(balance.exposures, GAINS, strict=True):
        # A tenth of the largest change of a tone, 0.075, is left.
        assert_allclose(exposure(TONES), np.repeat(exposed(TONES, gain), 3, axis=1), atol=0.007)
    assert balance.taken
    assert balance.balanced_psnr > balance.recorded_psnr + 5
    assert "The cameras were balanced" in balance.sentence


@pytest.mark.slow
def test_balance_cameras__leaves_equal_cameras_alone_after_one_fit():
    fits = []
    balance = balanced(np.ones(4), report=lambda *state: fits.append(state))
    assert not balance.taken
    assert max(exposure.change for exposure in balance.exposures) < 0.003
    assert fits[0] == ("Balancing cameras", 0, 8)
    assert fits[-1] == ("Balancing cameras", 1, 8)
    assert fits == sorted(fits)
    assert "stay as recorded" in balance.sentence


@pytest.mark.slow
def test_balance_cameras__judges_by_withheld_pixels(monkeypatch):
    scores = iter((25.0, 25.05))
    monkeypatch.setattr("morgs_mi.fit.balance.mean_psnr", lambda *_: next(scores))
    balance = balanced(GAINS)
    assert not balance.taken
    assert (
        "balanced ones are no clear gain, withheld pixels have 25.05 dB instead of 25.00 dB"
        in balance.sentence
    )


def test_short_fit_config__takes_at_most_a_quarter_of_the_steps_of_the_first_frame():
    assert short_fit_config(FIT).first_frame_steps == 100
    assert short_fit_config(replace(FIT, first_frame_steps=40)).first_frame_steps == 10
    assert short_fit_config(replace(FIT, first_frame_steps=1)).first_frame_steps == 1
