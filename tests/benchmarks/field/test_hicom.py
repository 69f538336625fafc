"""Hierarchical coherent motion: cells, and motions that they can express."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from benchmarks.field.hicom import HicomConfig, cell_matrix, coherent_motion
from tests.assertions import assert_close
from tests.scenes.gaussians import make_wide_scene, to_gaussians


def test_cell_matrix__has_one_cell_of_each_level_for_every_point():
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    cells = cell_matrix(points, [1.0, 0.25])
    assert (cells.sum(axis=1) == 2).all()
    assert (cells.sum(axis=0) > 0).all()  # no cell is empty
    near = np.abs(points[:, None] - points[None]).max(axis=2)
    shared = (cells @ cells.T).toarray()
    assert near[shared == 2].max() < 0.25
    assert near[shared == 1].max() < 1.0


def test_coherent_motion__sums_the_levels():
    gaussians = to_gaussians(make_wide_scene())
    model = coherent_motion(gaussians, 3.0, HicomConfig(cells=(10.0, 0.1)))
    translation = np.zeros(tuple(model.parameters["translation"].shape), np.float32)
    translation[0] = (1, 2, 3)  # of the one cell of the coarse level
    translation[1] = (0.5, 0, 0)
    translations, rotation = model.motion(
        {**model.parameters, "translation": mi.TensorXf(translation)}
    )
    fine = np.asarray(translations) - (1, 2, 3)
    mask = fine.any(axis=1)
    assert 0 < mask.sum() < len(gaussians)
    assert_close(fine[mask], np.tile(np.array([0.5, 0, 0]), (mask.sum(), 1)), atol=1e-6)
    assert not np.asarray(rotation).any()
