"""Regions: the blocks of pixels that are drawn, all or some of the blocks of a view.

A block is `block_width` x `block_height` pixels and belongs to one SIMD lane; a tile is 4 x 8
blocks. An image of a whole view is stored row by row, padded to whole blocks on the right; an image
of a region, block by block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.lib.stride_tricks import as_strided

from morgs_mi.core.arrays import from_numpy, opaque
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import repeat_each
from morgs_mi.core.types import Float, Jit, Point2u, UInt32
from morgs_mi.render.backend import block_shape, elements, sections
from morgs_mi.render.render_config import RenderConfig

# Blocks of a tile, across and down: one for each bit of a word.
ACROSS = 4
DOWN = 8
# In `Region.slot_of`: no block of the tile is drawn.
NO_SLOT = 0xFFFFFFFF


@dataclass(frozen=True)
class BlockGrid:
    """All blocks of a view, in rows and columns that are padded to whole tiles."""

    width: int  #: Width of the view in pixels.
    height: int  #: Height of the view in pixels.
    block: tuple[int, int]  #: (width, height) of a block in pixels.

    def __str__(self) -> str:
        across, down = self.block
        return f"a {self.width}x{self.height} view with {across}x{down} blocks"

    @classmethod
    def of(cls, camera: Camera, config: RenderConfig) -> BlockGrid:
        """Return the blocks of a camera's view."""
        return cls(camera.width, camera.height, block_shape(config))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the view in pixels."""
        return self.width, self.height

    @property
    def tiles(self) -> tuple[int, int]:
        """Number of tiles across and down."""
        return -(-self.width // (ACROSS * self.block[0])), -(-self.height // (DOWN * self.block[1]))

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns of blocks."""
        across, down = self.tiles
        return down * DOWN, across * ACROSS

    def counts(self, mask: np.ndarray) -> np.ndarray:
        """Return the number of pixels of a mask [H, W] in each block, int32 [rows, columns]."""
        rows, columns = self.shape
        width, height = self.block
        pixels = np.zeros((rows * height, columns * width), np.float32)
        pixels[: self.height, : self.width] = mask
        shares = cv2.resize(pixels, (columns, rows), interpolation=cv2.INTER_AREA)
        return np.rint(shares * (width * height)).astype(np.int32)


