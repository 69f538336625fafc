"""Who touches which block of pixels, in depth order.

Two levels. Coarse: every Gaussian is entered into the tiles (4 x 8 blocks) that its extent touches; one counting
sort by tile, fed in depth order, gives each tile its list. Fine: each entry of a tile's list is tested exactly
against the tile's 32 blocks, one bit each; 32 entries by 32 blocks of bits are transposed in registers, so that
every block has its own bit string over its tile's list; one lane per block then writes out the set ones, in order.
No pair of Gaussian and block costs more than its bit, unless it is really drawn: then it costs 4 bytes.

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

__all__ = ["BlockLists", "build_lists", "fetch_record", "pack_records", "pixel_grid", "sorted_buckets"]

# Half a thousandth of an octave: the block test may keep too much, never too little.
_TEST_SLACK = 1e-3
# Blocks of a tile, across and down: as many as a word has bits.
_ACROSS, _DOWN = 4, 8


@dataclass(frozen=True)
class BlockLists:
    """Depth-ordered lists, one per block of pixels.

    Attributes:
        entries: ranks, stretch after stretch.
        start: first entry of each block [B].
        count: number of entries of each block [B].
        origin: (x, y) of each block's first pixel [B].
        order: blocks by falling count [B], so that the lanes of a packet finish together.
        rank_of: rank of each Gaussian [N].
        by_rank: Gaussian of each rank [N].
        size: (width, height) of the image, as width-1 Dr.Jit integers.
    """

    entries: Any
    start: Any
    count: Any
    origin: tuple[Any, Any]
    order: Any
    rank_of: Any
    by_rank: Any
    size: tuple[Any, Any]


def build_lists(splats: Splats, width: int, height: int, config: RenderConfig) -> BlockLists:
    """List the splats (N > 0) that each block of a width x height image may show, nearest first."""
    UInt32, N = mi.UInt32, len(splats)
    block = config.block_shape(dr.backend_v(mi.Float) == dr.JitBackend.CUDA)
    tile = (_ACROSS * block[0], _DOWN * block[1])
    across, down = -(-width // tile[0]), -(-height // tile[1])
    memory = UInt32([width, height, across, down])
    *size, stride, rows = (dr.gather(UInt32, memory, UInt32(i)) for i in range(4))

    by_rank = dr.argsort(dr.select(splats.valid, splats.depths, dr.inf))
    rank_of = dr.empty(UInt32, N)
    dr.scatter(rank_of, dr.arange(UInt32, N), by_rank, mode=dr.ReduceMode.Permute)
    rectangles = _tile_rectangles(splats, by_rank, (stride, rows), tile)
    tiles = _tile_lists(*rectangles, stride, across * down)

    records = pack_records([*splats.shape, *splats.slopes], by_rank)
    words, first_word, end_word = _block_bits(records, tiles, stride, block, config)
    lane = dr.arange(UInt32, across * down * _ACROSS * _DOWN)
    home, part = lane // (_ACROSS * _DOWN), lane % (_ACROSS * _DOWN)
    x = (home % stride) * tile[0] + (part % _ACROSS) * block[0]
    y = (home // stride) * tile[1] + (part // _ACROSS) * block[1]
    begin = dr.gather(UInt32, first_word, home)
    end = dr.select((x < size[0]) & (y < size[1]), dr.gather(UInt32, end_word, home), begin)
    entries, start, count = _written_out(words, begin, end, part, tiles.entries, dr.gather(UInt32, tiles.first, home))
    # 1023 buckets suffice: longer lists are all "long".
    order = dr.detail.block_mkperm(1023 - dr.minimum(count, 1023), dr.width(count), 1024)
    dr.eval(x, y)
    return BlockLists(entries, start, count, (x, y), order, rank_of, by_rank, (size[0], size[1]))


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


def fetch_record(records: Any, rank: Any, length: int) -> list[Any]:
    """Return the `length` floats of the record at `rank`."""
    width = -(-length // 4)
    packets = (dr.gather(mi.Vector4f, records, rank * width + j) for j in range(width))
    return [v for packet in packets for v in packet][:length]


def pixel_grid(origin: tuple[Any, Any], block: tuple[int, int], size: tuple[Any, Any]) -> list[tuple[Any, Any]]:
    """Return (pixel index, inside the image) for every pixel of the lanes' blocks, row by row."""
    grid = []
    for j in range(block[1]):
        for i in range(block[0]):
            x, y = origin[0] + i, origin[1] + j
            grid.append((y * size[0] + x, (x < size[0]) & (y < size[1])))
    return grid


@dataclass(frozen=True)
class _Tiles:
    """The coarse lists: ranks `entries` sorted by tile and depth, the tile of each, each tile's first and end."""

    entries: Any
    tile_of: Any
    first: Any
    end: Any


