"""The start of each Gaussian's motion (eq. 5), in stages: lifted flow, proposals, search,
refinement.

A stage returns a better start from the one before. `STARTS` has them in their order, by the
settings that switch them off.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.method.active_set import ActiveSet
from morgs_mi.method.cohesion import NeighbourIndex, share_confidence
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.lift import MAX_LOGIT, lift_flow
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_start import MotionProblem, MotionStart
from morgs_mi.method.photometric import refine_start
from morgs_mi.method.propagation import propagate_motion
from morgs_mi.method.search import search_motion
from morgs_mi.method.ssim import Target

STARTS: dict[str, Callable[[MotionProblem, MotionStart, MotionConfig], MotionStart]] = {
    "lift_flow": lambda p, start, config: lift_flow(p.gaussians, p.views, p.flows, config.masks),
    "propagate_motion": lambda p, start, config: propagate_motion(p, start),
    "search_motion": lambda p, start, config: search_motion(p, start, config.search),
    "refine_start": lambda p, start, config: refine_start(p, start) if config.two_gates else start,
}

# Logit that a confidence loses per frame without evidence of motion: where something moved, more is
# to correct.
_CONFIDENCE_DECAY = 0.3


def initial_motion(
    previous: Gaussians,
    active: ActiveSet,
    flows: Mapping[int, FlowObservation],
    targets: Mapping[int, Target],
    config: MotionConfig,
    rng: np.random.Generator,
) -> MotionStart | None:
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
    start = MotionStart.without_motion(gaussians)
    if not (config.learn_motion and config.lift_flow):
        if not config.constant_velocity or gaussians.motion is None:
            return start if config.constant_velocity else None
        return replace(start, displacement=np.asarray(gaussians.motion))
    views = {v: active.views[v] for v in sorted(flows.keys() & active.views.keys())}
    problem = MotionProblem(gaussians, views, targets, rng, flows)
    for name, stage in STARTS.items():
        if getattr(config, name):
            start = stage(problem, start, config)
    logit = start.logit_confidence
    if gaussians.logit_confidence is not None:
        last_logit = np.asarray(gaussians.logit_confidence)
        logit = np.maximum(logit, last_logit - np.float32(_CONFIDENCE_DECAY))
    neighbours = problem.neighbours
    if gaussians is not previous:
        neighbours = NeighbourIndex(np.asarray(previous.means))
    shared = share_confidence(
        previous, active.indices, logit, -MAX_LOGIT, config.cohesion_weight, neighbours
    )
    return replace(start, logit_confidence=shared)
