"""The settings of the first frame that follow from the capture: its number of steps and its strength of dropping."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.fit.budget import steps_within
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.cross_validation import CrossValidation, cross_validate, trial_steps
from morgs_mi.fit.dropping import dropping_by_noise
from morgs_mi.fit.forecast import Forecast, forecast
from morgs_mi.losses.ssim import Target
from morgs_mi.render.config import RenderConfig

__all__ = ["FirstSettings", "first_settings"]


@dataclass(frozen=True)
class FirstSettings:
    """Settings of the first frame.

    Attributes:
        config: with a number of steps and a strength of dropping.
        expected: what to expect of views between the cameras; None for a single camera.
        steps_before: number of steps that cross-validation has made.
    """

    config: FitConfig
    expected: CrossValidation | Forecast | None
    steps_before: int = 0


def first_settings(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    images: Sequence[np.ndarray],
    masks: Sequence[np.ndarray | None],
    targets: Sequence[Target],
    points: np.ndarray,
    extent: float,
    config: FitConfig,
    render: RenderConfig,
    seed: Sequence[int],
    on_step: Callable[[int, int], None] | None = None,
) -> FirstSettings:
    """Return the settings of the first frame.

    Where cross-validation does not choose the strength of dropping, a forecast says what to expect of other views.

    Args:
        gaussians: the start.
        cameras: V views.
        images: their images [H, W, 3], uint8.
        masks: valid pixels of each [H, W], or None.
        targets: both, as the first frame is fitted to them.
        points: [P, 3] of the capture, world units.
        extent: of the scene in world units.
        config: settings of the fit.
        render: cut-offs.
        seed: of the trials.
        on_step: called with (steps of the trials done, steps of trials and first frame).
    """
    if config.first_frame_seconds is not None:
        steps = steps_within(
            config.first_frame_seconds, gaussians, cameras, targets, extent, config, render, [*seed, 1]
        )
        config = replace(config, first_frame_steps=steps)
    if config.dropping is not None or len(images) < config.cross_validation.min_views:
        dropping = dropping_by_noise(images) if config.dropping is None else config.dropping
        expected = forecast(cameras, points) if len(cameras) > 1 else None
        return FirstSettings(replace(config, dropping=dropping), expected)
    before = trial_steps(config) * len(config.cross_validation.candidates)
    tick = None if on_step is None else lambda done: on_step(done, before + config.planned_steps)
    found = cross_validate(gaussians, cameras, images, masks, extent, config, render, seed, tick)
    return FirstSettings(replace(config, dropping=found.best.dropping), found, before)
