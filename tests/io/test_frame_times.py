"""Frames of clips that are cut by an edit list, and rates that headers round."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.io.frame_times import true_rate
from morgs_mi.io.video import VideoReader
from tests.scenes.captures import write_timed_video
from tests.scenes.edit_lists import show_parts

CLIPS = Path(__file__).parent / "clips"
FPS = 20
COUNT = 140
# Parts in s, and the frames that players show.
PARTS = {
    "start": ([(0.25, 6.75)], range(5, 140)),
    "start within a frame": ([(0.22, 6.78)], range(5, 140)),
    "end": ([(0.0, 5.5)], range(110)),
    "end by a frame": ([(0.0, 6.95)], range(139)),
    "both": ([(0.25, 5.5)], range(5, 115)),
    "after a pause": ([(-1.0, 0.5), (0.25, 6.75)], range(5, 140)),
    "within": ([(0.0, 1.0), (3.0, 1.0)], (*range(20), *range(60, 80))),
}


def clip(count=COUNT):
    """Return images with the frame's number as bars."""
    numbers = np.arange(count)[:, None] >> np.arange(8) & 1
    bars = np.repeat(np.repeat(numbers[:, None, :, None], 8, axis=2), 32, axis=1)
    return list(np.repeat(40 + 170 * bars, 3, axis=3).astype(np.uint8))


def number(image):
    """Return the frame's number in an image of `clip`."""
    return int(((image[8:24, 3::8].mean(axis=(0, 2)) > 120) * 2 ** np.arange(8)).sum())


@pytest.mark.parametrize("name", ["hevc.mp4", "hevc.mov", "h264.mp4"])
def test_video_reader__has_the_shown_frames_of_hevc_with_sound(name):
    reader = VideoReader.open(CLIPS / name)
    levels = np.array([image.mean() for image in reader.frames()])
    assert reader.num_frames == len(levels) == 19
    # Half a step: lossy compression.
    assert_allclose(levels, 98 + 8 * np.arange(19), atol=4)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("file", ["a.mp4 mpeg4", "a.mov libx264"])
def test_video_reader__has_the_frames_that_the_edit_list_shows(tmp_path, file, part):
    """With frames that refer to later ones in H.264."""
    name, codec = file.split()
    parts, frames = PARTS[part]
    write_timed_video(tmp_path / name, clip(), range(0, 50 * COUNT, 50), codec)
    reader = VideoReader.open(show_parts(tmp_path / name, parts))
    assert [number(image) for image in reader.frames()] == list(frames)
    assert (reader.num_frames, reader.num_held) == (len(frames), len(frames))
    assert reader.fps == pytest.approx(FPS)
    if part != "within":  # FFmpeg delays the second part where frames refer to later ones
        assert reader.positions is None
        assert_allclose(np.diff(reader.times), 1 / FPS, atol=1e-3)
    last = len(frames) - 1
    assert [number(image) for image in reader.pick([last])] == [frames[-1]]  # type: ignore[arg-type]


def test_video_reader__has_the_positions_of_shown_frames_at_a_variable_rate(tmp_path):
    write_timed_video(tmp_path / "a.mp4", clip(8), [0, 50, 100, 150, 300, 350, 400, 450])
    reader = VideoReader.open(show_parts(tmp_path / "a.mp4", [(0.1, 0.3)]))
    assert [number(image) for image in reader.frames()] == [2, 3, 4, 5]
    assert_allclose(reader.positions, [0, 1, 4, 5], atol=0.05)


def test_true_rate__is_that_of_the_times_where_the_header_contradicts_them():
    assert true_rate(30, 1800, 60.0) == 30
    assert true_rate(29.97, 100, 100 / 30) == 29.97  # a tenth of a frame
    assert true_rate(30, 1790, 60.0) == 1790 / 60
    assert true_rate(0, 50, 2.0) == 25


def test_video_reader__has_the_rate_of_its_time_stamps(tmp_path):
    times = [round(1000 * t / 29.83) for t in range(60)]
    write_timed_video(tmp_path / "a.mp4", [image[:, :48] for image in clip(60)], times)
    reader = VideoReader.open(tmp_path / "a.mp4")
    assert reader.positions is None
    assert reader.fps == pytest.approx(29.83, abs=0.02)
    assert cv2.VideoCapture(str(tmp_path / "a.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 60
