"""The provisional first frame beside a stream, which viewers show while the first one is fitted."""

import errno
from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.reader import StreamReader
from morgs_mi.fit.fit_config import DensityConfig
from morgs_mi.platform.files import PROVISIONAL
from morgs_mi.runs import fit_capture
from morgs_mi.runs.fit_capture import FirstFrameProgress, stream_capture
from morgs_mi.runs.fit_files import ProvisionalFrame
from tests.scenes.recording import CONFIG, recording


def stream_of(out):
    return (out / "stream.morgs").read_bytes()


def without_points(num_frames=1):
    return replace(
        recording(num_frames=num_frames), points=np.zeros((0, 3)), point_colors=np.zeros((0, 3))
    )


def test_FirstFrameProgress__tells_the_time_of_the_steps_that_are_left(monkeypatch):
    clock = iter([130.0, 140.0])
    monkeypatch.setattr(fit_capture.time, "perf_counter", lambda: next(clock))
    watched = FirstFrameProgress(None, begin=100.0)
    watched("Matching views", 3, 3)
    assert watched.left is None
    watched("First frame, about 42 s", 0, 20)  # the first step begins at 130 s
    assert watched.left is None
    watched("First frame, about 42 s", 5, 20)
    assert watched.left == 30.0


@pytest.mark.slow
def test_stream_capture__shows_a_provisional_first_frame(tmp_path, monkeypatch):
    """A stream beside the one that is written has a frame for each round of density control, and is
    removed before the result is written.
    """
    shown = []
    show = ProvisionalFrame.show
    write = StreamWriter.write

    def written(writer, packet):
        assert "provisional" in writer.path.name or not (tmp_path / PROVISIONAL).exists()
        return write(writer, packet)

    def spy(files, keyframe, progress):
        show(files, keyframe, progress)
        provisional = StreamReader(tmp_path / PROVISIONAL)
        shown.append([packet.encoded for packet in provisional])
        metadata = provisional.metadata
        assert metadata.pop("provisional")["seconds"] > 0
        assert metadata == StreamReader(tmp_path / "stream.morgs").metadata
        assert not StreamReader(tmp_path / "stream.morgs").index()

    monkeypatch.setattr(ProvisionalFrame, "show", spy)
    monkeypatch.setattr(StreamWriter, "write", written)
    density = DensityConfig(rounds=3)
    fit = replace(
        CONFIG.fit, num_gaussians=80, first_frame_steps=20, density=density, exposure="off"
    )
    stream_capture(recording(num_frames=2), tmp_path, replace(CONFIG, fit=fit))
    first = next(iter(StreamReader(tmp_path / "stream.morgs")))
    assert len(shown) == 3
    assert [first.encoded] not in shown
    assert not (tmp_path / PROVISIONAL).exists()


def test_stream_capture__shows_pictures_before_it_searches_stereo_points(tmp_path, monkeypatch):
    """Short fits to triangulated points, with which the result has the same bytes as without."""
    complete = recording(num_frames=1)
    shown = []
    counts = []
    monkeypatch.setattr(fit_capture, "match_capture", lambda *_: None)
    monkeypatch.setattr(fit_capture, "triangulate_points", lambda *_: complete)
    monkeypatch.setattr(
        fit_capture, "dense_points", lambda *_: counts.append(len(shown)) or complete
    )
    stream_capture(without_points(), tmp_path / "shown", CONFIG, on_provisional=shown.append)
    assert counts[0] >= 2
    assert not (tmp_path / "shown" / PROVISIONAL).exists()
    monkeypatch.setattr(fit_capture, "preview", lambda *_: None)
    stream_capture(without_points(), tmp_path / "without", CONFIG)
    assert stream_of(tmp_path / "shown") == stream_of(tmp_path / "without")


@pytest.mark.slow
def test_stream_capture__goes_on_without_a_provisional_first_frame_that_has_no_room(
    tmp_path, monkeypatch, caplog
):
    stream_capture(recording(), tmp_path / "whole", CONFIG)
    out = tmp_path / "full"
    write = StreamWriter.write

    def full(writer, packet):
        if "provisional" in writer.path.name:
            raise OSError(errno.ENOSPC, "No space left on device")
        assert not (out / PROVISIONAL).exists(), "it would take the room of the result"
        return write(writer, packet)

    monkeypatch.setattr(StreamWriter, "write", full)
    stream_capture(recording(), out, CONFIG)
    assert stream_of(out) == stream_of(tmp_path / "whole")
    (message,) = caplog.messages
    assert message.startswith(f"{out / PROVISIONAL}: a provisional first frame cannot be written")


def test_stream_capture__removes_a_provisional_first_frame_where_it_fails(tmp_path, monkeypatch):
    """Between the first picture and the result, e.g. in stereo matching."""

    def fail(*_):
        assert (tmp_path / PROVISIONAL).exists()
        raise MemoryError

    monkeypatch.setattr(fit_capture, "match_capture", lambda *_: None)
    monkeypatch.setattr(fit_capture, "triangulate_points", lambda *_: recording(num_frames=1))
    monkeypatch.setattr(fit_capture, "dense_points", fail)
    with pytest.raises(MemoryError):
        stream_capture(without_points(), tmp_path, CONFIG)
    assert not (tmp_path / PROVISIONAL).exists()
