"""The blocks of pixels that are drawn: all of a view's, or those that matter.

A block is `block_width` x `block_height` pixels and belongs to one SIMD lane; a tile is 4 x 8 blocks. A whole view's
picture is stored row after row, padded to whole blocks on the right; a part's, block after block.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from morgs_mi.render.config import RenderConfig

__all__ = ["ACROSS", "DOWN", "NO_SLOT", "Region", "full_view", "owned_copy", "quotient"]

# Blocks of a tile, across and down: as many as a word has bits.
ACROSS, DOWN = 4, 8
# In `Region.slot_of`: the tile has no block that is drawn.
NO_SLOT = 0xFFFFFFFF


class Region:
    """The blocks of a view that hold at least one of the pixels asked for.

    Pictures on a region are [A, block_height, block_width, C], block after block, A blocks in all.

    Args:
        mask: [H, W] bool, the pixels asked for.
        config: block shape.

    Attributes:
        width: of the view in pixels.
        height: of the view in pixels.
        block: (width, height) of a block in pixels.
        num_blocks: A.
        whole: whether pictures are [H, W, C] instead, for a region made by `full_view`.

    Raises:
        ValueError: no pixel is asked for, or `mask` is not a picture of booleans.
    """

    def __init__(self, mask: np.ndarray, config: RenderConfig | None = None) -> None:
        if mask.ndim != 2 or mask.dtype != bool or not mask.any():
            found = f"{mask.dtype} {mask.shape}" if mask.ndim != 2 or mask.dtype != bool else "none"
            raise ValueError(
                f"Region(): `mask` must be bool [H, W] with at least one pixel set, got {found}; "
                "leave a view out where nothing is to be drawn."
            )
        self._build(mask, config or RenderConfig(), whole=False)

    home: Any
    part: Any
    x: Any
    y: Any
    place: Any
    pitch: Any
    rows: Any
    grid: Any
    slot_of: Any
    block_table: Any
    tile_table: Any

    def _build(self, mask: np.ndarray, config: RenderConfig, whole: bool) -> None:
        H, W = mask.shape
        bw, bh = config.block_shape(dr.backend_v(mi.Float) == dr.JitBackend.CUDA)
        self.width, self.height, self.block, self.whole = W, H, (bw, bh), whole
        self.across, self.down = -(-W // (ACROSS * bw)), -(-H // (DOWN * bh))
        padded = np.zeros((self.down * DOWN * bh, self.across * ACROSS * bw), bool)
        padded[:H, :W] = mask
        blocks = padded.reshape(self.down * DOWN, bh, self.across * ACROSS, bw).any((1, 3))
        active = blocks.reshape(self.down, DOWN, self.across, ACROSS).transpose(0, 2, 1, 3)
        active = active.reshape(-1, ACROSS * DOWN)  # [tiles, blocks of a tile]
        tiles = np.flatnonzero(active.any(1))
        home, part = np.nonzero(active[tiles])
        x = (tiles[home] % self.across * ACROSS + part % ACROSS) * bw
        y = (tiles[home] // self.across * DOWN + part // ACROSS) * bh
        slot_of = np.full(len(active), NO_SLOT, np.uint32)
        slot_of[tiles] = np.arange(len(tiles))
        pitch = -(-W // bw) * bw if whole else bw
        place = y * pitch + x if whole else np.arange(len(x)) * (bw * bh)

        self.num_blocks, self.num_tiles = len(x), len(tiles)
        self.row, self.num_pixels = pitch, pitch * H if whole else len(x) * bw * bh
        # Pixels are read and written in packets of 4 floats: places and pitch count by fours.
        arrays = {
            "home": home,
            "part": part,
            "x": x,
            "y": y,
            "place": place // 4,
            "pitch": [pitch // 4],
            "rows": np.minimum(H - y, bh) if whole else np.full(len(y), bh),
            "grid": [self.across, self.down],
            "slot_of": slot_of,
            "block_table": _summed_area(blocks),
            "tile_table": _summed_area(active.any(1).reshape(self.down, self.across)),
        }
        for name, values in arrays.items():
            setattr(self, name, owned_copy(mi.UInt32(np.asarray(values, np.uint32))))
        self.corner_x = owned_copy(mi.Float(np.float32(tiles % self.across * (ACROSS * bw))))
        self.corner_y = owned_copy(mi.Float(np.float32(tiles // self.across * (DOWN * bh))))
        inside = None if whole else self.inside()
        self.weights = None if inside is None or inside.all() else owned_copy(mi.Float(np.float32(inside).ravel()))

    def shape(self, channels: int) -> tuple[int, ...]:
        """Return the shape of a picture on this region."""
        if self.whole:
            return self.height, self.width, channels
        return self.num_blocks, self.block[1], self.block[0], channels

    def pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the column and row of every pixel on this region, two int arrays [A, block_height, block_width].

        A view that is no multiple of the block has blocks that stick out: there pixels lie outside.
        """
        i, j = np.arange(self.block[0]), np.arange(self.block[1])[:, None]
        x, y = (np.asarray(v).astype(np.int64)[:, None, None] for v in (self.x, self.y))
        return np.broadcast_arrays(x + i, y + j)  # type: ignore[return-value]

    def inside(self) -> np.ndarray:
        """Return which pixels on this region lie in the view, bool [A, block_height, block_width]."""
        x, y = self.pixels()
        return (x < self.width) & (y < self.height)

    def crop(self, picture: np.ndarray) -> np.ndarray:
        """Return what a picture [H, W, ...] shows on this region [A, block_height, block_width, ...], 0 outside."""
        x, y = self.pixels()
        inside = (x < self.width) & (y < self.height)
        values = picture[np.minimum(y, self.height - 1), np.minimum(x, self.width - 1)]
        return np.where(inside.reshape(inside.shape + (1,) * (picture.ndim - 2)), values, 0)

    def paste(self, values: np.ndarray, picture: np.ndarray) -> np.ndarray:
        """Return a copy of a picture [H, W, ...] with this region's pixels replaced by `values`."""
        (x, y), inside = self.pixels(), self.inside()
        picture = picture.copy()
        picture[y[inside], x[inside]] = values[inside]
        return picture


