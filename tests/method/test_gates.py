"""Learned gates and quantised residuals: values, gradients, and their place in the residual."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.method.config import MotionConfig
from morgs_mi.method.gates import GateConfig, gate_loss, hard_gate, quantised
from morgs_mi.method.residual import apply_residual, residual_parameters
from tests.assertions import assert_close
from tests.scenes.gaussians import make_scene, to_gaussians

CONFIG = MotionConfig(learn_motion=False, learn_offset=False, learn_confidence=False, learn_gates=True)
LOGITS = np.array([-6, -2.3, -1, 0, 0.7, 2.5, 6], np.float32)


def gate64(a: np.ndarray) -> np.ndarray:
    return np.clip(1.2 / (1 + np.exp(-a.astype(np.float64))) - 0.1, 0, 1)


def test_hard_gate__is_exactly_closed_and_open_at_the_ends():
    found = np.asarray(hard_gate(mi.Float(LOGITS)))
    assert_close(found, gate64(LOGITS), atol=1e-6)
    assert found[0] == 0
    assert found[-1] == 1
    assert 0 < found[2] < found[3] < found[4] < 1


@pytest.mark.parametrize("name", ["gate", "loss"])
def test_gates__gradients_agree_with_central_differences(name):
    def value(logits):
        return dr.sum(hard_gate(logits.array)) if name == "gate" else gate_loss(logits, 20)

    logits, at, step = mi.TensorXf(LOGITS), mi.TensorXf(LOGITS), 1e-2
    dr.enable_grad(logits)
    dr.backward(value(logits))
    ends = np.array(
        [
            [np.asarray(value(at + s * step * mi.TensorXf(unit))).item() for s in (1, -1)]
            for unit in np.eye(len(LOGITS), dtype=np.float32)
        ]
    )
    assert_close(dr.grad(logits), (ends[:, 0] - ends[:, 1]) / (2 * step), atol=2e-4)


def test_gate_loss__is_the_share_of_open_gates():
    logits = mi.TensorXf(np.full(6, 20, np.float32))
    assert np.asarray(gate_loss(logits, 12)).item() == pytest.approx(0.5, abs=1e-5)
    assert np.asarray(gate_loss(-logits, 12)).item() == pytest.approx(0, abs=1e-5)


def test_quantised__rounds_values_and_passes_gradients():
    values = mi.TensorXf(np.array([0.04, 0.06, -0.26, 0.31], np.float32))
    dr.enable_grad(values)
    rounded, weight = quantised(values, 0.1), mi.TensorXf(np.array([1, 2, 3, 4], np.float32))
    assert_close(rounded, [0, 0.1, -0.3, 0.3], atol=1e-6)
    dr.backward(dr.sum(weight * rounded, axis=None))
    assert_close(dr.grad(values), weight, atol=0)
    assert np.array_equal(np.asarray(quantised(values, 0.0)), np.asarray(values))


def test_apply_residual__gates_means_and_rounds_the_rest():
    previous, rng = to_gaussians(make_scene()), np.random.default_rng(0)
    start = residual_parameters(previous, CONFIG)
    assert np.array_equal(start["logit_gate"], np.full(10, 2))
    logits = np.resize(LOGITS, 10)
    parameters = {n: mi.TensorXf(rng.normal(0, 0.1, tuple(v.shape)).astype(np.float32)) for n, v in start.items()}
    parameters["logit_gate"] = mi.TensorXf(logits)
    current, before = apply_residual(previous, parameters, CONFIG).numpy(), previous.numpy()
    assert_close(current["motion"], gate64(logits)[:, None] * np.asarray(parameters["motion"]), atol=1e-6)
    assert_close(current["means"] - before["means"], current["motion"], atol=1e-6)
    assert np.array_equal(current["means"][0], before["means"][0]), "a closed gate changes no bit"
    for name, step in (("log_scales", 0.02), ("quats", 0.02), ("logit_opacities", 0.1), ("sh_coeffs", 0.02)):
        multiples = (current[name].astype(np.float64) - before[name]) / step
        assert_close(multiples, np.round(multiples), atol=1e-3, name=name)
        assert np.abs(multiples).max() > 1


def test_apply_residual__without_steps_rounds_nothing():
    config = replace(CONFIG, gates=GateConfig(scale_step=0, rotation_step=0, opacity_step=0, color_step=0))
    previous = to_gaussians(make_scene())
    parameters = residual_parameters(previous, config)
    parameters["log_scales"] = mi.TensorXf(np.full((10, 3), 0.007, np.float32))
    change = np.asarray(apply_residual(previous, parameters, config).log_scales) - np.asarray(previous.log_scales)
    assert_close(change, np.full((10, 3), 0.007), atol=1e-6)


def test_GateConfig__refuses_what_is_out_of_range():
    with pytest.raises(ValueError, match=r"`color_step` must be a number in \[0, inf\), got -1"):
        GateConfig(color_step=-1)
