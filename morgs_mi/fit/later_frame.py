"""A later frame: its gated residual (eq. 12) under the objective (eq. 13)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from morgs_mi.core.gaussians import Gaussians, at_rest
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.progress import Progress
from morgs_mi.core.types import Tensor
from morgs_mi.fit.density import apply_plan, plan_additions
from morgs_mi.fit.fit_config import FitConfig
from morgs_mi.fit.motion_stage import fit_motion
from morgs_mi.fit.optimise import Steps, adam, optimise, select_rows, values_of, view_order
from morgs_mi.method.active_set import ActiveSet
from morgs_mi.method.attribution import Attribution
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_model import motion_model
from morgs_mi.method.motion_start import MotionProblem, MotionStart
from morgs_mi.method.objective import Observations, Prediction, channels_of, losses_of, weights_of
from morgs_mi.method.residual import apply_residual, residual_parameters
from morgs_mi.method.rigidity import Neighbours, find_neighbours
from morgs_mi.method.ssim import Target

# Fraction of the epochs after which the round of density control is due, even if the loss still
# falls: the residual has shown by then where Gaussians are missing, and enough steps are left to
# fit the births.
_LATEST_DENSITY_ROUND = 0.625


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
    previous = problem.previous
    active = problem.active
    if not active.views or not len(active.indices):
        return LaterFrame(at_rest(previous), np.arange(len(previous)), {}, 0)
    fit = _LaterFrameFit(problem, config, motion, rng, progress)
    latest_density_epoch = round(_LATEST_DENSITY_ROUND * config.epochs)
    first_epoch = fit.fit_motion_model()
    for epoch in range(first_epoch, config.epochs):
        if fit.can_densify and (fit.has_converged or epoch >= latest_density_epoch):
            fit.densify()
        elif fit.has_converged:
            break
        fit.run_epoch(epoch)
    gaussians, source = active.merge(previous, fit.gaussians, fit.source)
    return LaterFrame(gaussians, source, fit.losses, fit.steps // len(active.views))


@dataclass(frozen=True)
class Epoch:
    """An epoch: a step in every active view. The stage of a motion model may be several ones."""

    first_step: int  #: Number of the first step.
    stop: int  #: Number of the step after the last one.
    #: Number of the first step that counts for densification scores, which are collected in the
    #: last quarter: an error that is seen earlier may be gone by the end of the epoch.
    first_scored_step: int

    @classmethod
    def after(cls, steps: int, num_views: int, count: int = 1) -> Epoch:
        """Return the next `count` epochs after some steps."""
        stop = steps + count * num_views
        return cls(steps, stop, stop - (num_views + 3) // 4)

    @property
    def unscored_steps(self) -> int:
        """Number of steps before the first one that counts for densification scores."""
        return self.first_scored_step - self.first_step


class _LaterFrameFit:
    """Optimiser of a later frame's residual: the stage of a motion model, epochs, and a round of
    density control.

    Attributes:
        source: as in `LaterFrame`, among the active Gaussians.
        losses: mean losses of the last epoch, by name.
        steps: number of steps that were made.
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
        self._views = sorted(problem.active.views)
        count = len(self._views)
        self._order = [self._views[k] for k in view_order(count, config.epochs * count, rng)]
        # As tensors on the region of each active view.
        self._observations: dict[int, Observations] = {
            v: {"target": problem.targets[v]}
            | {
                name: from_numpy(mi.TensorXf, view.crop(array))
                for name, array in problem.observations.get(v, {}).items()
            }
            for v, view in problem.active.views.items()
        }
        self._previous = problem.active.select(problem.previous)
        self._start = problem.start
        self.source = np.arange(len(problem.active.indices))
        self._neighbours: Neighbours | None = None
        # The round of density control is still to come, and the scores of the last epoch, which it
        # needs.
        self._awaits_density_round = config.density.later_frames
        self._scores: Attribution | None = None
        self._objectives = list[float]()
        self.losses = dict[str, float]()
        self.steps = 0

    @property
    def gaussians(self) -> Gaussians:
        """The active Gaussians after the residual."""
        with dr.suspend_grad():
            return apply_residual(self._previous, values_of(self._optimizer), self._motion)

    @property
    def has_converged(self) -> bool:
        """Whether the objective (eq. 13) decreased by less than the tolerance over the last two
        epochs; it may rise in a single one.
        """
        tolerance = self._config.early_stopping_tolerance
        values = self._objectives
        return tolerance > 0 and len(values) > 2 and values[-1] > (1 - tolerance) * values[-3]

    def fit_motion_model(self) -> int:
        """Fit the motion model, if there is one, and let the residual start from its motion; return
        the number of epochs that it took.
        """
        factory = motion_model(self._motion)
        if factory is None:
            return 0
        problem = self._problem
        model = factory(self._previous, problem.extent, self._rng)
        motion_problem = MotionProblem(
            self._previous, problem.active.views, problem.targets, self._rng
        )
        epochs = max(1, round(self._motion.model_share * self._config.epochs))
        steps = self._steps_of(self._next_epoch(epochs))
        weight = self._config.objective.dssim_weight
        self._start, self.losses = fit_motion(motion_problem, model, self._start, steps, weight)
        return epochs

    def run_epoch(self, number: int) -> None:
        """Make one step in every active view, at the rates of epoch `number`."""
        epoch = self._next_epoch()
        if self._awaits_density_round:
            self._scores = Attribution(len(self.source), epoch.unscored_steps)
        if self._neighbours is None and self._config.objective.is_rigid:
            self._neighbours = find_neighbours(self._previous, self._problem.extent)
        rates = self._config.rates_at(number).by_parameter(self._problem.extent)
        weights = weights_of(self._config.objective)
        steps = self._steps_of(epoch, self._scores)
        self.losses = optimise(self._optimizer, rates, self._losses_at, steps, weights)
        self._objectives.append(sum(weights[name] * loss for name, loss in self.losses.items()))

    @property
    def can_densify(self) -> bool:
        """Whether a round of density control is to come, and an epoch has shown where to add
        Gaussians.
        """
        return self._scores is not None

    def densify(self) -> None:
        """Add and prune active Gaussians by density control, once."""
        assert self._scores is not None
        problem = self._problem
        num_static = len(problem.previous) - len(problem.active.indices)
        plan = plan_additions(
            self.gaussians, self._scores.scores(), self._config.density, self._rng, num_static
        )
        # The optimiser has the residual, so the plan changes the previous Gaussians: a birth starts
        # from the past of its parent, and shares its residual.
        self._previous = apply_plan(self._previous, plan)
        self.source = plan.source
        select_rows(self._optimizer, plan.parent, plan.is_birth)
        self._neighbours = None
        self._awaits_density_round = False
        self._scores = None

    @cached_property
    def _optimizer(self) -> Adam:
        """Optimiser of the residual of the active Gaussians, which begins at the start of their
        motion.
        """
        parameters = residual_parameters(self._previous, self._motion, self._start)
        return adam(parameters, self._config.momentum)

    def _next_epoch(self, count: int = 1) -> Epoch:
        """Return the next epochs, and count their steps."""
        epoch = Epoch.after(self.steps, len(self._views), count)
        self.steps = epoch.stop
        return epoch

    def _steps_of(self, epoch: Epoch, scores: Attribution | None = None) -> Steps:
        """Return the steps of an epoch, which collect densification scores, if any."""
        return Steps(
            views=self._order[epoch.first_step : epoch.stop],
            first_step=epoch.first_step,
            on_step=lambda step: self._progress(step, len(self._order)),
            observer=scores,
            averaged_steps=len(self._views),
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
        features = None if self._scores is None else self._scores.features()
        # Motion, confidence and scores must not move opacity and geometry.
        detached_channels = [name for name in channels if name != "color"]
        if features is not None:
            detached_channels.append("features")
        image = view.render(gaussians, channels, detached_channels, features)
        if self._scores is not None and features is not None:
            self._scores.observe(image, problem.targets[index], view.region)
        num_pixels = view.camera.width * view.camera.height
        num_gaussians = problem.active.num_gaussians
        prediction = Prediction(
            image, parameters, view.region, num_pixels, num_gaussians, problem.extent, gaussians
        )
        return losses_of(prediction, observations, objective)
