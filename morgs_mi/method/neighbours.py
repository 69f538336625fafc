"""Nearest neighbours in space."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.spatial import KDTree


class NeighbourIndex:
    """Nearest neighbours among N points; the tree is built at the first query.

    Args:
        points: [N, 3].
    """

    def __init__(self, points: np.ndarray) -> None:
        self.points = np.asarray(points)
        self._of_all: dict[int, np.ndarray] = {}

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points)

    def nearest(self, count: int) -> np.ndarray:
        """Return the indices of the nearest other points of each point, [N, min(count, N - 1)], the
        nearest first.
        """
        if count not in self._of_all:
            self._of_all[count] = self.nearest_of(np.arange(len(self.points)), count)
        return self._of_all[count]

    def nearest_of(self, rows: np.ndarray, count: int) -> np.ndarray:
        """Return the same of the chosen points, int [M]: [M, min(count, N - 1)]."""
        count = min(count, len(self.points) - 1)
        _, near = self._tree.query(self.points[rows], count + 1, workers=-1)
        # The first is the point itself.
        return np.asarray(near).reshape(len(rows), count + 1)[:, 1:]
