"""`morgs-mi fit`: options, interruption, a full disk, and continuing."""

import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.cli.main import main
from morgs_mi.codec.reader import StreamReader
from morgs_mi.io.video import VideoReader
from morgs_mi.platform.bounded import read_json
from morgs_mi.playback.visualise import write_png
from morgs_mi.stream_loop import StreamLoop
from tests.cli.commands import assert_one_sentence, assert_refused, interrupt
from tests.quick import OPTIONS
from tests.scenes.noise_capture import FRAMES, rig, truncate_clip
from tests.scenes.recording import write_recording


@pytest.mark.slow
def test_fit__continues_without_a_camera_whose_clip_is_cut_off_meanwhile(
    capture, tmp_path, run, monkeypatch
):
    whole = shutil.copy(capture / "cam1.mkv", tmp_path / "whole.mkv")
    truncate_clip(capture)
    opened = VideoReader.open
    copies = {str(capture / "cam1.mkv"): whole}
    monkeypatch.setattr(
        VideoReader, "open", lambda path: replace(opened(copies.get(str(path), path)), path=path)
    )
    assert run("fit", capture, tmp_path / "out", *OPTIONS)[0] == 0
    frames = read_json(tmp_path / "out" / "report.json")["frames"]
    assert [frame["missing_views"] for frame in frames] == [[], ["cam1"], ["cam1"]]
    assert "cam1.mkv: frame 1 of 3 cannot be decoded" in frames[2]["status"]
    assert run("eval", tmp_path / "out", "--json", tmp_path / "eval.json")[0] == 0
    frames = read_json(tmp_path / "eval.json")["frames"]
    assert [frame["views"]["cam1"]["psnr"] is None for frame in frames] == [False, True, True]
    assert all(frame["psnr"] > 0 for frame in frames)


def before_frame_2(monkeypatch, action):
    """Call `action` before frame 2 is fitted."""
    push = StreamLoop.push

    def acting_push(loop, *args):
        if loop.state.frame == 2:
            action()
        return push(loop, *args)

    monkeypatch.setattr(StreamLoop, "push", acting_push)


@pytest.mark.slow
def test_fit__ends_when_its_recording_disappears_and_resumes_when_it_is_back(
    tmp_path, run, monkeypatch
):
    clip = write_recording(tmp_path / "clip", 12)
    out = tmp_path / "out"
    fit = ("fit", clip, out, *OPTIONS)
    with monkeypatch.context() as patch:
        before_frame_2(patch, lambda: clip.rename(tmp_path / "away"))
        status, _, error = run(*fit)
    last = StreamReader(out / "stream.morgs").index()[-1][1]
    assert 2 <= last < 11
    assert status == 1
    sentence = error.splitlines()[-1]
    assert sentence.startswith(f"frame {last + 1}: expected an image of at least one fitted camera")
    assert f"holds {last + 1} frames of 12; continue with `--resume`" in sentence
    (tmp_path / "away").rename(clip)
    assert run(*fit, "--resume")[0] == 0


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        (["--downscale", "0.5"], ("`downscale` must be a number in [1, inf), got 0.5",)),
        (
            ["--hold-out", "3"],
            ("`test_view` must be an index in 0..2 or one of cam0, cam1, cam2", "got '3'"),
        ),
        (["--offset", "cam9", "1"], ("`offset` must name cameras of cam0, cam1, cam2, got cam9",)),
        (["--quality", "nan"], ("`codec.quality` must be a finite number, above 0, got nan",)),
        (["--flow", "none"], ("`motion.flow_method` must be one of dis,", "got 'none'")),
        (["--flow", "files:nowhere"], ("nowhere",)),
        (
            ["--config", "nowhere.toml"],
            ("nowhere.toml: expected a TOML file with settings, found none",),
        ),
        (
            ["--variant", "cuda_ad_rgb"],
            ("--variant cuda_ad_rgb cannot be used here", "llvm_ad_rgb"),
        ),
    ],
)
def test_fit__rejects_bad_input_in_one_sentence(capture, tmp_path, run, args, parts):
    if "cuda_ad_rgb" in args and Path("/dev/nvidiactl").exists():
        pytest.skip("this machine has a GPU")
    assert_refused(run("fit", capture, tmp_path / "out", *args), *parts)
    assert not (tmp_path / "out").exists()


def test_fit__rejects_arguments_that_cannot_be_parsed(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["fit", str(tmp_path), str(tmp_path / "out"), "--epochs", "many"])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert "many" in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("view", "test_views"),
    [(("cam1",), (1,)), (("cam2", "0"), (0, 2)), (("auto",), ())],
)
def test_fit__takes_the_held_out_camera_by_index_or_name(
    capture, tmp_path, run, monkeypatch, view, test_views
):
    assert (
        fitted_capture(monkeypatch, run, capture, tmp_path, "--hold-out", *view).test_views
        == test_views
    )


