"""Memory layout of images as planes, and the runs of rows over which a separable window walks.

A strip is 8 pixels wide, a column 16 strips. The three components of an image [H, W, 3] are stored
one after the other, each column by column, and a column row by row: 16 SIMD lanes that walk down 16
neighbouring strips read one contiguous section of memory. Two strips of zeros lie on either side of
an image: derivatives of windows there are 0, and are read.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.memory import from_numpy
from morgs_mi.core.types import Bool, Float, Int32, Jit, UInt32
from morgs_mi.render.backend import elements
from morgs_mi.render.region import Region, quotient_and_rest

RADIUS = 5
STRIP = 8  # pixels wide: a window extends at most into the next strip
COLUMN = 16  # strips
_SPARE = 2  # strips on either side
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
        `memory.owned_copy`).
        """
        target = dr.empty(mi.Float, self.size)
        strip, y, places = self._strips(self.num_columns * COLUMN)
        strip = strip - _SPARE
        if self.width % STRIP == 0:
            strips = dr.opaque(mi.UInt32, self.num_strips)
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
                lane = 3 * (y * dr.opaque(mi.UInt32, self.num_strips) + strip) + k
                write_packet(target, values[STRIP * k : STRIP * (k + 1)], lane)
        else:
            for value, (place, valid) in zip(values, self._numbers(strip, y), strict=True):
                dr.scatter(target, value, place, valid, mode=dr.ReduceMode.NoConflicts)
        return target

    def _numbers(self, strip: UInt32, y: UInt32) -> list[tuple[UInt32, Bool]]:
        """Return (place in the flat image, in the view) of each number of a strip of a row."""
        width = dr.opaque(mi.UInt32, self.width)
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
            sizes = (dr.opaque(mi.UInt32, size) for size in sizes)
        height, num_columns = sizes
        x = x + _SPARE * STRIP
        column = component * num_columns + x // (COLUMN * STRIP)
        return (column * height + y) * (COLUMN * STRIP) + x % (COLUMN * STRIP)

    def places_on(self, region: Region) -> tuple[UInt32, Bool]:
        """Return the places of the numbers of a flat image on a region, and the mask of those in
        the view.
        """
        component, x, y = self._pixels_of(region)
        valid = (x < dr.opaque(mi.UInt32, self.width)) & (y < dr.opaque(mi.UInt32, self.height))
        places = dr.select(valid, self._place(component, y, x), 0)
        dr.eval(places, valid)
        return places, valid

    def gradient_on(self, planes: Float, region: Region) -> tuple[Float, Float]:
        """Return the derivatives of an image in `planes` along x and y on a region, flat, per px,
        by Sobel's filter.
        """
        component, x, y = self._pixels_of(region)
        xs, ys = (
            [
                dr.minimum(dr.maximum(mi.Int32(v) + step, 0), dr.opaque(mi.Int32, size - 1))
                for step in (-1, 0, 1)
            ]
            for v, size in ((x, self.width), (y, self.height))
        )
        near = [
            [elements(planes, self._place(component, mi.UInt32(b), mi.UInt32(a))) for a in xs]
            for b in ys
        ]
        along_x, along_y = (
            sum(w * (rows[k][2] - rows[k][0]) for k, w in enumerate((0.125, 0.25, 0.125)))
            for rows in (near, [*zip(*near, strict=True)])
        )
        dr.eval(along_x, along_y)
        return along_x, along_y

    def _pixels_of(self, region: Region) -> tuple[UInt32, UInt32, UInt32]:
        """Return (component, x, y) of the numbers of a flat image on a region."""
        lane = dr.arange(mi.UInt32, 3 * region.num_pixels)
        pixel = lane // 3
        return lane - 3 * pixel, *region.pixels(pixel)

    def runs(self, region: Region | None, reach: int) -> tuple[Lanes, int]:
        """Return the runs that cover a region, or the whole view, and `reach` <= 8 pixels around
        it, and how many numbers of the image they cover.
        """
        cells = np.ones((self.height, self.num_strips), bool)  # the strips of each row
        if region is not None:
            mask = np.pad(region.mask, ((0, 0), (0, self.num_strips * STRIP - self.width)))
            cells = np.any(mask.reshape(self.height, self.num_strips, STRIP), axis=2)
        cells = np.pad(cells, ((0, 0), (1, 1)))
        if reach:  # those within `reach` rows, or in the next strip, too
            cells = cv2.dilate(cells.astype(np.uint8), np.ones((2 * reach + 1, 3), np.uint8)) > 0
            cells[:, 0] = cells[:, 1]
            cells[:, -1] = cells[:, -2]
        # The runs of cells in each column, in parts that are not too long.
        edges = np.diff(np.pad(cells.T, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        strip, first = np.nonzero(edges == 1)
        end = np.nonzero(edges == -1)[1]
        parts = -(-(end - first) // _LONGEST)
        index = np.repeat(np.arange(len(strip)), parts)
        part = np.arange(len(index)) - np.repeat(parts.cumsum() - parts, parts)
        first = first[index] + _LONGEST * part
        end = np.minimum(end[index], first + _LONGEST)
        strip = strip[index]
        # The lanes of a packet are neighbours in one column.
        order = np.lexsort((strip, first, (strip + _SPARE - 1) // COLUMN))
        strip, first, end = np.stack([strip, first, end])[:, order]
        columns = np.clip(self.width - (strip - 1) * STRIP, 0, STRIP) * (strip > 0)
        component = np.repeat(np.arange(3), len(strip))
        x = np.tile(strip - 1, 3) * STRIP  # strip 1 is the first of the image
        left, middle, right = (
            from_numpy(mi.UInt32, self._place(component, 0, x + k * STRIP) // STRIP)
            for k in (-1, 0, 1)
        )
        lanes = Lanes(
            (left, middle, right),
            from_numpy(mi.Int32, np.tile(first, 3)),
            from_numpy(mi.Int32, np.tile(end, 3)),
            from_numpy(mi.UInt32, np.tile(columns, 3)),
        )
        return lanes, 3 * int(((end - first) * columns).sum())


def read_packet(values: Float, place: UInt32, active: Bool | bool = True) -> Jit:
    """Return the 8 floats at 8 `place`."""
    return dr.gather(packet_type(), values, place, active=active, shape=(STRIP, dr.width(place)))


def write_packet(
    target: Float, values: list[Float], place: UInt32, active: Bool | bool = True
) -> None:
    """Write 8 floats to 8 `place`, which differs between lanes."""
    dr.scatter(target, packet_type()(values), place, active=active, mode=dr.ReduceMode.NoConflicts)


def packet_type() -> type[Jit]:
    """Return Dr.Jit's dynamic array of float arrays, which is read and written in packets of its
    size.
    """
    return sys.modules[mi.Float.__module__].ArrayXf
