"""`morgs-mi batch`: each job has its folder and log, and one that fails does not stop the others."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from morgs_mi.codec.reader import StreamReader
from tests.cli.commands import assert_refused
from tests.scenes.recording import write_recording

FRAMES = 3
JOBS = """
captures = ["clip", "missing"]
out = "sweep"
seeds = [1]
reading.without = ["cam1"]
[settings.tiny.fit]
num_gaussians = 80
first_frame_steps = 4
epochs = 1
"""


@pytest.fixture
def jobs(tmp_path: Path) -> Path:
    write_recording(tmp_path / "clip", FRAMES)
    (tmp_path / "jobs.toml").write_text(JOBS)
    return tmp_path / "jobs.toml"


def test_batch__names_the_jobs_that_failed_and_finishes_the_others(jobs: Path, run: Callable) -> None:
    status, output, error = run("batch", jobs, "--workers", 1)
    assert status == 1
    assert error.splitlines()[-1] == f"{jobs}: 1 of 2 jobs failed, see above."
    out = jobs.parent / "sweep"
    rows = {row["name"]: row for row in json.loads((out / "batch.json").read_text())["jobs"]}
    stream = StreamReader(out / "clip-tiny-s1" / "stream.morgs")
    assert [frame for _, frame, _ in stream.index()] == list(range(FRAMES))
    assert stream.metadata["config"]["seed"] == 1
    assert "cam1" not in [camera.name for camera in stream.cameras]
    assert "frames 0 to 1: " in (out / "clip-tiny-s1" / "log.txt").read_text()
    assert rows["clip-tiny-s1"]["status"] == "done"
    sentence = f"{jobs.parent / 'missing'}: expected a capture folder, found none; check the path."
    assert rows["missing-tiny-s1"]["sentence"] == sentence
    assert f"missing-tiny-s1: {sentence}" in output

    # Run again with the capture that was missing: only that is fitted.
    write_recording(jobs.parent / "missing", FRAMES)
    before = (out / "clip-tiny-s1" / "stream.morgs").stat().st_mtime_ns
    assert run("batch", jobs, "--workers", 1)[0] == 0
    assert (out / "clip-tiny-s1" / "stream.morgs").stat().st_mtime_ns == before
    assert [row["status"] for row in json.loads((out / "batch.json").read_text())["jobs"]] == ["done"] * 2


def test_batch__says_how_to_continue_after_an_interruption(jobs: Path, run: Callable, monkeypatch) -> None:
    def stop(*_: object) -> Iterator[None]:
        raise KeyboardInterrupt

    monkeypatch.setattr("morgs_mi.runs.cluster.jobs.run_batch", stop)
    status, _, error = run("batch", jobs)
    assert (status, error.strip()) == (130, "Interrupted. The jobs continue with the same command.")


def test_batch__refuses_in_one_sentence(jobs: Path, run: Callable) -> None:
    assert_refused(run("batch", jobs, "--workers", 0), "--workers must be at least 1, got 0")
    assert_refused(run("batch", jobs.parent / "other.toml"), "other.toml: expected a TOML file with jobs, found none")
    assert_refused(run("batch", jobs, "--scheduler", "here"), "--scheduler must be local or an address", "got here")
