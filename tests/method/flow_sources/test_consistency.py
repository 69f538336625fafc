"""Forward-backward check: which pixels pass, and what its two tolerances do."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi.method.flow import consistency_mask


def constant_flow(x, y=0.0):
    return np.full((20, 30, 2), (x, y), np.float32)


def test_consistency_mask__passes_flow_that_returns_inside_the_image():
    mask = consistency_mask(constant_flow(3), constant_flow(-3))
    assert mask.dtype == bool
    assert_array_equal(mask, np.arange(30)[None] + 3 < np.full((20, 1), 30))


def test_consistency_mask__samples_the_flow_back_where_the_flow_leads():
    back = constant_flow(9)
    back[:, 15:20] = (-5, 0)
    mask = consistency_mask(constant_flow(5), back)
    assert_array_equal(np.flatnonzero(mask.all(axis=0)), np.arange(10, 15))
    assert mask.sum() == 5 * 20


@pytest.mark.parametrize(
    ("back", "tolerances", "passes"),
    [
        # |F| = 6: a squared mismatch of 0.01 (36 + |B|^2) + 0.5 is tolerated.
        (-7.0, {}, True),
        (-7.5, {}, False),
        (-7.0, {"RELATIVE": 0}, False),
        (-7.0, {"ABSOLUTE": 0}, False),
        (-7.5, {"RELATIVE": 0.03}, True),
        (-7.5, {"ABSOLUTE": 2}, True),
    ],
)
def test_consistency_mask__tolerates_a_mismatch(monkeypatch, back, tolerances, passes):
    for kind, tolerance in tolerances.items():
        monkeypatch.setattr(f"morgs_mi.method.flow.{kind}_TOLERANCE", tolerance)
    mask = consistency_mask(constant_flow(6), constant_flow(back))
    assert mask[:, :20].all() == passes
    assert mask[:, :20].any() == passes
