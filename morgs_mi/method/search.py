"""Coarse search: the motion of parts that neither flow nor motion proposals explain.

Beyond the paper. Flow cannot follow a thin part that moves farther than it is wide, and no
neighbour has its motion. It appears as connected Gaussians with colours that their pixels no longer
have. Such a part is searched for as a whole. With the rendering I_{t-1} of the previous Gaussians
in a key view v, and the blend weight m_v of the part there, a displacement d of the part costs

    C(d) = sum_v sum_x m_v(x) |I_t(x + s_v(d)) - I_{t-1}(x)|^2,    s_v(d) its projected shift in px.

Masked template matching gives the inner sums for all shifts of a view at once; the sum over the
views is then looked up on a grid of displacements in 3D. The best one is accepted if the image with
the displaced part is closer to the target.

Few scenes need it: without it, random scene 28 loses 10 dB where things move (docs/experiments/
field.md), and no recording loses anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import gcd

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import SH_C0
from morgs_mi.core.gaussians import displaced
from morgs_mi.method.cohesion import NEIGHBOURS, NeighbourIndex
from morgs_mi.method.motion_start import SOFT_LOGIT, MotionProblem, MotionStart

# Steps of the grid from 0 to its end, in each direction of each axis: it has 36,000 places.
_GRID = 16
# Error of a Gaussian, in medians of all active ones, or in grey levels if the median is less, above
# which it is not explained.
_UNEXPLAINED = 3.0
# The fewest Gaussians of a part.
_MIN_SIZE = 4
# Cost of a displacement, relative to no displacement, up to which it is tested.
_COST_RATIO = 0.3
# Error of the images around a part, relative to the error without the displacement, up to which it
# is accepted.
_ERROR_RATIO = 0.8
# Longest displacement along each axis, as a fraction of the image width.
_REACH = 0.1
# Most parts of a frame, those with the largest errors first: they are rendered at once, each in a
# colour of its own.
_MAX_PARTS = 3


def search_motion(problem: MotionProblem, start: MotionStart) -> MotionStart:
    """Return a start of the motion in which parts that were not explained move to where they are
    found.

    If nothing is found, it is `start` itself.

    Args:
        problem: N Gaussians, the key views and their images.
        start: of the motion.
    """
    displacement = start.displacement
    logit = start.logit_confidence
    gaussians = problem.gaussians
    masks = _unexplained_parts(problem, displacement, _MAX_PARTS)
    if not masks:
        return start
    for part in _parts_of(problem, masks):
        center = np.asarray(gaussians.means)[part.mask].mean(axis=0)
        d = _best_displacement(center, part.surfaces)
        if not d.any():
            continue
        proposal = np.where(part.mask[:, None], d, displacement).astype(np.float32)
        images = problem.images_around(part.mask, [displacement, proposal])
        if images is None:
            continue
        old_error = images.total_error(displaced(gaussians, displacement))
        new_error = images.total_error(displaced(gaussians, proposal))
        if new_error < _ERROR_RATIO * old_error:
            displacement = proposal
            logit = np.where(part.mask, np.maximum(logit, SOFT_LOGIT), logit)
    if displacement is start.displacement:
        return start
    return replace(start, displacement=displacement, logit_confidence=logit.astype(np.float32))


def _unexplained_parts(
    problem: MotionProblem, displacement: np.ndarray, count: int
) -> list[np.ndarray]:
    """Return the `count` parts with the largest errors that are not explained, or fewer, each as a
    mask [N].
    """
    sums = problem.sums_at(displacement)
    total_error = sums["error"].sum(0)
    weight = sums["weight"].sum(0)
    error = total_error / (weight + 1)
    visible = weight > 1
    if not visible.any():
        return []
    typical = max(float(np.median(error[visible])), 1 / 255)
    unexplained = visible & (error > _UNEXPLAINED * typical)
    if np.count_nonzero(unexplained) < _MIN_SIZE:
        return []
    near = NeighbourIndex(np.asarray(problem.gaussians.means) + displacement).nearest(NEIGHBOURS)
    ends = unexplained[:, None] & unexplained[near]
    rows = np.broadcast_to(np.arange(len(near))[:, None], near.shape)[ends]
    graph = coo_array((np.ones(len(rows), bool), (rows, near[ends])), (len(near), len(near)))
    label = connected_components(graph, directed=False)[1]
    size = np.bincount(label, unexplained)
    total = np.bincount(label, np.where(unexplained, total_error, 0))
    largest = np.argsort(-total, kind="stable")[:count]
    return [label == part for part in largest if size[part] >= _MIN_SIZE]


def _parts_of(problem: MotionProblem, masks: Sequence[np.ndarray]) -> list[_Part]:
    """Return up to three parts, by their masks, with their cost surfaces."""
    parts = [_Part(mask, []) for mask in masks]
    images = problem.images_around(np.any(masks, axis=0), [])
    if images is None:
        return parts
    widest = max(view.camera.width for view in images.views.values())
    factor = _reduction(widest, images.group.region.block)
    # The weight of a part is the increase of a pixel if the part is brighter by 1: in red, green or
    # blue.
    sh_coeffs = np.array(problem.gaussians.sh_coeffs)
    for k, part in enumerate(parts):
        sh_coeffs[part.mask, 0, k] += 1 / np.float32(SH_C0)
    colors = images.rendered(problem.gaussians, factor)
    brighter_colors = images.rendered(replace(problem.gaussians, sh_coeffs=sh_coeffs), factor)
    for v, view in images.views.items():
        color = colors[v]
        target = view.target.image()
        height = target.shape[0] // factor
        width = target.shape[1] // factor
        target = target[: height * factor, : width * factor]
        if factor > 1:
            target = cv2.resize(target, (width, height), interpolation=cv2.INTER_AREA)
        weights = np.clip(brighter_colors[v] - color, 0, 1)
        for k, part in enumerate(parts):
            if weights[..., k].any():
                cost = _matching_cost(target, color, weights[..., k]) * factor**2
                part.surfaces.append(_CostSurface(cost, view.camera, 1 / factor))
    return parts


def _reduction(width: int, block: tuple[int, int]) -> int:
    """Return the factor by which images are reduced: it divides the sides of a block, and leaves 2
    px per step of the grid, if any does.
    """
    side = gcd(*block)
    return next(
        f for f in (4, 2, 1) if f == 1 or (2 * _GRID * f <= _REACH * width and side % f == 0)
    )


def _matching_cost(target: np.ndarray, rendering: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the inner sums of C(d) for all shifts up to a margin, along y and x in pixels.

    Args:
        target: the target [h, w, 3].
        rendering: rendering of the previous Gaussians [h, w, 3].
        weight: m of a part [h, w], not all 0.
    """
    rows, columns = np.nonzero(weight > 0.01 * weight.max())
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    # Twice the grid along an axis, as its corners are farther; beyond its border, the image is
    # continued.
    margin = 4 * _GRID
    wide = cv2.copyMakeBorder(target, margin, margin, margin, margin, cv2.BORDER_REPLICATE)
    surroundings = wide[
        rows.min() : rows.max() + 1 + 2 * margin, columns.min() : columns.max() + 1 + 2 * margin
    ]
    mask = np.repeat(np.sqrt(weight[box])[..., None], 3, axis=2)  # squared by OpenCV
    return np.maximum(cv2.matchTemplate(surroundings, rendering[box], cv2.TM_SQDIFF, mask=mask), 0)


