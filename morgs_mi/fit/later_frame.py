"""A later frame: its gated residual (eq. 12) under the objective (eq. 13)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.gaussians import Gaussians, at_rest, displaced
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.progress import Progress
from morgs_mi.core.types import Tensor
from morgs_mi.fit.density import apply_plan, plan_additions
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.optimise import Steps, adam, optimise, select_rows, values_of, view_order
from morgs_mi.method.active_set import ActiveSet
from morgs_mi.method.error_per_gaussian import ErrorPerGaussian
from morgs_mi.method.losses import recon_loss
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_model import MOTION_MODELS, MotionModel, moved
from morgs_mi.method.motion_start import MotionStart
from morgs_mi.method.objective import (
    Observations,
    Prediction,
    channels_of,
    losses_of,
    terms_of,
    weights_of,
)
from morgs_mi.method.residual import apply_residual, residual_parameters
from morgs_mi.method.rigidity import Neighbours, find_neighbours
from morgs_mi.method.ssim import Target

# Fraction of the epochs after which the round of density control is due, even if the loss still
# falls: the residual has shown by then where Gaussians are missing, and enough steps are left to
# fit the births.
_LATEST_DENSITY_ROUND = 0.625
# Learning rates of a motion model at the end, as a fraction of those at the start.
_FINAL_RATE = 0.1


@dataclass(frozen=True, eq=False)
class FrameProblem:
    """Input of the fit of a later frame."""

    previous: Gaussians  #: N Gaussians of the previous frame, detached.
    active: ActiveSet  #: The active Gaussians and views.
    targets: Mapping[int, Target]  #: Images of the active views, by view index.
    #: Observations of the key views: arrays [H, W, ...] by name, by view index.
    observations: Mapping[int, Mapping[str, np.ndarray]]
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
    epochs: int  #: Number of epochs that were run.


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
    num_views = len(active.views)
    if not num_views or not len(active.indices):
        count = len(problem.previous)
        return LaterFrame(at_rest(problem.previous), np.arange(count), {}, 0)
    fit = _LaterFrameFit(problem, config, motion, rng, progress)
    latest_density_epoch = round(_LATEST_DENSITY_ROUND * config.epochs)
    tolerance = config.early_stopping_tolerance
    objectives = []
    for epoch in range(fit.steps // num_views, config.epochs):
        # It may rise in a single epoch.
        has_converged = (
            tolerance > 0
            and len(objectives) > 2
            and objectives[-1] > (1 - tolerance) * objectives[-3]
        )
        # An epoch has shown where to add Gaussians.
        if fit.scores is not None and (has_converged or epoch >= latest_density_epoch):
            fit.densify()
        elif has_converged:
            break
        objectives.append(fit.run_epoch(epoch))
    gaussians, source = active.merge(problem.previous, fit.gaussians(), fit.source)
    return LaterFrame(gaussians, source, fit.losses, fit.steps // num_views)


class _LaterFrameFit:
    """Optimiser of a later frame's residual: the stage of a motion model, epochs, and a round of
    density control. An epoch is a step in every active view.

    Attributes:
        source: as in `LaterFrame`, among the active Gaussians.
        losses: mean losses of the last epoch, by name.
        steps: number of steps that were made.
        scores: of the last epoch, for the round of density control; None where none is to come.
    """

    def __init__(
        self,
        problem: FrameProblem,
        config: FitConfig,
        motion: MotionConfig,
        rng: np.random.Generator,
        progress: Progress | None,
    ) -> None:
        self._problem = problem
        self._config = config
        self._motion = motion
        self._rng = rng
        self._progress = progress or Progress()
        active = problem.active
        views = sorted(active.views)
        count = len(views)
        self._order = [views[k] for k in view_order(count, config.epochs * count, rng)]
        # As tensors on the region of each active view.
        self._observations: dict[int, Observations] = {
            v: {"target": problem.targets[v]}
            | {
                name: from_numpy(mi.TensorXf, view.crop(array))
                for name, array in problem.observations.get(v, {}).items()
            }
            for v, view in active.views.items()
        }
        self._previous = active.select(problem.previous)
        self._neighbours: Neighbours | None = None
        self._awaits_density_round = config.density.later_frames
        self.source = np.arange(len(active.indices))
        self.scores: ErrorPerGaussian | None = None
        self.losses = dict[str, float]()
        self.steps = 0
        start = problem.start
        factory = MOTION_MODELS.make(motion.model, motion)
        if factory is not None:
            epochs = max(1, round(motion.model_share * config.epochs))
            start, self.losses = _fit_motion(
                self._previous,
                problem,
                factory(self._previous, problem.extent, rng),
                start,
                self._next_steps(epochs * count),
                config.objective.dssim_weight,
            )
        parameters = residual_parameters(self._previous, motion, start)
        self._optimizer = adam(parameters, config.momentum)

    def gaussians(self) -> Gaussians:
        """Return the active Gaussians after the residual."""
        with dr.suspend_grad():
            return apply_residual(self._previous, values_of(self._optimizer), self._motion)

    def run_epoch(self, number: int) -> float:
        """Make one step in every active view, at the rates of epoch `number`, and return the
        objective (eq. 13).
        """
        config = self._config
        num_views = len(self._problem.active.views)
        if self._awaits_density_round:
            # Scores are collected in the last quarter: an error that is seen earlier may be gone by
            # the end of the epoch.
            self.scores = ErrorPerGaussian(len(self.source), num_views - (num_views + 3) // 4)
        weights = weights_of(config.objective)
        terms = [term for term in terms_of(config.objective) if weights[term.name]]
        if self._neighbours is None and any("neighbours" in term.observations for term in terms):
            self._neighbours = find_neighbours(self._previous, self._problem.extent)
        rates = config.rates_at(number).by_parameter(self._problem.extent)
        steps = self._next_steps(num_views)
        self.losses = optimise(self._optimizer, rates, self._losses_at, steps, weights)
        return sum(weights[name] * loss for name, loss in self.losses.items())

    def densify(self) -> None:
        """Add and prune active Gaussians by density control, once."""
        assert self.scores is not None
        problem = self._problem
        num_static = len(problem.previous) - len(problem.active.indices)
        plan = plan_additions(
            self.gaussians(),
            np.asarray(self.scores.scores),
            self._config.density,
            self._rng,
            num_static,
        )
        # The optimiser has the residual, so the plan changes the previous Gaussians: a birth starts
        # from the past of its parent, and shares its residual.
        self._previous = apply_plan(self._previous, plan)
        self.source = plan.source
        select_rows(self._optimizer, plan.parent, plan.source < 0)
        self._neighbours = None
        self._awaits_density_round = False
        self.scores = None

    def _next_steps(self, count: int) -> Steps:
        """Return the next steps, which collect densification scores, if any, and count them."""
        first = self.steps
        self.steps += count
        return Steps(
            views=self._order[first : self.steps],
            first_step=first,
            on_step=lambda step: self._progress(step, len(self._order)),
            observer=self.scores,
            averaged_steps=len(self._problem.active.views),
        )

    def _losses_at(self, parameters: Mapping[str, Tensor], index: int) -> dict[str, Tensor]:
        """Render one view and return its losses by name."""
        problem = self._problem
        objective = self._config.objective
        view = problem.active.views[index]
        observations = dict(self._observations[index])
        if self._neighbours is not None:
            observations["neighbours"] = self._neighbours
        channels = channels_of(observations, objective)
        gaussians = apply_residual(self._previous, parameters, self._motion)
        features = None if self.scores is None else self.scores.features()
        # Motion, confidence and scores must not move opacity and geometry.
        names = channels if features is None else (*channels, "features")
        detached_channels = [name for name in names if name != "color"]
        image = view.render(gaussians, channels, detached_channels, features)
        if self.scores is not None and features is not None:
            self.scores.observe(image, problem.targets[index], view.region)
        num_pixels = view.camera.width * view.camera.height
        num_gaussians = problem.active.num_gaussians
        prediction = Prediction(
            image, parameters, view.region, num_pixels, num_gaussians, problem.extent, gaussians
        )
        return losses_of(prediction, observations, objective)


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

    def losses_at(parameters: Mapping[str, Tensor], index: int) -> dict[str, Tensor]:
        view = problem.active.views[index]
        image = view.render(moved(start_gaussians, *model.motion(parameters)), ("color",))
        return {
            "recon": recon_loss(image.color, problem.targets[index], dssim_weight, view.region),
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
