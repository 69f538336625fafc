"""Blending as one differentiable operation, implemented by the traced loops of `loops`."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import drjit as dr
import mitsuba as mi

from morgs_mi.core.arrays import concatenated, opaque
from morgs_mi.core.types import Float
from morgs_mi.render.backend import elements, sections
from morgs_mi.render.blocks import BlockLists, pack_records
from morgs_mi.render.kernel_recording import recorded
from morgs_mi.render.loops import (
    Layout,
    adjoint,
    primal,
    record_packets,
    tangent,
)
from morgs_mi.render.region import NO_SLOT, DrawnBlocks, quotient, quotient_and_rest


def blend(
    values: list[Float], region: DrawnBlocks, lists: BlockLists, layout: Layout
) -> list[Float]:
    """Blend every channel's columns over a region.

    Args:
        values: floats [N]: the splats' geometry (see `Splats.geometry`), the columns of the
            channels, and with `layout.absolute` two columns that are not read, and whose gradients
            are the sums of the absolute gradients of the means over the pixels.
        region: the blocks that are drawn.
        lists: the splats that touch them, built from the same values, and perhaps further splats
            after them, which get no gradients.
        layout: sizes of the channels, whether their gradients reach the weights, and cut-offs.

    Returns:
        The image of each channel on the region, flat; and, if the layout has it, alpha, twice: one
        for output, one to divide by, because forward mode clears the gradients of an array that is
        used further. Differentiable in `values` by `dr.backward` and `dr.forward`.
    """
    return dr.custom(_Blend, values, _Constants(region, lists, layout))


class _Constants:
    """Arguments of a blend that have no gradients.

    Not a dataclass: `dr.custom` copies those, and so checks their settings in every step.
    """

    def __init__(self, region: DrawnBlocks, lists: BlockLists, layout: Layout) -> None:
        self.region = region
        self.lists = lists
        self.layout = layout


class _Blend(dr.CustomOp):
    def eval(self, values: list[Float], constants: _Constants) -> list[Float]:
        # The lists' records contain the values already: they are arguments only to be
        # differentiated.
        self.values = values
        self.region = constants.region
        self.lists = constants.lists
        self.layout = layout = constants.layout
        self.images = recorded(primal, layout)(self.lists, self._allocated())
        return self._outputs(self.images)

    def backward(self) -> None:
        layout = self.layout
        grads = cast(list[Float], self.grad_out())
        # The transpose of `_outputs`.
        if layout.alpha:
            *grads, alpha, coverage = grads
            grads = [*grads, alpha + coverage]
        grads = [padded(v, self.region, size) for v, size in zip(grads, layout.sizes, strict=True)]
        count = dr.width(self.values[0])
        columns = record_gradients(self.region, self.lists, layout, self.images, grads, count)
        missing = layout.geometry + layout.columns + 2 * layout.absolute - len(columns)
        self.set_grad_in("values", [mi.Float(0)] * missing + columns)

    def forward(self) -> None:
        grads = [dr.zeros(mi.Float, 1) + g for g in cast(list[Float], self.grad_in("values"))]
        grads = grads[: self.layout.geometry + self.layout.columns]
        if missing := dr.width(self.lists.depth_order_of) - dr.width(self.values[0]):
            none = dr.zeros(mi.Float, missing)
            zero = dr.zeros(mi.Float, dr.width(self.values[0]))
            grads = [concatenated([grad + zero, none]) for grad in grads]
        tangents = pack_records(grads, self.lists.depth_order_of)
        images = recorded(tangent, self.layout)(self.lists, tangents, self._allocated())
        self.set_grad_out(self._outputs(images))

    def _allocated(self) -> list[Float]:
        """Return memory for the images: a frozen function cannot allocate arrays of a size that it
        computes.
        """
        images = [dr.empty(mi.Float, self.region.num_pixels * size) for size in self.layout.sizes]
        dr.make_opaque(images)  # Dr.Jit records a function again for arrays without memory
        return images

    def _outputs(self, images: list[Float]) -> list[Float]:
        """Return the images without the padding to whole blocks, and alpha twice."""
        outputs = [_cropped(image, self.region) for image in images]
        return [*outputs, outputs[-1] + 0] if self.layout.alpha else outputs


def record_gradients(
    region: DrawnBlocks,
    lists: BlockLists,
    layout: Layout,
    images: list[Float],
    grads: list[Float],
    count: int,
) -> list[Float]:
    """Return the gradients of the geometry (if the layout reaches it) and the columns, and the
    absolute gradients of the means (if the layout has them), floats [N'].

    The gradients of columns that do not reach the weights are the sums of `grads`, weighted by each
    splat's blend weights; they do not depend on `images`.

    Args:
        region: the blocks.
        lists: the splats that touch them.
        layout: description of the blend.
        images: flat image of each channel on the region.
        grads: their gradients.
        count: N', the number of the first splats, whose gradients are returned.
    """
    N = dr.width(lists.depth_order_of)
    stride = 4 * record_packets(layout)
    launches, num_sections, lanes = sections(dr.width(lists.order))
    num_blocks, blocks_per_section = region.section_sizes
    if num_sections * lanes == dr.width(lists.order) and num_sections > 1:
        # A recording distinguishes which arrays have the same size: as many lanes as blocks would
        # be another one.
        lanes += 32
    sums = dr.opaque(mi.Float, 0, num_sections * N * stride)
    # Dr.Jit adds in the order of the lanes within a section; the sections are added in theirs.
    section, within = quotient_and_rest(dr.arange(mi.UInt32, num_sections * lanes), lanes)
    first_record = opaque(mi.UInt32, N) * section
    for launch in range(launches):
        place = (section + opaque(mi.UInt32, launch * num_sections)) * blocks_per_section + within
        is_block = (within < blocks_per_section) & (place < num_blocks)
        order = dr.gather(mi.UInt32, lists.order, place, is_block)
        order = dr.select(is_block, order, NO_SLOT)
        part = replace(lists, order=order, depth_order_of=None, total=None)
        sums = recorded(adjoint, layout)(part, images, grads, first_record, sums)
    lane = dr.gather(mi.UInt32, lists.depth_order_of, dr.arange(mi.UInt32, count)) * stride
    section_size = opaque(mi.UInt32, N * stride)
    firsts = [lane + k * section_size for k in range(num_sections)]
    start = 0 if layout.reaches_weights else layout.geometry
    stop = layout.geometry + layout.columns + 2 * layout.absolute
    return [sum(elements(sums, first + k) for first in firsts) for k in range(start, stop)]


def _cropped(image: Float, region: DrawnBlocks) -> Float:
    """Return a flat image without the columns of pixels that pad it to whole blocks."""
    if not region.whole or region.row == region.width:
        return image
    size = dr.width(image) // region.num_pixels
    lane = dr.arange(mi.UInt32, region.width * region.height * size)
    row = quotient(lane, region.width * size)
    return elements(image, lane + row * opaque(mi.UInt32, (region.row - region.width) * size))


def padded(image: Float, region: DrawnBlocks, size: int) -> Float:
    """Return a flat image padded to whole blocks, or zeros for a literal 0: the transpose of
    `_cropped`.
    """
    total = region.num_pixels * size
    if dr.width(image) != dr.prod(region.shape(size)):
        return dr.opaque(mi.Float, 0, total)
    if not region.whole or region.row == region.width:
        # In memory allocated by Dr.Jit (see `owned_copy`); a product fuses with the kernel
        # of the gradient.
        return image * opaque(mi.Float, 1)
    row, column = quotient_and_rest(dr.arange(mi.UInt32, total), region.row * size)
    width = opaque(mi.UInt32, region.width * size)
    return dr.gather(mi.Float, image, row * width + column, active=column < width)
