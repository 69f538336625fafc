"""The settings of the first frame that follow from the capture: steps, dropping, and the loss of noisy images."""

from __future__ import annotations

from dataclasses import dataclass, replace

from morgs_mi.core.progress import Progress
from morgs_mi.fit.budget import steps_within
from morgs_mi.fit.cross_validation import CrossValidation, candidates_of, cross_validate, trial_share
from morgs_mi.fit.dropping import dropping_by_noise
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.forecast import Forecast, forecast
from morgs_mi.fit.noise import is_noisy
from morgs_mi.fit.problem import FirstFrameProblem

__all__ = ["Expected", "FirstSettings", "first_settings"]

# Number of views from which one can be withheld.
_VALIDATED = 3

Expected = CrossValidation | Forecast


@dataclass(frozen=True)
class FirstSettings:
    """Settings of the first frame.

    Attributes:
        config: with a number of steps, a strength of dropping, and the weights of the losses.
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
    views, is_chosen = len(problem.views), config.dropping is None
    validated = is_chosen and views >= _VALIDATED
    if config.first_frame_seconds is not None:
        trials = len(candidates_of(problem, config)) * trial_share(config) if validated else 0
        steps = steps_within(config.first_frame_seconds, problem, config, trials, seed)
        config = replace(config, first_frame_steps=steps)
    if validated:
        found = cross_validate(problem, config, seed, progress)
        return FirstSettings(replace(config, dropping=found.best.dropping), found)
    if is_chosen:
        config = replace(config, dropping=dropping_by_noise(problem.images))
    return FirstSettings(config, forecast(problem.cameras, problem.points) if views > 1 else None)
