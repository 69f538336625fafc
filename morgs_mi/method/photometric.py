"""Photometric refinement of a frame's start: displacement and colour in closed form, from the key views' images.

Beyond the paper. Lifted flow is a fraction of a pixel off, which the few steps of a later frame hardly correct. With
the blend weights w fixed, the error e = target - image of a view is linear in a Gaussian's displacement (Lucas and
Kanade 1981): displaced by delta, it shifts its pixels by J delta, and with the target's gradient g, per colour
component,

    e + g . J delta = 0 .

The least squares over the pixels of the Gaussian and of its nearest moving neighbours j in all key views v are

    (sum_jv J_jv' G_jv J_jv + lambda I) delta = - sum_jv J_jv' b_jv,    G = sum_x w g g',    b = sum_x w e g .

A Gaussian accepts the step if its error falls. Then its colour changes by the mean error of its pixels,

    c = sum_v sum_x w e / (sum_v sum_x w + 10 px) .
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from morgs_mi.core.color_space import SH_C0
from morgs_mi.core.gaussians import Gaussians, displaced
from morgs_mi.method.image_gradient import image_gradient
from morgs_mi.method.motion_start import MotionProblem, MotionStart
from morgs_mi.method.ssim import Target
from morgs_mi.render.active_view import ActiveView

__all__ = ["mean_color_error", "refine_displacement", "refine_start"]

# Steps of the displacement; more gain nothing before the fit.
_ROUNDS = 1
# Nearest Gaussians. Their pixels count, too, if they move: a small Gaussian alone may cover one straight edge.
_NEIGHBOURS = 8
# Weight of the prior that a step is 0, in pixels on which the contrast is 1 per px.
_PRIOR_PIXELS = 1e-3
# Longest step, in px of the view where it is longest: farther away, the image is not linear.
_LONGEST_PX = 2.0
# Error, in pixels of full contrast, that is added to every Gaussian's error, see `propagation`.
_FLOOR_PX = 0.01
# Covered pixels at which the colour changes by half of the mean error: the mean of few pixels is noise.
_HALF_COLOR_PIXELS = 10.0


def refine_start(problem: MotionProblem, start: MotionStart) -> MotionStart:
    """Return a start with refined displacements, and with the change of colour at these displacements.

    Args:
        problem: N Gaussians, the key views and their images.
        start: of the motion.
    """
    start = refine_displacement(problem, start)
    moved = displaced(problem.gaussians, start.displacement)
    return replace(start, color_change=mean_color_error(moved, problem.views, problem.targets))


def refine_displacement(problem: MotionProblem, start: MotionStart) -> MotionStart:
    """Return a start with displacements that explain the images better; see `refine_start`."""
    previous, targets, d = problem.gaussians, problem.targets, start.displacement
    moves = np.any(d, axis=1)
    views = problem.views_around(moves, [d]) if moves.any() else {}
    if not views:
        return start
    means = np.asarray(previous.means)
    near = problem.neighbours.nearest(_NEIGHBOURS)
    gradients = {v: _gradient(view, targets[v]) for v, view in views.items()}

    def sums_of(d: np.ndarray) -> np.ndarray:
        moved = displaced(previous, d)
        return np.stack([_sums(moved, view, targets[v], gradients[v]) for v, view in views.items()])

    def error_of(sums: np.ndarray) -> np.ndarray:
        return (sums[..., 0].sum(0) + _FLOOR_PX) / (sums[..., 1].sum(0) + 1)

    sums = sums_of(d)
    for _ in range(_ROUNDS):
        jacobians = np.stack([view.camera.projection_jacobian(means + d) for view in views.values()])
        step = np.where(moves[:, None], _step(jacobians, sums, near, moves), 0)
        new_sums = sums_of(d + step)
        better = error_of(new_sums) < error_of(sums)
        d, sums = d + np.where(better[:, None], step, 0), np.where(better[:, None], new_sums, sums)
    return replace(start, displacement=d.astype(np.float32))


def mean_color_error(
    gaussians: Gaussians, views: Mapping[int, ActiveView], targets: Mapping[int, Target]
) -> np.ndarray:
    """Return the change c [N, 3] of the constant SH coefficients that removes the mean error of each Gaussian's pixels.

    Args:
        gaussians: N Gaussians at their start in this frame, detached.
        views: active views of the key views, by view index.
        targets: their images, by view index.
    """
    sums = np.zeros((len(gaussians), 4), np.float32)
    for v, view in views.items():
        error = targets[v].difference(view.render(gaussians).color, view.region)
        sums += view.backproject(gaussians, np.concatenate([error, np.ones_like(error[..., :1])], axis=-1))
    return sums[:, :3] / (sums[:, 3:] + _HALF_COLOR_PIXELS) / np.float32(SH_C0)


def _gradient(view: ActiveView, target: Target) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of a target along x and y, per px, on the pixels of the view."""
    along_x, along_y = image_gradient(target.image())
    return view.crop(along_x), view.crop(along_y)


def _sums(
    gaussians: Gaussians, view: ActiveView, target: Target, gradient: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return the error, the weight, G (xx, xy, yy) and b (x, y) of each Gaussian [N, 7] in a view."""
    error, (x, y) = target.difference(view.render(gaussians).color, view.region), gradient
    products = [np.sum(a * b, axis=-1) for a, b in ((x, x), (x, y), (y, y), (error, x), (error, y))]
    size = np.abs(error).mean(axis=-1)
    return view.backproject(gaussians, np.stack([size, np.ones_like(size), *products], axis=-1))


def _step(jacobians: np.ndarray, sums: np.ndarray, near: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Return the step delta [N, 3] from J [V, N, 2, 3] and the sums [V, N, 7]."""
    G = sums[..., [2, 3, 3, 4]].reshape(*sums.shape[:2], 2, 2)
    system = np.einsum("vnia,vnij,vnjb->nab", jacobians, G, jacobians, optimize=True)
    right = -np.einsum("vnia,vni->na", jacobians, sums[..., 5:])
    counts = moves[near].astype(float)
    system = system + np.einsum("nk,nkab->nab", counts, system[near])
    right = right + np.einsum("nk,nka->na", counts, right[near])
    prior = _PRIOR_PIXELS * np.median(np.sum(jacobians[:, :, 0] ** 2, axis=-1))
    step = np.linalg.solve(system + max(prior, 1e-30) * np.eye(3), right[..., None])[..., 0]
    length = np.linalg.norm(np.einsum("vnij,nj->vni", jacobians, step), axis=-1).max(axis=0)
    return step * np.minimum(1, _LONGEST_PX / np.maximum(length, 1e-30))[:, None]
