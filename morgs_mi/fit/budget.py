"""The plan of the first frame: as many Gaussians and steps as its images ask for and its time allows.

The images ask for a number of Gaussians (see `detail`), and these for a number of steps (`FitConfig.planned_steps`).
Where that would take longer than `FitConfig.first_frame_seconds`, both are reduced: the Gaussians by the square root of
the share that the time allows, and the steps by the rest. Numbers that are given stay as they are.

The time of a step is proportional to

    number of Gaussians + 0.45 number of pixels,

as measured on two cores with 20,000 to 240,000 Gaussians and images of 160x120 to 706x529. A few steps on this machine
give the factor, in reproducible fits a reference machine. On a CPU they are timed by its processor time over all
threads: other programs delay a fit, and do not make it worse. Where the time does not limit the plan, the clock has no
influence on the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import sqrt
from time import perf_counter, process_time

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.fit.cross_validation import trial_steps
from morgs_mi.fit.detail import with_num_gaussians
from morgs_mi.fit.first_frame import LAST_ROUND, fit_first_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.initialise import Points
from morgs_mi.fit.problem import FirstFrameProblem
from morgs_mi.fit.view import View
from morgs_mi.render.render_config import RenderConfig

__all__ = ["Plan", "plan_first_frame"]

# Time of a pixel relative to the time of a Gaussian.
_PIXEL = 0.45
# Seconds per Gaussian and step of the reference machine, two cores of a server.
_REFERENCE = 2.5e-7
# Steps that are timed, without as many before them, in as many views; and the least number that a time leaves.
_TIMED, _VIEWS, _LEAST = 12, 4, 100
# Mean number of Gaussians while it grows from a half to all, relative to all.
_GROWING = 0.75


@dataclass(frozen=True)
class Plan:
    """Gaussians and steps of a first frame.

    Attributes:
        config: settings with both numbers.
        seconds: expected time of the first frame with its trials; None if both numbers were given.
    """

    config: FitConfig
    seconds: float | None = None

    @property
    def stage(self) -> str:
        """Name of the stage in which the first frame is fitted, with its time."""
        return "First frame" if self.seconds is None else f"First frame, about {max(self.seconds, 1):.0f} s"


def plan_first_frame(views: Sequence[View], points: Points, config: FitConfig, render: RenderConfig, seed: int) -> Plan:
    """Return the plan of a first frame.

    Args:
        views: V views, at least one.
        points: P points and their colours; P may be 0.
        config: settings of the fit.
        render: cut-offs.
        seed: of the steps that are timed.
    """
    if None not in (config.num_gaussians, config.first_frame_steps):
        return Plan(config)
    begin, wanted = _clock(), with_num_gaussians(config, views, points[0])
    problem = FirstFrameProblem.of(views, points, wanted, render, rng_of(seed, Stream.BUDGET))
    unit, left = _REFERENCE, config.first_frame_seconds
    if not render.reproducible:
        unit = _measured_unit(problem, wanted, seed)
        left -= _clock() - begin
    unit *= 1 + trial_steps(problem, wanted)
    plan, share = wanted, max(left, 0) / (unit * _work(problem, wanted))
    if share < 1 and config.num_gaussians is None:
        count = wanted.planned_gaussians
        least = min(config.detail.least_gaussians, count)
        plan = replace(wanted, num_gaussians=max(round(sqrt(share) * count), least))
    if config.first_frame_steps is None:
        allowed = int(plan.planned_steps * left / (unit * _work(problem, plan)))
        plan = replace(plan, first_frame_steps=max(_LEAST, min(plan.planned_steps, allowed)))
    return Plan(plan, unit * _work(problem, plan))


def _clock() -> float:
    """Return seconds of processor time over all threads, or of a clock where a GPU computes."""
    is_cpu = dr.backend_v(mi.Float) == dr.JitBackend.LLVM
    return process_time() / dr.thread_count() if is_cpu else perf_counter()


def _work(problem: FirstFrameProblem, config: FitConfig) -> float:
    """Return the time of a first frame relative to the time of a step of a Gaussian."""
    count, steps = config.planned_gaussians, config.planned_steps
    all_pixels = count + _PIXEL * _pixels(problem)
    if not config.density.rounds:
        return steps * all_pixels
    growing = _GROWING * count + _PIXEL * _pixels(problem.halved())
    return steps * (LAST_ROUND * growing + (1 - LAST_ROUND) * all_pixels)


def _pixels(problem: FirstFrameProblem) -> float:
    """Return the mean number of pixels of a view."""
    return float(np.mean([camera.width * camera.height for camera in problem.cameras]))


def _measured_unit(problem: FirstFrameProblem, config: FitConfig, seed: int) -> float:
    """Return the seconds of a step on this machine relative to its work."""
    timed = replace(config, dropping=0.0, density=replace(config.density, rounds=0))
    some, ends = problem.only(range(min(_VIEWS, len(problem.views)))), [_clock()]
    for steps in (_TIMED, _TIMED, 2 * _TIMED):  # the first time, kernels are compiled
        fit_first_frame(some, replace(timed, first_frame_steps=steps), rng_of(seed, Stream.BUDGET))
        ends.append(_clock())
    _, less, more = np.diff(ends)
    work = _work(some, replace(timed, first_frame_steps=_TIMED, num_gaussians=len(problem.start)))
    return float(max(more - less, 0.1 * less)) / work
