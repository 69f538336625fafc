"""The assertion that the tests share: what passes, and what its message reports."""

import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.testing import assert_close


def test_assert_close__accepts_errors_up_to_the_tolerances():
    assert_close(mi.TensorXf([1.0, 2.5]), np.array([1.0, 2.0]), atol=0.5)
    assert_close([1.0, 2.5], [1.0, 2.0], rtol=0.25)
    assert_close([1.0, np.nan], [1.0, 2.0], where=[True, False])
    assert_close([1.0, 1.5], 1, atol=0.5)


@pytest.mark.parametrize(
    ("value", "expected", "message"),
    [
        ([[1, 2], [3, 5]], [[1, 2], [3, 4]], r"x\n(.|\n)*\[1, 1\]: 5"),
        ([1, np.nan], [1, 2], r"x\n(.|\n)*nan"),
        ([1, 2], [1, 2, 3], r"x: shape \[2\], expected \[3\]"),
    ],
)
def test_assert_close__reports_the_worst_entry(value, expected, message):
    with pytest.raises(AssertionError, match=message):
        assert_close(value, expected, atol=0.5, name="x")
