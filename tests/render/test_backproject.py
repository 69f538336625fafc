"""The transpose of blending against blending itself."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi import rasterize
from morgs_mi.render.backproject import backproject
from tests import tolerances as tol
from tests.render.test_rasterize import as_float32, make_camera, make_scene, to_gaussians


def test_backprojection_is_the_transpose_of_blending():
    """<picture, sum_i w_i c_i> = sum_i c_i <picture, w_i> for the confidence channel, which blends plainly."""
    raw, camera = as_float32(make_scene()), make_camera()
    gaussians = to_gaussians(raw)
    picture = np.random.default_rng(0).normal(size=(camera.height, camera.width, 1)).astype(np.float32)
    sums = backproject(gaussians, camera, picture)
    blended = np.asarray(rasterize(gaussians, camera, ("confidence",)).confidence, np.float64)
    confidence = 1 / (1 + np.exp(-raw["logit_confidence"]))
    assert np.vdot(sums[:, 0], confidence) == pytest.approx(np.vdot(blended, picture), rel=tol.DUALITY_REL)


def test_weights_sum_to_alpha():
    raw, camera = as_float32(make_scene()), make_camera()
    ones = np.ones((camera.height, camera.width, 3), np.float32)
    sums = backproject(to_gaussians(raw), camera, ones)
    alpha = np.asarray(rasterize(to_gaussians(raw), camera, ("alpha",)).alpha, np.float64)
    assert sums.sum(0) == pytest.approx(np.full(3, alpha.sum()), rel=tol.DUALITY_REL)


def test_picture_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"`picture` must be \[18, 21, 1\], got \[4, 5, 1\]"):
        backproject(to_gaussians(make_scene()), make_camera(), np.zeros((4, 5, 1), np.float32))