class DrawnBlocks:
    """Blocks of pixels that are drawn, as arrays: a `Region`, or a `PaddedRegion` of fixed sizes.

    Images on them are [A, block_height, block_width, C], block by block, A blocks in all, or
    [H, W, C] if they are a `whole` view.

    Args:
        grid: all blocks of a view.
        num_blocks: number of those that are drawn.
        whole: whether they are a whole view.
        views: number of views, one below the other.
    """

    # Per block: slot of its tile, its bit there, its first pixel (x, y), that pixel's packet in
    # memory, its rows.
    tile: UInt32
    bit: UInt32
    x: UInt32
    y: UInt32
    place: UInt32
    rows: UInt32
    pitch: UInt32  # packets from a row of a block to the next, [1]
    slot_of: UInt32  # slot of every tile of the view, or NO_SLOT
    tile_table: UInt32  # summed areas of the tiles that have a drawn block
    # Per slot: first pixel of the tile.
    corner_x: Float
    corner_y: Float
    weights: Float | None  # per pixel: 1 in the view, 0 outside; None: all pixels are in the view
    num_tiles: int
    #: Entries of the lists, see `PaddedRegion`; None: as many as needed, which stops the queue.
    capacity: int | None = None

    def __init__(self, grid: BlockGrid, num_blocks: int, whole: bool, views: int = 1) -> None:
        block_width, block_height = grid.block
        self.grid = grid
        self.width = grid.width
        self.height = views * grid.height
        self.block = grid.block
        self.across, self.down = grid.tiles
        self.whole = whole
        self.num_blocks = num_blocks
        self.row = -(-grid.width // block_width) * block_width if whole else block_width
        self.num_pixels = self.row * (self.height if whole else num_blocks * block_height)

    def shape(self, channels: int) -> tuple[int, ...]:
        """Return the shape of an image with `channels` floats per pixel on these blocks."""
        if self.whole:
            return self.height, self.width, channels
        return self.num_blocks, self.block[1], self.block[0], channels

    def within_view(self, image: Float, channels: int) -> Float:
        """Return a flat image of `channels` floats per pixel with zeros outside the view."""
        return image if self.weights is None else image * repeat_each(self.weights, channels)

    @property
    def section_sizes(self) -> tuple[UInt32, UInt32]:
        """Number of blocks, and of those in each section of a launch (see `backend.sections`)."""
        *_, lanes = sections(self.num_blocks)
        return opaque(mi.UInt32, self.num_blocks), opaque(mi.UInt32, lanes)

    @property
    def size(self) -> Point2u:
        """Width and height of the view in pixels."""
        return mi.Point2u(opaque(mi.UInt32, self.width), opaque(mi.UInt32, self.height))

    def pixels(self, lane: UInt32) -> Point2u:
        """Return the pixels of the view at some places of an image."""
        if self.whole:
            y, x = quotient_and_rest(lane, self.row)
            return mi.Point2u(x, y)
        width, height = self.block
        index = lane // (width * height)
        within = lane - index * (width * height)
        first = mi.Point2u(elements(self.x, index), elements(self.y, index))
        return first + mi.Point2u(within % width, within // width)


class Region(DrawnBlocks):
    """Some blocks of a view, or of several views.

    Args:
        grid: all blocks of a view.
        blocks: the requested ones, at least one, bool [rows, columns], of all views.
        whole: whether images are [H, W, C]; all blocks must be requested.
        views: number of views, one below the other; a second one begins after the rows of tiles of
            a grid.
        valid: mask of an image's pixels that are in a view; None: those of equal views.

    Attributes:
        grid: all blocks of the view.
        drawn: which of them the region has, bool [rows, columns].
        width: width of the view in pixels.
        height: height of the view in pixels.
        block: (width, height) of a block in pixels.
        num_blocks: number of blocks A.
        whole: whether images are [H, W, C] instead, for a region made by `full_view`.
        host: the arrays below in NumPy's memory.
    """

    block_table: UInt32  # summed areas of the drawn blocks
    _blocks: tuple[np.ndarray, np.ndarray]  # per block: its row and column in the grid

    def __init__(
        self,
        grid: BlockGrid,
        blocks: np.ndarray,
        whole: bool = False,
        views: int = 1,
        valid: np.ndarray | None = None,
    ) -> None:
        super().__init__(grid, int(np.count_nonzero(blocks)), whole, views)
        bw, bh = grid.block
        active = blocks.reshape(-1, DOWN, self.across, ACROSS).transpose(0, 2, 1, 3)
        active = active.reshape(-1, ACROSS * DOWN)
        tiles = np.flatnonzero(active.any(1))
        tile, bit = np.nonzero(active[tiles])
        row = tiles[tile] // self.across * DOWN + bit // ACROSS
        column = tiles[tile] % self.across * ACROSS + bit % ACROSS
        slots = np.full(len(active), NO_SLOT, np.uint32)
        slots[tiles] = np.arange(len(tiles))
        self.drawn = blocks
        self._blocks = (row, column)
        self.num_tiles = len(tiles)
        view, row_in_view = np.divmod(row, self.down * DOWN)
        x = column * bw
        y = row_in_view * bh
        if self.whole:
            H = self.grid.height
            place = (view * H + y) * self.row + x
            rows = np.minimum(H - y, bh)
        else:
            place = np.arange(len(x)) * (bw * bh)
            rows = np.full(len(y), bh)
        self.host = {
            "tile": tile,
            "bit": bit,
            "x": x,
            "y": y,
            # Pixels are read and written in packets of 4 floats: place and pitch count packets.
            "place": place // 4,
            "pitch": np.array([self.row // 4]),
            "rows": rows,
            "slot_of": slots,
            "block_table": summed_area(blocks),
            "tile_table": summed_area(active.any(1).reshape(-1, self.across)),
        }
        self.host["corner_x"] = np.float32(tiles % self.across * (ACROSS * bw))
        self.host["corner_y"] = np.float32(tiles // self.across % self.down * (DOWN * bh))
        if valid is None:
            valid = np.ones((), bool) if whole else self.inside
        self.weights = None if valid.all() else from_numpy(mi.Float, valid)

    def __getattr__(self, name: str) -> Jit:
        """Return an array, which is uploaded when it is first read: most of them are not, because
        many regions are only compared, joined or cropped.
        """
        values = self.__dict__.get("host", {}).get(name)
        if values is None:
            raise AttributeError(f"Region has no attribute {name!r}.")
        kind = mi.Float if values.dtype == np.float32 else mi.UInt32
        setattr(self, name, array := from_numpy(kind, values))
        return array

    @classmethod
    def of(cls, mask: np.ndarray, config: RenderConfig | None = None) -> Region:
        """Return the region of the blocks that contain a pixel of a mask [H, W], at least one."""
        grid = BlockGrid(mask.shape[1], mask.shape[0], block_shape(config or RenderConfig()))
        return cls(grid, grid.counts(mask) > 0)

    @property
    def mask(self) -> np.ndarray:
        """The drawn pixels, bool [H, W]."""
        width, height = self.block
        return self.drawn.repeat(height, axis=0).repeat(width, axis=1)[: self.height, : self.width]

    @property
    def inside(self) -> np.ndarray:
        """Mask of the pixels of the blocks that lie in the view, bool [A, block_height,
        block_width].
        """
        width, height = self.block
        row, column = self._blocks
        rows = height * row[:, None] + np.arange(height) < self.height
        columns = width * column[:, None] + np.arange(width) < self.width
        return rows[:, :, None] & columns[:, None]

    def crop(self, image: np.ndarray) -> np.ndarray:
        """Return this region's pixels [A, block_height, block_width, ...] of an image [H, W, ...],
        0 outside it.
        """
        assert image.shape[:2] == (self.height, self.width)  # others would be read beyond their end
        row, column = self._blocks
        width, height = self.block
        # The blocks that lie in the image as a whole, [rows, height, columns, width, ...]. A view:
        # a copy of large images would take most of the time.
        down, across, *rest = image.strides
        blocks = as_strided(
            image,
            (self.height // height, height, self.width // width, width, *image.shape[2:]),
            (height * down, down, width * across, across, *rest),
        )
        is_whole = (row < blocks.shape[0]) & (column < blocks.shape[2])
        if is_whole.all():
            return blocks[row, :, column]
        pixels = np.zeros((len(row), height, width, *image.shape[2:]), image.dtype)
        pixels[is_whole] = blocks[row[is_whole], :, column[is_whole]]
        for k in np.flatnonzero(~is_whole):
            y = row[k] * height
            x = column[k] * width
            part = image[y : y + height, x : x + width]
            pixels[k, : part.shape[0], : part.shape[1]] = part
        return pixels

    def uncropped(self, values: np.ndarray) -> np.ndarray:
        """Return an image in whole blocks from this region's values [A, height, width, ...], 0 in
        all other blocks.
        """
        row, column = self._blocks
        (_, height, width, *rest) = values.shape
        rows, columns = self.drawn.shape
        blocks = np.zeros((rows, height, columns, width, *rest), values.dtype)
        blocks[row, :, column] = values
        return blocks.reshape(rows * height, columns * width, *rest)


def joined(regions: Sequence[Region]) -> Region:
    """Return the blocks of regions of several views as one region, of the views one below the
    other.

    Its images are the regions' images, one after the other. Blocks keep the pixel coordinates of
    their view.
    """
    blocks = stacked([part.drawn for part in regions])
    views, rows, columns = blocks.shape
    bw, bh = regions[0].block
    grid = BlockGrid(columns * bw, rows * bh, (bw, bh))
    valid = np.concatenate([part.inside for part in regions])
    return Region(grid, blocks.reshape(-1, columns), views=views, valid=valid)


def stacked(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Return arrays [rows, columns] as one [V, rows, columns], with zeros after the smaller
    ones.
    """
    shape = np.max([array.shape for array in arrays], axis=0)
    result = np.zeros((len(arrays), *shape), arrays[0].dtype)
    for k, array in enumerate(arrays):
        rows, columns = array.shape
        result[k, :rows, :columns] = array
    return result


def summed_area(grid: np.ndarray) -> np.ndarray:
    """Return the number of set cells left of and above every corner of a grid [R, C], flat
    [(R + 1) (C + 1)].
    """
    return np.asarray(cv2.integral(grid.astype(np.uint8))).ravel()


def quotient(lane: UInt32, divisor: int) -> UInt32:
    """Return lane // divisor without the divisor as a literal in the kernel.

    Adding half a step before the product rounds down correctly: it exceeds the rounding error of a
    double.
    """
    return mi.UInt32((mi.Float64(lane) + 0.5) * opaque(mi.Float64, 1 / divisor))


def quotient_and_rest(lane: UInt32, divisor: int) -> tuple[UInt32, UInt32]:
    """Return lane // divisor and lane % divisor, likewise."""
    whole = quotient(lane, divisor)
    return whole, lane - whole * opaque(mi.UInt32, divisor)


def on_region(values: Float, region: DrawnBlocks) -> Float:
    """Return an image [H W] of one float per pixel on the region, 0 outside the view."""
    pixel = region.pixels(dr.arange(mi.UInt32, region.num_pixels))
    size = region.size
    place = pixel.y * size.x + pixel.x
    image = dr.gather(mi.Float, values, place, active=dr.all(pixel < size))
    dr.eval(image)
    return image


@lru_cache(maxsize=8)
def full_view(
    width: int, height: int, block: tuple[int, int], views: int, variant: str | None
) -> Region:
    """Return the region of all blocks of equal views, one below the other; its images are
    [views * H, W, C].

    Args:
        width: width of a view in pixels.
        height: height of a view in pixels.
        block: (width, height) of a block in pixels.
        views: number of views.
        variant: the active one.
    """
    grid = BlockGrid(width, height, block)
    blocks = grid.counts(np.ones((height, width), bool)) > 0
    return Region(grid, np.tile(blocks, (views, 1)), True, views)
