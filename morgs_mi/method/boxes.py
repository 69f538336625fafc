"""Boxes of pixels around projected Gaussians, and the parts of them that masks cover."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians
from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import Float, UInt32
from morgs_mi.render.projection import project
from morgs_mi.render.region import Region
from morgs_mi.render.render_config import RenderConfig

__all__ = ["Boxes", "boxes_around"]

_CELL = 4  # px: views are rendered in blocks, of which this divides the sides


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of N Gaussians in one view, in px; empty where a Gaussian is culled.

    Attributes:
        left: first column [N].
        top: first row [N].
        right: column after the last one [N].
        bottom: row after the last one [N].
    """

    left: UInt32
    top: UInt32
    right: UInt32
    bottom: UInt32

    @property
    def area(self) -> Float:
        """Number of pixels [N]."""
        return mi.Float((self.right - self.left) * (self.bottom - self.top))

    def covered(self, mask: np.ndarray) -> Float:
        """Return the number of pixels [N] of each box that a mask [H, W] covers."""
        pitch = dr.opaque(mi.UInt32, mask.shape[1] + 1)
        table = from_numpy(mi.UInt32, cv2.integral(mask.astype(np.uint8)))

        def sum_before(x: UInt32, y: UInt32) -> UInt32:
            return dr.gather(mi.UInt32, table, y * pitch + x)

        left = sum_before(self.left, self.bottom) - sum_before(self.left, self.top)
        return mi.Float(sum_before(self.right, self.bottom) - sum_before(self.right, self.top) - left)

    def within(self, region: Region, factor: int) -> Float:
        """Return the number of pixels [N] of each box in the blocks of a region, in a view reduced by `factor`.

        The number of pixels before a corner is linear within a block, along x and y: it is interpolated.
        """
        width, height = (factor * side for side in region.block)
        rows, columns = region.grid_shape

        def before(x: UInt32, y: UInt32) -> Float:
            across, down = mi.Float(x) * (1 / width), mi.Float(y) * (1 / height)
            i = dr.minimum(mi.UInt32(across), dr.opaque(mi.UInt32, columns - 1))
            j = dr.minimum(mi.UInt32(down), dr.opaque(mi.UInt32, rows - 1))
            place, pitch = j * dr.opaque(mi.UInt32, columns + 1) + i, dr.opaque(mi.UInt32, columns + 1)
            a, b, c, d = (
                mi.Float(dr.gather(mi.UInt32, region.block_table, place + step)) for step in (0, 1, pitch, pitch + 1)
            )
            u, v = dr.minimum(across - mi.Float(i), 1), dr.minimum(down - mi.Float(j), 1)
            return dr.lerp(dr.lerp(a, b, u), dr.lerp(c, d, u), v)

        right = before(self.right, self.bottom) - before(self.right, self.top)
        left = before(self.left, self.bottom) - before(self.left, self.top)
        return (right - left) * (width * height)

    def union(self, chosen: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Return the mask [H, W] of the union of the `chosen` boxes [N], rounded up to cells of 4 x 4 pixels."""
        x0, y0, x1, y1 = (
            np.asarray(v)[chosen].astype(np.int64) for v in (self.left, self.top, self.right, self.bottom)
        )
        some = (x1 > x0) & (y1 > y0)
        x0, y0 = x0[some] // _CELL, y0[some] // _CELL
        x1, y1 = -(-x1[some] // _CELL), -(-y1[some] // _CELL)
        rows, columns = (-(-size // _CELL) + 1 for size in shape)
        corners = np.concatenate([y0 * columns + x0, y1 * columns + x1, y0 * columns + x1, y1 * columns + x0])
        signs = np.repeat([1.0, -1.0], 2 * len(x0))
        steps = np.bincount(corners, signs, rows * columns).reshape(rows, columns)
        cells = steps.cumsum(0).cumsum(1) > 0.5
        return cells.repeat(_CELL, 0).repeat(_CELL, 1)[: shape[0], : shape[1]]


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
            center, half = splats.shape[axis], core * splats.extent[axis]
            low = dr.clip(dr.floor(center - half), 0, dr.opaque(mi.Float, size))
            high = dr.clip(dr.floor(center + half) + 1, 0, dr.opaque(mi.Float, size))
            corners.append((mi.UInt32(low), mi.UInt32(dr.select(splats.valid, high, low))))
        (left, right), (top, bottom) = corners
        dr.eval(left, top, right, bottom)
    return Boxes(left, top, right, bottom)
