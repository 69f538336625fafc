"""The first frame: growth by density control, and the bands of the spherical harmonics."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from morgs_mi.core.progress import Progress
from morgs_mi.fit.config import ConvergenceConfig, DensityConfig, FitConfig
from morgs_mi.fit.first_frame import density_rounds, fit_first_frame
from tests.scenes.ball import ball, images_of, mean_psnr, opaque_ball, problem


def fit(images, start, config, seed=0):
    return fit_counted(images, start, config, seed).gaussians


def fit_counted(images, start, config, seed=0, progress=None):
    return fit_first_frame(problem(images, start), config, np.random.default_rng(seed), progress)


def test_fit_first_frame__grows_from_too_few():
    images, config = images_of(opaque_ball()), FitConfig(sh_degree=0, first_frame_steps=160, num_gaussians=250)
    few = fit(images, ball(60), dataclasses.replace(config, density=DensityConfig(rounds=0)))
    more = fit(images, ball(60), config)
    assert len(few) == 60
    assert 150 < len(more) <= 250
    assert mean_psnr(more, images) > mean_psnr(few, images) + 1


UNTIL_CONVERGED = FitConfig(sh_degree=0, num_gaussians=300, convergence=ConvergenceConfig(steps=60, most_steps=150))


def test_fit_first_frame__doubles_its_steps_while_the_loss_falls():
    images, done = images_of(opaque_ball()), []
    progress = Progress(lambda *steps: done.append(steps), "First frame")
    found = fit_counted(images, ball(150), UNTIL_CONVERGED, progress=progress)
    assert found.steps == 150
    totals = [60] * 60 + [120] * 60 + [150] * 30
    assert done == [("First frame", *steps) for steps in enumerate(totals, 1)]
    few = fit(images, ball(150), dataclasses.replace(UNTIL_CONVERGED, first_frame_steps=60))
    assert mean_psnr(found.gaussians, images) > mean_psnr(few, images) + 3


def test_fit_first_frame__ends_where_only_noise_is_left():
    rng = np.random.default_rng(0)
    noisy = [np.clip(image + rng.normal(0, 0.3, image.shape), 0, 1) for image in images_of(opaque_ball())]
    assert fit_counted(noisy, ball(150), UNTIL_CONVERGED).steps == 60


def test_fit_first_frame__has_the_steps_that_are_given():
    config = dataclasses.replace(UNTIL_CONVERGED, first_frame_steps=20)
    assert fit_counted(images_of(opaque_ball()), ball(150), config).steps == 20


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": 0}, "`steps` must be 1 to `most_steps` = 6000, got 0"),
        ({"steps": 200, "most_steps": 100}, "`steps` must be 1 to `most_steps` = 100, got 200"),
        ({"least_decrease": 0.0}, "`least_decrease` must be above 0 and at most 1, got 0.0"),
    ],
)
def test_convergence_config__names_bad_values(arguments, message):
    with pytest.raises(ValueError, match=message):
        ConvergenceConfig(**arguments)
