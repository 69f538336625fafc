"""Every later frame: the gated residual, under all four losses (eq. 13)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.density import apply_plan, plan_additions, resize_optimizer
from morgs_mi.fit.optimise import adam, optimise, values_of, view_order
from morgs_mi.losses.attribution import NOISE_TOLERANCE, densification_scores
from morgs_mi.losses.losses import flow_loss, mask_loss, offset_loss, recon_loss
from morgs_mi.losses.ssim import Target
from morgs_mi.method.active_set import ActiveSet, with_zero_motion
from morgs_mi.method.config import MotionConfig
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.lift import Lift, lift_flow
from morgs_mi.method.propagation import propagate_motion
from morgs_mi.method.residual import apply_residual, residual_parameters
from morgs_mi.render.active_view import ActiveView

__all__ = ["LaterFrame", "fit_later_frame"]


@dataclass(frozen=True, eq=False)
class LaterFrame:
    """What a frame has become.

    Attributes:
        gaussians: M of them, with the flow-guided `motion` and the learned `offset` that moved them.
        source: int [M], each one's index among the N of the frame before, survivors first in ascending order; -1 for
            those born, who come last.
        losses: means over the last pass over the views, by name.
        epochs: passes over the views that were made.
    """

    gaussians: Gaussians
    source: np.ndarray
    losses: dict[str, float]
    epochs: int


def fit_later_frame(
    previous: Gaussians,
    part: ActiveSet,
    targets: Mapping[int, Target],
    cues: Mapping[int, FlowObservation],
    extent: float,
    config: FitConfig,
    motion: MotionConfig,
    rng: np.random.Generator,
    on_step: Callable[[int, int], None] | None = None,
) -> LaterFrame:
    """Fit one frame's residual (eq. 12) by L_recon + L_mask + L_flow + L_off (eq. 13).

    Args:
        previous: N Gaussians of the frame before, detached.
        part: those that may change, and windows onto the views where they may be seen.
        targets: the pictures of these views.
        cues: flow on key views, by view, with masks at keyframes; empty without motion reasoning.
        extent: of the scene in world units.
        config: epochs and rates.
        motion: which modules are on, and their weights.
        rng: draws the views.
        on_step: called with (steps done, steps in all).
    """
    views = sorted(part.views)
    if not views or not len(part.indices):
        return LaterFrame(with_zero_motion(previous), np.arange(len(previous)), {}, 0)
    base = previous if len(part.indices) == len(previous) else previous.select(part.indices)
    lifted = _lifted(base, part, targets, cues, motion, rng)
    optimizer, source = adam(residual_parameters(base, motion, lifted)), np.arange(len(base))
    weights = {"flow": motion.weight_flow, "mask": motion.weight_mask, "offset": motion.weight_offset}
    losses_of = partial(_losses_of, _evidence(part, cues, motion), part, targets, extent, config, motion)
    order = view_order(len(views), config.epochs * len(views), rng)
    tick = None if on_step is None else lambda done: on_step(done, len(order))
    # Enough is settled by then to tell what is missing, and enough is left to put it in its place.
    growth = round(0.625 * config.epochs) if config.density.later_frames else config.epochs
    losses, done = {}, 0
    for epoch in range(config.epochs):
        if epoch == growth:
            with dr.suspend_grad():
                now = apply_residual(base, values_of(optimizer), motion)
            need = densification_scores(
                now, [part.views[v] for v in views], [targets[v] for v in views], NOISE_TOLERANCE
            )
            plan = plan_additions(now, need, config.density, rng, len(previous) - len(part.indices))
            # What is born starts from its parent's past and shares its residual, so that its motion is the parent's.
            base, source = apply_plan(base, plan), plan.source
            resize_optimizer(optimizer, plan)
        steps = [views[k] for k in order[done : done + len(views)]]
        last = losses.get("recon", np.inf)
        losses = optimise(
            optimizer,
            config.rates_at(epoch).by_parameter(extent),
            steps,
            partial(losses_of, base),
            weights,
            None,
            tick,
            done,
            len(views),
        )
        done += len(views)
        if epoch >= growth and losses["recon"] > (1 - config.early_stopping_tolerance) * last:
            break
    with dr.suspend_grad():
        now = apply_residual(base, values_of(optimizer), motion)
    return LaterFrame(*_joined(previous, part, now, source), losses, done // len(views))


def _lifted(
    base: Gaussians,
    part: ActiveSet,
    targets: Mapping[int, Target],
    cues: Mapping[int, FlowObservation],
    motion: MotionConfig,
    rng: np.random.Generator,
) -> Lift | None:
    """Return where motion starts; None: from zero."""
    if not (motion.learn_motion and motion.lift_flow):
        return None
    lifted = lift_flow(base, part.views, cues)
    if not motion.propagate_motion:
        return lifted
    key_views = sorted(cues.keys() & part.views.keys())
    return propagate_motion(base, lifted, {v: part.views[v] for v in key_views}, targets, rng)


def _losses_of(
    evidence: Mapping[int, _Evidence],
    part: ActiveSet,
    targets: Mapping[int, Target],
    extent: float,
    config: FitConfig,
    motion: MotionConfig,
    base: Gaussians,
    values: Mapping[str, Any],
    view: int,
) -> dict[str, Any]:
    """Return the losses of one view by name."""
    gaussians, seen, window = apply_residual(base, values, motion), evidence.get(view), part.views[view]
    maps, pixels = seen.channels if seen else (), window.camera.width * window.camera.height
    image = window.render(gaussians, ("color", *maps), maps if motion.detach_weights else ())
    losses = {"recon": recon_loss(image.color, targets[view], config.dssim_weight, window.region)}
    if seen and "motion" in maps:
        losses["flow"] = flow_loss(image.motion, seen.motion, seen.reliable, pixels)
    if seen and "confidence" in maps:
        losses["mask"] = mask_loss(image.confidence, seen.mask, pixels)
    if "offset" in values:
        losses["offset"] = offset_loss(values["offset"], extent, part.num_gaussians)
    return losses


def _evidence(part: ActiveSet, cues: Mapping[int, FlowObservation], motion: MotionConfig) -> dict[int, _Evidence]:
    return {view: _Evidence(cue, part.views[view], motion) for view, cue in cues.items() if view in part.views}


class _Evidence:
    """A key view's cue as tensors, and the channels that it supervises."""

    def __init__(self, cue: FlowObservation, window: ActiveView, config: MotionConfig) -> None:
        self.channels: tuple[str, ...] = ()
        if config.learn_motion:
            self.channels += ("motion",)
            self.motion = mi.TensorXf(window.crop(cue.motion))
            self.reliable = mi.TensorXf(window.crop(cue.reliable.astype(np.float32)))
        if config.learn_confidence and cue.mask is not None:
            self.channels += ("confidence",)
            self.mask = mi.TensorXf(window.crop(cue.mask.astype(np.float32)))


def _joined(
    previous: Gaussians, part: ActiveSet, changed: Gaussians, source: np.ndarray
) -> tuple[Gaussians, np.ndarray]:
    """Return those that have changed among those that stood still, survivors in order; and each one's `source`."""
    if len(part.indices) == len(previous):
        return changed, source
    others = np.setdiff1d(np.arange(len(previous)), part.indices)
    known = np.concatenate([others, np.where(source < 0, len(previous), part.indices[source])])
    order = np.argsort(known, kind="stable")  # births come last
    everyone = Gaussians.concatenate([with_zero_motion(previous.select(others)), changed])
    return everyone.select(order), np.where(known < len(previous), known, -1)[order]
