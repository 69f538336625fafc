"""Coarse search: the motion of parts that neither flow nor motion proposals explain.

Beyond the paper. Flow cannot follow a thin part that moves farther than it is wide, and no
neighbour has its motion. It appears as connected Gaussians with colours that their pixels no longer
have. Such a part is searched for as a whole. With the rendering I_{t-1} of the previous Gaussians
in a key view v, and the blend weight m_v of the part there, a displacement d of the part costs

    C(d) = sum_v sum_x m_v(x) |I_t(x + s_v(d)) - I_{t-1}(x)|^2,    s_v(d) its projected shift in px.

Masked template matching gives the inner sums for all shifts of a view at once; the sum over the
views is then looked up on a grid of displacements in 3D. The best one is accepted if the image with
the displaced part is closer to the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import gcd
from typing import Annotated

import cv2
import numpy as np
from annotated_types import Ge, Gt, Le
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from morgs_mi.core.camera import Camera
from morgs_mi.core.color_space import SH_C0
from morgs_mi.core.config import config_class
from morgs_mi.core.gaussians import Gaussians, displaced
from morgs_mi.method.motion_start import MotionProblem, MotionStart
from morgs_mi.method.neighbours import NeighbourIndex
from morgs_mi.render.view_group import ViewGroup

_GRID = 16  # steps of the grid from 0 to its end, in each direction of each axis
# Error of a Gaussian, in medians of all active ones, or in grey levels if the median is less, above
# which it is not explained.
_UNEXPLAINED = 3.0
# Nearest Gaussians that it forms a part with if they are not explained either, and the fewest
# Gaussians of a part.
_NEIGHBOURS = 8
_MIN_SIZE = 4
# Cost of a displacement, relative to no displacement, up to which it is tested.
_COST_RATIO = 0.3
# Error of the images around a part, relative to the error without the displacement, up to which it
# is accepted.
_ERROR_RATIO = 0.8
# Logit of the confidence of a Gaussian that was found, see `propagation`.
_LOGIT = 0.3


@config_class
class SearchConfig:
    """Settings of the coarse search."""

    reach: Annotated[float, Gt(0), Le(1)] = 0.1
    """Longest displacement along each axis, as a fraction of the image width."""
    max_parts: Annotated[int, Ge(0)] = 3
    """Most parts of a frame, those with the largest errors first."""


def search_motion(
    problem: MotionProblem, start: MotionStart, config: SearchConfig | None = None
) -> MotionStart:
    """Return a start of the motion in which parts that were not explained move to where they are
    found.

    If nothing is found, it is `start` itself.

    Args:
        problem: N Gaussians, the key views and their images.
        start: of the motion.
        config: settings.
    """
    config = config or SearchConfig()
    if not problem.views:
        return start
    displacement = start.displacement
    logit = start.logit_confidence
    parts = _unexplained_parts(problem, displacement, config.max_parts)
    for part, d in _find(problem, parts, config.reach):
        proposal = np.where(part[:, None], d, displacement).astype(np.float32)
        if _is_better(problem, part, displacement, proposal):
            displacement = proposal
            logit = np.where(part, np.maximum(logit, _LOGIT), logit)
    if displacement is start.displacement:
        return start
    return replace(start, displacement=displacement, logit_confidence=logit.astype(np.float32))


def _is_better(
    problem: MotionProblem, part: np.ndarray, displacement: np.ndarray, proposal: np.ndarray
) -> bool:
    """Return whether another displacement [N, 3] of a part clearly lowers the error around it."""
    images = problem.images_around(part, [displacement, proposal])
    if images is None:
        return False
    old_error, new_error = (
        images.total_error(displaced(problem.gaussians, at)) for at in (displacement, proposal)
    )
    return new_error < _ERROR_RATIO * old_error


def _unexplained_parts(
    problem: MotionProblem, displacement: np.ndarray, count: int
) -> list[np.ndarray]:
    """Return the `count` parts with the largest errors that are not explained, or fewer, each as a
    mask [N].
    """
    sums = problem.sums_at(displacement)
    error = sums["error"].sum(0)
    unexplained = _unexplained(error, sums["weight"].sum(0))
    if np.count_nonzero(unexplained) < _MIN_SIZE:
        return []
    near = NeighbourIndex(np.asarray(problem.gaussians.means) + displacement).nearest(_NEIGHBOURS)
    label = _connected(near, unexplained)
    size = np.bincount(label, unexplained)
    total = np.bincount(label, np.where(unexplained, error, 0))
    largest = np.argsort(-total, kind="stable")[:count]
    return [label == part for part in largest if size[part] >= _MIN_SIZE]


def _unexplained(error_sums: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the visible Gaussians with large errors, bool [N], from the sums of errors and of
    weights.
    """
    error = error_sums / (weight + 1)
    visible = weight > 1
    if not visible.any():
        return visible
    return visible & (error > _UNEXPLAINED * max(float(np.median(error[visible])), 1 / 255))


def _connected(near: np.ndarray, unexplained: np.ndarray) -> np.ndarray:
    """Return a number [N] that unexplained neighbours have in common; `near` [N, k] are indices."""
    ends = unexplained[:, None] & unexplained[near]
    rows = np.broadcast_to(np.arange(len(near))[:, None], near.shape)[ends]
    graph = coo_array((np.ones(len(rows), bool), (rows, near[ends])), (len(near), len(near)))
    return connected_components(graph, directed=False)[1]


