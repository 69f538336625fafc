"""Who touches which block of pixels, in depth order.

Two levels. Coarse: every Gaussian is entered into the tiles (4 x 8 blocks) that its extent touches; one counting
sort by tile, fed in depth order, gives each tile its list. Fine: each entry of a tile's list is tested exactly
against the tile's 32 blocks, one bit each; 32 entries by 32 blocks of bits are transposed in registers, so that
every block has its own string of bits over its tile's list. The blending loops walk the set bits: what a block
draws is never written out, and a pair of Gaussian and block costs one bit.

"Rank" is a Gaussian's place in depth order; equal depths keep the order of the input.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log2
from typing import Any

import drjit as dr
import mitsuba as mi

from morgs_mi.render.config import RenderConfig
from morgs_mi.render.projection import Splats
from morgs_mi.render.region import ACROSS, DOWN, NO_SLOT, Region

__all__ = ["BlockLists", "build_lists", "fetch_record", "next_entry", "pack_records", "sorted_buckets", "touches"]

# Half a thousandth of an octave: the block test may keep too much, never too little.
_TEST_SLACK = 1e-3


@dataclass(frozen=True)
class BlockLists:
    """Depth-ordered lists, one per block of pixels: which bits of which words, over which entries.

    Attributes:
        records: (mean_x, mean_y, a, b, c, log2_opacity, blended columns) of each rank, see `pack_records`.
        words: bit k of a block's i-th word says that it draws entry `first` + 32 i + k.
        entries: ranks, tile after tile.
        begin: place of each block's first word [A]; the next ones follow at steps of 32.
        end: place past its last word [A].
        first: first entry of its tile [A].
        count: number of set bits of each block [A].
        order: blocks by falling count, roughly [A], so that the lanes of a packet finish together.
        rank_of: rank of each splat [N].
        by_rank: splat of each rank [N].
    """

    records: Any
    words: Any
    entries: Any
    begin: Any
    end: Any
    first: Any
    count: Any
    order: Any
    rank_of: Any
    by_rank: Any


def build_lists(splats: Splats, columns: list[Any], region: Region, config: RenderConfig) -> BlockLists:
    """List the splats (N > 0) that each block of a region may show, nearest first.

    Args:
        splats: what to list.
        columns: what is blended, floats [N].
        region: the blocks.
        config: cut-offs.
    """
    UInt32, N = mi.UInt32, len(splats)
    depths = dr.select(splats.valid, splats.depths, dr.inf)
    if splats.order is None:
        by_rank = dr.argsort(depths)
    else:
        by_rank = dr.gather(UInt32, splats.order, dr.argsort(dr.gather(mi.Float, depths, splats.order)))
    rank_of = dr.empty(UInt32, N)
    dr.scatter(rank_of, dr.arange(UInt32, N), by_rank, mode=dr.ReduceMode.Permute)
    rectangles = _tile_rectangles(splats, region)
    dr.eval(rectangles)
    tiles = _tile_lists([dr.gather(UInt32, v, by_rank) for v in rectangles], region)

    records = pack_records([*splats.shape, *columns], by_rank)
    geometry = fetch_record(records, tiles.entries, 6, dr.width(records) // (4 * N))
    words, first_word, end_word = _block_bits(geometry, tiles, region, config)
    begin = dr.gather(UInt32, first_word, region.home) * 32 + region.part
    end = dr.gather(UInt32, end_word, region.home) * 32 + region.part
    first = dr.gather(UInt32, tiles.first, region.home)
    count = _set_bits(words, begin, end)
    dr.eval(begin, end, first, count)
    # Where lengths differ by less than an eighth, neighbours stay together: they draw the same and go dark alike.
    bucket = UInt32(6 * dr.log2(mi.Float(count) + 1))
    order = dr.detail.block_mkperm(255 - bucket, dr.width(count), 256)
    return BlockLists(records, words, tiles.entries, begin, end, first, count, order, rank_of, by_rank)


def touches(splats: Splats, region: Region) -> Any:
    """Return whether the extent of each splat reaches a block of the region, bool [N]."""
    return splats.valid & (_cells_within(region.block_table, region, splats, (1, 1))[1] > 0)


def next_entry(place: Any, word: Any, base: Any, end: Any, words: Any) -> tuple[Any, Any, Any]:
    """Walk on to a word with a set bit: return (place of the word after it, word, entry that its bit 0 stands for).

    The word is 0 where there is none left.
    """

    def step(place, word, base, end, words):
        return place + 32, dr.gather(mi.UInt32, words, place), base + 32, end, words

    state = (place, word, base, end, words)
    walked = dr.while_loop(
        state, lambda place, word, base, end, _: (word == 0) & (place < end), step, label="next word"
    )
    return walked[:3]


def pack_records(columns: list[Any], order: Any) -> Any:
    """Interleave columns [N] to one record per Gaussian, in the order given, padded to 4 floats.

    Records are read by packets of 4 floats, one cache line or less for each Gaussian.
    """
    N, width = dr.width(order), -(-len(columns) // 4)
    values = [dr.gather(mi.Float, column, order) for column in columns]
    values += [mi.Float(0)] * (4 * width - len(values))
    records = dr.empty(mi.Float, 4 * width * N)
    lane = dr.arange(mi.UInt32, N) * width
    for j in range(width):
        packet = mi.Vector4f(*values[4 * j : 4 * j + 4])
        dr.scatter(records, packet, lane + j, mode=dr.ReduceMode.NoConflicts)
    dr.eval(records)
    return records


def fetch_record(records: Any, rank: Any, length: int, packets: int | None = None) -> list[Any]:
    """Return the first `length` floats of the record at `rank`; a record has `packets`, by default just enough."""
    needed = -(-length // 4)
    reads = (dr.gather(mi.Vector4f, records, rank * (packets or needed) + j) for j in range(needed))
    return [v for packet in reads for v in packet][:length]


@dataclass(frozen=True)
class _Tiles:
    """The coarse lists: ranks `entries` by tile and depth, the slot of each's tile, each slot's first and end."""

    entries: Any
    slots: Any
    first: Any
    end: Any


def _cells_within(table: Any, region: Region, splats: Splats, cell: tuple[int, int]) -> tuple[Any, Any]:
    """Return the rectangle (x0, y0, x1, y1) of cells that each splat's extent touches, and how many of them are set.

    Args:
        table: summed area of the cells.
        region: whose grid it is.
        splats: N of them.
        cell: width and height in blocks.
    """
    UInt32 = mi.UInt32
    across = dr.gather(UInt32, region.grid, UInt32(0)) * (ACROSS // cell[0])
    down = dr.gather(UInt32, region.grid, UInt32(1)) * (DOWN // cell[1])

    def span(axis: int, cells: Any) -> tuple[Any, Any]:
        center, half, top = dr.detach(splats.shape[axis]), splats.extent[axis], mi.Float(cells)
        bound = 1.0 / (cell[axis] * region.block[axis])
        low = dr.clip(dr.floor((center - half) * bound), 0, top)
        high = dr.clip(dr.floor((center + half) * bound) + 1, 0, top)
        return UInt32(low), UInt32(high)

    (x0, x1), (y0, y1) = span(0, across), span(1, down)
    if region.whole:
        return (x0, y0, x1, y1), (x1 - x0) * (y1 - y0)

    def before(x: Any, y: Any) -> Any:
        return dr.gather(UInt32, table, y * (across + 1) + x)

    return (x0, y0, x1, y1), before(x1, y1) - before(x0, y1) - before(x1, y0) + before(x0, y0)


def _tile_rectangles(splats: Splats, region: Region) -> tuple[Any, Any, Any, Any]:
    """Return each splat's first tile (x, y), its tiles across, and how many of its tiles are the region's."""
    (x0, y0, x1, _), counts = _cells_within(region.tile_table, region, splats, (ACROSS, DOWN))
    return x0, y0, x1 - x0, dr.select(splats.valid, counts, 0)


def _tile_lists(rectangles: list[Any], region: Region) -> _Tiles:
    """Enter every rank into those tiles of its rectangle that are the region's, and sort by tile."""
    x0, y0, columns, counts = rectangles
    UInt32, N, slots = mi.UInt32, dr.width(counts), region.num_tiles
    if N * slots >= 2**32 and (entries := dr.sum(mi.Float64(counts))[0]) >= 2**32:
        raise ValueError(
            f"rasterize(): the lists must have fewer than 2^32 entries, got {entries:.3g} for {N} Gaussians in "
            f"{slots} tiles; make the Gaussians smaller or fewer, or render the image in parts."
        )
    end = dr.cumsum(counts)
    total = int(end[-1])  # the one number that must reach the host: the size of the lists
    if total == 0:
        return _Tiles(dr.zeros(UInt32, 1), dr.zeros(UInt32, 1), dr.zeros(UInt32, slots), dr.zeros(UInt32, slots))
    slot_at, rank_at = dr.empty(UInt32, total), dr.empty(UInt32, total)
    across = dr.gather(UInt32, region.grid, UInt32(0))

    def enter(place, end, column, tile, columns, rank, across, slot_of, slot_at, rank_at):
        slot = tile if region.whole else dr.gather(UInt32, slot_of, tile)
        ours = region.whole or slot != NO_SLOT
        dr.scatter(slot_at, slot, place, active=ours, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(rank_at, rank, place, active=ours, mode=dr.ReduceMode.NoConflicts)
        place = place + 1 if region.whole else dr.select(ours, place + 1, place)
        wrap = column + 1 == columns
        column, tile = dr.select(wrap, 0, column + 1), dr.select(wrap, tile + across + 1 - columns, tile + 1)
        return place, end, column, tile, columns, rank, across, slot_of, slot_at, rank_at

    state = (
        end - counts,
        end,
        UInt32(0),
        y0 * across + x0,
        columns,
        dr.arange(UInt32, N),
        across,
        region.slot_of,
        slot_at,
        rank_at,
    )
    *_, slot_at, rank_at = dr.while_loop(state, lambda place, end, *_: place < end, enter, label="tile entries")
    dr.eval(slot_at, rank_at)

    perm, slot_at, first, end = sorted_buckets(slot_at, slots)
    entries = dr.gather(UInt32, rank_at, perm)
    dr.eval(entries)
    return _Tiles(entries, slot_at, first, end)


def sorted_buckets(keys: Any, buckets: int) -> tuple[Any, Any, Any, Any]:
    """Return (permutation that sorts `keys` stably, sorted keys, first place of each bucket, end of each bucket)."""
    UInt32, total = mi.UInt32, dr.width(keys)
    # On the CPU one counting pass sorts, stably. On the GPU that pass is stable for few buckets only.
    on_cpu = dr.backend_v(mi.Float) == dr.JitBackend.LLVM
    perm = dr.detail.block_mkperm(keys, total, buckets) if on_cpu else dr.argsort(keys)
    ordered = dr.gather(UInt32, keys, perm)
    dr.eval(ordered)
    first, end = dr.zeros(UInt32, buckets), dr.zeros(UInt32, buckets)
    j = dr.arange(UInt32, total)
    is_last = j + 1 == dr.opaque(UInt32, total)
    following = dr.gather(UInt32, ordered, j + 1, active=~is_last)
    edge = is_last | (following != ordered)
    dr.scatter(end, j + 1, ordered, active=edge)
    dr.scatter(first, j + 1, following, active=edge & ~is_last)
    dr.eval(first, end)
    return perm, ordered, first, end


def _block_bits(geometry: list[Any], tiles: _Tiles, region: Region, config: RenderConfig) -> tuple[Any, Any, Any]:
    """Return (words, first word of each tile, end): bit k of word 32 w + b says that block b of the tile is
    touched by entry 32 w + k, counted from the tile's first word and first entry. `geometry` is the entries'.
    """
    UInt32, (bw, bh), num_tiles = mi.UInt32, region.block, region.num_tiles
    length = (tiles.end - tiles.first + 31) // 32
    end_word = dr.cumsum(length)
    first_word = end_word - length
    dr.eval(first_word, end_word)
    num_words = dr.width(tiles.entries) // 32 + num_tiles  # at most one word per tile is not full

    slot = tiles.slots
    mx, my, a, b, c, log2_opacity = geometry
    # dx/dy and dy/dx along which p is largest for given dy and for given dx.
    tilt = b / dr.maximum(c, 1e-30)
    slope_x, slope_y = -b / dr.maximum(a, 1e-30), -a / dr.maximum(c, 1e-30) * tilt / dr.fma(tilt, tilt, 1)
    px, py = dr.gather(mi.Float, region.corner_x, slot) - mx, dr.gather(mi.Float, region.corner_y, slot) - my
    reach = log2_opacity - log2(config.alpha_min) + _TEST_SLACK
    columns = []
    for i in range(ACROSS):
        x0, x1 = px + (i * bw + 0.5), px + (i * bw + bw - 0.5)
        x = _clipped(0, x0, x1)
        columns.append((x0, x1, a * x, slope_y * x))
    mask = UInt32(0)
    for j in range(DOWN):
        y0, y1 = py + (j * bh + 0.5), py + (j * bh + bh - 0.5)
        y = _clipped(0, y0, y1)
        by, v, best_x = b * y, c * y, slope_x * y
        for i, (x0, x1, ax, best_y) in enumerate(columns):
            # Over a box, u^2 + v^2 is least at the clamped centre or on the two nearest edges.
            u1, y_edge = dr.fma(a, _clipped(best_x, x0, x1), by), _clipped(best_y, y0, y1)
            u2, v2 = dr.fma(b, y_edge, ax), c * y_edge
            touches = (dr.fma(u1, u1, v * v) <= reach) | (dr.fma(u2, u2, v2 * v2) <= reach)
            mask |= dr.select(touches, UInt32(1 << (j * ACROSS + i)), UInt32(0))

    # Over the tile, u^2 + v^2 is largest at a corner: a lower bound of alpha, so an upper bound of the light that
    # is left behind an entry. What no light can reach in any block is not listed; it would not have been blended.
    def distance(x: Any, y: Any) -> Any:
        u, v = dr.fma(a, x, b * y), c * y
        return dr.fma(u, u, v * v)

    x0, x1, y0, y1 = columns[0][0], columns[-1][1], py + 0.5, py + (DOWN * bh - 0.5)
    farthest = distance(x0, y0)
    for x, y in ((x0, y1), (x1, y0), (x1, y1)):
        farthest = dr.maximum(farthest, distance(x, y))
    alpha = dr.select(farthest < reach - 2 * _TEST_SLACK, dr.exp2(log2_opacity - farthest), 0)
    dimming = dr.log2(1 - dr.minimum(alpha, config.alpha_max))
    dr.eval(mask, dimming)
    behind = dr.prefix_sum(mi.Float64(dimming))
    light = behind - dr.gather(mi.Float64, behind, dr.gather(UInt32, tiles.first, slot))
    # Half an octave is more than the blend's own rounding can lose; with no stop at all nothing is left out.
    mask = dr.select(light < log2(max(config.stop_transmittance, 1e-38)) - 0.5, 0, mask)

    place = dr.gather(UInt32, first_word, slot) * 32 + dr.arange(UInt32, dr.width(slot))
    masks = dr.zeros(UInt32, num_words * 32)
    dr.scatter(masks, mask, place - dr.gather(UInt32, tiles.first, slot), mode=dr.ReduceMode.NoConflicts)
    dr.eval(masks)
    word = dr.arange(UInt32, num_words) * 32
    rows = _transposed([dr.gather(UInt32, masks, word + k) for k in range(32)])
    words = dr.empty(UInt32, num_words * 32)
    for k, row in enumerate(rows):
        dr.scatter(words, row, word + k, mode=dr.ReduceMode.NoConflicts)
    dr.eval(words)
    return words, first_word, end_word


def _clipped(value: Any, low: Any, high: Any) -> Any:
    """Return `value` within [low, high]: two instructions, where `dr.clip` takes six to be right about NaN."""
    value = dr.select(value < low, low, value)
    return dr.select(value > high, high, value)


def _transposed(rows: list[Any]) -> list[Any]:
    """Transpose 32 words of 32 bits: swap off-diagonal squares of 16, 8, ... 1 bits (Hacker's Delight, 7-3)."""
    rows, size, mask = list(rows), 16, 0x0000FFFF
    while size:
        for k in range(32):
            if not k & size:
                swap = ((rows[k] >> size) ^ rows[k + size]) & mask
                rows[k], rows[k + size] = rows[k] ^ (swap << size), rows[k + size] ^ swap
        size >>= 1
        mask ^= (mask << size) & 0xFFFFFFFF
    return rows


def _set_bits(words: Any, begin: Any, end: Any) -> Any:
    """Return the number of set bits in every block's words."""

    def add(place, count, end, words):
        return place + 32, count + dr.popcnt(dr.gather(mi.UInt32, words, place)), end, words

    state = (begin, mi.UInt32(0), end, words)
    return dr.while_loop(state, lambda place, count, end, _: place < end, add, label="set bits")[1]
