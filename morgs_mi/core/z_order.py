"""Z-order curve through points: neighbours on the curve are neighbours in space."""

from __future__ import annotations

import numpy as np

_CELL_BITS = 10


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
