"""Cropping."""

from __future__ import annotations

import numpy as np

from morgs_mi.viewer.crop import box_edges, crop_limits, is_shown
from tests.assertions import assert_close
from tests.scenes.changing_splats import splats

EVERYWHERE = np.array([[-np.inf] * 3, [np.inf] * 3])


def test_is_shown__needs_the_opacity_and_a_mean_in_the_box():
    gaussians = splats(200)
    means, opacities = gaussians.numpy()["means"], np.asarray(gaussians.opacities)
    assert is_shown(gaussians, 0, EVERYWHERE).all()
    np.testing.assert_array_equal(is_shown(gaussians, 0.6, EVERYWHERE), opacities >= 0.6)
    box = EVERYWHERE.copy()
    box[:, 1] = -0.2, 0.3
    inside = (means[:, 1] >= -0.2) & (means[:, 1] <= 0.3)
    np.testing.assert_array_equal(is_shown(gaussians, 0.6, box), inside & (opacities >= 0.6))


def test_crop_limits__are_round_and_ignore_far_gaussians():
    means = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * [1, 20, 0] + [0, 5, 3]
    means[0] = 1e6
    limits, steps = crop_limits(means)
    assert_close(steps, np.array([0.01, 0.1, 1e-8]), rtol=1e-6)
    assert (limits[0] <= np.quantile(means, 0.01, axis=0)).all()
    assert (limits[1] > np.quantile(means, 0.99, axis=0)).all()
    assert_close(np.abs(limits[:, :2]), np.array([[1, 15], [1, 25]]), atol=0.6)


def test_box_edges__connect_neighbouring_corners():
    edges = box_edges(np.array([[0, 0, 0], [1, 2, 3]]))
    lengths = np.abs(edges[:, 0] - edges[:, 1])
    assert sorted(lengths.sum(axis=1)) == [1] * 4 + [2] * 4 + [3] * 4
    assert len({tuple(corner) for corner in edges.reshape(-1, 3)}) == 8
