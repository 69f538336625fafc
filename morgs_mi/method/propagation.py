"""Where each Gaussian's motion starts: from the flow's, from its own of the frame before, or from a neighbour's.

Flow fails where parts are thin and fast, or alike; but what moves mostly goes on as before, and as what lies beside
it. So each Gaussian is offered further displacements, as PatchMatch offers them to pixels (Barnes et al. 2009): first
the one it had, then, twice, that of one of its nearest neighbours that move. All try theirs at once, and are drawn so
on the key views; what each answers for there, E_iv of W_iv pixels (see `density`), makes its error

    (0.01 px + sum_v E_iv) / (1 px + sum_v W_iv) .

Who answers for clearly less error than before keeps the offer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from morgs_mi.core.gaussians import Gaussians
from morgs_mi.losses.attribution import attribute_error
from morgs_mi.losses.ssim import Target
from morgs_mi.method.lift import Lift
from morgs_mi.render.active_view import ActiveView

__all__ = ["propagate_motion"]

_ROUNDS = 2
_NEIGHBOURS = 8
# How much of the error must not be left; others move at the same time, so a little less is chance.
_BETTER = 0.9
# The same for who would stand still else.
_WAKE = 0.8
# px of full contrast: who is hardly seen does not change its mind.
_FLOOR = 0.01
# A confidence of 0.57 for who moves: chance lets some keep an offer that is wrong.
_SURE = 0.3


def propagate_motion(
    previous: Gaussians,
    lifted: Lift,
    windows: Mapping[int, ActiveView],
    targets: Mapping[int, Target],
    rng: np.random.Generator,
) -> Lift:
    """Return a start of the motion that explains the pictures at least as well as the one that the flow gave.

    Args:
        previous: N Gaussians of the frame before, detached; `motion` is how they came there.
        lifted: what the flow says of them.
        windows: onto the key views, by view.
        targets: their pictures, by view.
        rng: draws the neighbours.

    Returns:
        The same or another displacement [N, 3], world units; the confidence follows who has taken an offer.
    """
    d, logit = lifted.displacement, lifted.logit_confidence
    before = np.zeros_like(d) if previous.motion is None else np.asarray(previous.motion)
    if not windows or not (d.any() or before.any()):
        return lifted
    means = np.asarray(previous.means)

    def error_of(d: np.ndarray) -> np.ndarray:
        moved = replace(previous, means=mi.TensorXf(means + d))
        sums = np.sum([attribute_error(moved, windows[view], targets[view]) for view in windows], axis=0)
        return (sums[:, 0] + _FLOOR) / (sums[:, 1] + 1)

    error, near = error_of(d), _nearest(means)
    for k in range(1 + _ROUNDS):
        offer = d[_moving_neighbour(near, d, rng)] if k else np.where(before.any(axis=1)[:, None], before, d)
        other = (offer != d).any(axis=1)
        if not other.any():
            continue
        left = error_of(offer)
        better = other & (left < np.where(d.any(axis=1), _BETTER, _WAKE) * error)
        d, error = np.where(better[:, None], offer, d), np.where(better, left, error)
        moves = np.where(d.any(axis=1), np.maximum(logit, _SURE), np.minimum(logit, -_SURE))
        logit = np.where(better, moves, logit)
    return Lift(d, logit.astype(np.float32))


def _nearest(means: np.ndarray) -> np.ndarray:
    """Return each one's nearest neighbours, [N, 8] or fewer if there are no more."""
    count = min(_NEIGHBOURS + 1, len(means))
    _, near = cKDTree(means).query(means, count, workers=-1)
    return near.reshape(len(means), count)[:, -_NEIGHBOURS:]


def _moving_neighbour(near: np.ndarray, d: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return one of each one's neighbours [N], by chance; one that moves if there is any."""
    draw = d.any(axis=1)[near] + rng.random(near.shape, np.float32)
    return near[np.arange(len(near)), draw.argmax(axis=1)]
