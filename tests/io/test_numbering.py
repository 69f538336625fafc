"""Numbers of frames in the names of files."""

from pathlib import Path

import pytest

from morgs_mi.io.numbering import frame_numbers


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["cam1_0007", "cam1_0009"], [7, 9]),
        (["0000_cam1", "0001_cam1"], [0, 1]),
        (["3_rgb8_v2", "4_rgb8_v2", "7_rgb8_v2"], [3, 4, 7]),
        (["f1_t0.033", "f2_t0.066", "f3_t0.100"], [1, 2, 3]),
        (["1_iso100", "2_iso100", "3_iso200"], [1, 2, 3]),
        (["2024-05-01_10", "2024-05-02_11"], [10, 11]),
        (["cam1_0005"], [5]),
        ([f"{10**20}_a1", f"{10**20 + 1}_a1"], [10**20, 10**20 + 1]),
    ],
)
def test_frame_numbers__are_those_that_change(names, numbers):
    assert frame_numbers(Path("cam1"), names) == numbers


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["0000_left", "0000_right"], "one file of number 0, got 0000_left and 0000_right"),
        (["7", "8", "07"], "one file of number 7, got 7 and 07"),
        (["0_0", "0_1", "1_0", "1_1"], "one file of number 0, got 0_0 and 1_0"),
        (["0000", "b"], "a number in each name, got b; rename it"),
    ],
)
def test_frame_numbers__refuses_equal_numbers_and_none(names, message):
    with pytest.raises(ValueError, match=f"^cam1: expected {message}"):
        frame_numbers(Path("cam1"), names)
