"""Motion proposals from the previous frame and from neighbours, where lifted flow fails.

Flow fails where parts are thin and fast, or look alike. But motion mostly continues, and neighbours
share it. So each Gaussian gets further proposals, as pixels do in PatchMatch (Barnes et al. 2009):
first its own motion of the previous frame, then, in each round, the motion of a random one of its
nearest moving neighbours. All Gaussians try their proposals at once and are rendered in the key
views. With the attributed error E_iv and the coverage W_iv there (see `method.attribution`), the
error of a Gaussian is

    (0.01 px + sum_v E_iv) / (1 px + sum_v W_iv) .

A Gaussian accepts a proposal that clearly lowers its error. Only the surroundings of Gaussians that
may move are rendered.
"""

from __future__ import annotations

import numpy as np

from morgs_mi.core.gaussians import Gaussians, displaced
from morgs_mi.method.motion_start import MotionProblem, MotionStart
from morgs_mi.method.sweep import KeyImages, relative_error

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
    last_motion = _previous_motion(problem.gaussians)
    if not problem.views or not (d.any() or last_motion.any()):
        return start
    near = problem.neighbours.nearest(_NEIGHBOURS)
    moving = np.any([d, last_motion], axis=(0, 2))
    images = problem.images_around(_reached(near, moving, _rounds(near)), (d, last_motion))
    return start if images is None else _propagated(problem, start, images, near)


def _rounds(near: np.ndarray) -> int:
    """Return the number of rounds of proposals from neighbours `near` [N, k]."""
    return _ROUNDS if near.size else 0


def _propagated(
    problem: MotionProblem, start: MotionStart, images: KeyImages, near: np.ndarray
) -> MotionStart:
    """Return a start with the proposals that lower the error in `images`."""
    d = start.displacement
    logit = start.logit_confidence
    error = _error_of(problem, images, d)
    for k in range(1 + _rounds(near)):
        proposal = (
            d[_moving_neighbour(near, d, problem.rng)]
            if k
            else _continued(d, _previous_motion(problem.gaussians))
        )
        differs = np.any(proposal != d, axis=1)
        if not differs.any():
            continue
        new_error = _error_of(problem, images, proposal)
        is_better = differs & (new_error < _error_ratio(d) * error)
        d = np.where(is_better[:, None], proposal, d)
        error = np.where(is_better, new_error, error)
        logit = np.where(is_better, _accepted_logit(logit, d), logit)
    return MotionStart(d, logit.astype(np.float32))


def _error_of(problem: MotionProblem, images: KeyImages, d: np.ndarray) -> np.ndarray:
    """Return the errors [N] of Gaussians displaced by d [N, 3]."""
    return relative_error(images.sums(displaced(problem.gaussians, d), ("error", "weight")))


def _continued(d: np.ndarray, last_motion: np.ndarray) -> np.ndarray:
    """Return the motions [N, 3] into the previous frame, and d for Gaussians that did not move."""
    return np.where(np.any(last_motion, axis=1, keepdims=True), last_motion, d)


def _error_ratio(d: np.ndarray) -> np.ndarray:
    """Return the ratio [N] of errors up to which Gaussians with motions d [N, 3] accept others."""
    return np.where(d.any(axis=1), _ERROR_RATIO, _ERROR_RATIO_STATIC)


def _accepted_logit(logit: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the logits [N] of the confidence of Gaussians that accepted motions d [N, 3]."""
    return np.where(d.any(axis=1), np.maximum(logit, _LOGIT), np.minimum(logit, -_LOGIT))


def _previous_motion(gaussians: Gaussians) -> np.ndarray:
    """Return the motion [N, 3] into the previous frame of those that moved then with confidence, 0
    for the others.
    """
    if gaussians.motion is None:
        return np.zeros((len(gaussians), 3), np.float32)
    motion = np.asarray(gaussians.motion)
    if gaussians.logit_confidence is None:
        return motion
    return np.where(np.asarray(gaussians.logit_confidence)[:, None] > 0, motion, 0)


def _reached(near: np.ndarray, moving: np.ndarray, rounds: int) -> np.ndarray:
    """Return which Gaussians a motion can reach within some rounds, bool [N]."""
    for _ in range(rounds):
        moving = moving | moving[near].any(axis=1)
    return moving


def _moving_neighbour(near: np.ndarray, d: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the index of a random neighbour of each Gaussian [N], a moving one if there is any."""
    draw = np.any(d, axis=1)[near] + rng.random(near.shape, np.float32)
    return near[np.arange(len(near)), draw.argmax(axis=1)]
