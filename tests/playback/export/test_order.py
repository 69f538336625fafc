"""The order of the Gaussians of a compressed file."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.playback.export.clips import in_z_order
from tests.scenes.changing_splats import splats


@pytest.mark.parametrize("far", [0.0, 1e6])
def test_in_z_order__puts_neighbours_side_by_side(far):
    means = splats(2000).numpy()["means"]
    means[0] += far
    ordered = in_z_order(replace(splats(2000), means=means)).numpy()["means"]
    assert_array_equal(np.sort(ordered, axis=0), np.sort(means, axis=0))
    steps = np.linalg.norm(np.diff(ordered, axis=0), axis=1)
    # Random pairs in this box are 1.06 apart.
    assert np.median(steps) < 0.25


def test_in_z_order__returns_no_gaussians_as_they_are():
    assert len(in_z_order(splats(0))) == 0
