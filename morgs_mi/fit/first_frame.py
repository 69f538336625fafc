"""The fit of the first frame.

`fit_first_frame` fits all attributes but the confidence; up to the last round of density control,
the images have half the size. `fit_confidence` follows when the second frame, and with it the flow,
is there.

Where training views are few or noisy, Gaussians overfit them together: one compensates for another
in a single view. Dropout prevents it (DropGaussian, Park et al. 2025): in every step of the first
frame, each Gaussian is left out with probability p, and the opacities of the others are scaled by
1 / (1 - p). p follows from the number of views, their noise and the angles between them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy, opaque
from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Tensors
from morgs_mi.core.view import View
from morgs_mi.fit.density import DensityControl
from morgs_mi.fit.detail import is_noisy
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.forecast import MANY_VIEWS, are_far_apart
from morgs_mi.fit.frozen_views import FirstSteps, is_recordable, kept, with_dropout
from morgs_mi.fit.initialise import FirstFrameProblem
from morgs_mi.fit.optimise import (
    FINAL_RATE,
    Steps,
    adam,
    fit_problem,
    optimise,
    pop_psnr,
    replace_parameter,
    values_of,
    view_order,
)
from morgs_mi.fit.view import half_sized
from morgs_mi.method.objective import SQUARED_ERROR, ObjectiveConfig, mask_loss, recon_loss
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.ssim import Target
from morgs_mi.platform.progress import Progress
from morgs_mi.render.active_view import ActiveView
from morgs_mi.render.rasterize import render_view
from morgs_mi.render.render_config import RenderConfig

# Probability with which few views are fitted that are noisy or far apart.
_DROPOUT = 0.2
# Passes over all views over which the losses are averaged: of fewer, a mean depends on the views
# that come last.
_AVERAGED_PASSES = 4
# Least number of steps over which they are averaged, of few views.
_LEAST_AVERAGED_STEPS = 8
# Fraction of the steps after which another SH band is added: 1000 of 30,000 steps in 3DGS.
BAND = 1 / 30
# First round of density control, as a fraction of the steps: before it, errors are everywhere.
_FIRST_ROUND = 0.1
LAST_ROUND = 0.5
"""Last round of density control, as a fraction of the steps: the remaining steps fit the births."""
# Steps after which the clock is read, under a limit: reading waits until they are computed.
_CHECKED = 20
# Least number of steps under a limit: after fewer, there is nothing to look at.
_LEAST_STEPS = 50
# Time of a step with the full images relative to one with the half-sized images, as measured.
_LATE = 2.0


def dropped(gaussians: Gaussians, probability: float, rng: np.random.Generator) -> Gaussians:
    """Return the Gaussians as one step of the first frame renders them, differentiable.

    Args:
        gaussians: N Gaussians.
        probability: with which each is left out, below 1; 0: none is.
        rng: draws which.
    """
    if not probability:
        return gaussians
    return with_dropout(gaussians, probability, kept(len(gaussians), probability, rng))


def adapted_to_images(config: FitConfig, problem: FirstFrameProblem) -> FitConfig:
    """Return the settings of the first frame with what follows from its images: dropout, and the
    loss of noisy ones.

    Noisy images are fitted by L1 alone if `noise_aware`. Few views that are noisy or far apart are
    fitted with dropout, unless it is given.
    """
    noisy = is_noisy([view.image for view in problem.views])
    if config.noise_aware and noisy:
        config = replace(config, objective=replace(config.objective, dssim_weight=0.0))
    if config.dropout is not None:
        return config
    few = len(problem.views) < MANY_VIEWS
    far = are_far_apart(problem.cameras, problem.points)
    return replace(config, dropout=_DROPOUT if few and (noisy or far) else 0.0)


class _Pace:
    """Planned steps of a fit, some of which are skipped evenly if it would exceed a limit of the
    clock.
    """

    def __init__(self, steps: int, limit: float | None, late: float) -> None:
        self._steps = steps
        self._limit = limit
        self._late = late
        self._begin = self._checked = time.perf_counter()
        self._stride = 1.0
        self.position = 0.0  # planned steps that are done
        self.count = 0  # steps that were made

    def done(self) -> tuple[float, float]:
        """Return how much is done, and of how much: seconds of the limit, or without one planned
        steps, in proportion to the time they take.
        """
        position = min(self.position + 1, self._steps)
        share = self._work(position) / self._work(self._steps)
        if self._limit is None:
            return self._steps * share, self._steps
        seconds = time.perf_counter() - self._begin
        # The least number of steps may take longer.
        return seconds, self._limit if seconds < self._limit else seconds / share

    def _work(self, position: float) -> float:
        """Return the time that the planned steps up to a position take, in units of a step with the
        half-sized images.
        """
        return position + (self._late - 1) * max(position - LAST_ROUND * self._steps, 0)

    def views(self, order: Iterator[int], stop: int) -> Iterator[int]:
        """Yield the view of each step before the planned step `stop`."""
        while self.position < stop:
            yield next(order)
            self.position += self._stride
            self.count += 1
            if self._limit is not None and self.count % _CHECKED == 0:
                dr.sync_thread()
                moment = time.perf_counter()
                seconds = (moment - self._checked) / _CHECKED
                self._checked = moment
                work = self._work(self._steps) - self._work(self.position)
                steps_left = work / (self._work(self.position) - self._work(self.position - 1))
                left = max(self._begin + self._limit - moment, 1e-3)
                stride = min(steps_left * seconds / left, self._steps / _LEAST_STEPS)
                self._stride = max(stride, 1.0)


@dataclass(frozen=True, eq=False)
class FirstFrame:
    """Result of fitting the first frame."""

    gaussians: Gaussians  #: The fitted Gaussians.
    losses: dict[str, float]  #: Means over the last steps, by name.
    steps: int  #: Number of steps.
    psnr: float  #: Of the training views in the last steps, dB; NaN without a step.
    problem: str  #: A sentence if that is worse than a constant image; empty otherwise.


def fit_first_frame(
    problem: FirstFrameProblem,
    config: FitConfig,
    rng: np.random.Generator,
    progress: Progress | None = None,
    on_round: Callable[[Gaussians], None] | None = None,
    limit: float | None = None,
) -> FirstFrame:
    """Return Gaussians fitted to the images of one timestamp by L_recon (eq. 2); their confidence
    stays unchanged.

    As in 3DGS, the bands of the spherical harmonics are added one after the other. Between a tenth
    and a half of the planned steps, rounds of density control (see `density`) let the Gaussians
    grow to `num_gaussians`, if so many are needed.

    Args:
        problem: views and initial Gaussians.
        config: steps and rates.
        rng: draws the views and the means of births.
        progress: called with the numbers of steps made and of all steps, in proportion to their
            time; with a limit, in seconds.
        on_round: called with the Gaussians before each round of density control.
        limit: of the time, seconds, for which steps are skipped; None: none.
    """
    progress = progress or Progress()
    steps = config.planned_steps
    # Steps before which a band is added; 3 times a thirtieth of 30 is 3, and not below.
    bands = [int(k * steps * BAND + 1e-9) for k in range(1, problem.start.sh_degree + 1)]
    rounds = density_rounds(config)
    fit = _GaussianFit(problem, config, rng)
    fit.set_views(half_sized(problem.views) if rounds else problem.views)
    order = iter(view_order(len(fit.views), steps, rng))
    pace = _Pace(steps, limit, _LATE if rounds else 1.0)
    losses = {}
    for first, stop in pairwise(sorted({0, *bands, *rounds, steps})):
        if on_round is not None and first in rounds:
            on_round(fit.gaussians())
        for _ in range(bands.count(first)):
            fit.add_band()
        if first in rounds:
            if first == rounds[-1]:  # its scores come from the full images already
                fit.set_views(problem.views)
            fit.density_round(len(rounds) - rounds.index(first))
        losses = fit.run(
            Steps(
                pace.views(order, stop),
                rate_factor=lambda _: FINAL_RATE ** (pace.position / steps),
                on_step=lambda _: progress(*pace.done()),
                averaged_steps=max(_LEAST_AVERAGED_STEPS, _AVERAGED_PASSES * len(fit.views)),
            )
        )
    if pace.count < steps:  # perhaps the last ones were skipped
        total = pace.done()[1]
        progress(total, total)
    psnr = pop_psnr(losses)
    problem_text = fit_problem(psnr, (view.target.constant_error() for view in fit.views))
    return FirstFrame(fit.gaussians(), losses, pace.count, psnr, problem_text)


class _GaussianFit:
    """Fit of the Gaussians of the first frame, in parts; `set_views` comes first.

    Args:
        problem: initial Gaussians, cameras, and cut-offs.
        config: number of the Gaussians, rates, loss, dropout and density control.
        rng: draws the Gaussians that steps leave out and the means of births.

    Attributes:
        views: the views that are rendered.
    """

    views: list[ObservedView]
    _steps: FirstSteps | None  # in these views as recordings; None: they cannot be recorded

    def __init__(
        self, problem: FirstFrameProblem, config: FitConfig, rng: np.random.Generator
    ) -> None:
        self._config = config
        self._render = problem.render
        self._rng = rng
        # The Gaussians with the values from which the parameters start.
        self._start = problem.start
        parameters = self._start.parameters()
        names = [a.name for a in ATTRIBUTES if a.first_frame and a.name in parameters]
        # The higher bands follow.
        self._optimizer = adam({name: parameters[name] for name in names if name != "sh_rest"})
        self._rates = config.first_frame_rates.by_parameter(problem.extent)
        self._control = DensityControl(problem.cameras, config.density, problem.extent, rng)

    def set_views(self, views: Sequence[View]) -> None:
        """Render and compare some views from now on."""
        self.views = [
            ObservedView.of(ActiveView(view.camera, self._render), Target(view.image, view.mask))
            for view in views
        ]
        self._steps = None
        if is_recordable(self.views, ObjectiveConfig()):
            weight = self._config.objective.dssim_weight
            self._steps = FirstSteps(self.views, weight, self._config.dropout or 0.0, self._rng)

    def gaussians(self) -> Gaussians:
        """Return the Gaussians."""
        return self._start.with_parameters(values_of(self._optimizer))

    def run(self, steps: Steps) -> dict[str, float]:
        """Make some steps, and return their mean losses by name."""
        recorded_steps = None if self._steps is None else self._steps.of(len(self._start))
        return optimise(
            self._optimizer, self._rates, self._losses_at, steps, recorded_steps=recorded_steps
        )

    def _losses_at(self, parameters: Tensors, index: int) -> Tensors:
        """Render one view and return its losses by name."""
        config = self._config
        view = self.views[index]
        gaussians = self._start.with_parameters(parameters)
        image = render_view(dropped(gaussians, config.dropout or 0.0, self._rng), view)
        loss = recon_loss(image.color, view.target, config.objective.dssim_weight)
        return {"recon": loss, SQUARED_ERROR: view.target.mse}

    def density_round(self, rounds: int) -> None:
        """Prune, clone and split Gaussians where the errors of the views are largest.

        Args:
            rounds: number of this round and those that follow, which share the missing Gaussians.
        """
        gaussians = self.gaussians()
        missing = max(self._config.planned_gaussians - len(gaussians), 0)
        self._control.observe_views(gaussians, self.views)
        del gaussians  # tensors that the next steps would keep in memory
        plan = self._control.step(self._optimizer, -(-missing // rounds))
        self._start = self._start.select(plan.parent)

    def add_band(self) -> None:
        """Add the next SH band to the parameters, with its values in the initial Gaussians."""
        rest = np.asarray(self._start.sh_coeffs)[:, 1:]
        if "sh_rest" not in self._optimizer:
            self._optimizer["sh_rest"] = from_numpy(mi.TensorXf, rest[:, :3])
            return
        coefficients = np.asarray(dr.detach(self._optimizer["sh_rest"]))
        count = coefficients.shape[1]
        next_degree = round((count + 1) ** 0.5)
        width = (next_degree + 1) ** 2 - 1
        band = rest[:, count:width]
        replace_parameter(
            self._optimizer,
            "sh_rest",
            from_numpy(mi.TensorXf, np.concatenate([coefficients, band], axis=1)),
            lambda m: from_numpy(mi.TensorXf, np.pad(m, [(0, 0), (0, width - count), (0, 0)])),
        )


def density_rounds(config: FitConfig) -> list[int]:
    """Return the steps of the first frame before which density control acts."""
    steps = np.linspace(_FIRST_ROUND, LAST_ROUND, config.density.rounds) * config.planned_steps
    return sorted(set(steps.astype(int).tolist()))


@dataclass(frozen=True, eq=False)
class MotionMask:
    """Motion mask of a view (eq. 10)."""

    camera: Camera  #: The view.
    mask: np.ndarray  #: [H, W] bool.


def fit_confidence(
    gaussians: Gaussians,
    masks: Sequence[MotionMask],
    config: FitConfig,
    render: RenderConfig,
    rng: np.random.Generator,
) -> tuple[Gaussians, dict[str, float]]:
    """Return Gaussians with a confidence that is learned from motion masks on key views (eq. 11);
    all other attributes are frozen.

    Args:
        gaussians: N Gaussians with a confidence.
        masks: of the key views.
        config: steps and rates.
        render: cut-offs.
        rng: draws the views.

    Returns:
        The Gaussians with the learned confidence, and the losses by name.
    """
    views = [
        (ActiveView(each.camera, render), from_numpy(mi.TensorXf, each.mask)) for each in masks
    ]

    def losses_at(parameters: Tensors, index: int) -> Tensors:
        trial = replace(gaussians, logit_confidence=parameters["logit_confidence"])
        view, mask = views[index]
        image = render_view(trial, view, ("confidence",), detach_weights=("confidence",))
        pixel_share = opaque(mi.Float, 1 / (view.camera.width * view.camera.height))
        return {"mask": mask_loss(image.confidence, mask, pixel_share)}

    rates = {"logit_confidence": config.first_frame_rates.confidence}
    order = view_order(len(views), config.confidence_steps, rng)
    optimizer = adam({"logit_confidence": gaussians.logit_confidence})
    losses = optimise(optimizer, rates, losses_at, Steps(order))
    return replace(gaussians, **values_of(optimizer)), losses
