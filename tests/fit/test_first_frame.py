"""The first frame: growth by density control, and the bands of the spherical harmonics."""

from __future__ import annotations

import dataclasses

import numpy as np

from morgs_mi import RenderConfig
from morgs_mi.fit.config import DensityConfig, FitConfig
from morgs_mi.fit.first_frame import density_rounds, fit_first_frame
from morgs_mi.losses.ssim import Target
from tests.scenes.ball import ball, images_of, mean_psnr, opaque_ball, views

RENDER, EXTENT = RenderConfig(), 3.0


def fit(images, start, config, seed=0):
    targets = [Target(image) for image in images]
    return fit_first_frame(start, views(), targets, EXTENT, config, RENDER, np.random.default_rng(seed))[0]


def test_fit_first_frame__grows_from_too_few():
    images, config = images_of(opaque_ball()), FitConfig(sh_degree=0, first_frame_steps=160, num_gaussians=250)
    few = fit(images, ball(60), dataclasses.replace(config, density=DensityConfig(rounds=0)))
    more = fit(images, ball(60), config)
    assert len(few) == 60
    assert 150 < len(more) <= 250
    assert mean_psnr(more, images) > mean_psnr(few, images) + 1


def test_fit_first_frame__adds_sh_bands_one_after_the_other():
    images = images_of(opaque_ball())
    for steps in (1, 40):
        found = fit(images, ball(50, sh_degree=3), FitConfig(sh_degree=3, first_frame_steps=steps))
        assert found.sh_degree == 3
    bands = np.abs(np.asarray(found.sh_coeffs)).mean(axis=(0, 2))
    assert bands[1:4].mean() > bands[4:9].mean() > bands[9:].mean() > 0


def test_density_rounds__lie_between_a_tenth_and_a_half():
    steps = density_rounds(FitConfig(first_frame_steps=1000, density=DensityConfig(rounds=5)))
    assert steps == [100, 200, 300, 400, 500]
    assert density_rounds(FitConfig(density=DensityConfig(rounds=0))) == []
