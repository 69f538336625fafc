"""Statistics of a sweep: paired differences, what a scene needs, and the seconds for a quality.

Scores [A, S, N] are of A arms, S seeds and the N scores of `SCORES`; NaN where unknown. Fits with
the same seed continue the same first frame, unless their settings differ there, and run in turn.
Differences are therefore taken seed by seed before anything is averaged: what the first frame and
the load of the machine do to both of them cancels.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import itemgetter
from typing import NamedTuple

import numpy as np

DECIDING = ("psnr", "psnr_moving", "motion_error_moving", "kilobytes", "seconds")
"""Scores by which a part of the method is needed; seconds are the last."""
COST_TOLERANCE = 0.05
"""Share by which seconds, motion error and bytes may grow without a part that is not needed."""
# Standard errors that a change must exceed.
_ERRORS = 2
# Least degrees of freedom of the noise that the seconds of all arms have in common.
_FREE = 4
# About as many round values are reported.
_LEVELS = 4


class Score(NamedTuple):
    """A score of a fit."""

    title: str  #: Its name.
    unit: str  #: Its unit; of some there is none.
    digits: int  #: After the point.
    gain: int  #: 1: larger is better; -1: smaller is.

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.title}, {self.unit}".removesuffix(", ")


SCORES = {
    "first_seconds": Score("first frame", "s", 1, -1),
    "seconds": Score("later frame", "s", 2, -1),
    "psnr": Score("PSNR", "dB", 2, 1),
    "psnr_moving": Score("moving PSNR", "dB", 2, 1),
    "ssim": Score("SSIM", "", 4, 1),
    "lpips": Score("LPIPS", "", 4, -1),
    "motion_error_moving": Score("motion error", "px", 2, -1),
    "kilobytes": Score("size", "kB", 1, -1),
}
"""Scores of a fit by name: wall seconds of the first frame and of a later one; PSNR of the images
and of moving pixels; SSIM; LPIPS; endpoint error of the motion where surfaces move; kilobytes of a
frame. Means over the frames.
"""
INDEX = {name: k for k, name in enumerate(SCORES)}
"""Their places in an array of scores."""
DECIDING_INDICES = list(itemgetter(*DECIDING)(INDEX))
"""Their places in an array of scores."""


class Means(NamedTuple):
    """Means over the seeds for each arm and score [A, N]; NaN where unknown."""

    mean: np.ndarray  #: The means.
    error: np.ndarray  #: Their standard errors; NaN of fewer than two seeds.


def mean_of(values: np.ndarray) -> Means:
    """Return the means of values [A, S, N] over the seeds that have them."""
    numbers = np.ma.masked_invalid(values)
    count = numbers.count(1)
    deviation = np.ma.masked_where(count < 2, numbers.std(1, ddof=1))
    error = deviation / np.sqrt(np.maximum(count, 1))
    return Means(numbers.mean(1).filled(np.nan), error.filled(np.nan))


def excess(
    scores: np.ndarray, reference: np.ndarray, calls: np.ndarray, tolerance: float
) -> np.ndarray:
    """Return by how many times each arm's losses exceed their bounds [A, D], in the order of
    `DECIDING`: what an arm lacks is needed because of each score where that is above 1. NaN where
    it is unknown.

    The loss of a score is the mean over the seeds of the paired difference from the arm with all
    parts. Its bound is the tolerance, or twice the standard error of that mean if that is larger.
    With one seed there is no standard error, and the tolerance alone is the bound.

    Seconds depend on all that runs beside a fit, so they are compared as ratios, and only between
    fits that ran in turn. The standard error of an arm alone is too uncertain for them: of arms
    without any effect, 15 % exceed twice their own with two seeds, 9 % with three. It is therefore
    at least the one that the noise of all arms together gives, after the means of each arm and of
    each seed: 2 to 3 % exceed that. With one seed, or with few arms, seconds do not decide.

    Args:
        scores: [A, S, N].
        reference: index [A] of the arm with all parts that each arm is compared with; first of all
            the first one, and of such an arm its own.
        calls: [A, S], equal where fits ran in turn.
        tolerance: of PSNR, dB; of all others it is `COST_TOLERANCE`.
    """
    gains = np.array([SCORES[name].gain for name in DECIDING])
    values = scores[..., DECIDING_INDICES]
    with np.errstate(invalid="ignore", divide="ignore"):
        differences = gains * (values[reference] - values)
        shares = differences / mean_of(values).mean[reference][:, None]
        losses = np.where(gains > 0, differences, shares)
        ratios = np.log(values[..., -1] / values[reference][..., -1])
        losses[..., -1] = np.where(calls == calls[reference], ratios, np.nan)
        loss, error = mean_of(losses)
        error[:, -1] = np.maximum(error[:, -1], _common_error(losses[..., -1], reference))
        bounds = np.fmax(np.where(gains > 0, tolerance, COST_TOLERANCE), _ERRORS * error)
        # Without a standard error, seconds do not decide.
        bounds[:, -1] += 0 * error[:, -1]
        return loss / bounds


def _common_error(ratios: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the standard error of the mean logarithm of a ratio of seconds [A, S] for each arm, by
    the noise that all arms beside the first one have in common; NaN if it is known too roughly.
    """
    parts = np.ma.masked_invalid(ratios[1:][reference[1:] == 0])
    residuals = parts - parts.mean(1, keepdims=True)
    residuals -= residuals.mean(0)
    free = parts.count() - sum(parts.shape) + 1
    # The variance of one fit's seconds: those of the first arm, which all ratios share, went with
    # the means of the seeds. A ratio has the noise of two fits.
    variance = (residuals**2).sum() / free if free >= _FREE else np.nan
    count = np.isfinite(ratios).sum(1)
    return np.sqrt(2 * variance / np.maximum(count, 1))


