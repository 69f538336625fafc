"""The orbit of the turntable."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi.viewer.turntable import Axis
from tests.assertions import assert_close


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -2, 0), (1, 1, 0.5)])
def test_axis__orbits_at_the_same_height_and_distance(up):
    center, position = np.array([1.0, 2, 3]), np.array([4.0, -1, 5])
    axis, direction = Axis(center, np.array(up)), np.array(up) / np.linalg.norm(up)
    start = axis.azimuth(position)
    assert_close(axis.at(position, start), position, atol=1e-12)
    for turn in np.linspace(0, 2 * np.pi, 7):
        there = axis.at(position, start + turn)
        assert_close((there - center) @ direction, (position - center) @ direction, atol=1e-12)
        assert_close(np.linalg.norm(there - center), np.linalg.norm(position - center), atol=1e-12)
        assert_close(np.cos(axis.azimuth(there)), np.cos(start + turn), atol=1e-12)
    quarter = axis.at(position, start + np.pi / 2) - center
    assert np.cross(position - center, quarter) @ direction > 0, "counter-clockwise seen from above"
