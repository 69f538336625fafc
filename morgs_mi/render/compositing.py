"""Blending as one differentiable operation: lists in, channels out, three traced loops behind it (see `loops`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from morgs_mi.render.blocks import BlockLists, pack_records, sorted_buckets
from morgs_mi.render.loops import GEOMETRY, Layout, adjoint, pixel_stride, primal, tangent

__all__ = ["Layout", "blend"]


def blend(
    geometry: tuple[Any, ...], channels: list[tuple[Any, ...]], lists: BlockLists, layout: Layout, num_pixels: int
) -> list[Any]:
    """Blend every channel's columns over an image.

    Args:
        geometry: (mean_x, mean_y, a, b, c, log2_opacity), six floats [N].
        channels: per channel its columns, floats [N]; C columns in all.
        lists: the blocks and who touches them.
        layout: what the gradients reach, and cut-offs.
        num_pixels: width x height.

    Returns:
        Per channel one flat float [num_pixels * columns], and alpha [num_pixels], twice: one to be shown, one to
        divide by, for forward mode clears the gradients of what is used further. Differentiable in `geometry` and
        `channels` by `dr.backward` and `dr.forward`.
    """
    columns = [column for channel in channels for column in channel]
    return dr.custom(_Blend, [*geometry, *columns], lists, layout, num_pixels, [len(channel) for channel in channels])


@cache
def _frozen(loop: Callable[..., Any], layout: Layout, variant: str) -> Callable[..., Any]:
    """Return a traced loop as a function of arrays alone, recorded once for each layout and variant.

    Tracing it anew would cost several ms per call. The layout must not be an argument of the recording:
    Dr.Jit 1.5 tells Python values apart by a hash in which two booleans can cancel.
    """
    return dr.freeze(lambda *arrays: loop(layout, *arrays), warn_after=1000)


class _Blend(dr.CustomOp):
    def eval(
        self, values: list[Any], lists: BlockLists, layout: Layout, num_pixels: int, sizes: list[int]
    ) -> list[Any]:
        self.lists, self.layout, self.num_pixels, self.sizes = lists, layout, num_pixels, [*sizes, 1, 1]
        self.stride = pixel_stride(len(layout.attached))
        self.records = pack_records(values, lists.by_rank)
        self.image = self._run(primal, self.records, _zeros(num_pixels * self.stride))
        return self._split(self.image)

    def backward(self) -> None:
        lists, layout = self.lists, self.layout
        C, skipped = len(layout.attached), 0 if layout.reaches_weights else GEOMETRY
        packets = -(-(GEOMETRY + C - skipped) // 4)
        pairs, N = layout.config.reproducible, dr.width(lists.by_rank)
        sums = _zeros((dr.width(lists.entries) if pairs else _ladder(N)) * packets * 4)
        sums = self._run(adjoint, self.records, self.image, self._joined(self.grad_out()), sums)
        if pairs:
            sums = _summed_by_rank(sums, lists.entries, N, packets)
        lane = lists.rank_of * (4 * packets)
        columns = [dr.gather(mi.Float, sums, lane + k) for k in range(GEOMETRY + C - skipped)]
        self.set_grad_in("values", [mi.Float(0)] * skipped + columns)

    def _run(self, loop: Callable[..., Any], *arrays: Any) -> Any:
        # The maps of length N play no part in the loops; a recording is tied to what it is given.
        walked = replace(self.lists, rank_of=None, by_rank=None)
        return _frozen(loop, self.layout, mi.variant())(walked, *arrays)

    def _split(self, image: Any) -> list[Any]:
        """Cut an image of `stride` floats per pixel into one array per channel, alpha and alpha again."""
        parts = []
        for first, size in zip(self._firsts(), self.sizes, strict=True):
            lane = dr.arange(mi.UInt32, self.num_pixels * size)
            parts.append(dr.gather(mi.Float, image, lane // size * self.stride + lane % size + first))
        return parts

    def _joined(self, parts: list[Any]) -> Any:
        """Transpose `_split`: what belongs to the same place is added up."""
        lane = dr.arange(mi.UInt32, self.num_pixels * self.stride)
        pixel, place, image = lane // self.stride, lane % self.stride, mi.Float(0)
        for part, first, size in zip(parts, self._firsts(), self.sizes, strict=True):
            if dr.width(part) == self.num_pixels * size:  # a literal 0 otherwise: nothing depends on it
                inside = (place >= first) & (place < first + size)
                image += dr.gather(mi.Float, part, pixel * size + place - first, active=inside)
        return image + dr.zeros(mi.Float, self.num_pixels * self.stride)

    def _firsts(self) -> list[int]:
        C = len(self.layout.attached)
        return [min(sum(self.sizes[:k]), C) for k in range(len(self.sizes))]

    def forward(self) -> None:
        grads = [dr.zeros(mi.Float, 1) + g for g in list(self.grad_in("values"))]  # type: ignore[call-overload]
        tangents = pack_records(grads, self.lists.by_rank)
        image = self._run(tangent, self.records, tangents, _zeros(self.num_pixels * self.stride))
        self.set_grad_out(self._split(image))

    def name(self) -> str:
        return "morgs_mi.blend"


def _zeros(size: int) -> Any:
    """Return zeros in memory: a frozen function writes to what it is given, it cannot know sizes of its own."""
    return dr.opaque(mi.Float, 0, size)


def _summed_by_rank(pairs: Any, entries: Any, N: int, packets: int) -> Any:
    """Sum the records of all pairs of a rank, one lane per rank, in the order of the blocks."""
    perm, first, end = sorted_buckets(entries, N)

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
    """Round up to a quarter octave: scatter-reductions have their target's size as a literal in the kernel."""
    step = max(1024, 1 << max(n.bit_length() - 3, 0))
    return -(-n // step) * step
