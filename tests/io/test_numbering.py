"""Numbers of frames in the names of files."""

from pathlib import Path

import pytest

from morgs_mi.io.numbering import check_numbering, frames_by_number


def files(names):
    return {name: Path(f"{name}.png") for name in names}


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["cam1_0007", "cam1_0009"], [7, 9]),
        (["0000_cam1", "0001_cam1"], [0, 1]),
        (["3_rgb8_v2", "4_rgb8_v2", "7_rgb8_v2"], [3, 4, 7]),
        (["t0.033_f1", "t0.066_f2", "t0.100_f3"], [1, 2, 3]),
        (["1_iso100", "2_iso100", "3_iso200"], [1, 2, 3]),
        (["2024-05-01_10", "2024-05-02_11"], [10, 11]),
        (["cam1_0005"], [5]),
        ([f"{10**20}_a1", f"{10**20 + 1}_a1"], [10**20, 10**20 + 1]),
    ],
)
def test_frames_by_number__are_those_that_change(names, numbers):
    frames = frames_by_number(Path("cam1"), files(reversed(names)))
    assert frames == dict(zip(numbers, files(names).values(), strict=True))
    assert list(frames) == numbers


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["0000_left", "0000_right"], "one number .* got 0000_left followed by 0000_right"),
        (["7", "8", "07"], "one number .* got 0?7 followed by 0?7"),
        (["0_0", "0_1", "1_0", "1_1"], "one number .* got 0_1 followed by 1_0"),
        (["12_30_59_29", "12_31_00_00"], "one number .* got 12_30_59_29 followed by 12_31_00_00"),
        (["0.8", "0.9", "1.0"], "one number .* got 0.9 followed by 1.0; rename the images"),
        (["color_0", "color_1", "depth_0"], "one number .* got color_1 followed by depth_0"),
        (["0000", "b"], "a number in each name, got b; rename it"),
    ],
)
def test_frames_by_number__refuses_equal_numbers_another_order_and_none(names, message):
    with pytest.raises(ValueError, match=f"^cam1: expected {message}"):
        frames_by_number(Path("cam1"), files(names))


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ([0, 1, 3, 4], "numbered without gaps, got 1 followed by 3; .*--gaps"),
        (
            [0, 33, 67, 100],
            "in equal steps, got 33 followed by 67, and steps of 33",
        ),
        (
            [10**18, 10**18 + 33366, 10**18 + 66733],
            "in equal steps, got .* if their names are times",
        ),
    ],
)
def test_check_numbering__distinguishes_gaps_from_times(numbers, message):
    with pytest.raises(ValueError, match=message):
        check_numbering(Path("cam1"), {number: Path(str(number)) for number in numbers})
    assert check_numbering(Path("cam1"), {number: Path(str(number)) for number in (4, 6, 8)}) == 2
