"""A later frame: its gated residual (eq. 12) under the objective (eq. 13)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import opaque
from morgs_mi.core.gaussians import Gaussians, at_rest, displaced
from morgs_mi.core.types import Tensors
from morgs_mi.fit.density import DensityControl, apply_plan
from morgs_mi.fit.fit_config import FitConfig, LearningRates
from morgs_mi.fit.frozen_step import RecordedSteps
from morgs_mi.fit.frozen_views import LaterSteps, is_recordable
from morgs_mi.fit.optimise import (
    FINAL_RATE,
    Steps,
    adam,
    fit_problem,
    optimise,
    pop_psnr,
    values_of,
    view_order,
)
from morgs_mi.method.active_set import ActiveSet
from morgs_mi.method.error_per_gaussian import ErrorPerGaussian
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_model import MOTION_MODELS, MotionModel, moved
from morgs_mi.method.motion_start import MotionStart
from morgs_mi.method.objective import (
    SQUARED_ERROR,
    Prediction,
    channels_of,
    losses_of,
    recon_loss,
    weights_of,
)
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.residual import apply_residual, residual_parameters
from morgs_mi.platform.progress import Progress
from morgs_mi.render.rasterize import check_rendering, render_view

# Fraction of the epochs after which the round of density control is due: the residual has shown by
# then where Gaussians are missing, and enough steps are left to fit the births.
_DENSITY_ROUND = 0.625


@dataclass(frozen=True, eq=False)
class FrameProblem:
    """Input of the fit of a later frame."""

    previous: Gaussians  #: N Gaussians of the previous frame, detached.
    active: ActiveSet  #: The active Gaussians.
    views: Mapping[int, ObservedView]  #: The active views with their images, by view index.
    #: Start of the motion, confidence, colour and rotation of the A active Gaussians; None: no
    #: motion, and all else as before.
    start: MotionStart | None
    extent: float  #: Extent of the scene in world units.

    @cached_property
    def gaussians(self) -> Gaussians:
        """The active Gaussians of the previous frame."""
        return self.active.select(self.previous)


@dataclass(frozen=True, eq=False)
class LaterFrame:
    """Result of fitting one later frame."""

    #: M Gaussians after the fit, with the `motion` that moved them and the learned `offset` that is
    #: part of it.
    gaussians: Gaussians
    #: int [M], index of each Gaussian in the previous frame, ascending; -1 for births, which come
    #: last.
    source: np.ndarray
    losses: dict[str, float]  #: Mean losses of the last epoch, by the names of the terms.
    steps: int  #: Number of steps, one in every active view per epoch.
    #: Of the active views in the last epoch, in the pixels that were fitted, dB; NaN without one.
    psnr: float
    problem: str  #: A sentence if that is worse than a constant image; empty otherwise.


def fit_later_frame(
    problem: FrameProblem,
    config: FitConfig,
    motion: MotionConfig,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> LaterFrame:
    """Return the Gaussians after the gated residual (eq. 12) that minimises the objective (eq. 13
    and its further terms).

    Args:
        problem: input of the fit.
        config: epochs, rates, weights of the losses, density control.
        motion: which parts of the method are on.
        rng: draws the order of the views and the positions of births.
        progress: called with the numbers of steps made and of all steps.
    """
    active = problem.active
    views = problem.views
    count = len(views)
    if not count or not len(active.indices):
        source = np.arange(len(problem.previous))
        return LaterFrame(at_rest(problem.previous), source, {}, 0, np.nan, "")
    progress = progress or Progress()
    indices = sorted(views)
    order = [indices[k] for k in view_order(count, config.epochs * count, rng)]

    def steps_of(epoch: int, epochs: int = 1) -> Steps:
        """Return the steps of some epochs, one in every active view per epoch."""
        return Steps(
            order[epoch * count : (epoch + epochs) * count],
            epoch * count,
            on_step=lambda step: progress(step, len(order)),
            averaged_steps=count,
        )

    start = problem.start
    losses = dict[str, float]()
    psnr = np.nan
    model_epochs = 0
    factory = MOTION_MODELS.make(motion.model, motion)
    if factory is not None:  # the Gaussians move together first
        model_epochs = max(1, round(motion.model_share * config.epochs))
        model = factory(problem.gaussians, problem.extent, rng)
        steps = steps_of(0, model_epochs)
        start, losses = _fit_motion(problem, model, steps, config.objective.dssim_weight)
    fit = _ResidualFit(problem, start, config, motion)
    density_epoch = _density_epoch(config, model_epochs)
    for epoch in range(model_epochs, config.epochs):
        if epoch == density_epoch:
            fit.density_round(rng)
        is_scored = epoch + 1 == density_epoch
        losses = fit.epoch(steps_of(epoch), config.rates_at(epoch), is_scored)
        psnr = pop_psnr(losses)
    gaussians, source = active.merge(problem.previous, fit.checked_gaussians(), fit.source)
    constant_errors = (view.target.constant_error(view.region) for view in views.values())
    problem_text = fit_problem(psnr, constant_errors)
    return LaterFrame(gaussians, source, losses, len(order), psnr, problem_text)


def _density_epoch(config: FitConfig, model_epochs: int) -> int | None:
    """Return the epoch before which density control acts; None: it does not.

    It comes after an epoch of the residual, which shows where to add Gaussians.
    """
    epoch = max(round(_DENSITY_ROUND * config.epochs), model_epochs + 1)
    return epoch if config.density.later_frames and epoch < config.epochs else None


class _ResidualFit:
    """Fit of the residual of the active Gaussians, epoch by epoch.

    Args:
        problem: input of the fit.
        start: of the residual.
        config: weights of the losses, density control.
        motion: which parts of the method are on.

    Attributes:
        source: int [N], index of each Gaussian among the active ones of the previous frame; -1 for
            births, which come last.
    """

    def __init__(
        self,
        problem: FrameProblem,
        start: MotionStart | None,
        config: FitConfig,
        motion: MotionConfig,
    ) -> None:
        self._problem = problem
        self._config = config
        self._motion = motion
        # The Gaussians before the residual; a birth has the past of its parent.
        self._previous = problem.gaussians
        self.source = np.arange(len(self._previous))
        # Densification scores of the epoch; None: it has none.
        self._scores: ErrorPerGaussian | None = None
        parameters = residual_parameters(self._previous, motion, start)
        self._optimizer = adam(parameters, config.momentum)
        self._later_steps = None
        if is_recordable(problem.views.values(), config.objective):
            views = problem.views
            self._later_steps = LaterSteps(views, self._optimizer, config.objective, motion)
        self._recorded_steps = self._recorded()

    def _recorded(self) -> RecordedSteps | None:
        """Return the steps of the active Gaussians as recordings; None if these do not exist."""
        if self._later_steps is None:
            return None
        problem = self._problem
        return self._later_steps.of(self._previous, problem.active.num_gaussians, problem.extent)

    def epoch(self, steps: Steps, rates: LearningRates, is_scored: bool) -> dict[str, float]:
        """Make the steps of an epoch, and return their mean losses by name.

        Args:
            steps: one in every active view.
            rates: learning rates.
            is_scored: whether densification scores are collected, for the next `density_round`.
        """
        if is_scored:
            # In the last quarter: an error that is seen earlier may be gone by the end of the
            # epoch.
            count = len(self._problem.views)
            self._scores = ErrorPerGaussian(len(self.source), count - (count + 3) // 4)
        return optimise(
            self._optimizer,
            rates.by_parameter(self._problem.extent),
            self._losses_at,
            replace(steps, observer=self._scores),
            weights_of(self._config.objective),
            self._recorded_steps,
        )

    def density_round(self, rng: np.random.Generator) -> None:
        """Prune and add Gaussians where the scores of the last epoch are largest."""
        assert self._scores is not None
        problem = self._problem
        num_static = len(problem.previous) - len(problem.active.indices)
        control = DensityControl((), self._config.density, problem.extent, rng)
        control.scores = np.asarray(self._scores.scores)
        plan = control.step_later(self._optimizer, self._gaussians(), num_static)
        # The optimiser has the residual, so the plan changes the previous Gaussians: a birth starts
        # from the past of its parent, and shares its residual.
        self._previous = apply_plan(self._previous, plan)
        self.source = plan.source
        self._scores = None
        self._recorded_steps = self._recorded()

    def _gaussians(self) -> Gaussians:
        """Return the active Gaussians after the residual."""
        with dr.suspend_grad():
            return apply_residual(self._previous, values_of(self._optimizer), self._motion)

    def checked_gaussians(self) -> Gaussians:
        """Return the active Gaussians after the residual, with the checks of a rendering, which
        recordings do not have.
        """
        gaussians = self._gaussians()
        if self._later_steps is not None:
            view = self._problem.views[min(self._problem.views)]
            check_rendering(gaussians, view.camera, ("color", "motion"), view.config)
        return gaussians

    def _losses_at(self, parameters: Tensors, index: int) -> Tensors:
        """Render one view and return its losses by name."""
        problem = self._problem
        objective = self._config.objective
        view = problem.views[index]
        observed = view.observations
        scores = self._scores
        channels = channels_of(observed, objective)
        gaussians = apply_residual(self._previous, parameters, self._motion)
        features = None if scores is None else scores.features()
        # Motion, confidence and scores must not move opacity and geometry.
        names = channels if features is None else (*channels, "features")
        detached_channels = [name for name in names if name != "color"]
        image = render_view(
            gaussians, view, channels, features=features, detach_weights=detached_channels
        )
        if scores is not None and features is not None:
            scores.observe(image, view.target, view.region)
        prediction = Prediction(
            image,
            parameters,
            view.region,
            opaque(mi.Float, 1 / (view.camera.width * view.camera.height)),
            opaque(mi.Float, 1 / (problem.active.num_gaussians * problem.extent)),
            problem.extent,
            gaussians,
            self._previous,
        )
        losses = losses_of(prediction, observed, objective)
        return {**losses, SQUARED_ERROR: view.target.mse}


def _fit_motion(
    problem: FrameProblem, model: MotionModel, steps: Steps, dssim_weight: float
) -> tuple[MotionStart, dict[str, float]]:
    """Fit a motion model to the images by L_recon and the model's own losses.

    Args:
        problem: the active Gaussians and views. Its start has the displacement from which the
            motion starts, and the colour from which the residual starts.
        model: of the motion of the Gaussians.
        steps: the steps, from the first one of the frame.
        dssim_weight: lambda of eq. 2.

    Returns:
        The start of the residual, with the confidence of the problem's start or of the previous
        frame, and the losses by name, means over the last round of views.
    """
    gaussians = problem.gaussians
    start = problem.start or MotionStart.without_motion(gaussians)
    start_gaussians = displaced(gaussians, start.displacement)

    def losses_at(parameters: Tensors, index: int) -> Tensors:
        view = problem.views[index]
        image = render_view(moved(start_gaussians, *model.motion(parameters)), view)
        return {
            "recon": recon_loss(image.color, view.target, dssim_weight, view.region),
            **model.losses(parameters),
        }

    optimizer = adam(model.parameters)
    total = len([*steps.views])
    # Adam's steps are as long as the rate; long ones find the motion, short ones settle it.
    decaying_steps = replace(steps, rate_factor=lambda step: FINAL_RATE ** (step / total))
    losses = optimise(optimizer, model.rates, losses_at, decaying_steps)
    with dr.suspend_grad():
        displacement, rotation = model.motion(values_of(optimizer))
        change = moved(gaussians, displacement, rotation).quats - gaussians.quats
    displacement = start.displacement + np.asarray(displacement)
    return replace(start, displacement=displacement, rotation=np.array(change)), losses
