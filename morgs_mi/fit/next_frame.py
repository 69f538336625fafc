"""Every later frame: the gated residual, under all four losses (eq. 13)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.capture.camera import Camera
from morgs_mi.fit.config import FitConfig
from morgs_mi.fit.density import NOISE, apply_plan, find_need, plan_additions, regrow
from morgs_mi.fit.losses import Target, flow_loss, mask_loss, offset_loss, recon_loss
from morgs_mi.fit.optimise import adam, optimise, values_of, view_order
from morgs_mi.gaussians.gaussians import Gaussians
from morgs_mi.motion.config import MotionConfig
from morgs_mi.motion.cues import MotionCue
from morgs_mi.motion.lift import lift_flow
from morgs_mi.motion.residual import apply_residual, residual_parameters
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.rasterize import rasterize

__all__ = ["fit_next_frame"]


def fit_next_frame(
    previous: Gaussians,
    cameras: Sequence[Camera],
    targets: Sequence[Target],
    cues: Mapping[int, MotionCue],
    extent: float,
    config: FitConfig,
    motion: MotionConfig,
    render: RenderConfig,
    rng: np.random.Generator,
    on_step: Callable[[int], None] | None = None,
) -> tuple[Gaussians, np.ndarray, dict[str, float]]:
    """Fit one frame's residual (eq. 12) by L_recon + L_mask + L_flow + L_off (eq. 13).

    Args:
        previous: N Gaussians of the frame before, detached.
        cameras: V views.
        targets: their pictures.
        cues: flow on key views, by view, with masks at keyframes; empty without motion reasoning.
        extent: of the scene in world units.
        config: epochs and rates.
        motion: which modules are on, and their weights.
        render: cut-offs.
        rng: draws the views.
        on_step: called with the number of steps done.

    Returns:
        The M Gaussians of this frame; `source` [M], each one's index among the N of the frame before, survivors
        first in ascending order, or -1 for those born, who come last; and the final losses.
    """
    evidence = {view: _Evidence(cue, motion) for view, cue in cues.items()}

    def losses_of(base: Gaussians, values: Mapping[str, Any], view: int) -> dict[str, Any]:
        gaussians, seen = apply_residual(base, values, motion), evidence.get(view)
        maps = seen.channels if seen else ()
        detached = maps if motion.detach_weights else ()
        image = rasterize(gaussians, cameras[view], ("color", *maps), detach_weights=detached, config=render)
        losses = {"recon": recon_loss(image.color, targets[view], config.dssim_weight)}
        if seen and "motion" in maps:
            losses["flow"] = flow_loss(image.motion, seen.motion, seen.reliable)
        if seen and "confidence" in maps:
            losses["mask"] = mask_loss(image.confidence, seen.mask)
        if "offset" in values:
            losses["offset"] = offset_loss(values["offset"], extent)
        return losses

    weights = {"flow": motion.weight_flow, "mask": motion.weight_mask, "offset": motion.weight_offset}
    rates = config.rates.by_parameter(extent)
    views = view_order(len(cameras), config.epochs * len(cameras), rng)
    lifted = lift_flow(previous, cameras, cues, render) if motion.learn_motion and motion.lift_flow else None
    optimizer = adam(residual_parameters(previous, motion, lifted))
    # Enough is settled by then to tell what is missing, and enough is left to put it in its place.
    cut = round(0.625 * config.epochs) * len(cameras) if config.density.later_frames else len(views)
    losses = optimise(optimizer, rates, views[:cut], partial(losses_of, previous), weights, on_step=on_step)
    source = np.arange(len(previous))
    if cut < len(views):
        with dr.suspend_grad():
            now = apply_residual(previous, values_of(optimizer), motion)
        plan = plan_additions(now, find_need(now, cameras, targets, render, NOISE), config.density, rng)
        # What is born starts from its parent's past and shares its residual, so that its motion is the parent's.
        previous, source = apply_plan(previous, plan), plan.source
        regrow(optimizer, plan)
        losses |= optimise(
            optimizer, rates, views[cut:], partial(losses_of, previous), weights, on_step=on_step, first_step=cut
        )
    with dr.suspend_grad():
        return apply_residual(previous, values_of(optimizer), motion), source, losses


class _Evidence:
    """A key view's cue as tensors, and the channels that it supervises."""

    def __init__(self, cue: MotionCue, config: MotionConfig) -> None:
        self.channels: tuple[str, ...] = ()
        if config.learn_motion:
            self.channels += ("motion",)
            self.motion = mi.TensorXf(cue.motion)
            self.reliable = mi.TensorXf(cue.reliable.astype(np.float32))
        if config.learn_confidence and cue.mask is not None:
            self.channels += ("confidence",)
            self.mask = mi.TensorXf(cue.mask.astype(np.float32))
