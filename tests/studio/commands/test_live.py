"""`morgs-mi live`: from sources to a stream with a summary, its end, and what it refuses."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from morgs_mi.core.fit_names import PROVISIONAL
from morgs_mi.io.video_writer import write_video
from morgs_mi.playback.streams import open_stream
from morgs_mi.studio.commands import live as module
from morgs_mi.studio.commands.live import Live, LiveSettings, _Lines, _summary
from morgs_mi.studio.live.fit_live import LiveFrame
from tests.cli.commands import assert_refused
from tests.quick import OPTIONS
from tests.scenes import noise_capture


@pytest.fixture
def videos(tmp_path: Path) -> list[Path]:
    """Videos of half a second, which are played at their own speed, one per camera."""
    paths = [tmp_path / "videos" / f"{name}.mkv" for name in noise_capture.NAMES]
    for path in paths:
        write_video(path, noise_capture.clip(10), 20)
    return paths


@pytest.mark.slow
def test_Live__fits_videos_until_they_end(
    capture, tmp_path: Path, videos: list[Path], run, monkeypatch, caplog
) -> None:
    started = []
    monkeypatch.setattr(module, "start_viewer", lambda *args: started.append(args))
    monkeypatch.setattr(module, "stop_viewer", started.append)
    out = tmp_path / "out"
    status, printed, error = run(
        "live", out, "--camera", *videos, "--calibration", capture, "--view", *OPTIONS
    )
    assert status == 0
    assert re.fullmatch(
        rf"{out}/stream.morgs: fitted \d+ of \d+ frames \(\d+ dropped\) in [\d.]+ s, [\d.]+ MB, "
        r"[\d.]+ s for .*\.\n",
        printed,
    )
    assert "Frame 0: 0.0 s after the first, latency " in error
    assert re.search(
        r"the fit ends after frame \d+: cam0, cam1, cam2: it has ended; --loop repeats videos",
        caplog.text,
    )
    assert started == [(out, True), None]
    assert open_stream(out).closed()
    assert {path.name for path in out.iterdir()} == {
        "stream.morgs",
        "report.json",
        "capture.json",
        "capture",
    }


@pytest.mark.slow
def test_Live__starts_the_viewer_at_a_provisional_first_frame(
    capture: Path, tmp_path: Path, videos: list[Path], run, monkeypatch
) -> None:
    states = []
    monkeypatch.setattr(
        module,
        "start_viewer",
        lambda out, _: states.append(sorted(path.name for path in out.iterdir())),
    )
    monkeypatch.setattr(module, "stop_viewer", lambda _: None)
    args = (
        "--camera",
        *videos,
        "--calibration",
        capture,
        "--view",
        "--frames",
        1,
        *OPTIONS,
        "--first-frame-steps",
        20,
    )
    assert run("live", tmp_path / "out", *args)[0] == 0
    assert len(states) == 1
    assert PROVISIONAL in states[0]


def test_Live__ends_with_a_summary_on_ctrl_c(
    capture: Path, tmp_path: Path, videos, run, monkeypatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(_Lines, "add", interrupt)
    status, printed, error = run(
        "live", tmp_path / "out", "--camera", *videos, "--calibration", capture, *OPTIONS
    )
    assert status == 0
    assert "fitted 1 of 1 frames (0 dropped) in 0.0 s" in printed
    assert "Interrupted" not in error


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        ((), ("--camera must have a source per camera, got none",)),
        (("--timeout", 1e18), ("--timeout must be above 0 and at most 1000000, got 1e+18",)),
        (("--fps", 1e9), ("--fps must be at least 1e-06 and at most 1000000, got 1000000000.0",)),
        (
            ("--test-view", "x", "--camera", "VIDEOS"),
            ("test_view` must be an index in 0..2, one of cam0, cam1, cam2",),
        ),
    ],
)
def test_Live__refuses_in_one_sentence(
    capture: Path, tmp_path: Path, videos, run, args, parts
) -> None:
    arguments = [arg for a in args for arg in (videos if a == "VIDEOS" else [a])]
    assert_refused(run("live", tmp_path / "out", "--calibration", capture, *arguments), *parts)
    assert not (tmp_path / "out").exists()


def test_Live__names_the_output_after_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    arguments: dict[str, Any] = {}

    def fit(sources, out, live, config, *_):
        arguments.update(out=out, sources=sources, fit=config.fit)
        raise KeyboardInterrupt

    monkeypatch.setattr("morgs_mi.studio.live.fit_live.fit_live", fit)
    cases = (
        (LiveSettings(), 30, 2),
        (LiveSettings(first_frame_seconds=5, epochs=8), 5, 8),
        (LiveSettings(preset="s"), 30, 5),
    )
    for settings, seconds, epochs in cases:
        with pytest.raises(KeyboardInterrupt):
            Live(camera=("0", "rtsp://10.0.0.10/live"), settings=settings).run()
        assert re.fullmatch(r"live-\d{8}-\d{6}", arguments["out"].name)
        assert arguments["sources"] == [0, "rtsp://10.0.0.10/live"]
        assert arguments["fit"].first_frame_seconds == seconds
        assert arguments["fit"].epochs == epochs


def test_Lines__count_what_was_dropped_since_the_last_one(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_summary__has_means_of_the_later_frames(tmp_path: Path) -> None:
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
