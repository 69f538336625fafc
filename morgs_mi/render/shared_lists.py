"""Lists of the blocks of several views that several renderings share.

To build lists takes more launches than to draw them. From step to step of a fit, splats move by
less than a pixel: lists that are built once for all views, with a margin around each block, hold
for some steps. They only select the splats that a block walks; each pixel still computes their
alpha. The depth order stays that of the moment at which they were built.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from morgs_mi.core.arrays import opaque
from morgs_mi.core.types import Float, UInt32
from morgs_mi.render.backend import elements, stable_order
from morgs_mi.render.blocks import BlockLists, pack_records
from morgs_mi.render.projection import Splats
from morgs_mi.render.region import DrawnBlocks


@dataclass(frozen=True)
class SharedLists:
    """Lists of the blocks of several views, view after view.

    An entry is the index of a splat of its view: of the Gaussians first, then of static splats.
    """

    words: UInt32  #: See `BlockLists`.
    entries: UInt32
    # Of each block.
    begin: UInt32
    end: UInt32
    first: UInt32
    order: UInt32  #: The blocks of each view by falling count, view after view.

    @classmethod
    def of(cls, lists: BlockLists, number: UInt32, view_of: UInt32, views: int) -> SharedLists:
        """Return lists of the blocks of several views.

        Args:
            lists: of splats of all views.
            number: index of each splat among those of its view [N].
            view_of: view of each block [A].
            views: number of views.
        """
        number_of = dr.empty(mi.UInt32, dr.width(number))
        mode = dr.ReduceMode.Permute
        dr.scatter(number_of, number, lists.depth_order_of, mode=mode)  # pyright: ignore
        by_view = stable_order(elements(view_of, lists.order), views)
        shared = cls(
            lists.words,
            elements(number_of, lists.entries),
            lists.begin,
            lists.end,
            lists.first,
            elements(lists.order, by_view),
        )
        dr.eval(vars(shared))
        return shared


@dataclass(frozen=True, eq=False)
class ViewLists:
    """Lists of one view."""

    shared: SharedLists  #: Of several views.
    first_block: UInt32 | int  #: Index of the view's first block.

    def of(self, splats: Splats, columns: list[Float], region: DrawnBlocks) -> BlockLists:
        """Return the lists of the view's blocks.

        Args:
            splats: N splats of the view.
            columns: the blended values, floats [N].
            region: the view's blocks.
        """
        shared = self.shared
        first_block = opaque(mi.UInt32, self.first_block)
        number = dr.arange(mi.UInt32, len(splats))
        block = dr.arange(mi.UInt32, region.num_blocks)
        is_block = block < region.section_sizes[0]  # the blocks that fill it up list nothing
        place = first_block + block
        begin, end, first, order = (
            dr.gather(mi.UInt32, values, place, is_block)
            for values in (shared.begin, shared.end, shared.first, shared.order)
        )
        order = dr.select(is_block, order - first_block, block)
        dr.eval(number, begin, end, first, order)
        return BlockLists(
            pack_records([*splats.geometry, *columns], number),
            *(shared.words, shared.entries, begin, end, first, order, number),
            *(region.x, region.y, region.place, region.rows, region.pitch),
            limits=None,
        )
