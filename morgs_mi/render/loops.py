"""Front-to-back blending of the block lists (eq. 1), and its two derivatives, by hand.

Each SIMD lane owns a block of pixels and walks its own list once; the pixels of the block are
unrolled. For Gaussian i at one pixel, with values c_i and transmittance T:

    p = log2(opacity) - u^2 - v^2        alpha = 2^p, 0 below alpha_min, at most alpha_max
    w = T alpha                          C += w c_i        T <- T - w

The adjoint walks the same list in the same direction. With g the gradient of the pixel, it needs
one more number per pixel, the suffix S = <g, C_final> - sum_j<=i w_j <g, c_j>, and

    dL/dp = ln(2) (w <g, c_i> - alpha S / (1 - alpha)).

A channel is *attached* if its gradient reaches the weights w (geometry and opacity), detached if it
reaches only the blended value itself. Alpha is blended as one more channel of ones.

With depth limits, alpha' takes the place of alpha (see `cut`), and a record contains the splat's
shape, followed by the four numbers of its profile. The limits are constants: they get no
derivative.

Every channel has its own image, rows of blocks times its columns (see `region`). A row of a block
is a run of packets of 4 floats.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, log2

import drjit as dr
import mitsuba as mi

from morgs_mi.core.types import Bool, Float, UInt32
from morgs_mi.render.backend import block_shape, elements, exp2, on_aligned_stack, on_cpu
from morgs_mi.render.blocks import BlockLists, fetch_record, next_entry
from morgs_mi.render.cut import PROFILE, Cut
from morgs_mi.render.region import NO_SLOT
from morgs_mi.render.render_config import RenderConfig

_LN2 = log(2.0)
_SHAPE = 6  # mean_x, mean_y, a, b, c, log2_opacity


@dataclass(frozen=True)
class Channel:
    """A channel to blend: its floats per pixel, and whether its gradient reaches the weights."""

    size: int
    attached: bool


@dataclass(frozen=True)
class Layout:
    """Static description of a blend: the loops are traced once for each."""

    channels: tuple[Channel, ...]  #: The blended channels, in the order of the records' columns.
    alpha: bool  #: Whether alpha is an output.
    alpha_attached: bool  #: Whether the gradient of alpha is wanted.
    config: RenderConfig  #: Cut-offs.
    cut: bool = False  #: Whether every pixel has a depth limit.
    #: Whether the adjoint also sums the absolute gradients of the means over the pixels.
    absolute: bool = False

    @property
    def geometry(self) -> int:
        """The number of floats that determine alpha."""
        return _SHAPE + (PROFILE if self.cut else 0)

    @property
    def columns(self) -> int:
        """The number of blended floats."""
        return sum(channel.size for channel in self.channels)

    @property
    def attached(self) -> tuple[bool, ...]:
        """For each column, whether its gradient reaches the weights."""
        return tuple(channel.attached for channel in self.channels for _ in range(channel.size))

    @property
    def reaches_weights(self) -> bool:
        """Whether the adjoint has any gradient for geometry and opacity."""
        return self.alpha_attached or any(channel.attached for channel in self.channels)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Floats per pixel of every output, alpha last."""
        sizes = tuple(channel.size for channel in self.channels)
        return (*sizes, 1) if self.alpha else sizes


