"""The Gaussians of a stream in an order that lasts, along a Z-order curve: neighbours on the curve
are neighbours in space.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from morgs_mi.codec.frame_source import FrameSource
from morgs_mi.core.gaussians import Gaussians

_CELL_BITS = 10


def by_place(stream: FrameSource) -> Iterator[tuple[int, Gaussians]]:
    """Yield (frame, Gaussians) like `play`, with the Gaussians along a Z-order curve of the places
    of their births.

    Neighbours on the curve are neighbours in space and mostly move together. As the place of the
    birth does not change, Gaussians that live in two frames have the same order in both.

    Raises:
        ValueError: a broken packet.
    """
    all_ids = np.zeros(0, np.int64)
    all_keys = np.zeros(0, np.int64)
    cells = None
    for state in stream.states():
        ids = state.lasting_ids
        means = state.gaussians.numpy()["means"]
        if len(ids) and (cells is None or not np.isin(ids, all_ids).any()):
            cells = equal_cells(means)
        births = ~np.isin(ids, all_ids)
        if cells is not None and births.any():
            all_ids = np.concatenate([all_ids, ids[births]])
            all_keys = np.concatenate([all_keys, z_order(means[births], cells)])
        keys = all_keys[np.searchsorted(all_ids, ids)]
        yield state.frame, state.gaussians.select(np.argsort(keys, kind="stable"))


def equal_cells(points: np.ndarray) -> np.ndarray:
    """Return the inner bounds [1023, 3] of cells with equal numbers of points [N, 3] along each
    axis.

    Unlike cells of equal size, they are not widened by far points.
    """
    return np.quantile(points, np.linspace(0, 1, 2**_CELL_BITS + 1)[1:-1], axis=0)


def z_order(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the places int64 [N] of points [N, 3] on a Z-order curve through a grid with the inner
    bounds `cells`.
    """
    keys = np.zeros(len(points), np.int64)
    for axis in range(3):
        index = np.searchsorted(cells[:, axis], points[:, axis])
        for bit in range(_CELL_BITS):
            keys |= (index >> bit & 1) << (3 * bit + axis)
    return keys
