"""A later frame: its gated residual (eq. 12) under the objective (eq. 13)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy, opaque
from morgs_mi.core.gaussians import Gaussians, at_rest, displaced
from morgs_mi.core.types import Tensors
from morgs_mi.fit.density import DensityControl, apply_plan
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.frozen_views import LaterSteps, is_recordable
from morgs_mi.fit.optimise import (
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
    Observations,
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
# Learning rates of a motion model at the end, as a fraction of those at the start.
_FINAL_RATE = 0.1


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
    objective = config.objective
    indices = sorted(views)
    order = [indices[k] for k in view_order(count, config.epochs * count, rng)]

    @cache
    def observed_in(index: int) -> Observations:
        """Return what a view is compared with, as tensors on its region."""
        view = views[index]
        images = view.observed.items()
        tensors = {name: from_numpy(mi.TensorXf, view.crop(array)) for name, array in images}
        return {"target": view.target, **tensors}

    previous = active.select(problem.previous)
    source = np.arange(len(active.indices))
    scores: ErrorPerGaussian | None = None  # None: the epoch collects none

    def steps_of(epoch: int, epochs: int = 1) -> Steps:
        """Return the steps of some epochs, one in every active view per epoch."""
        return Steps(
            order[epoch * count : (epoch + epochs) * count],
            epoch * count,
            on_step=lambda step: progress(step, len(order)),
            observer=scores,
            averaged_steps=count,
        )

    def gaussians() -> Gaussians:
        """Return the active Gaussians after the residual."""
        with dr.suspend_grad():
            return apply_residual(previous, values_of(optimizer), motion)

    def losses_at(parameters: Tensors, index: int) -> Tensors:
        """Render one view and return its losses by name."""
        view = views[index]
        observed = observed_in(index)
        channels = channels_of(observed, objective)
        gaussians = apply_residual(previous, parameters, motion)
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
            opaque(mi.Float, 1 / (active.num_gaussians * problem.extent)),
            problem.extent,
            gaussians,
            previous,
        )
        losses = losses_of(prediction, observed, objective)
        return {**losses, SQUARED_ERROR: view.target.mse}

    start = problem.start
    losses = dict[str, float]()
    model_epochs = 0
    psnr = np.nan
    factory = MOTION_MODELS.make(motion.model, motion)
    if factory is not None:
        model_epochs = max(1, round(motion.model_share * config.epochs))
        model = factory(previous, problem.extent, rng)
        steps = steps_of(0, model_epochs)
        start, losses = _fit_motion(previous, problem, model, start, steps, objective.dssim_weight)
    optimizer = adam(residual_parameters(previous, motion, start), config.momentum)
    weights = weights_of(objective)
    later_steps = None
    if is_recordable(views.values(), objective):
        later_steps = LaterSteps(views, optimizer, objective, motion)
    recorded_steps = None
    # The round comes after an epoch of the residual, which shows where to add Gaussians.
    density_epoch = max(round(_DENSITY_ROUND * config.epochs), model_epochs + 1)
    for epoch in range(model_epochs, config.epochs):
        if scores is not None:
            num_static = len(problem.previous) - len(active.indices)
            control = DensityControl((), config.density, problem.extent, rng)
            control.scores = np.asarray(scores.scores)
            plan = control.step_later(optimizer, gaussians(), num_static)
            # The optimiser has the residual, so the plan changes the previous Gaussians: a birth
            # starts from the past of its parent, and shares its residual.
            previous = apply_plan(previous, plan)
            source = plan.source
            recorded_steps = None
            scores = None
        elif config.density.later_frames and epoch == density_epoch - 1:
            # Scores are collected in the last quarter: an error that is seen earlier may be gone by
            # the end of the epoch.
            scores = ErrorPerGaussian(len(source), count - (count + 3) // 4)
        rates = config.rates_at(epoch).by_parameter(problem.extent)
        if recorded_steps is None and later_steps is not None:
            recorded_steps = later_steps.of(previous, active.num_gaussians, problem.extent)
        losses = optimise(optimizer, rates, losses_at, steps_of(epoch), weights, recorded_steps)
        psnr = pop_psnr(losses)
    if later_steps is not None:
        view = views[indices[0]]
        check_rendering(gaussians(), view.camera, ("color", "motion"), view.config)
    result, source = active.merge(problem.previous, gaussians(), source)
    constant_errors = (view.target.constant_error(view.region) for view in views.values())
    problem_text = fit_problem(psnr, constant_errors)
    return LaterFrame(result, source, losses, len(order), psnr, problem_text)


def _fit_motion(
    gaussians: Gaussians,
    problem: FrameProblem,
    model: MotionModel,
    start: MotionStart | None,
    steps: Steps,
    dssim_weight: float,
) -> tuple[MotionStart, dict[str, float]]:
    """Fit a motion model to the images by L_recon and the model's own losses.

    Args:
        gaussians: N active Gaussians of the previous frame.
        problem: the active views and their images.
        model: of their motion.
        start: displacement from which it starts, and colour from which the residual starts; None:
            none.
        steps: the steps, from the first one of the frame.
        dssim_weight: lambda of eq. 2.

    Returns:
        The start of the residual, with the confidence of `start` or of the previous frame, and the
        losses by name, means over the last round of views.
    """
    start = start or MotionStart.without_motion(gaussians)
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
    decaying_steps = replace(steps, rate_factor=lambda step: _FINAL_RATE ** (step / total))
    losses = optimise(optimizer, model.rates, losses_at, decaying_steps)
    with dr.suspend_grad():
        displacement, rotation = model.motion(values_of(optimizer))
        change = moved(gaussians, displacement, rotation).quats - gaussians.quats
    displacement = start.displacement + np.asarray(displacement)
    return replace(start, displacement=displacement, rotation=np.array(change)), losses
