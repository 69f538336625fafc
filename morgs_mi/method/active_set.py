"""The active set of a frame: the Gaussians that may change, and the pixels of the views where they are visible.

Let c_v be the changed pixels of view v and b_iv the pixels of the box around two standard deviations of Gaussian i
there. All views decide together: Gaussian i is active if the sum of |b_iv and c_v| / |b_iv| over the V_i views that see
it exceeds 5/4, but at least V_i / 10 and at most V_i / 2. A Gaussian that is occluded now and then by something that
moves has changes around it in one view, but not in the others. A change that no active Gaussian explains, such as a new
object before a static background, activates all Gaussians on it of whose box at least half has changed. Fewer than five
views have too little in common to compare: there a sum of a tenth is enough.

A view is rendered where an active Gaussian is visible, and skipped where none is. All other Gaussians are static
splats.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import UInt32
from morgs_mi.render.active_view import ActiveView, make_active_view
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.projection import project

__all__ = ["ActiveSet", "ActiveSetConfig", "find_active_set", "full_active_set", "with_zero_motion"]

_CELL = 4  # px: views are rendered in blocks, of which this divides the sides

Corners = tuple[UInt32, UInt32, UInt32, UInt32]


@dataclass(frozen=True)
class ActiveSetConfig:
    """Settings of the selection, see the module."""

    min_sum: float = 1.25
    """Sum of the changed fractions over the views above which a Gaussian is active."""
    min_fraction: float = 0.1
    """Lower bound of that sum, as a fraction of the number of views that see the Gaussian."""
    max_fraction: float = 0.5
    """Upper bound of that sum, likewise."""
    min_views: int = 5
    """Views from which on they are compared; with fewer, a sum of `min_fraction` is enough."""
    min_unexplained: float = 0.5
    """Changed fraction of its box from which on an unexplained change activates a Gaussian."""
    min_cluster: int = 5
    """Side of the smallest square of unexplained pixels that counts, in px."""
    core: float = 0.6
    """Half side of the box, as a fraction of the Gaussian's extent: two standard deviations of an opaque one, whose
    extent reaches the alpha cut-off at three and a third."""


@dataclass(frozen=True, eq=False)
class ActiveSet:
    """The Gaussians and pixels that take part in a frame.

    Attributes:
        indices: int [M], ascending: the active Gaussians among N.
        num_gaussians: N.
        views: active views in which they are visible, by view index.
        num_views: V, the views that have an image.
    """

    indices: np.ndarray
    num_gaussians: int
    views: Mapping[int, ActiveView]
    num_views: int

    def select(self, gaussians: Gaussians) -> Gaussians:
        """Return the active ones among N Gaussians."""
        return gaussians if len(self.indices) == len(gaussians) else gaussians.select(self.indices)

    @property
    def fractions(self) -> dict[str, float]:
        """Fractions of the Gaussians, of the views and of all their pixels that are active, from 0 to 1."""
        pixels = sum(view.pixel_fraction for view in self.views.values())
        return {
            "gaussians": len(self.indices) / max(self.num_gaussians, 1),
            "views": len(self.views) / max(self.num_views, 1),
            "pixels": pixels / max(self.num_views, 1),
        }


def full_active_set(gaussians: Gaussians, cameras: Mapping[int, Camera], render: RenderConfig) -> ActiveSet:
    """Return the active set of all Gaussians and of all pixels of the cameras, by view index."""
    views = {view: ActiveView(camera, render) for view, camera in cameras.items()}
    return ActiveSet(np.arange(len(gaussians)), len(gaussians), views, len(cameras))


def find_active_set(
    gaussians: Gaussians,
    cameras: Mapping[int, Camera],
    changes: Mapping[int, np.ndarray],
    channels: Mapping[int, Sequence[str]],
    render: RenderConfig,
    config: ActiveSetConfig | None = None,
) -> ActiveSet:
    """Return the active set of a frame (see the module).

    Args:
        gaussians: N Gaussians of the previous frame, detached.
        cameras: V cameras, by view index.
        changes: masks of their changed pixels, bool [H, W], by view index.
        channels: channels that will be rendered, by view index.
        render: cut-offs.
        config: settings.
    """
    config = config or ActiveSetConfig()
    boxes = {view: _boxes(gaussians, camera, render, config) for view, camera in cameras.items()}
    total, num_seen, fractions = np.zeros(len(gaussians)), np.zeros(len(gaussians)), {}
    for view, box in boxes.items():
        fractions[view], visible = _covered(box, changes[view])
        total, num_seen = total + fractions[view], num_seen + visible
    threshold = np.clip(config.min_sum, config.min_fraction * num_seen, config.max_fraction * np.maximum(num_seen, 1))
    active = total > (threshold if len(cameras) >= config.min_views else config.min_fraction)
    drawn = {view: _union(box, active, changes[view].shape) for view, box in boxes.items()}
    more = np.zeros(len(gaussians), bool)
    for view, box in boxes.items():
        unexplained = changes[view] & ~drawn[view]
        square = np.ones((config.min_cluster, config.min_cluster))
        if unexplained.any() and cv2.erode(unexplained.astype(np.uint8), square).any():
            more |= (fractions[view] >= config.min_unexplained) & (_covered(box, unexplained)[0] > 0)
    if (more & ~active).any():
        active |= more
        drawn = {view: _union(box, active, changes[view].shape) for view, box in boxes.items()}
    static = with_zero_motion(gaussians.select(~active))
    views = {
        view: make_active_view(cameras[view], mask, static, channels[view], render)
        for view, mask in drawn.items()
        if mask.any()
    }
    return ActiveSet(np.flatnonzero(active), len(gaussians), views, len(cameras))


def with_zero_motion(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with a motion and an offset of zero."""
    zero = np.zeros((len(gaussians), 3))
    return replace(gaussians, motion=zero, offset=zero)


