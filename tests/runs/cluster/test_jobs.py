"""Batches: every combination is a job, and a mistake in the file is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.runs.cluster.jobs import JobState, read_jobs

JOBS = """
captures = ["clips/walk", "/elsewhere/dance"]
out = "sweep"
seeds = [3, 4]
segments = 2

[settings.quick]
preset = "s"
motion.key_views = 2

[reading]
without = ["cam04"]

[settings.fine.fit]
num_gaussians = 40000
"""


def written(folder: Path, text: str) -> Path:
    (folder / "jobs.toml").write_text(text)
    return folder / "jobs.toml"


def test_read_jobs__combines_captures_settings_and_seeds(tmp_path: Path) -> None:
    jobs = read_jobs(written(tmp_path, JOBS))
    assert [job.name for job in jobs] == [
        f"{capture}-{settings}-s{seed}"
        for capture in ("walk", "dance")
        for settings in ("quick", "fine")
        for seed in (3, 4)
    ]
    assert jobs[0].batch.reading == ReadConfig(without=("cam04",))
    assert jobs[0].capture == tmp_path / "clips/walk"
    assert jobs[0].out == tmp_path / "sweep" / "walk-quick-s3"
    assert jobs[-1].capture == Path("/elsewhere/dance")
    assert (jobs[0].config.fit.epochs, jobs[0].config.motion.key_views, jobs[0].config.seed) == (5, 2, 3)
    assert (jobs[-1].config.fit.num_gaussians, jobs[-1].config.seed, jobs[-1].batch.segments) == (40000, 4, 2)


def test_read_jobs__leaves_urls_as_they_are(tmp_path: Path) -> None:
    (job,) = read_jobs(written(tmp_path, 'captures = ["s3://bucket/clips/walk"]'))
    assert (job.name, job.capture) == ("walk-default-s0", "s3://bucket/clips/walk")


def test_read_jobs__has_default_settings_and_one_seed(tmp_path: Path) -> None:
    assert [job.name for job in read_jobs(written(tmp_path, 'captures = ["walk"]'))] == ["walk-default-s0"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seeds = [0]\nout = @", r"jobs\.toml: expected TOML, got a broken file \(.*line 2"),
        ("seeds = [0]", r"jobs\.toml: `captures` must be one or more that differ, got none"),
        ('captures = ["a/x", "b/x"]', r"jobs\.toml: `captures` must be one or more that differ, got x, x"),
        ('captures = ["x"]\nseeds = [1, 1]', r"jobs\.toml: `seeds` must be one or more that differ, got 1, 1"),
        (
            'captures = ["x"]\nseeds = ["a"]',
            r"jobs\.toml: `seeds` must be a list \(each a whole number below 2\^64\), got \('a',\)",
        ),
        ('captures = ["x"]\nseed = 1', r"jobs\.toml: `seed` is unknown, expected `seeds`"),
        (
            'captures = ["x"]\n[reading]\nwithout = 3',
            r"jobs\.toml: `reading\.without` must be a list \(each a string\)",
        ),
        ('captures = ["x"]\nsettings = 3', r"jobs\.toml: `settings` must be tables such as \[settings\.quick\], got 3"),
        ('captures = ["x"]\n[settings]\nq = 3', r"jobs\.toml: \[settings\.q\]: expected a table, got 3"),
        (
            'captures = ["x"]\n[settings.q]\npreset = "z"',
            r"\[settings\.q\]: `preset` must be one of .* got 'z'",
        ),
        (
            'captures = ["x"]\n[settings.q.fit]\nepoch = 1',
            r"\[settings\.q\]: `fit\.epoch` is unknown, expected",
        ),
    ],
)
def test_read_jobs__names_the_mistake(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_jobs(written(tmp_path, text))


def test_read_jobs__names_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"jobs\.toml: expected a TOML file with jobs, found none"):
        read_jobs(tmp_path / "jobs.toml")


def test_job_state__estimates_the_time_left_from_the_frames_of_this_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = iter([100.0, 103.0])
    monkeypatch.setattr("morgs_mi.runs.cluster.jobs.time.monotonic", lambda: next(now))
    state = JobState(read_jobs(written(tmp_path, JOBS))[0])
    state.progress(4, 20)  # resumed
    assert state.seconds_left is None
    state.progress(10, 20)
    assert (state.seconds, state.seconds_left) == (3.0, 5.0)