def _find(
    problem: MotionProblem, parts: Sequence[np.ndarray], reach: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the parts that are found elsewhere, each with its displacement [3]."""
    centers = np.asarray(problem.gaussians.means)
    displaced_parts = []
    for first in range(0, len(parts), 3):
        few = parts[first : first + 3]
        for part, surfaces in zip(few, _cost_surfaces(problem, few, reach), strict=True):
            d = _best_displacement(centers[part].mean(axis=0), surfaces, reach)
            if d.any():
                displaced_parts.append((part, d))
    return displaced_parts


def _cost_surfaces(
    problem: MotionProblem, parts: Sequence[np.ndarray], reach: float
) -> list[list[_CostSurface]]:
    """Return the cost surfaces of each of up to three parts, in the views that show it."""
    images = problem.images_around(np.any(parts, axis=0), [])
    if images is None:
        return [[] for _ in parts]
    factor = _reduction(images.group, reach)
    previous = problem.gaussians
    colors, brighter_colors = (
        images.rendered(gaussians, factor) for gaussians in (previous, _brighter(previous, parts))
    )
    views = [
        _MatchedView(view.camera, color, _reduced(problem.targets[v].image(), factor), 1 / factor)
        for (v, view), color in zip(images.views.items(), colors, strict=True)
    ]
    # The weight of a part is the increase of a pixel if the part is brighter by 1.
    weights = [
        np.clip(brighter - color, 0, 1)
        for color, brighter in zip(colors, brighter_colors, strict=True)
    ]
    return [
        _part_surfaces(views, [weight[..., k] for weight in weights]) for k in range(len(parts))
    ]


def _part_surfaces(
    views: Sequence[_MatchedView], weights: Sequence[np.ndarray]
) -> list[_CostSurface]:
    """Return the cost surfaces of a part in the views in which a weight [h, w] is not 0."""
    pairs = zip(views, weights, strict=True)
    return [view.cost_surface(weight) for view, weight in pairs if weight.any()]


def _brighter(gaussians: Gaussians, parts: Sequence[np.ndarray]) -> Gaussians:
    """Return Gaussians with the red, green or blue of up to three parts increased by 1."""
    sh_coeffs = np.array(gaussians.sh_coeffs)
    for k, part in enumerate(parts):
        sh_coeffs[part, 0, k] += 1 / np.float32(SH_C0)
    return replace(gaussians, sh_coeffs=sh_coeffs)


def _best_displacement(
    center: np.ndarray, surfaces: Sequence[_CostSurface], reach: float
) -> np.ndarray:
    """Return the displacement d [3] that costs a part around `center` least; 0 if it hardly saves
    anything.
    """
    if not surfaces:
        return np.zeros(3)

    def cost_of(d: np.ndarray) -> np.ndarray:
        return np.sum([surface.at(center, d) for surface in surfaces], axis=0)

    camera = surfaces[0].camera
    px_per_unit = np.linalg.norm(camera.projection_jacobian(center[None])[0, 0])
    unit = reach * camera.width / _GRID / px_per_unit
    d = np.zeros(3)
    for grid in _grids():
        steps = d + unit * grid
        d = steps[np.argmin(cost_of(steps))]
    at_d, at_rest = cost_of(np.stack([d, np.zeros(3)]))
    return d if at_d < _COST_RATIO * at_rest else np.zeros(3)


def _grids() -> tuple[np.ndarray, np.ndarray]:
    """Return the steps [K, 3] of the whole grid, and quarters of steps around its middle."""
    axes = [np.arange(-_GRID, _GRID + 1)] * 3
    coarse = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return coarse, coarse[np.abs(coarse).max(axis=1) <= 4] / 4


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


@dataclass(frozen=True, eq=False)
class _MatchedView:
    """A view in which parts are looked for, with images reduced to 2 px or more per step of the
    grid.
    """

    camera: Camera  # the view
    rendering: np.ndarray  # rendering of the previous Gaussians around the parts, reduced [h, w, 3]
    target: np.ndarray  # the target, reduced [h, w, 3]
    scale: float  # reduced pixels per pixel

    def cost_surface(self, weight: np.ndarray) -> _CostSurface:
        """Match the pixels of a part with the weight m [h, w], not all 0."""
        box = _box_of(weight > 0.01 * weight.max())
        # In reduced pixels: twice the grid along an axis, as its corners are farther.
        surroundings = _surroundings(self.target, box, 4 * _GRID)
        mask = np.repeat(np.sqrt(weight[box])[..., None], 3, axis=2)  # squared by OpenCV
        cost = cv2.matchTemplate(surroundings, self.rendering[box], cv2.TM_SQDIFF, mask=mask)
        return _CostSurface(np.maximum(cost, 0) / self.scale**2, self.camera, self.scale)


def _box_of(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of the smallest box around a mask [h, w] that is not empty."""
    rows, columns = np.nonzero(mask)
    return np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]


def _surroundings(image: np.ndarray, box: tuple[slice, slice], margin: int) -> np.ndarray:
    """Return a box of an image, enlarged by a margin on all sides; beyond its border, the image is
    continued.
    """
    image = cv2.copyMakeBorder(image, margin, margin, margin, margin, cv2.BORDER_REPLICATE)
    return image[box[0].start : box[0].stop + 2 * margin, box[1].start : box[1].stop + 2 * margin]


def _reduction(group: ViewGroup, reach: float) -> int:
    """Return the factor by which the images of views are reduced: it leaves 2 px per step of the
    grid, if any does.
    """
    widest = max(view.camera.width for view in group.views)
    block = gcd(*group.region.block)
    return next(
        f for f in (4, 2, 1) if f == 1 or (2 * _GRID * f <= reach * widest and block % f == 0)
    )


def _reduced(image: np.ndarray, factor: int) -> np.ndarray:
    """Return the means of an image's squares of `factor` x `factor` pixels."""
    height = image.shape[0] // factor
    width = image.shape[1] // factor
    whole = image[: height * factor, : width * factor]
    return (
        whole if factor == 1 else cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    )
