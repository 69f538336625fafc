"""The plan of the first frame: as many Gaussians and steps as its images ask for and its time allows.

The images ask for a number of Gaussians (see `detail`), and these for a number of steps (`FitConfig.planned_steps`).
Where that would take longer than `FitConfig.first_frame_seconds`, the most Gaussians are chosen whose own number of
steps fits the time. An eighth of those that the images ask for is the least, because pixels take time as well: from
there on, the steps are reduced. Numbers that are given stay as they are.

The time of a step is modelled as

    a number of Gaussians + b number of pixels.

Steps with the Gaussians that the images ask for, at full and at half the resolution, give both factors; reproducible
fits have the factors of a reference machine. On a CPU, steps are timed by its processor time over all threads: other
programs delay a fit, and do not make it worse. Where the time does not limit the plan, the clock has no influence on
the result.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter, process_time

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.progress import Progress
from morgs_mi.core.random_streams import Stream, rng_of
from morgs_mi.fit.detail import with_num_gaussians
from morgs_mi.fit.first_frame import LAST_ROUND, fit_first_frame
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.initialise import Points
from morgs_mi.fit.problem import FirstFrameProblem
from morgs_mi.fit.view import View
from morgs_mi.render.render_config import RenderConfig

__all__ = ["Plan", "plan_first_frame"]

# Steps that compile kernels, steps that are timed, and their views; the least number of steps that a time leaves.
_WARM, _TIMED, _VIEWS, _LEAST = 6, 12, 4, 100
# The Gaussians that the images ask for, relative to the least that a time leaves.
_LEAST_SHARE = 8
# Mean number of Gaussians while it grows from a half to all, relative to all.
_GROWING = 0.75


@dataclass(frozen=True)
class _Work:
    """What a first frame works on.

    Attributes:
        pixels: mean number of pixels of a view.
        half_pixels: the same at half the size, up to the last round of density control.
        views: number of views.
    """

    pixels: float
    half_pixels: float
    views: int

    @classmethod
    def of(cls, problem: FirstFrameProblem) -> _Work:
        """Return the work of a problem."""
        return cls(_pixels(problem), _pixels(problem.halved()), len(problem.views))


@dataclass(frozen=True)
class _StepTime:
    """Time of a step, s: per Gaussian and per pixel of its view."""

    gaussian: float
    pixel: float

    def of(self, count: float, pixels: float) -> float:
        """Return the time of a step with `count` Gaussians."""
        return self.gaussian * count + self.pixel * pixels

    def of_all(self, work: _Work, config: FitConfig) -> float:
        """Return the time of a first frame; a round of density control is a step in every view."""
        count, steps, rounds = config.planned_gaussians, config.planned_steps, config.density.rounds
        late = self.of(count, work.pixels)
        if not rounds:
            return steps * late
        early = self.of(_GROWING * count, work.half_pixels)
        return steps * (LAST_ROUND * early + (1 - LAST_ROUND) * late) + rounds * work.views * early


# Of the reference machine, two cores of a server.
_REFERENCE = _StepTime(2.2e-7, 0.5e-7)


@dataclass(frozen=True)
class Plan:
    """Gaussians and steps of a first frame.

    Attributes:
        config: settings with both numbers.
        seconds: expected time of the first frame; None if both numbers were given.
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
    work = _Work.of(FirstFrameProblem.of(views, points, wanted, render, rng_of(seed, Stream.BUDGET)))
    time, left = _REFERENCE, config.first_frame_seconds
    if not render.reproducible:
        time = _measured(views, points, wanted, render, seed)
        left -= _clock() - begin
    plan = wanted
    if config.num_gaussians is None:
        most = wanted.planned_gaussians
        least = min(max(config.detail.least_gaussians, most // _LEAST_SHARE), most)

        def is_too_long(count: int) -> bool:
            return time.of_all(work, replace(wanted, num_gaussians=count)) > left

        plan = replace(wanted, num_gaussians=least + bisect_left(range(least + 1, most + 1), True, key=is_too_long))
    if config.first_frame_steps is None:
        allowed = int(plan.planned_steps * left / time.of_all(work, plan))
        plan = replace(plan, first_frame_steps=max(_LEAST, min(plan.planned_steps, allowed)))
    return Plan(plan, time.of_all(work, plan))


def _clock() -> float:
    """Return seconds of processor time over all threads, or of a clock where a GPU computes."""
    is_cpu = dr.backend_v(mi.Float) == dr.JitBackend.LLVM
    return process_time() / dr.thread_count() if is_cpu else perf_counter()


def _measured(views: Sequence[View], points: Points, config: FitConfig, render: RenderConfig, seed: int) -> _StepTime:
    """Return the time of a step on this machine, from some with all Gaussians at full and at half the resolution."""
    config = replace(config, dropping=0.0, density=replace(config.density, rounds=0))
    full = FirstFrameProblem.of(views[:_VIEWS], points, config, render, rng_of(seed, Stream.BUDGET))
    half = full.reduced(max(camera.width for camera in full.cameras) // 2)
    pixels = [_pixels(problem) for problem in (full, half)]
    times = [_timed(problem, config, seed) for problem in (full, half)]
    fewer = pixels[0] - pixels[1]  # none of images that are too small to be reduced
    pixel = max(times[0] - times[1], 0) / fewer if fewer else 0.0
    return _StepTime(max(times[0] - pixel * pixels[0], 0.1 * times[0]) / len(full.start), pixel)


def _timed(problem: FirstFrameProblem, config: FitConfig, seed: int) -> float:
    """Return the median time of a step, s."""
    config, ends = replace(config, first_frame_steps=_WARM + _TIMED), []

    def on_step(stage: str, done: float, total: float) -> None:
        dr.sync_thread()
        ends.append(_clock())

    fit_first_frame(problem, config, rng_of(seed, Stream.BUDGET), Progress(on_step))
    return float(np.median(np.diff(ends)[-_TIMED:]))


def _pixels(problem: FirstFrameProblem) -> float:
    """Return the mean number of pixels of a view."""
    return float(np.mean([camera.width * camera.height for camera in problem.cameras]))
