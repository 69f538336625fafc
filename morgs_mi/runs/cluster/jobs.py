"""Batches: many captures, settings and seeds, each a fit with its own folder and log.

    out = "sweep"                       # folder of all fits, relative to this file as are all paths without a protocol
    captures = ["clips/walk", "clips/dance"]
    seeds = [0, 1]
    segments = 4                        # of each fit; downscale, frames and test_view likewise

    [reading]                           # of all captures, as the options of fit
    without = ["cam04"]

    [settings.quick]                    # settings by name: a preset, and tables as in --config
    preset = "s"

    [settings.fine.fit]
    num_gaussians = 40000

Each capture is fitted with all settings and seeds. A batch that is started again continues where it stopped.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

from morgs_mi.capture.capture import load_capture
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.core.documentation import page
from morgs_mi.io.remote import is_url
from morgs_mi.loop.stream_config import StreamConfig, apply_preset, apply_values, read_config
from morgs_mi.runs.cluster.executor import Workers, wait_for
from morgs_mi.runs.cluster.seams import SegmentConfig
from morgs_mi.runs.cluster.segments import SegmentedRun
from morgs_mi.runs.cluster.tasks import Part

__all__ = ["BatchConfig", "Job", "JobState", "read_jobs", "run_batch"]

LOG = "log.txt"


@dataclass(frozen=True)
class BatchConfig:
    """Captures, seeds and options of all jobs of a batch."""

    captures: tuple[str, ...] = ()
    """Folders or URLs of the captures, with distinct names."""
    out: str = "out/batch"
    """Folder of the fits."""
    seeds: tuple[int, ...] = (0,)
    """Seeds."""
    segments: int = 1
    """Number of segments of each fit."""
    downscale: float = 1.0
    """Factor by which the images are reduced."""
    frames: int | None = None
    """Number of frames to fit, from the first one."""
    test_view: str = "auto"
    """Held-out camera, by index or name; none: all are fitted; auto: the capture's own."""
    reading: ReadConfig = field(default_factory=ReadConfig)
    """Reading of clips that do not match, and cameras that are left out."""


@dataclass(frozen=True)
class Job:
    """One fit of a batch.

    Attributes:
        name: names of its capture and settings, and its seed.
        capture: folder or URL.
        out: folder of the fit.
        config: settings.
        batch: options of all jobs.
    """

    name: str
    capture: str | Path
    out: Path
    config: StreamConfig
    batch: BatchConfig


@dataclass
class JobState:
    """State of a job.

    Attributes:
        job: the job.
        status: waiting, fitting, done or failed.
        frames: number of frames that are fitted.
        num_frames: number of frames of the capture, 0 before it is opened.
        worker: name of the worker that fitted the last frames.
        seconds: wall time so far.
        seconds_left: estimate, None if unknown.
        num_bytes: size of the stream, 0 before it is joined.
        error: why the job failed.
    """

    job: Job
    status: str = "waiting"
    frames: int = 0
    num_frames: int = 0
    worker: str = ""
    seconds: float = 0.0
    seconds_left: float | None = None
    num_bytes: int = 0
    error: Exception | None = None
    _begin: tuple[float, int] | None = field(default=None, repr=False)

    def progress(self, frames: int, num_frames: int) -> None:
        """Note how many frames are fitted, and estimate the time left from the frames of this run."""
        now = time.monotonic()
        self.frames, self.num_frames = frames, num_frames
        self._begin = self._begin or (now, frames)
        begin, before = self._begin
        self.seconds = now - begin
        if frames > before:
            self.seconds_left = self.seconds * (num_frames - frames) / (frames - before)

    def note(self, part: Part) -> None:
        """Note the worker of a task, and append its frames and warnings to the log."""
        self.worker = part.worker
        frames = f"frames {part.reports[0].frame} to {part.reports[-1].frame}"
        seconds = sum(report.seconds for report in part.reports)
        self.log(f"{frames}: {seconds:.1f} s on {part.worker}, {part.peak_bytes / 1e9:.2f} GB at most", *part.messages)

    def log(self, *lines: str) -> None:
        """Append lines to the log of the job."""
        self.job.out.mkdir(parents=True, exist_ok=True)
        with open(self.job.out / LOG, "a", encoding="utf-8") as file:
            for line in lines:
                file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {' '.join(line.split())}\n")


