"""Live fits of a clip that is played at real speed: frames are dropped, and the stream shows those
that are not.
"""

from collections import deque
from dataclasses import replace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.codec.reader import StreamReader
from morgs_mi.extras.live import sources as module
from morgs_mi.extras.live.fit_live import fit_live
from morgs_mi.extras.live.live_config import LiveConfig
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.png import png_bytes
from morgs_mi.playback.streams import open_stream
from morgs_mi.runs.fit_capture import stream_capture
from tests.scenes.full_disk import files_end_at
from tests.scenes.live_clip import (
    CONFIG,
    FPS,
    NAMES,
    clips,
    write_calibration,
    write_videos,
)

# Seconds in which the thread of every camera has run, however busy the machine; no test waits so
# long.
BUSY = 30


@pytest.fixture
def rig(tmp_path):
    """The calibration of the cameras."""
    return write_calibration(tmp_path / "rig")


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    return write_videos(tmp_path_factory.mktemp("videos"))


@pytest.fixture
def cameras(monkeypatch):
    """The images that the cameras of this machine deliver next, for the sources 0 to 3."""
    queues = [deque[np.ndarray]() for _ in NAMES]

    def read(source, closed, *_):
        while not closed.wait(0.01):
            yield queues[source].popleft() if queues[source] else None

    monkeypatch.setattr(module, "read_camera", read)
    return queues


def packets(path):
    return [packet.encoded for packet in StreamReader(path / "stream.morgs")]


@pytest.mark.slow
def test_fit_live__follows_videos_at_their_speed(tmp_path, rig, videos):
    out = tmp_path / "out"
    grown = []
    live = LiveConfig(rig, downscale=4, frames=4)
    rows = fit_live(
        videos, out, live, CONFIG, lambda *_: grown.append(open_stream(out).index()[-1][1])
    )
    assert grown == [0, 1, 2, 3], "the stream can be read while it grows"
    assert [row.frame for row in rows] == [0, 1, 2, 3]
    assert min(np.diff([row.time for row in rows])) > 0
    for row in rows[1:]:
        assert row.latency >= 0
        assert not row.problems
        assert row.skew <= 0.5
    assert sum(row.dropped for row in rows) > 0, "the fit is slower than the clip"
    assert sum(row.dropped + 1 for row in rows[1:]) <= FPS * rows[-1].time + 4
    report = read_json(out / "report.json")
    assert [row["dropped"] for row in report["live"]] == [row.dropped for row in rows]
    assert open_stream(out).closed()
    recorded = list(load_capture(out / "capture").images(2))
    assert all(any(np.array_equal(image, other) for other in clips()[2]) for image in recorded)
    # The live fit equals the fit of a recording of its frames, to the bit.
    stream_capture(load_capture(out / "capture", 4), tmp_path / "again", CONFIG)
    assert packets(out) == packets(tmp_path / "again")


def deliver(cameras, number, names=NAMES, **sizes):
    """Let cameras deliver an image, at the sizes that are given and otherwise the recorded one."""
    for name, camera, clip in zip(NAMES, cameras, clips(), strict=True):
        if name in names:
            camera.append(cv2.resize(clip[number], sizes.get(name, (200, 150))))


@pytest.mark.slow
def test_fit_live__leaves_out_images_of_another_size_and_a_camera_that_stops(
    tmp_path, rig, cameras, caplog
):
    """cam2 changes the size of its images in frame 1, cam1 stops after it."""
    deliver(cameras, 0)
    live = LiveConfig(rig, downscale=4, frames=3, timeout=2, warm_up=0)

    def deliver_next(row, _):
        if row.frame == 0:
            deliver(cameras, 1, cam2=(100, 75))
        else:
            deliver(cameras, 2, ("cam0", "cam2", "cam3"))

    _, *rows = fit_live(range(4), tmp_path / "out", live, CONFIG, deliver_next)
    assert [row.problems for row in rows] == [
        ("cam2: expected an image of 200x150, got 100x75",),
        ("cam1: no image for 2 s",),
    ]
    assert "frame 2: cam1 is left out: no image for 2 s" in caplog.messages
    assert not (tmp_path / "out" / "capture" / "cam2" / "0001.png").exists()


@pytest.mark.slow
def test_fit_live__needs_no_images_of_a_camera_that_is_left_out(tmp_path, rig, videos):
    live = LiveConfig(rig, without=("cam1",), downscale=4, frames=1)
    fit_live([videos[0], *videos[2:]], tmp_path / "out", live, CONFIG)
    assert load_capture(tmp_path / "out" / "capture").names == ("cam0", "cam2", "cam3")
    assert not (tmp_path / "out" / "capture" / "cam1").exists()


@pytest.mark.slow
def test_fit_live__calibrates_the_cameras_once(tmp_path, videos):
    live = LiveConfig(frames=2, record=False)
    assert len(fit_live(videos, tmp_path / "out", live, CONFIG)) == 2
    capture = load_capture(tmp_path / "out" / "capture")
    assert capture.names == NAMES
    assert capture.num_frames == 1, "only the first frame is recorded"


