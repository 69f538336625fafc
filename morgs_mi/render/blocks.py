"""Depth-ordered lists of the Gaussians that touch each block of pixels.

The lists have two levels. Coarse: every Gaussian is entered into the tiles (4 x 8 blocks) that its
extent touches. One counting sort by tile, applied in depth order, gives the list of each tile.
Fine: each entry of a tile's list is tested exactly against the tile's 32 blocks, one bit each. 32
entries by 32 blocks of bits are transposed in registers: every block has its own string of bits
over its tile's list. The blending loops walk the set bits. A block's list is never written out, and
a pair of Gaussian and block costs one bit.

The *depth order* of a Gaussian is its place among all by depth. Equal depths are in the order of
the input.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log2

import drjit as dr
import mitsuba as mi

from morgs_mi.core.arrays import opaque
from morgs_mi.core.types import Bool, Float, Point2u, UInt32
from morgs_mi.render.backend import elements, stable_order
from morgs_mi.render.cut import FARTHEST_CUT
from morgs_mi.render.projection import Splats
from morgs_mi.render.region import (
    ACROSS,
    DOWN,
    NO_SLOT,
    DrawnBlocks,
    Region,
    on_region,
    quotient_and_rest,
)
from morgs_mi.render.render_config import RenderConfig

# A thousandth of an octave: the block test may accept too many entries, never too few.
_TEST_SLACK = 1e-3


@dataclass(frozen=True)
class BlockLists:
    """Depth-ordered lists, one per block of pixels, as bits over the entries of its tile."""

    #: (geometry, blended columns) by depth order, see `Splats.geometry` and `pack_records`.
    records: Float
    #: Bit k of a block's i-th word is set if the block draws entry `first` + 32 i + k.
    words: UInt32
    entries: UInt32  #: Ranks, tile by tile.
    begin: UInt32  #: Place of each block's first word [A]; the next ones follow at steps of 32.
    end: UInt32  #: Place past its last word [A].
    first: UInt32  #: First entry of its tile [A].
    order: UInt32  #: Blocks by falling count, roughly [A]: the lanes of a packet finish together.
    depth_order_of: UInt32 | None  #: Of each splat [N]; None: it is not needed further.
    # Of each block [A], see `Region`.
    x: UInt32
    y: UInt32
    place: UInt32
    rows: UInt32
    pitch: UInt32  #: As in `Region`, [1].
    limits: Float | None  #: Image on the region, the depth limit of every pixel; None: none.
    #: Number of entries that a region's capacity should hold [1]; None: it has no capacity.
    total: UInt32 | None = None


def build_lists(
    splats: Splats,
    columns: list[Float],
    region: DrawnBlocks,
    config: RenderConfig,
    limits: Float | None = None,
) -> BlockLists:
    """List the splats (N > 0) that may touch each block of a region, nearest first.

    Args:
        splats: the splats to list.
        columns: the blended values, floats [N].
        region: the blocks.
        config: cut-offs.
        limits: depth limit of every pixel of the view [H W], which the splats' profiles are
            compared with.
    """
    N = len(splats)
    # Each splat's first tile, its tiles across, and the number of its tiles in the region.
    low, high, counts = _cells_within(region.tile_table, region, splats, (ACROSS, DOWN))
    rectangles = _Rectangles(low, high.x - low.x, dr.select(splats.valid, counts, 0))
    dr.schedule(rectangles)  # by the kernel that the sort begins with
    depths = dr.select(splats.valid, splats.depth, dr.inf)
    by_depth_order = dr.argsort(depths)
    depth_order_of = dr.empty(mi.UInt32, N)
    dr.scatter(depth_order_of, dr.arange(mi.UInt32, N), by_depth_order, mode=dr.ReduceMode.Permute)
    tiles = _tile_lists(dr.gather(_Rectangles, rectangles, by_depth_order), region)

    records = pack_records([*splats.geometry, *columns], depth_order_of)
    geometry = fetch_record(
        records, tiles.entries, len(splats.geometry), dr.width(records) // (4 * N)
    )
    farthest = None if limits is None else _farthest_limits(limits, region)
    words, end_word, length = _block_bits(geometry, tiles, region, config, farthest)
    length = elements(length, region.tile)
    begin = (elements(end_word, region.tile) - length) * 32 + region.bit
    end = begin + length * 32
    if region.capacity is not None:  # the blocks that fill it up list nothing
        block = dr.arange(mi.UInt32, region.num_blocks)
        end = dr.select(block < region.section_sizes[0], end, begin)
    first = elements(tiles.first, region.tile)
    # Neighbours stay together if their lengths differ by less than an eighth: they draw the same
    # splats and stop alike.
    bucket = 255 - mi.UInt32(6 * dr.log2(mi.Float(_set_bits(words, begin, end)) + 1))
    dr.eval(begin, end, first, bucket)
    order = dr.detail.block_mkperm(bucket, dr.width(bucket), 256)  # pyright: ignore[reportArgumentType]
    return BlockLists(
        records,
        words,
        tiles.entries,
        begin,
        end,
        first,
        order,
        depth_order_of,
        *(region.x, region.y, region.place, region.rows, region.pitch),
        None if limits is None else on_region(limits, region),
        tiles.total,
    )


def touches(splats: Splats, region: Region) -> Bool:
    """Return the mask of the splats with an extent that reaches a block of the region [N]."""
    *_, counts = _cells_within(region.block_table, region, splats, (1, 1))
    return splats.valid & (counts > 0)


def next_entry(
    place: UInt32, word: UInt32, base: UInt32, end: UInt32, words: UInt32
) -> tuple[UInt32, UInt32, UInt32]:
    """Advance to a word with a set bit and return (place of the word after it, word, entry of the
    word's bit 0).

    The word is 0 where none is left.
    """

    def step(place, word, base):
        return place + 32, elements(words, place), base + 32

    return dr.while_loop(
        (place, word, base),
        lambda place, word, base: (word == 0) & (place < end),
        step,
        label="next word",
    )


def pack_records(columns: list[Float], depth_order_of: UInt32) -> Float:
    """Return the columns [N] interleaved to one record per Gaussian, by depth order, padded to 4
    floats.

    Records are read in packets of 4 floats, one cache line or less for each Gaussian.
    """
    N = dr.width(depth_order_of)
    width = -(-len(columns) // 4)
    values = columns + [mi.Float(0)] * (4 * width - len(columns))
    records = dr.empty(mi.Float, 4 * width * N)
    place = depth_order_of * width
    for j in range(width):
        packet = mi.Vector4f(*values[4 * j : 4 * j + 4])
        dr.scatter(records, packet, place + j, mode=dr.ReduceMode.NoConflicts)
    dr.eval(records)
    return records


def fetch_record(
    records: Float, depth_order: UInt32, length: int, packets: int | None = None
) -> list[Float]:
    """Return the first `length` floats of a record, which has `packets`, by default as many as
    needed.
    """
    count = -(-length // 4)
    reads = (
        dr.gather(mi.Vector4f, records, depth_order * (packets or count) + j) for j in range(count)
    )
    return [v for packet in reads for v in packet][:length]


@dataclass(frozen=True)
class _Rectangles:
    """Tiles that the extent of each splat touches."""

    first: Point2u  #: Column and row of the first one.
    columns: UInt32  #: Tiles across.
    count: UInt32  #: Tiles that the region has.


@dataclass(frozen=True)
class _Tiles:
    """The coarse lists: depth orders by tile, the slot of each entry's tile, first and end entry of
    each slot, and the number of entries that a capacity should hold.
    """

    entries: UInt32
    slots: UInt32
    first: UInt32
    end: UInt32
    total: UInt32 | None = None


def _cells_within(
    table: UInt32, region: DrawnBlocks, splats: Splats, cell: tuple[int, int]
) -> tuple[Point2u, Point2u, UInt32]:
    """Return the first cell (column, row) that each splat's extent touches, the one past the last,
    and the number of set cells between them.

    Args:
        table: summed areas of the cells.
        region: the region of the cells.
        splats: N splats.
        cell: width and height of a cell in blocks.
    """
    across = opaque(mi.UInt32, region.across * ACROSS // cell[0])
    down = opaque(mi.UInt32, region.down * DOWN // cell[1])
    per_px = mi.Vector2f(1.0 / (cell[0] * region.block[0]), 1.0 / (cell[1] * region.block[1]))
    most = mi.Vector2f(across, down)
    mean = dr.detach(splats.mean)
    low = mi.Point2u(dr.clip(dr.floor((mean - splats.radius) * per_px), 0, most))
    high = mi.Point2u(dr.clip(dr.floor((mean + splats.radius) * per_px) + 1, 0, most))
    if splats.view is not None:
        low.y += splats.view * down
        high.y += splats.view * down
    if region.whole:
        return low, high, dr.prod(high - low)

    def before(x: UInt32, y: UInt32) -> UInt32:
        return elements(table, y * (across + 1) + x)

    count = before(high.x, high.y) - before(low.x, high.y) - before(high.x, low.y)
    return low, high, count + before(low.x, low.y)


def _tile_lists(rectangles: _Rectangles, region: DrawnBlocks) -> _Tiles:
    """Enter every depth order into the region's tiles within its rectangle, and sort by tile."""
    columns = rectangles.columns
    counts = rectangles.count
    N = dr.width(counts)
    slots = region.num_tiles
    if N * slots >= 2**32 and (entries := dr.sum(mi.Float64(counts))[0]) >= 2**32:
        raise ValueError(
            f"rasterize(): the lists must have fewer than 2^32 entries, got {entries:.3g} for {N} "
            f"Gaussians in {slots} tiles; make the Gaussians smaller or fewer, or render the "
            "image in several regions."
        )
    end = dr.cumsum(counts)
    capacity = region.capacity
    if capacity is None:
        total = int(end[-1])  # the one number that must reach the host: the size of the lists
        if total == 0:
            return _Tiles(*(dr.zeros(mi.UInt32, size) for size in (1, 1, slots, slots)))
        slot_at = dr.empty(mi.UInt32, total)
        depth_order_at = dr.empty(mi.UInt32, total)
    else:
        # Entries that are not used lie in the last tile, which is beside the view. By a kernel:
        # Dr.Jit 1.5 cannot replay the sort of an array that it has filled without one.
        lane = dr.arange(mi.UInt32, capacity)
        nothing = dr.maximum(lane, capacity - 1) - (capacity - 1)
        slot_at = nothing + (slots - 1)
        depth_order_at = nothing & lane
        dr.eval(slot_at, depth_order_at)
    across = opaque(mi.UInt32, region.across)

    depth_order = dr.arange(mi.UInt32, N)
    mode = dr.ReduceMode.NoConflicts

    def enter(place, column, tile, slot_at, depth_order_at):
        slot = tile if region.whole else elements(region.slot_of, tile)
        is_drawn = region.whole or slot != NO_SLOT
        is_entered = is_drawn if capacity is None else is_drawn & (place < capacity)
        dr.scatter(slot_at, slot, place, active=is_entered, mode=mode)
        dr.scatter(depth_order_at, depth_order, place, active=is_entered, mode=mode)
        place = place + 1 if region.whole else dr.select(is_drawn, place + 1, place)
        wrap = column + 1 == columns
        column = dr.select(wrap, 0, column + 1)
        tile = dr.select(wrap, tile + across + 1 - columns, tile + 1)
        return place, column, tile, slot_at, depth_order_at

    first_tile = rectangles.first.y * across + rectangles.first.x
    state = (end - counts, mi.UInt32(0), first_tile, slot_at, depth_order_at)
    *_, slot_at, depth_order_at = dr.while_loop(
        state, lambda place, *_: place < end, enter, label="tile entries"
    )
    dr.eval(slot_at, depth_order_at)

    total = None if capacity is None else dr.gather(mi.UInt32, end, mi.UInt32(N - 1))
    entries, slot_at, first, end = sorted_buckets(slot_at, slots, depth_order_at)
    return _Tiles(entries, slot_at, first, end, total)


def sorted_buckets(
    keys: UInt32, buckets: int, values: UInt32
) -> tuple[UInt32, UInt32, UInt32, UInt32]:
    """Return (values sorted stably by their `keys`, sorted keys, first place of each bucket, end of
    each bucket).
    """
    perm = stable_order(keys, buckets)
    sorted_keys = elements(keys, perm)
    sorted_values = elements(values, perm)
    dr.eval(sorted_keys, sorted_values)
    bucket = dr.arange(mi.UInt32, buckets)
    first = _first_place(sorted_keys, bucket)
    end = _first_place(sorted_keys, bucket + 1)
    return sorted_values, sorted_keys, first, end


def _first_place(sorted_keys: UInt32, least: UInt32) -> UInt32:
    """Return the place of the first key that is at least `least`, by halving the rest."""

    def halve(low, high):
        middle = low + (high - low) // 2
        is_less = elements(sorted_keys, middle) < least
        return dr.select(is_less, middle + 1, low), dr.select(is_less, high, middle)

    state = (mi.UInt32(0), opaque(mi.UInt32, dr.width(sorted_keys)))
    return dr.while_loop(state, lambda low, high: low < high, halve, label="first place")[0]


def _block_bits(
    geometry: list[Float],
    tiles: _Tiles,
    region: DrawnBlocks,
    config: RenderConfig,
    farthest_limits: Float | None,
) -> tuple[UInt32, UInt32, UInt32]:
    """Return (words, end word of each tile, number of its words) for the geometry of the entries.

    Bit k of word 32 w + b is set if block b of the tile is touched by entry 32 w + k, both counted
    from the tile's first.
    """
    bw, bh = region.block
    num_tiles = region.num_tiles
    length = (tiles.end - tiles.first + 31) // 32
    dr.eval(tiles.first, tiles.end, length)
    end_word = dr.cumsum(length)
    num_words = dr.width(tiles.entries) // 32 + num_tiles  # at most one word per tile is not full

    slot = tiles.slots
    mx, my, a, b, c, log2_opacity, *profile = geometry
    # Slopes dx/dy and dy/dx along which p is largest for a given dy and for a given dx.
    tilt = b / dr.maximum(c, 1e-30)
    slope_x = -b / dr.maximum(a, 1e-30)
    slope_y = -a / dr.maximum(c, 1e-30) * tilt / dr.fma(tilt, tilt, 1)
    px = elements(region.corner_x, slot) - mx
    py = elements(region.corner_y, slot) - my
    reach = log2_opacity - log2(config.alpha_min) + _TEST_SLACK
    columns = []
    for i in range(ACROSS):
        x0 = px + (i * bw + 0.5)
        x1 = px + (i * bw + bw - 0.5)
        x = _clipped(0, x0, x1)
        columns.append((x0, x1, a * x, slope_y * x))
    left = columns[0][0]
    right = columns[-1][1]
    top = py + 0.5
    bottom = py + (DOWN * bh - 0.5)
    if farthest_limits is not None:
        z, gx, gy, r_sigma = profile
        nearest = [z + dr.minimum(gx * x0, gx * x1) for x0, x1, *_ in columns]
    mask = mi.UInt32(0)
    for j in range(DOWN):
        y0 = py + (j * bh + 0.5)
        y1 = py + (j * bh + bh - 0.5)
        if farthest_limits is not None:
            row = dr.minimum(gy * y0, gy * y1)
            farthest = dr.gather(mi.Vector4f, farthest_limits, slot * DOWN + j)
            ahead = [
                (limit - z - row) * r_sigma > -FARTHEST_CUT
                for limit, z in zip(farthest, nearest, strict=True)
            ]
        y = _clipped(0, y0, y1)
        by = b * y
        v = c * y
        best_x = slope_x * y
        for i, (x0, x1, ax, best_y) in enumerate(columns):
            # Over a box, u^2 + v^2 is least at the clamped centre or on the two nearest edges.
            u1 = dr.fma(a, _clipped(best_x, x0, x1), by)
            y_edge = _clipped(best_y, y0, y1)
            u2 = dr.fma(b, y_edge, ax)
            v2 = c * y_edge
            touches = (dr.fma(u1, u1, v * v) <= reach) | (dr.fma(u2, u2, v2 * v2) <= reach)
            if farthest_limits is not None:
                touches &= ahead[i]
            mask |= dr.select(touches, mi.UInt32(1 << (j * ACROSS + i)), mi.UInt32(0))

    # A depth limit may cut the entries that would hide later ones: no entry is omitted for its
    # transmittance.
    if farthest_limits is None:
        # Over the tile, u^2 + v^2 is largest at a corner: a lower bound of alpha, hence an upper
        # bound of the transmittance behind an entry. Entries below the stop in all blocks are not
        # listed; they would not have been blended.
        farthest = mi.Float(0)
        for x in (left, right):
            for y in (top, bottom):
                u = dr.fma(a, x, b * y)
                v = c * y
                farthest = dr.maximum(farthest, dr.fma(u, u, v * v))
        alpha = dr.select(farthest < reach - 2 * _TEST_SLACK, dr.exp2(log2_opacity - farthest), 0)
        log2_transmitted = mi.Float64(dr.log2(1 - dr.minimum(alpha, config.alpha_max)))
        dr.eval(mask, log2_transmitted)
        behind = dr.prefix_sum(log2_transmitted)
        before = dr.gather(mi.Float64, behind, elements(tiles.first, slot))
        # Half an octave exceeds the rounding error of the blend; a stop at 0 omits nothing.
        least = log2(max(config.stop_transmittance, 1e-38)) - 0.5
        mask = dr.select(behind - before < least, 0, mask)
    dr.eval(mask)
    # The tile of each word, and the word's entries.
    word = dr.arange(mi.UInt32, num_words)
    tile = dr.minimum(_first_place(end_word, word + 1), opaque(mi.UInt32, num_tiles - 1))
    place = 32 * (word - elements(end_word, tile) + elements(length, tile))
    place += elements(tiles.first, tile)
    end = elements(tiles.end, tile)
    masks = [dr.gather(mi.UInt32, mask, place + k, place + k < end) for k in range(32)]
    words = dr.empty(mi.UInt32, num_words * 32)
    for k, row in enumerate(_transposed(masks)):
        dr.scatter(words, row, word * 32 + k, mode=dr.ReduceMode.NoConflicts)
    dr.eval(words)
    return words, end_word, length


def _farthest_limits(limits: Float, region: DrawnBlocks) -> Float:
    """Return the largest depth limit in each block of a region's tiles [tiles ACROSS DOWN]."""
    lane = dr.arange(mi.UInt32, region.width * region.height)
    row, column = quotient_and_rest(lane, region.width)
    across = opaque(mi.UInt32, region.across)
    x = column // region.block[0]
    y = row // region.block[1]
    tile = y // DOWN * across + x // ACROSS
    slot = tile if region.whole else elements(region.slot_of, tile)
    farthest = dr.full(mi.Float, -dr.inf, region.num_tiles * ACROSS * DOWN)
    bit = y % DOWN * ACROSS + x % ACROSS
    dr.scatter_reduce(
        dr.ReduceOp.Max, farthest, limits, slot * (ACROSS * DOWN) + bit, active=slot != NO_SLOT
    )
    dr.eval(farthest)
    return farthest


def _clipped(value: Float | int, low: Float, high: Float) -> Float:
    """Return `value` clipped to [low, high]: two instructions, where `dr.clip` takes six to handle
    NaN.
    """
    value = dr.select(value < low, low, value)
    return dr.select(value > high, high, value)


def _transposed(rows: list[UInt32]) -> list[UInt32]:
    """Return 32 words of 32 bits transposed: swap off-diagonal squares of 16, 8, ... 1 bits
    (Hacker's Delight, 7-3).
    """
    rows = list(rows)
    size = 16
    mask = 0x0000FFFF
    while size:
        for k in range(32):
            if not k & size:
                swap = ((rows[k] >> size) ^ rows[k + size]) & mask
                rows[k] = rows[k] ^ (swap << size)
                rows[k + size] = rows[k + size] ^ swap
        size >>= 1
        mask ^= (mask << size) & 0xFFFFFFFF
    return rows


def _set_bits(words: UInt32, begin: UInt32, end: UInt32) -> UInt32:
    """Return the number of set bits in every block's words."""

    def add(place, count):
        return place + 32, count + dr.popcnt(elements(words, place))

    return dr.while_loop(
        (begin, mi.UInt32(0)), lambda place, count: place < end, add, label="set bits"
    )[1]