def level_lines(title: str, curves: Mapping[str, np.ndarray], score: Score) -> list[str]:
    """Return a line for each round value that some curves cross, with the seconds of each curve.

    Args:
        title: what was fitted.
        curves: seconds and scores [2, P] of the points of a curve, from the cheapest on, by its
            name.
        score: what they show.
    """
    values = np.concatenate([np.zeros(0), *(y for _, y in curves.values())])
    lines = []
    for level in round_levels(values[np.isfinite(values)]):
        times = ", ".join(
            f"{name} {seconds_for(level, x, y, score.gain)}" for name, (x, y) in curves.items()
        )
        lines.append(f"{title}, {level:.4g} {score.unit or score.title}: {times}")
    return lines


def round_levels(values: np.ndarray) -> np.ndarray:
    """Return round values, 1, 2 or 5 times a power of ten apart, between the least and the largest
    of some numbers; none if all are equal.
    """
    low = values.min(initial=np.inf)
    high = values.max(initial=-np.inf)
    if not high > low:
        return np.zeros(0)
    least = (high - low) / _LEVELS
    steps = 10 ** np.floor(np.log10(least)) * np.array([1, 2, 5, 10])
    step = steps[np.searchsorted(steps, least)]
    return step * np.arange(np.ceil(low / step), np.floor(high / step) + 1)


def seconds_for(level: float, seconds: np.ndarray, values: np.ndarray, gain: int) -> str:
    """Return in words when a curve first reaches a value, interpolated in the logarithm of the
    seconds.

    Args:
        level: the value.
        seconds: of the points of the curve [P], from the cheapest on.
        values: at the points [P].
        gain: 1 if larger values are better, -1 if smaller ones are.
    """
    distances = gain * (values - level)
    k = int(np.argmax(distances >= 0))
    if not distances[k] >= 0:
        return "not reached"
    if k == 0:
        return f"at most {seconds[0]:.3g} s"
    segment = slice(k - 1, k + 1)
    logarithm = np.interp(0, distances[segment], np.log(seconds[segment]))
    return f"{np.exp(logarithm):.3g} s"
