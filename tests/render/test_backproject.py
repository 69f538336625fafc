"""Back-projection against blending, of which it is the transpose."""

from __future__ import annotations

import numpy as np
import pytest

from morgs_mi import rasterize
from morgs_mi.render.backproject import backproject
from tests import tolerances as tol
from tests.assertions import assert_close
from tests.scenes.cameras import make_camera
from tests.scenes.gaussians import as_float32, make_scene, to_gaussians


def test_backproject__is_the_transpose_of_blending():
    """<image, sum_i w_i c_i> = sum_i c_i <image, w_i> for the confidence channel, which is plain blending."""
    raw, camera = as_float32(make_scene()), make_camera()
    gaussians = to_gaussians(raw)
    image = np.random.default_rng(0).normal(size=(camera.height, camera.width, 1)).astype(np.float32)
    sums = backproject(gaussians, camera, image)
    blended = np.asarray(rasterize(gaussians, camera, ("confidence",)).confidence, np.float64)
    confidence = 1 / (1 + np.exp(-raw["logit_confidence"]))
    assert np.vdot(sums[:, 0], confidence) == pytest.approx(np.vdot(blended, image), rel=tol.DUALITY_REL)


def test_backproject__of_ones_sums_to_alpha():
    raw, camera = as_float32(make_scene()), make_camera()
    ones = np.ones((camera.height, camera.width, 3), np.float32)
    sums = backproject(to_gaussians(raw), camera, ones)
    alpha = np.asarray(rasterize(to_gaussians(raw), camera, ("alpha",)).alpha, np.float64)
    assert_close(sums.sum(0), np.full(3, alpha.sum()), rtol=tol.DUALITY_REL)


def test_backproject__refuses_an_image_of_another_size():
    with pytest.raises(ValueError, match=r"`image` must be \[18, 21, C\] with C > 0, got \[4, 5, 1\]"):
        backproject(to_gaussians(make_scene()), make_camera(), np.zeros((4, 5, 1), np.float32))