def _boxes(gaussians: Gaussians, camera: Camera, render: RenderConfig, config: ActiveSetConfig) -> Corners:
    """Return the corners (x0, y0, x1, y1) [N], in px, of the boxes around the Gaussians; empty if culled."""
    with dr.suspend_grad():
        splats = project(gaussians, camera, (), render)
        corners = []
        for axis, size in ((0, camera.width), (1, camera.height)):
            center, half = splats.shape[axis], config.core * splats.extent[axis]
            low = dr.clip(dr.floor(center - half), 0, dr.opaque(mi.Float, size))
            high = dr.clip(dr.floor(center + half) + 1, 0, dr.opaque(mi.Float, size))
            corners.append((mi.UInt32(low), mi.UInt32(dr.select(splats.valid, high, low))))
        (x0, x1), (y0, y1) = corners
        dr.eval(x0, y0, x1, y1)
    return x0, y0, x1, y1


def _covered(box: Corners, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the fraction of each box that a mask [H, W] covers [N], and whether the box has any pixel [N]."""
    x0, y0, x1, y1 = box
    pitch, area = dr.opaque(mi.UInt32, mask.shape[1] + 1), (x1 - x0) * (y1 - y0)
    table = from_numpy(mi.UInt32, cv2.integral(mask.astype(np.uint8)))

    def sum_before(x: UInt32, y: UInt32) -> UInt32:
        return dr.gather(mi.UInt32, table, y * pitch + x)

    count = sum_before(x1, y1) - sum_before(x0, y1) - sum_before(x1, y0) + sum_before(x0, y0)
    fraction = dr.select(area > 0, mi.Float(count) / mi.Float(dr.maximum(area, 1)), 0)
    return np.asarray(fraction, float), np.asarray(area) > 0


def _union(box: Corners, active: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the mask [H, W] of the union of the active boxes, rounded up to cells of 4 x 4 pixels."""
    x0, y0, x1, y1 = (np.asarray(v).astype(np.int64)[active] for v in box)
    some = (x1 > x0) & (y1 > y0)
    x0, y0 = x0[some] // _CELL, y0[some] // _CELL
    x1, y1 = -(-x1[some] // _CELL), -(-y1[some] // _CELL)
    rows, columns = (-(-size // _CELL) + 1 for size in shape)
    corners = np.concatenate([y0 * columns + x0, y1 * columns + x1, y0 * columns + x1, y1 * columns + x0])
    signs = np.repeat([1.0, -1.0], 2 * len(x0))
    steps = np.bincount(corners, signs, rows * columns).reshape(rows, columns)
    cells = steps.cumsum(0).cumsum(1) > 0.5
    return cells.repeat(_CELL, 0).repeat(_CELL, 1)[: shape[0], : shape[1]]