@pytest.mark.slow
def test_fit_live__ends_with_a_whole_stream_when_it_is_interrupted(tmp_path, rig, videos):
    def interrupt(row, report):
        if row.frame == 1:
            raise KeyboardInterrupt

    live = LiveConfig(rig, downscale=2)
    rows = fit_live(videos, tmp_path / "out", live, CONFIG, interrupt)
    assert len(rows) == len(packets(tmp_path / "out")) == 2
    assert open_stream(tmp_path / "out").closed()

    def interrupt_first(stage, done, total):
        if stage == "First frame" and done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_live(videos, tmp_path / "first", live, CONFIG, on_stage=interrupt_first)


@pytest.mark.slow
def test_fit_live__ends_with_a_reason(tmp_path, rig, cameras, caplog):
    """Without further images, and with an error when a frame cannot be written."""
    deliver(cameras, 0)
    live = LiveConfig(rig, downscale=4, timeout=2, warm_up=0)
    assert len(fit_live(range(4), tmp_path / "out", live, CONFIG)) == 1
    reason = "the fit ends after frame 0: cam0, cam1, cam2, cam3: no image for 2 s"
    assert reason in caplog.messages
    deliver(cameras, 0)
    fill_disk = Mock(side_effect=OSError("the disk is full"))
    with pytest.raises(OSError, match="the disk is full") as failed:
        fit_live(range(4), tmp_path / "full", live, CONFIG, fill_disk)
    assert failed.value.__notes__ == [f"{tmp_path / 'full' / 'stream.morgs'} ends with frame 0."]
    assert open_stream(tmp_path / "full").closed()
    assert len(packets(tmp_path / "full")) == 1


def deliver_black(cameras):
    """Let cameras deliver a black image, one of another shape."""
    for camera, width in zip(cameras, (120, 120, 90, 120), strict=True):
        camera.append(np.zeros((90, width, 3), np.uint8))


FAULTS = [
    ([], "`camera` must have a source per camera, got none"),
    (["a", "a"], r"must have different sources, got 2 \(a, a\)"),
    (
        [61, 62],
        r"each of the 4 calibrated cameras \(cam0, cam1, cam2, cam3\), got 2 \(61, 62\)",
    ),
    ([60, 61, 62, 63], "cannot open the source 6.; check that it exists"),
]


@pytest.mark.parametrize(("sources", "message"), FAULTS)
def test_fit_live__names_what_is_wrong(tmp_path, rig, sources, message):
    with pytest.raises((ValueError, OSError), match=message):
        fit_live(sources, tmp_path / "out", LiveConfig(rig, timeout=BUSY), CONFIG)
    assert not (tmp_path / "out").exists()


def test_fit_live__refuses_images_of_another_shape(tmp_path, rig, cameras):
    deliver_black(cameras)
    with pytest.raises(
        ValueError, match=r"expected 200x150, the calibrated size of cam2, .* of it, got 90x90"
    ):
        fit_live(range(4), tmp_path / "out", LiveConfig(rig, timeout=BUSY, warm_up=0), CONFIG)
    assert not (tmp_path / "out").exists()


def test_fit_live__keeps_images_that_cannot_be_calibrated(tmp_path, cameras):
    deliver_black(cameras)
    with pytest.raises(
        ValueError, match="expected at least 100 features in every view, got 0 in cam"
    ) as failed:
        fit_live(range(4), tmp_path / "out", LiveConfig(timeout=BUSY, warm_up=0), CONFIG)
    assert (
        f"The images are in {tmp_path / 'out' / 'capture'}: calibrate them with"
        in failed.value.__notes__[0]
    )
    assert (tmp_path / "out" / "capture" / "cam0" / "0000.png").exists()


def test_fit_live__can_be_started_again_after_a_full_disk(tmp_path, rig, cameras):
    sizes = [len(png_bytes(clip[0])) for clip in clips()]
    assert (rig / "sparse" / "0" / "points3D.txt").stat().st_size > max(sizes)
    live = LiveConfig(rig, timeout=BUSY, warm_up=0)
    full = "check that its folder is writable and the disk has room"
    # The calibration does not fit, then not even the images.
    for limit in (max(sizes), min(sizes) - 1):
        deliver(cameras, 0)
        with pytest.raises(OSError, match=full), files_end_at(limit):
            fit_live(range(4), tmp_path / "out", live, CONFIG)
        assert not (tmp_path / "out").exists()


def test_fit_live__does_not_replace_an_earlier_capture(tmp_path, rig):
    (tmp_path / "out" / "capture").mkdir(parents=True)
    with pytest.raises(FileExistsError, match="got that of an earlier fit; choose another folder"):
        fit_live([0], tmp_path / "out", LiveConfig(rig), CONFIG)
    with pytest.raises(
        FileNotFoundError, match="expected a calibrated capture of the cameras, found none"
    ):
        fit_live([0], tmp_path / "new", LiveConfig(tmp_path / "nowhere"), CONFIG)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"calibration": None, "without": ("cam0",)},
            r"`without` must name cameras of a calibration, got cam0 and no calibration",
        ),
        ({"without": ("cam7",)}, "`without` must name cameras of cam0, cam1, .*, got cam7"),
        ({"frames": 0}, "`frames` must be at least 1, got 0"),
    ],
)
def test_fit_live__refuses_settings_out_of_range(tmp_path, rig, changes, message):
    with pytest.raises(ValueError, match=message):
        fit_live([0], tmp_path / "out", replace(LiveConfig(rig), **changes))
