"""Nearest neighbours: against all distances, for all points and for some."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.method.cohesion import NeighbourIndex

POINTS = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)


@pytest.mark.parametrize("count", [1, 8, 29, 100])
def test_nearest__are_the_nearest_others_in_order(count):
    distance = np.linalg.norm(POINTS[:, None].astype(float) - POINTS, axis=2)
    expected = np.argsort(distance, axis=1)[:, 1 : count + 1]
    index = NeighbourIndex(POINTS)
    assert_array_equal(index.nearest(count), expected)
    assert_array_equal(index.nearest(count, np.array([4, 2])), expected[[4, 2]])
