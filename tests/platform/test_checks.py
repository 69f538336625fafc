"""Checks of arguments: what they accept, and the sentences with which they refuse."""

import numpy as np
import pytest

from morgs_mi.platform.checks import check_number, check_points


@pytest.mark.parametrize(
    ("value", "interval", "good"),
    [
        (0, "[0, 1)", True),
        (0, "(0, 1)", False),
        (1, "[0, 1]", True),
        (np.float32(0.5), "[0, 1]", True),
        (np.inf, "[0, inf)", False),
        (np.nan, "[0, inf)", False),
        (True, "[0, 1]", False),
    ],
)
def test_check_number__accepts_the_numbers_of_the_interval(value, interval, good):
    if good:
        check_number("f()", "x", value, interval)
        return
    with pytest.raises(ValueError, match=r"f\(\): `x` must be a number in .0, .*, got"):
        check_number("f()", "x", value, interval)


def test_check_points__accepts_none_and_integers():
    assert [v.shape for v in check_points("f()", [], [])] == [(0, 3), (0, 3)]
    assert check_points("f()", [[1, 2, 3]], [[0, 1, 1]])[0].tolist() == [[1, 2, 3]]
