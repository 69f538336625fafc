"""The gated residual (eq. 12): values, gates and gradients."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.motion_start import MotionStart
from morgs_mi.method.residual import apply_residual, residual_parameters
from morgs_mi.testing import assert_close
from tests.scenes.derivatives import backward, gradient
from tests.scenes.gaussians import make_scene, to_gaussians


def random_parameters(previous, config, seed=0):
    rng = np.random.default_rng(seed)
    start = residual_parameters(previous, config)
    return {
        k: mi.TensorXf(rng.normal(0, 0.1, tuple(v.shape)).astype(np.float32))
        for k, v in start.items()
    }


@pytest.mark.parametrize("two_gates", [False, True])
@pytest.mark.parametrize("degree", [0, 2])
def test_apply_residual__gate_scales_every_attribute(degree, two_gates):
    """A_t = A_{t-1} + m R_t (eq. 12); with two gates, the appearance's gate is 1."""
    config = MotionConfig(two_gates=two_gates)
    previous = to_gaussians(make_scene(degree))
    parameters = random_parameters(previous, config)
    m = 1 / (1 + np.exp(-np.asarray(parameters["logit_confidence"], np.float64)))
    current = apply_residual(previous, parameters, config).numpy()
    old_values = previous.numpy()
    R = {name: np.asarray(value) for name, value in parameters.items()}
    displacement = m[:, None] * (R["motion"] + R["offset"])
    assert_close(current["motion"], displacement, atol=1e-6)
    assert_close(current["offset"], m[:, None] * R["offset"], atol=1e-6)
    appearance = np.ones_like(m) if two_gates else m
    R["sh_coeffs"] = np.concatenate([R["sh_dc"], *([R["sh_rest"]] if degree else [])], axis=1)
    for name, gate in (
        ("quats", m),
        ("log_scales", appearance),
        ("logit_opacities", appearance),
        ("sh_coeffs", appearance),
    ):
        change = gate * R[name].T
        assert_close(current[name] - old_values[name], change.T, atol=1e-6, name=name)
    assert_close(current["means"] - old_values["means"], displacement, atol=1e-6)


def test_residual_parameters__follow_the_modules():
    previous = to_gaussians(make_scene())
    assert "offset" not in residual_parameters(previous, MotionConfig(learn_offset=False))
    assert "logit_confidence" not in residual_parameters(
        previous, MotionConfig(learn_confidence=False)
    )
    assert {"offset", "logit_confidence", "motion"} <= set(
        residual_parameters(previous, MotionConfig())
    )


@pytest.mark.parametrize("lift_confidence", [False, True])
def test_residual_parameters__lifted_motion_passes_the_gate_at_full_length(lift_confidence):
    previous = to_gaussians(make_scene())
    rng = np.random.default_rng(1)
    lifted = MotionStart(np.float32(rng.normal(size=(10, 3))), np.float32(rng.uniform(-2, 2, 10)))
    config = MotionConfig(lift_confidence=lift_confidence)
    current = apply_residual(previous, residual_parameters(previous, config, lifted), config)
    assert (np.asarray(current.confidence) > 0.1).all()
    assert np.asarray(current.motion) == pytest.approx(lifted.displacement, rel=1e-5, abs=1e-6)
    old_logits = np.asarray(previous.logit_confidence)
    logit = lifted.logit_confidence if lift_confidence else old_logits
    assert np.array_equal(current.logit_confidence, logit)


def test_apply_residual__gradient_of_the_gate_follows_the_product_rule():
    config = MotionConfig()
    previous = to_gaussians(make_scene())
    parameters = random_parameters(previous, config)
    dr.enable_grad(parameters["logit_confidence"], parameters["motion"])
    backward(apply_residual(previous, parameters, config).means)
    logit = np.asarray(parameters["logit_confidence"], np.float64)
    m = 1 / (1 + np.exp(-logit))
    R = sum(np.asarray(parameters[name], np.float64) for name in ("motion", "offset"))
    assert gradient(parameters["motion"]) == pytest.approx(np.repeat(m[:, None], 3, 1), rel=1e-5)
    expected = m * (1 - m) * R.sum(1)
    assert_close(dr.grad(parameters["logit_confidence"]), expected, atol=1e-6)
