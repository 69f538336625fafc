"""The Gaussians of a stream in an order that lasts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from morgs_mi.codec.packets import frames_with_lasting_ids
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.gaussians import Gaussians

__all__ = ["by_place", "equal_cells", "z_order"]

_CELL_BITS = 10


def by_place(stream: StreamReader) -> Iterator[tuple[int, Gaussians]]:
    """Yield (frame, Gaussians) like `play`, with the Gaussians along a Z-order curve of the places of their births.

    Neighbours on the curve are neighbours in space and mostly move together. As the place of the birth does not change,
    Gaussians that live in two frames have the same order in both.

    Raises:
        ValueError: a broken packet.
    """
    known_ids, known_keys, cells = np.zeros(0, np.int64), np.zeros(0, np.int64), None
    for ids, coded in frames_with_lasting_ids(stream):
        means = coded.gaussians.numpy()["means"]
        if len(ids) and (cells is None or not np.isin(ids, known_ids).any()):
            cells = equal_cells(means)
        born = ~np.isin(ids, known_ids)
        if cells is not None and born.any():
            known_ids = np.concatenate([known_ids, ids[born]])
            known_keys = np.concatenate([known_keys, z_order(means[born], cells)])
        keys = known_keys[np.searchsorted(known_ids, ids)]
        yield coded.frame, coded.gaussians.select(np.argsort(keys, kind="stable"))


def equal_cells(points: np.ndarray) -> np.ndarray:
    """Return the inner bounds [1023, 3] of cells with equal numbers of points [N, 3] along each axis.

    Unlike cells of equal size, they are not widened by far points.
    """
    return np.quantile(points, np.linspace(0, 1, 2**_CELL_BITS + 1)[1:-1], axis=0)


def z_order(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the places int64 [N] of points [N, 3] on a Z-order curve through a grid with the inner bounds `cells`."""
    keys = np.zeros(len(points), np.int64)
    for axis in range(3):
        index = np.searchsorted(cells[:, axis], points[:, axis])
        for bit in range(_CELL_BITS):
            keys |= (index >> bit & 1) << (3 * bit + axis)
    return keys
