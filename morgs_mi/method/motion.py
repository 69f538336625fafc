"""The start of each Gaussian's motion (eq. 5): lifted flow, proposals, search, refinement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from morgs_mi.core.gaussians import Gaussians, displaced
from morgs_mi.losses.ssim import Target
from morgs_mi.method.active_set import ActiveSet
from morgs_mi.method.cohesion import share_confidence
from morgs_mi.method.config import MotionConfig
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.lift import Lift, lift_flow
from morgs_mi.method.photometric import mean_color_error, refine_displacement
from morgs_mi.method.propagation import propagate_motion
from morgs_mi.method.search import search_motion

__all__ = ["initial_motion"]


def initial_motion(
    previous: Gaussians,
    active: ActiveSet,
    flows: Mapping[int, FlowObservation],
    targets: Mapping[int, Target],
    config: MotionConfig,
    rng: np.random.Generator,
) -> Lift | None:
    """Return the start of the active Gaussians' motion (eq. 5), confidence and colour.

    None: all start as in the previous frame, without motion.

    Args:
        previous: N Gaussians of the previous frame, detached.
        active: the M active ones, and the active views.
        flows: optical flow of the key views, by view index.
        targets: images of the active views, by view index.
        config: which modules are on.
        rng: draws the neighbours that proposals come from.
    """
    if not (active.views and len(active.indices)):
        return None
    gaussians = active.select(previous)
    if not (config.learn_motion and config.lift_flow):
        return _constant_velocity(gaussians) if config.constant_velocity else None
    start = lift_flow(gaussians, active.views, flows, config.lift, config.masks)
    views = {v: active.views[v] for v in sorted(flows.keys() & active.views.keys())}
    if config.propagate_motion:
        start = propagate_motion(gaussians, start, views, targets, rng, config.propagation)
    if config.search_motion:
        start = search_motion(gaussians, start, views, targets, config.search)
    if config.refine_start and config.two_gates:
        start = refine_displacement(gaussians, start, views, targets, config.photometric)
        moved = displaced(gaussians, start.displacement)
        start = replace(start, color_change=mean_color_error(moved, views, targets, config.photometric))
    return replace(start, logit_confidence=_initial_confidence(start, active, previous, config))


def _constant_velocity(gaussians: Gaussians) -> Lift:
    """Return the motion into the previous frame as the start, with the confidence as it is."""
    means, logit = np.asarray(gaussians.means), gaussians.logit_confidence
    displacement = np.zeros_like(means) if gaussians.motion is None else np.asarray(gaussians.motion)
    return Lift(displacement, np.zeros(len(means), np.float32) if logit is None else np.asarray(logit))


def _initial_confidence(lifted: Lift, active: ActiveSet, previous: Gaussians, config: MotionConfig) -> np.ndarray:
    """Return the logits [M] that a frame's confidence starts from.

    They are those of the previous frame, a little lower, or those of lifted flow where they are higher, shared among
    neighbours.
    """
    logit = lifted.logit_confidence
    if previous.logit_confidence is not None:
        before = np.asarray(previous.logit_confidence)[active.indices]
        logit = np.maximum(logit, before - np.float32(config.confidence_decay))
    return share_confidence(previous, active.indices, logit, -config.lift.max_logit, config.cohesion)
