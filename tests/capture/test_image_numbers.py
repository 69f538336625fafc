"""Folders of images whose numbers differ among the cameras."""

import cv2
import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.timeline import ReadConfig
from tests.capture.test_timeline import frame_numbers
from tests.scenes import captures as layouts

TRIM = ReadConfig(trim=True)
GAPS = ReadConfig(gaps=True)


def capture_of(path, **cameras):
    """Write folders of images with the numbers of each camera; the colour is the number."""
    layouts.n3dv(path, tuple(cameras), lambda *_: None)
    for name, numbers in cameras.items():
        (path / name).mkdir()
        for number in numbers:
            image = np.full((layouts.HEIGHT, layouts.WIDTH, 3), number % 256, np.uint8)
            cv2.imwrite(str(path / name / f"{number:04d}.png"), image)
    return path


DIFFERENT = [
    (range(4), range(2, 6)),
    (range(10), range(1, 11)),
    ([0, 1], [0, 2]),
    (range(9), range(4, 9, 2)),
    (range(0, 13, 2), range(0, 13, 3)),
]


@pytest.mark.parametrize(("a", "b"), DIFFERENT)
def test_align_numbers__are_times(tmp_path, a, b):
    path = capture_of(tmp_path / "c", a=a, b=b, c=a)
    timestamps = frame_numbers(load_capture(path, reading=GAPS))
    assert all(len({number for number in row if number is not None}) <= 1 for row in timestamps)
    for camera, numbers in enumerate((a, b, a)):
        assert [row[camera] for row in timestamps if row[camera] is not None] == list(numbers)


@pytest.mark.parametrize("b", [range(2, 6), range(1, 9, 2)])
@pytest.mark.parametrize("trim", [False, True])
def test_align_numbers__are_refused_without_an_option_and_replaced_by_offsets(tmp_path, b, trim):
    path = capture_of(tmp_path / "c", a=range(4), b=b)
    step = " by 2" if b.step == 2 else ""
    message = rf"got a 0 to 3, b {b[0]} to {b[-1]}{step}; move .*--gaps.*--offset a 0"
    with pytest.raises(ValueError, match=message):
        load_capture(path, reading=ReadConfig(trim=trim))
    capture = load_capture(path, reading=ReadConfig(trim=trim, offset={"a": 0}))
    assert frame_numbers(capture) == [[t, number] for t, number in enumerate(b)]
    assert "aligned by their positions and --offset" in capture.notes[0]


@pytest.mark.parametrize("reading", [ReadConfig(), TRIM, GAPS])
def test_align_numbers__that_do_not_overlap_are_paired_by_an_offset(tmp_path, reading):
    path = capture_of(tmp_path / "c", a=range(100, 105), b=range(40, 45), c=range(40, 45))
    with pytest.raises(ValueError, match=r"(numbers|position) with --offset"):
        load_capture(path, reading=reading)
    capture = load_capture(path, reading=ReadConfig(offset={"a": 0}))
    assert frame_numbers(capture) == [[100 + t, 40 + t, 40 + t] for t in range(5)]


def test_align_numbers__says_nothing_on_equal_numbers_and_photos(tmp_path):
    for cameras in (
        {"a": range(3, 6), "b": range(3, 6)},
        {"a": [1], "b": [2]},
        {"a": [4], "b": [4]},
    ):
        capture = load_capture(capture_of(tmp_path / str(cameras["a"]), **cameras))
        assert not any("numbers" in note for note in capture.notes)
    (tmp_path / "d").mkdir()
    path = capture_of(tmp_path / "d" / "c", a=[0], b=[0])
    for name in ("a", "b"):
        (path / name / "0000.png").rename(path / name / "photo.png")
    assert load_capture(path).num_frames == 1


@pytest.mark.parametrize("reading", [ReadConfig(), GAPS])
def test_align_numbers__are_those_that_change(tmp_path, reading):
    path = capture_of(tmp_path / "c", a1=range(3), a2=range(3))
    for file in [*path.glob("a*/*.png")]:
        file.rename(file.with_stem(f"{file.stem}_{file.parent.name}"))
    assert frame_numbers(load_capture(path, reading=reading)) == [[t, t] for t in range(3)]
    (path / "a2" / "0001_a2.png").unlink()
    rows = frame_numbers(load_capture(path, reading=GAPS))
    assert rows == [[0, 0], [1, None], [2, 2]]
    (path / "a2" / "0002_a2.png").rename(path / "a2" / "0000_b2.png")
    with pytest.raises(ValueError, match=r"a2: expected one number .* 0000_a2 followed by 0000_b2"):
        load_capture(path, reading=reading)


@pytest.mark.parametrize("reading", [ReadConfig(), TRIM, GAPS])
def test_align_numbers__are_no_times(tmp_path, reading):
    """Times in milliseconds of two cameras."""
    path = capture_of(tmp_path / "c", a=[0, 33, 67, 100], b=[1, 34, 66, 101])
    message = r"a: expected numbers that count the frames .* got 0033.png followed by 0067.png"
    with pytest.raises(ValueError, match=message):
        load_capture(path, reading=reading)
