"""Regions of fixed sizes, whose arrays are arguments of a recording.

A recording contains the sizes of all arrays that it makes. The blocks of a view, their tiles and
the entries of their lists therefore fill a part of arrays that are large enough for several views:
the remaining blocks list nothing, and the remaining entries lie in a last tile beside the view.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.core.arrays import from_numpy, opaque
from morgs_mi.core.types import Arrays, Jit, UInt32
from morgs_mi.render.backend import elements, sections
from morgs_mi.render.region import BlockGrid, DrawnBlocks, Region

# Pixels of a tile that no splat reaches.
_FAR = 1e9
# Column of pixels beside every view.
_BESIDE = 2**30


@dataclass(frozen=True)
class PaddedSizes:
    """Sizes of a padded region."""

    grid: BlockGrid  #: All blocks of the view.
    whole: bool  #: Whether its images are those of the whole view, see `Region`.
    num_blocks: int  #: Blocks that it has room for; all, if it is whole.
    num_tiles: int  #: Tiles, of which the last one is beside the view.
    is_partial: bool  #: Whether some pixels of its blocks may lie outside the view.
    capacity: int  #: Entries of the lists.


class PaddedRegion(DrawnBlocks):
    """A `Region` of fixed sizes, made of the arguments of a recording.

    Args:
        sizes: the sizes.
        arrays: see `padded_arrays`.
    """

    def __init__(self, sizes: PaddedSizes, arrays: Mapping[str, Jit]) -> None:
        vars(self).update(arrays)
        super().__init__(sizes.grid, sizes.num_blocks, sizes.whole)
        self.num_tiles = sizes.num_tiles
        self.capacity = sizes.capacity
        self._counts: UInt32 = arrays["counts"]
        self.weights = None
        if sizes.is_partial:
            pixel = self.pixels(dr.arange(mi.UInt32, self.num_pixels))
            is_inside = dr.all(pixel < self.size)
            self.weights = dr.select(is_inside, mi.Float(1), mi.Float(0))

    @property
    def section_sizes(self) -> tuple[UInt32, UInt32]:
        """See `DrawnBlocks`: data, because blocks fill up a region."""
        return elements(self._counts, mi.UInt32(0)), elements(self._counts, mi.UInt32(1))


def padded_arrays(region: Region, sizes: PaddedSizes) -> dict[str, np.ndarray]:
    """Return the arrays of a region, padded, by name.

    ``counts`` are the number of its blocks, and of those in each section of a launch (see
    `backend.sections`).
    """
    blocks = sizes.num_blocks
    host = region.host
    block_width, block_height = region.block
    # Blocks without splats are drawn, too, because losses read their pixels.
    fills = {"tile": 0, "bit": 0, "x": _BESIDE, "y": 0, "rows": block_height}
    places = np.arange(blocks) * (block_width * block_height // 4)
    arrays = {
        **{name: filled(host[name], blocks, fill) for name, fill in fills.items()},
        **{name: host[name] for name in ("pitch", "slot_of", "tile_table")},
        "place": host["place"] if region.whole else places,
    }
    arrays = {name: np.asarray(values, np.uint32) for name, values in arrays.items()}
    for name in ("corner_x", "corner_y"):
        arrays[name] = filled(host[name], sizes.num_tiles, _FAR)
    *_, lanes = sections(region.num_blocks)
    arrays["counts"] = np.array([region.num_blocks, lanes], np.uint32)
    return arrays


def filled(values: np.ndarray, size: int, fill: float = 0) -> np.ndarray:
    """Return an array, then `fill` up to a size."""
    result = np.full(size, fill, values.dtype)
    result[: len(values)] = values
    return result


@dataclass(frozen=True)
class Packing:
    """Places of arrays of 32-bit numbers in one, which is uploaded at once."""

    places: tuple[tuple[str, np.dtype, int, int], ...]  #: (name, dtype, first word, size) of each.

    def unpacked(self, words: UInt32) -> dict[str, Jit]:
        """Return the arrays by name."""
        kinds = {"u": mi.UInt32, "i": mi.Int32, "f": mi.Float}
        return {
            name: dr.reinterpret_array(
                kinds[dtype.kind], elements(words, dr.arange(mi.UInt32, size) + first)
            )
            for name, dtype, first, size in self.places
        }


def packed(arrays: Arrays) -> tuple[Packing, UInt32]:
    """Return arrays of 32-bit numbers as one."""
    first = 0
    places = []
    for name, values in arrays.items():
        places.append((name, values.dtype, first, len(values)))
        first += len(values)
    words = [np.ascontiguousarray(values).view(np.uint32) for values in arrays.values()]
    return Packing(tuple(places)), from_numpy(mi.UInt32, np.concatenate(words))


def padded(values: Jit, size: int) -> Jit:
    """Return an array, then zeros up to a size."""
    lane = dr.arange(mi.UInt32, size)
    is_inside = lane < opaque(mi.UInt32, dr.width(values))
    return dr.select(is_inside, dr.gather(type(values), values, lane, is_inside), 0)