def fitted_capture(monkeypatch, run, capture, out, *args):
    """Return the capture that `morgs-mi fit` passes on."""
    passed = []

    def stop(capture, *_):
        passed.append(capture)
        raise KeyboardInterrupt

    monkeypatch.setattr("morgs_mi.runs.fit_capture.stream_capture", stop)
    assert run("fit", capture, out, *args)[0] == 130
    return passed[0]


def clean_up(*_):
    """Do what a library may make of an interruption."""
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt:
        raise RuntimeError("drjit: an exception in a callback") from None


@pytest.mark.slow
@pytest.mark.parametrize("interrupted", [partial(signal.raise_signal, signal.SIGTERM), clean_up])
def test_fit__names_what_stands_and_how_to_go_on_when_interrupted(
    capture, tmp_path, run, monkeypatch, interrupted, heeds_interrupts
):
    before_frame_2(monkeypatch, interrupted)
    args = ["fit", str(capture), str(tmp_path / "my out"), *OPTIONS]
    status, _, error = run(*args)
    stands = (
        f"Interrupted. {tmp_path / 'my out'}/stream.morgs holds 2 frames of 3; continue with "
        "`--resume`."
    )
    assert status == 130
    assert error.splitlines()[-1] == stands  # after lines of progress, on a slow machine
    status, _, error = run("eval", tmp_path / "my out", "--json", tmp_path / "eval.json")
    assert (status, "the fit was not finished" in error) == (0, True)
    assert not read_json(tmp_path / "eval.json")["complete"]


def test_fit__does_not_offer_to_resume_a_stream_of_an_earlier_fit(
    capture, stream, tmp_path, run, monkeypatch
):
    (tmp_path / "out").mkdir()
    stream.rename(tmp_path / "out" / "stream.morgs")
    monkeypatch.setattr("morgs_mi.runs.fit_capture.StreamLoop.of", interrupt)
    status, _, error = run("fit", capture, tmp_path / "out", *OPTIONS)
    assert status == 130
    assert error.splitlines()[-1] == "Interrupted."
    assert len(StreamReader(tmp_path / "out" / "stream.morgs").index()) == 2


def test_fit__reports_progress_before_the_first_frame(capture, tmp_path, run, monkeypatch):
    write_colmap(capture / "sparse" / "0", rig(), np.zeros((0, 3)), np.zeros((0, 3)))
    clock = iter(range(0, 10**9, 40))
    monkeypatch.setattr("morgs_mi.cli.console.time.monotonic", lambda: float(next(clock)))
    monkeypatch.setattr("morgs_mi.runs.fit_capture.StreamLoop.of", interrupt)
    status, _, error = run("fit", capture, tmp_path / "out", *OPTIONS)
    assert status == 130
    assert error.startswith("Matching views: 0/3, 0 s elapsed.\nMatching views: 1/3, ")
    assert "Triangulating points: 0/1, " in error


@pytest.mark.slow
def test_fit__ends_with_a_whole_packet_on_a_full_disk(capture, tmp_path):
    """The second packet does not fit: the file ends with the first and still has the intended
    number of frames.
    """
    script = (
        "import resource, sys; from morgs_mi.codec import container\n"
        "from morgs_mi.cli.main import main\n"
        "write = container.StreamWriter.write\n"
        "def limited(writer, packet):\n"
        "    if packet.frame:\n"
        "        resource.setrlimit(resource.RLIMIT_FSIZE, (writer.num_bytes + 9,) * 2)\n"
        "    return write(writer, packet)\n"
        "container.StreamWriter.write = limited\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    args = [sys.executable, "-c", script, "fit", str(capture), str(tmp_path / "out"), *OPTIONS]
    result = subprocess.run(args, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert_one_sentence(
        result.stderr,
        "stream.morgs",
        "could not be written",
        "free space on the disk. ",
        "--resume`.",
    )
    assert "Errno" not in result.stderr
    reader = StreamReader(tmp_path / "out" / "stream.morgs")
    assert len(list(reader)) == 1
    assert reader.metadata["num_frames"] == FRAMES


@pytest.mark.slow
def test_fit__prints_the_first_problem_and_what_to_expect_of_views_between_the_cameras(
    tmp_path, run
):
    clip = write_recording(tmp_path / "clip", 2)
    for image in clip.glob("cam*/0000.png"):
        write_png(image, np.zeros((24, 32, 3), np.uint8))
    status, output, _ = run("fit", clip, tmp_path / "out", *OPTIONS, "--hold-out", "none")
    (first, second) = read_json(tmp_path / "out" / "report.json")["frames"]
    assert (status, second["status"]) == (0, "ok")
    assert "the image is black; cut such frames off" in first["status"]
    assert "Frames with a problem (status in report.json): 1 of 2; frame 0: " in output
    assert f"{first['status']}.\n" in output
    assert first["validation"]["sentence"] in " ".join(output.split())
