"""`morgs-mi eval`: its files."""

import shutil

import pytest

from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.files import PROVISIONAL
from tests.cli.commands import assert_refused
from tests.quick import OPTIONS
from tests.scenes.moving_splats import write_stream
from tests.scenes.recording import write_recording


def test_eval__replaces_no_file_of_the_fit(stream, tmp_path, run):
    for name in ("good.morgs", "report.json", "capture.json"):
        assert_refused(
            run("eval", stream, "--json", tmp_path / name),
            f"{name}: expected a new file, got one that the fit has written",
        )


def test_eval__ends_with_what_scores_of_fitted_views_do_not_measure(
    fitted_clip, tmp_path, run, far_cameras
):
    write_stream(tmp_path / "stream.morgs", {"test_view": None})
    args = ("eval", tmp_path, "--capture", fitted_clip / "capture")
    assert run(*args)[1].splitlines()[-2] == "These views were fitted."
    (tmp_path / "report.json").write_text(far_cameras)
    status, output, _ = run(*args, "--json", tmp_path / "scores.json")
    assert status == 0
    assert output.splitlines()[-3] == (
        "These views were fitted; between the cameras: poor (58 degrees apart); refit with "
        "`--hold-out cam1` to measure."
    )
    assert read_json(tmp_path / "scores.json")["between_cameras"] == "poor (58 degrees apart)"
    write_stream(tmp_path / "stream.morgs", {"test_view": 0})
    assert "These views were fitted" not in run(*args)[1]


@pytest.mark.slow
def test_eval__says_that_a_first_frame_is_provisional(tmp_path, run, caplog):
    clip = write_recording(tmp_path / "clip", 1)
    out = tmp_path / "out"
    assert run("fit", clip, out, *OPTIONS)[0] == 0
    assert not caplog.messages
    provisional = (out / "stream.morgs").rename(out / PROVISIONAL)
    assert run("eval", provisional)[0] == 0
    assert run("render", provisional, tmp_path / "image.png")[0] == 0
    sentence = "a provisional first frame of a fit that is still running or was killed"
    assert [sentence in message for message in caplog.messages] == [True, True]


def test_eval__reports_a_hostile_report_in_one_sentence(fitted_clip, tmp_path, run):
    shutil.copy(fitted_clip / "stream.morgs", tmp_path)
    report = f'{{"frames": [{{"frame": 0, "seconds": {10**400}}}]}}'
    (tmp_path / "report.json").write_text(report)
    assert_refused(
        run("eval", tmp_path, "--capture", fitted_clip / "capture"),
        "report.json: expected a fit's report, got a broken one",
    )