def _tile_rectangles(
    splats: Splats, by_rank: Any, tiles: tuple[Any, Any], tile: tuple[int, int]
) -> tuple[Any, Any, Any, Any]:
    """Return each rank's first tile (x, y), its tiles across, and its number of tiles."""

    def span(center: Any, half: Any, tiles: Any, edge: int) -> tuple[Any, Any]:
        top, bound = mi.Float(tiles), 1.0 / edge
        low = dr.clip(dr.floor((center - half) * bound), 0, top)
        high = dr.clip(dr.floor((center + half) * bound) + 1, 0, top)
        return mi.UInt32(low), mi.UInt32(high)

    (x0, x1), (y0, y1) = (span(dr.detach(splats.shape[i]), splats.extent[i], tiles[i], tile[i]) for i in range(2))
    counts = dr.select(splats.valid, (x1 - x0) * (y1 - y0), 0)
    rectangles = (x0, y0, x1 - x0, counts)
    dr.eval(rectangles)
    x, y, columns, counts = (dr.gather(mi.UInt32, v, by_rank) for v in rectangles)
    return x, y, columns, counts


def _tile_lists(x0: Any, y0: Any, columns: Any, counts: Any, stride: Any, tiles: int) -> _Tiles:
    """Enter every rank into the tiles of its rectangle and sort by tile."""
    UInt32, N = mi.UInt32, dr.width(counts)
    if N * tiles >= 2**32 and (entries := dr.sum(mi.Float64(counts))[0]) >= 2**32:
        raise ValueError(
            f"rasterize(): the lists must have fewer than 2^32 entries, got {entries:.3g} for {N} Gaussians in "
            f"{tiles} tiles; make the Gaussians smaller or fewer, or render the image in parts."
        )
    offsets = dr.cumsum(counts)
    total = int(offsets[-1])  # the one number that must reach the host: the size of the lists
    if total == 0:
        return _Tiles(dr.zeros(UInt32, 1), dr.zeros(UInt32, 1), dr.zeros(UInt32, tiles), dr.zeros(UInt32, tiles))
    tile_of, rank_at = dr.empty(UInt32, total), dr.empty(UInt32, total)

    def enter(k, column, tile, first, columns, counts, rank, stride, tile_of, rank_at):
        dr.scatter(tile_of, tile + column, first + k, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(rank_at, rank, first + k, mode=dr.ReduceMode.NoConflicts)
        wrap = column + 1 == columns
        column, tile = dr.select(wrap, 0, column + 1), dr.select(wrap, tile + stride, tile)
        return k + 1, column, tile, first, columns, counts, rank, stride, tile_of, rank_at

    rank = dr.arange(UInt32, N)
    state = (
        UInt32(0),
        UInt32(0),
        y0 * stride + x0,
        offsets - counts,
        columns,
        counts,
        rank,
        stride,
        tile_of,
        rank_at,
    )
    *_, tile_of, rank_at = dr.while_loop(state, lambda k, *s: k < s[4], enter, label="tile entries")
    dr.eval(tile_of, rank_at)

    perm, first, end = sorted_buckets(tile_of, tiles)
    entries, tile_of = dr.gather(UInt32, rank_at, perm), dr.gather(UInt32, tile_of, perm)
    dr.eval(entries, tile_of)
    return _Tiles(entries, tile_of, first, end)


def sorted_buckets(keys: Any, buckets: int) -> tuple[Any, Any, Any]:
    """Return (permutation that sorts `keys` stably, first place of each bucket, end of each bucket)."""
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
    return perm, first, end


def _block_bits(
    records: Any, tiles: _Tiles, stride: Any, block: tuple[int, int], config: RenderConfig
) -> tuple[Any, Any, Any]:
    """Return (words, first word of each tile, end): bit k of word 32 w + b says that block b of the tile is
    touched by entry 32 w + k, counted from the tile's first word and first entry.
    """
    UInt32, (bw, bh), num_tiles = mi.UInt32, block, dr.width(tiles.first)
    length = (tiles.end - tiles.first + 31) // 32
    end_word = dr.cumsum(length)
    first_word = end_word - length
    dr.eval(first_word, end_word)
    num_words = dr.width(tiles.entries) // 32 + num_tiles  # at most one word per tile is not full

    tile = tiles.tile_of
    mx, my, a, b, c, log2_opacity, slope_x, slope_y = fetch_record(records, tiles.entries, 8)
    px, py = mi.Float((tile % stride) * (_ACROSS * bw)) - mx, mi.Float((tile // stride) * (_DOWN * bh)) - my
    reach = log2_opacity - log2(config.alpha_min) + _TEST_SLACK
    columns = []
    for i in range(_ACROSS):
        x0, x1 = px + (i * bw + 0.5), px + (i * bw + bw - 0.5)
        x = _clipped(0, x0, x1)
        columns.append((x0, x1, a * x, slope_y * x))
    mask = UInt32(0)
    for j in range(_DOWN):
        y0, y1 = py + (j * bh + 0.5), py + (j * bh + bh - 0.5)
        y = _clipped(0, y0, y1)
        by, v, best_x = b * y, c * y, slope_x * y
        for i, (x0, x1, ax, best_y) in enumerate(columns):
            # Over a box, u^2 + v^2 is least at the clamped centre or on the two nearest edges.
            u1, y_edge = dr.fma(a, _clipped(best_x, x0, x1), by), _clipped(best_y, y0, y1)
            u2, v2 = dr.fma(b, y_edge, ax), c * y_edge
            touches = (dr.fma(u1, u1, v * v) <= reach) | (dr.fma(u2, u2, v2 * v2) <= reach)
            mask |= dr.select(touches, UInt32(1 << (j * _ACROSS + i)), UInt32(0))

    # Over the tile, u^2 + v^2 is largest at a corner: a lower bound of alpha, so an upper bound of the light that
    # is left behind an entry. What no light can reach in any block is not listed; it would not have been blended.
    def distance(x: Any, y: Any) -> Any:
        u, v = dr.fma(a, x, b * y), c * y
        return dr.fma(u, u, v * v)

    x0, x1, y0, y1 = columns[0][0], columns[-1][1], py + 0.5, py + (_DOWN * bh - 0.5)
    farthest = distance(x0, y0)
    for x, y in ((x0, y1), (x1, y0), (x1, y1)):
        farthest = dr.maximum(farthest, distance(x, y))
    alpha = dr.select(farthest < reach - 2 * _TEST_SLACK, dr.exp2(log2_opacity - farthest), 0)
    dimming = dr.log2(1 - dr.minimum(alpha, config.alpha_max))
    dr.eval(mask, dimming)
    behind = dr.prefix_sum(mi.Float64(dimming))
    light = behind - dr.gather(mi.Float64, behind, dr.gather(UInt32, tiles.first, tile))
    # Half an octave is more than the blend's own rounding can lose; with no stop at all nothing is left out.
    mask = dr.select(light < log2(max(config.stop_transmittance, 1e-38)) - 0.5, 0, mask)

    place = dr.gather(UInt32, first_word, tile) * 32 + dr.arange(UInt32, dr.width(tile))
    masks = dr.zeros(UInt32, num_words * 32)
    dr.scatter(masks, mask, place - dr.gather(UInt32, tiles.first, tile), mode=dr.ReduceMode.NoConflicts)
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


def _written_out(
    words: Any, begin: Any, end: Any, part: Any, tile_entries: Any, first_entry: Any
) -> tuple[Any, Any, Any]:
    """Return (entries, start, count) of every block: the ranks at the set bits of its words [begin, end)."""
    UInt32 = mi.UInt32

    def add(w, count, end, part, words):
        return w + 1, count + dr.popcnt(dr.gather(UInt32, words, w * 32 + part)), end, part, words

    state = (begin, UInt32(0), end, part, words)
    _, count, *_ = dr.while_loop(state, lambda w, count, end, *_: w < end, add, label="count bits")
    stop = dr.cumsum(count)
    dr.eval(count, stop)
    start = stop - count
    total = int(stop[-1])
    # An array of one would be taken for a scalar.
    entries = dr.empty(UInt32, total) if total > 1 else dr.zeros(UInt32, 2)

    def emit(w, word, base, place, begin, end, part, first_entry, words, tile_entries, entries):
        load = word == 0
        base = dr.select(load, first_entry + (w - begin) * 32, base)
        word = dr.select(load, dr.gather(UInt32, words, w * 32 + part, active=load), word)
        w = dr.select(load, w + 1, w)
        found = word != 0
        rank = dr.gather(UInt32, tile_entries, base + dr.tzcnt(word), active=found)
        dr.scatter(entries, rank, place, active=found, mode=dr.ReduceMode.NoConflicts)
        place = dr.select(found, place + 1, place)
        return w, word & (word - 1), base, place, begin, end, part, first_entry, words, tile_entries, entries

    state = (begin, UInt32(0), UInt32(0), start, begin, end, part, first_entry, words, tile_entries, entries)
    *_, entries = dr.while_loop(
        state, lambda w, word, base, place, begin, end, *_: (w < end) | (word != 0), emit, label="block lists"
    )
    dr.eval(entries, start)
    return entries, start, count
