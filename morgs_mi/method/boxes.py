"""Boxes of pixels around projected Gaussians, and the blocks of the views that they cover.

All views are computed together: a lane has one Gaussian in one view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy, opaque
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Float, UInt32
from morgs_mi.render.backend import elements
from morgs_mi.render.projection import TracedCameras, project
from morgs_mi.render.region import BlockGrid, quotient, quotient_and_rest
from morgs_mi.render.render_config import RenderConfig


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of N Gaussians in V views, view by view, in px; empty where a Gaussian is culled."""

    grids: Sequence[BlockGrid]  #: All blocks of each view, of one shape.
    left: UInt32  #: First column [V N].
    top: UInt32  #: First row [V N].
    right: UInt32  #: Column after the last one [V N].
    bottom: UInt32  #: Row after the last one [V N].

    @property
    def count(self) -> int:
        """N."""
        return dr.width(self.left) // len(self.grids)

    @property
    def area(self) -> Float:
        """Number of pixels [V N]."""
        return mi.Float((self.right - self.left) * (self.bottom - self.top))

    @property
    def sides(self) -> np.ndarray:
        """Width and height of a block of each view, px [V, 2]."""
        return np.tile(self.grids[0].block, (len(self.grids), 1))

    def of_view(self, index: int) -> Boxes:
        """Return the boxes in one view."""
        lane = dr.arange(mi.UInt32, self.count) + opaque(mi.UInt32, index * self.count)
        sides = (self.left, self.top, self.right, self.bottom)
        return Boxes([self.grids[index]], *(elements(side, lane) for side in sides))

    def total(self, values: Float) -> Float:
        """Return the sum of numbers [V N] over the views [N], in their order."""
        lane = dr.arange(mi.UInt32, self.count)
        count = opaque(mi.UInt32, self.count)
        return sum(elements(values, lane + v * count) for v, _ in enumerate(self.grids))

    def within(self, masks: np.ndarray, sides: np.ndarray) -> Float:
        """Return the number of pixels [V N] of each box in some blocks of its view.

        The number of pixels before a corner is linear within a block, along x and y: it is
        interpolated.

        Args:
            masks: these blocks, bool [V, rows, columns].
            sides: width and height of a block of each view, px [V, 2].
        """
        tables = np.pad(masks, ((0, 0), (1, 0), (1, 0))).cumsum(1).cumsum(2)
        table = from_numpy(mi.UInt32, tables)
        _, rows, columns = masks.shape
        pitch = opaque(mi.UInt32, columns + 1)
        view = quotient(dr.arange(mi.UInt32, dr.width(self.left)), self.count)
        first = view * opaque(mi.UInt32, (rows + 1) * (columns + 1))
        numbers = from_numpy(mi.Float, np.column_stack([1 / sides, sides.prod(axis=1)]))
        per_width, per_height, area = (elements(numbers, 3 * view + k) for k in range(3))

        def before(x: UInt32, y: UInt32) -> Float:
            across = mi.Float(x) * per_width
            down = mi.Float(y) * per_height
            i = dr.minimum(mi.UInt32(across), opaque(mi.UInt32, columns - 1))
            j = dr.minimum(mi.UInt32(down), opaque(mi.UInt32, rows - 1))
            place = first + j * pitch + i
            a, b, c, d = (
                mi.Float(elements(table, place + step)) for step in (0, 1, pitch, pitch + 1)
            )
            u = dr.minimum(across - mi.Float(i), 1)
            v = dr.minimum(down - mi.Float(j), 1)
            return dr.lerp(dr.lerp(a, b, u), dr.lerp(c, d, u), v)

        right = before(self.right, self.bottom) - before(self.right, self.top)
        left = before(self.left, self.bottom) - before(self.left, self.top)
        return (right - left) * area

    def union(self, selection: np.ndarray) -> np.ndarray:
        """Return the blocks that any box of a `selection` touches, bool [V, rows, columns], with as
        many rows and columns as the largest view (see `stacked`).

        Args:
            selection: which boxes, bool [N] or [V, N].
        """
        count = len(self.grids)
        selected = from_numpy(mi.Bool, np.broadcast_to(selection, (count, self.count)).ravel())
        some = selected & (self.right > self.left) & (self.bottom > self.top)
        width, height = self.grids[0].block
        x0 = self.left // width
        y0 = self.top // height
        x1 = (self.right + (width - 1)) // width
        y1 = (self.bottom + (height - 1)) // height
        # Summed over rows and columns, steps at the four corners fill a rectangle.
        rows, columns = np.max([grid.shape for grid in self.grids], axis=0).tolist()
        steps = dr.zeros(mi.Int32, count * (rows + 1) * (columns + 1))
        view = quotient(dr.arange(mi.UInt32, dr.width(self.left)), self.count)
        first = view * opaque(mi.UInt32, rows + 1)
        pitch = opaque(mi.UInt32, columns + 1)
        for x, y, step in ((x0, y0, 1), (x1, y1, 1), (x1, y0, -1), (x0, y1, -1)):
            dr.scatter_add(steps, mi.Int32(step), (first + y) * pitch + x, some)
        numbers = np.asarray(steps).reshape(count, rows + 1, columns + 1)
        return numbers.cumsum(1).cumsum(2)[:, :-1, :-1] > 0


def boxes_around(
    gaussians: Gaussians, cameras: Sequence[Camera], render: RenderConfig, core: float
) -> Boxes:
    """Return the boxes around Gaussians in some views.

    Args:
        gaussians: N >= 1 Gaussians.
        cameras: the views, at least one.
        render: cut-offs.
        core: half side of a box, as a fraction of the Gaussian's extent.
    """
    count = len(gaussians)
    with dr.suspend_grad():
        view, row = quotient_and_rest(dr.arange(mi.UInt32, len(cameras) * count), count)
        splats = project(gaussians, TracedCameras.of(cameras).of_each(view), (), render, row)
        sides = from_numpy(mi.Float, [camera.size for camera in cameras])
        size = mi.Point2f(elements(sides, 2 * view), elements(sides, 2 * view + 1))
        half = core * splats.radius
        low = dr.clip(dr.floor(splats.mean - half), 0, size)
        high = dr.clip(dr.floor(splats.mean + half) + 1, 0, size)
        first = mi.Point2u(low)
        end = mi.Point2u(dr.select(splats.valid, high, low))
        dr.eval(first, end)
    grids = [BlockGrid.of(camera, render) for camera in cameras]
    return Boxes(grids, first.x, first.y, end.x, end.y)
