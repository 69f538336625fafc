"""Settings of the first frame that follow from its images."""

from __future__ import annotations

from dataclasses import replace

import pytest

from morgs_mi.core.progress import Progress
from morgs_mi.fit.cross_validation import CrossValidation
from morgs_mi.fit.dropping import default_dropping
from morgs_mi.fit.first_settings import first_settings
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.forecast import Forecast
from tests.scenes.ball import bytes_of, images_of, opaque_ball, problem

CONFIG = FitConfig(sh_degree=0, first_frame_steps=5, num_gaussians=80, dropping=0.0)
CHOOSING = replace(CONFIG, dropping=None)
GREY = [0.2 + 0.6 * image for image in images_of(opaque_ball())]


def settings(config: FitConfig, views: int = 4, noise: float = 0.0, report=None):
    return first_settings(problem(bytes_of(GREY[:views], noise)), config, 0, Progress(report))


def dssim_weight(noise: float, config: FitConfig = CONFIG) -> float:
    """Return the weight of D-SSIM for images with noise, relative to white."""
    found = settings(config, noise=noise)
    assert replace(found.config, objective=config.objective) == config
    return found.config.objective.dssim_weight


def test_first_settings__leave_dssim_out_for_noisy_images():
    assert dssim_weight(0.0) == CONFIG.objective.dssim_weight == 0.2
    assert dssim_weight(0.008) == 0.2
    assert dssim_weight(0.025) == 0


def test_first_settings__keep_the_weights_unless_noise_aware():
    assert dssim_weight(0.025, replace(CONFIG, noise_aware=False)) == 0.2


@pytest.mark.parametrize(
    ("views", "expected", "stages"),
    [(1, None, set()), (2, Forecast, set()), (3, CrossValidation, {"Trial"}), (4, CrossValidation, {"Trial"})],
)
def test_first_settings__withhold_a_view_of_three_and_more(views: int, expected, stages):
    reported = set()
    found = settings(CHOOSING, views, report=lambda stage, *_: reported.add(stage))
    assert type(found.expected) is (expected or type(None))
    assert found.config == replace(CHOOSING, dropping=default_dropping(problem(GREY[:views])))
    assert reported == stages


def test_first_settings__choose_the_dropping_with_the_best_withheld_views(monkeypatch):
    monkeypatch.setattr("morgs_mi.fit.cross_validation.MANY_VIEWS", 4)
    config = replace(CHOOSING, first_frame_steps=60, validate=True)
    stages = []
    found = settings(config, report=lambda stage, *_: stages.append(stage))
    assert isinstance(found.expected, CrossValidation)
    assert found.config.dropping == found.expected.best.dropping
    assert set(stages) == {f"Trial {number} of 3" for number in range(1, len(found.expected.trials) + 1)}


@pytest.mark.parametrize("views", [1, 2, 4])
def test_first_settings__let_noise_choose_the_dropping(views: int):
    assert settings(CHOOSING, views).config.dropping == 0
    assert settings(CHOOSING, views, 0.05).config.dropping == 0.2


def test_first_settings__keep_a_given_dropping_without_trials():
    stages = []
    found = settings(replace(CONFIG, dropping=0.1), report=lambda stage, *_: stages.append(stage))
    assert found.config.dropping == 0.1
    assert isinstance(found.expected, Forecast)
    assert not stages


def test_forecast__bounds_the_quality_by_the_training_views():
    found = settings(CHOOSING, 2).expected
    assert found is not None
    assert "at most" not in found.sentence
    fitted = replace(found, training_psnr=31.2)
    assert fitted.sentence.endswith("% of what they see. They have at most 31 dB.")
    assert fitted.expected_psnr is None