def record_packets(layout: Layout) -> int:
    """Return the number of packets of 4 floats of a Gaussian's gradient."""
    return -(-(layout.geometry + layout.columns + 2 * layout.absolute) // 4)


# --------------------------------------------------------------------------------------------------
#  Shared by the three loops
# --------------------------------------------------------------------------------------------------


class _Block:
    """The lanes' blocks: their pixels, their section of the lists, and the shape in which they are
    unrolled.
    """

    def __init__(self, layout: Layout, lists: BlockLists) -> None:
        is_block = lists.order != NO_SLOT

        def of_lane(values: UInt32) -> UInt32:
            return dr.gather(mi.UInt32, values, lists.order, is_block)

        self.layout = layout
        self.lists = lists
        self.width, self.height = block_shape(layout.config)
        self.area = self.width * self.height
        self.place = of_lane(lists.place)
        self.rows = of_lane(lists.rows)
        self.pitch = elements(lists.pitch, mi.UInt32(0))
        # Centre of the first pixel.
        self.x = mi.Float(of_lane(lists.x)) + 0.5
        self.y = mi.Float(of_lane(lists.y)) + 0.5
        begin = of_lane(lists.begin)
        first = of_lane(lists.first)
        # One depth limit per pixel, row by row; none without depth limits.
        self.limits = (
            [] if lists.limits is None else [v for (v,) in _load_image(self, 1, lists.limits)]
        )
        self.end = on_aligned_stack(of_lane(lists.end))
        # One word before the block's first, as `next_entry` expects.
        self.walk = next_entry(begin, mi.UInt32(0), first - 32, self.end, lists.words)

    def advance(
        self, walk: tuple[UInt32, UInt32, UInt32]
    ) -> tuple[UInt32, tuple[UInt32, UInt32, UInt32]]:
        """Return the depth order at a lane's current entry, and the walk advanced to the next
        entry.
        """
        place, word, base = walk
        depth_order = elements(self.lists.entries, base + dr.tzcnt(word))
        next_walk = next_entry(place, word & (word - 1), base, self.end, self.lists.words)
        return depth_order, next_walk

    def continues(self, walk: tuple[UInt32, UInt32, UInt32], T: list[Float]) -> Bool:
        """Return whether a lane continues: entries are left, and its most transparent pixel is
        above the stop.
        """
        while len(T) > 1:
            pairs = zip(T[::2], T[1::2], strict=False)
            T = [dr.select(a > b, a, b) for a, b in pairs] + T[len(T) & ~1 :]
        return (walk[1] != 0) & (T[0] >= self.layout.config.stop_transmittance)

    def packets(self, size: int) -> list[tuple[UInt32, Bool]]:
        """Return (place, in the image) of all packets of 4 in an image of `size` floats per pixel,
        row by row.
        """
        run = self.width * size // 4
        starts = [((self.place + j * self.pitch) * size, self.rows > j) for j in range(self.height)]
        return [(start + k, valid) for start, valid in starts for k in range(run)]

    def offsets(self, geometry: list[Float]) -> tuple[list[Float], list[Float]]:
        """Return the offsets dx [width] and dy [height] of the block's columns and rows from the
        mean.
        """
        dx = self.x - geometry[0]
        dy = self.y - geometry[1]
        return [dx + i for i in range(self.width)], [dy + j for j in range(self.height)]

    def cut(self, geometry: list[Float], dx: list[Float], dy: list[Float]) -> Cut | None:
        """Return the cut by the depth limits of the pixels; None without depth limits."""
        return Cut(geometry[_SHAPE:], dx, dy, self.limits) if self.layout.cut else None

    def powers(
        self, dx: list[Float], dy: list[Float], geometry: list[Float]
    ) -> list[tuple[Float, Float]]:
        """Return (p, u) of every pixel, row by row."""
        _, _, a, b, c, log2_opacity = geometry[:_SHAPE]
        ax = [a * x for x in dx]
        rows = []
        for y in dy:
            v = c * y
            by = b * y
            top = dr.fma(-v, v, log2_opacity)
            for x in ax:
                u = x + by
                rows.append((dr.fma(-u, u, top), u))
        return rows

    def alpha(self, p: Float) -> tuple[Float, Float]:
        """Return (alpha, alpha before the cap and the cut-off)."""
        config = self.layout.config
        full = exp2(p)
        # One instruction; `dr.minimum` takes three to handle NaN.
        value = dr.select(full < config.alpha_max, full, config.alpha_max)
        return dr.select(p >= log2(config.alpha_min), value, 0), full

    def weights(self, geometry: list[Float], T: list[Float]) -> list[Float]:
        """Return the blend weight w of every pixel, row by row."""
        dx, dy = self.offsets(geometry)
        cut = self.cut(geometry, dx, dy)
        alphas = [self.alpha(p)[0] for p, _ in self.powers(dx, dy, geometry)]
        if cut:
            alphas = [cut.alpha(k, alpha).alpha for k, alpha in enumerate(alphas)]
        return [alpha * t for alpha, t in zip(alphas, T, strict=True)]


def _floats(count: int, value: float = 0.0) -> list[Float]:
    return [mi.Float(value) for _ in range(count)]


def _store(
    block: _Block, layout: Layout, sums: list[list[Float]], alpha: list[Float], images: list[Float]
) -> list[Float]:
    """Write every pixel's columns, and alpha if it is an output, to the channels' images."""
    pixels = [[*row, a] for row, a in zip(sums, alpha, strict=True)]
    first = 0
    for image, size in zip(images, layout.sizes, strict=True):
        values = [value for pixel in pixels for value in pixel[first : first + size]]
        for k, (place, valid) in enumerate(block.packets(size)):
            packet = mi.Vector4f(*values[4 * k : 4 * k + 4])
            dr.scatter(image, packet, place, active=valid, mode=dr.ReduceMode.NoConflicts)
        first += size
    return images


def _load(block: _Block, layout: Layout, images: list[Float]) -> list[list[Float]]:
    """Return every pixel's columns, and alpha if it is an output; zeros outside the image."""
    channels = (
        _load_image(block, size, image) for image, size in zip(images, layout.sizes, strict=True)
    )
    return [
        [value for values in pixel for value in values] for pixel in zip(*channels, strict=True)
    ]


def _load_image(block: _Block, size: int, image: Float) -> list[list[Float]]:
    """Return the `size` floats of every pixel in an image."""
    packets = (
        dr.gather(mi.Vector4f, image, place, active=valid) for place, valid in block.packets(size)
    )
    values = [value for packet in packets for value in packet]
    return [values[k : k + size] for k in range(0, len(values), size)]


# --------------------------------------------------------------------------------------------------
#  Primal
# --------------------------------------------------------------------------------------------------


def primal(layout: Layout, lists: BlockLists, images: list[Float]) -> list[Float]:
    """Blend the records' columns into the channels' images, which are overwritten."""
    block = _Block(layout, lists)
    G = layout.geometry
    C = layout.columns

    def body(walk, T, sums):
        depth_order, walk = block.advance(walk)
        record = fetch_record(lists.records, depth_order, G + C)
        weights = block.weights(record[:G], T)
        sums = [
            [dr.fma(w, c, total) for c, total in zip(record[G:], row, strict=True)]
            for w, row in zip(weights, sums, strict=True)
        ]
        return walk, [t - w for t, w in zip(T, weights, strict=True)], sums

    state = (block.walk, _floats(block.area, 1.0), [_floats(C) for _ in range(block.area)])
    _, T, sums = dr.while_loop(
        state, lambda walk, T, _: block.continues(walk, T), body, label="blend"
    )
    return _store(block, layout, sums, [1 - t for t in T], images)


# --------------------------------------------------------------------------------------------------
#  Adjoint: per Gaussian and block, sums over the pixels of
#     w g_c                      for the blended values, and with d = dL/dp / ln(2)
#     d, d u, d u dx, d u dy, d dy, d dy^2    for opacity, mean and Cholesky factor
# --------------------------------------------------------------------------------------------------


def adjoint(
    layout: Layout,
    lists: BlockLists,
    images: list[Float],
    image_grads: list[Float],
    first_record: UInt32,
    sums: Float,
) -> Float:
    """Add dL/d(record) to `sums`, which has a record of each Gaussian by depth order: the
    geometry's floats, the columns, the two absolute gradients of the mean if the layout has them,
    padding.

    Args:
        layout: description of the blend.
        lists: the blocks and their lists.
        images: images that `primal` returned.
        image_grads: their gradients.
        first_record: the record of depth order 0 that each lane adds to, see `backend.sections`.
        sums: the records.
    """
    block = _Block(layout, lists)
    packets = record_packets(layout)
    mode = dr.ReduceMode.NoConflicts if on_cpu() else dr.ReduceMode.Auto  # see `sections`
    geometric = layout.reaches_weights
    G = layout.geometry
    C = layout.columns
    gradients = _load(block, layout, image_grads)
    suffix = [
        _inner(g, v, layout, v[C] if layout.alpha else None)
        for g, v in zip(gradients, _load(block, layout, images), strict=True)
    ]

    def body(walk, T, S):
        depth_order, walk = block.advance(walk)
        record = fetch_record(lists.records, depth_order, G + C)
        geometry = record[:G]
        values = record[G:]
        dx, dy = block.offsets(geometry)
        cut = block.cut(geometry, dx, dy)
        T_next = []
        S_next = []
        value_grads = _floats(C)
        moments = _Moments(block)
        absolute = _floats(2 * layout.absolute)
        for k, (p, u) in enumerate(block.powers(dx, dy, geometry)):
            alpha, full = block.alpha(p)
            part = cut.alpha(k, alpha) if cut else None
            w = (part.alpha if part else alpha) * T[k]
            value_grads = [
                dr.fma(w, g_c, total) for g_c, total in zip(gradients[k], value_grads, strict=False)
            ]
            T_next.append(T[k] - w)
            if geometric:
                gc = _inner(gradients[k], values, layout, None)
                s = dr.fma(-w, gc, S[k])
                S_next.append(s)
                if cut and part:
                    d_alpha = dr.fma(T[k], gc, -s * dr.rcp(1 - part.alpha))
                    cut.add(k, part, d_alpha)
                    d = alpha * part.by_alpha * d_alpha
                else:
                    d = dr.fma(w, gc, -alpha * s * dr.rcp(1 - alpha))
                d = dr.select(full <= layout.config.alpha_max, d, 0)
                moments.add(k, d, u)
                if layout.absolute:
                    _, _, a, b, c, _ = geometry[:_SHAPE]
                    by_mean = a * u, dr.fma(b, u, c * c * dy[k // block.width])
                    absolute = [
                        total + 2 * _LN2 * dr.abs(d * slope)
                        for total, slope in zip(absolute, by_mean, strict=True)
                    ]
        geometry_grads = moments.gradients(dx[0], dy[0], geometry) if geometric else _floats(G)
        if cut and geometric:
            mean_grads, profile_grads = cut.gradients()
            total_grads = [a + b for a, b in zip(geometry_grads, mean_grads, strict=False)]
            geometry_grads = [*total_grads, *geometry_grads[2:], *profile_grads]
        grads = [*geometry_grads, *value_grads, *absolute]
        grads += _floats(packets * 4 - len(grads))
        for k in range(packets):
            packet = mi.Vector4f(*grads[4 * k : 4 * k + 4])
            place = (first_record + depth_order) * packets + k
            dr.scatter_reduce(dr.ReduceOp.Add, sums, packet, place, mode=mode)
        return walk, T_next, S_next

    # Without `sums` in the state: a recording would copy it once more.
    state = (block.walk, _floats(block.area, 1.0), suffix if geometric else [])
    dr.while_loop(state, lambda walk, T, _: block.continues(walk, T), body, label="blend (adjoint)")
    return sums


def _inner(g: list[Float], values: list[Float], layout: Layout, alpha: Float | None) -> Float:
    """Return <g, values> over the attached columns, plus g_alpha alpha; `alpha` None means 1."""
    total = None
    if layout.alpha_attached:
        total = g[layout.columns] if alpha is None else g[layout.columns] * alpha
    for g_c, c, attached in zip(g, values, layout.attached, strict=False):
        if attached:
            total = g_c * c if total is None else dr.fma(g_c, c, total)
    return mi.Float(0) if total is None else total


class _Moments:
    """Sums over a block of d times 1, u, u dx, u dy, dy, dy^2; rows first: a pixel costs four
    additions.
    """

    def __init__(self, block: _Block) -> None:
        self.width = block.width
        self.d, self.du, self.dui, self.duj, self.dj, self.djj = _floats(6)
        self.row_d = mi.Float(0)
        self.row_du = mi.Float(0)

    def add(self, k: int, d: Float, u: Float) -> None:
        """Add pixel k (row by row) with its d and u."""
        j, i = divmod(k, self.width)
        du = d * u
        self.row_d, self.row_du = (self.row_d + d, self.row_du + du) if i else (d, du)
        self.dui = dr.fma(du, float(i), self.dui)
        if i == self.width - 1:
            self.d = self.d + self.row_d
            self.du = self.du + self.row_du
            self.dj = dr.fma(self.row_d, float(j), self.dj)
            self.djj = dr.fma(self.row_d, float(j * j), self.djj)
            self.duj = dr.fma(self.row_du, float(j), self.duj)

    def gradients(self, x0: Float, y0: Float, geometry: list[Float]) -> list[Float]:
        """Return the gradients of (mean_x, mean_y, a, b, c, log2_opacity); (x0, y0) is the first
        pixel's offset.
        """
        _, _, a, b, c, _ = geometry[:_SHAPE]
        du_dx = dr.fma(self.du, x0, self.dui)
        du_dy = dr.fma(self.du, y0, self.duj)
        d_dy = dr.fma(self.d, y0, self.dj)
        d_dy2 = dr.fma(y0, self.dj + d_dy, self.djj)
        grads = (
            2 * a * self.du,
            2 * (b * self.du + c * c * d_dy),
            -2 * du_dx,
            -2 * du_dy,
            -2 * c * d_dy2,
            self.d,
        )
        return [_LN2 * g for g in grads]


# --------------------------------------------------------------------------------------------------
#  Tangent
# --------------------------------------------------------------------------------------------------


def tangent(layout: Layout, lists: BlockLists, tangents: Float, images: list[Float]) -> list[Float]:
    """Write the directional derivative along the records' tangents to `images`, which are
    overwritten.
    """
    block = _Block(layout, lists)
    G = layout.geometry
    C = layout.columns

    def body(walk, T, dT, dsums):
        depth_order, walk = block.advance(walk)
        record = fetch_record(lists.records, depth_order, G + C)
        tangent = fetch_record(tangents, depth_order, G + C)
        with dr.resume_grad():
            inputs = [mi.Float(v) for v in (*record, *T)]
            dr.enable_grad(inputs)
            dr.set_grad(inputs, [*tangent, *dT])
            values = inputs[G : G + C]
            T = inputs[G + C :]
            weights = block.weights(inputs[:G], T)
            blended = [
                (w if attached else dr.detach(w)) * c
                for w in weights
                for c, attached in zip(values, layout.attached, strict=True)
            ]
            T = [t - w for t, w in zip(T, weights, strict=True)]
            *change, dT = dr.forward_to(blended, T)
        changes = iter(*change)
        dsums = [[total + next(changes) for total in row] for row in dsums]
        return walk, dr.detach(T), dT, dsums

    state = (
        block.walk,
        _floats(block.area, 1.0),
        _floats(block.area),
        [_floats(C) for _ in range(block.area)],
    )
    _, _, dT, dsums = dr.while_loop(
        state, lambda walk, T, *_: block.continues(walk, T), body, label="blend (tangent)"
    )
    return _store(
        block, layout, dsums, [-t if layout.alpha_attached else mi.Float(0) for t in dT], images
    )
