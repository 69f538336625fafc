"""The settings of the first frame that follow from the capture: steps, dropping, and the loss of noisy images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.fit.agreement import NUM_FITS, Agreement, compare_fits
from morgs_mi.fit.budget import planned_trials, steps_within
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.cross_validation import CrossValidation, cross_validate, trial_steps
from morgs_mi.fit.dropping import dropping_by_noise
from morgs_mi.fit.forecast import Forecast, forecast
from morgs_mi.fit.noise import is_noisy
from morgs_mi.fit.view import View
from morgs_mi.render.config import RenderConfig

__all__ = ["Expected", "FirstSettings", "first_settings"]

Expected = CrossValidation | Agreement | Forecast


@dataclass(frozen=True)
class FirstSettings:
    """Settings of the first frame.

    Attributes:
        config: with a number of steps, a strength of dropping, and the weights of the losses.
        expected: what to expect of views between the cameras; None for a single camera or a single Gaussian.
        steps_before: number of steps that trials have made.
    """

    config: FitConfig
    expected: Expected | None
    steps_before: int = 0


def first_settings(
    gaussians: Gaussians,
    views: Sequence[View],
    points: np.ndarray,
    extent: float,
    config: FitConfig,
    render: RenderConfig,
    seed: int,
    on_step: Callable[[int, int], None] | None = None,
) -> FirstSettings:
    """Return the settings of the first frame.

    What to expect of other views follows from cross-validation or, for fewer than `min_views`, from the comparison of
    two fits; where the strength of dropping is given, from a forecast.

    Args:
        gaussians: the start.
        views: V views.
        points: [P, 3] of the capture, world units.
        extent: of the scene in world units.
        config: settings of the fit.
        render: cut-offs.
        seed: of the trials.
        on_step: called with (steps of the trials done, steps of trials and first frame).
    """
    cameras, images = [view.camera for view in views], [view.image for view in views]
    if config.noise_aware and is_noisy(images):
        config = replace(config, objective=replace(config.objective, dssim_weight=0.0))
    if config.first_frame_seconds is not None:
        targets = [view.target for view in views]
        steps = steps_within(config.first_frame_seconds, gaussians, cameras, targets, extent, config, render, seed)
        config = replace(config, first_frame_steps=steps)
    if config.dropping is not None:
        return FirstSettings(config, forecast(cameras, points) if len(cameras) > 1 else None)
    before = trial_steps(config) * planned_trials(config, len(cameras))

    def tick(done: int) -> None:
        if on_step is not None:
            on_step(done, before + config.planned_steps)

    if len(cameras) >= config.cross_validation.min_views:
        found = cross_validate(gaussians, views, extent, config, render, seed, tick)
        return FirstSettings(replace(config, dropping=found.best.dropping), found, before)
    config, found = replace(config, dropping=dropping_by_noise(images)), None
    if len(cameras) > 1 and len(gaussians) >= NUM_FITS:
        found = compare_fits(gaussians, views, extent, config, render, seed, tick)
    return FirstSettings(config, found, before)