def read_jobs(path: str | Path) -> list[Job]:
    """Return the jobs of a TOML file, see the module.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is not valid TOML, a key is unknown or its value is of the wrong type or out of range, or two
            captures have one name.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a TOML file with jobs, found none; see {page('cluster')}.")
    values = read_config(path)
    settings = values.pop("settings", {"default": {}})
    batch = apply_values(BatchConfig(), values, str(path))
    names = [Path(capture).name for capture in batch.captures]
    for key, items in (("captures", names), ("seeds", batch.seeds)):
        if not items or len(set(items)) < len(items):
            raise ValueError(
                f"{path}: `{key}` must be one or more that differ, got {', '.join(map(str, items)) or 'none'}."
            )
    configs = dict(_configs(settings, path))
    folder, jobs = path.parent, []
    for capture, (name, config), seed in product(batch.captures, configs.items(), batch.seeds):
        title = f"{Path(capture).name}-{name}-s{seed}"
        out = folder / batch.out / title
        source = capture if is_url(capture) else folder / capture
        jobs.append(Job(title, source, out, replace(config, seed=seed), batch))
    return jobs


def _configs(settings: Any, path: Path) -> Iterator[tuple[str, StreamConfig]]:
    """Yield names and settings."""
    if not isinstance(settings, Mapping) or not settings:
        raise ValueError(f"{path}: `settings` must be tables such as [settings.quick], got {settings!r}.")
    for name, values in settings.items():
        source = f"{path}: [settings.{name}]"
        if not isinstance(values, Mapping):
            raise ValueError(f"{source}: expected a table, got {values!r}.")
        config, values = StreamConfig(), dict(values)
        if (preset := values.pop("preset", None)) is not None:
            try:
                config = apply_preset(config, preset)
            except ValueError as error:
                sentence = str(error).partition(": ")[2].replace("`name`", "`preset`")
                raise ValueError(f"{source}: {sentence}") from None
        yield name, apply_values(config, values, source)


def run_batch(
    jobs: Sequence[Job], workers: Workers, on_change: Callable[[Sequence[JobState]], None] | None = None
) -> list[JobState]:
    """Run all jobs, as many at once as there are workers; a job that fails does not stop the others.

    Args:
        jobs: the jobs; those that were begun earlier continue.
        workers: from `open_workers`.
        on_change: called with the states of all jobs when one of them changes.

    Raises:
        ConnectionError: the scheduler was lost.
    """
    states, changed = [JobState(job) for job in jobs], on_change or (lambda _: None)

    async def run(state: JobState) -> None:
        state.status = "fitting"
        try:
            await _fit(state, workers, lambda: changed(states))
            state.status = "done"
        except ConnectionError:
            raise
        except Exception as error:
            state.status, state.error = "failed", error
            state.log(f"failed: {error}")
        changed(states)

    wait_for(workers.map(run, states))
    return states


class _Noted(Workers):
    """Workers that pass the result of every task to a function too."""

    def __init__(self, workers: Workers, note: Callable[[Part], None]) -> None:
        self.place, self._workers, self._note = workers.place, workers, note

    @property
    def count(self) -> int:
        return self._workers.count

    async def run(self, function: Callable[..., Part], *args: Any) -> Part:
        part = await self._workers.run(function, *args)
        self._note(part)
        return part


async def _fit(state: JobState, workers: Workers, changed: Callable[[], None]) -> None:
    """Fit a job, and note its progress and the size of its stream."""
    job, batch = state.job, state.job.batch
    view = None if batch.test_view.lower() == "none" else batch.test_view
    capture = load_capture(job.capture, batch.downscale, view, batch.frames, batch.reading)

    def on_stage(stage: str, done: float, total: float) -> None:
        if stage == "Fitting frames":
            state.progress(int(done), int(total))
            changed()

    noted, segments = _Noted(workers, state.note), SegmentConfig(batch.segments)
    fit = await SegmentedRun(capture, job.out, noted, job.config, segments, on_stage).fit(resume=True)
    state.frames = state.num_frames = len(fit.reports)
    state.num_bytes = (job.out / "stream.morgs").stat().st_size
