"""The start of each Gaussian's motion (eq. 5), in stages: lifted flow, proposals, search,
refinement.

A `Stage` returns a better start from the one before. `STAGES` lists them in their order; settings
switch them off.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.method.active_set import ActiveSet
from morgs_mi.method.cohesion import share_confidence
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.lift import MAX_LOGIT, lift_flow
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_start import MotionProblem, MotionStart
from morgs_mi.method.neighbours import NeighbourIndex
from morgs_mi.method.photometric import refine_start
from morgs_mi.method.propagation import propagate_motion
from morgs_mi.method.search import search_motion
from morgs_mi.method.ssim import Target


@dataclass(frozen=True)
class Stage:
    """One stage of the start of the motion."""

    acts: Callable[[MotionConfig], bool]  #: Whether it is on, by the settings.
    #: (problem, start, settings) -> start.
    run: Callable[[MotionProblem, MotionStart, MotionConfig], MotionStart]


STAGES: tuple[Stage, ...] = (
    Stage(
        lambda config: config.lift_flow,
        lambda p, start, config: lift_flow(p.gaussians, p.views, p.flows, config.masks),
    ),
    Stage(
        lambda config: config.propagate_motion,
        lambda p, start, config: propagate_motion(p, start),
    ),
    Stage(
        lambda config: config.search_motion,
        lambda p, start, config: search_motion(p, start, config.search),
    ),
    Stage(
        lambda config: config.refine_start and config.two_gates,
        lambda p, start, config: refine_start(p, start),
    ),
)

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
    if not (config.learn_motion and config.lift_flow):
        return _constant_velocity(gaussians) if config.constant_velocity else None
    views = {v: active.views[v] for v in sorted(flows.keys() & active.views.keys())}
    problem = MotionProblem(gaussians, views, targets, rng, flows)
    start = _staged_motion(problem, config)
    neighbours = (
        problem.neighbours if gaussians is previous else NeighbourIndex(np.asarray(previous.means))
    )
    logit = _carried_confidence(start, gaussians)
    shared = share_confidence(
        previous, active.indices, logit, -MAX_LOGIT, config.cohesion_weight, neighbours
    )
    return replace(start, logit_confidence=shared)


def _staged_motion(problem: MotionProblem, config: MotionConfig) -> MotionStart:
    """Return the start after all stages that are on."""
    start = MotionStart.without_motion(problem.gaussians)
    for stage in STAGES:
        if stage.acts(config):
            start = stage.run(problem, start, config)
    return start


def _constant_velocity(gaussians: Gaussians) -> MotionStart:
    """Return the motion into the previous frame as the start, with the confidence as it is."""
    start = MotionStart.without_motion(gaussians)
    return (
        start
        if gaussians.motion is None
        else replace(start, displacement=np.asarray(gaussians.motion))
    )


def _carried_confidence(start: MotionStart, gaussians: Gaussians) -> np.ndarray:
    """Return the logits [M] of the previous frame, slightly lowered, or the start's logits where
    these are higher.
    """
    if gaussians.logit_confidence is None:
        return start.logit_confidence
    last_logit = np.asarray(gaussians.logit_confidence)
    return np.maximum(start.logit_confidence, last_logit - np.float32(_CONFIDENCE_DECAY))
