"""The number of steps of the first frame within a time budget, from the speed of a few steps on this machine."""

from __future__ import annotations

import time
from dataclasses import replace

from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.fit.first_frame import fit_first_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.problem import FirstFrameProblem

__all__ = ["steps_within"]

# Steps that are timed, and the least number that a first frame gets.
_TIMED, _LEAST = 20, 100
# Mean time of a step relative to the first steps; density control later doubles the number of Gaussians.
_GROWTH = 1.5


def steps_within(seconds: float, problem: FirstFrameProblem, config: FitConfig, trials: float, seed: int) -> int:
    """Return the number of steps of the first frame, at least 100, that this machine makes in a time.

    The time of the measurement and of the trials is part of it. The same number as `first_frame_steps` gives the
    same result on any machine.

    Args:
        seconds: the time.
        problem: the data of the first frame.
        config: settings of the fit.
        trials: steps of the trials before the first frame, at most, as a multiple of its own.
        seed: of the steps that are timed.
    """
    begin = time.perf_counter()
    timed = replace(config, first_frame_steps=_TIMED, dropping=0.0, density=replace(config.density, rounds=0))
    took = 0.0
    for _ in range(2):  # the first time, kernels are compiled
        start = time.perf_counter()
        fit_first_frame(problem, timed, rng_of(seed, Stream.BUDGET))
        took = time.perf_counter() - start
    per_step = _GROWTH * took / _TIMED * (1 + trials)
    return max(_LEAST, int((seconds - (time.perf_counter() - begin)) / per_step))
