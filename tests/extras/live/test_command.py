"""`morgs-mi live`: from sources to a stream with a summary, its end, and what it refuses."""

import re
from unittest.mock import Mock

import pytest

from morgs_mi.extras.live import command as module
from morgs_mi.extras.live.command import Live, LiveSettings, _Lines, _summary
from morgs_mi.extras.live.fit_live import LiveFrame
from morgs_mi.extras.live.live_config import LIVE_STREAM
from morgs_mi.io.video_writer import write_video
from morgs_mi.platform.files import PROVISIONAL
from morgs_mi.playback.streams import open_stream
from tests.cli.commands import interrupt
from tests.cli.test_settings import check_help
from tests.quick import OPTIONS
from tests.scenes import noise_capture


@pytest.fixture
def videos(tmp_path):
    """Videos of half a second, which are played at their own speed, one per camera."""
    paths = [tmp_path / "videos" / f"{name}.mkv" for name in noise_capture.NAMES]
    for path in paths:
        write_video(path, noise_capture.clip(10), 20)
    return paths


@pytest.mark.slow
def test_Live__fits_videos_until_they_end(capture, tmp_path, videos, run, monkeypatch, caplog):
    """The viewer starts at a provisional first frame."""
    out = tmp_path / "out"
    calls = []
    monkeypatch.setattr(
        module, "start_viewer", lambda *args: calls.append((args, (out / PROVISIONAL).exists()))
    )
    monkeypatch.setattr(module, "stop_viewer", calls.append)
    options = ("--calibration", capture, "--view", *OPTIONS, "--first-frame-steps", 20)
    status, printed, error = run("live", out, "--camera", *videos, *options)
    assert status == 0
    assert re.fullmatch(
        rf"{out}/stream.morgs: fitted \d+ of \d+ frames \(\d+ dropped\) in [\d.]+ s, [\d.]+ MB, "
        rf"[\d.]+ s for .*\.\nNext: morgs-mi view {out}\n",
        printed,
    )
    assert "Frame 0: 0.0 s after the first, latency " in error
    assert re.search(
        r"the fit ends after frame \d+: cam0, cam1, cam2: it has ended",
        caplog.text,
    )
    assert calls == [((out, True), True), None]
    assert open_stream(out).closed()
    names = {path.name for path in out.iterdir()}
    assert names == {"stream.morgs", "report.json", "capture.json", "capture"}


def test_Live__ends_with_a_summary_on_ctrl_c(capture, tmp_path, videos, run, monkeypatch):
    monkeypatch.setattr(_Lines, "add", interrupt)
    status, printed, error = run(
        "live", tmp_path / "out", "--camera", *videos, "--calibration", capture, *OPTIONS
    )
    assert status == 0
    assert "fitted 1 of 1 frames (0 dropped) in 0.0 s" in printed
    assert "Interrupted" not in error


@pytest.mark.parametrize(
    ("settings", "seconds", "epochs"),
    [
        (LiveSettings(), 30, 2),
        (LiveSettings(first_frame_seconds=5, epochs=8), 5, 8),
        (LiveSettings(preset="s"), 30, 5),
    ],
)
def test_Live__names_the_output_after_the_time(monkeypatch, settings, seconds, epochs):
    fit = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("morgs_mi.extras.live.command.fit_live", fit)
    with pytest.raises(KeyboardInterrupt):
        Live(camera=("0", "rtsp://10.0.0.10/live"), settings=settings).run()
    sources, out, _, config, *_ = fit.call_args.args
    assert re.fullmatch(r"live-\d{8}-\d{6}", out.name)
    assert sources == [0, "rtsp://10.0.0.10/live"]
    assert (config.fit.first_frame_seconds, config.fit.epochs) == (seconds, epochs)


def test_Lines__count_what_was_dropped_since_the_last_one(monkeypatch):
    printed = []
    clock = 100.0
    monkeypatch.setattr(module, "print_warning", printed.append)
    monkeypatch.setattr("time.monotonic", lambda: clock)
    lines = _Lines()
    for frame, seconds in enumerate((0, 0.4, 0.4, 0.4)):
        clock += seconds
        lines.add(LiveFrame(frame, clock - 100, 0.25, 0.004, 3 * (frame > 0)))
    assert printed == [
        "Frame 0: 0.0 s after the first, latency 0.25 s, 0 frames dropped, skew 4 ms.",
        "Frame 3: 1.2 s after the first, latency 0.25 s, 9 frames dropped, skew 4 ms.",
    ]


def test_summary__has_means_of_the_later_frames(tmp_path):
    (tmp_path / "stream.morgs").write_bytes(b"x" * 2_340_000)
    rows = [
        LiveFrame(0, 0, 30, 0.001, 0),
        LiveFrame(1, 31, 0.5, 0.012, 900),
        LiveFrame(2, 32, 0.7, 0.003, 20),
    ]
    assert _summary(tmp_path, rows) == (
        f"{tmp_path}/stream.morgs: fitted 3 of 923 frames (920 dropped) in 32.0 s, 2.3 MB, 30.0 s "
        "for the first one, mean latency of the others 0.60 s, largest skew 12 ms."
    )


def test_help__shows_the_defaults_of_live_fits(capsys):
    check_help("live", LIVE_STREAM, capsys)
