"""Motion proposals from the previous frame and from neighbours, where lifted flow fails.

Flow fails where parts are thin and fast, or look alike. But motion mostly continues, and neighbours
share it. So each Gaussian gets further proposals, as pixels do in PatchMatch (Barnes et al. 2009):
first its own motion of the previous frame, then, in each round, the motion of a random one of its
nearest moving neighbours. All Gaussians try their proposals at once and are rendered in the key
views. With the attributed error E_iv and the coverage W_iv there (see `error_per_gaussian`), the
error of a Gaussian is

    (0.01 px + sum_v E_iv) / (1 px + sum_v W_iv) .

A Gaussian accepts a proposal that clearly lowers its error. Only the surroundings of Gaussians that
may move are rendered.
"""

from __future__ import annotations

import numpy as np

from morgs_mi.core.gaussians import displaced
from morgs_mi.method.motion_start import MotionProblem, MotionStart
from morgs_mi.method.sweep import relative_error

# Rounds of proposals from neighbours, after the one from the previous frame.
_ROUNDS = 2
# Nearest Gaussians that a proposal is drawn from.
_NEIGHBOURS = 8
# Ratio of the new error to the old one up to which a Gaussian accepts a proposal, if it moves
# otherwise and if not. Others move at the same time: a smaller gain is chance.
_ERROR_RATIO = 0.9
_ERROR_RATIO_STATIC = 0.8
# Logit of the confidence of a Gaussian that accepted a motion: 0.57, as some accept a wrong one by
# chance.
_LOGIT = 0.3


def propagate_motion(problem: MotionProblem, start: MotionStart) -> MotionStart:
    """Return a start of the motion that explains the images at least as well as `start` does.

    Args:
        problem: N Gaussians, the key views and their images.
        start: by lifted flow.
    """
    d = start.displacement  # [N, 3]
    logit = start.logit_confidence
    # Into the previous frame, of those that moved then with confidence.
    gaussians = problem.gaussians
    last_motion = np.zeros_like(d) if gaussians.motion is None else np.asarray(gaussians.motion)
    if gaussians.logit_confidence is not None:
        confident = np.asarray(gaussians.logit_confidence)[:, None] > 0
        last_motion = np.where(confident, last_motion, 0)
    if not problem.views or not (d.any() or last_motion.any()):
        return start
    near = problem.neighbours.nearest(_NEIGHBOURS)
    rounds = _ROUNDS if near.size else 0
    reached = np.asarray(d.any(axis=1) | last_motion.any(axis=1))
    for _ in range(rounds):  # those that may move within these rounds
        reached = np.logical_or(reached, reached[near].any(axis=1))
    images = problem.images_around(reached, (d, last_motion))
    if images is None:
        return start
    names = ("error", "weight")
    error = relative_error(images.sums(displaced(problem.gaussians, d), names))
    for k in range(1 + rounds):
        moves = np.asarray(d.any(axis=1))
        if k:
            # A random neighbour of each Gaussian, a moving one if there is any.
            draw = moves[near] + problem.rng.random(near.shape, np.float32)
            proposal = d[near[np.arange(len(near)), draw.argmax(axis=1)]]
        else:
            proposal = np.where(np.any(last_motion, axis=1, keepdims=True), last_motion, d)
        differs = np.any(proposal != d, axis=1)
        if not differs.any():
            continue
        new_error = relative_error(images.sums(displaced(problem.gaussians, proposal), names))
        ratio = np.where(moves, _ERROR_RATIO, _ERROR_RATIO_STATIC)
        is_better = differs & (new_error < ratio * error)
        d = np.where(is_better[:, None], proposal, d)
        error = np.where(is_better, new_error, error)
        accepted = np.where(d.any(axis=1), np.maximum(logit, _LOGIT), np.minimum(logit, -_LOGIT))
        logit = np.where(is_better, accepted, logit)
    return MotionStart(d, logit.astype(np.float32))
