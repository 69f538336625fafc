"""The part of a scene that a frame works on: who may change, and where the views may change with them.

Let c_v be the pixels of view v that have changed, and b_iv the pixels of the box around Gaussian i's two standard
deviations there. Who is responsible for a change is told by the views together: i may change if the sum of
|b_iv and c_v| / |b_iv| over the V_i views that look at i exceeds 5/4, but at least V_i / 10 and at most V_i / 2. What
is hidden now and then by something that moves has changed around it in one view, but not in the others. A change that
nobody would explain so, such as something new before a still background, makes all those responsible who lie on it with
at least half of their box changed. Fewer than five views have too little in common to compare: there a sum of a tenth
is enough.

A view is drawn where somebody who may change is, and left out where nobody is. The others stand still behind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.render.active_view import ActiveView, make_active_view
from morgs_mi.render.config import RenderConfig
from morgs_mi.render.projection import Splats, project
from morgs_mi.render.region import owned_copy

__all__ = ["ActiveSet", "find_active_set", "full_active_set", "with_zero_motion"]

_LEAST_VIEWS, _LEAST_SHARE, _MOST_SHARE, _FILLED = 1.25, 0.1, 0.5, 0.5
# Two standard deviations of an opaque Gaussian, of whose extent three and a third reach the alpha cut-off.
_CORE = 0.6
_CELL = 4
_MANY_VIEWS = 5
# Pixels that nobody explains, in a cluster of 5x5 at least.
_LEAST_CLUSTER = 5


@dataclass(frozen=True, eq=False)
class ActiveSet:
    """What a frame works on.

    Attributes:
        rows: int [M], ascending: the Gaussians that may change, out of N.
        num_gaussians: N.
        windows: onto the views where they may be seen, by view.
        num_views: V, with those that are left out.
    """

    indices: np.ndarray
    num_gaussians: int
    views: Mapping[int, ActiveView]
    num_views: int

    @property
    def fractions(self) -> dict[str, float]:
        """What it takes of the whole, from 0 to 1: of the Gaussians, of the views and of all their pixels."""
        pixels = sum(window.pixel_fraction for window in self.views.values()) / self.num_views
        return {
            "gaussians": len(self.indices) / max(self.num_gaussians, 1),
            "views": len(self.views) / self.num_views,
            "pixels": pixels,
        }


def full_active_set(gaussians: Gaussians, cameras: Sequence[Camera], render: RenderConfig) -> ActiveSet:
    """Return the part that leaves nothing out."""
    windows = {view: ActiveView(camera, render) for view, camera in enumerate(cameras)}
    return ActiveSet(np.arange(len(gaussians)), len(gaussians), windows, len(cameras))


def find_active_set(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    changes: Sequence[np.ndarray],
    channels: Sequence[Sequence[str]],
    render: RenderConfig,
) -> ActiveSet:
    """Return the part that may have to do with what has changed (see the module).

    Args:
        gaussians: N of them, of the frame before, detached.
        cameras: V views.
        changes: what has changed in them, bool [H, W].
        channels: all that will be drawn in each of them.
        render: cut-offs.
    """
    boxes = [_boxes(gaussians, camera, render) for camera in cameras]
    filled, seen, shares = np.zeros(len(gaussians)), np.zeros(len(gaussians)), []
    for box, change in zip(boxes, changes, strict=True):
        share, visible = _filled(box, change)
        filled, seen = filled + share, seen + visible
        shares.append(share)
    least = np.clip(_LEAST_VIEWS, _LEAST_SHARE * seen, _MOST_SHARE * np.maximum(seen, 1))
    # A few views that look from far apart have little to compare: one that has seen a change is enough.
    chosen = filled > (least if len(cameras) >= _MANY_VIEWS else _LEAST_SHARE)
    drawn = [_painted(box, chosen, change.shape) for box, change in zip(boxes, changes, strict=True)]
    more = np.zeros(len(gaussians), bool)
    for box, change, share, known in zip(boxes, changes, shares, drawn, strict=True):
        unexplained = change & ~known
        if unexplained.any() and cv2.erode(unexplained.astype(np.uint8), np.ones((_LEAST_CLUSTER,) * 2)).any():
            more |= (share >= _FILLED) & (_filled(box, unexplained)[0] > 0)
    if (more & ~chosen).any():
        chosen |= more
        drawn = [_painted(box, chosen, change.shape) for box, change in zip(boxes, changes, strict=True)]
    still = with_zero_motion(gaussians.select(~chosen))
    views = enumerate(zip(cameras, drawn, channels, strict=True))
    windows = {view: make_active_view(c, mask, still, names, render) for view, (c, mask, names) in views if mask.any()}
    return ActiveSet(np.flatnonzero(chosen), len(gaussians), windows, len(cameras))


def with_zero_motion(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians that have not moved since the frame before."""
    nothing = np.zeros((len(gaussians), 3))
    return replace(gaussians, motion=nothing, offset=nothing)


def _boxes(gaussians: Gaussians, camera: Camera, render: RenderConfig) -> tuple[Any, ...]:
    """Return the corners (x0, y0, x1, y1) [N], in px, of the boxes around two standard deviations; empty if culled."""
    with dr.suspend_grad():
        splats: Splats = project(gaussians, camera, (), render)
        corners = []
        for axis, size in ((0, camera.width), (1, camera.height)):
            center, half = splats.shape[axis], _CORE * splats.extent[axis]
            low = dr.clip(dr.floor(center - half), 0, dr.opaque(mi.Float, size))
            high = dr.clip(dr.floor(center + half) + 1, 0, dr.opaque(mi.Float, size))
            corners.append((mi.UInt32(low), mi.UInt32(dr.select(splats.valid, high, low))))
        (x0, x1), (y0, y1) = corners
        dr.eval(x0, y0, x1, y1)
    return x0, y0, x1, y1


def _filled(box: tuple[Any, ...], mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of each box that a mask [H, W] fills [N], and whether the view looks at it at all."""
    x0, y0, x1, y1 = box
    pitch, area = dr.opaque(mi.UInt32, mask.shape[1] + 1), (x1 - x0) * (y1 - y0)
    table = owned_copy(mi.UInt32(cv2.integral(mask.astype(np.uint8)).astype(np.uint32).ravel()))

    def before(x: Any, y: Any) -> Any:
        return dr.gather(mi.UInt32, table, y * pitch + x)

    count = before(x1, y1) - before(x0, y1) - before(x1, y0) + before(x0, y0)
    share = dr.select(area > 0, mi.Float(count) / mi.Float(dr.maximum(area, 1)), 0)
    return np.asarray(share, float), np.asarray(area) > 0


def _painted(box: tuple[Any, ...], chosen: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the union [H, W] of the chosen boxes, in cells of 4 x 4 pixels, for blocks are drawn whole."""
    x0, y0, x1, y1 = (np.asarray(v).astype(np.int64)[chosen] for v in box)
    some = (x1 > x0) & (y1 > y0)
    x0, y0 = x0[some] // _CELL, y0[some] // _CELL
    x1, y1 = -(-x1[some] // _CELL), -(-y1[some] // _CELL)
    rows, columns = (-(-size // _CELL) + 1 for size in shape)
    corners = np.concatenate([y0 * columns + x0, y1 * columns + x1, y0 * columns + x1, y1 * columns + x0])
    signs = np.repeat([1.0, -1.0], 2 * len(x0))
    steps = np.bincount(corners, signs, rows * columns).reshape(rows, columns)
    cells = steps.cumsum(0).cumsum(1) > 0.5
    return cells.repeat(_CELL, 0).repeat(_CELL, 1)[: shape[0], : shape[1]]
