"""Blending as one differentiable operation: lists in, channels out, traced loops behind it (see `loops`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from morgs_mi.render.blocks import BlockLists, pack_records, sorted_buckets
from morgs_mi.render.loops import (
    GEOMETRY,
    Blocks,
    Channel,
    Layout,
    adjoint,
    adjoint_of_pairs,
    pair_packets,
    primal,
    record_packets,
    tangent,
)
from morgs_mi.render.recording import recorded
from morgs_mi.render.region import Region, quotient

__all__ = ["Channel", "Layout", "blend"]


def blend(
    geometry: tuple[Any, ...], channels: list[tuple[Any, ...]], region: Region, lists: BlockLists, layout: Layout
) -> list[Any]:
    """Blend every channel's columns over a region.

    Args:
        geometry: (mean_x, mean_y, a, b, c, log2_opacity), six floats [N].
        channels: per channel its columns, floats [N].
        region: the blocks that are drawn.
        lists: who touches them; made of the same geometry and columns.
        layout: the channels' sizes, what the gradients reach, and cut-offs.

    Returns:
        Per channel its picture on the region, flat; and, if the layout has it, alpha, twice: one to be shown, one to
        divide by, for forward mode clears the gradients of what is used further. Differentiable in `geometry` and
        `channels` by `dr.backward` and `dr.forward`.
    """
    columns = [column for channel in channels for column in channel]
    return dr.custom(_Blend, [*geometry, *columns], region, lists, layout)


class _Blend(dr.CustomOp):
    def eval(self, values: list[Any], region: Region, lists: BlockLists, layout: Layout) -> list[Any]:
        # The values are in the lists' records already: they are named here to be differentiated.
        self.region, self.lists, self.layout, self.blocks = region, lists, layout, Blocks.of(region, lists)
        self.pictures = self._run(primal, layout, self.blocks, lists.records, self._blank())
        return self._shown(self.pictures)

    def backward(self) -> None:
        lists, layout = self.lists, self.layout
        N, grads = dr.width(lists.by_rank), self._hidden(list(self.grad_out()))
        arrays, stride = (self.blocks, self.lists.records, self.pictures, grads), 4 * record_packets(layout)
        if layout.config.reproducible:
            end = dr.cumsum(lists.count)
            first = end - lists.count
            dr.eval(first)
            pairs = dr.opaque(mi.Float, 0, max(int(end[-1]), 1) * 4 * pair_packets(layout))
            pairs = self._run(adjoint_of_pairs, layout, *arrays, first, pairs)
            sums, stride = _summed_by_rank(pairs, N, layout), 4 * pair_packets(layout)
        else:
            sums = self._run(adjoint, layout, _ladder(N), *arrays)
        lane, skipped = lists.rank_of * stride, 0 if layout.reaches_weights else GEOMETRY
        columns = [dr.gather(mi.Float, sums, lane + k) for k in range(skipped, GEOMETRY + layout.columns)]
        self.set_grad_in("values", [mi.Float(0)] * skipped + columns)

    def forward(self) -> None:
        grads = [dr.zeros(mi.Float, 1) + g for g in list(self.grad_in("values"))]  # type: ignore[call-overload]
        tangents = pack_records(grads, self.lists.by_rank)
        pictures = self._run(tangent, self.layout, self.blocks, self.lists.records, tangents, self._blank())
        self.set_grad_out(self._shown(pictures))

    def _run(self, loop: Callable[..., Any], *arguments: Any) -> Any:
        static = [v for v in arguments if isinstance(v, (Layout, int))]
        return recorded(loop, *static)(*arguments[len(static) :])

    def _blank(self) -> list[Any]:
        """Return memory to write to: a frozen function cannot know sizes of its own."""
        return [dr.empty(mi.Float, self.region.num_pixels * size) for size in self.layout.sizes]

    def _shown(self, pictures: list[Any]) -> list[Any]:
        """Return what the caller gets: without the padding to whole blocks, and alpha twice."""
        shown = [_cropped(v, self.region, size) for v, size in zip(pictures, self.layout.sizes, strict=True)]
        return [*shown, shown[-1] + 0] if self.layout.alpha else shown

    def _hidden(self, grads: list[Any]) -> list[Any]:
        """Transpose `_shown`."""
        if self.layout.alpha:
            *grads, alpha, coverage = grads
            grads = [*grads, alpha + coverage]
        return [_padded(v, self.region, size) for v, size in zip(grads, self.layout.sizes, strict=True)]

    def name(self) -> str:
        return "morgs_mi.blend"


def _cropped(picture: Any, region: Region, size: int) -> Any:
    """Return a picture without the columns that make its blocks whole."""
    if not region.whole or region.row == region.width:
        return picture
    lane = dr.arange(mi.UInt32, region.width * region.height * size)
    row = quotient(lane, region.width * size)
    return dr.gather(mi.Float, picture, lane + row * dr.opaque(mi.UInt32, (region.row - region.width) * size))


def _padded(picture: Any, region: Region, size: int) -> Any:
    """Transpose `_cropped`; a literal 0 becomes a picture of zeros."""
    total = region.num_pixels * size
    if dr.width(picture) != dr.prod(region.shape(size)):
        return dr.opaque(mi.Float, 0, total)
    if not region.whole or region.row == region.width:
        # In memory of our own (see `region.owned_copy`), by what fuses with whatever computes the gradient.
        return picture * dr.opaque(mi.Float, 1)
    lane = dr.arange(mi.UInt32, total)
    row = quotient(lane, region.row * size)
    column, width = lane - row * dr.opaque(mi.UInt32, region.row * size), dr.opaque(mi.UInt32, region.width * size)
    return dr.gather(mi.Float, picture, row * width + column, active=column < width)


def _summed_by_rank(pairs: Any, N: int, layout: Layout) -> Any:
    """Sum the records of all pairs of a rank, one lane per rank, in the order of the blocks."""
    packets, place = pair_packets(layout), GEOMETRY + layout.columns
    lane = dr.arange(mi.UInt32, dr.width(pairs) // (4 * packets)) * (4 * packets)
    rank = dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, pairs, lane + place))
    perm, _, first, end = sorted_buckets(dr.opaque(rank), N)

    def add(k, sums, end, perm, pairs):
        pair = dr.gather(mi.UInt32, perm, k) * packets
        sums = [a + dr.gather(mi.Vector4f, pairs, pair + i) for i, a in enumerate(sums)]
        return k + 1, sums, end, perm, pairs

    state = (first, [mi.Vector4f(0) for _ in range(packets)], end, perm, pairs)
    _, sums, *_ = dr.while_loop(state, lambda k, sums, end, *_: k < end, add, label="sum of pairs")
    total = dr.empty(mi.Float, N * packets * 4)
    lane = dr.arange(mi.UInt32, N) * packets
    for i, packet in enumerate(sums):
        dr.scatter(total, packet, lane + i, mode=dr.ReduceMode.NoConflicts)
    dr.eval(total)
    return total


def _ladder(n: int) -> int:
    """Round up to a quarter octave, for each size of a scatter-reduction's target has a kernel of its own."""
    step = max(1024, 1 << max(n.bit_length() - 3, 0))
    return -(-n // step) * step
