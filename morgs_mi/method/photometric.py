"""Photometric refinement of a frame's start: displacement and colour in closed form, from the key
views' images.

Beyond the paper. Lifted flow is a fraction of a pixel off, which the few steps of a later frame
hardly correct. With the blend weights w fixed, the error e = target - image of a view is linear in
a Gaussian's displacement (Lucas and Kanade 1981): displaced by delta, it shifts its pixels by J
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

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from morgs_mi.core.color_space import SH_C0
from morgs_mi.core.gaussians import displaced
from morgs_mi.method.motion_start import MotionProblem, MotionStart
from morgs_mi.method.sweep import relative_error

# Nearest Gaussians. Their pixels count, too, if they move: a small Gaussian alone may cover one
# straight edge.
_NEIGHBOURS = 8
# Weight of the prior that a step is 0, in pixels on which the contrast is 1 per px.
_PRIOR_PIXELS = 1e-3
# Longest step, in px of the view where it is longest: farther away, the image is not linear.
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
    if not problem.views:
        return replace(start, color_change=np.zeros((len(problem.gaussians), 3), np.float32))
    d = start.displacement
    moves = np.any(d, axis=1)
    start_sums = problem.sums_at(d)
    if not moves.any():
        return replace(start, color_change=_color_change(start_sums["color"], start_sums["weight"]))
    near = problem.neighbours.nearest(_NEIGHBOURS)
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


def _step(
    jacobians: np.ndarray, sums: Mapping[str, np.ndarray], near: np.ndarray, moves: np.ndarray
) -> np.ndarray:
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
