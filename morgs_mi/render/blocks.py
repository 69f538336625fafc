"""Who touches which block of pixels, in depth order.

Two levels. Coarse: every Gaussian is entered into the tiles that its extent touches; one counting sort by
tile, fed in depth order, gives each tile its list. Fine: one lane per pixel block walks its tile's list,
tests the ellipse against the block exactly and appends what passes to its own stretch of memory, in order.
The walk ends where the Gaussians so far leave less light than the stop transmittance at every pixel.

"Rank" is a Gaussian's place in depth order; equal depths keep the order of the input.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log2
from typing import Any

import drjit as dr
import mitsuba as mi

from .config import RenderConfig
from .projection import Splats

__all__ = ["BlockLists", "build_lists", "fetch_record", "pack_records", "pixel_grid"]

# Half a thousandth of an octave: the block test may keep too much, never too little.
_TEST_SLACK = 1e-3


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
    UInt32, N, edge = mi.UInt32, len(splats), config.tile_size
    tiles_x, tiles_y = -(-width // edge), -(-height // edge)
    memory = UInt32([width, height, tiles_x])
    size = tuple(dr.gather(UInt32, memory, UInt32(i)) for i in range(2))
    stride = dr.gather(UInt32, memory, UInt32(2))

    by_rank = dr.argsort(dr.select(splats.valid, splats.depths, dr.inf))
    x0, y0, columns, counts = _tile_rectangles(splats, by_rank, stride, (size[1] + (edge - 1)) // edge, edge)
    tile_entries, first, last = _tile_lists(x0, y0, columns, counts, stride, tiles_x * tiles_y)
    rank_of = dr.empty(UInt32, N)
    dr.scatter(rank_of, dr.arange(UInt32, N), by_rank, mode=dr.ReduceMode.Permute)

    tests = pack_records([*splats.shape, *splats.slopes], by_rank)
    block = config.block_shape(dr.backend_v(mi.Float) == dr.JitBackend.CUDA)
    entries, start, count, origin = _block_lists(
        tests, tile_entries, first, last, stride, size, tiles_x * tiles_y, block, config
    )
    # 1023 buckets suffice: longer lists are all "long".
    order = dr.detail.block_mkperm(1023 - dr.minimum(count, 1023), dr.width(count), 1024)
    return BlockLists(entries, start, count, origin, order, rank_of, by_rank, size)


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


def _tile_rectangles(splats: Splats, by_rank: Any, tiles_x: Any, tiles_y: Any, edge: int) -> tuple[Any, ...]:
    """Return each rank's first tile (x, y), its tiles across, and its number of tiles."""

    def span(center: Any, half: Any, tiles: Any) -> tuple[Any, Any]:
        top, bound = mi.Float(tiles), 1.0 / edge
        low = dr.clip(dr.floor((center - half) * bound), 0, top)
        high = dr.clip(dr.floor((center + half) * bound) + 1, 0, top)
        return mi.UInt32(low), mi.UInt32(high)

    (x0, x1), (y0, y1) = (
        span(dr.detach(splats.shape[i]), splats.extent[i], tiles) for i, tiles in enumerate((tiles_x, tiles_y))
    )
    counts = dr.select(splats.valid, (x1 - x0) * (y1 - y0), 0)
    rectangles = (x0, y0, x1 - x0, counts)
    dr.eval(rectangles)
    return tuple(dr.gather(mi.UInt32, v, by_rank) for v in rectangles)


