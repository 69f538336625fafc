"""`morgs-mi info` for a capture."""

import cv2
import numpy as np
import pytest

from morgs_mi.extras.calibration import command as info
from morgs_mi.extras.calibration.timing import TimeOffsets
from morgs_mi.playback.visualise import write_png
from tests.cli.commands import assert_refused
from tests.scenes.noise_capture import FRAMES, HEIGHT, NAMES, WIDTH


def test_info__lists_the_cameras_of_a_capture(capture, run):
    status, out, _ = run("info", capture, "--no-check")
    assert status == 0
    assert all(f"{name} {WIDTH}x{HEIGHT}" in " ".join(out.split()) for name in NAMES)
    place = f"{NAMES[0]}: {NAMES[0]}.mkv"
    assert f"{FRAMES} frames at 25 fps ({place}), 150 points, without ground truth." in out
    assert "COLMAP" in out
    assert "Reprojection" not in out


def test_info__names_black_first_images(capture, run):
    for image in capture.glob("cam*/0000.png"):
        write_png(image, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    out = run("info", capture)[1]
    assert f"the poses of {', '.join(NAMES)} could not be checked." in out
    assert f"{', '.join(NAMES)} not checked: its first image is black, of one colour or" in out


@pytest.mark.slow
def test_info__prints_the_check_and_draws_the_rig(textured_capture, tmp_path, run):
    path = textured_capture.path
    plot = tmp_path / "new" / "rig.png"
    times = {file: file.stat().st_mtime_ns for file in path.rglob("*")}
    status, out, _ = run("info", path, "--plot", plot)
    assert status == 0
    assert "1 frame at 30 fps (" in out
    assert out.startswith("Views between the cameras will be good: 5 cameras, 7 degrees apart")
    assert "\nReprojection check: median 0.0" in out
    assert "in 15 pairs; the poses fit the images." in out
    assert cv2.imread(str(plot)).shape == (910, 1440, 3)
    assert {file: file.stat().st_mtime_ns for file in path.rglob("*")} == times
    refused = run("info", path, "--plot", tmp_path / "rig.gif")
    assert_refused(refused, "the suffix of a plot must be .png, .jpg, .svg or .pdf, got '.gif'")


def test_info__prints_the_time_offsets_as_options(capture, run, monkeypatch):
    names = (*NAMES[:3], "other")
    offsets = dict(zip(names, (0.0, -0.254, 1.5, 0.7), strict=True))
    errors = dict(zip(names, (0.0, 0.023, 0.41, 1.0), strict=True))
    time_offsets = TimeOffsets(offsets, errors, NAMES[0], 0.3, converged=False)
    monkeypatch.setattr(info, "estimate_time_offsets", lambda *_: time_offsets)
    status, out, _ = run("info", capture, "--no-check", "--time")
    assert status == 0
    out = " ".join(out.split())
    assert f"{NAMES[0]} 0.00 0.00 {NAMES[1]} -0.25 0.02 {NAMES[2]} 1.50 0.41 other 0.70 1.00" in out
    assert f"Pass --offset {NAMES[1]} -0.25 {NAMES[2]} 1.50 for the time of {NAMES[0]}." in out
    assert "errors above 0.1 are uncertain, and from 0.5 not found: the images hardly" in out
    assert "The offsets still change by 0.30 frames" in out
