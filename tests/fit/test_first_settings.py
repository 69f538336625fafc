"""Settings of the first frame that follow from its images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from morgs_mi import RenderConfig
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.first_settings import first_settings
from morgs_mi.fit.view import View
from tests.scenes.ball import ball, images_of, opaque_ball, views

CONFIG = FitConfig(sh_degree=0, first_frame_steps=5, num_gaussians=80, dropping=0.0)


def dssim_weight(noise: float, config: FitConfig = CONFIG) -> float:
    """Return the weight of D-SSIM for images with noise, relative to white."""
    rng = np.random.default_rng(0)
    grey = [0.2 + 0.6 * image + rng.normal(0, noise, image.shape) for image in images_of(opaque_ball())]
    images = [np.uint8(np.clip(255 * image + 0.5, 0, 255)) for image in grey]
    given = [View(*view) for view in zip(views(), images, strict=True)]
    found = first_settings(ball(80), given, np.zeros((0, 3)), 3.0, config, RenderConfig(), 0)
    assert replace(found.config, objective=config.objective) == config
    return found.config.objective.dssim_weight


def test_first_settings__leave_dssim_out_for_noisy_images():
    assert dssim_weight(0.0) == CONFIG.objective.dssim_weight == 0.2
    assert dssim_weight(0.008) == 0.2
    assert dssim_weight(0.025) == 0


def test_first_settings__keep_the_weights_unless_noise_aware():
    assert dssim_weight(0.025, replace(CONFIG, noise_aware=False)) == 0.2
