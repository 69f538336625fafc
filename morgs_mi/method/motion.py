"""The start of each Gaussian's motion (eq. 5): lifted flow, then motion proposals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.losses.ssim import Target
from morgs_mi.method.active_set import ActiveSet
from morgs_mi.method.config import MotionConfig
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.lift import Lift, lift_flow
from morgs_mi.method.propagation import propagate_motion

__all__ = ["initial_motion"]


def initial_motion(
    previous: Gaussians,
    active: ActiveSet,
    flows: Mapping[int, FlowObservation],
    targets: Mapping[int, Target],
    config: MotionConfig,
    rng: np.random.Generator,
) -> Lift | None:
    """Return the start of motion (eq. 5) and confidence of the active Gaussians; None: no motion, confidence as before.

    Args:
        previous: N Gaussians of the previous frame, detached.
        active: the M active ones, and the active views.
        flows: optical flow of the key views, by view index.
        targets: images of the active views, by view index.
        config: which modules are on.
        rng: draws the neighbours that proposals come from.
    """
    if not (config.learn_motion and config.lift_flow and active.views and len(active.indices)):
        return None
    gaussians = active.select(previous)
    lifted = lift_flow(gaussians, active.views, flows, config.lift, config.masks)
    if config.propagate_motion:
        views = {v: active.views[v] for v in sorted(flows.keys() & active.views.keys())}
        lifted = propagate_motion(gaussians, lifted, views, targets, rng, config.propagation)
    return _only_changed(lifted, active, previous, config)


def _only_changed(lifted: Lift, active: ActiveSet, previous: Gaussians, config: MotionConfig) -> Lift:
    """Return the start in which Gaussians do not move where the surface around them has hardly changed."""
    if active.responsibility is None:
        return lifted
    pooled = active.responsibility.pooled(np.asarray(previous.means), active.indices, config.changed_neighbours)
    moves = pooled > config.min_changed
    logit = np.where(moves, lifted.logit_confidence, -np.inf)
    return Lift(lifted.displacement, logit.astype(np.float32))