def _summed_area(grid: np.ndarray) -> np.ndarray:
    """Return how many cells are set to the left of and above every corner of a grid [R, C], flat [(R + 1) (C + 1)]."""
    return np.pad(grid, ((1, 0), (1, 0))).cumsum(0).cumsum(1).ravel()


def owned_copy(values: Any) -> Any:
    """Return a copy in memory of Dr.Jit's own, evaluated.

    It borrows NumPy's memory where it can. Packets cannot be read from there unless it happens to be aligned, and
    kernels would be compiled for both cases; a gather does not care. The opaque 0 keeps it from being optimised away.
    """
    copy = dr.gather(type(values), values, dr.arange(mi.UInt32, dr.width(values)) + dr.opaque(mi.UInt32, 0))
    dr.eval(copy)
    return copy


def quotient(lane: Any, divisor: int) -> Any:
    """Return lane // divisor, of which no kernel knows: half a step is more than what a double rounds away."""
    return mi.UInt32((mi.Float64(lane) + 0.5) * dr.opaque(mi.Float64, 1 / divisor))


def full_view(width: int, height: int, config: RenderConfig) -> Region:
    """Return all blocks of a view, whose pictures are plain images [H, W, C]."""
    return _whole_view(width, height, config.block_shape(dr.backend_v(mi.Float) == dr.JitBackend.CUDA), mi.variant())


@lru_cache(maxsize=8)
def _whole_view(width: int, height: int, block: tuple[int, int], variant: str) -> Region:
    region = Region.__new__(Region)
    config = RenderConfig(block_width=block[0], block_height=block[1])
    region._build(np.ones((height, width), bool), config, whole=True)
    return region
