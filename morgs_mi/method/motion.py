"""The start of each Gaussian's motion (eq. 5), in stages: lifted flow, proposals, search,
refinement.

A stage returns a better start from the one before. `STARTS` has them in their order, by the
settings that switch them off.

**Proposals.** Flow fails where parts are thin and fast, or look alike. But neighbours share their
motion. So in each round, a Gaussian gets the motion of a random one of its nearest moving
neighbours as a proposal, as pixels do in PatchMatch (Barnes et al. 2009). All Gaussians try their
proposals at once and are rendered in the key views. With the attributed error E_iv and the coverage
W_iv there (see `error_per_gaussian`), the error of a Gaussian is

    (0.01 px + sum_v E_iv) / (1 px + sum_v W_iv) .

A Gaussian accepts a proposal that clearly lowers its error. Only the surroundings of Gaussians that
may move are rendered.

**Refinement** of displacement and colour in closed form, from the key views' images; beyond the
paper. Lifted flow is a fraction of a pixel off, which the few steps of a later frame hardly
correct. With the blend weights w fixed, the error e = target - image of a view is linear in a
Gaussian's displacement (Lucas and Kanade 1981): displaced by delta, it shifts its pixels by J
delta, and with the target's gradient g, per colour component,

    e + g . J delta = 0 .

The least squares over the pixels of the Gaussian and of its nearest moving neighbours j in all key
views v are

    (sum_jv J_jv' G_jv J_jv + lambda I) delta = - sum_jv J_jv' b_jv,
    G = sum_x w g g',    b = sum_x w e g .

A Gaussian accepts the step if its error falls. Then its colour changes by the mean error of its
pixels,

    c = sum_v sum_x w e / (sum_v sum_x w + 10 px) .
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from morgs_mi.core.color_space import SH_C0
from morgs_mi.core.gaussians import Gaussians, displaced
from morgs_mi.core.types import Arrays
from morgs_mi.method.active_set import ActiveSet
from morgs_mi.method.cohesion import NEIGHBOURS, NeighbourIndex, share_confidence
from morgs_mi.method.lift import LOGIT, lift_flow
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_start import SOFT_LOGIT, MotionProblem, MotionStart
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.search import search_motion
from morgs_mi.method.sweep import relative_error

# Rounds of proposals: in two, a motion reaches neighbours of neighbours.
_ROUNDS = 2
# Ratio of the new error to the old one up to which a Gaussian accepts a proposal, if it moves
# otherwise and if not. Others move at the same time: a smaller gain is chance.
_ERROR_RATIO = 0.9
_ERROR_RATIO_STATIC = 0.8
# Weight of the prior that this step is 0, in pixels on which the contrast is 1 per px.
_PRIOR_PIXELS = 1e-3
# Longest step of a refinement, in px of the view where it is longest: farther away, the image is
# not linear, and a Gaussian that leaves the images has no error left that could reject the step.
LONGEST_PX = 2.0
# Covered pixels at which the colour changes by half of the mean error: the mean of few pixels is
# noise.
_HALF_COLOR_PIXELS = 10.0


def refine_start(problem: MotionProblem, start: MotionStart) -> MotionStart:
    """Return a start with refined displacements, and with the change of colour at these
    displacements.

    Args:
        problem: N Gaussians, the key views and their images.
        start: of the motion.
    """
    d = start.displacement
    moves = np.any(d, axis=1)
    start_sums = problem.sums_at(d)
    if not moves.any():
        return replace(start, color_change=_color_change(start_sums["color"], start_sums["weight"]))
    # Their pixels count as well: a small Gaussian alone may cover one straight edge.
    near = problem.neighbours.nearest(NEIGHBOURS)
    places = np.asarray(problem.gaussians.means) + d
    cameras = [view.camera for view in problem.views.values()]
    jacobians = np.stack([camera.projection_jacobian(places) for camera in cameras])
    step = np.where(moves[:, None], _step(jacobians, start_sums, near, moves), 0).astype(np.float32)
    step_sums = problem.images.sums(
        displaced(problem.gaussians, d + step), ("error", "weight", "color")
    )
    better = relative_error(step_sums) < relative_error(start_sums)
    color = np.where(better[:, None], step_sums["color"], start_sums["color"])
    weight = np.where(better, step_sums["weight"], start_sums["weight"])
    return replace(
        start,
        displacement=(d + np.where(better[:, None], step, 0)).astype(np.float32),
        color_change=_color_change(color, weight),
    )


def _color_change(color: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the change c [N, 3] of the constant SH coefficients from the sums of e [V, N, 3] and
    of 1 [V, N].
    """
    return color.sum(0) / (weight.sum(0)[:, None] + _HALF_COLOR_PIXELS) / np.float32(SH_C0)


