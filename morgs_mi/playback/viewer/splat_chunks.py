"""Gaussians on the page in chunks: only chunks with changes are sent again.

viser sends the whole buffer of a splat object, but it sorts and blends the Gaussians of all objects together. So the
Gaussians are distributed over the rows of several objects, the chunks, and a frame sends the chunks that differ. A
Gaussian keeps its row as long as it is shown. Neighbours share a chunk, because neighbours move together.

The page shows one large chunk sooner than many small ones, so there is only one until some Gaussians change.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from morgs_mi.core.z_order import equal_cells, z_order

__all__ = ["SplatChunks", "packed_splats"]

# Chunks, and the fewest and most rows of one: small ones fit the changes more closely, many take the page longer.
_CHUNKS, _LEAST_ROWS, _MOST_ROWS = 64, 64, 4096
# Share of the rows that are free for Gaussians that are born.
_SPARE = 1 / 16
_FREE = -1
# Share of the rows above which a change is due to a mode or a view, not to motion.
_NEARLY_ALL = 0.75
# Upper triangle of a covariance.
_UPPER = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
# Variance of the transparent Gaussians in free rows: small, to cover few pixels.
_TINY = 1e-4


def packed_splats(
    centers: np.ndarray, covariances: np.ndarray, colors: np.ndarray, opacities: np.ndarray
) -> np.ndarray:
    """Return Gaussians as in viser's buffers, uint32 [N, 8].

    Args:
        centers: [N, 3].
        covariances: [N, 3, 3], stored in half precision.
        colors: uint8 [N, 3].
        opacities: [N].
    """
    rows = np.zeros((len(centers), 8), np.uint32)
    rows[:, :3] = np.ascontiguousarray(centers, np.float32).view(np.uint32)
    rows[:, 4:7] = np.ascontiguousarray(covariances[:, *_UPPER], np.float16).view(np.uint32)
    alpha = np.clip(255 * opacities[:, None], 0, 255).astype(np.uint8)
    rows[:, 7:] = np.concatenate([colors, alpha], axis=1).view(np.uint32)
    return rows


class SplatChunks:
    """The Gaussians of a page.

    The first change of some Gaussians distributes all over several chunks. Where later changes are scattered over them,
    Gaussians are distributed again, in the order of how often they have changed. That sends all of them once, so it
    waits until as many rows have been sent in vain.

    Args:
        scene: viser's `SceneApi`.
    """

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self._chunks: list[Any] = []
        self._ids = np.zeros(0, np.int64)  # of the Gaussian in each row
        self._empty = np.zeros(8, np.uint32)  # a free row
        self._shown = np.zeros((0, 8), np.uint32)
        self._changes = np.zeros(0, np.int64)  # how often the Gaussian in each row has changed
        self._sent_in_vain = 0
        self._is_whole = True  # whether all are in one chunk

    def show(self, ids: np.ndarray, splats: np.ndarray) -> None:
        """Show Gaussians, and no others.

        Args:
            ids: their numbers [N], which are unique.
            splats: their rows [N, 8] of `packed_splats`.
        """
        rows = self._rows_of(ids)
        if rows is None or self._sent_in_vain > len(ids):
            rows = self._distribute(ids, splats)
        buffer, changed = self._compared(rows, splats)
        if self._is_whole and 0 < changed.mean() < _NEARLY_ALL:
            self._changes += changed
            buffer, changed = self._compared(self._distribute(ids, splats), splats)
        self._shown = buffer
        per_chunk = len(buffer) // max(len(self._chunks), 1)
        sent = np.flatnonzero(changed.reshape(len(self._chunks), -1).any(axis=1))
        if changed.sum() < _NEARLY_ALL * len(buffer):
            self._changes += changed
        self._sent_in_vain += per_chunk * len(sent) - int(changed.sum())
        for index in sent:
            self._chunks[index].buffer = buffer[index * per_chunk : (index + 1) * per_chunk]

    def set_visible(self, visible: bool) -> None:
        """Show or hide the Gaussians."""
        for chunk in self._chunks:
            chunk.visible = visible

    def _compared(self, rows: np.ndarray, splats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the buffer with Gaussians in `rows` [N], and the mask of its rows that the page does not show."""
        buffer = np.tile(self._empty, (len(self._ids), 1))
        buffer[rows] = splats
        return buffer, (buffer != self._shown).any(axis=1)

    def _rows_of(self, ids: np.ndarray) -> np.ndarray | None:
        """Return the row [N] of each Gaussian, free ones for those without a row; None if there are too few."""
        if not len(self._ids):
            return None
        order = np.argsort(self._ids)
        at = np.searchsorted(self._ids, ids, sorter=order)
        rows = order[np.minimum(at, len(order) - 1)]
        known = self._ids[rows] == ids
        is_free = np.ones(len(self._ids), bool)
        is_free[rows[known]] = False
        free, born = np.flatnonzero(is_free), np.flatnonzero(~known)
        if len(born) > len(free):
            return None
        rows[born] = free[: len(born)]
        self._ids[is_free], self._changes[is_free] = _FREE, 0
        self._ids[rows] = ids
        return rows

    def _distribute(self, ids: np.ndarray, splats: np.ndarray) -> np.ndarray:
        """Distribute Gaussians over new rows, of one chunk at first, and return the row [N] of each."""
        self._is_whole = not self._chunks
        centers = np.ascontiguousarray(splats[:, :3]).view(np.float32)
        changes = np.zeros(len(ids), np.int64)
        _, here, before = np.intersect1d(ids, self._ids, return_indices=True)
        changes[here] = self._changes[before]
        rows, needed = np.arange(len(ids)), int(np.ceil(max(len(ids) * (1 + _SPARE), 1)))
        if len(ids) and not self._is_whole:
            rows[np.lexsort((z_order(centers, equal_cells(centers)), -changes))] = np.arange(len(ids))
        size = needed if self._is_whole else int(np.clip(len(ids) // _CHUNKS, _LEAST_ROWS, _MOST_ROWS))
        count = int(np.ceil(needed / size))
        self._ids = np.full(count * size, _FREE, np.int64)
        self._ids[rows] = ids
        self._shown = np.zeros((count * size, 8), np.uint32)  # differs from every row: all are sent
        self._changes, self._sent_in_vain = np.zeros(count * size, np.int64), 0
        self._changes[rows] = changes
        # Beside the others, as the page sorts by depths between the least and the largest.
        beside = centers[:1] if len(ids) else np.zeros((1, 3))
        self._empty = packed_splats(beside, _TINY * np.eye(3)[None], np.zeros((1, 3), np.uint8), np.zeros(1))[0]
        while len(self._chunks) > count:
            self._chunks.pop().remove()
        while len(self._chunks) < count:
            self._chunks.append(self._added(len(self._chunks)))
        return rows

    def _added(self, index: int) -> Any:
        """Return a new chunk with one transparent Gaussian, as viser's objects are not empty."""
        means, covariances, colors, opacities = (
            np.zeros((1, 3)),
            np.eye(3)[None],
            np.zeros((1, 3), np.uint8),
            np.zeros((1, 1)),
        )
        return self._scene.add_gaussian_splats(f"/splats/{index}", means, covariances, colors, opacities)
