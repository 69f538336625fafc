"""Clips with different lengths, rates and starts, and missing images."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.io.frame_times import time_code_seconds
from morgs_mi.io.video_writer import write_video
from morgs_mi.playback.visualise import write_png
from tests.scenes import captures as layouts


def capture_of(path, clips, levels=1):
    """Write clips given by number of frames and frame rate; frame t of camera i is filled with (i,
    t, 0) times `levels`.
    """
    layouts.n3dv(path, tuple(clips), lambda *_: None)
    for i, (name, (count, fps)) in enumerate(clips.items()):
        images = [levels * image for image in layouts.frames(i, count)]
        write_video(path / f"{name}.mkv", images, fps)
    return path


def frame_numbers(capture):
    """Return per timestamp the frame of each clip, None for a missing image."""
    frames = capture.partial_frames()
    return [
        [None if image is None else int(image[0, 0, 1]) for image in frame.images]
        for frame in frames
    ]


@pytest.mark.parametrize(
    ("clips", "config", "fps", "timestamps"),
    [
        # The timestamps that both cover.
        ({"a": (4, 25), "b": (6, 25)}, ReadConfig(trim=True), 25, [[0, 0], [1, 1], [2, 2], [3, 3]]),
        # b started two frames earlier and ends one frame before a.
        ({"a": (4, 25), "b": (5, 25)}, ReadConfig(offset={"b": 2}), 25, [[0, 2], [1, 3], [2, 4]]),
        # b started a frame later.
        ({"a": (4, 25), "b": (4, 25)}, ReadConfig(offset={"b": -1}), 25, [[1, 0], [2, 1], [3, 2]]),
        # b has twice the rate and started three of its frames earlier.
        ({"a": (4, 25), "b": (8, 50)}, ReadConfig(offset={"b": 3}), 25, [[0, 3], [1, 5], [2, 7]]),
        # 2 frames of a take 66.7 ms, which is 3.33 frames of b: the nearest is used.
        ({"a": (3, 30), "b": (6, 50)}, ReadConfig(trim=True), 30, [[0, 0], [1, 2], [2, 3]]),
        # With gaps nothing is trimmed: a is left out of the frames that it lacks.
        ({"a": (2, 25), "b": (3, 25)}, ReadConfig(gaps=True), 25, [[0, 0], [1, 1], [None, 2]]),
    ],
)
def test_timeline__aligns_clips(tmp_path, clips, config, fps, timestamps):
    capture = load_capture(capture_of(tmp_path / "c", clips), reading=config)
    assert capture.fps == pytest.approx(fps, abs=0.01)
    assert capture.num_frames == len(timestamps)
    assert frame_numbers(capture) == timestamps
    assert [frame.index for frame in capture.partial_frames(1)] == list(range(1, len(timestamps)))


def test_timeline__gives_clips_whose_offset_is_not_whole_a_delay(tmp_path):
    path = capture_of(tmp_path / "c", {"a": (5, 25), "b": (5, 25)}, 40)
    capture = load_capture(path, reading=ReadConfig(offset={"b": -1.25}))
    # At frames 2, 3 and 4 of a, b would show its frames 0.75, 1.75 and 2.75. Only the first image
    # is interpolated.
    assert frame_numbers(capture) == [[80, 30], [120, 80], [160, 120]]
    assert [camera.delay for camera in capture.cameras] == [0, 0.25]
    first = next(capture.partial_frames())
    assert [int(view.image[0, 0, 1]) for view in first.comparable] == [80, 40]
    assert [int(image[0, 0, 1]) for image in capture.images(1)] == [40, 80, 120]
    capture = load_capture(path, reading=ReadConfig(offset={"a": 1.5, "b": 2}))
    assert frame_numbers(capture) == [[20, 40], [80, 80], [120, 120], [160, 160]]
    assert [camera.delay for camera in capture.cameras] == [0.5, 0]


@pytest.mark.parametrize(
    ("rates", "offset", "timestamps", "delays"),
    [
        # A delay is in timestamps.
        ((25, 50), {"b": 0.5}, [[0, 20], [40, 120]], [0, 0.25]),
        # a's frames 0, 1 and 2 are b's 0.25, 1.75 and 3.25: the delay varies.
        ((20, 30), {"b": 0.25}, [[0, 0], [40, 80], [80, 120]], [0, 0]),
        # Rates that hardly differ have a constant delay.
        ((30, 29.97), {"a": 0.25}, [[10, 0], [40, 40], [80, 80], [120, 120]], [-0.25, 0]),
    ],
)
def test_timeline__delays_clips_of_other_rates(tmp_path, rates, offset, timestamps, delays):
    clips = {name: (5, fps) for name, fps in zip("ab", rates, strict=True)}
    capture = load_capture(capture_of(tmp_path / "c", clips, 40), reading=ReadConfig(offset=offset))
    assert [camera.delay for camera in capture.cameras] == delays
    assert frame_numbers(capture)[: len(timestamps)] == timestamps


TIME_CODES = {
    # The time codes of a and b, and what is advised.
    "later": (("01:00:00:00", "01:00:00:02"), "--offset b -2."),
    "earlier, over a minute": (("01:01:00:00", "01:00:59:23"), "--offset b 2."),
    "equal": (("01:00:00:00", "01:00:00:00"), ""),
    "of other recordings": (("01:00:00:00", "09:30:00:00"), ""),
    "of one clip": (("01:00:00:00", ""), ""),
}


@pytest.mark.parametrize("case", TIME_CODES)
@pytest.mark.parametrize("suffix", [".mov", ".mp4", ".mkv"])
def test_timeline__names_time_codes_that_differ(tmp_path, caplog, case, suffix):
    codes, advice = TIME_CODES[case]
    layouts.n3dv(tmp_path / "c", ("a", "b"), lambda *_: None)
    for i, (name, code) in enumerate(zip("ab", codes, strict=True)):
        clip = tmp_path / "c" / f"{name}{suffix}"
        times = range(0, 240, 40)
        layouts.write_timed_video(clip, layouts.frames(i, 6), times, "libx264", time_code=code)
    assert load_capture(tmp_path / "c").num_frames == 6
    assert bool(caplog.text) == bool(advice)
    assert advice in caplog.text
    name, offset = (advice or "--offset b 1.").removeprefix("--offset ").rstrip(".").split()
    caplog.clear()
    load_capture(tmp_path / "c", reading=ReadConfig(offset={name: float(offset)}))
    assert "time codes" not in caplog.text


@pytest.mark.parametrize(
    ("code", "fps", "seconds"),
    [
        ("00:01:00:12", 24, 60.5),
        ("01:00:00;00", 30000 / 1001, 3600),
        ("00:10:00;02", 30000 / 1001, 600.0667),
        ("00:01:00;02", 30000 / 1001, 60.06),
        ("00:01:00;04", 60000 / 1001, 60.06),
        ("noon", 25, np.nan),
    ],
)
def test_time_code_seconds__follows_the_clock(code, fps, seconds):
    assert time_code_seconds(code, fps) == pytest.approx(seconds, abs=0.01, nan_ok=True)


def test_load_capture__names_the_cameras_of_a_note_together(tmp_path, caplog):
    path = capture_of(tmp_path / "c", {"a": (3, 25), "b": (3, 25)})
    for name in ("a", "b"):
        (path / f"{name}.mkv").unlink()
        cv2.imwritemulti(str(path / f"{name}.tif"), [layouts.frames(0)[0]] * 3)
    capture = load_capture(path)
    assert capture.notes[0] == (
        "a, b: images have 3 pages, of which the first is used; extract all."
    )
    assert capture.notes[0] in caplog.text


def test_load_capture__takes_white_from_the_settings(tmp_path, caplog):
    path = capture_of(tmp_path / "c", {"a": (2, 25), "b": (2, 25)})
    for name in ("a", "b"):
        (path / f"{name}.mkv").unlink()
        (path / name).mkdir()
        image = np.full((layouts.HEIGHT, layouts.WIDTH, 3), 2048, np.uint16)
        for t in range(2):
            cv2.imwrite(str(path / name / f"{t}.png"), image)
    load_capture(path)
    assert "nearly black; if white is less than 65535" in caplog.text
    (path / "capture.json").write_text('{"white": 4095}')
    caplog.clear()
    assert next(load_capture(path).frames()).images[0].max() == 128
    assert not caplog.text


def test_load_capture__reads_the_readout_of_cameras(tmp_path):
    path = capture_of(tmp_path / "c", {"a": (3, 25), "b": (6, 50)})
    for setting, expected in (("0.6", [0.6, 0.3]), ('{"b": -0.5}', [0, -0.25])):
        (path / "capture.json").write_text(f'{{"readout": {setting}}}')
        capture = load_capture(path, reading=ReadConfig(trim=True))
        assert [camera.readout for camera in capture.cameras] == expected


def test_timeline__uses_the_true_rate_and_the_frame_limit_for_aligned_clips(tmp_path):
    path = capture_of(tmp_path / "c", {"a": (4, 25), "b": (6, 50)})
    (path / "capture.json").write_text('{"fps": 20}')
    capture = load_capture(path, max_frames=2, reading=ReadConfig(offset={"b": 1}))
    assert (capture.fps, frame_numbers(capture)) == (20, [[0, 1], [1, 2]])
    assert capture.metadata()["reading"]["offset"] == {"b": 1}
    assert [camera["first_frame"] for camera in capture.metadata()["cameras"]] == [0, 1]


RATES = {"a": (300, 30.0), "b": (300, 29.7), "c": (300, 29.97)}


def moments(capture, clips):
    """Return the times of the images of each timestamp [T, C] in s; the clips of `capture_of` begin
    together.
    """
    numbers = np.array(
        [[int(image[0, 0, 1]) for image in frame.images] for frame in capture.frames()]
    )
    # The colour of a frame is its number modulo 256.
    numbers += 256 * np.cumsum(np.diff(numbers, axis=0, prepend=0) < 0, axis=0)
    return numbers / [fps for _, fps in clips.values()]


@pytest.mark.parametrize("config", [ReadConfig(offset={"b": 0}), ReadConfig(trim=True, gaps=True)])
def test_timeline__uses_rates_that_are_less_than_a_percent_apart(tmp_path, caplog, config):
    path = capture_of(tmp_path / "c", RATES)
    capture = load_capture(path, reading=config)
    assert capture.fps == pytest.approx(29.7, abs=0.01)
    times = moments(capture, RATES)
    assert_allclose(times[:, 1], np.arange(len(times)) / 29.7, atol=1e-3)
    spread = np.ptp(times, axis=1).max()
    assert spread < 1 / 29.7
    assert f"images of one timestamp are up to {1e3 * spread:.0f}"[:-1] in caplog.text


def test_timeline__refuses_rates_that_drift_more_than_half_a_frame(tmp_path, caplog):
    path = capture_of(tmp_path / "c", RATES)
    with pytest.raises(
        ValueError, match=r"same frame rate, got a.mkv 30, .* up to 3.0 frames apart; .*--trim"
    ):
        load_capture(path)
    assert load_capture(path, max_frames=30).num_frames == 30
    assert "images of one timestamp are up to 9.8 ms apart" in caplog.text
    (path / "capture.json").write_text('{"fps": 30}')
    assert load_capture(path).num_frames == 300


def test_timeline__keeps_truth_only_for_unshifted_clips(tmp_path):
    path = capture_of(tmp_path / "c", {"a": (4, 25), "b": (6, 25)})
    (path / "truth").mkdir()
    assert load_capture(path, reading=ReadConfig(trim=True)).truth == path / "truth"
    assert load_capture(path, reading=ReadConfig(offset={"b": 1})).truth is None


def test_timeline__refuses_clips_of_different_lengths(tmp_path):
    path = capture_of(tmp_path / "c", {"a": (4, 25), "b": (6, 25)})
    message = r"number of frames, got a.mkv 4, b.mkv 6; .*--frames 4, .* --trim, .* --offset"
    with pytest.raises(ValueError, match=message):
        load_capture(path)


def test_read_config__refuses_an_offset_that_is_not_finite():
    with pytest.raises(ValueError, match="`offset` must be a table, each value a finite number"):
        ReadConfig(offset={"b": np.nan})


def test_timeline__truncated_clip_can_be_trimmed_or_left_out_but_not_shifted(tmp_path):
    path = capture_of(tmp_path / "c", {"a": (6, 25), "b": (6, 25)})
    data = (path / "b.mkv").read_bytes()
    (path / "b.mkv").write_bytes(data[: len(data) * 2 // 3])
    for config in (ReadConfig(), ReadConfig(offset={"b": 1})):
        with pytest.raises(ValueError, match=r"b.mkv: frame \d of 6 cannot be read: .* \(--gaps\)"):
            load_capture(path, reading=config)
    held = load_capture(path, reading=ReadConfig(trim=True)).num_frames
    assert 0 < held < 6
    assert frame_numbers(load_capture(path, reading=ReadConfig(trim=True))) == [
        [t, t] for t in range(held)
    ]
    expected = [[t, t if t < held else None] for t in range(6)]
    assert frame_numbers(load_capture(path, reading=ReadConfig(gaps=True))) == expected


# Clips at 20 fps, the second with two frames that come 0.1 s late, the third with jitter within
# half a frame.
REGULAR = [50 * t for t in range(7)]
LATE = [0, 50, 100, 250, 300]
JITTER = [0, 60, 95, 140, 200, 255, 300]


def timed(path, **times):
    """Write clips given by the times of their frames in milliseconds; frame t of camera i is filled
    with (i, t, 0).
    """
    layouts.n3dv(path, tuple(times), lambda *_: None)
    for i, (name, milliseconds) in enumerate(times.items()):
        layouts.write_timed_video(
            path / f"{name}.mp4", layouts.frames(i, len(milliseconds)), milliseconds
        )
    return path


@pytest.mark.parametrize(
    ("times", "config", "timestamps"),
    [
        # The nearest frame is shown at each timestamp.
        (
            {"a": REGULAR, "b": LATE},
            ReadConfig(trim=True),
            [[0, 0], [1, 1], [2, 2], [3, 2], [4, 3], [5, 3], [6, 4]],
        ),
        # Its camera is left out where the nearest frame is more than half a frame away.
        (
            {"a": REGULAR, "b": LATE},
            ReadConfig(gaps=True),
            [[0, 0], [1, 1], [2, 2], [3, None], [4, None], [5, 3], [6, 4]],
        ),
        # Frame 1 of b is simultaneous with frame 0 of a; then frame 3 of b.
        (
            {"a": REGULAR, "b": LATE},
            ReadConfig(offset={"b": 1}),
            [[0, 1], [1, 2], [2, 2], [3, 3], [4, 3], [5, 4]],
        ),
        ({"a": REGULAR, "b": JITTER}, ReadConfig(), [[t, t] for t in range(7)]),
    ],
)
def test_timeline__synchronises_variable_frame_rates_by_time(tmp_path, times, config, timestamps):
    capture = load_capture(timed(tmp_path / "c", **times), reading=config)
    assert capture.fps == pytest.approx(20, rel=0.01)
    assert frame_numbers(capture) == timestamps


def test_timeline__refuses_a_variable_frame_rate_by_default(tmp_path):
    path = timed(tmp_path / "c", a=REGULAR[:5], b=LATE)
    with pytest.raises(
        ValueError,
        match=r"b.mp4: expected a constant frame rate, got frame 3 100 ms late; .*--trim",
    ):
        load_capture(path)
    assert load_capture(path, max_frames=3).num_frames == 3


def test_timeline__reports_how_irregular_a_clip_is_and_what_was_done(tmp_path):
    path = timed(tmp_path / "c", a=REGULAR, b=LATE)
    assert load_capture(path, reading=ReadConfig(trim=True)).notes == (
        "b.mp4: variable frame rate, 5 frames in 7 periods of 50.0 ms, up to 0.0 ms off; each "
        "timestamp has the frame nearest in time: 2 repeat one, 0 have none.",
    )
    capture = load_capture(path, reading=ReadConfig(gaps=True))
    assert "0 repeat one, 2 have none" in capture.metadata()["notes"][0]
    problems = [frame.problems for frame in capture.partial_frames(3, 4)]
    assert problems == [(f"b: {path / 'b.mp4'}: no frame at timestamp 3.",)]
    # Rounded, as in Matroska.
    regular = timed(tmp_path / "d", a=REGULAR, b=[50 * t + t % 2 for t in range(7)])
    assert load_capture(regular).notes == ()


def images(path, names=("cam_0", "cam_2", "cam_10")):
    """Write three folders of images 0000.png ... 0003.png."""
    return layouts.n3dv(path, tuple(names), layouts.folder_per_camera)


def test_partial_frames__leave_out_missing_and_broken_images(tmp_path, caplog):
    """Images are aligned by number; even the first, which determines the size, may be missing."""
    path = images(tmp_path / "c")
    (path / "cam_0" / "0000.png").unlink()
    (path / "cam_2" / "0002.png").write_bytes(b"no image")
    write_png(path / "cam_10" / "0003.png", np.zeros((8, 8, 3), np.uint8))
    capture = load_capture(path, reading=ReadConfig(gaps=True))
    assert frame_numbers(capture) == [[None, 0, 0], [1, 1, 1], [2, None, 2], [3, 3, None]]
    problems = [frame.problems for frame in capture.partial_frames()]
    assert [len(problem) for problem in problems] == [1, 0, 1, 1]
    assert "cam_0: " in problems[0][0]
    assert "cam_0/0000.png: expected an image, found none" in problems[0][0]
    assert "cam_10/0003.png: expected 62x46 as in 0000.png, got 8x8" in problems[3][0]
    assert "frame 2: cam_2 is left out: " in caplog.text


def test_open_clips__refuses_numbers_that_span_more_than_the_images(tmp_path):
    number = "9" * 60
    path = images(tmp_path / "c")
    (path / "cam_2" / "0003.png").rename(path / "cam_2" / f"{number}.png")
    with pytest.raises(
        ValueError,
        match=rf"c: expected numbers of images without .*, got {number} after 3",
    ):
        load_capture(path, reading=ReadConfig(gaps=True))


def test_frames__stop_at_a_broken_image(tmp_path):
    path = images(tmp_path / "c")
    (path / "cam_2" / "0002.png").write_bytes(b"")
    frames = load_capture(path).frames()
    assert [next(frames).index for _ in range(2)] == [0, 1]
    with pytest.raises(ValueError, match=r"cam_2/0002.png: expected an image, got 0 bytes"):
        next(frames)
