"""The settings of the first frame that follow from its images: dropping, and the loss of noisy images."""

from __future__ import annotations

from dataclasses import dataclass, replace

from morgs_mi.core.progress import Progress
from morgs_mi.fit.cross_validation import CrossValidation, cross_validate, has_trials
from morgs_mi.fit.dropping import default_dropping
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.forecast import Forecast, forecast
from morgs_mi.fit.noise import is_noisy
from morgs_mi.fit.problem import FirstFrameProblem

__all__ = ["Expected", "FirstSettings", "first_settings"]

Expected = CrossValidation | Forecast


@dataclass(frozen=True)
class FirstSettings:
    """Settings of the first frame.

    Attributes:
        config: with a strength of dropping and the weights of the losses.
        expected: expected quality of views between the cameras; None for a single camera.
    """

    config: FitConfig
    expected: Expected | None


def first_settings(
    problem: FirstFrameProblem, config: FitConfig, seed: int, progress: Progress | None = None
) -> FirstSettings:
    """Return the settings of the first frame.

    The quality of views between the cameras is estimated by a trial without some of three views and more; where the
    strength of dropping is given, and of two views, it is a forecast.

    Args:
        problem: the data of the first frame.
        config: settings of the fit.
        seed: of the trials.
        progress: of the trials, a stage each.
    """
    if config.noise_aware and is_noisy(problem.images):
        config = replace(config, objective=replace(config.objective, dssim_weight=0.0))
    if has_trials(problem, config):
        found = cross_validate(problem, config, seed, progress)
        return FirstSettings(replace(config, dropping=found.best.dropping), found)
    if config.dropping is None:
        config = replace(config, dropping=default_dropping(problem))
    return FirstSettings(config, forecast(problem.cameras, problem.points) if len(problem.views) > 1 else None)
