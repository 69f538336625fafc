"""A later frame: its gated residual (eq. 12) under the objective (eq. 13)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

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
from morgs_mi.render.active_view import ActiveView

# The round of density control is due when the loss hardly falls, and at this fraction of the epochs
# at the latest: the residual has shown by then where Gaussians are missing, and enough steps are
# left to fit the births.
_DENSITY_ROUND = 0.625


@dataclass(frozen=True, eq=False)
class FrameProblem:
    """Data to which one later frame is fitted."""

    previous: Gaussians  #: N Gaussians of the previous frame, detached.
    active: ActiveSet  #: The active Gaussians and views.
    targets: Mapping[int, Target]  #: Images of the active views, by view index.
    #: Of the key views, arrays [H, W, ...] by name, by view index.
    observations: Mapping[int, Mapping[str, np.ndarray]]
    #: Start of motion and confidence of the M active Gaussians; None: no motion, confidence as
    #: before.
    start: MotionStart | None
    extent: float  #: Of the scene in world units.


@dataclass(frozen=True, eq=False)
class LaterFrame:
    """Result of fitting one later frame."""

    #: M Gaussians, with the `motion` that moved them and the learned `offset` that is part of it.
    gaussians: Gaussians
    #: int [M], index of each Gaussian in the previous frame, ascending; -1 for births, which come
    #: last.
    source: np.ndarray
    losses: dict[str, float]  #: Means over the last epoch, by the names of the terms.
    epochs: int  #: Number of epochs that were run.


def fit_later_frame(
    problem: FrameProblem,
    config: FitConfig,
    motion: MotionConfig,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> LaterFrame:
    """Fit one frame's residual (eq. 12) by L_recon + L_mask + L_flow + L_off (eq. 13).

    Args:
        problem: the data of the frame.
        config: epochs, rates, weights of the losses, density control.
        motion: which modules are on.
        rng: draws the order of the views and the positions of births.
        progress: of the steps.
    """
    previous = problem.previous
    active = problem.active
    if not active.views or not len(active.indices):
        return LaterFrame(at_rest(previous), np.arange(len(previous)), {}, 0)
    fit = _Fit(problem, config, motion, rng, progress)
    last_chance = round(_DENSITY_ROUND * config.epochs)
    for epoch in range(fit.start(), config.epochs):
        if fit.can_densify and (fit.has_converged or epoch >= last_chance):
            fit.densify()
        elif fit.has_converged:
            break
        fit.run_epoch(epoch)
    gaussians, source = active.merge(previous, fit.gaussians, fit.source)
    return LaterFrame(gaussians, source, fit.losses, fit.steps // len(active.views))


@dataclass(frozen=True)
class Epoch:
    """Steps of one or several epochs, each with a step in every active view."""

    first: int  #: Number of the first step.
    stop: int  #: Number of the step after the last one.
    #: Number of the step from which densification scores are collected: the first steps of an epoch
    #: still correct what the last ones show.
    first_score: int

    @classmethod
    def after(cls, steps: int, num_views: int, count: int = 1) -> Epoch:
        """Return the next `count` epochs after some steps."""
        stop = steps + count * num_views
        return cls(steps, stop, stop - (num_views + 3) // 4)


class _Fit:
    """Optimiser of a later frame's residual: the stage of a motion model, epochs, and a round of
    density control.

    Attributes:
        source: as in `LaterFrame`, among the active Gaussians.
        losses: means over the last epoch, by name.
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
        self._observations = _on_active_views(problem)
        self._base = problem.active.select(problem.previous)
        self.source = np.arange(len(problem.active.indices))
        self._neighbours: Neighbours | None = None
        self._densifies = config.density.later_frames
        self._attribution = None
        self._objectives = list[float]()
        self.losses = dict[str, float]()
        self.steps = 0

    @property
    def gaussians(self) -> Gaussians:
        """The active Gaussians after the residual."""
        with dr.suspend_grad():
            return apply_residual(self._base, values_of(self._optimizer), self._motion)

    @property
    def has_converged(self) -> bool:
        """Whether the objective (eq. 13) hardly decreased over two epochs: one may overshoot."""
        tolerance = self._config.early_stopping_tolerance
        values = self._objectives
        return tolerance > 0 and len(values) > 2 and values[-1] > (1 - tolerance) * values[-3]

    def start(self) -> int:
        """Fit the motion model, if there is one, and start the residual; return the epochs used."""
        problem = self._problem
        motion = self._motion
        start = self._problem.start
        epochs = 0
        if (factory := motion_model(motion)) is not None:
            epochs = max(1, round(motion.model_share * self._config.epochs))
            model = factory(self._base, problem.extent, self._rng)
            shared = MotionProblem(self._base, problem.active.views, problem.targets, self._rng)
            weight = self._config.objective.dssim_weight
            steps = self._begin(epochs)
            start, self.losses = fit_motion(shared, model, start, steps, weight)
        parameters = residual_parameters(self._base, motion, start)
        self._optimizer = adam(parameters, self._config.momentum)
        return epochs

    def run_epoch(self, epoch: int) -> None:
        """Make one step in every active view."""
        steps = self._begin()
        if self._neighbours is None and self._config.objective.is_rigid:
            self._neighbours = find_neighbours(self._base, self._problem.extent)
        rates = self._config.rates_at(epoch).by_parameter(self._problem.extent)
        weights = weights_of(self._config.objective)
        self.losses = optimise(self._optimizer, rates, self._losses_at, steps, weights)
        self._objectives.append(sum(weights[name] * loss for name, loss in self.losses.items()))

    @property
    def can_densify(self) -> bool:
        """Whether a round of density control is due, and an epoch has shown where it is needed."""
        return self._attribution is not None

    def densify(self) -> None:
        """Add and prune active Gaussians by density control, once."""
        assert self._attribution is not None
        problem = self._problem
        density = self._config.density
        scores = self._attribution.scores()
        num_static = len(problem.previous) - len(problem.active.indices)
        plan = plan_additions(self.gaussians, scores, density, self._rng, num_static)
        # A birth has the motion of its parent: it starts from the parent's past and shares the
        # residual.
        self._base = apply_plan(self._base, plan)
        self.source = plan.source
        select_rows(self._optimizer, plan.parent, plan.is_birth)
        self._neighbours = None
        self._densifies = False
        self._attribution = None

    def _begin(self, epochs: int = 1) -> Steps:
        """Return the steps of the next epochs, which begin."""
        count = len(self._views)
        epoch = Epoch.after(self.steps, count, epochs)
        self.steps = epoch.stop
        if self._densifies:
            self._attribution = Attribution(len(self.source), epoch.first_score - epoch.first)
        views = self._order[epoch.first : epoch.stop]
        return Steps(views, epoch.first, None, self._report_step, self._attribution, last=count)

    def _report_step(self, step: int) -> None:
        self._progress(step, len(self._order))

    def _losses_at(self, parameters: Mapping[str, Tensor], index: int) -> dict[str, Tensor]:
        """Render one view and return its losses by name."""
        problem = self._problem
        objective = self._config.objective
        view = problem.active.views[index]
        observations = dict(self._observations[index])
        if self._neighbours is not None:
            observations["neighbours"] = self._neighbours
        channels = channels_of(observations, objective)
        # The other terms are about motion and confidence, and must not move opacity and geometry.
        other_channels = [name for name in channels if name != "color"]
        gaussians = apply_residual(self._base, parameters, self._motion)
        features = None if self._attribution is None else self._attribution.features()
        gradients = other_channels if features is None else [*other_channels, "features"]
        image = view.render(gaussians, channels, gradients, features)
        if self._attribution is not None and features is not None:
            self._attribution.observe(image, problem.targets[index], view.region)
        num_pixels = view.camera.width * view.camera.height
        num_gaussians = problem.active.num_gaussians
        prediction = Prediction(
            image, parameters, view.region, num_pixels, num_gaussians, problem.extent, gaussians
        )
        return losses_of(prediction, observations, objective)


def _on_active_views(problem: FrameProblem) -> dict[int, Observations]:
    """Return the observations of each active view as tensors on its region, its target included."""
    return {
        v: {"target": problem.targets[v]}
        | {n: _tensor(a, view) for n, a in problem.observations.get(v, {}).items()}
        for v, view in problem.active.views.items()
    }


def _tensor(array: np.ndarray, view: ActiveView) -> Tensor:
    return from_numpy(mi.TensorXf, view.crop(array))
