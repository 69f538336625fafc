"""Boxes of pixels around projected Gaussians, and the blocks of a view that they cover."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.types import Float, UInt32
from morgs_mi.render.backend import elements
from morgs_mi.render.projection import project
from morgs_mi.render.region import BlockGrid
from morgs_mi.render.render_config import RenderConfig


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of N Gaussians in one view, in px; empty where a Gaussian is culled."""

    left: UInt32  #: First column [N].
    top: UInt32  #: First row [N].
    right: UInt32  #: Column after the last one [N].
    bottom: UInt32  #: Row after the last one [N].

    @property
    def area(self) -> Float:
        """Number of pixels [N]."""
        return mi.Float((self.right - self.left) * (self.bottom - self.top))

    def within(self, table: UInt32, grid: BlockGrid, factor: int = 1) -> Float:
        """Return the number of pixels [N] of each box in some blocks of the view.

        The number of pixels before a corner is linear within a block, along x and y: it is
        interpolated.

        Args:
            table: the `summed_area` of these blocks.
            grid: all blocks of the view, at 1 / `factor` of its resolution.
            factor: by which the view is reduced.
        """
        width, height = (factor * side for side in grid.block)
        rows, columns = grid.shape

        def before(x: UInt32, y: UInt32) -> Float:
            across = mi.Float(x) * (1 / width)
            down = mi.Float(y) * (1 / height)
            i = dr.minimum(mi.UInt32(across), dr.opaque(mi.UInt32, columns - 1))
            j = dr.minimum(mi.UInt32(down), dr.opaque(mi.UInt32, rows - 1))
            place = j * dr.opaque(mi.UInt32, columns + 1) + i
            pitch = dr.opaque(mi.UInt32, columns + 1)
            a, b, c, d = (
                mi.Float(elements(table, place + step)) for step in (0, 1, pitch, pitch + 1)
            )
            u = dr.minimum(across - mi.Float(i), 1)
            v = dr.minimum(down - mi.Float(j), 1)
            return dr.lerp(dr.lerp(a, b, u), dr.lerp(c, d, u), v)

        right = before(self.right, self.bottom) - before(self.right, self.top)
        left = before(self.left, self.bottom) - before(self.left, self.top)
        return (right - left) * (width * height)

    def union(self, selection: np.ndarray, grid: BlockGrid) -> np.ndarray:
        """Return the blocks, bool [rows, columns], that any box of a `selection` [N] touches."""
        rows = np.flatnonzero(selection)
        x0, y0, x1, y1 = (
            np.asarray(v)[rows].astype(np.int64)
            for v in (self.left, self.top, self.right, self.bottom)
        )
        some = (x1 > x0) & (y1 > y0)
        width, height = grid.block
        x0 = x0[some] // width
        y0 = y0[some] // height
        x1 = -(-x1[some] // width)
        y1 = -(-y1[some] // height)
        # Summed over rows and columns, steps at the four corners fill a rectangle.
        rows, columns = (size + 1 for size in grid.shape)
        corners = np.concatenate(
            [y0 * columns + x0, y1 * columns + x1, y0 * columns + x1, y1 * columns + x0]
        )
        signs = np.repeat([1.0, -1.0], 2 * len(x0))
        steps = np.bincount(corners, signs, rows * columns).reshape(rows, columns)
        return (steps.cumsum(0).cumsum(1) > 0.5)[:-1, :-1]


def boxes_around(gaussians: Gaussians, camera: Camera, render: RenderConfig, core: float) -> Boxes:
    """Return the boxes around Gaussians in a view.

    Args:
        gaussians: N Gaussians.
        camera: the view.
        render: cut-offs.
        core: half side of a box, as a fraction of the Gaussian's extent.
    """
    with dr.suspend_grad():
        splats = project(gaussians, camera, (), render)
        corners = []
        for axis, size in ((0, camera.width), (1, camera.height)):
            center = splats.shape[axis]
            half = core * splats.extent[axis]
            low = dr.clip(dr.floor(center - half), 0, dr.opaque(mi.Float, size))
            high = dr.clip(dr.floor(center + half) + 1, 0, dr.opaque(mi.Float, size))
            corners.append((mi.UInt32(low), mi.UInt32(dr.select(splats.valid, high, low))))
        (left, right), (top, bottom) = corners
        dr.eval(left, top, right, bottom)
    return Boxes(left, top, right, bottom)
