"""A later frame: its gated residual (eq. 12) under the objective (eq. 13)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.progress import Progress
from morgs_mi.core.types import Tensor
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.density import apply_plan, plan_additions, resize_optimizer
from morgs_mi.fit.motion_stage import fit_motion, motion_model
from morgs_mi.fit.optimise import adam, optimise, values_of, view_order
from morgs_mi.losses.attribution import densification_scores
from morgs_mi.losses.ssim import Target
from morgs_mi.method.active_set import ActiveSet, with_zero_motion
from morgs_mi.method.config import MotionConfig
from morgs_mi.method.flow import choose_key_views
from morgs_mi.method.lift import Lift
from morgs_mi.method.objective import Observations, Prediction, channels_of, losses_of, weights_of
from morgs_mi.method.residual import apply_residual, residual_parameters
from morgs_mi.method.rigidity import find_neighbours
from morgs_mi.render.active_view import ActiveView

__all__ = ["FrameProblem", "LaterFrame", "fit_later_frame"]


@dataclass(frozen=True, eq=False)
class FrameProblem:
    """What one later frame is fitted to.

    Attributes:
        previous: N Gaussians of the previous frame, detached.
        active: the active Gaussians and views.
        targets: images of the active views, by view index.
        observations: of the key views, arrays [H, W, ...] by name, by view index.
        start: start of motion and confidence of the M active Gaussians; None: no motion, confidence as before.
        extent: of the scene in world units.
    """

    previous: Gaussians
    active: ActiveSet
    targets: Mapping[int, Target]
    observations: Mapping[int, Mapping[str, np.ndarray]]
    start: Lift | None
    extent: float


@dataclass(frozen=True, eq=False)
class LaterFrame:
    """Result of fitting one later frame.

    Attributes:
        gaussians: M Gaussians, with the `motion` that moved them and the learned `offset` that is part of it.
        source: int [M], index of each Gaussian in the previous frame, ascending; -1 for births, which come last.
        losses: means over the last epoch, by the names of the terms.
        epochs: number of epochs that were run.
    """

    gaussians: Gaussians
    source: np.ndarray
    losses: dict[str, float]
    epochs: int


def fit_later_frame(
    problem: FrameProblem,
    config: FitConfig,
    motion: MotionConfig,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> LaterFrame:
    """Fit one frame's residual (eq. 12) by L_recon + L_mask + L_flow + L_off (eq. 13).

    Args:
        problem: what it is fitted to.
        config: epochs, rates, weights of the losses, density control.
        motion: which modules are on.
        rng: draws the order of the views and the positions of births.
        progress: of the steps.
    """
    previous, active = problem.previous, problem.active
    views = sorted(active.views)
    if not views or not len(active.indices):
        return LaterFrame(with_zero_motion(previous), np.arange(len(previous)), {}, 0)
    base, source = active.select(previous), np.arange(len(active.indices))
    losses_at = partial(_losses_at, problem, _on_active_views(problem), config, motion)
    order = [views[k] for k in view_order(len(views), config.epochs * len(views), rng)]
    tick = None if progress is None else lambda done: progress(done, len(order))
    density_epoch = round(config.density.later_round * config.epochs)
    start, losses, first_epoch = problem.start, {}, 0
    if (model := motion_model(base, problem.extent, motion, rng)) is not None:
        first_epoch = max(1, round(motion.model_share * config.epochs))
        how = order[: first_epoch * len(views)], config.objective.dssim_weight, tick
        start, losses = fit_motion(base, model, start, active.views, problem.targets, *how)
    optimizer, done = adam(residual_parameters(base, motion, start)), first_epoch * len(views)
    neighbours = _neighbours(base, problem, config)
    for epoch in range(first_epoch, config.epochs):
        if epoch == density_epoch and config.density.later_frames:
            now = _current(base, optimizer, motion)
            scores = densification_scores(
                now, *_spread(problem, config.density.later_views), config.density.noise_tolerance
            )
            plan = plan_additions(now, scores, config.density, rng, len(previous) - len(active.indices))
            # A birth starts from its parent's past and shares its residual, so that its motion is the parent's.
            base, source = apply_plan(base, plan), plan.source
            neighbours = _neighbours(base, problem, config)
            resize_optimizer(optimizer, plan)
        last_recon = losses.get("recon", np.inf)
        losses = optimise(
            optimizer,
            {**config.rates_at(epoch).by_parameter(problem.extent), "logit_gate": motion.gates.rate},
            order[done : done + len(views)],
            partial(losses_at, base, neighbours),
            weights_of(config.objective),
            on_step=tick,
            first_step=done,
            last=len(views),
        )
        done += len(views)
        tolerance = config.early_stopping_tolerance
        if tolerance and epoch >= density_epoch and losses["recon"] > (1 - tolerance) * last_recon:
            break
    gaussians, source = _merge(previous, active, _current(base, optimizer, motion), source)
    return LaterFrame(gaussians, source, losses, done // len(views))


def _current(base: Gaussians, optimizer: Mapping[str, Tensor], motion: MotionConfig) -> Gaussians:
    with dr.suspend_grad():
        return apply_residual(base, values_of(optimizer), motion)


def _spread(problem: FrameProblem, count: int) -> tuple[list[ActiveView], list[Target]]:
    """Return `count` active views that are spread over the rig, or all if there are fewer, and their targets."""
    indices = sorted(problem.active.views)
    chosen = choose_key_views([problem.active.views[v].camera for v in indices], count)
    return [problem.active.views[indices[k]] for k in chosen], [problem.targets[indices[k]] for k in chosen]


def _neighbours(base: Gaussians, problem: FrameProblem, config: FitConfig) -> Observations:
    """Return the observation of all views that compares neighbours, if a term does."""
    objective = config.objective
    found = find_neighbours(base, problem.extent, objective.rigidity) if objective.is_rigid else None
    return {} if found is None else {"neighbours": found}


def _on_active_views(problem: FrameProblem) -> dict[int, Observations]:
    """Return the observations of each active view as tensors on its region, its target included."""
    return {
        v: {"target": problem.targets[v]} | {n: _tensor(a, view) for n, a in problem.observations.get(v, {}).items()}
        for v, view in problem.active.views.items()
    }


def _tensor(array: np.ndarray, view: ActiveView) -> Tensor:
    return from_numpy(mi.TensorXf, view.crop(array))


def _losses_at(
    problem: FrameProblem,
    observations: Mapping[int, Observations],
    config: FitConfig,
    motion: MotionConfig,
    base: Gaussians,
    neighbours: Observations,
    parameters: Mapping[str, Tensor],
    view_index: int,
) -> dict[str, Tensor]:
    """Render one view and return its losses by name."""
    view, observed = problem.active.views[view_index], {**observations[view_index], **neighbours}
    channels = channels_of(observed, config.objective)
    detached = [name for name in channels if name != "color"] if config.objective.detach_weights else ()
    now = apply_residual(base, parameters, motion)
    image = view.render(now, channels, detached)
    num_pixels, num_gaussians = view.camera.width * view.camera.height, problem.active.num_gaussians
    prediction = Prediction(image, parameters, view.region, num_pixels, num_gaussians, problem.extent, now)
    return losses_of(prediction, observed, config.objective)


def _merge(
    previous: Gaussians, active: ActiveSet, changed: Gaussians, source: np.ndarray
) -> tuple[Gaussians, np.ndarray]:
    """Return the changed Gaussians among the static ones, in the order of the previous frame, and their `source`."""
    if len(active.indices) == len(previous):
        return changed, source
    is_static = np.ones(len(previous), bool)
    is_static[active.indices] = False
    static = np.flatnonzero(is_static)
    known = np.concatenate([static, np.where(source < 0, len(previous), active.indices[source])])
    order = np.argsort(known, kind="stable")  # births come last
    everything = Gaussians.concatenate([with_zero_motion(previous.select(static)), changed])
    return everything.select(order), np.where(known < len(previous), known, -1)[order]
