"""Parts that several motion models share."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.field.shared import quantised
from tests.assertions import assert_close


def test_quantised__rounds_values_and_passes_gradients():
    values = mi.TensorXf(np.array([0.04, 0.06, -0.26, 0.31], np.float32))
    dr.enable_grad(values)
    rounded = quantised(values, 0.1)
    weight = mi.TensorXf(np.array([1, 2, 3, 4], np.float32))
    assert_close(rounded, [0, 0.1, -0.3, 0.3], atol=1e-6)
    dr.backward(dr.sum(weight * rounded, axis=None))
    assert_close(dr.grad(values), weight, atol=0)
    assert np.array_equal(np.asarray(quantised(values, 0.0)), np.asarray(values))
