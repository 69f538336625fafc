"""Tasks that a worker refuses, and results that it stores."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.runs.cluster import tasks
from morgs_mi.runs.cluster.executor import cores
from morgs_mi.runs.cluster.seams import SegmentConfig
from morgs_mi.runs.cluster.tasks import Fit, FrameRange, Source, fit_frames, installed
from tests.scenes.recording import CONFIG, write_recording


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> Fit:
    capture = load_capture(write_recording(tmp_path_factory.mktemp("clip"), 5))
    return Fit(Source.of(capture), CONFIG, SegmentConfig(), str(mi.variant()), installed())


def test_fit_frames__continues_the_loop_of_the_last_task_or_reads_it_again(
    fit: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = fit_frames(fit, FrameRange(0, 0, 3), ())
    monkeypatch.setattr(Source, "open", None)
    kept = fit_frames(fit, FrameRange(0, 3, 5), first.restart)
    monkeypatch.undo()
    again = fit_frames(fit, FrameRange(0, 3, 5), first.restart)
    assert again.packets == kept.packets
    assert again.restart == kept.restart
    assert [report.frame for report in again.reports] == [3, 4]


def test_fit_frames__refuses_other_versions(fit: Fit) -> None:
    versions = tuple((name, "0.1" if name == "drjit" else version) for name, version in installed())
    with pytest.raises(ValueError, match=r"expected a worker with drjit 0\.1 like the client, got 1\.5\.0; install"):
        fit_frames(replace(fit, versions=versions), FrameRange(0, 0, 1), ())


def test_fit_frames__ends_where_its_memory_ends(fit: Fit, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "share_of_machine", lambda: (cores(), 1000))
    with pytest.raises(MemoryError, match=r"expected a worker with at most 0\.0 GB, its share, got .* fewer workers"):
        fit_frames(fit, FrameRange(0, 0, 1), ())


def test_source__opens_the_capture_as_it_is(tmp_path: Path) -> None:
    capture = load_capture(write_recording(tmp_path, 5), 1.0, "cam1", 4)
    again = Source.of(capture).open()
    assert (again.num_frames, again.test_views, again.names) == (4, (1,), capture.names)


def test_source__of_a_url_is_opened_by_its_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fsspec", reason="comes with the extra `cluster`")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    url = f"file://{write_recording(tmp_path / 'clip', 2)}"
    source = Source.of(load_capture(url))
    assert source.path == url
    assert source.open().num_frames == 2