def _step(jacobians: np.ndarray, sums: Arrays, near: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Return the step delta [N, 3] from J [V, N, 2, 3] and the sums G [V, N, 3] (xx, xy, yy) and b
    [V, N, 2], shortened to `LONGEST_PX` in the view where it is longest.
    """
    G = sums["normal"][..., [0, 1, 1, 2]].reshape(*sums["normal"].shape[:2], 2, 2)
    system = np.einsum("vnia,vnij,vnjb->nab", jacobians, G, jacobians, optimize=True)
    right = -np.einsum("vnia,vni->na", jacobians, sums["right"])
    counts = moves[near].astype(float)
    system = system + np.einsum("nk,nkab->nab", counts, system[near])
    right = right + np.einsum("nk,nka->na", counts, right[near])
    # lambda, which has the unit of J' J.
    prior = max(_PRIOR_PIXELS * np.median(np.sum(jacobians[:, :, 0] ** 2, axis=-1)), 1e-30)
    step = np.linalg.solve(system + prior * np.eye(3), right[..., None])[..., 0]
    length = np.linalg.norm(np.einsum("vnij,nj->vni", jacobians, step), axis=-1).max(axis=0)
    return step * np.minimum(1, LONGEST_PX / np.maximum(length, 1e-30))[:, None]


def propagate_motion(problem: MotionProblem, start: MotionStart) -> MotionStart:
    """Return a start of the motion that explains the images at least as well as `start` does.

    Args:
        problem: N Gaussians, the key views and their images.
        start: by lifted flow.
    """
    d = start.displacement  # [N, 3]
    logit = start.logit_confidence
    near = problem.neighbours.nearest(NEIGHBOURS)
    if not (d.any() and near.size):
        return start
    reached = np.asarray(d.any(axis=1))
    for _ in range(_ROUNDS):  # those that may move within these rounds
        reached = np.logical_or(reached, reached[near].any(axis=1))
    images = problem.images_around(reached, (d,))
    if images is None:
        return start
    names = ("error", "weight")
    error = relative_error(images.sums(displaced(problem.gaussians, d), names))
    for _ in range(_ROUNDS):
        moves = np.asarray(d.any(axis=1))
        # A random neighbour of each Gaussian, a moving one if there is any.
        draw = moves[near] + problem.rng.random(near.shape, np.float32)
        proposal = d[near[np.arange(len(near)), draw.argmax(axis=1)]]
        differs = np.any(proposal != d, axis=1)
        if not differs.any():
            continue
        new_error = relative_error(images.sums(displaced(problem.gaussians, proposal), names))
        ratio = np.where(moves, _ERROR_RATIO, _ERROR_RATIO_STATIC)
        is_better = differs & (new_error < ratio * error)
        d = np.where(is_better[:, None], proposal, d)
        error = np.where(is_better, new_error, error)
        moving = np.maximum(logit, SOFT_LOGIT)
        still = np.minimum(logit, -SOFT_LOGIT)
        accepted = np.where(d.any(axis=1), moving, still)
        logit = np.where(is_better, accepted, logit)
    return MotionStart(d, logit.astype(np.float32))


STARTS: dict[str, Callable[[MotionProblem, MotionStart, MotionConfig], MotionStart]] = {
    "lift_flow": lambda p, start, config: lift_flow(p.gaussians, p.flows),
    "propagate_motion": lambda p, start, config: propagate_motion(p, start),
    "search_motion": lambda p, start, _: search_motion(p, start),
    "refine_start": lambda p, start, config: refine_start(p, start) if config.two_gates else start,
}


def initial_motion(
    previous: Gaussians,
    active: ActiveSet,
    views: Mapping[int, ObservedView],
    config: MotionConfig,
    rng: np.random.Generator,
) -> MotionStart | None:
    """Return the start of the active Gaussians' motion (eq. 5), confidence and colour.

    None: all start as in the previous frame, without motion.

    Args:
        previous: N Gaussians of the previous frame, detached.
        active: the M active ones.
        views: the active views with their images, and of key views the flow, by view index.
        config: which modules are on.
        rng: draws the neighbours that proposals come from.
    """
    if not (views and len(active.indices)):
        return None
    gaussians = active.select(previous)
    start = MotionStart.without_motion(gaussians)
    if not (config.learn_motion and config.lift_flow):
        if not config.constant_velocity:
            return None
        if gaussians.motion is None:
            return start
        return replace(start, displacement=np.asarray(gaussians.motion))
    key_views = {v: views[v] for v in sorted(views) if views[v].flow is not None}
    problem = MotionProblem(gaussians, key_views, rng)
    for name, stage in STARTS.items():
        if getattr(config, name):
            start = stage(problem, start, config)
        if not key_views:  # lifted flow alone has a start: no motion
            break
    neighbours = problem.neighbours
    if gaussians is not previous:
        neighbours = NeighbourIndex(np.asarray(previous.means))
    logit = start.logit_confidence
    shared = share_confidence(previous, active.indices, logit, -LOGIT, neighbours)
    return replace(start, logit_confidence=shared)
