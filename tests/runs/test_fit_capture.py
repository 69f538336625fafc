"""Recording: a fit that is killed and resumed leaves the same files as one that was not."""

import contextlib
import errno
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, replace
from math import ceil
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.codec.container import PAYLOAD, TRAILER, StreamWriter
from morgs_mi.codec.frame_source import play
from morgs_mi.codec.packets import coded_frames
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.view import Views
from morgs_mi.fit.fit_config import ShortFitConfig
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.platform.bounded import read_json
from morgs_mi.platform.files import write_json
from morgs_mi.platform.progress import Progress
from morgs_mi.playback.stream_header import as_fitted, open_stream_capture
from morgs_mi.runs.fit_capture import stream_capture, with_next, with_points
from morgs_mi.runs.fit_files import Recording as Files
from morgs_mi.runs.fit_files import read_reports, stream_metadata
from morgs_mi.stream_loop import StreamLoop
from tests.codec.forge import damaged, with_forged_bytes, with_forged_header, with_forged_packets
from tests.scenes.captures import colmap
from tests.scenes.coded_clip import history
from tests.scenes.recording import CONFIG, FRAMES, recording, write_recording
from tests.scenes.short_clip import Clip, pieces_of

# About what the fit takes here; on a slower machine all kills come early.
SECONDS = 0.8


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The output of a fit without interruption."""
    out = tmp_path_factory.mktemp("whole")
    stream_capture(recording(), out, CONFIG)
    return out


def stream_of(out):
    return (out / "stream.morgs").read_bytes()


def report_of(out):
    """Return the report without what differs between any two runs."""
    report = read_json(out / "report.json")
    return report | {
        "frames": [
            {name: value for name, value in row.items() if name not in ("seconds", "memory")}
            for row in report["frames"]
        ]
    }


def assert_same(out, whole):
    assert stream_of(out) == stream_of(whole)
    assert report_of(out) == report_of(whole)
    assert (out / "capture.json").read_bytes() == (whole / "capture.json").read_bytes()
    assert sorted(path.name for path in out.iterdir()) == [
        "capture.json",
        "report.json",
        "stream.morgs",
    ]


def process(out, *left):
    args = [sys.executable, "-m", "tests.scenes.recording", str(out), *map(str, left)]
    started = subprocess.Popen(args, stdout=subprocess.PIPE, cwd=Path(__file__).parents[2])
    assert started.stdout.readline() == b"ready\n"
    return started


def kill_and_resume(whole, folder, kills):
    """Fit again and again, each time killed at a random byte of the stream or a random moment,
    until it is done.
    """
    rng = np.random.default_rng(0)
    size = len(stream_of(whole))
    killed = 0
    fits = 0
    while killed < kills:
        out = folder / f"{fits}"
        fits = fits + 1
        status = -9
        while status and killed < kills:
            written = len(stream_of(out)) if (out / "stream.morgs").exists() else 0
            if rng.random() < 0.5 and written < size:
                running = process(out, int(rng.integers(1, size - written + 1)))
            else:
                running = process(out)
                time.sleep(rng.uniform(0, SECONDS))
                running.kill()
            status = running.wait()
            assert status in (-9, 0)
            killed += status == -9
        stream_capture(recording(), out, CONFIG, resume=True)
        assert_same(out, whole)


def other_fit(out, push=None):
    """Fit with another seed into a folder; `push` replaces the fit of a frame."""
    with pytest.MonkeyPatch.context() as patch:
        if push is not None:
            patch.setattr(StreamLoop, "push", push)
        stream_capture(recording(path=Path("other")), out, replace(CONFIG, seed=1))


def files_of(out):
    return {path.name: path.read_bytes() for path in out.iterdir()}


@pytest.mark.slow
def test_stream_capture__keeps_an_earlier_fit_until_its_first_frame(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)

    def fail(*_):
        assert {name: data for name, data in files_of(out).items() if name[0] != "."} == files_of(
            whole
        )
        raise OSError(errno.ENOSPC, "full")

    with pytest.raises(OSError, match="full"):
        other_fit(out, fail)
    assert files_of(out) == files_of(whole)
    stream_capture(recording(), out, CONFIG, resume=True)
    assert files_of(out) == files_of(whole)


@pytest.mark.slow
def test_stream_capture__replaces_an_earlier_fit_together(whole, tmp_path):
    out = tmp_path / "out"
    push = StreamLoop.push
    frames = []
    shutil.copytree(whole, out)

    def spy(loop, *args):
        if frame := loop.state.frame:
            metadata = read_json(out / "capture.json")
            rows = report_of(out)["frames"]
            held = {index for _, index, _ in StreamReader(out / "stream.morgs").index()}
            frames.append(
                (
                    Path(metadata["capture"]).name,
                    report_of(out)["config"]["seed"],
                    len(rows),
                    len(held),
                )
            )
            assert len(rows) == frame
        return push(loop, *args)

    other_fit(out, spy)
    assert frames == [("other", 1, frame, frame) for frame in range(1, FRAMES)]
    assert sorted(files_of(out)) == ["capture.json", "report.json", "stream.morgs"]


@pytest.mark.slow
@pytest.mark.parametrize("calls", range(1, 5))
def test_stream_capture__resumes_after_a_kill_between_the_files_that_it_replaces(
    whole, tmp_path, monkeypatch, calls
):
    """Whatever has been replaced, the files that are there after the next start belong together."""
    out = tmp_path / "out"
    count = 0
    rename = Path.replace
    shutil.copytree(whole, out)

    class Killed(BaseException):
        pass

    def dying(path, target):
        nonlocal count
        count += path.name.startswith(".next-") and path.suffix in (".morgs", ".json")
        if count >= calls:
            raise Killed
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", dying)
    monkeypatch.setattr(Files, "__exit__", lambda *_: None)  # a killed process does not clean up
    with contextlib.suppress(Killed):
        other_fit(out)
    monkeypatch.undo()
    if calls == 1:  # nothing was replaced
        stream_capture(recording(), out, CONFIG, resume=True)
        assert files_of(out) == files_of(whole)
    stream_capture(recording(path=Path("other")), out, replace(CONFIG, seed=1), resume=calls > 1)
    other_fit(tmp_path / "new")
    assert_same(out, tmp_path / "new")


@pytest.mark.slow
def test_stream_capture__killed_and_resumed_is_the_same(whole, tmp_path):
    kill_and_resume(whole, tmp_path, 3)


@pytest.mark.long
def test_stream_capture__killed_60_times_is_the_same(whole, tmp_path):
    kill_and_resume(whole, tmp_path, 60)


def cuts(whole):
    """Return bytes within and between packets of every kind."""
    index = StreamReader(whole / "stream.morgs").index()
    size = len(stream_of(whole))
    ends = [offset for _, _, offset in index]
    index_at = size - PAYLOAD - 16 * len(index) - TRAILER.size
    # A re-emitted keyframe, the fourth packet, may be missing after its residual.
    return [0, ends[0] - 1, ends[0], ends[3] - 1, ends[3], ends[4], index_at, size - 1, size]


@pytest.mark.slow
def test_stream_capture__resumed_from_any_cut_is_the_same(whole, tmp_path):
    report = read_json(whole / "report.json")
    for k, at in enumerate(cuts(whole)):
        out = interrupted(whole, tmp_path / f"{at}", at)
        count = len(played(out / "stream.morgs"))
        # A row of the report may be there before its packet.
        rows = report["frames"][: count + k % 2]
        (out / "report.json").write_text(json.dumps({**report, "frames": rows}))
        reports = stream_capture(recording(), out, CONFIG, resume=True)
        assert [r.frame for r in reports] == list(range(FRAMES))
        # What was there was not fitted again.
        assert [r.seconds for r in reports[:count]] == [row["seconds"] for row in rows[:count]]
        assert_same(out, whole)


def test_stream_capture__resumed_after_an_interrupt_is_the_same(whole, tmp_path):
    """The stream was closed, with an index that must not stay in the middle."""

    def stop(stage, done, total):
        if stage == "Later frames" and done > 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stream_capture(recording(), tmp_path / "out", CONFIG, progress=stop)
    reader = StreamReader(tmp_path / "out" / "stream.morgs")
    assert reader.closed()
    assert [frame for frame, _ in play(reader)] == [0, 1, 2]
    stream_capture(recording(), tmp_path / "out", CONFIG, resume=True)
    assert_same(tmp_path / "out", whole)


def interrupted(whole, out, at):
    shutil.copytree(whole, out)
    os.truncate(out / "stream.morgs", at)
    return out


def played(path):
    """Return the frames that can be played."""
    numbers = []
    with contextlib.suppress(ValueError):
        numbers.extend(frame for frame, _ in play(StreamReader(path)))
    return numbers


def brighter(capture):
    """Return another recording with the same cameras."""
    return replace(capture, point_colors=capture.point_colors / 2)


@pytest.mark.parametrize(
    ("capture", "config", "message"),
    [
        (
            recording(),
            replace(CONFIG, seed=1),
            r"resume a fit with metadata\.config\.seed = 0, got 1",
        ),
        (brighter(recording()), CONFIG, r"resume a fit with metadata\.fingerprint = "),
        (recording(views=Views(recording().views[::-1])), CONFIG, "resume a fit with cameras = "),
    ],
)
def test_stream_capture__does_not_resume_another_fit(whole, tmp_path, capture, config, message):
    out = interrupted(whole, tmp_path / "out", len(stream_of(whole)) // 2)
    old_stream = stream_of(out)
    with pytest.raises(ValueError, match=message):
        stream_capture(capture, out, config, resume=True)
    assert stream_of(out) == old_stream


def test_stream_capture__does_not_resume_a_damaged_fit(whole, tmp_path):
    out = interrupted(whole, tmp_path / "out", len(stream_of(whole)))
    damaged = bytearray(stream_of(whole))
    damaged[len(damaged) // 2] ^= 1
    (out / "stream.morgs").write_bytes(damaged)
    with pytest.raises(ValueError, match="the bytes are damaged"):
        stream_capture(recording(), out, CONFIG, resume=True)
    assert stream_of(out) == damaged


@pytest.mark.slow
def test_stream_capture__refuses_a_folder_into_which_another_fit_writes(whole, tmp_path):
    """The other one goes on, and its files are whole."""
    refused = {}

    def fit_too(stage, done, total):
        frame = ceil(done)
        if stage == "Later frames" and frame in (1, 3) and frame not in refused:
            with pytest.raises(
                BlockingIOError, match="out: expected a folder into which nothing else is written"
            ) as e:
                stream_capture(recording(), tmp_path / "out", CONFIG, resume=frame == 3)
            refused[frame] = e

    stream_capture(recording(), tmp_path / "out", CONFIG, progress=fit_too)
    assert len(refused) == 2
    assert_same(tmp_path / "out", whole)


@pytest.mark.slow
@pytest.mark.parametrize("change", ["removed", "moved", "replaced"])
def test_stream_capture__ends_when_its_stream_is_taken_away(whole, tmp_path, change):
    out = tmp_path / "out"
    reports = []

    def take_away(stage, done, total):
        frame = ceil(done) if stage == "Later frames" else 0
        if frame in reports:
            return
        reports.append(frame)
        if frame != 2:
            return
        if change == "removed":
            (out / "stream.morgs").unlink()
        elif change == "replaced":
            shutil.copy(whole / "stream.morgs", tmp_path / "other")
            (tmp_path / "other").replace(out / "stream.morgs")
        else:
            out.rename(tmp_path / "moved")

    place = "another file" if change == "replaced" else "none"
    with pytest.raises(
        FileNotFoundError,
        match=rf"stream\.morgs: expected the stream that is being .*, found {place}",
    ):
        stream_capture(recording(), out, CONFIG, progress=take_away)
    assert max(reports) == 2
    if change == "replaced":
        assert stream_of(out) == stream_of(whole)
    elif change == "moved":
        assert not out.exists()
        stream_capture(recording(), tmp_path / "moved", CONFIG, resume=True)
        assert_same(tmp_path / "moved", whole)


def test_stream_metadata__has_no_path(tmp_path):
    """A stream is shared; its capture is named in the file beside it."""
    secret = tmp_path / "home" / "jane"
    methods = replace(
        CONFIG.motion,
        flow_method=f"files:{secret}/flow",
        mask_method=f"sam2:{secret}/encoder.onnx,{secret}/decoder.onnx",
    )
    capture = recording(path=secret / "clip")
    header = stream_metadata(
        capture, next(capture.partial_frames()), replace(CONFIG, motion=methods)
    )
    assert "jane" not in json.dumps(header)
    assert header["config"]["motion"]["flow_method"] == "files:flow"
    assert header["config"]["motion"]["mask_method"] == "sam2:encoder.onnx,decoder.onnx"


@pytest.mark.slow
def test_stream_capture__resumes_a_stream_whose_header_has_a_path(whole, tmp_path):
    """As the headers of earlier versions have; the recording may have moved."""
    reader = StreamReader(whole / "stream.morgs")
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    metadata = {**reader.metadata, "capture": "/elsewhere"}
    with StreamWriter(out / "stream.morgs", reader.cameras, reader.fps, metadata) as writer:
        for packet in list(reader)[:3]:
            writer.write(packet)
    stream_capture(recording(), out, CONFIG, resume=True)
    assert history(coded_frames(StreamReader(out / "stream.morgs"))) == history(
        coded_frames(reader)
    )
    assert read_json(out / "capture.json")["capture"] == str(Path("noise").resolve())


def test_stream_capture__resumes_beside_a_hostile_description(whole, tmp_path):
    out = interrupted(whole, tmp_path / "out", len(stream_of(whole)) * 3 // 4)
    (out / "capture.json").write_text("[]")
    stream_capture(recording(), out, CONFIG, resume=True)
    assert_same(out, whole)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "expected JSON, got a broken file"),
        ('{"frames": []}', "expected the report of 6 frames, got none or a broken one .0 rows"),
        (
            f'{{"frames": [{{"seconds": {10**400}}}]}}',
            "expected the report of 6 frames, got none or a broken one",
        ),
        (None, "expected the report of 6 frames, got none or a broken one"),
    ],
    ids=["broken", "empty", "large", "missing"],
)
def test_stream_capture__refuses_a_hostile_or_missing_report(whole, tmp_path, text, message):
    out = interrupted(whole, tmp_path / "out", len(stream_of(whole)))
    (out / "report.json").unlink()
    if text is not None:
        (out / "report.json").write_text(text)
    with pytest.raises(ValueError, match=f"report.json: {message}"):
        stream_capture(recording(), out, CONFIG, resume=True)


@pytest.mark.slow
def test_stream_capture__resumes_hostile_streams_or_refuses_them_in_one_sentence(whole, tmp_path):
    clip = Clip(stream_of(whole), pieces_of(stream_of(whole)), {})
    out = tmp_path / "out"
    for case in range(12):
        forge = (damaged, with_forged_bytes, with_forged_packets, with_forged_header)[case % 4]
        forged = forge(clip, np.random.default_rng(case))
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(whole, out)
        (out / "stream.morgs").write_bytes(forged)
        refusal = ""
        try:
            stream_capture(recording(), out, CONFIG, resume=True)
        except ValueError as error:
            refusal = str(error)
        assert refusal.startswith(f"{out}/") or StreamReader(out / "stream.morgs").seek(FRAMES - 1)


def test_stream_capture__does_not_write_through_a_link_into_a_capture(tmp_path):
    capture = colmap(tmp_path / "clip")
    (capture / "capture.json").write_text("{}")
    out = tmp_path / "out"
    out.mkdir()
    (out / "capture.json").symlink_to(capture / "capture.json")
    with pytest.raises(
        ValueError, match=rf"an output outside of captures, .* in the capture {capture}; choose"
    ):
        stream_capture(recording(), out, CONFIG)
    assert (capture / "capture.json").read_text() == "{}"


def test_with_points__does_not_use_points_that_no_camera_sees(tmp_path, caplog):
    """Others are found in the images."""
    write_recording(tmp_path / "clip")
    capture = load_capture(tmp_path / "clip")
    assert with_points(capture, 0, Progress()) is capture
    beside = replace(capture, points=capture.points + np.float32([50, 0, 0]))
    assert with_points(beside, 0, Progress()).points[:, 0].max() < 10
    assert "clip: the cameras see 0 % of the 150 points, which are not used: check" in caplog.text


def test_read_reports__reads_frames_without_a_psnr(tmp_path):
    report = FrameReport(0, 1.0, 100, {}, 10)
    assert np.isnan(report.psnr)
    row = asdict(report)
    old_row = {name: value for name, value in row.items() if name != "psnr"}
    write_json(tmp_path / "report.json", {"frames": [row, {**old_row, "frame": 1}]})
    assert read_json(tmp_path / "report.json")["frames"][0]["psnr"] is None
    reports = read_reports(tmp_path / "report.json", range(2))
    assert [np.isnan(read.psnr) for read in reports] == [True, True]


def test_with_next__yields_the_frames_before_one_that_cannot_be_read():
    def frames():
        yield from "ab"
        raise OSError("the video ends here")

    numbers = []
    with pytest.raises(OSError, match="the video ends here"):
        numbers.extend(with_next(frames()))
    assert numbers == [("a", "b"), ("b", None)]


def refined_config():
    """Return the config with refined cameras."""
    return replace(CONFIG, fit=replace(CONFIG.fit, refine_cameras="on"))


def test_stream_capture__stores_refined_cameras_and_resumes_with_them(
    tmp_path_factory, monkeypatch
):
    changes = np.full((2, 11), 1e-3)  # by features, of which the images have too few
    monkeypatch.setattr(
        "morgs_mi.extras.calibration.refine.RefinementProblem.matched", lambda _: (changes, 100)
    )
    tmp_path = tmp_path_factory.mktemp("out")
    config = refined_config()
    capture = load_capture(write_recording(tmp_path_factory.mktemp("capture"), 2), test_view=0)
    stream_capture(capture, tmp_path, config)
    stream = StreamReader(tmp_path / "stream.morgs")
    whole = stream_of(tmp_path)
    names = set(stream.metadata["distortions"])
    assert names == set(capture.names[1:]), "the terms of the training views"
    opened = open_stream_capture(stream, None, [0, 1])
    assert np.array_equal(opened.cameras[1].viewmat, stream.cameras[1].viewmat)
    assert [list(view.distortion) for view in opened.views[1:]] == [
        *stream.metadata["distortions"].values()
    ]
    assert np.array_equal(stream.cameras[0].viewmat, capture.cameras[0].viewmat), (
        "the held-out view"
    )
    assert all(
        not np.array_equal(stream.cameras[v].viewmat, capture.cameras[v].viewmat) for v in (1, 2)
    )
    first = report_of(tmp_path)["frames"][0]["validation"]["refinement"]
    assert first["taken"]
    (tmp_path / "stream.morgs").write_bytes(whole[: stream.index()[-1][2]])
    stream_capture(capture, tmp_path, config, resume=True)
    assert stream_of(tmp_path) == whole


@pytest.mark.parametrize("distortion", [[1, 2], {"cam1": ["x", "y"]}])
def test_as_fitted__refuses_broken_distortions(tmp_path, distortion):
    capture = recording()
    with StreamWriter(
        tmp_path / "stream.morgs", capture.cameras, 25.0, {"distortions": distortion}
    ):
        pass
    with pytest.raises(ValueError, match=r"`distortions` .*must be"):
        as_fitted(capture, StreamReader(tmp_path / "stream.morgs"))


@pytest.mark.slow
def test_stream_capture__resumes_with_delays_of_cameras_and_the_exposures_of_the_report(tmp_path):
    how = ShortFitConfig(gaussians=40, steps=4, rounds=1)
    reading = ReadConfig(offset={"cam1": 0.25, "cam2": -0.5})
    capture = load_capture(write_recording(tmp_path / "capture"), reading=reading)
    delays = [0, -0.25, 0.5]
    assert [camera.delay for camera in capture.cameras] == delays
    config = replace(CONFIG, fit=replace(CONFIG.fit, exposure="on", short_fits=how))
    out = tmp_path / "out"
    stream_capture(capture, out, config)
    stream = StreamReader(out / "stream.morgs")
    assert [c.delay for c in open_stream_capture(stream, None, [0, 1]).cameras] == delays
    whole = stream_of(out)
    report = report_of(out)
    assert all(len(row["exposures"]) == len(capture.train_views) for row in report["frames"])
    for frame in (1, 3):
        end = next(offset for _, index, offset in stream.index() if index == frame)
        (out / "stream.morgs").write_bytes(whole[:end])
        stream_capture(capture, out, config, resume=True)
        assert stream_of(out) == whole
        assert report_of(out)["frames"] == report["frames"]


def test_stream_metadata__names_the_calibration_that_cameras_are_refined_from():
    capture = recording()
    first, *others = capture.cameras
    wider = replace(first, K=np.diag([1.01, 1.01, 1]) @ first.K)
    frame = next(capture.partial_frames())
    same, different = (
        stream_metadata(c, frame, refined_config())["fingerprint"]
        for c in (capture, capture.with_cameras((wider, *others)))
    )
    assert same != different
