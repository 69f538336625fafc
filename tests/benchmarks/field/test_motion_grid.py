"""Motion grid with its rate: interpolation, bits against float64, gradients, and what a heavy rate
does.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from benchmarks.field.motion_grid import GridConfig, bits, corner_matrix, motion_grid
from tests.assertions import assert_close
from tests.scenes.gaussians import make_wide_scene, to_gaussians

X = np.array([-9, -2.5, -0.6, 0, 0.3, 1, 4], np.float32)


def test_corner_matrix__reproduces_linear_fields():
    """Each level interpolates a linear field exactly from its values at the corners."""
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    side = 0.3
    matrix, levels = corner_matrix(points, [side])
    corner = np.unique(
        (np.floor(points / side)[:, None] + np.indices((2, 2, 2)).reshape(3, 8).T).reshape(-1, 3),
        axis=0,
    )
    assert not levels.any()
    assert_close(matrix @ (side * corner), points, atol=1e-6)


def test_corner_matrix__sums_the_levels():
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    matrix, levels = corner_matrix(points, [0.5, 0.1])
    for level in (0, 1):
        assert matrix @ (levels == level) == pytest.approx(np.ones(40), abs=1e-6)
    assert (np.diff(levels) >= 0).all()


def test_bits__are_those_of_the_logistic_density():
    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    rates = bits(mi.Float(X), mi.Float(0.8))
    x = X.astype(np.float64)
    assert_close(rates, -np.log2(sigmoid((x + 0.5) / 0.8) - sigmoid((x - 0.5) / 0.8)), atol=1e-2)
    whole = np.arange(-30, 31, dtype=np.float32)
    assert np.sum(2.0 ** -np.asarray(bits(mi.Float(whole), mi.Float(2.0)))) == pytest.approx(
        1, abs=1e-3
    )


def test_bits__are_finite_far_away():
    rates = np.asarray(bits(mi.Float([1e4, -1e4]), mi.Float(0.1)))
    assert (rates < 20).all()


@pytest.mark.parametrize("name", ["translation", "rotation", "log_scales"])
def test_motion_grid__gradients_of_the_rate_agree_with_central_differences(name):
    model = motion_grid(to_gaussians(make_wide_scene(30)), 2.0, GridConfig(cells=(1.0, 0.3)))
    rng = np.random.default_rng(2)
    shapes = {n: tuple(v.shape) for n, v in model.parameters.items()}
    p = {n: mi.TensorXf(rng.normal(0, 1, shape).astype(np.float32)) for n, shape in shapes.items()}
    dr.enable_grad(p[name])
    dr.backward(model.losses(p)["rate"])
    gradient = np.asarray(dr.grad(p[name]), np.float64)
    at = dr.detach(p[name])
    direction = mi.TensorXf(rng.normal(size=shapes[name]).astype(np.float32))
    step = 1e-2
    ends = [
        np.asarray(model.losses({**p, name: at + s * step * direction})["rate"]).item()
        for s in (1, -1)
    ]
    expected = (ends[0] - ends[1]) / (2 * step)
    assert np.vdot(gradient, np.asarray(direction)) == pytest.approx(expected, rel=0.01)


def test_motion_grid__moves_in_steps():
    config = GridConfig(cells=(10.0,), translation_step=0.01)
    extent = 2.0
    model = motion_grid(to_gaussians(make_wide_scene(30)), extent, config)
    corner_values = mi.TensorXf(
        np.full(tuple(model.parameters["translation"].shape), 3.4, np.float32)
    )
    displacement, rotation = model.motion({**model.parameters, "translation": corner_values})
    assert_close(displacement, np.full((30, 3), 3 * 0.01 * extent), atol=1e-6)
    assert not np.asarray(rotation).any()