def _best_displacement(center: np.ndarray, surfaces: Sequence[_CostSurface]) -> np.ndarray:
    """Return the displacement d [3] that costs a part around `center` least; 0 if it hardly saves
    anything.
    """
    if not surfaces:
        return np.zeros(3)
    camera = surfaces[0].camera
    px_per_unit = np.linalg.norm(camera.projection_jacobian(center[None])[0, 0])
    unit = _REACH * camera.width / _GRID / px_per_unit
    # The whole grid, then quarters of steps around its best.
    axes = [np.arange(-_GRID, _GRID + 1)] * 3
    coarse = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    fine = coarse[np.abs(coarse).max(axis=1) <= 4] / 4
    d = np.zeros(3)
    for grid in (coarse, fine):
        steps = d + unit * grid
        d = steps[np.argmin(np.sum([surface.at(center, steps) for surface in surfaces], axis=0))]
    ends = np.stack([d, np.zeros(3)])
    at_d, at_rest = np.sum([surface.at(center, ends) for surface in surfaces], axis=0)
    return d if at_d < _COST_RATIO * at_rest else np.zeros(3)


@dataclass(frozen=True, eq=False)
class _Part:
    """Connected Gaussians that are searched for."""

    mask: np.ndarray  # which of all Gaussians, bool [N]
    surfaces: list[_CostSurface]  # in the views that show it


@dataclass(frozen=True, eq=False)
class _CostSurface:
    """The inner sums of C(d) in one view, for all shifts up to its margin."""

    cost: np.ndarray  # [2 M + 1, 2 M + 1], by shift along y and x, in reduced pixels
    camera: Camera  # the view
    scale: float  # reduced pixels per pixel

    def at(self, center: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Return the costs [K] of displacements d [K, 3] of a part around `center` [3]."""
        pixels, _ = self.camera.project(np.concatenate([center[None], center + d]))
        shift = (pixels[1:] - pixels[0]) * self.scale + len(self.cost) // 2
        return map_coordinates(self.cost, shift[:, ::-1].T, order=1, mode="nearest")
