"""Memory layout of images as planes, and the runs of rows over which a separable window walks.

A strip is 8 pixels wide, a column 16 strips. The three components of an image [H, W, 3] are stored
one after the other, each column by column, and a column row by row: 16 SIMD lanes that walk down 16
neighbouring strips read one contiguous section of memory. Two strips of zeros lie on either side of
an image: derivatives of windows there are 0, and are read.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy, opaque
from morgs_mi.core.types import Arrays, Bool, Float, Int32, Jit, Matrix3f, UInt32, Vector2f
from morgs_mi.render.backend import elements
from morgs_mi.render.region import DrawnBlocks, Region, quotient_and_rest

RUN = ("left", "middle", "right", "first", "end", "columns")
"""Names of the arrays of runs, see `Lanes.of`."""

RADIUS = 5
STRIP = 8  # pixels wide: a window extends at most into the next strip
COLUMN = 16  # strips
_SPARE = 2  # strips on either side
# Weight of an outer row of Sobel's filter, whose differences are of two pixels; the middle row has
# twice as much.
_SOBEL = 0.125
# Rows of a run: enough that the 10 rows before it cost little, few enough to occupy every thread.
_LONGEST = 64


@dataclass(frozen=True)
class Lanes:
    """Runs of rows of strips, in all three planes, one for each SIMD lane."""

    #: Places of row 0 of the strip to the left, of the strip, and of the one to the right, in
    #: strips.
    places: tuple[UInt32, UInt32, UInt32]
    first: Int32  #: First row.
    end: Int32  #: Row past the last.
    columns: UInt32  #: Number of the strip's columns that lie in the image, 0 to 8.

    @classmethod
    def of(cls, runs: Mapping[str, Any]) -> Lanes:
        """Return the lanes of some runs: arrays of NumPy or Dr.Jit by name, the places as ``left``,
        ``middle`` and ``right``.
        """
        kinds = {"first": mi.Int32, "end": mi.Int32}
        left, middle, right, first, end, columns = (
            values if dr.is_array_v(values) else from_numpy(kinds.get(name, mi.UInt32), values)
            for name, values in runs.items()
        )
        return cls((left, middle, right), first, end, columns)


class Planes:
    """The layout of an image [H, W, 3] in planes."""

    def __init__(self, height: int, width: int) -> None:
        self.height = height
        self.width = width
        self.num_strips = -(-width // STRIP)
        self.num_columns = -(-(self.num_strips + 2 * _SPARE) // COLUMN)
        self.size = 3 * self.num_columns * height * COLUMN * STRIP

    def of(self, image: Float) -> Float:
        """Return the planes of a flat image [H * W * 3] in memory allocated by Dr.Jit (see
        `owned_copy`).
        """
        target = dr.empty(mi.Float, self.size)
        strip, y, places = self._strips(self.num_columns * COLUMN)
        strip = strip - _SPARE
        if self.width % STRIP == 0:
            strips = opaque(mi.UInt32, self.num_strips)
            reads = [
                read_packet(image, 3 * (y * strips + strip) + k, strip < strips) for k in range(3)
            ]
            values = [v for read in reads for v in read]
        else:
            values = [dr.gather(mi.Float, image, *number) for number in self._numbers(strip, y)]
        for component, place in enumerate(places):
            write_packet(target, values[component::3], place)
        return target

    def image(self, planes: Float) -> Float:
        """Return the flat image [H * W * 3] of planes."""
        target = dr.empty(mi.Float, 3 * self.height * self.width)
        strip, y, places = self._strips(self.num_strips, _SPARE)
        rows = zip(*(read_packet(planes, place) for place in places), strict=True)
        values = [v for pixel in rows for v in pixel]
        if self.width % STRIP == 0:
            for k in range(3):
                lane = 3 * (y * opaque(mi.UInt32, self.num_strips) + strip) + k
                write_packet(target, values[STRIP * k : STRIP * (k + 1)], lane)
        else:
            for value, (place, valid) in zip(values, self._numbers(strip, y), strict=True):
                dr.scatter(target, value, place, valid, mode=dr.ReduceMode.NoConflicts)
        return target

    def on(self, planes: Float, region: DrawnBlocks | None) -> Float:
        """Return the flat image of planes on a region, 0 outside the view; None: of the view."""
        if region is None or region.whole:
            return self.image(planes)
        places, valid = self.places_on(region)
        return dr.gather(mi.Float, planes, places, active=valid)

    def _numbers(self, strip: UInt32, y: UInt32) -> list[tuple[UInt32, Bool]]:
        """Return (place in the flat image, in the view) of each number of a strip of a row."""
        width = opaque(mi.UInt32, self.width)
        x = strip * STRIP
        first = 3 * (y * width + x)
        return [(first + k, x + k // 3 < width) for k in range(3 * STRIP)]

    def _strips(self, count: int, first: int = 0) -> tuple[UInt32, UInt32, list[UInt32]]:
        """Return (strip, row) of `count` strips of every row, and the place of strip `first` +
        strip in each plane.
        """
        y, strip = quotient_and_rest(dr.arange(mi.UInt32, self.height * count), count)
        x = (strip + first) * STRIP - _SPARE * STRIP
        return (
            strip,
            y,
            [self._place(mi.UInt32(component), y, x) // STRIP for component in range(3)],
        )

    def _place(self, component: Jit, y: Jit, x: Jit) -> Jit:
        """Return the place of a number; all arguments are integers, NumPy's or Dr.Jit's."""
        sizes: Any = self.height, self.num_columns
        if dr.is_jit_v(x):
            sizes = (opaque(mi.UInt32, size) for size in sizes)
        height, num_columns = sizes
        x = x + _SPARE * STRIP
        column = component * num_columns + x // (COLUMN * STRIP)
        return (column * height + y) * (COLUMN * STRIP) + x % (COLUMN * STRIP)

    def places_on(self, region: DrawnBlocks) -> tuple[UInt32, Bool]:
        """Return the places of the numbers of a flat image on a region, and the mask of those in
        the view.
        """
        component, x, y = self._pixels_of(region)
        valid = (x < opaque(mi.UInt32, self.width)) & (y < opaque(mi.UInt32, self.height))
        return dr.select(valid, self._place(component, y, x), 0), valid

    def gradient_on(self, planes: Float, region: Region) -> Vector2f:
        """Return the derivatives of an image in `planes` along x and y on a region, flat, per px,
        by Sobel's filter.
        """
        component, x, y = self._pixels_of(region)
        xs = _neighbours(x, self.width)
        ys = _neighbours(y, self.height)
        near = [[elements(planes, self._place(component, b, a)) for a in xs] for b in ys]
        neighbours = mi.Matrix3f(near)
        gradient = mi.Vector2f(_slope(neighbours), _slope(neighbours.T))
        dr.eval(gradient)
        return gradient

    def _pixels_of(self, region: DrawnBlocks) -> tuple[UInt32, UInt32, UInt32]:
        """Return (component, x, y) of the numbers of a flat image on a region."""
        lane = dr.arange(mi.UInt32, 3 * region.num_pixels)
        pixel = lane // 3
        return lane - 3 * pixel, *region.pixels(pixel)

    def runs(self, region: Region | None, reach: int) -> tuple[Arrays, int]:
        """Return the runs that cover a region, or the whole view, and `reach` <= 8 pixels around
        it, as `Lanes.of` takes them, and how many numbers of the image they cover.
        """
        return self._runs(self._cells(region, reach), 1)

    def runs_around(self, region: Region, reach: int) -> Arrays:
        """Return the runs of all that windows read whose centres are in `runs`, likewise."""
        cells = self._cells(region, reach)
        wide = cv2.copyMakeBorder(cells, 0, 0, 1, 1, cv2.BORDER_CONSTANT)
        return self._runs(_within(wide, reach), 2)[0]

    def _cells(self, region: Region | None, reach: int) -> np.ndarray:
        """Return the strips of each row, and one on either side, that `runs` cover: uint8, 1 where
        they do.
        """
        cells = np.zeros((self.height, self.num_strips + 2), np.uint8)
        inner = cells[:, 1:-1]
        if region is None:
            inner[:] = 1
        else:
            width, height = region.block
            first = STRIP * np.arange(self.num_strips)
            last = np.minimum(first + STRIP, self.width) - 1
            # A strip lies in two blocks at most.
            strips = region.drawn[:, first // width] | region.drawn[:, last // width]
            inner[:] = strips.repeat(height, axis=0)[: self.height]
        if reach:  # those within `reach` rows, or in the next strip, too
            cells = _within(cells, reach)
            cells[:, 0] = cells[:, 1]
            cells[:, -1] = cells[:, -2]
        return cells

    def _runs(self, cells: np.ndarray, margin: int) -> tuple[Arrays, int]:
        """Return the runs of some strips of each row, of which `margin` lie on either side of the
        image, and how many numbers of the image they cover.
        """
        # The runs of cells in each column, in parts that are not too long: a row of zeros is before
        # every column, and after the last one.
        rows = self.height + 1
        edges = np.zeros(cells.shape[1] * rows + 1, np.uint8)
        edges[:-1].reshape(-1, rows)[:, 1:] = cells.T
        first, end = np.flatnonzero(edges[1:] != edges[:-1]).reshape(-1, 2).T
        strip = first // rows
        first = first - strip * rows
        end = end - strip * rows
        parts = -(-(end - first) // _LONGEST)
        index = np.repeat(np.arange(len(strip)), parts)
        part = np.arange(len(index)) - np.repeat(parts.cumsum() - parts, parts)
        first = first[index] + _LONGEST * part
        end = np.minimum(end[index], first + _LONGEST)
        strip = strip[index] - margin  # the first one of the image is 0
        # The lanes of a packet are neighbours in one column.
        order = np.lexsort((strip, first, (strip + _SPARE) // COLUMN))
        strip = strip[order]
        first = first[order]
        end = end[order]
        columns = np.clip(self.width - strip * STRIP, 0, STRIP) * (strip >= 0)
        count = 3 * int(((end - first) * columns).sum())
        # In all three planes, one after the other.
        planes = np.arange(3)[:, None] * (self.size // (3 * STRIP))
        near = strip + np.arange(-1, 2)[:, None]
        places = (self._place(0, 0, near * STRIP) // STRIP)[:, None] + planes
        left, middle, right = places.astype(np.uint32).reshape(3, -1)
        runs = {
            "left": left,
            "middle": middle,
            "right": right,
            "first": np.tile(first.astype(np.int32), 3),
            "end": np.tile(end.astype(np.int32), 3),
            "columns": np.tile(columns.astype(np.uint32), 3),
        }
        return runs, count

    def copied(self, planes: Float, lanes: Lanes) -> Float:
        """Return planes that are defined on some runs alone."""
        target = dr.empty(mi.Float, self.size)

        def step(row):
            place = lanes.places[1] + mi.UInt32(row) * COLUMN
            write_packet(target, list(read_packet(planes, place)), place)
            return (row + 1,)

        # Without `target` in the state: what is written to it next would copy it.
        dr.while_loop((lanes.first,), lambda row: row < lanes.end, step, label="copied rows")
        dr.eval(target)  # before anything else is written to it
        return target


def _neighbours(place: UInt32, size: int) -> list[UInt32]:
    """Return the places before, at and after a place along an axis, inside the image."""
    last = opaque(mi.Int32, size - 1)
    return [
        mi.UInt32(dr.minimum(dr.maximum(mi.Int32(place) + step, 0), last)) for step in (-1, 0, 1)
    ]


def _slope(neighbours: Matrix3f) -> Float:
    """Return the mean slope along the rows of a pixel and its neighbours, per px."""
    outer = neighbours[0, 2] - neighbours[0, 0]
    middle = neighbours[1, 2] - neighbours[1, 0]
    return _SOBEL * (outer + 2 * middle + (neighbours[2, 2] - neighbours[2, 0]))


def _within(cells: np.ndarray, reach: int) -> np.ndarray:
    """Return the strips within `reach` rows of some strips of each row, or in the next strip."""
    return np.asarray(cv2.dilate(cells, np.ones((2 * reach + 1, 3), np.uint8)))


def read_packet(values: Float, place: UInt32, active: Bool | bool = True) -> Jit:
    """Return the 8 floats at 8 `place`."""
    return dr.gather(packet_type(), values, place, active=active, shape=(STRIP, dr.width(place)))


def write_packet(
    target: Float, values: Jit | list[Float], place: UInt32, active: Bool | bool = True
) -> None:
    """Write 8 floats to 8 `place`, which differs between lanes."""
    dr.scatter(target, packet_type()(values), place, active=active, mode=dr.ReduceMode.NoConflicts)


def packet_type() -> type[Jit]:
    """Return Dr.Jit's dynamic array of float arrays, which is read and written in packets of its
    size.
    """
    return sys.modules[mi.Float.__module__].ArrayXf