def _tile_lists(x0: Any, y0: Any, columns: Any, counts: Any, stride: Any, tiles: int) -> tuple[Any, Any, Any]:
    """Return (ranks sorted by tile and depth, first entry of each tile, end of each tile)."""
    UInt32 = mi.UInt32
    offsets = dr.cumsum(counts)
    total = int(offsets[-1])  # the one number that must reach the host: the size of the lists
    if total == 0:
        return dr.zeros(UInt32, 1), dr.zeros(UInt32, tiles), dr.zeros(UInt32, tiles)
    tile_of, rank_at = dr.empty(UInt32, total), dr.empty(UInt32, total)

    def enter(k, column, tile, first, columns, counts, rank, stride, tile_of, rank_at):
        dr.scatter(tile_of, tile + column, first + k, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(rank_at, rank, first + k, mode=dr.ReduceMode.NoConflicts)
        wrap = column + 1 == columns
        column, tile = dr.select(wrap, 0, column + 1), dr.select(wrap, tile + stride, tile)
        return k + 1, column, tile, first, columns, counts, rank, stride, tile_of, rank_at

    rank = dr.arange(UInt32, dr.width(counts))
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

    # On the CPU one counting pass sorts by tile, stably. On the GPU that pass is stable for few buckets only.
    on_cpu = dr.backend_v(mi.Float) == dr.JitBackend.LLVM
    perm = dr.detail.block_mkperm(tile_of, total, tiles) if on_cpu else dr.argsort(tile_of)
    entries, tile_of = dr.gather(UInt32, rank_at, perm), dr.gather(UInt32, tile_of, perm)
    dr.eval(entries, tile_of)
    first, end = dr.zeros(UInt32, tiles), dr.zeros(UInt32, tiles)
    j = dr.arange(UInt32, total)
    is_last = j + 1 == dr.opaque(UInt32, total)
    following = dr.gather(UInt32, tile_of, j + 1, active=~is_last)
    edge = is_last | (following != tile_of)
    dr.scatter(end, j + 1, tile_of, active=edge)
    dr.scatter(first, j + 1, following, active=edge & ~is_last)
    dr.eval(first, end)
    return entries, first, end


def _block_lists(
    tests: Any,
    tile_entries: Any,
    first: Any,
    end: Any,
    stride: Any,
    size: tuple[Any, Any],
    tiles: int,
    block: tuple[int, int],
    config: RenderConfig,
) -> tuple[Any, Any, Any, tuple[Any, Any]]:
    """Return (entries, start, count, origin) of every block: its tile's list without what misses it."""
    UInt32, edge, (bw, bh) = mi.UInt32, config.tile_size, block
    across = edge // bw
    per_tile = across * (edge // bh)
    lane = dr.arange(UInt32, tiles * per_tile)
    tile, part = lane // per_tile, lane % per_tile
    origin = ((tile % stride) * edge + (part % across) * bw, (tile // stride) * edge + (part // across) * bh)
    j0, j1 = dr.gather(UInt32, first, tile), dr.gather(UInt32, end, tile)
    start = j0 * per_tile + part * (j1 - j0)
    entries = dr.empty(UInt32, dr.width(tile_entries) * per_tile)
    log_min = log2(config.alpha_min)

    def visit(j, count, light, j1, start, px, py, tile_entries, tests, entries):
        rank = dr.gather(UInt32, tile_entries, j)
        mx, my, a, b, c, log2_opacity, slope_x, slope_y = fetch_record(tests, rank, 8)
        x0, y0 = px - mx, py - my
        x1, y1 = x0 + (bw - 1), y0 + (bh - 1)

        def power(x: Any, y: Any) -> Any:
            u, v = dr.fma(a, x, b * y), c * y
            return dr.fma(-u, u, dr.fma(-v, v, log2_opacity))

        # Over a box, a concave quadratic is largest at the clamped centre or on the two nearest edges.
        x, y = dr.clip(0, x0, x1), dr.clip(0, y0, y1)
        highest = dr.maximum(power(x, dr.clip(slope_y * x, y0, y1)), power(dr.clip(slope_x * y, x0, x1), y))
        touches = highest >= log_min - _TEST_SLACK
        dr.scatter(entries, rank, start + count, active=touches, mode=dr.ReduceMode.NoConflicts)

        # It is smallest at a corner: a lower bound of alpha, hence an upper bound of what light remains.
        lowest = dr.minimum(dr.minimum(power(x0, y0), power(x1, y0)), dr.minimum(power(x0, y1), power(x1, y1)))
        alpha = dr.select(lowest >= log_min, dr.minimum(dr.exp2(lowest), config.alpha_max), 0)
        count = count + dr.select(touches, UInt32(1), UInt32(0))
        return j + 1, count, light * (1 - alpha), j1, start, px, py, tile_entries, tests, entries

    def unfinished(j, count, light, j1, *_):
        return (j < j1) & (light >= config.stop_transmittance)

    inside = (origin[0] < size[0]) & (origin[1] < size[1])
    px, py = mi.Float(origin[0]) + 0.5, mi.Float(origin[1]) + 0.5
    state = (
        dr.select(inside, j0, j1),
        UInt32(0),
        mi.Float(1),
        j1,
        start,
        px,
        py,
        tile_entries,
        tests,
        entries,
    )
    _, count, *_, entries = dr.while_loop(state, unfinished, visit, label="block lists")
    dr.eval(entries, start, count, origin)
    return entries, start, count, origin
