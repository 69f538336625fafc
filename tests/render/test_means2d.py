"""Gradients of projected means, signed and absolute."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import ActiveView, Camera, RenderConfig, render_view
from morgs_mi.render.region import Region
from morgs_mi.testing import assert_close
from tests.scenes.derivatives import backward
from tests.scenes.gaussians import make_scene, to_gaussians
from tests.tolerances import CENTRAL_DIFFERENCE_REL, GRADIENT_REL

W = 9
H = 6
CAMERA = Camera.look_at((0, 0, -4), (0, 0, 0), (0, -1, 0), 40, W, H)
WEIGHTS = np.random.default_rng(0).normal(size=(H, W, 3)).astype(np.float32)
VIEW = ActiveView(CAMERA, RenderConfig(alpha_min=1e-9, stop_transmittance=1e-9))
COUNT = 10


def gaussians():
    return to_gaussians(make_scene(n=COUNT))


def gradient(weights):
    """Return dL/d means2d [N, 4] for the loss <image, weights>."""
    probe = dr.zeros(mi.TensorXf, (COUNT, 4))
    dr.enable_grad(probe)
    image = render_view(gaussians(), VIEW, means2d=probe)
    backward(image.color * mi.TensorXf(weights))
    return np.array(dr.grad(probe))


def test_means2d__signed_gradient_agrees_with_central_differences():
    step = 1e-2  # px

    def loss(shift):
        probe = mi.TensorXf(shift.astype(np.float32))
        image = render_view(gaussians(), VIEW, means2d=probe)
        return np.sum(np.array(image.color, float) * WEIGHTS)

    differences = np.zeros((COUNT, 2))
    for i, axis in np.ndindex(differences.shape):
        shift = np.zeros((COUNT, 4))
        shift[i, axis] = step
        differences[i, axis] = (loss(shift) - loss(-shift)) / (2 * step)
    assert_close(gradient(WEIGHTS)[:, :2], differences, rtol=CENTRAL_DIFFERENCE_REL)


def test_means2d__absolute_gradient_is_the_sum_over_pixels():
    total = np.zeros((COUNT, 2))
    for pixel in np.ndindex(H, W):
        one = np.zeros_like(WEIGHTS)
        one[pixel] = WEIGHTS[pixel]
        total += np.abs(gradient(one)[:, :2])
    assert_close(gradient(WEIGHTS)[:, 2:], total, rtol=GRADIENT_REL)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"means2d": np.zeros((COUNT, 4))}, r"`means2d` must be a tensor of zeros \[10, 4\]"),
        (
            {"view": ActiveView(CAMERA, region=Region.of(np.ones((H, W), bool)))},
            "`region` must be None with `means2d`",
        ),
    ],
)
def test_means2d__refuses_what_it_cannot_do(options, words):
    options = {"view": ActiveView(CAMERA), "means2d": dr.zeros(mi.TensorXf, (COUNT, 4)), **options}
    with pytest.raises(ValueError, match=words):
        render_view(gaussians(), **options)
